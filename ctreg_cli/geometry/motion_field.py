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
    k, q = projection.slope, projection.xy_mm - T[..., None, :2, 3]
    features = np.empty((*q.shape[:-1], N_FEATURES))
    features[..., :2], features[..., 2:4] = k, q
    np.multiply(k[..., :, None], q[..., None, :], out=features[..., 4:8].reshape(*q.shape[:-1], 2, 2))
    features[..., 8], features[..., 9] = 1.0, -T[..., None, 2, 3]  # the crossing has z = 0
    return np.asarray(features @ FIELD).reshape(*q.shape, 6)


def _field() -> FloatArray:
    """(10, 12) that makes ``[I | −k] [I | −[q]ₓ]`` (2, 6) of ``k_x k_y q_x q_y k_x·q k_y·q 1 q_z`` (q in the plane).

    The motion field of a rod is linear in its slope k, in its crossing q seen from the model origin, and in the
    products of the two: one product of matrices makes it of all rods.
    """
    k_x, k_y, q_x, q_y, kx_qx, kx_qy, ky_qx, ky_qy, one, q_z = range(N_FEATURES)
    M = np.zeros((N_FEATURES, 2, 6))
    M[one, 0, 0] = M[one, 1, 1] = 1.0
    M[k_x, 0, 2] = M[k_y, 1, 2] = -1.0
    M[kx_qy, 0, 3] = M[ky_qy, 1, 3] = M[q_z, 1, 3] = -1.0
    M[kx_qx, 0, 4] = M[ky_qx, 1, 4] = M[q_z, 0, 4] = 1.0
    M[q_y, 0, 5] = -1.0
    M[q_x, 1, 5] = 1.0
    return M.reshape(N_FEATURES, 12)


#: features of a rod, see :func:`_field`
N_FEATURES = 10
FIELD = _field()


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
