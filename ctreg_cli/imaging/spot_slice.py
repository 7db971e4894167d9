"""The spots of a slice with what is known of the slice: what a spots file holds, and what segmentation makes."""

from __future__ import annotations

from dataclasses import dataclass

from ctreg_cli.imaging.slice import SliceInfo
from ctreg_cli.imaging.spots import Spots


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SpotSlice:
    """One slice after segmentation; ``problem`` is set (and ``spots`` empty) where it could not be read."""

    info: SliceInfo
    spots: Spots
    problem: str = ""
    #: the slice's number where a spots file gave one (it may have gaps); None: its place in the sequence
    index: int | None = None
