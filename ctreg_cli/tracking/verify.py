"""Whether a followed frame may be believed at once.

A servo that converged proves nothing yet: a false spot beside a rod, two rods exchanged, a twin minimum or a second
pose of a symmetric frame converge as well. All of these leave traces: a spot that the others do not predict, two spots
that fit one rod, a pose known badly, a prediction too vague to tell two minima apart. Without any trace the pose is
sure; with one it is not refused, but looked into (:mod:`~ctreg_cli.tracking.tracker`).
"""

from __future__ import annotations

import math
from functools import lru_cache
from operator import add
from typing import NamedTuple, TypeVar

import numpy as np
from scipy.special import chdtri

from ctreg_cli.arrays import FloatArray, IntArray, frozen
from ctreg_cli.geometry import pose as poses
from ctreg_cli.imaging.spots import Spots
from ctreg_cli.registration.evidence import P_SEEN
from ctreg_cli.registration.integrity import protected_points
from ctreg_cli.registration.matching import Scene
from ctreg_cli.registration.misfit import RELATIVE_SD, hidden_derivatives
from ctreg_cli.registration.options import RegistrationOptions
from ctreg_cli.registration.register import (
    ACCEPT_LOG_ODDS,
    INFLATE_P,
    NEAR_MISS_P,
    WEAK_CONDITION,
    fit_warnings,
    near_misses_p,
)
from ctreg_cli.registration.result import Candidate, Registration
from ctreg_cli.rods import RodModel
from ctreg_cli.scale import Scale
from ctreg_cli.tracking.gate import Outlook
from ctreg_cli.tracking.other_minimum import TWO_MINIMA_BOUND, has_other_minimum
from ctreg_cli.tracking.posterior import most_probable_pose
from ctreg_cli.tracking.servo import Desired, ServoResult
from ctreg_cli.tracking.single import (
    determinant_2x2,
    difference,
    inverse_2x2,
    largest_eigenvalue,
    levers,
    log_determinant,
    mahalanobis2,
    turned_by,
)

#: matches that leave a redundancy to check by: four spots leave two equations, too few to contradict a false one
CHECKABLE_MATCHES = 5
#: a spot this far (χ² of two degrees of freedom) from where the others predict it is odd: 1 in 500
ODD_D2 = 12.5
#: a second spot within this of where the others predict a rod's could be the rod's
CONTEST_D2 = 25.0
#: expected number of false spots within a rod's gate above which the spot there is not taken for granted
CHANCE_IN_GATE = 0.003
#: a prediction or a pose known worse than this (sd of the worst turn, rad) does not exclude a twin, or is not linear
VAGUE_PREDICTION_RAD, VAGUE_POSE_RAD = math.radians(3.0), math.radians(1.5)
#: how far the pose most probable with the past may lie from the one without (χ² of six degrees of freedom)
_AGREES_D2 = 30.0
#: nearer than this nothing is seen; farther off, the cost must have risen by this share of what the covariance says
_NEAR_D2, _LEAST_RISE = 9.0, 0.5
#: a pose off by more than this, in sd of the spots' information where the past puts the frame, is a surprise
_SURPRISE_SD = 4.0
#: innovations beyond this (χ² of six degrees of freedom: 1 in 30,000) are looked into
_ODD_INNOVATION2 = 30.0
#: crossings closer than this (in rod diameters, or of the frame's size where there are none) may leave one spot
_TOUCHING_DIAMETERS, _TOUCHING_SIZE = 2.0, 0.05
#: a score beyond this (χ² of three degrees of freedom: 3 in 1,000) may be a scale or a height that is off; the looser
#: test of a registration would have one sure slice in a hundred looked into for nothing
MISFIT_SCORE = 13.9
_SCALES_PRIOR = np.eye(3) / RELATIVE_SD**2
#: a spot fixes a direction alone when the others predict it with this share of certainty (of areas) or less
_FIXES_ALONE = 1e-9
#: radius of the frame's neighbourhood, in units of the farthest crossing from their middle; the least, in frame sizes
_NEIGHBOURHOOD, _LEAST_REACH = 1.25, 1e-3
_NONE, _NOWHERE = np.empty(0, dtype=np.intp), frozen(np.empty((0, 2)), (0, 2))
_Array = TypeVar("_Array", FloatArray, IntArray)


