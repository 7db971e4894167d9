"""The control law: straight and curved paths, decay at the rate of the gain, its basin, and what it says of itself."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ctreg_cli.geometry.projection import project
from ctreg_cli.rods import RodModel
from ctreg_cli.tracking.servo import Desired, ServoOptions, pseudoinverse, servo, stability_margin, view
from tests.oracle import OracleFrame, bound, cross_line, random_frame
from tests.tracking.sequences import TrueSlice, error_of, model_of

S = np.array([0.5, 0.4])


def tilted_pose(frame: OracleFrame, rng: np.random.Generator, tilt: float = 0.15) -> np.ndarray:
    """A pose with the slice through the frame's middle."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([*rng.normal(size=2) * tilt, rng.uniform(-3, 3)]).as_matrix()
    middle = (frame.starts.mean(axis=0) + frame.ends.mean(axis=0)) / 2
    T[:3, 3] = np.array([120.0, 100.0, 0.0]) - T[:3, :3] @ middle
    return T


def moved(T: np.ndarray, shift_mm: np.ndarray, turn_rad: np.ndarray, model: RodModel) -> np.ndarray:
    """Turned about the frame's middle, and shifted."""
    out = T.copy()
    out[:3, :3] = Rotation.from_rotvec(turn_rad).as_matrix() @ T[:3, :3]
    middle = T[:3, :3] @ model.centre + T[:3, 3]
    out[:3, 3] = middle + shift_mm - out[:3, :3] @ model.centre
    return out


def desired_at(model: RodModel, T: np.ndarray, rods: np.ndarray, noise_px: np.ndarray | float = 0.0) -> Desired:
    frame = OracleFrame(np.array(model.starts), np.array(model.ends))
    spots = np.array([cross_line(frame.starts[i], frame.ends[i], T[:3, :3], T[:3, 3]) for i in rods]) / S
    return Desired.of(model, rods, spots + noise_px, np.tile(np.eye(2) * 0.09, (len(rods), 1, 1)), S)


def bend(path: np.ndarray) -> float:
    """Greatest distance of any spot from the chord of its path (i, k, 2), px."""
    chord = path[-1] - path[0]
    normal = np.stack([-chord[:, 1], chord[:, 0]], axis=1) / np.linalg.norm(chord, axis=1)[:, None]
    return float(np.abs(((path - path[0]) * normal).sum(axis=2)).max())


@pytest.fixture(scope="module")
def cube() -> tuple[RodModel, OracleFrame]:
    frame = random_frame(np.random.default_rng(3), 8)
    return model_of(frame), frame


@pytest.mark.parametrize("seed", range(6))
def test_the_view_is_that_of_the_oracle(seed: int) -> None:
    rng = np.random.default_rng(seed)
    frame = random_frame(rng, 7)
    model, T = model_of(frame), tilted_pose(frame, rng)
    rods = np.array([0, 2, 3, 6])
    seen = view(desired_at(model, T, rods), T)
    np.testing.assert_allclose(seen.residual_px, 0, atol=1e-9)
    information = np.linalg.inv(bound(frame, list(rods), T[:3, :3], T[:3, 3], S, 0.3))
    np.testing.assert_allclose(seen.weighted(seen.jacobian).T @ seen.jacobian, information, rtol=1e-4, atol=1e-2)


