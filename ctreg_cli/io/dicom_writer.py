"""CT slices as DICOM files (CT Image Storage, Explicit VR Little Endian), for slices that were made and not scanned.

The writer holds no patient: name and id are one constant. Every file of the same content has the same bytes, UIDs
included, so a series can be made again and compared.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.uid import UID, CTImageStorage, ExplicitVRLittleEndian, generate_uid
from pydicom.valuerep import DSfloat

from ctreg_cli._version import __version__
from ctreg_cli.errors import InputError
from ctreg_cli.imaging.slice import Slice

#: the only name and id ever written
PATIENT = "SIMULATED"
#: time 0 of every series; midnight, so that the time of day is the time of the truth
EPOCH = datetime(2000, 1, 1)
#: display window for metal in tissue, HU
WINDOW_CENTRE_HU, WINDOW_WIDTH_HU = 650, 1700
TUBE_KV = 120


@dataclass(frozen=True, slots=True, kw_only=True)
class SeriesIdentity:
    """UIDs of one series, all made from ``entropy``: the same text gives the same UIDs, another text others.

    Put everything the pixels depend on into it, or two different images may claim one identity.
    """

    entropy: str

    def uid(self, role: str) -> UID:
        """The UID of ``study``, ``series``, ``frame of reference`` or of an instance."""
        return generate_uid(entropy_srcs=[self.entropy, role])


def write_ct_slice(path: Path, slice_: Slice, *, instance_number: int, identity: SeriesIdentity) -> None:
    """Write one slice. The file appears as soon as writing begins: make a series in :func:`ctreg_cli.io.new_folder`.

    Raises:
        InputError: the slice lacks what a CT image must have, or the place cannot be written.
    """
    try:
        ct_dataset(slice_, instance_number=instance_number, identity=identity).save_as(path, enforce_file_format=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from error


def ct_dataset(slice_: Slice, *, instance_number: int, identity: SeriesIdentity) -> Dataset:
    """The DICOM data set of a slice with int16 pixels, scale and patient geometry.

    Raises:
        InputError: pixels of another type, or no scale or patient geometry.
    """
    info = slice_.info
    if slice_.stored.dtype != np.int16 or slice_.stored.ndim != 2:
        raise InputError(f"{info.source}: {slice_.stored.dtype} pixels cannot be written as CT; they must be int16")
    if info.scale is None or info.T_patient_slice is None:
        raise InputError(f"{info.source}: a CT image needs mm per pixel and a place in the patient")

    ds = Dataset()
    ds.file_meta = _file_meta(sop_instance := identity.uid(f"instance {instance_number}"))
    ds.SOPClassUID, ds.SOPInstanceUID = CTImageStorage, sop_instance
    _add_patient_and_study(ds, identity)
    _add_series(ds, identity)
    _add_time(ds, info.time_s)
    ds.ImageType = ["DERIVED", "PRIMARY", "AXIAL"]
    ds.InstanceNumber = instance_number
    ds.AcquisitionNumber = instance_number
    ds.KVP = TUBE_KV

    T = info.T_patient_slice
    ds.SliceThickness = "" if info.thickness_mm is None else _ds(info.thickness_mm)
    ds.PixelSpacing = [_ds(info.scale.s_y), _ds(info.scale.s_x)]
    ds.ImageOrientationPatient = [_ds(v) for v in (*T[:3, 0], *T[:3, 1])]
    ds.ImagePositionPatient = [_ds(v) for v in T[:3, 3]]
    ds.SliceLocation = _ds(float(T[:3, 2] @ T[:3, 3]))

    ds.SamplesPerPixel = 1
    ds.PhotometricInterpretation = "MONOCHROME2"
    ds.Rows, ds.Columns = slice_.stored.shape
    ds.BitsAllocated, ds.BitsStored, ds.HighBit, ds.PixelRepresentation = 16, 16, 15, 1
    if slice_.padding is not None:
        low, high = slice_.padding
        ds.PixelPaddingValue = int(low)
        if high != low:
            ds.PixelPaddingRangeLimit = int(high)
    ds.RescaleIntercept, ds.RescaleSlope, ds.RescaleType = _ds(slice_.intercept), _ds(slice_.slope), "HU"
    ds.WindowCenter, ds.WindowWidth = WINDOW_CENTRE_HU, WINDOW_WIDTH_HU
    ds.add_new("PixelData", "OW", slice_.stored.astype("<i2", copy=False).tobytes())
    return ds


def _file_meta(sop_instance: UID) -> FileMetaDataset:
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = CTImageStorage
    meta.MediaStorageSOPInstanceUID = sop_instance
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    return meta


def _add_patient_and_study(ds: Dataset, identity: SeriesIdentity) -> None:
    ds.PatientName = ds.PatientID = PATIENT
    ds.PatientBirthDate = ds.PatientSex = ""
    ds.StudyInstanceUID = identity.uid("study")
    ds.StudyDate, ds.StudyTime = f"{EPOCH:%Y%m%d}", f"{EPOCH:%H%M%S}"
    ds.StudyID = "1"
    ds.AccessionNumber = ds.ReferringPhysicianName = ""


def _add_series(ds: Dataset, identity: SeriesIdentity) -> None:
    ds.Modality = "CT"
    ds.SeriesInstanceUID = identity.uid("series")
    ds.SeriesNumber = 1
    ds.PatientPosition, ds.Laterality = "HFS", ""
    ds.FrameOfReferenceUID = identity.uid("frame of reference")
    ds.PositionReferenceIndicator = ""
    ds.Manufacturer = "ctreg"
    ds.ManufacturerModelName = "simulated"
    ds.SoftwareVersions = __version__


def _add_time(ds: Dataset, time_s: float | None) -> None:
    """Acquisition and content time, to the microsecond DICOM knows; without a time, that of the study."""
    moment = EPOCH + timedelta(seconds=time_s or 0.0)
    ds.AcquisitionDate = ds.ContentDate = f"{moment:%Y%m%d}"
    ds.AcquisitionTime = ds.ContentTime = f"{moment:%H%M%S.%f}"


def _ds(value: float) -> DSfloat:
    """A decimal string of at most 16 characters: 13 or more significant digits."""
    return DSfloat(float(value), auto_format=True)