def verified(
    outlook: Outlook,
    scale: Scale,
    spots: Spots,
    T_predicted: FloatArray,
    predicted_covariance: FloatArray,
    moved: ServoResult,
    spot_of_rod: IntArray,
    options: RegistrationOptions,
) -> Registration | None:
    """The verdict ``ok`` on a followed frame, or None where something is in doubt.

    Args:
        outlook: what the pose expects of the slice.
        scale: mm per pixel.
        spots: the same spots, px.
        T_predicted: (4, 4) where the past expected the frame.
        predicted_covariance: (6, 6) of it.
        moved: where the servo brought it.
        spot_of_rod: (n,) spot of each rod, −1 for none.
        options: the integrity risk, and the alert limit.
    """
    model, scene = outlook.model, outlook.scene
    seen, T, C = moved.view, moved.T, moved.covariance
    rods = np.nonzero(spot_of_rod >= 0)[0]
    dof = 2 * len(rods) - 6
    chi2 = moved.chi2
    if len(rods) < CHECKABLE_MATCHES or chi2 > _most_chi2(dof) or not _allowed(scene, T):
        return None
    if is_vaguer(C, VAGUE_POSE_RAD) or is_vaguer(predicted_covariance, VAGUE_PREDICTION_RAD):
        return None
    crossings = outlook.crossing
    missing = _NONE if len(rods) == len(model) else np.nonzero(outlook.must_be_seen() & (spot_of_rod < 0))[0]
    if not all(outlook.may_be_seen()[rods].tolist()) or len(missing) > len(rods):
        return None
    apart_mm = _least_distance_mm(crossings.xy_mm, rods, missing)
    if apart_mm < _reach_mm(model) or outlook.has_ends_near(rods):
        return None
    without = LeftOut.of(moved)
    if without is None or _contested(scene, moved, without, spot_of_rod[rods], apart_mm):
        return None
    protection = without.protection_mm(_protected(model), moved, options.integrity_risk)
    if options.alert_limit_mm is not None and protection.max() > options.alert_limit_mm:
        return None
    innovation = mahalanobis2(difference(T, T_predicted), predicted_covariance + C)
    if innovation[0] > _ODD_INNOVATION2:
        return None
    if _hides_a_misfit(model, moved):
        return None
    odds = _log_odds(model, scene, crossings.xy_mm, moved, without, rods, missing, innovation)
    if not odds > ACCEPT_LOG_ODDS:
        return None
    residual = seen.residual_px / scale.mm_per_px
    every_residual = residual.ravel()
    best = Candidate(
        T_slice_model=_kept(T),
        covariance=_kept(C),
        rod_index=_kept(rods),
        spot_index=_kept(spot_of_rod[rods]),
        residual_px=_kept(residual),
        lambda_mm=_kept(seen.crossing.lambda_mm),
        missing_rods=_kept(missing),
        missing_px=_kept(crossings.xy_mm.take(missing, axis=0) / scale.mm_per_px) if len(missing) else _NOWHERE,
        rms_px=math.sqrt(float(every_residual @ every_residual) / len(every_residual)),
        chi2=chi2,
        degrees_of_freedom=dof,
        log_odds=odds,
        iterations=moved.iterations,
        protection_mm=_kept(protection),
    )
    if near_misses_p(scene, scale, best) < NEAR_MISS_P:
        return None
    weakness = _greatest_condition(model, moved)
    if weakness > TWO_MINIMA_BOUND:
        desired = Desired.of(model, rods, scene.xy_mm[best.spot_index], scene.covariance_mm[best.spot_index])
        if has_other_minimum(model, moved, desired, T_predicted, predicted_covariance):
            return None
    clear = not spots.sd_assumed and weakness < WEAK_CONDITION
    return Registration(
        status="ok",
        reason="",
        candidates=(best,),
        n_spots=len(spots),
        warnings=() if clear else fit_warnings(model, spots, best),
    )


