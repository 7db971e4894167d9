"""The pose most probable given the spots of a slice and where the past expects the frame."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ctreg_cli.arrays import FloatArray
from ctreg_cli.geometry.plucker import skew
from ctreg_cli.tracking.servo import Desired, View, view
from ctreg_cli.tracking.single import difference, updated

#: steps at most; the last moves the pose by less than this (sd²), or, where a bent valley makes for a zigzag, than that
_MOST_STEPS, _DONE2, _NEAR2 = 30, 1e-5, 0.25
#: damping of a step that made things worse, to start from, and the most that is tried
_FIRST_DAMPING, _MOST_DAMPING = 1e-3, 1e6


class Posterior(NamedTuple):
    """The most probable pose."""

    #: (4, 4)
    T: FloatArray
    #: the spots from there
    seen: View
    #: (6, 6) what the spots alone say there
    information: FloatArray
    #: χ² of the spots and of the distance from the prediction
    cost: float


def most_probable_pose(
    desired: Desired, T_predicted: FloatArray, predicted_covariance: FloatArray, T_of_spots: FloatArray
) -> Posterior | None:
    """Minimise χ² of spots and past by Levenberg–Marquardt, from where either of them alone would have the frame.

    Along a curved valley the spots' own lowest point may lie far from what both together say; and a past that says
    little must not send the search astray: the better of the two minima counts.

    Args:
        desired: the spots and their rods.
        T_predicted: (4, 4) where the past expects the frame.
        predicted_covariance: (6, 6) of it.
        T_of_spots: (4, 4) where the spots alone put it.

    Returns:
        None where neither way leads to a minimum.
    """
    past = np.asarray(np.linalg.inv(predicted_covariance), dtype=np.float64)
    ends = [_descended(desired, T, T_predicted, past) for T in (T_predicted, T_of_spots)]
    return min((end for end in ends if end is not None), key=lambda end: end.cost, default=None)


def _descended(desired: Desired, T: FloatArray, T_predicted: FloatArray, past: FloatArray) -> Posterior | None:
    def seen_from(T: FloatArray) -> tuple[View, FloatArray, float]:
        seen, off = view(desired, T), difference(T, T_predicted)
        cost = seen.chi2 + float(off @ past @ off)
        return seen, off, cost if math.isfinite(cost) else math.inf

    seen, off, cost = seen_from(T)
    if not math.isfinite(cost):
        return None
    damping, moved2 = 0.0, math.inf
    for _ in range(_MOST_STEPS):
        WJ = seen.weighted(seen.jacobian)
        turned = _turned(off)
        both = WJ.T @ seen.jacobian + turned.T @ past @ turned
        pull = seen.residual_px.reshape(-1) @ WJ - turned.T @ past @ off
        step = np.asarray(np.linalg.solve(both + damping * np.diag(both.diagonal()), pull), dtype=np.float64)
        moved2 = float(step @ both @ step)
        T_new = updated(T, step)
        seen_new, off_new, cost_new = seen_from(T_new)
        if cost_new <= cost:
            T, seen, off, cost = T_new, seen_new, off_new, cost_new
            damping *= 0.1
        elif moved2 >= _DONE2:
            damping = max(10.0 * damping, _FIRST_DAMPING)
        if moved2 < _DONE2 or damping > _MOST_DAMPING:
            break
    if not moved2 < _NEAR2:
        return None
    return Posterior(T=T, seen=seen, information=seen.weighted(seen.jacobian).T @ seen.jacobian, cost=cost)


def _turned(off: FloatArray) -> FloatArray:
    """(6, 6) how the difference ``off`` (6,) from the prediction changes with a twist of the pose.

    A large turn's axis comes along: the inverse left Jacobian of SO(3) (Barfoot, *State Estimation for Robotics*,
    eq. 7.76) to fourth order.
    """
    x = skew(off[3:])
    A = np.eye(6)
    A[3:, 3:] += -0.5 * x + (x @ x) / 12.0 - (x @ x @ x @ x) / 720.0
    return A
