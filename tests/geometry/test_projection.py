"""The forward model against a plain intersection written here, and the pixel conventions."""

from __future__ import annotations

import numpy as np

from ctreg_cli.geometry.plucker import moments
from ctreg_cli.geometry.pose import make_pose
from ctreg_cli.geometry.projection import MIN_DIRECTION_Z, project, to_mm, to_pixels, within_bounds
from tests.geometry.sampling import crossing, random_pose, random_rods


def test_projection_agrees_with_a_plain_intersection() -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        T = random_pose(rng)
        p, y = random_rods(rng, 8)
        found = project(T, p, y)
        for i in range(8):
            xy, along = crossing(T, p[i], y[i])
            scale = 1 + abs(along)
            np.testing.assert_allclose(found.xy_mm[i] / scale, xy / scale, atol=1e-10)
            np.testing.assert_allclose(found.lambda_mm[i] / scale, along / scale, atol=1e-10)


def test_the_spot_brought_back_to_the_model_lies_on_the_rod() -> None:
    """X(u, v) × y = w (eq. 2), through pixels of unequal scale."""
    rng = np.random.default_rng(2)
    T = random_pose(rng)
    p, y = random_rods(rng, 20)
    found = project(T, p, y)
    scale = np.array([0.4, 0.7])
    uv = to_pixels(found.xy_mm, scale)
    np.testing.assert_allclose(uv[:, 0] * 0.4, found.xy_mm[:, 0])
    np.testing.assert_allclose(uv[:, 1] * 0.7, found.xy_mm[:, 1])
    np.testing.assert_allclose(to_mm(uv, scale), found.xy_mm)
    R, t = T[:3, :3], T[:3, 3]
    X = uv[:, :1] * (0.4 * R[0]) + uv[:, 1:] * (0.7 * R[1]) - R.T @ t
    np.testing.assert_allclose(np.cross(X, y), moments(p, y), atol=1e-8)
    np.testing.assert_allclose(p + found.lambda_mm[:, None] * y, X, atol=1e-8)


def test_an_upright_rod_is_seen_where_it_stands() -> None:
    """By hand: R = identity, the slice 10 mm above the rod's start."""
    T = make_pose(np.eye(3), np.array([100.0, 50.0, -10.0]))
    found = project(T, np.array([[3.0, 4.0, 0.0]]), np.array([[0.0, 0.0, 1.0]]))
    np.testing.assert_allclose(found.xy_mm, [[103, 54]])
    np.testing.assert_allclose(found.lambda_mm, [10])
    np.testing.assert_allclose(found.slope, [[0, 0]])


def test_slope_is_how_the_spot_slides_as_the_plane_moves() -> None:
    rng = np.random.default_rng(3)
    T = random_pose(rng)
    p, y = random_rods(rng, 10)
    h = 1e-3
    lower = make_pose(T[:3, :3], T[:3, 3] - [0, 0, h])  # the rods go down: the plane goes up
    found = project(T, p, y)
    np.testing.assert_allclose((project(lower, p, y).xy_mm - found.xy_mm) / h, found.slope, rtol=1e-6, atol=1e-8)


def test_a_rod_in_the_plane_leaves_no_spot() -> None:
    p = np.array([[0.0, 0, 0], [0, 0, 5], [0, 0, 0]])
    y = np.array([[1.0, 0, 0], [0, 1, 0], [np.sqrt(1 - MIN_DIRECTION_Z**2 / 4), 0, MIN_DIRECTION_Z / 2]])
    found = project(np.eye(4), p, y)
    assert np.isnan(found.xy_mm).all()
    assert np.isnan(found.lambda_mm).all()
    assert not within_bounds(found.lambda_mm, np.full(3, 100.0)).any()


def test_a_stack_of_poses_gives_each_pose_its_own() -> None:
    rng = np.random.default_rng(4)
    T = np.stack([random_pose(rng) for _ in range(6)]).reshape(2, 3, 4, 4)
    p, y = random_rods(rng, 5)
    stacked = project(T, p, y)
    assert stacked.xy_mm.shape == (2, 3, 5, 2)
    for i in np.ndindex(2, 3):
        single = project(T[i], p, y)
        np.testing.assert_allclose(stacked.xy_mm[i], single.xy_mm, rtol=1e-12)
        np.testing.assert_allclose(stacked.lambda_mm[i], single.lambda_mm, rtol=1e-12)
        np.testing.assert_allclose(stacked.slope[i], single.slope, rtol=1e-12)


def test_bounds_hold_both_ends_and_the_slack() -> None:
    along = np.array([-1.0, -0.5, 0, 5, 10, 10.5, 11])
    length = np.full(7, 10.0)
    assert within_bounds(along, length).tolist() == [False, False, True, True, True, False, False]
    assert within_bounds(along, length, slack_mm=0.5).tolist() == [False, True, True, True, True, True, False]