def test_the_whole_path_is_straight_to_a_millionth_pixel_in_the_limit_of_small_gains(
    cube: tuple[RodModel, OracleFrame],
) -> None:
    """Three rods: bends at gains g and g/2 extrapolate to nothing."""
    model, frame = cube
    rng = np.random.default_rng(0)
    T_desired = tilted_pose(frame, rng)
    T_start = moved(T_desired, np.array([1.5, -1.0, 1.0]), np.radians([2.0, -2.0, 3.0]), model)
    desired = desired_at(model, T_desired, np.array([0, 2, 5]))
    deviations = []
    for steps in (100, 200, 400):
        out = servo(
            model,
            T_start,
            desired,
            options=ServoOptions(
                gain=1.0 - np.exp(-2.0 / steps),  # the same poses in time, whatever the step
                spot_tolerance_sd=0.0,
                step_tolerance=0.0,
                residual_tolerance=0.0,
                max_iterations=steps,
            ),
            keep_path=True,
        )
        assert out.path_px is not None
        path = out.path_px[:: steps // 100]
        chord = out.path_px[0] + (1 - np.exp(-2.0 * np.arange(101) / 100))[:, None, None] * (
            desired.uv_px - out.path_px[0]
        )
        deviations.append(path - chord)
    once = 2 * deviations[1] - deviations[0]
    twice = 2 * deviations[2] - deviations[1]
    limit = (4 * twice - once) / 3  # Richardson: first and second order in the gain taken out
    assert np.abs(deviations[2]).max() > 1e-5
    assert np.abs(limit).max() < 1e-6


def test_a_constant_jacobian_draws_curved_paths(cube: tuple[RodModel, OracleFrame]) -> None:
    model, frame = cube
    T_desired = tilted_pose(frame, np.random.default_rng(1))
    T_start = moved(T_desired, np.array([8.0, -6.0, 3.0]), np.radians([8.0, -6.0, 12.0]), model)
    desired = desired_at(model, T_desired, np.arange(8))
    options = ServoOptions(gain=0.02, spot_tolerance_sd=0.0, max_iterations=1000)
    kept = view(desired, T_desired).jacobian
    updated = servo(model, T_start, desired, options=options, keep_path=True)
    constant = servo(model, T_start, desired, options=options, jacobian=kept, keep_path=True)
    assert updated.path_px is not None
    assert constant.path_px is not None
    assert bend(constant.path_px) > 5 * bend(updated.path_px)
    assert bend(constant.path_px) > 0.3
    np.testing.assert_allclose(constant.T, T_desired, atol=1e-5)


@pytest.mark.parametrize(("strategy", "gain"), list(product(("updated", "constant"), (0.1, 0.3, 0.7))))
def test_the_error_decays_at_the_rate_of_the_gain(
    cube: tuple[RodModel, OracleFrame], strategy: str, gain: float
) -> None:
    model, frame = cube
    T_desired = tilted_pose(frame, np.random.default_rng(2))
    T_start = moved(T_desired, np.array([2.0, -1.0, 1.0]), np.radians([2.0, -1.0, 3.0]), model)
    desired = desired_at(model, T_desired, np.arange(8))
    kept = view(desired, T_desired).jacobian if strategy == "constant" else None
    options = ServoOptions(gain=gain, spot_tolerance_sd=0, step_tolerance=0, residual_tolerance=0, max_iterations=25)
    out = servo(model, T_start, desired, options=options, jacobian=kept, keep_path=True)
    assert out.path_px is not None
    error = np.linalg.norm((out.path_px - desired.uv_px).reshape(26, -1), axis=1)
    use = error > 1e-9 * error[0]
    rates = error[1:][use[1:]] / error[:-1][use[1:]]
    # near the goal the law is linear, and the rate exact
    assert rates[-1] == pytest.approx(1 - gain, abs=0.01)
    assert rates.max() < 1 - 0.5 * gain


@pytest.mark.parametrize("turn_deg", [5.0, 15.0, 30.0])
@pytest.mark.parametrize("shift_mm", [2.0, 10.0])
@pytest.mark.parametrize("strategy", ["updated", "constant"])
def test_basin(cube: tuple[RodModel, OracleFrame], strategy: str, shift_mm: float, turn_deg: float) -> None:
    """From any start in the basin to the same pose: start displacement × strategy → success, steps."""
    model, frame = cube
    rng = np.random.default_rng(7)
    reached, steps = 0, []
    for _ in range(12):
        T_desired = tilted_pose(frame, rng, tilt=0.1)
        axis, way = rng.normal(size=3), rng.normal(size=3)
        T_start = moved(
            T_desired,
            shift_mm * way / np.linalg.norm(way),
            np.radians(turn_deg) * axis / np.linalg.norm(axis),
            model,
        )
        desired = desired_at(model, T_desired, np.arange(8))
        kept = view(desired, T_desired).jacobian if strategy == "constant" else None
        out = servo(model, T_start, desired, options=ServoOptions(gain=0.5, max_iterations=200), jacobian=kept)
        reached += bool(out.converged and np.abs(out.T - T_desired).max() < 1e-2)
        steps.append(out.iterations)
    assert reached == 12, f"{strategy} {shift_mm} mm {turn_deg} deg: {reached} of 12"
    assert max(steps) < 60


def test_noise_leaves_both_strategies_at_the_bound_with_a_true_covariance(
    cube: tuple[RodModel, OracleFrame],
) -> None:
    model, frame = cube
    rng = np.random.default_rng(11)
    T_true = tilted_pose(frame, rng, tilt=0.05)
    T_kept = moved(T_true, np.array([1.0, 1.0, 2.0]), np.radians([4.0, -3.0, 5.0]), model)
    rods = np.arange(8)
    kept = view(desired_at(model, T_true, rods), T_kept).jacobian
    true = TrueSlice(R=T_true[:3, :3], t=T_true[:3, 3], rods=list(rods), bound=None, has_jumped=False)
    C = bound(frame, list(rods), true.R, true.t, S, 0.05)
    for jacobian in (None, kept):
        ratios, nees = [], []
        for _ in range(200):
            noisy = desired_at(model, T_true, rods, rng.normal(size=(8, 2)) * 0.05)
            noisy = Desired.of(model, rods, noisy.uv_px, np.tile(np.eye(2) * 0.05**2, (8, 1, 1)), S)
            out = servo(model, T_kept, noisy, jacobian=jacobian)
            error = error_of(out.T, true)
            ratios.append(error @ np.linalg.solve(C, error) / 6)
            nees.append(error @ np.linalg.solve(out.covariance, error))
        # mean of χ²₆ over 300: 6 ± 0.2
        assert np.mean(nees) == pytest.approx(6.0, abs=0.8)
        if jacobian is None:
            assert np.mean(ratios) == pytest.approx(1.0, abs=0.12)
        else:  # Ĵ kept from 7° away weighs the spots a little wrong, and says so in the covariance
            assert 1.0 < np.mean(ratios) < 1.5


def test_the_margin_is_one_for_the_true_jacobian_and_falls_with_distance(cube: tuple[RodModel, OracleFrame]) -> None:
    model, frame = cube
    T = tilted_pose(frame, np.random.default_rng(5))
    here = view(desired_at(model, T, np.arange(8)), T)
    own = pseudoinverse(here.jacobian, here)
    assert stability_margin(own, here.jacobian, model.size_mm) == pytest.approx(1.0)
    margins = []
    for angle in (10.0, 40.0, 120.0, 180.0):
        far = view(desired_at(model, T, np.arange(8)), moved(T, np.zeros(3), np.radians([0, 0, angle]), model))
        margins.append(stability_margin(own, far.jacobian, model.size_mm))
    assert margins[0] > 0.5
    assert margins[0] > margins[1] > margins[2]
    assert margins[-1] < 0


def test_units_do_not_move_the_margin(cube: tuple[RodModel, OracleFrame]) -> None:
    """The same frame in centimetres: a margin that means something is the same number."""
    model, frame = cube
    small = model_of(OracleFrame(frame.starts / 10, frame.ends / 10))
    T = tilted_pose(frame, np.random.default_rng(6))
    T_far = moved(T, np.array([3.0, 2.0, 1.0]), np.radians([10.0, 5.0, 20.0]), model)
    margins = []
    for m, factor in ((model, 1.0), (small, 0.1)):
        scaled, far = T.copy(), T_far.copy()
        scaled[:3, 3] *= factor
        far[:3, 3] *= factor
        desired = Desired.of(m, np.arange(8), np.zeros((8, 2)), np.tile(np.eye(2), (8, 1, 1)), factor * S)
        here, there = view(desired, scaled), view(desired, far)
        margins.append(stability_margin(pseudoinverse(here.jacobian, here), there.jacobian, m.size_mm))
    assert margins[0] == pytest.approx(margins[1], rel=1e-9)


@pytest.mark.parametrize("left_over_sd", [0.0, 0.03], ids=["looks again", "looks no more"])
def test_lambda_is_that_of_the_pose_it_comes_with(cube: tuple[RodModel, OracleFrame], left_over_sd: float) -> None:
    model, frame = cube
    options = ServoOptions(left_over_sd=left_over_sd, spot_tolerance_sd=3e-3)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        T, rods = tilted_pose(frame, rng), np.arange(len(model))
        start = moved(T, np.array([1.5, -1.0, 2.0]), np.array([0.02, -0.03, 0.01]), model)
        out = servo(model, start, desired_at(model, T, rods, rng.normal(size=(len(rods), 2)) * 0.3), options=options)
        assert out.converged
        expected = project(out.T, model.starts, model.directions).lambda_mm
        np.testing.assert_allclose(out.view.crossing.lambda_mm, expected, atol=1e-9)


def test_spots_that_do_not_determine_the_pose_are_said_to(cube: tuple[RodModel, OracleFrame]) -> None:
    model, frame = cube
    T = tilted_pose(frame, np.random.default_rng(5))
    two = desired_at(model, T, np.array([0, 1]), 0.1)
    try:
        out = servo(model, T, two)
    except np.linalg.LinAlgError:
        return
    # rounding may hide the rank; then the covariance shows it
    assert not out.converged or np.linalg.cond(out.covariance) > 1e10
