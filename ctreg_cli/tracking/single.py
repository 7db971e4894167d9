"""One pose at a time: what :mod:`ctreg_cli.geometry` does for stacks, with a quarter of the calls.

A tracked slice costs a few hundred operations on arrays of a dozen numbers: what counts is how many, not how large.
Plain matrices are multiplied by ``dot``, which costs half of ``@`` at this size.
Tests hold every function here equal to its counterpart.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dposv, dpotrf

from ctreg_cli.arrays import FloatArray, IntArray
from ctreg_cli.geometry import pose as poses
from ctreg_cli.geometry.motion_field import FIELD, N_FEATURES
from ctreg_cli.geometry.projection import MIN_DIRECTION_Z
from ctreg_cli.rods import RodModel


class Crossing(NamedTuple):
    """``n`` rods and the slice; NaN where a rod lies in the plane."""

    #: (n, 2) mm
    xy_mm: FloatArray
    #: (n,) along the rod, mm
    lambda_mm: FloatArray
    #: (n, 2) ``d_xy / d_z``
    slope: FloatArray
    #: (n,) millimetres along each rod for one along the slice normal: ``1 / |d_z|``
    mm_per_height: FloatArray
    #: (n, 2, 6) motion field, mm per mm and rad
    jacobian: FloatArray


def lines(starts: FloatArray, directions: FloatArray) -> FloatArray:
    """(4, 2n) rods as homogeneous columns: n points (n, 3), then n unit directions (n, 3)."""
    n = len(starts)
    columns = np.zeros((4, 2 * n))
    columns[:3, :n], columns[:3, n:] = starts.T, directions.T
    columns[3, :n] = 1.0
    return columns


@lru_cache(maxsize=16)
def model_lines(model: RodModel) -> FloatArray:
    """:func:`lines` of all rods of a model; cached, since a model is a value that never changes."""
    return lines(model.starts, model.directions)


@lru_cache(maxsize=16)
def greatest_tolerance_mm(model: RodModel) -> float:
    """Of any rod; cached, since a model is a value that never changes."""
    return float(model.tolerances.max())


def lines_of(model: RodModel, rods: IntArray) -> FloatArray:
    """:func:`lines` of the rods with the indices ``rods`` (k,), in their order."""
    columns = model_lines(model)
    n = len(model)
    return columns.reshape(4, 2, n).take(rods, axis=2).reshape(4, -1)


def cross(T: FloatArray, columns: FloatArray) -> Crossing:
    """:func:`~ctreg_cli.geometry.projection.project` and the motion field, at once.

    The motion field (Doignon et al. 2008, eq. 12) of all rods is made by one product of matrices, see
    :data:`~ctreg_cli.geometry.motion_field.FIELD`.

    Args:
        T: (4, 4) pose, mm.
        columns: (4, 2n) :func:`lines`.
    """
    n = columns.shape[1] // 2
    placed = T[:3].dot(columns)
    a_z, d_z = placed[2, :n], placed[2, n:]
    if min(map(abs, d_z.tolist())) <= MIN_DIRECTION_Z:
        d_z = np.where(np.abs(d_z) > MIN_DIRECTION_Z, d_z, np.nan)
    features = np.empty((N_FEATURES, n))
    slope = np.divide(placed[:2, n:], d_z, out=features[:2])
    xy = placed[:2, :n] - a_z * slope
    q = np.subtract(xy, T[:2, 3:], out=features[2:4])
    np.multiply(slope[:, None], q, out=features[4:8].reshape(2, 2, n))
    features[8], features[9] = 1.0, -T[2, 3]
    mm_per_dz = -1.0 / d_z
    return Crossing(
        xy_mm=xy.T,
        lambda_mm=a_z * mm_per_dz,
        slope=slope.T,
        mm_per_height=np.abs(mm_per_dz),
        jacobian=features.T.dot(FIELD).reshape(n, 2, 6),
    )


def lambdas(T: FloatArray, columns: FloatArray) -> FloatArray:
    """(n,) :attr:`Crossing.lambda_mm` alone, at an eighth of the cost; not finite where a rod lies in the plane."""
    a_z, d_z = T[2].dot(columns).reshape(2, -1)
    lambda_mm: FloatArray = a_z / -d_z
    return lambda_mm


def updated(T: FloatArray, twist: FloatArray) -> FloatArray:
    """:func:`ctreg_cli.geometry.pose.update` of one pose."""
    v_x, v_y, v_z, x, y, z = twist.tolist()
    angle2 = x * x + y * y + z * z
    angle = math.sqrt(angle2)
    if angle < _SMALL_RAD:
        a, b = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0
    else:
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle2
    turn = np.array(
        [
            [1 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y],
            [b * x * y + a * z, 1 - b * (x * x + z * z), b * y * z - a * x],
            [b * x * z - a * y, b * y * z + a * x, 1 - b * (x * x + y * y)],
        ]
    )
    moved = T.copy()
    moved[:3, :3] = turn.dot(T[:3, :3])
    moved[0, 3] += v_x
    moved[1, 3] += v_y
    moved[2, 3] += v_z
    return moved


def difference(T_to: FloatArray, T_from: FloatArray) -> FloatArray:
    """:func:`ctreg_cli.geometry.pose.difference`."""
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = T_to[:3, :3].dot(T_from[:3, :3].T).tolist()
    x, y, z = r21 - r12, r02 - r20, r10 - r01
    sine, cosine = 0.5 * math.sqrt(x * x + y * y + z * z), 0.5 * (r00 + r11 + r22 - 1.0)
    if cosine < _NEARLY_OPPOSITE:  # the axis has to be read off the symmetric part
        return poses.difference(T_to, T_from)
    scale = 0.5 if sine < _SMALL_RAD else 0.5 * math.atan2(sine, cosine) / sine
    twist = np.empty(6)
    twist[:3] = T_to[:3, 3] - T_from[:3, 3]
    twist[3:] = scale * x, scale * y, scale * z
    return twist


def quaternion(T: FloatArray) -> tuple[float, float, float, float]:
    """:func:`ctreg_cli.geometry.pose.quaternion` of one pose: ``qx qy qz qw``, ``qw ≥ 0`` (Shepperd 1978)."""
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = T[:3, :3].tolist()
    # four times the squares of the components; the largest is safe to divide by
    squares = (1 + r00 - r11 - r22, 1 - r00 + r11 - r22, 1 - r00 - r11 + r22, 1 + r00 + r11 + r22)
    largest = squares.index(max(squares))
    x, y, z, w = (
        (squares[0], r10 + r01, r20 + r02, r21 - r12),
        (r10 + r01, squares[1], r21 + r12, r02 - r20),
        (r20 + r02, r21 + r12, squares[2], r10 - r01),
        (r21 - r12, r02 - r20, r10 - r01, squares[3]),
    )[largest]
    scale = math.copysign(1 / math.sqrt(x * x + y * y + z * z + w * w), w)
    return x * scale, y * scale, z * scale, w * scale


def turned_by(T: FloatArray, nominal: FloatArray) -> float:
    """Angle, rad, between the rotations of a pose (4, 4) and a nominal one (3, 3)."""
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = T[:3, :3].dot(nominal.T).tolist()
    return math.atan2(math.hypot(r21 - r12, r02 - r20, r10 - r01), r00 + r11 + r22 - 1.0)


def solve_positive(A: FloatArray, b: FloatArray) -> FloatArray:
    """``A⁻¹ b`` for a positive definite A (n, n), by Cholesky; b (n,) or (n, k).

    Raises:
        numpy.linalg.LinAlgError: A is not positive definite.
    """
    _, x, failed = dposv(A, b)
    if failed:
        raise np.linalg.LinAlgError("not positive definite")
    return np.asarray(x)


def inverse_positive(A: FloatArray) -> FloatArray:
    """Inverse of a positive definite (6, 6) matrix.

    Raises:
        numpy.linalg.LinAlgError: A is not positive definite.
    """
    return solve_positive(A, _EYE6)


def log_determinant(A: FloatArray) -> float:
    """ln det of a positive definite matrix.

    Raises:
        numpy.linalg.LinAlgError: A is not positive definite.
    """
    factor, failed = dpotrf(A)
    if failed:
        raise np.linalg.LinAlgError("not positive definite")
    return _log_determinant_of(factor)


def mahalanobis2(x: FloatArray, S: FloatArray) -> tuple[float, float]:
    """``xᵀ S⁻¹ x`` and ln det S, which one Cholesky factor of the covariance S tells.

    Raises:
        numpy.linalg.LinAlgError: S is not positive definite.
    """
    factor, solved, failed = dposv(S, x)
    if failed:
        raise np.linalg.LinAlgError("not positive definite")
    return float(x.dot(solved)), _log_determinant_of(factor)


def _log_determinant_of(factor: FloatArray) -> float:
    """ln det of the matrix with this Cholesky factor."""
    return 2.0 * sum(map(math.log, factor.diagonal().tolist()))


def inverse_2x2(matrices: FloatArray, determinants: FloatArray | None = None) -> FloatArray:
    """Inverses of (k, 2, 2) matrices; ``determinants`` (k,) where they have been worked out already."""
    if determinants is None:
        determinants = determinant_2x2(matrices)
    adjugate = matrices.reshape(-1, 4).take(_ADJUGATE, axis=1)
    adjugate *= _ADJUGATE_SIGN
    adjugate /= determinants[:, None]
    return adjugate.reshape(-1, 2, 2)


def determinant_2x2(matrices: FloatArray) -> FloatArray:
    """(k,) determinants of (k, 2, 2) matrices."""
    a, b, c, d = matrices.reshape(-1, 4).T
    determinant: FloatArray = a * d - b * c
    return determinant


def largest_eigenvalue(elements: Sequence[float]) -> float:
    """Of a symmetric (3, 3) matrix given row by row (Smith 1961), at less than half of what LAPACK costs.

    Where the largest two are the same, to half of the digits.
    """
    xx, xy, xz, _, yy, yz, _, _, zz = elements
    mean = (xx + yy + zz) / 3.0
    x, y, z = xx - mean, yy - mean, zz - mean
    spread2 = (x * x + y * y + z * z + 2.0 * (xy * xy + yz * yz + xz * xz)) / 6.0
    spread = math.sqrt(spread2)
    half_determinant = 0.5 * (x * (y * z - yz * yz) - xy * (xy * z - yz * xz) + xz * (xy * yz - y * xz))
    cube = spread2 * spread
    cosine = half_determinant / cube if cube > 0 else 1.0
    return mean + 2.0 * spread * math.cos(math.acos(min(max(cosine, -1.0), 1.0)) / 3.0)


def shifted(lever_mm: FloatArray) -> FloatArray:
    """(6, 6) that takes a twist to the one at a point ``lever_mm`` (3,) away: ``V + Ω × lever``."""
    x, y, z = lever_mm.tolist()
    G = _EYE6.copy()
    G[0, 4], G[0, 5] = z, -y
    G[1, 3], G[1, 5] = -z, x
    G[2, 3], G[2, 4] = y, -x
    return G


def carried(G: FloatArray, covariance: FloatArray) -> FloatArray:
    """``G C Gᵀ``: a covariance (n, n), of twists say, that ``G`` (n, n) takes elsewhere."""
    result: FloatArray = G.dot(covariance).dot(G.T)
    return result


def levers(points_mm: FloatArray) -> FloatArray:
    """(p, 3, 6) how a twist moves points (p, 3), seen from the model origin: ``V + Ω × point``."""
    matrices: FloatArray = points_mm.dot(_LEVER) + _SHIFT
    return matrices.reshape(-1, 3, 6)


def _lever() -> FloatArray:
    """(3, 18) that makes ``[0 | −[p]ₓ]`` of p."""
    return np.stack([shifted(unit)[:3] - _EYE6[:3] for unit in np.eye(3)]).reshape(3, 18)


#: cosine below which half a turn is near
_NEARLY_OPPOSITE = -0.99
#: below this an angle's sine is the angle, to double precision
_SMALL_RAD = 1e-5
_EYE6 = np.eye(6)
_LEVER, _SHIFT = _lever(), _EYE6[:3].ravel()
_ADJUGATE, _ADJUGATE_SIGN = np.array([3, 1, 2, 0]), np.array([1.0, -1.0, -1.0, 1.0])
