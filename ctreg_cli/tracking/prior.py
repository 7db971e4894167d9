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

from ctreg_cli.arrays import BoolArray, FloatArray
from ctreg_cli.geometry import pose as poses
from ctreg_cli.registration.evidence import PosePrior, log_odds
from ctreg_cli.registration.matching import Matches, Scene, distinct, join, observations, weigh
from ctreg_cli.registration.refine import Linearisation, Observations, covariance_from_information, linearise
from ctreg_cli.registration.twins import Twin
from ctreg_cli.rods import RodModel
from ctreg_cli.tracking.single import carried, difference, mahalanobis2, shifted

#: probability that the frame is moved by hand from one slice to the next, or within a second; the most it may become
JUMP_A_SLICE, JUMP_A_SECOND, MOST_JUMP = 0.01, 0.005, 0.5
#: share of the jumps that put a frame which looks much alike the other way round back to where it was, that way round
_OTHER_WAY = 0.05
#: side of the field a frame may lie in, in its own sizes
_FIELD_SIZES = 3.0
#: a jump to where a match puts the frame is out of the question when it lies this far (ln) under the best match
_OUT_OF_THE_QUESTION = 10.0
#: a minimum farther (sd²) from there than this is perhaps not the only one
_ANOTHER_MINIMUM_D2 = 30.0
#: so many spots determine a pose
_LEAST_DETERMINED = 3
#: steps to the pose most probable with the past, when they are enough, and what the last must be less than, sd²
_MAP_STEPS, _MAP_DONE2, _MAP_FOUND2 = 8, 1e-5, 1e-2


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
    #: poses (4, 4), each with a (6, 6) covariance, of the frame put back the other way round
    other_ways: tuple[tuple[FloatArray, FloatArray], ...] = ()

    @classmethod
    def of(cls, model: RodModel, scene: Scene, prediction: Predicted, twins: tuple[Twin, ...] = ()) -> PastPrior:
        """The prior that a prediction makes; ``twins`` of the frame."""
        p_jump = min(JUMP_A_SLICE * prediction.n_slices + JUMP_A_SECOND * prediction.dt_s, MOST_JUMP)
        return cls(
            T=prediction.T,
            covariance=prediction.covariance,
            p_jump=p_jump,
            anywhere=scene.prior,
            volume_mm3=2 * _FIELD_SIZES**2 * model.size_mm**3,
            other_ways=tuple(_turned_over(prediction, twin) for twin in twins),
        )

    def log_density(self, T: FloatArray, covariance: FloatArray) -> float:
        """ln π, per mm³ rad³, of a pose (4, 4) measured with ``covariance`` (6, 6), which it is averaged over."""
        near = math.log1p(-self.p_jump) + _log_normal(difference(T, self.T), self.covariance + covariance)
        return float(np.logaddexp(near, self.log_jumped(T, covariance)))

    def log_jumped(self, T: FloatArray, covariance: FloatArray) -> float:
        """ln of the part of π, per mm³ rad³, that is left to a pose (4, 4) after a jump."""
        anywhere = float(self.anywhere.log_density(T[None, :3, :3])[0]) - math.log(self.volume_mm3)
        if not self.other_ways:
            return math.log(self.p_jump) + anywhere
        share = math.log(_OTHER_WAY / len(self.other_ways))
        ways = [share + _log_normal(poses.difference(T, T0), P + covariance) for T0, P in self.other_ways]
        return math.log(self.p_jump) + float(np.logaddexp.reduce([math.log1p(-_OTHER_WAY) + anywhere, *ways]))

    def applied(self, model: RodModel, scene: Scene, matches: Matches) -> Weighed:
        """Matches weighed anew with this prior, best first, and where the frame then is if each of them is true."""
        seen = observations(scene, matches.spot_of_rod)
        nearby = most_probable(model, seen, self.T, self.covariance)
        leads, distance2 = _leads_there(matches, nearby)
        # the same matches may have another minimum, where the past is
        other = leads & nearby.found & (distance2 > _ANOTHER_MINIMUM_D2)
        more = weigh(model, scene, nearby.T[other], matches.spot_of_rod[other], _LEAST_DETERMINED)
        if more is not None:
            matches = distinct(model, join([matches, more]), within=np.inf, most=2 * len(matches))
            seen = observations(scene, matches.spot_of_rod)
            nearby = most_probable(model, seen, self.T, self.covariance)
            leads, _ = _leads_there(matches, nearby)
        if not leads.all():
            # past and spots may leave several poses to the same matches: another minimum is asked for its own
            start = np.where(leads[:, None, None], self.T, matches.T)
            nearby = most_probable(model, seen, self.T, self.covariance, start=start)
        H, _ = matches.fit.normal_equations()
        C, _ = covariance_from_information(H, model.size_mm)
        density = np.array([self.log_density(T, c) for T, c in zip(matches.T, C, strict=True)])
        odds = _odds(model, scene, matches, matches.T, matches.fit, density)
        jumped = odds - density + np.array([self.log_jumped(T, c) for T, c in zip(matches.T, C, strict=True)])
        # where a valley bends, the spots' own pose and an ellipsoid about it say little of what lies where the past is
        odds_nearby = _odds(model, scene, matches, nearby.T, nearby.fit, self._log_density_nearby(nearby))
        odds = np.where(leads & nearby.found, np.maximum(odds, odds_nearby), odds)
        # where a jump is not out of the question, only what the spots say counts
        near = nearby.found & (jumped < odds.max() - _OUT_OF_THE_QUESTION)
        order = np.argsort(-odds, kind="stable")
        weighed = Matches(
            T=matches.T, spot_of_rod=matches.spot_of_rod, log_odds=odds, fit=matches.fit, expected=matches.expected
        )
        return Weighed(
            matches=weighed.subset(order),
            covariance=C[order],
            near=near[order],
            T_if_true=np.where(near[:, None, None], nearby.T, matches.T)[order],
            covariance_if_true=np.where(near[:, None, None], nearby.covariance, C)[order],
        )

    def _log_density_nearby(self, nearby: MostProbable) -> FloatArray:
        """(b,) ln of the part of π where the past is, averaged over what the spots leave open there."""
        apart = poses.difference(nearby.T, self.T)
        distance2 = np.einsum("bi,ij,bj->b", apart, np.linalg.inv(self.covariance), apart)
        _, by_spots = np.linalg.slogdet(nearby.fit.normal_equations()[0])
        _, by_both = np.linalg.slogdet(nearby.covariance)
        _, by_past = np.linalg.slogdet(self.covariance)
        density: FloatArray = math.log1p(-self.p_jump) - 0.5 * (distance2 + by_past - by_both - by_spots)
        return density - 3 * math.log(2 * math.pi)