def _kept(values: _Array) -> _Array:
    """An array that is this verdict's own, from now on read-only."""
    values.flags.writeable = False
    return values


def _greatest_condition(model: RodModel, moved: ServoResult) -> float:
    """How many times worse one direction of the pose may be known than another, at most.

    The largest eigenvalue of a covariance is at most its trace, the inverse of the smallest at most that of the
    information.
    """
    variances, informations = moved.covariance.diagonal().tolist(), moved.information.diagonal().tolist()
    size2 = model.size_mm**2
    spread = sum(variances[:3]) + size2 * sum(variances[3:])
    return math.sqrt(spread * (sum(informations[:3]) + sum(informations[3:]) / size2))


def agrees_with_past(
    model: RodModel, scene: Scene, best: Candidate, T_predicted: FloatArray, predicted_covariance: FloatArray
) -> bool:
    """Whether the pose and the one most probable with the past taken in differ by no more than the covariance allows.

    With few spots the cost is a long curved valley. Its lowest point may lie far from the truth, and the covariance
    there, a straight ellipsoid, does not reach back; the past does, along the valley.
    """
    spots = best.spot_index
    desired = Desired.of(model, best.rod_index, scene.xy_mm[spots], scene.covariance_mm[spots])
    both = most_probable_pose(desired, T_predicted, predicted_covariance, best.T_slice_model)
    if both is None:
        return False
    apart = poses.difference(both.T, best.T_slice_model)
    distance2 = float(apart @ np.linalg.solve(best.covariance, apart))
    if distance2 > _AGREES_D2 or is_surprising(apart, both.information):
        return False
    # the cost rises from its lowest point by the squared distance, if the covariance describes it
    rise = both.seen.chi2 - best.chi2
    return distance2 < _NEAR_D2 or rise > _LEAST_RISE * distance2


def is_surprising(apart: FloatArray, information: FloatArray) -> bool:
    """Whether a pose off by ``apart`` (6,) is wrong by the ``information`` (6, 6) that the spots have at the true one.

    In place or in rotation. However wide its own covariance: where the past puts the frame, the spots tell so much more
    that such a pose is none of theirs.
    """
    bound = np.linalg.pinv(information, hermitian=True)
    error2, variance = apart * apart, np.diag(bound)
    return any(error2[part].sum() > _SURPRISE_SD**2 * variance[part].sum() for part in (slice(3), slice(3, 6)))


def _allowed(scene: Scene, T: FloatArray) -> bool:
    """:meth:`~ctreg_cli.registration.evidence.PosePrior.allows` of one pose."""
    nominal = scene.prior.rotation
    return nominal is None or turned_by(T, nominal) <= scene.prior.max_angle_rad


def is_vaguer(covariance: FloatArray, limit_rad: float) -> bool:
    """Whether the sd of the worst-known rotation exceeds ``limit_rad``."""
    turn = covariance[3:, 3:]
    if sum(turn.diagonal().tolist()) <= limit_rad**2:  # the variances of all axes together
        return False
    return float(np.linalg.eigvalsh(turn)[-1]) > limit_rad**2


@lru_cache(maxsize=64)
def _most_chi2(degrees_of_freedom: int) -> float:
    """Of residuals that need no inflation."""
    return float(chdtri(degrees_of_freedom, INFLATE_P))


@lru_cache(maxsize=16)
def _reach_mm(model: RodModel) -> float:
    """Crossings closer than this may leave one spot; cached, since a model is a value that never changes."""
    diameters = [rod.diameter_mm for rod in model.rods if rod.diameter_mm]
    return _TOUCHING_DIAMETERS * max(diameters) if diameters else _TOUCHING_SIZE * model.size_mm


@lru_cache(maxsize=16)
def _protected(model: RodModel) -> FloatArray:
    """:func:`~ctreg_cli.registration.integrity.protected_points`, cached likewise."""
    return protected_points(model)


