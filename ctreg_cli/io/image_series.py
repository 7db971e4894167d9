"""A series: its images in order, what it is, and what is odd about it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from ctreg_cli.arrays import FloatArray
from ctreg_cli.io.image_files import NaturalKey, natural_key
from ctreg_cli.io.image_record import ImageRecord, Kind, SeriesKey

#: a series in which the distance of neighbours exceeds its median by this factor has a gap
_GAP_FACTOR = 1.5
#: positions nearer than this are the same, mm
_SAME_POSITION_MM = 1e-3
#: orientations further apart than this are two, rad
_SAME_ORIENTATION_RAD = 1e-3
_SHOWN_TILT_DEG = 0.1
_T = TypeVar("_T")


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


@dataclass(slots=True, kw_only=True, eq=False)
class Series:
    """The records of one series, in order once :func:`order` has been over them."""

    index: int
    key: SeriesKey
    records: list[ImageRecord]
    #: which of the user's paths it was found in; files named one by one are all -1
    inputs: set[int]
    problems: tuple[str, ...] = ()

    @property
    def n_readable(self) -> int:
        """How many images have no problem known."""
        return sum(not record.problem for record in self.records)

    def describe(self, chosen: bool) -> SeriesInfo:
        """What may be told of it."""
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


def order(group: Series) -> None:
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


def remarks_on(group: Series, several: bool) -> list[str]:
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
    steps = np.diff(np.sort(heights))
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
