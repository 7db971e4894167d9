"""DICOM files made in code for the tests: a small CT slice and ways to write, bend and break it."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydicom import dcmwrite
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.encaps import encapsulate
from pydicom.sequence import Sequence
from pydicom.tag import Tag
from pydicom.uid import CTImageStorage, EnhancedCTImageStorage, ExplicitVRLittleEndian, generate_uid

ROWS, COLUMNS = 24, 32
ROW_SPACING_MM, COLUMN_SPACING_MM = 0.75, 0.5
POSITION_MM = (-10.0, -20.5, 30.25)
AXIAL = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
SERIES_UID = "1.2.3.4.1"
CANARY = "CANARY"


def pixels(rows: int = ROWS, columns: int = COLUMNS, dtype: str = "<i2", low: int = -500) -> NDArray[Any]:
    """Every pixel its own value, so that a shift, a shear or a transposition shows."""
    return (np.arange(rows * columns).reshape(rows, columns) + low).astype(dtype)


def ct_slice(stored: NDArray[Any] | None = None, **attributes: Any) -> Dataset:
    """A CT slice with canaries in its patient and text fields; an attribute given as None is left out."""
    stored = pixels() if stored is None else stored
    bits = stored.dtype.itemsize * 8
    ds = Dataset()
    fields: dict[str, Any] = {
        "ImageType": ["ORIGINAL", "PRIMARY", "AXIAL"],
        "SOPClassUID": CTImageStorage,
        "SOPInstanceUID": generate_uid(entropy_srcs=[str(sorted(map(str, attributes.items())))]),
        "StudyDate": "20240229",
        "AcquisitionDate": "20240229",
        "ContentDate": "20240229",
        "AcquisitionTime": "101500.250000",
        "ContentTime": "101501",
        "AccessionNumber": CANARY,
        "Modality": "CT",
        "InstitutionName": CANARY,
        "StudyDescription": CANARY,
        "SeriesDescription": CANARY,
        "PatientName": f"{CANARY}^NAME",
        "PatientID": CANARY,
        "PatientBirthDate": "19000101",
        "PatientComments": CANARY,
        "SliceThickness": "2.5",
        "StudyInstanceUID": "1.2.3.4",
        "SeriesInstanceUID": SERIES_UID,
        "FrameOfReferenceUID": "1.2.3.4.9",
        "InstanceNumber": 1,
        "ImagePositionPatient": list(POSITION_MM),
        "ImageOrientationPatient": list(AXIAL),
        "SamplesPerPixel": 1,
        "PhotometricInterpretation": "MONOCHROME2",
        "Rows": stored.shape[-2],
        "Columns": stored.shape[-1],
        "PixelSpacing": [ROW_SPACING_MM, COLUMN_SPACING_MM],
        "BitsAllocated": bits,
        "BitsStored": bits,
        "HighBit": bits - 1,
        "PixelRepresentation": int(stored.dtype.kind == "i"),
        "RescaleIntercept": "-24",
        "RescaleSlope": "2",
    }
    for keyword, value in {**fields, **attributes}.items():
        if value is not None:
            setattr(ds, keyword, value)
    ds.PixelData = stored.tobytes() + b"\0" * (stored.nbytes % 2)
    ds["PixelData"].VR = "OW" if bits > 8 else "OB"
    return ds


def dicom_bytes(
    ds: Dataset, syntax: str = ExplicitVRLittleEndian, *, sop_class: str = CTImageStorage, preamble: bool = True
) -> bytes:
    """The data set as a DICOM file; without ``preamble`` as a bare data set, with neither preamble nor file meta."""
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = sop_class
    meta.MediaStorageSOPInstanceUID = ds.get("SOPInstanceUID", "1.2.3")
    meta.TransferSyntaxUID = syntax
    meta.ImplementationClassUID = "1.2.3.4.5"
    buffer = io.BytesIO()
    if preamble:
        ds.file_meta = meta
        dcmwrite(buffer, ds, enforce_file_format=True)
    else:
        bare = Dataset({element.tag: element for element in ds})
        implicit, little = syntax.endswith("1.2"), not syntax.endswith(".2.2")
        dcmwrite(buffer, bare, implicit_vr=implicit, little_endian=little)
    return buffer.getvalue()


def write_dicom(path: Path, ds: Dataset | None = None, syntax: str = ExplicitVRLittleEndian, **options: Any) -> Path:
    """Write the data set (a plain CT slice, if none is given) to ``path``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(dicom_bytes(ct_slice() if ds is None else ds, syntax, **options))
    return path