def _least_distance_mm(xy_mm: FloatArray, rods: IntArray, missing: IntArray) -> float:
    """Of a rod that is seen, or should be, from a seen one: where it is small, their spots may be one."""
    places = xy_mm[:, 0] + 1j * xy_mm[:, 1]
    here = places.take(rods)
    there = here if not len(missing) else places.take(np.concatenate([rods, missing]))
    apart = np.abs(there[:, None] - here)
    k = len(rods)
    apart.ravel()[: k * k : k + 1] = np.inf  # each lies on itself
    return float(apart.min())


class LeftOut(NamedTuple):
    """What the other spots say of each of k spots (the hat matrix of regression: no fit is repeated)."""

    #: (6, 2k) ``C Jᵀ`` and (k, 2, 2) ``(Σ − J C Jᵀ)⁻¹``
    influence: FloatArray
    left: FloatArray
    #: (k, 2) ``(Σ − J C Jᵀ)⁻¹`` times the residual
    pull: FloatArray
    #: (k,) squared distance of each spot from where the others predict it, in sd
    distance2: FloatArray
    #: (k, 2, 2) covariance of that prediction and the spot, and its determinant; and that of the spot's own covariance
    gate: FloatArray
    gate_det: FloatArray
    own_det: FloatArray

    @classmethod
    def of(cls, moved: ServoResult) -> LeftOut | None:
        """None where a spot alone fixes a direction of the pose: the others do not predict it."""
        own, J = moved.view.covariance_px, moved.view.jacobian
        influence = moved.covariance.dot(J.T)
        k = len(own)
        slack = own - J.reshape(k, 2, 6) @ influence.reshape(6, k, 2).transpose(1, 0, 2)
        slack_det, own_det = determinant_2x2(slack), determinant_2x2(own)
        if min((slack_det - _FIXES_ALONE * own_det).tolist()) <= 0 or min(slack[:, 0, 0].tolist()) <= 0:
            return None
        left = inverse_2x2(slack, slack_det)
        r = moved.view.residual_px
        pull = (left @ r[:, :, None])[:, :, 0]
        # det(Σ L Σ) = det(Σ)² / det(slack)
        return cls(
            influence=influence,
            left=left,
            pull=pull,
            distance2=(pull * r).sum(axis=1),
            gate=own @ left @ own,
            gate_det=own_det * own_det / slack_det,
            own_det=own_det,
        )

    def protection_mm(self, points: FloatArray, moved: ServoResult, risk: float) -> FloatArray:
        """:func:`ctreg_cli.registration.integrity.protection_levels` (p,) at ``points`` (p, 3), in closed form."""
        k, p, sds = len(self.left), len(points), _sd_at_risk(risk, len(self.left))
        G = levers(points.dot(moved.T[:3, :3].T))
        # (p, k, 3, 2)
        moves = G.reshape(3 * p, 6).dot(self.influence).reshape(p, 3, k, 2).transpose(0, 2, 1, 3)
        together = (G @ moved.covariance @ G.transpose(0, 2, 1)).reshape(p, 9).tolist()
        without = (moves @ self.left @ moves.transpose(0, 1, 3, 2)).reshape(p, k, 9).tolist()
        separations = (moves @ self.pull[:, :, None]).reshape(p, k, 3).tolist()
        levels = []
        for variance, more, separation in zip(together, without, separations, strict=True):
            level = sds * math.sqrt(largest_eigenvalue(variance))
            for added, apart in zip(more, separation, strict=True):
                total, off = [*map(add, variance, added)], math.hypot(*apart)
                # an eigenvalue is at most the trace: few have to be worked out
                if off + sds * math.sqrt(total[0] + total[4] + total[8]) > level:
                    level = max(level, off + sds * math.sqrt(largest_eigenvalue(total)))
            levels.append(level)
        return np.array(levels)


@lru_cache(maxsize=64)
def _sd_at_risk(risk: float, n_matches: int) -> float:
    """The K of :mod:`~ctreg_cli.registration.integrity`: how many sd of a target's error the ``risk`` allows."""
    return math.sqrt(float(chdtri(3, risk / (n_matches + 1))))


