"""What does not average out from slice to slice: rods beside their drawing (the frame's ``tolerance``).

Spot noise is another in every slice, a rod's displacement the same. It enters the pose through the same rods in every
slice, so that neither a filter nor a smoother makes it less. Schmidt (1966) carries such errors along as what they do
to the state, without estimating them: a *consider* filter.
"""

from __future__ import annotations

import numpy as np

from ctreg_cli.arrays import FloatArray, IntArray
from ctreg_cli.registration.refine import across
from ctreg_cli.rods import RodModel
from ctreg_cli.tracking.servo import View


def lasting_influence(
    model: RodModel, T: FloatArray, rods: IntArray, seen: View, mm_per_px: FloatArray | None = None
) -> FloatArray:
    """(6, 2n) what an sd of each rod's displacement does to a pose, mm and rad, along two axes across the rod.

    Args:
        model: the frame, of n rods.
        T: (4, 4) the pose.
        rods: (k,) the rods whose spots make it.
        seen: these, seen from there.
        mm_per_px: (2,) where the spots are in pixels.
    """
    WJ = seen.weighted(seen.jacobian)
    by_spot = np.linalg.solve(WJ.T @ seen.jacobian, WJ.T).reshape(6, -1, 2).transpose(1, 0, 2)  # (k, 6, 2)
    axes = T[:3, :3] @ across(model.directions[rods])  # (k, 3, 2)
    # a rod that moves by δ moves its spot by [I | −k] δ
    moved = axes[:, :2] - seen.crossing.slope[:, :, None] * axes[:, 2:]
    if mm_per_px is not None:
        moved = moved / mm_per_px[:, None]
    influence = np.zeros((6, len(model), 2))
    influence[:, rods] = (by_spot @ (moved * model.tolerances[rods, None, None])).transpose(1, 0, 2)
    return influence.reshape(6, -1)
