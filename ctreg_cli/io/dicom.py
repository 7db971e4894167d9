"""One DICOM file → one record a frame, or one that says why it cannot be used.

Read are CT and other grey images of integers: single-frame, classic multi-frame and enhanced (functional groups), with
or without preamble and file meta, in any transfer syntax pydicom decodes. The geometry is checked, not believed.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from sys import intern

from pydicom.uid import UID

from ctreg_cli.arrays import FloatArray
from ctreg_cli.imaging.slice import SliceInfo
from ctreg_cli.io.dicom_geometry import read_patient_from_slice, read_scale, read_thickness
from ctreg_cli.io.dicom_header import (
    Elements,
    Header,
    HeaderProblem,
    looks_like_dicom,
    once_a_series,
    open_binary,
    plain_header,
    problem,
    read_header,
    tag_name,
)
from ctreg_cli.io.dicom_layout import Layout, read_layout, read_padding, read_rescale
from ctreg_cli.io.dicom_pixels import excess_bytes, is_lossy, locate, pixel_element
from ctreg_cli.io.dicom_time import delayed, frame_delays_s, read_clock
from ctreg_cli.io.image_record import ImageRecord, Instant, Kind, Pixels, SeriesKey

DICOM_SUFFIXES = frozenset({".dcm", ".dicom", ".dic", ".ima"})

# codes of PS3.3 C.7.3.1.1.1 that a series of images may carry; anything else in Modality is not shown
_MODALITIES = frozenset(
    ("CT", "MR", "PT", "NM", "XA", "RF", "CR", "DX", "DR", "MG", "US", "OT", "SC", "SEG", "RTDOSE", "RTIMAGE", "OPT")
)
_LOCALIZER_WORDS = frozenset({"LOCALIZER", "SCOUT", "TOPOGRAM", "SURVIEW"})
_CAPTURE_WORDS = frozenset({"SCREEN SAVE", "SCREENSAVE", "PROTOCOL", "DOSE_INFO"})
_CAPTURE_CLASSES = "1.2.840.10008.5.1.4.1.1.7"
_DIRECTORY_CLASS = "1.2.840.10008.1.3.10"
_SERIES_UIDS = {
    "sop_class": "SOPClassUID",
    "series_instance": "SeriesInstanceUID",
    "study_instance": "StudyInstanceUID",
    "frame_of_reference": "FrameOfReferenceUID",
}
#: of a file that broke off before it said which series it is of
_LOST = SeriesKey(None, Kind.SLICE, "")


@dataclass(frozen=True, slots=True, kw_only=True)
class NotAnImage:
    """A sound DICOM file that never meant to be an image: a report, a structure set, a DICOMDIR."""


def is_dicom(path: Path, head: bytes) -> bool:
    """Whether a file is, or says by its name that it is, DICOM; ``head`` are its first 132 bytes or more."""
    return looks_like_dicom(head) or path.suffix.lower() in DICOM_SUFFIXES


def read_dicom(path: Path, source: str, head: bytes = b"", size: int | None = None) -> list[ImageRecord] | NotAnImage:
    """Read the header of one file; pixels are read later, by :meth:`ImageRecord.load`.

    Args:
        path: the file.
        source: its name in results; ``#1``, ``#2``, ... is added in a multi-frame file.
        head: its first :data:`~ctreg_cli.io.dicom_plain.HEAD_BYTES`, where they have been read already: of a plain
            file no more is needed.
        size: of the file, bytes, where it is known already.

    Returns:
        A record a frame, in the file's order. A file that cannot be used is one record with a ``problem``.
    """
    info = SliceInfo(source=source)
    try:
        return _read(path, source, head, path.stat().st_size if size is None else size)
    except HeaderProblem as error:
        return [ImageRecord(info=info, series=_LOST, problem=str(error))]
    except RecursionError:
        return [ImageRecord(info=info, series=_LOST, problem="its sequences are nested too deeply")]
    # The one door for hostile files. Walking through damaged elements, pydicom raises struct.error, EOFError,
    # OSError, ValueError, TypeError, KeyError, AttributeError, NotImplementedError, OverflowError and more.
    except Exception:  # noqa: BLE001
        return [ImageRecord(info=info, series=_LOST, problem="its header is damaged")]


def _read(path: Path, source: str, head: bytes, size: int) -> list[ImageRecord] | NotAnImage:
    if size == 0:
        raise HeaderProblem("the file is empty")
    header = plain_header(head, size) if head else None
    if header is None:
        with open_binary(path) as file:
            header = read_header(file, size, tried_plain=bool(head))
    if _is_not_an_image(header):
        return NotAnImage()
    series = _series_key(path, header.elements)
    try:
        return _records(path, source, header, series)
    except HeaderProblem as error:  # which series it belongs to, and when it was taken, is known all the same
        info = SliceInfo(source=source, uids=_uids(header.elements))
        if "series_instance" not in info.uids:
            series = _LOST
        clock, instance = _place(header.elements)
        return [ImageRecord(info=info, series=series, problem=str(error), clock=clock, instance=instance)]


def _is_not_an_image(header: Header) -> bool:
    sop_class = header.meta.uid("MediaStorageSOPClassUID") or header.elements.uid("SOPClassUID")
    if sop_class == _DIRECTORY_CLASS:
        return True
    has_image = header.pixels is not None or "Rows" in header.elements
    # the name is the standard's; a class it does not know is its own name
    return not has_image and sop_class != "" and "Image Storage" not in UID(sop_class).name


def _series_key(path: Path, elements: Elements) -> SeriesKey:
    kind, modality = _kind_and_modality(elements)
    identity = elements.uid("SeriesInstanceUID") or f"folder {path.parent.as_posix()}"
    return SeriesKey(intern(identity), kind, modality)


@once_a_series("ImageType", "SOPClassUID", "Modality")
def _kind_and_modality(elements: Elements) -> tuple[Kind, str]:
    image_type = set(elements.codes("ImageType"))
    if image_type & _LOCALIZER_WORDS:
        kind = Kind.LOCALIZER
    elif elements.uid("SOPClassUID").startswith(_CAPTURE_CLASSES) or image_type & _CAPTURE_WORDS:
        kind = Kind.CAPTURE
    else:
        kind = Kind.SLICE
    modality = elements.text("Modality").upper()
    return kind, modality if modality in _MODALITIES else ""


def _uids(elements: Elements) -> dict[str, str]:
    uids, own = dict(_series_uids(elements)), elements.uid("SOPInstanceUID")
    return uids | {"sop_instance": own} if own else uids


@once_a_series(*_SERIES_UIDS.values())
def _series_uids(elements: Elements) -> dict[str, str]:
    uids = {name: elements.uid(keyword) for name, keyword in _SERIES_UIDS.items()}
    return {name: uid for name, uid in uids.items() if uid}


def _place(elements: Elements) -> tuple[tuple[Instant | None, ...], int | None]:
    """What says where in its series a slice belongs: time and instance number."""
    try:
        instance = elements.integer("InstanceNumber")
    except HeaderProblem:
        instance = None
    return read_clock(elements), instance


def _records(path: Path, source: str, header: Header, series: SeriesKey) -> list[ImageRecord]:
    elements = header.elements
    pixel_element(header)  # of all that is missing in a file cut short, the pixels say it best
    layout = read_layout(elements)
    whole = SliceInfo(source=source, shape=(layout.rows, layout.columns), uids=_uids(elements))
    padding, notes = read_padding(elements, layout), _notes(header, layout)
    clock, instance = _place(elements)
    pixels = locate(path, header, layout)
    shared = elements.items("SharedFunctionalGroupsSequence")
    own = elements.items("PerFrameFunctionalGroupsSequence")
    is_enhanced = bool(shared or own)
    slope, intercept = (1.0, 0.0) if is_enhanced else read_rescale(elements, layout)
    record = ImageRecord(
        info=whole if is_enhanced else _with_geometry(whole, elements, elements, elements),
        series=series,
        pixels=pixels[0],
        slope=slope,
        intercept=intercept,
        padding=padding,
        clock=clock,
        instance=instance,
        notes=notes,
    )
    if is_enhanced:
        return _enhanced_frames(record, elements, layout, pixels, shared, own)
    return [record] if layout.n_frames == 1 else _classic_frames(record, elements, pixels)


def _with_geometry(info: SliceInfo, measures: Elements, position: Elements, orientation: Elements) -> SliceInfo:
    return SliceInfo(
        source=info.source,
        shape=info.shape,
        uids=info.uids,
        scale=read_scale(measures),
        thickness_mm=read_thickness(measures),
        T_patient_slice=read_patient_from_slice(position, orientation),
    )


def _classic_frames(record: ImageRecord, elements: Elements, pixels: list[Pixels]) -> list[ImageRecord]:
    """Frames of one place after another in time, or of unknown places.

    Without functional groups only time (Frame Time, Frame Time Vector) or depth (Grid Frame Offset Vector) is said of
    a frame. Where neither is, the frames may be anywhere: then none keeps the position that is written for the first.
    """
    n = len(pixels)
    delays_s = frame_delays_s(elements, n)
    depths_mm = elements.decimals("GridFrameOffsetVector")
    frames = []
    for k in range(n):
        T = record.info.T_patient_slice
        if depths_mm is not None and len(depths_mm) == n:
            T = _moved(T, depths_mm[k] - depths_mm[0])
        elif delays_s is None:
            T = None
        frames.append(
            dataclasses.replace(
                record,
                info=dataclasses.replace(record.info, source=f"{record.info.source}#{k + 1}", T_patient_slice=T),
                pixels=pixels[k],
                frame=k + 1,
                clock=delayed(record.clock, delays_s[k]) if delays_s else record.clock,
            )
        )
    return frames


def _moved(T: FloatArray | None, depth_mm: float) -> FloatArray | None:
    if T is None:
        return None
    moved = T.copy()
    moved[:3, 3] += depth_mm * T[:3, 2]
    moved.flags.writeable = False
    return moved


def _enhanced_frames(
    whole: ImageRecord,
    elements: Elements,
    layout: Layout,
    pixels: list[Pixels],
    shared: list[Elements],
    own: list[Elements],
) -> list[ImageRecord]:
    """Frames of an enhanced file: what its own functional groups say, else the shared ones, else the file."""
    if own and len(own) != layout.n_frames:
        raise problem("PerFrameFunctionalGroupsSequence", f"describes {len(own)} of {layout.n_frames} frames")
    shared_macros = _macros(shared[0]) if shared else {}
    nothing = Elements({}, elements.little_endian)
    frames = []
    for k in range(layout.n_frames):
        number = k + 1 if layout.n_frames > 1 else 0
        info = dataclasses.replace(whole.info, source=f"{whole.info.source}#{number}" if number else whole.info.source)
        try:
            macros = shared_macros | (_macros(own[k]) if own else {})
            measures, position, orientation, transform = (macros.get(name, elements) for name in _GEOMETRY_MACROS)
            slope, intercept = read_rescale(transform, layout)
            frame = dataclasses.replace(
                whole,
                info=_with_geometry(info, measures, position, orientation),
                frame=number,
                pixels=pixels[k],
                slope=slope,
                intercept=intercept,
                clock=read_clock(elements, macros.get("FrameContentSequence", nothing)),
            )
        except HeaderProblem as error:
            frame = dataclasses.replace(whole, info=info, frame=number, pixels=None, problem=str(error))
        frames.append(frame)
    return frames


_GEOMETRY_MACROS = (
    "PixelMeasuresSequence",
    "PlanePositionSequence",
    "PlaneOrientationSequence",
    "PixelValueTransformationSequence",
)


def _macros(group: Elements) -> dict[str, Elements]:
    """The functional groups of one item, those that are there."""
    found = {name: group.items(name) for name in (*_GEOMETRY_MACROS, "FrameContentSequence")}
    return {name: items[0] for name, items in found.items() if items}


def _notes(header: Header, layout: Layout) -> tuple[str, ...]:
    notes = list(header.notes)
    if is_lossy(header):
        notes.append("compressed with loss: spots may have moved")
    if layout.inverted:
        notes.append("MONOCHROME1, read with small stored values as bright")
    if excess_bytes(header, layout):
        notes.append(f"bytes beyond the image in {tag_name('PixelData')}, left aside")
    return tuple(notes)