def _turned_over(prediction: Predicted, twin: Twin) -> tuple[FloatArray, FloatArray]:
    """The predicted pose (4, 4) of the frame with the motion of a twin done to it, and its (6, 6) covariance."""
    G = shifted(prediction.T[:3, :3] @ twin.transform[:3, 3])
    return prediction.T @ twin.transform, carried(G, prediction.covariance)


def _log_normal(x: FloatArray, S: FloatArray) -> float:
    """ln of the normal density of x (6,) with mean zero and covariance S (6, 6)."""
    return -0.5 * sum(mahalanobis2(x, S)) - 3 * math.log(2 * math.pi)


def _leads_there(matches: Matches, nearby: MostProbable) -> tuple[BoolArray, FloatArray]:
    """(b,) of the minima that the same matches have, the one nearest to what is most probable with the past.

    And how far each is from there (b,), in sd² of the spots.
    """
    apart = np.stack([difference(T, there) for T, there in zip(matches.T, nearby.T, strict=True)])
    distance2 = np.einsum("bi,bij,bj->b", apart, nearby.fit.normal_equations()[0], apart)
    first: dict[bytes, int] = {}
    for row in np.argsort(distance2, kind="stable"):
        first.setdefault(matches.spot_of_rod[row].tobytes(), int(row))
    leads = np.zeros(len(matches), dtype=bool)
    leads[list(first.values())] = True
    return leads, distance2


