"""The past as a prior on the pose: where the motion predicts the frame, or, seldom, anywhere.

``π(θ) = (1 − h) N(θ; predicted, P) + h U(θ)``: with a small probability h, growing with the time that has gone by
unseen, the frame was moved by hand and may be at any pose U the registration alone would have believed in. So a rival
pose is excluded by the past only while the past is certain, and a frame that did jump is still found where it is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ctreg_cli.arrays import FloatArray
from ctreg_cli.geometry import pose as poses
from ctreg_cli.registration.evidence import PosePrior, log_odds
from ctreg_cli.registration.matching import Matches, Scene
from ctreg_cli.registration.refine import covariance_from_information
from ctreg_cli.rods import RodModel

#: probability that the frame is moved by hand from one slice to the next, or within a second; the most it may become
JUMP_A_SLICE, JUMP_A_SECOND, MOST_JUMP = 0.01, 0.005, 0.5
#: side of the field a frame may lie in, in its own sizes
_FIELD_SIZES = 3.0


class Predicted(Protocol):
    """What of a prediction is needed here."""

    @property
    def T(self) -> FloatArray: ...
    @property
    def covariance(self) -> FloatArray: ...
    @property
    def dt_s(self) -> float: ...
    @property
    def n_slices(self) -> int: ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PastPrior:
    """Density of the pose before looking at the slice."""

    #: (4, 4) predicted pose, and its (6, 6) covariance
    T: FloatArray
    covariance: FloatArray
    #: h
    p_jump: float
    #: what a registration alone would have gone by
    anywhere: PosePrior
    #: mm³
    volume_mm3: float

    @classmethod
    def of(cls, model: RodModel, scene: Scene, prediction: Predicted) -> PastPrior:
        """The prior that a prediction makes."""
        p_jump = min(JUMP_A_SLICE * prediction.n_slices + JUMP_A_SECOND * prediction.dt_s, MOST_JUMP)
        return cls(
            T=prediction.T,
            covariance=prediction.covariance,
            p_jump=p_jump,
            anywhere=scene.prior,
            volume_mm3=2 * _FIELD_SIZES**2 * model.size_mm**3,
        )

    def log_density(self, T: FloatArray, covariance: FloatArray) -> float:
        """ln π, per mm³ rad³, of a pose (4, 4) measured with ``covariance`` (6, 6), which it is averaged over."""
        innovation = poses.difference(T, self.T)
        S = self.covariance + covariance
        _, logdet = np.linalg.slogdet(S)
        near = -0.5 * (float(innovation @ np.linalg.solve(S, innovation)) + logdet) - 3 * math.log(2 * math.pi)
        far = float(self.anywhere.log_density(T[None, :3, :3])[0]) - math.log(self.volume_mm3)
        return float(np.logaddexp(math.log1p(-self.p_jump) + near, math.log(self.p_jump) + far))

    def applied(self, model: RodModel, scene: Scene, matches: Matches) -> Matches:
        """Matches weighed anew with this prior, best first."""
        H, _ = matches.fit.normal_equations()
        C, _ = covariance_from_information(H, model.size_mm)
        density = np.array([self.log_density(T, c) for T, c in zip(matches.T, C, strict=True)])
        odds = log_odds(
            model,
            scene.prior,
            scene.xy_mm,
            matches.T,
            matches.fit,
            matches.spot_of_rod >= 0,
            matches.expected,
            log_prior_density=density,
        )
        weighed = Matches(
            T=matches.T, spot_of_rod=matches.spot_of_rod, log_odds=odds, fit=matches.fit, expected=matches.expected
        )
        return weighed.subset(np.argsort(-odds, kind="stable"))