def _contested(scene: Scene, moved: ServoResult, without: LeftOut, spots: IntArray, apart_mm: float) -> bool:
    """Whether a spot is not where the others predict it, or another could be there as well, by fit or by chance.

    ``apart_mm``: least distance of two of the rods' crossings.
    """
    if max(without.distance2.tolist()) > ODD_D2:
        return True
    k = len(spots)
    free = len(scene.xy_mm) - k
    if free:
        extent = np.ptp(scene.xy_mm, axis=0)
        density = free / float(extent[0] * extent[1])
        if math.pi * ODD_D2 * math.sqrt(float(without.gate_det.max())) * density > CHANCE_IN_GATE:
            return True
    else:
        # the rods' own spots: far from each other by more than the widest gate, and what two may lie off
        widest = CONTEST_D2 * max((without.gate[:, 0, 0] + without.gate[:, 1, 1]).tolist())
        off = max(map(abs, moved.view.residual_px.ravel().tolist())) * math.sqrt(2.0)
        if apart_mm > 2.0 * math.sqrt(widest) + off:
            return False
    predicted = scene.xy_mm[spots] - (moved.view.covariance_px @ without.pull[:, :, None])[:, :, 0]
    d_x, d_y = scene.xy_mm.T[:, None] - predicted.T[:, :, None]  # each (k, m)
    a, b, c = (without.gate[:, i, j, None] for i, j in ((0, 0), (0, 1), (1, 1)))
    near = (c * d_x - (b + b) * d_y) * d_x + a * d_y * d_y < CONTEST_D2 * without.gate_det[:, None]
    return int(np.count_nonzero(near)) > k


def _hides_a_misfit(model: RodModel, moved: ServoResult) -> bool:
    """Whether the spots speak of a scale or a frame's height that is off: the score test of registration.

    See :mod:`~ctreg_cli.registration.misfit`; in closed form, the spots in millimetres. The score is what χ² would fall
    by were these free, so that most slices need not work it out.
    """
    if moved.chi2 <= MISFIT_SCORE:
        return False
    seen = moved.view
    k = len(seen.residual_px)
    K = hidden_derivatives(model, moved.T, seen.crossing.xy_mm, seen.crossing.slope)
    WK = (seen.weight @ K).reshape(2 * k, 3)
    JWK = seen.jacobian.T.dot(WK)
    information = K.reshape(2 * k, 3).T.dot(WK) - JWK.T.dot(moved.covariance.dot(JWK)) + _SCALES_PRIOR
    pull = seen.residual_px.reshape(-1).dot(WK)
    return bool(float(pull.dot(np.linalg.solve(information, pull))) > MISFIT_SCORE)


def _log_odds(
    model: RodModel,
    scene: Scene,
    xy_mm: FloatArray,
    moved: ServoResult,
    without: LeftOut,
    rods: IntArray,
    missing: IntArray,
    innovation: tuple[float, float],
) -> float:
    """:func:`ctreg_cli.registration.evidence.log_odds` of one hypothesis whose prior is the prediction alone.

    ``innovation``: squared distance from the prediction, and ln det of its covariance.
    """
    there = xy_mm.take(np.concatenate([rods, missing]) if len(missing) else rods, axis=0)
    centre = there.sum(axis=0) / len(there)
    away = there - centre
    reach2 = max(_NEIGHBOURHOOD**2 * max((away * away).sum(axis=1).tolist()), (_LEAST_REACH * model.size_mm) ** 2)
    m = n = len(rods)
    if len(scene.xy_mm) > n:
        away = scene.xy_mm - centre
        m = max(int(np.count_nonzero((away * away).sum(axis=1) <= reach2)), n)
    distance2, log_det = innovation
    volume = min(-0.5 * distance2 + 0.5 * (log_determinant(moved.covariance) - log_det), 0.0)
    log_weights = -sum(map(math.log, without.own_det.tolist()))
    return (
        volume
        + n * (math.log(P_SEEN) - math.log(2 * math.pi))
        + 0.5 * log_weights
        - 0.5 * moved.chi2
        + n * math.log(math.pi * reach2)
        + math.lgamma(m - n + 0.5)
        - math.lgamma(m + 0.5)
        + len(missing) * math.log(1 - P_SEEN)
    )
