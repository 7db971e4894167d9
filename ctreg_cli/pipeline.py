"""Slices in, results out: the method on one page.

Everything is a generator, so that a progress bar, a robot and a file can each take a result as soon as it is there.
"""

from __future__ import annotations

from dataclasses import dataclass

from ctreg_cli.arrays import FloatArray
from ctreg_cli.imaging.slice import Slice, SliceInfo, UnreadableSlice
from ctreg_cli.imaging.spots import Spots
from ctreg_cli.registration.result import Candidate, Status


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SpotSlice:
    """The spots of one slice with what is known of the slice: what a spots file holds, and what segmentation makes.

    ``problem`` is set (and ``spots`` empty) where the slice could not be read.
    """

    info: SliceInfo
    spots: Spots
    problem: str = ""
    #: the slice's number where a spots file gave one (it may have gaps); None: its place in the sequence
    index: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TargetAccuracy:
    """A target of the frame: where it is, and how well that is known."""

    id: str
    #: (3,) mm
    position_slice: FloatArray
    position_patient: FloatArray | None
    #: predicted root-mean-square error of the position, mm
    tre_mm: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameResult:
    """One row of the output: slice ``index`` (zero-based, the join key) and what was found in it."""

    index: int
    info: SliceInfo
    spots: Spots
    status: Status
    reason: str
    #: ``registered`` | ``updated`` | ``constant`` | ``reacquired``; empty without a pose
    method: str
    candidates: tuple[Candidate, ...] = ()
    targets: tuple[TargetAccuracy, ...] = ()
    warnings: tuple[tuple[str, str], ...] = ()
    #: smallest eigenvalue of the symmetric part of Ĵ⁺J (tracking only): the servo is stable while it is positive
    stability: float | None = None

    @property
    def best(self) -> Candidate | None:
        """The pose to use, if any; only ``status == "ok"`` may move a robot."""
        return self.candidates[0] if self.candidates else None


SliceLike = Slice | SpotSlice | UnreadableSlice
