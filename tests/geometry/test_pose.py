"""Poses: the conventions of the public interface, against SciPy and against central differences."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ctreg_cli.geometry.pose import (
    difference,
    exp_rotation,
    from_quaternion,
    inverse,
    is_pose,
    log_rotation,
    make_pose,
    nearest_rotation,
    quaternion,
    rotation_angle,
    update,
)
from tests.geometry.sampling import random_pose, rotation_vectors, unit_vectors


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20080402)


def test_exp_rotation_agrees_with_scipy(rng: np.random.Generator) -> None:
    omega = np.concatenate([rotation_vectors(rng), rng.normal(scale=3, size=(50, 3))])
    np.testing.assert_allclose(exp_rotation(omega), Rotation.from_rotvec(omega).as_matrix(), atol=1e-14)


def test_exp_rotation_is_first_order_exact_for_tiny_turns(rng: np.random.Generator) -> None:
    for size in (1e-15, 1e-10, 1e-7):
        omega = size * unit_vectors(rng, 1)[0]
        R = exp_rotation(omega)
        turned = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2
        np.testing.assert_allclose(turned, omega, rtol=1e-9, atol=0)


def test_update_and_difference_undo_each_other(rng: np.random.Generator) -> None:
    for omega in rotation_vectors(rng):
        T = random_pose(rng)
        twist = np.concatenate([rng.normal(scale=30, size=3), omega])
        moved = update(T, twist)
        assert is_pose(moved)
        np.testing.assert_allclose(update(T, difference(moved, T)), moved, atol=1e-7 if omega @ omega > 9 else 1e-12)
        if np.linalg.norm(omega) < 3:  # at half a turn the axis has two signs
            np.testing.assert_allclose(difference(moved, T), twist, atol=1e-12)


def test_log_rotation_agrees_with_scipy(rng: np.random.Generator) -> None:
    turns = np.concatenate([rotation_vectors(rng), rng.normal(scale=0.7, size=(50, 3))])
    R = Rotation.from_rotvec(turns).as_matrix()
    for stack in (R, R[np.linalg.norm(turns, axis=1) < 2.5]):  # with half turns in it, and without
        np.testing.assert_allclose(log_rotation(stack), Rotation.from_matrix(stack).as_rotvec(), atol=1e-14)
    np.testing.assert_allclose(log_rotation(R[0]), Rotation.from_matrix(R[0]).as_rotvec(), atol=1e-14)


def test_zero_twist_changes_nothing(rng: np.random.Generator) -> None:
    T = random_pose(rng)
    np.testing.assert_allclose(update(T, np.zeros(6)), T, atol=1e-15)
    np.testing.assert_allclose(difference(T, T), 0, atol=1e-15)


def test_twist_is_v_of_the_model_origin_and_omega_in_slice_axes(rng: np.random.Generator) -> None:
    """Ṗ = V + Ω × (P − t): from the definition, by central differences of a point's path."""
    T = random_pose(rng)
    V, Omega = rng.normal(size=(2, 3))
    P_model = rng.normal(scale=20, size=3)

    def at(time: float) -> np.ndarray:
        return (update(T, time * np.concatenate([V, Omega])) @ np.append(P_model, 1))[:3]

    h = 1e-6
    velocity = (at(h) - at(-h)) / (2 * h)
    P = at(0)
    np.testing.assert_allclose(velocity, V + np.cross(Omega, P - T[:3, 3]), atol=1e-7)


def test_pure_rotation_leaves_the_model_origin_where_it_is(rng: np.random.Generator) -> None:
    """Not the exponential of SE(3), whose translation turns as it goes."""
    T = random_pose(rng)
    np.testing.assert_array_equal(update(T, np.array([0, 0, 0, 0.5, -1.0, 0.2]))[:3, 3], T[:3, 3])
    twist = np.array([1.0, 2, 3, 0.5, -1.0, 0.2])
    np.testing.assert_allclose(update(T, twist)[:3, 3], T[:3, 3] + [1, 2, 3], atol=1e-14)


