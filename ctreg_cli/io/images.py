"""Images of any kind the user names, as one ordered set of slices.

What is taken:

* Files named one by one are all taken, whatever series they are of. Of a folder (searched recursively), the one series
  that fits is: CT or MR slices with more than one readable image; failing that, with one; failing that, of another
  modality; failing that, localizers and secondary captures. If several fit, the user must say which (``--series N``).
* PNG files are one series. In a folder they stand back (with a warning) for a fitting DICOM series of more images.
* Files that are no images (text, reports, structure sets, DICOMDIR) are skipped and counted. A file that should be an
  image and cannot be read stays in its place as an :class:`UnreadableSlice`; one whose header is lost comes last.

The order within a series: by time if every slice has one, then by Instance Number if every slice has one, then by
natural file name and frame. Nothing but headers is read until a slice is asked for, and no pixel is kept.
"""

from __future__ import annotations

import dataclasses
import math
import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from ctreg_cli.arrays import FloatArray
from ctreg_cli.errors import InputError, UnreadableSliceError
from ctreg_cli.imaging.slice import Slice, SliceInfo, UnreadableSlice
from ctreg_cli.io.image_record import ImageRecord, Kind, SeriesKey
from ctreg_cli.io.png import is_png, read_png

_HEAD_BYTES = 256
#: a series in which the distance of neighbours exceeds its median by this factor has a gap
_GAP_FACTOR = 1.5
#: positions nearer than this are the same, mm
_SAME_POSITION_MM = 1e-3
#: orientations further apart than this are two, rad
_SAME_ORIENTATION_RAD = 1e-3
_SHOWN_TILT_DEG = 0.1
_MAX_SERIES_NAMED = 20
_T = TypeVar("_T")
NaturalKey = tuple[tuple[int, int, str], ...]

NOT_AN_IMAGE = "not an image"
NO_PIXELS = "DICOM without an image"
OTHER_SERIES = "image of another series"
PNG_BESIDE_DICOM = "PNG beside DICOM"
NOT_A_FILE = "not a regular file"
CLOSED_FOLDER = "folder that cannot be opened"


@dataclass(frozen=True, slots=True, kw_only=True)
class SeriesInfo:
    """What ``ctreg info`` tells of a series: numbers and codes of the standard only, never text from the files."""

    #: what ``--series`` takes, from 1
    index: int
    #: CT, MR, PNG, ...; empty where the file has none or an unknown one
    modality: str
    #: ``slice``, ``localizer`` or ``capture``
    kind: str
    n_slices: int
    n_unreadable: int
    #: (rows, columns), if all slices agree
    shape: tuple[int, int] | None
    #: (s_x, s_y) mm, if all slices agree
    spacing_mm: tuple[float, float] | None
    thickness_mm: float | None
    #: ``axial``, ``coronal``, ``sagittal`` (with the tilt, if any), ``mixed``, or empty where unknown
    orientation: str
    #: from the first to the last slice along the slice normal, mm
    span_mm: float | None
    #: from the first to the last slice, s
    duration_s: float | None
    #: whether :func:`open_images` takes it
    chosen: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImageSet:
    """Slices in order, read one at a time as they are asked for; may be gone through any number of times."""

    records: tuple[ImageRecord, ...]
    #: why files were left out → how many
    skipped: Mapping[str, int]
    #: one sentence each
    warnings: tuple[str, ...]
    #: all series found, also those not taken
    series: tuple[SeriesInfo, ...]

    def __len__(self) -> int:
        return len(self.records)

    def __iter__(self) -> Iterator[Slice | UnreadableSlice]:
        return (record.load() for record in self.records)


def open_images(paths: Sequence[Path], *, series: int | None = None) -> ImageSet:
    """Find the slices in files and folders; their headers are read now, their pixels when they are asked for.

    Args:
        paths: DICOM files, PNG files, folders of them.
        series: which series to take, as :func:`list_series` numbers them; needed only where several fit.

    Raises:
        InputError: a path does not exist, nothing in it is an image, there is no such series, or several fit.
        UnreadableSliceError: not one of the images can be read.
    """
    found = _find(paths)
    images = _image_set(found, _choose(found, paths, series))
    _refuse_if_none_is_readable(images.records)
    return images


