"""When a slice was taken, from DICOM's six ways of saying it, as seconds in which a series increases.

The first of these that every slice of a series has, and that is not the same in all of them, is its clock:

1. Frame Acquisition Date Time (enhanced files), else Acquisition Date Time, else Acquisition Date + Time;
2. Frame Reference Date Time, else Content Date + Time;
3. Trigger Time.

Frame Time and Frame Time Vector advance 1 and 2 from frame to frame of a classic multi-frame file.
``time_s`` counts from the midnight before the series' first day, so no date gets out; only differences mean anything.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from functools import lru_cache

from ctreg_cli.io.dicom_header import Elements, HeaderProblem
from ctreg_cli.io.image_record import Instant

DAY_S = 86_400.0
#: a series without dates that spans more than this has passed midnight
MAX_SERIES_SPAN_S = DAY_S / 2

# HHMMSS.FFFFFF, right end optional; the colons are ACR-NEMA's
_TIME = re.compile(r"(\d\d)(?::?(\d\d)(?::?(\d\d(?:\.\d{0,6})?))?)?", re.ASCII)
_DATE = re.compile(r"(\d{4})\.?(\d\d)\.?(\d\d)", re.ASCII)
# YYYYMMDDHHMMSS.FFFFFF&ZZXX; a time needs at least the hour
_DATE_TIME = re.compile(r"(\d{8})(\d\d(?:\d\d(?:\d\d(?:\.\d{0,6})?)?)?)(?:[+-]\d{4})?", re.ASCII)


def read_clock(elements: Elements, frame: Elements | None = None) -> tuple[Instant | None, ...]:
    """What the file says of the slice's time: (acquired, content, trigger); what cannot be read counts as absent."""
    acquired = parse_date_time(elements.text("AcquisitionDateTime")) or parse_instant(
        elements.text("AcquisitionDate"), elements.text("AcquisitionTime")
    )
    content = parse_instant(elements.text("ContentDate"), elements.text("ContentTime"))
    if frame is not None:
        acquired = parse_date_time(frame.text("FrameAcquisitionDateTime")) or acquired
        content = parse_date_time(frame.text("FrameReferenceDateTime")) or content
    trigger_ms = _milliseconds(elements, "TriggerTime")
    trigger = Instant(None, trigger_ms[0] / 1000) if trigger_ms else None
    return acquired, content, trigger


def frame_delays_s(elements: Elements, n_frames: int) -> list[float] | None:
    """When each frame of a classic multi-frame file follows the first, s; None where the file does not say."""
    steps = _milliseconds(elements, "FrameTimeVector")
    if steps is not None and len(steps) == n_frames:
        return [math.fsum(steps[: k + 1]) / 1000 for k in range(n_frames)]
    step = _milliseconds(elements, "FrameTime")
    return [k * step[0] / 1000 for k in range(n_frames)] if step else None


def delayed(clock: tuple[Instant | None, ...], delay_s: float) -> tuple[Instant | None, ...]:
    """The clock of a later frame."""
    if not any(clock):
        return (Instant(None, delay_s),)
    return tuple(instant and Instant(instant.day, instant.second + delay_s) for instant in clock)


def parse_instant(date_text: str, time_text: str) -> Instant | None:
    """A DICOM date (DA, may be empty) and time (TM); None where the time is absent or no time of day."""
    match = _TIME.fullmatch(time_text)
    if match is None:
        return None
    hour, minute, second = (float(part or 0) for part in match.groups())
    if hour > 23 or minute > 59 or second >= 61:  # a leap second is one
        return None
    return Instant(_day(date_text), hour * 3600 + minute * 60 + second)


def parse_date_time(text: str) -> Instant | None:
    """A DICOM date time (DT) that goes down to the hour at least; its offset from UTC is left aside."""
    match = _DATE_TIME.fullmatch(text)
    return parse_instant(match[1], match[2]) if match else None


@dataclass(frozen=True, slots=True, kw_only=True)
class Timeline:
    """The times of a series, one a slice (s; None where unknown)."""

    times_s: list[float | None]
    #: every slice that counts has one: they may order the series
    complete: bool


def timeline(clocks: Sequence[tuple[Instant | None, ...]], counts: Sequence[bool]) -> Timeline:
    """Choose the clock of a series (see above) and count its seconds; midnight is passed, not jumped back over.

    Args:
        clocks: what each slice says of its time.
        counts: which slices decide on the choice (the readable ones).
    """
    n_ways = max((len(clock) for clock in clocks), default=0)
    ways = [[clock[k] if k < len(clock) else None for clock in clocks] for k in range(n_ways)]
    seen = [[instant for instant, decides in zip(way, counts, strict=True) if decides] for way in ways]
    complete = [k for k in range(n_ways) if seen[k] and None not in seen[k]]
    telling = [k for k in complete if len(set(seen[k])) > 1]
    fullest = sorted(range(n_ways), key=lambda k: seen[k].count(None))
    best = ways[(telling or complete or fullest)[0]] if n_ways else [None] * len(clocks)
    return Timeline(times_s=_seconds(best), complete=bool(complete))


def _seconds(instants: Sequence[Instant | None]) -> list[float | None]:
    known = [instant for instant in instants if instant is not None]
    days = {instant.day for instant in known}
    # a date that some slices lack can place none of them
    first_day = min((day for day in days if day is not None), default=0) if None not in days else None
    times = [
        None
        if instant is None
        else instant.second + (0.0 if first_day is None or instant.day is None else DAY_S * (instant.day - first_day))
        for instant in instants
    ]
    present = [time for time in times if time is not None]
    if (first_day is None or len(days) == 1) and present and max(present) - min(present) > MAX_SERIES_SPAN_S:
        return [time if time is None or time >= DAY_S / 2 else time + DAY_S for time in times]
    return times


@lru_cache(maxsize=64)
def _day(text: str) -> int | None:
    match = _DATE.fullmatch(text)
    if match is None:
        return None
    try:
        return date(*map(int, match.groups())).toordinal()
    except ValueError:
        return None


def _milliseconds(elements: Elements, keyword: str) -> tuple[float, ...] | None:
    try:
        return elements.decimals(keyword)
    except HeaderProblem:
        return None
