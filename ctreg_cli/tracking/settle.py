"""What the past settles among the matches of a slice, and what one spot must not decide.

A rival is no rival if the pose it puts the frame at, *the past taken in*, is one that the verdict's covariance covers:
two rods exchanged may move the spots' own answer by ten degrees while the past leaves room for one. And where a false
spot can complete a wrong pose out of true ones, the odds that it does not are asked to be better than elsewhere.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ctreg_cli.arrays import BoolArray, FloatArray, frozen
from ctreg_cli.geometry import pose as poses
from ctreg_cli.registration.linearity import positive_part
from ctreg_cli.registration.matching import Scene, observations
from ctreg_cli.registration.refine import Observations, linearise
from ctreg_cli.registration.register import RIVAL_SD, averaged
from ctreg_cli.registration.result import Candidate
from ctreg_cli.rods import RodModel
from ctreg_cli.tracking.prior import Weighed, most_probable
from ctreg_cli.tracking.verify import is_surprising

#: a rival is reconciled when the verdict's pose would be this little wrong (χ² of six degrees of freedom) if it is true
_RECONCILED_D2 = 20.0
#: ln odds within which other matches count ...
_RIVALS_WITHIN = math.log(1000.0)
#: ... and those that lack a spot of it, and contradict: a spot that alone decides the pose must be well supported
_ALONE_DECIDES = 9.0
#: a match that moves the pose by more than this (χ² of six degrees of freedom) must be better supported than
#: 20,000 : 1 (ln), or the covariance has to cover the pose without it
_INFLUENTIAL_D2, _WELL_SUPPORTED = 20.0, 10.0
#: what three sd must cost at least and at most (an ellipsoid: 9) for the past to have straightened a valley
_LEAST_RISE, _MOST_RISE = 4.5, 18.0
#: where that is looked at, sd, and what it must cost at least at the farther places
_LOOKED_AT_SD, _LEAST_FAR_RISE = (3.0, 4.5, 6.0, 8.0), 12.0
_PROFILE_STEPS = 4


def reconciled(weighed: Weighed) -> BoolArray:
    """(b,) matches that contradict the best one by their spots alone, but not with the past taken in."""
    T, C = weighed.matches.T[0], weighed.covariance[0]
    alone = poses.difference(weighed.matches.T, T)
    contradicts = np.einsum("bi,ij,bj->b", alone, np.linalg.pinv(C, hermitian=True), alone) > RIVAL_SD**2
    rows: BoolArray = contradicts & (weighed.distance2(T, C) < _RECONCILED_D2)
    rows[0] = False
    return rows


def covering_reconciled(best: Candidate, rivals: Weighed) -> Candidate:
    """``best`` with a covariance that covers, by their odds, the poses of rivals that the past reconciles with it."""
    near = rivals.matches.log_odds > best.log_odds - _RIVALS_WITHIN
    return averaged(best, [_as_candidate(best, rivals, int(row)) for row in np.nonzero(near)[0]])[0]


def _as_candidate(best: Candidate, weighed: Weighed, row: int) -> Candidate:
    return replace(
        best,
        T_slice_model=weighed.T_if_true[row],
        covariance=weighed.covariance_if_true[row],
        log_odds=float(weighed.matches.log_odds[row]),
    )


def lacking(model: RodModel, weighed: Weighed, best: Candidate) -> BoolArray:
    """(b,) matches that are the best one without some of its spots."""
    spot_of_rod = weighed.matches.spot_of_rod
    own = np.full(len(model), -1, dtype=np.intp)
    own[best.rod_index] = best.spot_index
    less: BoolArray = ((spot_of_rod == own) | (spot_of_rod < 0)).all(axis=1) & (spot_of_rod != own).any(axis=1)
    return less


def opposing(model: RodModel, weighed: Weighed, best: Candidate) -> BoolArray:
    """(b,) matches that contradict the best one, whatever their own covariance, and are not far less probable.

    A sequence is thousands of slices: what one slice may be believed for at 100 : 1 would be wrong in some of them.
    """
    behind = best.log_odds - weighed.matches.log_odds
    near: BoolArray = behind < np.where(lacking(model, weighed, best), _ALONE_DECIDES, _RIVALS_WITHIN)
    for row in np.nonzero(near)[0]:
        both = best.covariance + weighed.covariance_if_true[row]
        near[row] = weighed.distance2(best.T_slice_model, both)[row] > RIVAL_SD**2
    return near


def covering(model: RodModel, weighed: Weighed, best: Candidate) -> Candidate:
    """``best`` with a covariance that covers the poses without each match that is influential and not well supported.

    Such a match may be a false spot that happens to fit. The odds say how seldom; but where one spot decides so much,
    more is asked than for the rest.
    """
    less = lacking(model, weighed, best) & (weighed.matches.log_odds > best.log_odds - _WELL_SUPPORTED)
    less &= weighed.distance2(best.T_slice_model, best.covariance) > _INFLUENTIAL_D2
    if not less.any():
        return best
    covariance = np.array(best.covariance)
    for row in np.nonzero(less)[0]:
        apart = poses.difference(weighed.T_if_true[row], best.T_slice_model)
        covariance += 0.5 * (weighed.covariance_if_true[row] + np.outer(apart, apart))
    return replace(best, covariance=frozen(covariance, (6, 6)))


def straightened(
    model: RodModel,
    scene: Scene,
    weighed: Weighed,
    best: Candidate,
    T_predicted: FloatArray,
    predicted_covariance: FloatArray,
) -> Candidate | None:
    """``best``, whose cost is no ellipsoid, with a covariance that holds where the past leaves of its valley a straight
    piece.

    The pose stays that of the spots. Its error is then what lies between it and the most probable pose with the past
    taken in, and that one's covariance, if the cost (spots and past) is an ellipsoid there.

    Args:
        model: the rods.
        scene: the spots.
        weighed: all matches of the slice, ``best`` first.
        best: the pose.
        T_predicted: (4, 4) where the past expected the frame.
        predicted_covariance: (6, 6) of it.

    Returns:
        None where the past does not settle it.
    """
    seen = observations(scene, weighed.matches.spot_of_rod[:1])
    nearby = most_probable(model, seen, T_predicted, predicted_covariance)
    T, C = nearby.T[0], nearby.covariance[0]
    if not nearby.found[0] or not _is_straight(model, seen, T, C, T_predicted, predicted_covariance):
        return None
    apart = poses.difference(T, best.T_slice_model)
    if is_surprising(apart, nearby.fit.normal_equations()[0][0]):
        return None
    covered = best.covariance + positive_part(C + np.outer(apart, apart) - best.covariance)
    best = replace(best, covariance=frozen(covered, (6, 6)))
    others = weighed.matches.log_odds > best.log_odds - _RIVALS_WITHIN
    others[0] = False
    if (weighed.distance2(best.T_slice_model, best.covariance)[others] > RIVAL_SD**2).any():
        return None
    return covering_reconciled(best, weighed.subset(others))


def _is_straight(
    model: RodModel,
    seen: Observations,
    T: FloatArray,
    C: FloatArray,
    T_predicted: FloatArray,
    predicted_covariance: FloatArray,
) -> bool:
    """Whether χ² of spots and past rises along its weakest direction as the covariance (6, 6) says.

    At three sd, and beyond: a valley may end in a wall there, and go on behind it.
    """
    unit = np.array([1, 1, 1, *(3 * [model.size_mm])])
    values, vectors = np.linalg.eigh(C * (unit[:, None] * unit))
    axes = vectors / unit[:, None]
    P_inverse = np.linalg.inv(predicted_covariance)
    far = np.array([side * sd for sd in _LOOKED_AT_SD for side in (1.0, -1.0)])
    several = Observations(
        uv_px=np.repeat(seen.uv_px, len(far), axis=0),
        covariance_px=np.repeat(seen.covariance_px, len(far), axis=0),
        matched=np.repeat(seen.matched, len(far), axis=0),
        mm_per_px=seen.mm_per_px,
        half_slab_mm=seen.half_slab_mm,
    )

    def cost(stack: FloatArray, observed: Observations) -> FloatArray:
        past = poses.difference(stack, T_predicted)
        return np.asarray(linearise(model, stack, observed).chi2 + np.einsum("bi,ij,bj->b", past, P_inverse, past))

    out = math.sqrt(float(values[-1])) * axes[:, -1]
    moved = poses.update(np.repeat(T[None], len(far), axis=0), far[:, None] * out)
    basis = axes[:, :-1]
    for _ in range(_PROFILE_STEPS):  # the other directions give way
        H, g = linearise(model, moved, several).normal_equations()
        g = g - poses.difference(moved, T_predicted) @ P_inverse
        step = np.linalg.solve(basis.T @ (H + P_inverse) @ basis, (g @ basis)[..., None])[..., 0]
        moved = poses.update(moved, step @ basis.T)
    rise = cost(moved, several) - cost(T[None], seen)
    return bool(rise.min() >= _LEAST_RISE and rise[:2].max() <= _MOST_RISE and rise[2:].min() >= _LEAST_FAR_RISE)
