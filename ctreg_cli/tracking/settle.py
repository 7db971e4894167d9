"""What the past settles among the matches of a slice, and what one spot must not decide.

A rival is no rival if the pose it puts the frame at, *the past taken in*, is one that the verdict's covariance covers:
two rods exchanged may move the spots' own answer by ten degrees while the past leaves room for one. And where a false
spot can complete a wrong pose out of true ones, the odds that it does not are asked to be better than elsewhere.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ctreg_cli.arrays import BoolArray, FloatArray, IntArray, frozen
from ctreg_cli.geometry import pose as poses
from ctreg_cli.registration.linearity import positive_part
from ctreg_cli.registration.matching import Scene, observations
from ctreg_cli.registration.register import RIVAL_SD, averaged
from ctreg_cli.registration.result import Candidate
from ctreg_cli.rods import RodModel
from ctreg_cli.tracking.posterior import most_probable_pose
from ctreg_cli.tracking.prior import Weighed
from ctreg_cli.tracking.servo import Desired
from ctreg_cli.tracking.valley import Valley, walked_along
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
#: a spot of a badly known pose that is supported by less than this (ln odds) is in doubt
_SPOT_IN_DOUBT = 5.0
#: a cost that rises by a lesser share of what an ellipsoid promises, or three sd out by a greater, is none
_LEAST_RISE, _MOST_RISE = 0.16, 2.0


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
    own = best.spot_of_rod(len(model))
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


def covering_less(
    model: RodModel,
    scene: Scene,
    weighed: Weighed,
    best: Candidate,
    T_predicted: FloatArray,
    predicted_covariance: FloatArray,
) -> Candidate | None:
    """``best``, badly known, with a covariance that covers what is left open without each spot that is in doubt.

    Where the past is vague as well, a false spot lies in a rod's gate easily, and makes a bent valley look closed.

    Returns:
        None where the pose is out of the question without such a spot.
    """
    less = lacking(model, weighed, best) & (weighed.matches.log_odds > best.log_odds - _SPOT_IN_DOUBT)
    covariance = best.covariance
    for row in np.nonzero(less)[0]:
        spot_of_rod = weighed.matches.spot_of_rod[row]
        rods = np.nonzero(spot_of_rod >= 0)[0]
        there = Spotted(rods, spot_of_rod[rods], weighed.matches.T[row])
        open_there = _left_open(model, scene, there, T_predicted, predicted_covariance)
        if open_there is None:
            return None
        T, valley, _ = open_there
        apart = poses.difference(T, best.T_slice_model)
        covariance = covariance + positive_part(valley.covariance + np.outer(apart, apart) - covariance)
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
    covered = covering_valley(model, scene, best, T_predicted, predicted_covariance, only_straight=True)
    if covered is None:
        return None
    others = weighed.matches.log_odds > covered.log_odds - _RIVALS_WITHIN
    others[0] = False
    if (weighed.distance2(covered.T_slice_model, covered.covariance)[others] > RIVAL_SD**2).any():
        return None
    return covering_reconciled(covered, weighed.subset(others))


def covering_valley(
    model: RodModel,
    scene: Scene,
    best: Candidate,
    T_predicted: FloatArray,
    predicted_covariance: FloatArray,
    *,
    only_straight: bool = False,
) -> Candidate | None:
    """``best`` with a covariance that covers what spots and past together leave open.

    The pose stays that of the spots. Its error is then what lies between it and the most probable pose with the past
    taken in, and what the valley of the cost (spots and past) leaves open there.

    Args:
        model: the rods.
        scene: the spots.
        best: the pose.
        T_predicted: (4, 4) where the past expected the frame.
        predicted_covariance: (6, 6) of it.
        only_straight: whether that valley has to be much like an ellipsoid.

    Returns:
        None where it is not, where there is no such pose, and where it takes this one for none of its spots'.
    """
    there = Spotted(best.rod_index, best.spot_index, best.T_slice_model)
    found = _left_open(model, scene, there, T_predicted, predicted_covariance)
    if found is None:
        return None
    T, valley, information = found
    apart = poses.difference(T, best.T_slice_model)
    if is_surprising(apart, information):
        return None
    if only_straight and (valley.least_share < _LEAST_RISE or valley.steepest_share > _MOST_RISE):
        return None
    wider = positive_part(valley.covariance + np.outer(apart, apart) - best.covariance)
    return replace(best, covariance=frozen(best.covariance + wider, (6, 6)))


class Spotted(NamedTuple):
    """Rods (k,) and their spots (k,), and the pose (4, 4) that these speak for."""

    rods: IntArray
    spots: IntArray
    T: FloatArray


def _left_open(
    model: RodModel, scene: Scene, spotted: Spotted, T_predicted: FloatArray, predicted_covariance: FloatArray
) -> tuple[FloatArray, Valley, FloatArray] | None:
    """The pose (4, 4) most probable with the past, the valley about it, and the spots' information there (6, 6)."""
    rods, spots, T = spotted
    desired = Desired.of(model, rods, scene.xy_mm[spots], scene.covariance_mm[spots])
    both = most_probable_pose(desired, T_predicted, predicted_covariance, T)
    if both is None:
        return None
    spot_of_rod = np.full((1, len(model)), -1, dtype=np.intp)
    spot_of_rod[0, rods] = spots
    seen = observations(scene, spot_of_rod)
    return both.T, walked_along(model, seen, both.T, T_predicted, predicted_covariance), both.information
