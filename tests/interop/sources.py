"""The sample slices as other kinds of images: what their registration refers to is then another class."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydicom import dcmread
from pydicom.dataset import Dataset
from pydicom.uid import CTImageStorage, EnhancedCTImageStorage, EnhancedMRImageStorage, MRImageStorage

from .senders import SLICES

#: storage class → frames in a file
IMAGE_CLASSES = {CTImageStorage: 1, MRImageStorage: 1, EnhancedCTImageStorage: 2, EnhancedMRImageStorage: 2}


def _item(**attributes: Any) -> Dataset:
    ds = Dataset()
    for keyword, value in attributes.items():
        setattr(ds, keyword, value)
    return ds


def _functional_groups(ds: Dataset) -> Dataset:
    moves = {keyword: ds[keyword].value for keyword in ("RescaleSlope", "RescaleIntercept")} | {"RescaleType": "HU"}
    return _item(
        PixelMeasuresSequence=[_item(PixelSpacing=ds.PixelSpacing, SliceThickness=ds.SliceThickness)],
        PlanePositionSequence=[_item(ImagePositionPatient=ds.ImagePositionPatient)],
        PlaneOrientationSequence=[_item(ImageOrientationPatient=ds.ImageOrientationPatient)],
        PixelValueTransformationSequence=[_item(**moves)],
        FrameContentSequence=[_item(FrameAcquisitionDateTime=f"20000101{ds.AcquisitionTime}")],
    )


def image_of_class(sop_class: str, folder: Path) -> Path:
    """A file of this storage class that shows the first sample slices, a frame each."""
    slices = [dcmread(path) for path in SLICES[: IMAGE_CLASSES[sop_class]]]
    ds = slices[0]
    ds.SOPClassUID = ds.file_meta.MediaStorageSOPClassUID = sop_class
    ds.Modality = "MR" if sop_class in (MRImageStorage, EnhancedMRImageStorage) else "CT"
    if IMAGE_CLASSES[sop_class] > 1:
        ds.PerFrameFunctionalGroupsSequence = [_functional_groups(one) for one in slices]
        ds.SharedFunctionalGroupsSequence = [Dataset()]
        ds.NumberOfFrames = len(slices)
        ds.PixelData = b"".join(one.PixelData for one in slices)
        for keyword in (
            *("PixelSpacing", "SliceThickness", "ImagePositionPatient", "ImageOrientationPatient"),
            *("RescaleSlope", "RescaleIntercept", "SliceLocation"),
        ):
            delattr(ds, keyword)
    path = folder / "image.dcm"
    ds.save_as(path, enforce_file_format=True)
    return path
