"""The profile fitted to many windows at once: Levenberg–Marquardt in the spots' own coordinates."""

from __future__ import annotations

import numpy as np

from ctreg_cli.arrays import BoolArray, FloatArray
from ctreg_cli.imaging.profile import CENTRE, FLATNESS, GRADIENT, LOG_HEIGHT, N_PARAMETERS, SHAPE, Rows, moved

#: steps at most, and so many of them for all spots together. A spot is done when its centre moves by less than this
#: (px), or the step by less than this (sd²): the next would be several times smaller
MAX_STEPS, STEPS_TOGETHER, DONE_PX, DONE_SD2 = 10, 3, 4e-3, 1e-3
#: of sharp spots at most so many: few pixels tell height, size and flatness apart
MAX_SHARP_STEPS = 20
#: and they are done only when the step is less than this as well, sd²
DONE_SHARP_SD2 = 0.1
#: what is left of a spot that is cut off goes to its minimum by smaller steps, px; more so if it is thick
DONE_CUT_PX = 5e-4
#: of a long spot, how flat it is tells one rod from two: its ln γ moves by less than this in the last step
DONE_FLATNESS = 0.05
#: range of ln β and ln γ: from tails heavier than a Gaussian's to nearly a box
FLATNESS_RANGE = (-0.5, 2.5)
#: Levenberg–Marquardt damping; a step that is small only because of much damping does not end the fit
FIRST_DAMPING, DAMPING_FACTOR, DONE_DAMPING = 1e-3, 10.0, 1e-2


def _per_parameter(*, centre: float, log_height: float, background: float, shape: float, flatness: float) -> FloatArray:
    values = np.full((N_PARAMETERS, 1), background)
    values[CENTRE], values[LOG_HEIGHT], values[GRADIENT] = centre, log_height, background
    values[SHAPE], values[FLATNESS] = shape, flatness
    return values


#: inverse variances (10, 1) of the steps about the start: size and height are known within a factor of two, and how
#: flat the top is hardly differs from spot to spot (tried on simulated CT: looser is worse); a trace of certainty about
#: the rest keeps the matrix regular where a window is all padding
PRIOR = _per_parameter(centre=1e-9, log_height=0.7**-2, background=1e-9, shape=0.7**-2, flatness=0.1**-2)
#: the plateau of a long spot is as long as its rod's tilt and the slab make it
LONG_FLATNESS_PRIOR = 0.7**-2
#: a sharp spot is anything from a Gaussian to nearly a box
SHARP_FLATNESS_PRIOR = 0.7**-2
_UNIT_MATRIX = np.eye(N_PARAMETERS)
#: farthest from the start (10, 1): px for the centre, a factor of eight for height and shape
MAX_CHANGE = _per_parameter(centre=2.0, log_height=2.0, background=np.inf, shape=2.0, flatness=np.inf)


@np.errstate(over="ignore", invalid="ignore")  # a fit that wanders off goes back, or is none
def fit(rows: Rows, start: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Parameters (10, k) and normal matrices (k, 10, 10) at the minima of Σ w r² plus weak priors on the shape.

    Every spot has its own damping and stops on its own, so that its centre does not depend on who is fitted beside it;
    the few that need many steps take them by themselves. Afterwards ``rows`` holds derivatives and residuals there.
    """
    parameters, normal, done = _steps(rows, start, start, STEPS_TOGETHER)
    if not done.all():
        few = np.flatnonzero(~done)
        slow = rows.take(few)
        most = (MAX_SHARP_STEPS if rows.unusual else MAX_STEPS) - STEPS_TOGETHER
        parameters[:, few], normal[few], _ = _steps(slow, start[:, few], parameters[:, few], most)
        rows.by_spot[few] = slow.by_spot
    return parameters, normal


def _steps(
    rows: Rows, start: FloatArray, parameters: FloatArray, most: int
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Parameters, normal matrices, and which spots (k,) are done, after at most so many steps from ``parameters``."""
    low: FloatArray = start - MAX_CHANGE
    high: FloatArray = start + MAX_CHANGE
    low[FLATNESS], high[FLATNESS] = FLATNESS_RANGE
    unit = np.ones_like(start)
    unit[7] = np.exp(-start[6])  # a step in l1 is measured in the spot's own coordinates, as all others are
    done_px = np.where(rows.cut_off, DONE_CUT_PX, DONE_PX)
    prior = np.broadcast_to(PRIOR, start.shape)
    if rows.unusual:
        prior = prior.copy()
        prior[FLATNESS] = SHARP_FLATNESS_PRIOR
    if rows.long is not None:
        prior = prior.copy()
        prior[FLATNESS, rows.long] = LONG_FLATNESS_PRIOR
    prior_matrix = prior.T[:, :, None] * _UNIT_MATRIX

    def deviation_and_cost(parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
        deviation = (parameters - start) * unit
        squares = np.einsum("kp,kp->k", rows.by_spot[:, -1], rows.by_spot[:, -1])
        return prior * deviation, squares + np.einsum("ik,ik->k", prior * deviation, deviation)

    products = rows.evaluate(parameters)
    pull, cost = deviation_and_cost(parameters)
    k = start.shape[1]
    damping, done, stale = np.full(k, FIRST_DAMPING), np.zeros(k, dtype=bool), False
    for _ in range(most):
        damped = products[:, :-1] + prior_matrix
        damped *= 1.0 + damping[:, None, None] * _UNIT_MATRIX
        gradient = products[:, -1] - pull.T
        step = np.asarray(np.linalg.solve(damped, gradient[:, :, None])[:, :, 0].T, dtype=np.float64)
        if done.any():
            step[:, done] = 0.0
        trial = np.minimum(np.maximum(moved(parameters, step), low), high)
        change = trial[CENTRE] - parameters[CENTRE]
        small = np.maximum(np.abs(change[0]), np.abs(change[1])) < done_px
        if rows.long is not None:
            small &= ~rows.long | (np.abs(trial[FLATNESS] - parameters[FLATNESS]) < DONE_FLATNESS)
        gain = np.einsum("ki,ik->k", gradient, step)
        if rows.unusual:
            small &= gain < DONE_SHARP_SD2
        small |= gain < DONE_SD2
        small &= damping <= DONE_DAMPING
        if not stale and small.all():
            parameters, done = trial, small
            rows.by_spot[:, -1] -= (step.T[:, None] @ rows.by_spot[:, :-1])[:, 0]
            break
        trial_products = rows.evaluate(trial)
        trial_pull, trial_cost = deviation_and_cost(trial)
        better = trial_cost <= cost
        done |= better & small
        stale = not better.all()
        if stale:
            damping *= np.where(better, 1.0 / DAMPING_FACTOR, DAMPING_FACTOR)
            parameters, pull = np.where(better, trial, parameters), np.where(better, trial_pull, pull)
            products = np.where(better[:, None, None], trial_products, products)
            cost = np.where(better, trial_cost, cost)
        else:
            damping /= DAMPING_FACTOR
            parameters, pull, products, cost = trial, trial_pull, trial_products, trial_cost
    if stale:
        products = rows.evaluate(parameters)
    return parameters, products[:, :-1] + prior_matrix, done