def list_series(paths: Sequence[Path], *, series: int | None = None) -> ImageSet:
    """As :func:`open_images`, but no choice is forced: where several series fit, or none can be read, none is chosen.

    Raises:
        InputError: a path does not exist, nothing in it is an image, or there is no such series.
    """
    found = _find(paths)
    try:
        chosen = _choose(found, paths, series)
    except _SeveralFitError:
        chosen = []
    return _image_set(found, chosen)


def read_slices(*paths: str | os.PathLike[str], series: int | None = None) -> list[Slice]:
    """All slices of files and folders at once, in order.

    Raises:
        InputError: as :func:`open_images`.
        UnreadableSliceError: one of them cannot be read.
    """
    slices = []
    for item in open_images([Path(path) for path in paths], series=series):
        if isinstance(item, UnreadableSlice):
            raise UnreadableSliceError(f"{item.info.source}: {item.problem}")
        slices.append(item)
    return slices


class _SeveralFitError(InputError):
    """Several series fit; the text lists them and names the option that settles it."""


def _image_set(found: _Found, chosen: Sequence[_Series]) -> ImageSet:
    skipped, warnings = Counter(found.skipped), []
    for group in found.groups:
        if group in chosen:
            warnings += _remarks(group, len(found.groups) > 1)
        elif group.key.modality == "PNG" and chosen:
            skipped[PNG_BESIDE_DICOM] += len(group.records)
            warnings.append(f"{_count(len(group.records), 'PNG file')} beside a DICOM series left out")
        else:
            skipped[OTHER_SERIES] += len(group.records)
    records = [record for group in chosen for record in group.records] + found.lost
    if len(chosen) > 1:
        warnings.append(f"the slices come from {len(chosen)} series")
    if found.lost:
        first = found.lost[0]
        warnings.append(
            f"{_count(len(found.lost), 'file')} cannot be read at all; {first.info.source}: {first.problem}"
        )
    return ImageSet(
        records=tuple(records),
        skipped=dict(skipped),
        warnings=(*warnings, *_notes(records)),
        series=tuple(group.describe(group in chosen) for group in found.groups),
    )


def _refuse_if_none_is_readable(records: Sequence[ImageRecord]) -> None:
    # of an image asked for alone the pixels are read too: what only decoding shows is an error at once
    first = records[0].load() if len(records) == 1 or all(record.problem for record in records) else None
    if isinstance(first, UnreadableSlice):
        several = "" if len(records) == 1 else f"none of the {len(records)} images can be read; the first, "
        raise UnreadableSliceError(f"{several}{first.info.source}: {first.problem}")


# ---------------------------------------------------------------------------------------------------- finding


