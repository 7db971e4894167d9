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
from ctreg_cli.rods import RodModel
from ctreg_cli.tracking.gate import GATE_SD
from ctreg_cli.tracking.servo import Desired, ServoOptions, ServoResult, servo, view
from ctreg_cli.tracking.single import difference, updated

#: a frame that is known so much worse in one direction than in another may have two minima along it. In 9,600 random
#: poses of all kinds of frames 111 had a second one within 14°, less than 9 in χ² above the first; of these frames one
#: was known more evenly than this
TWO_MINIMA_CONDITION = 30.0
#: so far along (sd) the cost must have risen by about the square, or the valley is no ellipsoid's
_FAR_SD, _RISE = 3.0, (5.4, 18.0)
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
    unit = np.array([1.0, 1.0, 1.0, *(3 * [model.size_mm])])
    values, vectors = np.linalg.eigh(moved.covariance * (unit[:, None] * unit))
    along, sd = vectors[:, -1] / unit, math.sqrt(float(values[-1]))
    by_past = np.linalg.solve(predicted_covariance, along)
    middle = float(difference(T_predicted, moved.T) @ by_past) / float(along @ by_past)
    reach = GATE_SD / math.sqrt(float(along @ by_past))
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
