"""The CT motion field: how spots move when the frame does (Doignon et al. 2008, eq. 7–14).

A point fixed to the rod moves with the twist, and the spot then slides along the rod until it is in the slice again:
``Q̇_xy = [I₂ | −k] (V + Ω × (Q − t))`` with ``k = d_xy / d_z``. It is the article's
``(FᵀF)⁻¹ Fᵀ [y]ₓ Rᵀ (…)`` without its matrix inverse (tests hold the two equal).
"""

from __future__ import annotations

import numpy as np

from ctreg_cli.arrays import FloatArray
from ctreg_cli.geometry.projection import Projection


def motion_field(T: FloatArray, projection: Projection) -> FloatArray:
    """Jacobian (..., n, 2, 6) of the crossings ``xy_mm`` with respect to the twist ``[V; Ω]``, mm per mm and per rad.

    Divide the rows by ``[s_x, s_y]`` for pixels. ``projection`` must come from :func:`project` at the same ``T``.
    """
    q = projection.xy_mm - T[..., None, :2, 3]
    q_z = np.broadcast_to(-T[..., None, 2, 3], q.shape[:-1])  # the crossing has z = 0
    k = projection.slope
    J = np.zeros((*q.shape[:-1], 2, 6))
    J[..., 0, 0] = J[..., 1, 1] = 1.0
    J[..., :, 2] = -k
    # Ω × q = (Ω_y q_z − Ω_z q_y, Ω_z q_x − Ω_x q_z, Ω_x q_y − Ω_y q_x), seen through [I₂ | −k]
    J[..., :, 3] = -k * q[..., 1, None]
    J[..., 1, 3] -= q_z
    J[..., :, 4] = k * q[..., 0, None]
    J[..., 0, 4] += q_z
    J[..., 0, 5] = -q[..., 1]
    J[..., 1, 5] = q[..., 0]
    return J


def scaled_columns(J: FloatArray, size_mm: float) -> FloatArray:
    """``J`` with its rotation columns divided by the frame's size: mm beside mm, so that condition means something."""
    scaled = np.array(J, dtype=np.float64)
    scaled[..., 3:] /= size_mm
    return scaled


def condition(J: FloatArray, size_mm: float) -> float:
    """Condition number of a stacked motion field (2n, 6) or (n, 2, 6), rotation columns scaled by the frame's size."""
    values = np.linalg.svd(scaled_columns(J, size_mm).reshape(-1, J.shape[-1]), compute_uv=False)
    return float(values[0] / values[-1]) if values[-1] > 0 and len(values) == J.shape[-1] else float("inf")


def scale_jacobian(xy_mm: FloatArray, mm_per_px: FloatArray) -> FloatArray:
    """Derivative (..., n, 2, 2) of the *pixel* coordinates ``xy / s`` with respect to ``[s_x, s_y]``."""
    J = np.zeros((*xy_mm.shape, 2))
    J[..., 0, 0] = -xy_mm[..., 0] / mm_per_px[0] ** 2
    J[..., 1, 1] = -xy_mm[..., 1] / mm_per_px[1] ** 2
    return J
