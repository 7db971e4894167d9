"""Seeded samples for laws: poses of every kind, rods, and an independent plane–line intersection."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

#: rotation angles that find mistakes: none, tiny, ordinary, half a turn to the last bit and nearly
ANGLES = (0.0, 1e-12, 1e-9, 1e-5, 0.3, 2.0, np.pi - 1e-6, np.pi - 1e-9, np.pi)


def unit_vectors(rng: np.random.Generator, n: int) -> Array:
    v = rng.normal(size=(n, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def rotation_vectors(rng: np.random.Generator) -> Array:
    """(9 · 3, 3): three axes for each of ``ANGLES``."""
    return np.concatenate([angle * unit_vectors(rng, 3) for angle in ANGLES])


def random_pose(rng: np.random.Generator, spread_mm: float = 50.0) -> Array:
    T = np.eye(4)
    T[:3, :3] = Rotation.random(rng=rng).as_matrix()
    T[:3, 3] = rng.normal(scale=spread_mm, size=3)
    return T


def random_rods(rng: np.random.Generator, n: int, spread_mm: float = 40.0) -> tuple[Array, Array]:
    """Starts (n, 3) and unit directions (n, 3)."""
    return rng.normal(scale=spread_mm, size=(n, 3)), unit_vectors(rng, n)


def crossing(T: Array, point: Array, direction: Array) -> tuple[Array, float]:
    """Where one rod meets z = 0 of the slice, and how far along: the plane brought to the model, solved as 3 equations.

    Written apart from the library: in *model* axes, unknowns (u, v, λ) of ``o + u e1 + v e2 = p + λ y``.
    """
    to_model = np.linalg.inv(T)
    origin, e1, e2 = to_model[:3, 3], to_model[:3, 0], to_model[:3, 1]
    x, y, along = np.linalg.solve(np.column_stack([e1, e2, -direction]), point - origin)
    return np.array([x, y]), float(along)
