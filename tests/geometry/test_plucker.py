"""Lines: the moment's sign, moving them, distances from them and between bounded rods."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from ctreg_cli.geometry.plucker import moments, point_line_distance, segment_distance_range, skew, transform_lines
from tests.geometry.sampling import random_pose, random_rods


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20080401)


def test_skew_is_the_cross_product(rng: np.random.Generator) -> None:
    a, b = rng.normal(size=(2, 4, 5, 3))
    np.testing.assert_allclose(np.einsum("...ij,...j->...i", skew(a), b), np.cross(a, b), atol=1e-14)
    np.testing.assert_array_equal(skew(a), -np.swapaxes(skew(a), -1, -2))


def test_a_point_of_the_rod_satisfies_the_fundamental_equation(rng: np.random.Generator) -> None:
    """X × y = w with w = p × y: the sign on which everything linear rests (method §2)."""
    p, y = random_rods(rng, 50)
    X = p + rng.normal(scale=100, size=(50, 1)) * y
    np.testing.assert_allclose(np.cross(X, y), moments(p, y), atol=1e-11)
    off = X + rng.normal(size=(50, 3))
    assert np.linalg.norm(np.cross(off, y) - moments(p, y), axis=1).min() > 1e-3


def test_moment_is_perpendicular_to_the_direction_and_independent_of_the_point(rng: np.random.Generator) -> None:
    p, y = random_rods(rng, 50)
    np.testing.assert_allclose(np.einsum("ij,ij->i", moments(p, y), y), 0, atol=1e-12)
    np.testing.assert_allclose(moments(p + 7.5 * y, y), moments(p, y), atol=1e-11)
    np.testing.assert_allclose(moments(p, -y), -moments(p, y))


def test_transformed_lines_hold_the_transformed_points(rng: np.random.Generator) -> None:
    T = random_pose(rng)
    p, y = random_rods(rng, 20)
    p2, y2 = transform_lines(T, p, y)
    X = p + 12.0 * y
    np.testing.assert_allclose(p2 + 12.0 * y2, (T[:3, :3] @ X.T).T + T[:3, 3], atol=1e-11)
    np.testing.assert_allclose(np.linalg.norm(y2, axis=1), 1, atol=1e-14)


def test_distance_from_a_line_is_the_least_over_its_points(rng: np.random.Generator) -> None:
    p, y = random_rods(rng, 20)
    X = rng.normal(scale=50, size=(20, 3))
    foot = p + np.einsum("ij,ij->i", X - p, y)[:, None] * y
    np.testing.assert_allclose(point_line_distance(X, p, y), np.linalg.norm(X - foot, axis=1), atol=1e-11)


def least_distance(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> float:
    """Oracle: the convex quadratic over the unit square, by a bounded minimiser from every corner and the middle."""

    def squared(st: np.ndarray) -> float:
        gap = a + st[0] * (b - a) - c - st[1] * (d - c)
        return float(gap @ gap)

    starts = [(0.5, 0.5), (0, 0), (0, 1), (1, 0), (1, 1)]
    options = {"ftol": 1e-16, "gtol": 1e-12}
    runs = (minimize(squared, s, bounds=[(0, 1), (0, 1)], method="L-BFGS-B", options=options) for s in starts)
    return float(np.sqrt(min(run.fun for run in runs)))


def bounded_rods(kind: str, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    start, end = rng.uniform(-50, 50, size=(2, 6, 3))
    match kind:
        case "parallel":
            end = start + rng.uniform(-60, 60, size=(6, 1)) * np.array([0.6, 0.0, 0.8])
        case "nearly parallel":
            end = start + np.array([0.6, 0.0, 0.8]) * 80 + rng.normal(scale=1e-4, size=(6, 3))
        case "collinear":
            start = rng.uniform(-50, 50, size=(6, 1)) * np.array([0.6, 0.0, 0.8])
            end = start + rng.uniform(5, 30, size=(6, 1)) * np.array([0.6, 0.0, 0.8])
        case "crossing":
            middle = rng.uniform(-5, 5, size=3)
            half = rng.normal(scale=30, size=(6, 3))
            start, end = middle - half, middle + half
        case "touching ends":
            start = np.repeat(rng.uniform(-50, 50, size=(1, 3)), 6, axis=0)
        case "very short":
            end = start + rng.normal(scale=1e-5, size=(6, 3))
    return start, end


KINDS = ("generic", "parallel", "nearly parallel", "collinear", "crossing", "touching ends", "very short")


@pytest.mark.parametrize("kind", KINDS)
def test_distance_range_of_bounded_rods(kind: str, rng: np.random.Generator) -> None:
    start, end = bounded_rods(kind, rng)
    least, greatest = segment_distance_range(start, end)
    np.testing.assert_array_equal(least, least.T)
    np.testing.assert_array_equal(greatest, greatest.T)
    np.testing.assert_allclose(np.diag(least), 0, atol=1e-9)
    np.testing.assert_allclose(np.diag(greatest), np.linalg.norm(end - start, axis=1), rtol=1e-12)

    s = np.linspace(0, 1, 31)[:, None, None]
    points = start + s * (end - start)  # (31, 6, 3)
    for i in range(6):
        for j in range(6):
            sampled = np.linalg.norm(points[:, None, i] - points[None, :, j], axis=-1)
            assert least[i, j] <= sampled.min() + 1e-9
            assert greatest[i, j] >= sampled.max() - 1e-9
            assert greatest[i, j] == pytest.approx(sampled.max(), abs=1e-9)  # the ends are among the samples
            if j > i:
                assert least[i, j] == pytest.approx(least_distance(start[i], end[i], start[j], end[j]), abs=2e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_distance_range_does_not_depend_on_where_or_which_way(kind: str, rng: np.random.Generator) -> None:
    start, end = bounded_rods(kind, rng)
    least, greatest = segment_distance_range(start, end)
    T = random_pose(rng)
    moved = [points @ T[:3, :3].T + T[:3, 3] for points in (start, end)]
    for others in (segment_distance_range(*moved), segment_distance_range(end, start)):
        np.testing.assert_allclose(others[0], least, atol=1e-5)
        np.testing.assert_allclose(others[1], greatest, atol=1e-9)
