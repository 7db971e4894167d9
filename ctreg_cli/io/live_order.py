"""Slices that come one by one: the series and the time of each, as far as its own header and those before it tell."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from ctreg_cli.io.dicom_time import timeline
from ctreg_cli.io.image_files import NaturalKey, natural_key
from ctreg_cli.io.image_record import ImageRecord, Instant, SeriesKey


@dataclass(slots=True)
class LiveOrder:
    """Gives arriving slices their series and time, the same way a folder read as a whole gets them.

    Times count from the midnight before the first slice of the series, so that no date gets out.
    """

    _first: dict[SeriesKey, tuple[Instant | None, ...]] = field(default_factory=dict)
    _number: dict[SeriesKey, str] = field(default_factory=dict)

    def place(self, record: ImageRecord) -> ImageRecord:
        """The record with its series and time."""
        number = self._number.setdefault(record.series, str(len(self._number) + 1))
        first = self._first.setdefault(record.series, record.clock)
        if not any(first):
            self._first[record.series] = first = record.clock
        time_s = timeline([first, record.clock], [True, True]).times_s[1]
        return dataclasses.replace(record, info=dataclasses.replace(record.info, time_s=time_s, series=number))


def arrival_order(records: Sequence[ImageRecord]) -> list[ImageRecord]:
    """Records that came at once, series by series, by time, Instance Number and name, those without one last."""

    def key(record: ImageRecord) -> tuple[str, float, float, NaturalKey, int]:
        info = record.info
        return (
            info.series,
            math.inf if info.time_s is None else info.time_s,
            math.inf if record.instance is None else record.instance,
            natural_key(info.source),
            record.frame,
        )

    return sorted(records, key=key)