def swap_to_big_endian(ds: Dataset) -> Dataset:
    """pydicom writes the header in any byte order but leaves Pixel Data as it is."""
    ds.PixelData = np.frombuffer(ds.PixelData, dtype=f"<u{ds.BitsAllocated // 8}").byteswap().tobytes()
    return ds


def replace_value(raw: bytes, keyword: str, old: bytes, new: bytes) -> bytes:
    """Overwrite the value of one element in an explicit VR little endian file; both must be of the same length."""
    assert len(old) == len(new)
    tag = Tag(keyword)
    header = tag.group.to_bytes(2, "little") + tag.element.to_bytes(2, "little")
    at = raw.index(header)
    value_at = raw.index(old, at, at + 64)
    return raw[:value_at] + new + raw[value_at + len(new) :]


def item(**attributes: Any) -> Sequence:
    """A sequence of one item."""
    ds = Dataset()
    for keyword, value in attributes.items():
        setattr(ds, keyword, value)
    return Sequence([ds])


def enhanced_ct(frames: NDArray[Any], frame_items: Iterable[dict[str, Any]], **shared: Any) -> Dataset:
    """An enhanced CT: geometry in functional groups only."""
    ds = ct_slice(
        frames,
        SOPClassUID=EnhancedCTImageStorage,
        NumberOfFrames=len(frames),
        ImagePositionPatient=None,
        ImageOrientationPatient=None,
        PixelSpacing=None,
        SliceThickness=None,
        RescaleSlope=None,
        RescaleIntercept=None,
    )
    for keyword, groups in (("SharedFunctionalGroupsSequence", [shared]), ("PerFrameFunctionalGroupsSequence", None)):
        items = []
        for group in groups if groups is not None else frame_items:
            one = Dataset()
            for name, value in group.items():
                setattr(one, name, value)
            items.append(one)
        setattr(ds, keyword, Sequence(items))
    return ds


#: ``pixels(12, 10)`` as codestreams made by GDCM 3.2.6, by transfer syntax
CODESTREAMS = {
    "1.2.840.10008.1.2.4.57": (
        "|JeV-01FTR3;+rN0TBTI!~hlm0RaI30000000000000000R#{K+5iXv0RRC20N;ZZRa%u*T9s8=l~r1mRa%u*T9s8=l~r1mRa%u*T9s8=l~rH="
        "*#H"
    ),
    "1.2.840.10008.1.2.4.70": (
        "|JeV-01FTR3;+rN0TBTI!~hlm0RaI30000000000000000R#{K+5iXv0RRC20N;ZZRa%u*T9s8=l~r1mRa%u*T9s8=l~r1mRa%u*T9s8=l~rH="
        "*#H"
    ),
    "1.2.840.10008.1.2.4.80": (
        "|JeWc01FTR3;+rN0TBTI_y7$7|Nj6I07C&306_oR00;pA00000erN*#U>F7i0f4|@V59<o5Cj1LfIuJ+3Q7hB1_lNO1`Gh91`HT5V8Md`P=f{x"
        "7%*Xm0Kynyh8SUn0faEa3^2nC0|;S;7-5DO1`xvxF^ppXLNSbE7{&nz#xaaz7z862#xaaw0RPzl"
    ),
    "1.2.840.10008.1.2.4.90": (
        "|4;u>04V?f0000A0000C00000000000000A0000C000000000000EBy0sm3}3;+NC0RRF71ONg5TmT9{fQX2Yh=`E?WB@7v0Yh?SVRU6=AYyqS"
        "M?^zSFHdk~Zc0!^M<8}(a&u{KZXhx)GcGXykN^q*00000GXMeqlfXYPun6php2R9z<U4yGpaA*7fDFAizyJ|I0Qmv{Cp$4EM(_XG"
    ),
}
CODESTREAM_SHAPE = (12, 10)


def compressed_slice(syntax: str, *frames: bytes, **attributes: Any) -> Dataset:
    """A CT slice whose pixels are given codestreams (the one above, if none is)."""
    ds = ct_slice(pixels(*CODESTREAM_SHAPE), **attributes)
    ds.PixelData = encapsulate(list(frames) or [base64.b85decode(CODESTREAMS[syntax])])
    ds["PixelData"].VR = "OB"
    ds["PixelData"].is_undefined_length = True
    return ds
