"""DICOM Spatial Registration (PS3.3 A.39.1): the frame's coordinates registered to the patient's, as one object.

The object lives in the slices' frame of reference. It registers two things to it: the slice itself, by the identity,
and the coordinate system of the frame, by the pose. No patient field is written: name, ID and birth date are there,
as the standard demands, and empty.
"""

from __future__ import annotations

import hashlib
import io
import re
from datetime import datetime
from typing import TYPE_CHECKING

import numpy as np

from ctreg_cli._version import __version__
from ctreg_cli.arrays import FloatArray
from ctreg_cli.errors import InputError
from ctreg_cli.interop.selection import Content
from ctreg_cli.io.results_document import SliceRecord

if TYPE_CHECKING:
    from pydicom.dataset import Dataset

SPATIAL_REGISTRATION_CLASS = "1.2.840.10008.5.1.4.1.1.66.1"
_UID_BYTES = 16
_NEEDED = ("sop_class", "sop_instance", "series_instance", "study_instance", "frame_of_reference")
#: PS3.5 9.1
_UID = re.compile(r"(?=.{1,64}\Z)(0|[1-9][0-9]*)(\.(0|[1-9][0-9]*))+")


def spatial_registration(content: Content, record: SliceRecord, *, now: datetime | None = None) -> bytes:
    """The registration of one slice as the bytes of a DICOM file (Explicit VR Little Endian).

    Args:
        content: in patient coordinates.
        record: a usable slice with its UIDs.
        now: when the object is made, for its date and time; None: now.

    Raises:
        InputError: the results hold no patient geometry, or no UIDs.
    """
    from pydicom.dataset import Dataset, FileDataset, FileMetaDataset
    from pydicom.filewriter import dcmwrite
    from pydicom.uid import UID, ExplicitVRLittleEndian

    missing = [name for name in _NEEDED if not _UID.fullmatch(record.uids.get(name, ""))]
    if missing:
        raise InputError(
            f"{content.document.name}: slice {record.index} has no valid {missing[0]} UID, which a DICOM registration "
            "refers to; write the results from DICOM slices with --with-uids -o results.json"
        )
    if content.space != "patient":
        raise InputError(f"{content.document.name}: a DICOM registration is in patient coordinates")
    uids, now = record.uids, now or datetime.now()
    pose = content.pose(record)
    identity = f"{uids['sop_instance']} {pose.round(9).tolist()} {now.isoformat()}"

    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = UID(SPATIAL_REGISTRATION_CLASS)
    meta.MediaStorageSOPInstanceUID = UID(_uid(f"instance {identity}"))
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    stream = io.BytesIO()
    ds = FileDataset(stream, Dataset(), preamble=b"\0" * 128, file_meta=meta)
    ds.SpecificCharacterSet = "ISO_IR 192"
    ds.SOPClassUID, ds.SOPInstanceUID = SPATIAL_REGISTRATION_CLASS, meta.MediaStorageSOPInstanceUID
    ds.InstanceCreationDate = ds.SeriesDate = ds.ContentDate = now.strftime("%Y%m%d")
    ds.InstanceCreationTime = ds.SeriesTime = ds.ContentTime = now.strftime("%H%M%S.%f")
    # patient and study: what belongs to the patient stays with the slices
    for keyword in ("PatientName", "PatientID", "PatientBirthDate", "PatientSex"):
        setattr(ds, keyword, "")
    for keyword in ("StudyDate", "StudyTime", "ReferringPhysicianName", "StudyID", "AccessionNumber"):
        setattr(ds, keyword, "")
    ds.StudyInstanceUID = uids["study_instance"]
    ds.Modality, ds.SeriesInstanceUID = "REG", _uid(f"series {identity}")
    ds.SeriesNumber, ds.InstanceNumber, ds.Laterality = "1", "1", ""
    ds.FrameOfReferenceUID, ds.PositionReferenceIndicator = uids["frame_of_reference"], ""
    ds.Manufacturer, ds.ManufacturerModelName = "ctreg", "ctreg"
    ds.DeviceSerialNumber, ds.SoftwareVersions = "none", __version__
    ds.ContentLabel, ds.ContentDescription, ds.ContentCreatorName = "ROD_FRAME_POSE", "Pose of a rod frame", ""
    ds.RegistrationSequence = [
        _registered(np.eye(4), image=_image_reference(record)),
        _registered(pose, frame_of_reference=model_frame_of_reference(content)),
    ]
    series = Dataset()
    series.SeriesInstanceUID = uids["series_instance"]
    series.ReferencedInstanceSequence = [_image_reference(record)]
    ds.ReferencedSeriesSequence = [series]
    dcmwrite(stream, ds, enforce_file_format=True)
    return stream.getvalue()


def model_frame_of_reference(content: Content) -> str:
    """The UID of the frame's own coordinate system: the same for the same frame file."""
    return _uid(f"frame of reference {content.document.model_sha256 or content.model_name}")


def _registered(T: FloatArray, *, image: Dataset | None = None, frame_of_reference: str | None = None) -> Dataset:
    """An item of the Registration Sequence: what ``T`` (4, 4), mm, brings into the patient's coordinates."""
    from pydicom.dataset import Dataset
    from pydicom.valuerep import DSfloat

    matrix = Dataset()
    matrix.FrameOfReferenceTransformationMatrixType = "RIGID"
    matrix.FrameOfReferenceTransformationMatrix = [
        DSfloat(value, auto_format=True) for value in np.asarray(T, dtype=np.float64).ravel().tolist()
    ]
    registration = Dataset()
    registration.RegistrationTypeCodeSequence = []
    registration.MatrixSequence = [matrix]
    item = Dataset()
    if image is not None:
        item.ReferencedImageSequence = [image]
    if frame_of_reference is not None:
        item.FrameOfReferenceUID = frame_of_reference
    item.MatrixRegistrationSequence = [registration]
    return item


def _image_reference(record: SliceRecord) -> Dataset:
    from pydicom.dataset import Dataset

    image = Dataset()
    image.ReferencedSOPClassUID = record.uids["sop_class"]
    image.ReferencedSOPInstanceUID = record.uids["sop_instance"]
    frame = record.source.rpartition("#")[2]
    if "#" in record.source and frame.isdecimal():
        image.ReferencedFrameNumber = frame
    return image


def _uid(text: str) -> str:
    """A UID (2.25, from a hash) that the same text gives again."""
    return f"2.25.{int.from_bytes(hashlib.sha256(text.encode()).digest()[:_UID_BYTES], 'big')}"
