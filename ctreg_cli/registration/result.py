"""What a registration says: one pose with its evidence, or honestly none."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from ctreg_cli.arrays import FloatArray, IntArray
from ctreg_cli.scale import Scale

Status = Literal["ok", "ambiguous", "no_pose"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Candidate:
    """A pose that explains spots of one slice; ``k`` matches, all arrays in the same order."""

    #: (4, 4) model → slice, mm
    T_slice_model: FloatArray
    #: (6, 6) covariance of the pose error as a twist ``[V; Ω]``, mm and rad
    covariance: FloatArray
    #: (k,) index of the rod in the model, and of the spot in the slice, of each match
    rod_index: IntArray
    spot_index: IntArray
    #: (k, 2) measured minus predicted, px
    residual_px: FloatArray
    #: (k,) where along the rod the slice cuts it, mm
    lambda_mm: FloatArray
    #: (r,) rods the pose says should be seen, and no spot was matched to
    missing_rods: IntArray
    #: (r, 2) where those rods should be seen, px
    missing_px: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    #: root mean square of ``residual_px`` over both coordinates and all matches, px; NaN where there is no match
    rms_px: float
    #: χ² of the residuals (spot covariance and frame tolerance) and its degrees of freedom
    chi2: float
    degrees_of_freedom: int
    #: natural logarithm of the odds of this match against chance (see :mod:`ctreg_cli.registration.evidence`)
    log_odds: float
    #: factor by which standard deviations were widened because the spots were worse than believed; 1 when they were not
    inflation: float = 1.0
    #: False where no covariance describes what is known (see :mod:`ctreg_cli.registration.linearity`)
    linear: bool = True
    iterations: int = 0
    #: (p,) protection level at each target, or at the frame's centre where it has none, mm; empty when not worked out
    #: (see :mod:`ctreg_cli.registration.integrity`)
    protection_mm: FloatArray = field(default_factory=lambda: np.empty(0))
    #: the scale estimated along with the pose, and (2, 2) its covariance; None where it was known
    scale: Scale | None = None
    scale_covariance: FloatArray | None = None

    def spot_of_rod(self, n_rods: int) -> IntArray:
        """(n_rods,) the spot of each rod of the model, −1 for none."""
        spots = np.full(n_rods, -1, dtype=np.intp)
        spots[self.rod_index] = self.spot_index
        return spots


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Registration:
    """The verdict on one slice.

    ``ok``: one pose explains the spots and passed every check. ``ambiguous``: another pose does so too
    (``candidates[0]`` is the best). ``no_pose``: ``reason`` says why in one word_with_underscores.
    """

    status: Status
    #: empty when ``ok``
    reason: str
    #: best first; one when ``ok``, two or more when ``ambiguous``; with ``no_pose`` none
    candidates: tuple[Candidate, ...] = ()
    n_spots: int = 0
    #: short words_with_underscores, each with an explanation: (``weak_geometry``, "tilt about x is known to 9° only")
    warnings: tuple[tuple[str, str], ...] = ()

    @property
    def best(self) -> Candidate | None:
        """The pose to use, if any; check ``status`` before a robot moves."""
        return self.candidates[0] if self.candidates else None
