"""The CT motion field: against central differences, against the article's own form, and in singular designs."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ctreg_cli.geometry.motion_field import condition, motion_field, scale_jacobian, scaled_columns
from ctreg_cli.geometry.plucker import skew
from ctreg_cli.geometry.pose import exp_rotation, make_pose, update
from ctreg_cli.geometry.projection import project, to_pixels
from tests.geometry.sampling import random_pose, random_rods, rotation_vectors, unit_vectors


def numeric(T: np.ndarray, p: np.ndarray, y: np.ndarray, h: float) -> np.ndarray:
    """Central differences along the very update that tracking integrates, with Richardson's extrapolation."""

    def central(step: float) -> np.ndarray:
        columns = []
        for e in np.eye(6):
            ahead, behind = update(T, step * e), update(T, -step * e)
            columns.append((project(ahead, p, y).xy_mm - project(behind, p, y).xy_mm) / (2 * step))
        return np.stack(columns, axis=-1)

    return (4 * central(h / 2) - central(h)) / 3


def assert_same_field(J: np.ndarray, other: np.ndarray, rtol: float) -> None:
    """Relative to the greatest entry of each rod's 2 × 6."""
    size = np.abs(J).max(axis=(-2, -1), keepdims=True)
    np.testing.assert_allclose(J / size, other / size, rtol=0, atol=rtol)


def test_equals_central_differences() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        T = random_pose(rng)
        p, y = random_rods(rng, 8)
        steep = np.abs(y @ T[2, :3]) > 0.1
        p, y = p[steep], y[steep]
        assert_same_field(motion_field(T, project(T, p, y)), numeric(T, p, y, 1e-3), 1e-6)


@pytest.mark.parametrize("d_z", [0.05, 0.01, 1e-3])
def test_equals_central_differences_for_a_rod_nearly_in_the_plane(d_z: float) -> None:
    """There the spot races: the step must shrink with d_z, the Jacobian must not lose its digits."""
    rng = np.random.default_rng(2)
    for azimuth in rng.uniform(0, 2 * np.pi, 5):
        flat = np.sqrt(1 - d_z**2)
        y = np.array([[flat * np.cos(azimuth), flat * np.sin(azimuth), d_z]])
        p = rng.normal(scale=5, size=(1, 3)) * [1, 1, d_z]
        T = make_pose(np.eye(3), rng.normal(scale=3, size=3) * [1, 1, d_z])
        assert_same_field(motion_field(T, project(T, p, y)), numeric(T, p, y, 0.02 * d_z), 1e-6)


@pytest.mark.parametrize("index", range(27))
def test_equals_central_differences_at_tiny_and_half_turns(index: int) -> None:
    rng = np.random.default_rng(3)
    omega = rotation_vectors(rng)[index]
    T = make_pose(exp_rotation(omega), rng.normal(scale=30, size=3))
    p, y = random_rods(rng, 6)
    steep = np.abs(y @ T[2, :3]) > 0.1
    assert_same_field(motion_field(T, project(T, p[steep], y[steep])), numeric(T, p[steep], y[steep], 1e-3), 1e-6)


def test_equals_the_form_of_the_article() -> None:
    """S⁻¹ (FᵀF)⁻¹ Fᵀ [y]ₓ Rᵀ [I₃ | −[Q − t]ₓ] with F = [y]ₓ Rᵀ [e1 e2] (Doignon et al. 2008, eq. 7–13)."""
    rng = np.random.default_rng(4)
    S = np.diag([0.4, 0.7])
    for _ in range(50):
        T = random_pose(rng)
        R, t = T[:3, :3], T[:3, 3]
        p, y = random_rods(rng, 1)
        found = project(T, p, y)
        Q = np.append(found.xy_mm[0], 0.0)
        F = skew(y[0]) @ R.T[:, :2]
        twist_to_velocity = np.hstack([np.eye(3), -skew(Q - t)])
        article = np.linalg.inv(S) @ np.linalg.inv(F.T @ F) @ F.T @ skew(y[0]) @ R.T @ twist_to_velocity
        ours = np.linalg.inv(S) @ motion_field(T, found)[0]
        conditioned = 1e-13 * np.linalg.cond(F.T @ F)
        np.testing.assert_allclose(ours / np.abs(ours).max(), article / np.abs(ours).max(), atol=1e-12 + conditioned)


