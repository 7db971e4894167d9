"""Where a slice lies in the patient: DICOM's position and orientation as a transform."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from ctreg_cli.arrays import FloatArray, frozen

#: direction cosines written with three decimals are off by this much; beyond, they are not directions
MAX_ORIENTATION_ERROR = 2e-3
#: and this is what double precision leaves
_ROUNDING = 1e-14


@lru_cache(maxsize=64)
def slice_axes(cosines: tuple[float, ...]) -> FloatArray | None:
    """Slice axes x, y, z as columns (3, 3), patient axes, freed from the rounding of the written cosines.

    Args:
        cosines: six: the first three point along increasing u, the last three along increasing v; z = x × y
            (DICOM PS3.3 C.7.6.2.1.1). A series repeats them in every slice, hence the cache.

    Returns:
        None where these are not two orthogonal unit vectors.
    """
    x, y = np.array(cosines[:3]), np.array(cosines[3:])
    errors = (math.hypot(*x) - 1, math.hypot(*y) - 1, float(x @ y))
    if not all(abs(error) <= MAX_ORIENTATION_ERROR for error in errors):
        return None
    if max(map(abs, errors)) > _ROUNDING:  # the orthonormal pair nearest to (x, y)
        U, _, Vt = np.linalg.svd(np.column_stack([x, y]), full_matrices=False)
        x, y = (U @ Vt).T
    return frozen(np.column_stack([x, y, np.cross(x, y)]), (3, 3))


def patient_from_slice(axes: FloatArray, position_mm: tuple[float, ...]) -> FloatArray:
    """``T_patient_slice`` (4, 4), read-only, of :func:`slice_axes` and the middle of the first pixel (3,), mm."""
    T = np.zeros((4, 4))
    T[:3, :3], T[:3, 3], T[3, 3] = axes, position_mm, 1.0
    T.flags.writeable = False
    return T
