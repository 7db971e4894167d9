"""Whether the same spots may have another pose where the past has room for it.

Where rods say little of one direction, the cost of a pose may have two minima along it, a few degrees apart: of two
panels of rods always, of other frames where the slice happens to cut them alike. A servo comes to the one that its
start is nearer to. Another is looked for from both ends of what the past leaves open along the direction that the spots
say least about.
"""

from __future__ import annotations

import math

import numpy as np

from ctreg_cli.arrays import FloatArray
from ctreg_cli.registration.refine import principal_axes
from ctreg_cli.rods import RodModel
from ctreg_cli.tracking.gate import GATE_SD
from ctreg_cli.tracking.servo import ControlLaw, Desired, ServoOptions, ServoResult, servo, view
from ctreg_cli.tracking.single import difference, updated

#: a frame that is known so much worse in one direction than in another may have two minima along it: by a bound that
#: costs next to nothing, and by its eigenvalues. In 15,000 random poses of all kinds of frames 179 had a second minimum
#: within 14°, less than 9 in χ² above the first; five of these frames were known more evenly
TWO_MINIMA_BOUND, _TWO_MINIMA_CONDITION = 30.0, 12.0
#: so far along (sd) the cost must have risen by about the square, or the valley is no ellipsoid's
_FAR_SD, _RISE = 3.0, (5.4, 18.0)
#: a step that leaves less than this share of the way it was to take (in sd) has only one minimum to lead to
_LEFT_OF_WAY = 0.2
#: a minimum this near (sd²) is the same
_SAME_D2 = 4.0
_OPTIONS = ServoOptions(spot_tolerance_sd=1e-2, left_over_sd=0.1, max_iterations=15)


def has_other_minimum(
    model: RodModel, moved: ServoResult, desired: Desired, T_predicted: FloatArray, predicted_covariance: FloatArray
) -> bool:
    """Whether the servo ends elsewhere, or nowhere, when it starts from what the past leaves open.

    Args:
        model: the rods.
        moved: where it ended.
        desired: the spots it was brought to.
        T_predicted: (4, 4) where the past expected the frame.
        predicted_covariance: (6, 6) of it.
    """
    values, axes = principal_axes(moved.covariance, model.size_mm)
    if values[-1] < _TWO_MINIMA_CONDITION**2 * values[0]:
        return False
    along, sd = axes[:, -1], math.sqrt(float(values[-1]))
    by_past = np.linalg.solve(predicted_covariance, along)
    middle = float(difference(T_predicted, moved.T) @ by_past) / float(along @ by_past)
    reach = GATE_SD / math.sqrt(float(along @ by_past))
    ends = min(middle - reach, -_FAR_SD * sd), max(middle + reach, _FAR_SD * sd)
    if all(_leads_back(moved, desired, end * along) for end in ends):
        return False  # nearly always
    for end in (-_FAR_SD * sd, _FAR_SD * sd):
        rise = view(desired, updated(moved.T, end * along)).chi2 - moved.chi2
        if not _RISE[0] <= rise <= _RISE[1]:
            return True
    for end in (middle - reach, middle + reach):
        if abs(end) < GATE_SD * sd:
            continue  # no farther than the pose itself says it may be off
        try:
            there = servo(model, updated(moved.T, end * along), desired, options=_OPTIONS)
        except np.linalg.LinAlgError:
            return True
        apart = difference(there.T, moved.T)
        if not there.converged or float(apart @ np.linalg.solve(moved.covariance, apart)) > _SAME_D2:
            return True
    return False


def _leads_back(moved: ServoResult, desired: Desired, away: FloatArray) -> bool:
    """Whether a single step from ``away`` (6,) leads nearly all the way back: up to there the cost is a bowl."""
    there = view(desired, updated(moved.T, away))
    try:
        step, _ = ControlLaw.of(there).full_step(there)
    except np.linalg.LinAlgError:
        return False
    left = away + step
    way2 = float(away.dot(moved.information).dot(away))
    return float(left.dot(moved.information).dot(left)) < _LEFT_OF_WAY**2 * way2
