"""One pose at a time is the same as one of a stack."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ctreg_cli.geometry import pose as poses
from ctreg_cli.geometry.motion_field import motion_field
from ctreg_cli.geometry.projection import project
from ctreg_cli.tracking import single
from tests.oracle import random_frame
from tests.tracking.sequences import model_of


@pytest.mark.parametrize("seed", range(5))
def test_crossings_and_motion_field(seed: int) -> None:
    rng = np.random.default_rng(seed)
    model = model_of(random_frame(rng, 8))
    T = poses.update(np.eye(4), np.concatenate([rng.normal(size=3) * 100, rng.normal(size=3)]))
    crossing, projection = single.cross(T, single.model_lines(model)), project(T, model.starts, model.directions)
    np.testing.assert_allclose(crossing.xy_mm, projection.xy_mm, rtol=1e-12)
    np.testing.assert_allclose(crossing.lambda_mm, projection.lambda_mm, rtol=1e-12)
    np.testing.assert_allclose(single.lambdas(T, single.model_lines(model)), projection.lambda_mm, rtol=1e-12)
    np.testing.assert_allclose(crossing.slope, projection.slope, rtol=1e-12)
    np.testing.assert_allclose(crossing.mm_per_height, np.hypot(1.0, np.hypot(*projection.slope.T)), rtol=1e-12)
    np.testing.assert_allclose(crossing.jacobian, motion_field(T, projection), rtol=1e-12, atol=1e-12)


def test_a_rod_in_the_slice_is_nan_and_no_warning() -> None:
    crossing = single.cross(np.eye(4), single.lines(np.zeros((2, 3)), np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])))
    assert np.isnan(crossing.xy_mm[0]).all()
    assert np.isfinite(crossing.xy_mm[1]).all()


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-7, 1e-4, 0.3, 2.0, 3.1, 3.141592])
def test_updates_and_differences(angle: float) -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        axis = rng.normal(size=3)
        twist = np.concatenate([rng.normal(size=3), angle * axis / np.linalg.norm(axis)])
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = Rotation.random(random_state=rng).as_matrix(), rng.normal(size=3)
        moved = single.updated(T, twist)
        np.testing.assert_allclose(moved, poses.update(T, twist), atol=1e-14)
        np.testing.assert_allclose(single.difference(moved, T), twist, atol=1e-8 if angle > 3 else 1e-13)


def test_half_a_turn_is_not_none() -> None:
    turned = np.diag([-1.0, -1.0, 1.0, 1.0])
    assert np.linalg.norm(single.difference(turned, np.eye(4))) == pytest.approx(np.pi)


@pytest.mark.parametrize("seed", range(4))
def test_quaternions(seed: int) -> None:
    """Every branch: turns about each axis up to the half circle, where the scalar vanishes."""
    rng = np.random.default_rng(seed)
    axes = [*np.eye(3), *rng.normal(size=(5, 3))]
    for axis in axes:
        for angle in (0.0, 1e-9, 0.5, 2.0, 3.0, np.pi - 1e-6):
            T = np.eye(4)
            T[:3, :3] = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()
            np.testing.assert_allclose(single.quaternion(T), poses.quaternion(T), atol=1e-9)
            assert single.quaternion(T)[3] >= 0


def test_small_positive_definite_systems() -> None:
    rng = np.random.default_rng(1)
    half = rng.normal(size=(9, 6))
    A, b = half.T @ half, rng.normal(size=6)
    np.testing.assert_allclose(A @ single.solve_positive(A, b), b, atol=1e-9)
    np.testing.assert_allclose(single.inverse_positive(A), np.linalg.inv(A), rtol=1e-9, atol=1e-12)
    assert single.log_determinant(A) == pytest.approx(np.linalg.slogdet(A)[1])
    distance2, log_determinant = single.mahalanobis2(b, A)
    assert distance2 == pytest.approx(b @ np.linalg.solve(A, b))
    assert log_determinant == pytest.approx(single.log_determinant(A))
    for singular in (np.zeros((6, 6)), -A):
        for function in (single.inverse_positive, single.log_determinant):
            with pytest.raises(np.linalg.LinAlgError):
                function(singular)
    blocks = rng.normal(size=(5, 2, 2))
    np.testing.assert_allclose(single.inverse_2x2(blocks) @ blocks, np.tile(np.eye(2), (5, 1, 1)), atol=1e-9)
    determinants = single.determinant_2x2(blocks)
    np.testing.assert_allclose(determinants, np.linalg.det(blocks))
    np.testing.assert_array_equal(single.inverse_2x2(blocks, determinants), single.inverse_2x2(blocks))


@pytest.mark.parametrize("seed", range(5))
def test_largest_eigenvalues(seed: int) -> None:
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(3, 3)) * 10.0 ** rng.uniform(-4, 4, size=3)
    turn = Rotation.random(random_state=rng).as_matrix()
    twice = turn @ np.diag([2.0, 2.0, 1.0]) @ turn.T
    line = np.outer(half[0], half[0])
    for A, accuracy in (
        (half @ half.T, 1e-12),
        (3.0 * np.eye(3) - twice, 1e-12),
        (line, 1e-12),
        (np.eye(3), 1e-12),
        (np.zeros((3, 3)), 1e-12),
        (twice, 1e-7),  # half of the digits, where the largest two are the same
        (1e-120 * twice, 1e-7),
    ):
        assert single.largest_eigenvalue(A.ravel().tolist()) == pytest.approx(np.linalg.eigvalsh(A)[-1], rel=accuracy)


def test_how_a_twist_moves_points() -> None:
    rng = np.random.default_rng(2)
    points, twist = rng.normal(size=(4, 3)), rng.normal(size=6)
    expected = twist[:3] + np.cross(twist[3:], points)
    np.testing.assert_allclose(single.levers(points) @ twist, expected)
    for point, velocity in zip(points, expected, strict=True):
        np.testing.assert_allclose(single.shifted(point) @ twist, [*velocity, *twist[3:]])