def _odds(
    model: RodModel, scene: Scene, matches: Matches, T: FloatArray, fit: Linearisation, log_prior_density: FloatArray
) -> FloatArray:
    """:func:`~ctreg_cli.registration.evidence.log_odds` of matches at poses ``T`` with the past's density there."""
    return log_odds(
        model,
        scene.prior,
        scene.xy_mm,
        T,
        fit,
        matches.spot_of_rod >= 0,
        matches.expected,
        log_prior_density=log_prior_density,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Weighed:
    """``b`` matches, best first, and where the frame is if each of them is the true one."""

    matches: Matches
    #: (b, 6, 6) of the poses that the spots alone speak for
    covariance: FloatArray
    #: (b,) whether a jump is out of the question
    near: BoolArray
    #: (b, 4, 4) the most probable pose with the past taken in, and (b, 6, 6) its covariance; that of the spots alone
    #: where there is no past, or the frame may have jumped
    T_if_true: FloatArray
    covariance_if_true: FloatArray

    @classmethod
    def alone(cls, model: RodModel, matches: Matches) -> Weighed:
        """Matches that no past says anything of."""
        C, _ = covariance_from_information(matches.fit.normal_equations()[0], model.size_mm)
        nowhere = np.zeros(len(matches), dtype=bool)
        return cls(matches=matches, covariance=C, near=nowhere, T_if_true=matches.T, covariance_if_true=C)

    def distance2(self, T: FloatArray, covariance: FloatArray) -> FloatArray:
        """(b,) how far a pose (4, 4) would be wrong, in sd² of its ``covariance`` (6, 6), if each match were true."""
        apart = poses.difference(self.T_if_true, T)
        return np.asarray(np.einsum("bi,ij,bj->b", apart, np.linalg.pinv(covariance, hermitian=True), apart))

    def subset(self, rows: BoolArray) -> Weighed:
        """These matches only."""
        return Weighed(
            matches=self.matches.subset(rows),
            covariance=self.covariance[rows],
            near=self.near[rows],
            T_if_true=self.T_if_true[rows],
            covariance_if_true=self.covariance_if_true[rows],
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MostProbable:
    """``b`` matches' most probable poses with the past taken in."""

    #: (b, 4, 4), and (b, 6, 6) their covariances
    T: FloatArray
    covariance: FloatArray
    #: the spots there
    fit: Linearisation
    #: (b,) whether there is such a pose near where it was looked for
    found: BoolArray


def most_probable(
    model: RodModel,
    seen: Observations,
    T_predicted: FloatArray,
    predicted_covariance: FloatArray,
    *,
    start: FloatArray | None = None,
) -> MostProbable:
    """The poses most probable with the past taken in, by Gauss–Newton from where it expects the frame.

    Args:
        model: the rods.
        seen: ``b`` hypotheses.
        T_predicted: (4, 4) where the past expects the frame.
        predicted_covariance: (6, 6) of it.
        start: (b, 4, 4) where to look for them instead.
    """
    b = len(seen.matched)
    P_inverse = np.linalg.inv(predicted_covariance)
    T = np.repeat(T_predicted[None], b, axis=0) if start is None else start
    fit = linearise(model, T, seen)
    size2 = np.full(b, np.inf)
    C = np.empty((b, 6, 6))
    for _ in range(_MAP_STEPS):
        H, g = fit.normal_equations()
        C = np.linalg.inv(H + P_inverse)
        step = (C @ (g - poses.difference(T, T_predicted) @ P_inverse)[..., None])[..., 0]
        size2 = np.einsum("bi,bij,bj->b", step, H + P_inverse, step)
        T = poses.update(T, step)
        fit = linearise(model, T, seen)
        if size2.max() < _MAP_DONE2:
            break
    return MostProbable(T=T, covariance=C, fit=fit, found=(size2 < _MAP_FOUND2) & np.isfinite(fit.chi2))