@dataclass(slots=True, kw_only=True, eq=False)
class _Series:
    """The records of one series, in order once :func:`_ordered` has been over them."""

    index: int
    key: SeriesKey
    records: list[ImageRecord]
    #: which of the user's paths it was found in; files named one by one are all -1
    inputs: set[int]
    problems: tuple[str, ...] = ()

    @property
    def n_readable(self) -> int:
        return sum(not record.problem for record in self.records)

    def describe(self, chosen: bool) -> SeriesInfo:
        usable = [record.info for record in self.records if not record.problem]
        times = [info.time_s for info in usable if info.time_s is not None]
        normal, heights = _heights(self.records)
        return SeriesInfo(
            index=self.index,
            modality=self.key.modality,
            kind=self.key.kind.value,
            n_slices=len(self.records),
            n_unreadable=len(self.records) - len(usable),
            shape=_common([info.shape for info in usable]),
            spacing_mm=_common([(s.s_x, s.s_y) if (s := info.scale) else None for info in usable]),
            thickness_mm=_common([info.thickness_mm for info in usable]),
            orientation=_orientation(self.records),
            span_mm=None if normal is None or heights.size < 1 else float(np.ptp(heights)),
            duration_s=max(times) - min(times) if len(times) == len(usable) > 0 else None,
            chosen=chosen,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Found:
    groups: list[_Series]
    #: images whose header broke off before it said which series they are of
    lost: list[ImageRecord]
    skipped: dict[str, int]


def _find(paths: Sequence[Path]) -> _Found:
    """Read the header of every file there is, and sort them into series."""
    if not paths:
        raise InputError("no input given; give CT slices or a folder of them")
    by_key: dict[SeriesKey, _Series] = {}
    lost: list[ImageRecord] = []
    skipped: Counter[str] = Counter()
    for number, path in enumerate(paths):
        for file, source in _files(path, skipped):
            records = _read_file(file, source)
            if isinstance(records, str):
                skipped[records] += 1
                continue
            for record in records:
                if record.series.id is None:
                    lost.append(record)
                    continue
                group = by_key.setdefault(
                    record.series, _Series(index=len(by_key) + 1, key=record.series, records=[], inputs=set())
                )
                group.records.append(record)
                group.inputs.add(number if path.is_dir() else -1)
    for group in by_key.values():
        _order(group)
    if not by_key and not lost:
        seen = ", ".join(f"{count} × {reason}" for reason, count in skipped.items()) or "no files"
        raise InputError(f"{_named(paths)}: no DICOM or PNG image found ({seen}); give CT slices or a folder of them")
    lost.sort(key=lambda record: natural_key(record.info.source))
    return _Found(groups=list(by_key.values()), lost=lost, skipped=dict(skipped))


def natural_key(name: str) -> NaturalKey:
    """A key that sorts ``s2.png`` before ``s10.png``."""
    parts = re.split(r"(\d+)", name)
    return tuple((0, int(part), "") if part.isdecimal() else (1, 0, part.casefold()) for part in parts if part)


def _files(path: Path, skipped: Counter[str]) -> Iterator[tuple[Path, str]]:
    """The file, or the files of the folder in natural order, each with its source name."""

    def cannot_open(error: OSError) -> None:
        if error.filename == str(path):
            raise InputError(f"{_shown(path)}: the folder cannot be opened ({error.strerror})")
        skipped[CLOSED_FOLDER] += 1

    if not path.exists():
        raise InputError(f"{_shown(path)}: no such file or folder")
    if not path.is_dir():
        yield path, _printable(path.name)
        return
    files = [Path(folder) / name for folder, _, names in os.walk(path, onerror=cannot_open) for name in names]
    named = sorted((natural_key(relative), relative, file) for file in files for relative in [_relative(file, path)])
    for _, relative, file in named:
        yield file, relative


def _read_file(path: Path, source: str) -> list[ImageRecord] | str:
    """The records of one file, or why it is skipped."""
    from ctreg_cli.io.dicom import NotAnImage, is_dicom, read_dicom

    if not path.is_file():  # a pipe or a device would be waited for
        return NOT_A_FILE
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except OSError as error:
        info = SliceInfo(source=source)
        unknown = SeriesKey(None, Kind.SLICE, "")
        return [ImageRecord(info=info, series=unknown, problem=f"the file cannot be read ({error.strerror})")]
    if is_png(path, head):
        return [read_png(path, source)]
    if not is_dicom(path, head):
        return NOT_AN_IMAGE
    records = read_dicom(path, source)
    return NO_PIXELS if isinstance(records, NotAnImage) else records


# ---------------------------------------------------------------------------------------------------- ordering


def _order(group: _Series) -> None:
    """Sort a series and settle its times; remembers what stood in the way.

    Only readable slices decide what there is to sort by; a broken one without it goes to the end.
    """
    from ctreg_cli.io.dicom_time import timeline

    records, problems = group.records, []
    readable = [not record.problem for record in records]
    line = timeline([record.clock for record in records], readable)
    instances = [record.instance for record, usable in zip(records, readable, strict=True) if usable]
    numbered = None not in instances
    if not line.complete and any(time is not None for time in line.times_s):
        problems.append("some slices have no time: all are ordered by Instance Number or file name")
    if not line.complete and not numbered and instances.count(None) < len(instances):
        problems.append("some slices have no Instance Number: all are ordered by file name")
    if not line.complete and numbered and len(set(instances)) < len(instances):
        problems.append("several slices have the same Instance Number: those are ordered by file name")

    def key(place: int) -> tuple[float, float, NaturalKey, int]:
        time, instance = line.times_s[place], records[place].instance
        return (
            (math.inf if time is None else time) if line.complete else 0.0,
            (math.inf if instance is None else instance) if numbered else 0.0,
            natural_key(records[place].info.source),
            records[place].frame,
        )

    places = sorted(range(len(records)), key=key)
    times = [line.times_s[place] for place in places]
    known = [time for time in times if time is not None]
    if known != sorted(known):  # times that run back are worse than none
        times = [None] * len(times)
    group.records = [
        dataclasses.replace(
            records[place], info=dataclasses.replace(records[place].info, time_s=time, series=str(group.index))
        )
        for place, time in zip(places, times, strict=True)
    ]
    group.problems = tuple(problems)


# ---------------------------------------------------------------------------------------------------- choosing


def _choose(found: _Found, paths: Sequence[Path], series: int | None) -> list[_Series]:
    groups = found.groups
    if series is not None:
        chosen = [group for group in groups if group.index == series]
        if not chosen:
            raise InputError(f"{_named(paths)}: there is no series {series}; {_listing(groups)}")
        return chosen
    chosen = [group for group in groups if -1 in group.inputs]
    for number, path in enumerate(paths):
        if path.is_dir():
            fitting = _fitting([group for group in groups if number in group.inputs])
            if len(fitting) > 1:
                raise _SeveralFitError(
                    f"{_shown(path)}: {len(fitting)} series fit; choose one with --series N; {_listing(groups)}"
                )
            chosen += [group for group in fitting if group not in chosen]
    return chosen


def _fitting(groups: list[_Series]) -> list[_Series]:
    """The series of the best rank that has any."""
    if not groups:
        return []
    best = min(map(_rank, groups))
    fitting = [group for group in groups if _rank(group) == best]
    dicom = [group.n_readable for group in fitting if group.key.modality != "PNG"]
    return [group for group in fitting if not dicom or group.key.modality != "PNG" or group.n_readable >= max(dicom)]


def _rank(group: _Series) -> int:
    """How well a series fits, 0 best."""
    if group.n_readable == 0:
        return 4
    if group.key.kind is not Kind.SLICE:
        return 3
    if group.key.modality not in ("CT", "MR", "PNG", ""):
        return 2
    return 0 if group.n_readable > 1 else 1


def _listing(groups: Sequence[_Series]) -> str:
    lines = []
    for group in groups[:_MAX_SERIES_NAMED]:
        info = group.describe(False)
        size = f"{info.shape[1]} × {info.shape[0]}" if info.shape else "of different sizes"
        what = f"{info.modality or 'unknown modality'} {info.orientation or info.kind}".strip()
        lines.append(f"{group.index}: {what}, {info.n_slices} slices {size}")
    more = [f"and {len(groups) - len(lines)} more"] if len(groups) > len(lines) else []
    return "series found: " + "; ".join(lines + more) if lines else "no series was found"


# ---------------------------------------------------------------------------------------------------- describing


def _common(values: list[_T | None]) -> _T | None:
    """The value all slices share, if they do."""
    return values[0] if values and all(value == values[0] for value in values) else None


def _heights(records: Sequence[ImageRecord]) -> tuple[FloatArray | None, FloatArray]:
    """The normal (3,) of the first slice that has a place, and the heights (n,) of all that have along it, mm."""
    places = [T for record in records if (T := record.info.T_patient_slice) is not None]
    if not places:
        return None, np.empty(0)
    normal = places[0][:3, 2]
    return normal, np.array([T[:3, 3] for T in places]) @ normal


def _orientation(records: Sequence[ImageRecord]) -> str:
    places = [T for record in records if (T := record.info.T_patient_slice) is not None]
    if not places:
        return ""
    if not _parallel(places):
        return "mixed"
    along = np.abs(places[0][:3, 2])
    plane = ("sagittal", "coronal", "axial")[int(along.argmax())]  # LPS: x to the left, y to the back, z to the head
    tilt_deg = math.degrees(math.acos(min(1.0, along.max())))
    return plane if tilt_deg < _SHOWN_TILT_DEG else f"{plane}, tilted {tilt_deg:.1f}°"


def _parallel(places: Sequence[FloatArray]) -> bool:
    axes = np.array([T[:3, :3] for T in places])
    return bool(np.abs(axes - axes[0]).max() < _SAME_ORIENTATION_RAD)


def _remarks(group: _Series, several: bool) -> list[str]:
    """What the user should know of a series before trusting its order and geometry."""
    readable = [record for record in group.records if not record.problem]
    remarks = list(group.problems)
    if n_bad := len(group.records) - len(readable):
        first = next(record for record in group.records if record.problem)
        remarks.append(f"{n_bad} of {len(group.records)} images cannot be read; {first.info.source}: {first.problem}")
    if group.key.kind is not Kind.SLICE:
        remarks.append(f"this is a {group.key.kind.value}, not a series of slices")
    if group.key.modality != "PNG":
        for attribute, what in (("scale", "Pixel Spacing"), ("T_patient_slice", "patient geometry")):
            if n_without := sum(getattr(record.info, attribute) is None for record in readable):
                remarks.append(f"{n_without} of {len(readable)} slices have no {what}")
    if len({record.info.shape for record in readable}) > 1:
        remarks.append("the slices differ in size")
    if len({record.info.scale for record in readable}) > 1:
        remarks.append("the slices differ in Pixel Spacing")
    places = [T for record in readable if (T := record.info.T_patient_slice) is not None]
    if places and not _parallel(places):
        remarks.append("the slices differ in orientation")
    else:
        remarks += _spacing_remarks(readable)
    return [f"series {group.index}: {remark}" if several else remark for remark in remarks]


def _spacing_remarks(records: Sequence[ImageRecord]) -> list[str]:
    _, heights = _heights(records)
    if heights.size < 2:
        return []
    remarks = []
    order = np.argsort(heights, kind="stable")
    steps = np.diff(heights[order])
    apart = steps[steps > _SAME_POSITION_MM]
    instances = [(uid, record.frame) for record in records if (uid := record.info.uids.get("sop_instance"))]
    if len(set(instances)) < len(instances):
        remarks.append("some images are there twice (same SOP Instance UID)")
    # slices that repeat a place at another time are a sequence in time, as in CT fluoroscopy: no defect
    elif len(set(_moments(records))) < len(records):
        remarks.append("several slices show the same place at the same time")
    if apart.size > 1 and apart.max() > _GAP_FACTOR * np.median(apart):
        remarks.append(f"the series has gaps: neighbours are {np.median(apart):.3g} to {apart.max():.3g} mm apart")
    return remarks


def _moments(records: Sequence[ImageRecord]) -> Iterator[tuple[float | None, bytes]]:
    """Time and place of every slice that has a place."""
    for record in records:
        T = record.info.T_patient_slice
        yield record.info.time_s, b"" if T is None else (T[:3, 3] / _SAME_POSITION_MM).round().tobytes()


def _notes(records: Sequence[ImageRecord]) -> list[str]:
    """One sentence a kind of oddity, however many files have it."""
    first: dict[str, str] = {}
    count: Counter[str] = Counter()
    for record in records:
        for note in record.notes:
            first.setdefault(note, record.info.source)
            count[note] += 1
    return [
        f"{source}: {note}" if count[note] == 1 else f"{count[note]} images, first {source}: {note}"
        for note, source in first.items()
    ]


# ---------------------------------------------------------------------------------------------------- names


def _count(n: int, what: str) -> str:
    return f"{n} {what}" if n == 1 else f"{n} {what}s"


def _relative(file: Path, folder: Path) -> str:
    return _printable(file.relative_to(folder).as_posix())


def _printable(name: str) -> str:
    """A file name that can be written as UTF-8 on one line, whatever bytes it is made of."""
    text = os.fsencode(name).decode("utf-8", "replace")
    return "".join(character if character.isprintable() else "�" for character in text)


def _shown(path: Path) -> str:
    return _printable(str(path))


def _named(paths: Sequence[Path]) -> str:
    shown = [_shown(path) for path in paths[:3]]
    return ", ".join(shown) + (f" and {len(paths) - 3} more" if len(paths) > 3 else "")
