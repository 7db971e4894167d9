"""Poses: 4 × 4 matrices, twists ``[V; Ω]`` and quaternions, with every convention in one place.

``T_slice_model`` maps model to slice coordinates, ``P_slice = R P_model + t`` (mm). A twist is translation first,
``Ṗ = V + Ω × (P − t)``: V moves the model origin, Ω turns about it, both in slice axes. Hence the update is
``R ← exp([Ω]ₓ) R``, ``t ← t + V`` — *not* the exponential of SE(3), whose translation turns as it goes. SciPy's own
se(3) exponential is rotation first; nothing else in ctreg reorders a twist, and nothing else needs to.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from ctreg_cli.arrays import FloatArray

#: below this an angle is its sine; and the cosine below which half a turn is near
_SMALL_SINE, _NEARLY_OPPOSITE = 1e-8, -0.9
#: half an angle is never taken to be less: its sine is itself
_TINY_RAD = 1e-30
_EYE = np.eye(3)
#: (3, 9) that makes ``[Ω]ₓ`` of Ω, row by row
_CROSS = np.cross(np.eye(3)[:, None], _EYE).transpose(0, 2, 1).reshape(3, 9)


def make_pose(R: FloatArray, t: FloatArray) -> FloatArray:
    """(..., 4, 4) from rotations (..., 3, 3) and translations (..., 3) in mm."""
    R = np.asarray(R, dtype=np.float64)
    T = np.zeros((*R.shape[:-2], 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, t, 1.0
    return T


def inverse(T: FloatArray) -> FloatArray:
    """Inverse of rigid transforms (..., 4, 4)."""
    R_inverse = np.swapaxes(T[..., :3, :3], -1, -2)
    return make_pose(R_inverse, -np.einsum("...ij,...j->...i", R_inverse, T[..., :3, 3]))


def exp_rotation(omega_rad: FloatArray) -> FloatArray:
    """Rotations ``exp([Ω]ₓ)`` (..., 3, 3) of rotation vectors (..., 3); Rodrigues' formula, exact near zero too.

    ``I + a [Ω]ₓ + b [Ω]ₓ²`` with ``a = sin θ / θ`` and ``b = (1 − cos θ) / θ²``.
    """
    omega = np.asarray(omega_rad, dtype=np.float64)
    half = np.maximum(0.5 * np.sqrt((omega * omega).sum(axis=-1)), _TINY_RAD)  # no division by nothing, and no branch
    sinc = np.sin(half) / half
    turn: FloatArray = (omega @ _CROSS).reshape(*omega.shape, 3)
    rotation: FloatArray = turn @ turn
    rotation *= (0.5 * sinc * sinc)[..., None, None]
    turn *= (sinc * np.cos(half))[..., None, None]
    rotation += turn
    rotation += _EYE
    return rotation


def update(T: FloatArray, twist: FloatArray) -> FloatArray:
    """Pose after the twist ``[V; Ω]`` (..., 6), mm and rad: ``R ← exp([Ω]ₓ) R``, ``t ← t + V`` (eq. 16 integrated)."""
    twist = np.asarray(twist, dtype=np.float64)
    return make_pose(exp_rotation(twist[..., 3:]) @ T[..., :3, :3], T[..., :3, 3] + twist[..., :3])


def difference(T_to: FloatArray, T_from: FloatArray) -> FloatArray:
    """The twist (6,) with ``update(T_from, twist) == T_to``; mm and rad. ``T_to`` may be a stack (b, 4, 4): (b, 6)."""
    omega = log_rotation(T_to[..., :3, :3] @ T_from[:3, :3].T)
    return np.concatenate([T_to[..., :3, 3] - T_from[:3, 3], omega], axis=-1)


def log_rotation(R: FloatArray) -> FloatArray:
    """Rotation vectors (..., 3), no longer than π, of rotations (..., 3, 3): the inverse of :func:`exp_rotation`."""
    omega = np.empty(R.shape[:-1])
    omega[..., 0] = R[..., 2, 1] - R[..., 1, 2]
    omega[..., 1] = R[..., 0, 2] - R[..., 2, 0]
    omega[..., 2] = R[..., 1, 0] - R[..., 0, 1]
    sine = 0.5 * np.sqrt((omega * omega).sum(axis=-1))
    cosine = 0.5 * (R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2] - 1.0)
    if np.any(cosine < _NEARLY_OPPOSITE):  # the axis has to be read off the symmetric part
        return np.asarray(Rotation.from_matrix(R).as_rotvec())
    small = sine < _SMALL_SINE
    omega *= np.where(small, 0.5, 0.5 * np.arctan2(sine, cosine) / np.where(small, 1.0, sine))[..., None]
    return omega


def nearest_rotation(M: FloatArray) -> FloatArray:
    """The rotations nearest (Frobenius) to matrices (..., 3, 3), with det = +1: a mirror never comes out."""
    U, _, Vt = np.linalg.svd(M)
    sign = np.sign(np.linalg.det(U @ Vt))
    U = U.copy()
    U[..., :, 2] *= sign[..., None]
    rotation: FloatArray = U @ Vt
    return rotation


def rotation_angle(R: FloatArray) -> FloatArray:
    """Angles (...,) in rad of rotations (..., 3, 3), accurate near 0 and near π."""
    twice_sine = np.linalg.norm(
        np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1),
        axis=-1,
    )
    angle: FloatArray = np.arctan2(twice_sine, np.trace(R, axis1=-2, axis2=-1) - 1)
    return angle


def quaternion(T: FloatArray) -> FloatArray:
    """Quaternion ``qx qy qz qw`` (scalar last, ``qw ≥ 0``) of a pose."""
    q: FloatArray = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)
    return q


def from_quaternion(q: FloatArray, t_mm: FloatArray) -> FloatArray:
    """Pose (4, 4) of a quaternion ``qx qy qz qw`` (any norm but zero) and a translation in mm."""
    return make_pose(Rotation.from_quat(q).as_matrix(), np.asarray(t_mm, dtype=np.float64))


def is_pose(T: FloatArray, tolerance: float = 1e-6) -> bool:
    """Whether (4, 4) ``T`` is finite and rigid: orthonormal, right-handed, last row 0 0 0 1."""
    return bool(
        T.shape == (4, 4)
        and np.isfinite(T).all()
        and np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=tolerance)
        and np.linalg.det(T[:3, :3]) > 0
        and np.allclose(T[3], [0, 0, 0, 1], atol=tolerance)
    )