def test_translation_within_the_slice_moves_every_spot_alike() -> None:
    rng = np.random.default_rng(5)
    T = random_pose(rng)
    J = motion_field(T, project(T, *random_rods(rng, 7)))
    np.testing.assert_array_equal(J[..., :2], np.broadcast_to(np.eye(2), (7, 2, 2)))


def test_the_field_turns_with_the_slice_axes() -> None:
    """The twist is in slice axes: turning slice and twist together by A turns the spots' velocities by A."""
    rng = np.random.default_rng(6)
    T = random_pose(rng)
    p, y = random_rods(rng, 6)
    A = Rotation.from_rotvec([0, 0, 0.7]).as_matrix()
    turned = make_pose(A @ T[:3, :3], A @ T[:3, 3])
    both = np.kron(np.eye(2), A)
    J, J_turned = motion_field(T, project(T, p, y)), motion_field(turned, project(turned, p, y))
    np.testing.assert_allclose(J_turned @ both, A[:2, :2] @ J, rtol=1e-9, atol=1e-8)


def test_a_stack_of_poses() -> None:
    rng = np.random.default_rng(7)
    T = np.stack([random_pose(rng) for _ in range(6)]).reshape(2, 3, 4, 4)
    p, y = random_rods(rng, 5)
    J = motion_field(T, project(T, p, y))
    assert J.shape == (2, 3, 5, 2, 6)
    for i in np.ndindex(2, 3):
        np.testing.assert_allclose(J[i], motion_field(T[i], project(T[i], p, y)), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("n", [3, 6])
def test_parallel_rods_are_singular(n: int) -> None:
    rng = np.random.default_rng(8)
    T = random_pose(rng)
    p, _ = random_rods(rng, n)
    y = np.broadcast_to(unit_vectors(rng, 1), (n, 3))
    assert condition(motion_field(T, project(T, p, y)), 40.0) > 1e9


@pytest.mark.parametrize("n", [3, 6])
def test_coplanar_rods_are_singular(n: int) -> None:
    rng = np.random.default_rng(9)
    T = random_pose(rng)
    a, b = unit_vectors(rng, 2)
    weights = rng.normal(size=(n, 2))
    y = weights @ np.stack([a, b])
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    p = 30 * rng.normal(size=(n, 2)) @ np.stack([a, b]) + [5.0, 6.0, 7.0]
    assert condition(motion_field(T, project(T, p, y)), 40.0) > 1e9


def test_generic_rods_are_not_singular_and_two_never_suffice() -> None:
    rng = np.random.default_rng(10)
    T = random_pose(rng)
    p, y = random_rods(rng, 6)
    J = motion_field(T, project(T, p, y))
    assert condition(J, 40.0) < 1e3
    assert condition(J.reshape(-1, 6), 40.0) == condition(J, 40.0)
    assert condition(J[:2], 40.0) == float("inf")


def test_condition_does_not_depend_on_the_unit_of_length() -> None:
    """Rods in cm with their size in cm are as well posed as in mm: what the scaling of the columns is for."""
    rng = np.random.default_rng(11)
    T = random_pose(rng)
    p, y = random_rods(rng, 6)
    T_cm = make_pose(T[:3, :3], T[:3, 3] / 10)
    J, J_cm = motion_field(T, project(T, p, y)), motion_field(T_cm, project(T_cm, p / 10, y))
    assert condition(J, 40.0) == pytest.approx(condition(J_cm, 4.0), rel=1e-9)
    np.testing.assert_allclose(scaled_columns(J, 40.0)[..., 3:] * 40, J[..., 3:])
    np.testing.assert_array_equal(scaled_columns(J, 40.0)[..., :3], J[..., :3])


def test_scale_jacobian_equals_central_differences() -> None:
    rng = np.random.default_rng(12)
    xy = rng.normal(scale=80, size=(9, 2))
    s = np.array([0.4, 0.7])
    h = 1e-5
    J = np.stack([(to_pixels(xy, s + h * e) - to_pixels(xy, s - h * e)) / (2 * h) for e in np.eye(2)], axis=-1)
    np.testing.assert_allclose(scale_jacobian(xy, s), J, rtol=1e-6, atol=1e-6)