def test_poses_come_in_stacks(rng: np.random.Generator) -> None:
    T = np.stack([random_pose(rng) for _ in range(6)]).reshape(2, 3, 4, 4)
    twists = rng.normal(size=(2, 3, 6))
    moved = update(T, twists)
    for i in np.ndindex(2, 3):
        np.testing.assert_allclose(moved[i], update(T[i], twists[i]), atol=1e-13)
        np.testing.assert_allclose(inverse(T)[i] @ T[i], np.eye(4), atol=1e-13)


def test_inverse_undoes(rng: np.random.Generator) -> None:
    T = random_pose(rng)
    np.testing.assert_allclose(inverse(T), np.linalg.inv(T), atol=1e-12)
    np.testing.assert_allclose(inverse(inverse(T)), T, atol=1e-13)


def test_quaternion_order_and_sign() -> None:
    quarter_about_z = make_pose(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.zeros(3))
    np.testing.assert_allclose(quaternion(quarter_about_z), [0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-15)
    np.testing.assert_allclose(quaternion(np.eye(4)), [0, 0, 0, 1], atol=1e-15)


def test_quaternion_round_trip(rng: np.random.Generator) -> None:
    for omega in rotation_vectors(rng):
        T = make_pose(exp_rotation(omega), rng.normal(size=3))
        q = quaternion(T)
        assert q[3] >= 0
        assert np.linalg.norm(q) == pytest.approx(1, abs=1e-15)
        np.testing.assert_allclose(from_quaternion(q, T[:3, 3]), T, atol=1e-13)
        np.testing.assert_allclose(from_quaternion(-3 * q, T[:3, 3]), T, atol=1e-13)


def test_nearest_rotation_is_a_rotation_and_keeps_rotations(rng: np.random.Generator) -> None:
    M = rng.normal(size=(200, 3, 3))
    M[:50] *= -1  # half of all matrices are mirrors; make sure of plenty
    M[50] = np.diag([1.0, 1.0, -1.0])
    M[51] = -np.eye(3)
    M[52] = np.diag([1.0, 1.0, 0.0])
    R = nearest_rotation(M)
    np.testing.assert_allclose(R @ np.swapaxes(R, -1, -2), np.broadcast_to(np.eye(3), M.shape), atol=1e-13)
    np.testing.assert_allclose(np.linalg.det(R), 1, atol=1e-13)
    np.testing.assert_allclose(nearest_rotation(R), R, atol=1e-13)
    np.testing.assert_allclose(nearest_rotation(R[0]), R[0], atol=1e-13)


def test_nearest_rotation_is_nearest(rng: np.random.Generator) -> None:
    others = Rotation.random(2000, rng=rng).as_matrix()
    for M in (*rng.normal(size=(5, 3, 3)), np.diag([1.0, 0.9, -0.8])):
        found = np.linalg.norm(nearest_rotation(M) - M)
        assert found <= np.linalg.norm(others - M, axis=(1, 2)).min() + 1e-12
        for near in exp_rotation(1e-3 * unit_vectors(rng, 50)):
            assert found <= np.linalg.norm(near @ nearest_rotation(M) - M) + 1e-12


def test_rotation_angle_is_accurate_at_both_ends(rng: np.random.Generator) -> None:
    for omega in rotation_vectors(rng):
        angle = float(np.linalg.norm(omega))
        measured = float(rotation_angle(exp_rotation(omega)))
        assert measured == pytest.approx(angle, abs=1e-14 if angle < 1 else 1e-9)


def test_is_pose_refuses_what_is_not_one(rng: np.random.Generator) -> None:
    T = random_pose(rng)
    assert is_pose(T)
    mirror, sheared, scaled, projective, broken = (T.copy() for _ in range(5))
    mirror[:3, 0] *= -1
    sheared[0, 1] += 0.1
    scaled[:3, :3] *= 1.01
    projective[3, 0] = 0.1
    broken[0, 3] = np.nan
    assert not any(is_pose(bad) for bad in (mirror, sheared, scaled, projective, broken, T[:3]))
