"""Rods as lines: a point, a unit direction and the moment (Plücker coordinates).

A line through ``p`` with unit direction ``y`` has the moment ``w = p × y``; a point ``X`` lies on it exactly when
``X × y = w`` (Doignon et al. 2008, eq. 2; the article prints the product in the other order, and so the other sign).
"""

from __future__ import annotations

import numpy as np

from ctreg_cli.arrays import FloatArray


def skew(vectors: FloatArray) -> FloatArray:
    """Cross-product matrices: (..., 3) → (..., 3, 3) with ``skew(a) @ b == cross(a, b)``."""
    a = np.asarray(vectors, dtype=np.float64)
    matrix = np.zeros((*a.shape[:-1], 3, 3))
    matrix[..., 0, 1], matrix[..., 0, 2] = -a[..., 2], a[..., 1]
    matrix[..., 1, 0], matrix[..., 1, 2] = a[..., 2], -a[..., 0]
    matrix[..., 2, 0], matrix[..., 2, 1] = -a[..., 1], a[..., 0]
    return matrix


def moments(points: FloatArray, directions: FloatArray) -> FloatArray:
    """Moments ``w = p × y`` (n, 3) of the lines through ``points`` (n, 3) along unit ``directions`` (n, 3)."""
    return np.cross(points, directions)


def transform_lines(T: FloatArray, points: FloatArray, directions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lines moved by the rigid transform ``T`` (4, 4): points ``R p + t`` and directions ``R y``, both (n, 3)."""
    R, t = T[:3, :3], T[:3, 3]
    return points @ R.T + t, directions @ R.T


def point_line_distance(X: FloatArray, points: FloatArray, directions: FloatArray) -> FloatArray:
    """Distance (n,) from points ``X`` (n, 3) to the lines, ``|X × y − w|``."""
    distance: FloatArray = np.linalg.norm(np.cross(X - points, directions), axis=-1)
    return distance


def segment_distance_range(start: FloatArray, end: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Least and greatest distance between any two points of two bounded rods.

    Args:
        start: (n, 3) starts of the rods, mm.
        end: (n, 3) their ends, mm.

    Returns:
        Two (n, n) symmetric matrices. Both are what a pair of spots may show as its distance in *any* slice.
    """
    start, end = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    ends = np.stack([start, end])  # the greatest distance is between two ends: distance is convex along both rods
    greatest = np.linalg.norm(ends[:, None, :, None] - ends[None, :, None, :], axis=-1).max(axis=(0, 1))

    d = end - start
    length2 = np.einsum("ij,ij->i", d, d)
    r = start[:, None] - start[None, :]
    a, e = length2[:, None], length2[None, :]
    b = d @ d.T
    c = np.einsum("ik,ijk->ij", d, r)
    f = np.einsum("jk,ijk->ij", d, r)
    det = a * e - b * b
    safe = np.where(det > 1e-12 * a * e, det, 1.0)
    s = np.where(det > 1e-12 * a * e, np.clip((b * f - c * e) / safe, 0, 1), 0.0)
    t = (b * s + f) / e
    t_clipped = np.clip(t, 0, 1)
    s = np.clip((b * t_clipped - c) / a, 0, 1)  # Ericson, Real-Time Collision Detection, §5.1.9
    gap = r + s[..., None] * d[:, None] - t_clipped[..., None] * d[None, :]
    least = np.linalg.norm(gap, axis=-1)
    return np.minimum(least, least.T), greatest
