"""What lasts from slice to slice is not averaged away, and a past too old to say anything is not obeyed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ctreg_cli import pipeline
from ctreg_cli.geometry import pose as poses
from ctreg_cli.io.rod_file import load_rod_model
from ctreg_cli.registration.refine import across, displaced
from ctreg_cli.tracking import motion
from ctreg_cli.tracking.lasting import lasting_influence
from ctreg_cli.tracking.posterior import most_probable_pose
from ctreg_cli.tracking.servo import Desired, ServoOptions, servo, view
from tests.oracle import cross_lines
from tests.tracking.sequences import sequence

#: beyond this a pose is wrong: six sd of six
WRONG_D2 = 36.0


def a_pose(rng: np.random.Generator, centre: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = poses.exp_rotation(rng.normal(size=3) * 0.15)
    T[:3, 3] = np.array([120.0, 110.0, 3.0]) - T[:3, :3] @ centre
    return T


@pytest.mark.parametrize("seed", range(3))
def test_the_influence_of_displaced_rods_is_that_of_differences(seed: int) -> None:
    rng = np.random.default_rng(seed)
    drawn = load_rod_model("rod-cube-30x30x40")
    model = replace(drawn, rods=tuple(replace(rod, tolerance_mm=0.2) for rod in drawn.rods))
    T, s = a_pose(rng, model.centre), np.array([0.5, 0.7])
    rods = np.sort(rng.permutation(len(model))[:7])
    unit = np.broadcast_to(0.01 * np.eye(2), (7, 2, 2))
    influence: np.ndarray | None = None
    step, options = 1e-3, ServoOptions(gain=1.0, spot_tolerance_sd=1e-9, step_tolerance=1e-12, residual_tolerance=0.0)
    for rod in rods:
        for axis in range(2):
            shift = np.zeros((len(model), 3))
            shift[rod] = step * across(model.directions)[rod, :, axis]
            true = displaced(model, shift)
            spots = cross_lines(true.starts, true.ends, T[:3, :3], T[:3, 3])[rods] / s
            desired = Desired.of(model, rods, spots, unit, s)
            moved = servo(model, T, desired, options=options)
            influence = lasting_influence(model, moved.T, rods, view(desired, moved.T), s) / 0.2
            change = poses.difference(moved.T, T) / step
            np.testing.assert_allclose(influence[:, 2 * rod + axis], change, rtol=2e-3, atol=2e-4)
    assert influence is not None
    unseen = np.setdiff1d(np.arange(len(model)), rods)
    assert not influence.reshape(6, -1, 2)[:, unseen].any()


def test_a_hundred_slices_know_no_more_of_what_lasts_than_one() -> None:
    rng = np.random.default_rng(5)
    lasting = rng.normal(size=(6, 8)) * 0.1
    noise = 0.01 * np.eye(6)
    C = noise + lasting @ lasting.T
    state = motion.start(np.eye(4), C, "velocity", lasting=lasting)
    for _ in range(100):
        state = motion.advance(state, 0.2, "velocity")
        state = motion.correct(state, np.zeros(6), C, 0.2, "velocity", lasting)
    known = motion.advance(state, 0.2, "velocity").pose_covariance
    assert np.linalg.eigvalsh(known - lasting @ lasting.T).min() > 0
    assert np.linalg.norm(state.lasting[:6] - lasting) < 1e-6 * np.linalg.norm(lasting)  # type: ignore[index]


@pytest.mark.parametrize("seed", range(4))
def test_the_most_probable_pose_is_no_worse_than_either_end(seed: int) -> None:
    rng = np.random.default_rng(seed)
    model = load_rod_model("rod-cube-30x30x40")
    T = a_pose(rng, model.centre)
    rods = np.arange(5)
    spots = cross_lines(model.starts, model.ends, T[:3, :3], T[:3, 3])[rods] + rng.normal(size=(5, 2)) * 0.1
    desired = Desired.of(model, rods, spots, np.broadcast_to(0.01 * np.eye(2), (5, 2, 2)))
    P = np.diag(np.repeat([9.0, 0.01], 3))
    predicted = poses.update(T, rng.normal(size=6) * np.sqrt(np.diag(P)))
    of_spots = servo(model, T, desired).T
    both = most_probable_pose(desired, predicted, P, of_spots)
    assert both is not None

    def cost(pose: np.ndarray) -> float:
        off = poses.difference(pose, predicted)
        return view(desired, pose).chi2 + float(off @ np.linalg.solve(P, off))

    assert both.cost == pytest.approx(cost(both.T))
    for pose in (predicted, of_spots, *(poses.update(both.T, 1e-3 * rng.normal(size=6)) for _ in range(10))):
        assert both.cost <= cost(pose)


@pytest.mark.parametrize("gap_s", [30.0, 600.0, 1e8, 1e12])
@pytest.mark.parametrize("seed", range(3))
def test_after_a_pause_a_frame_in_plain_view_is_found_at_once(seed: int, gap_s: float) -> None:
    made = sequence(seed, kind="breathing", n=20, p_missing=0.0, most_false=1)
    late = [
        item if i < 10 else replace(item, info=replace(item.info, time_s=(item.info.time_s or 0.0) + gap_s))
        for i, item in enumerate(made.slices)
    ]
    results = list(pipeline.track(late, made.model))
    alone = list(pipeline.pose(late, made.model))
    after = [result.status for result in results[10:]]
    assert after.count("ok") >= [result.status for result in alone[10:]].count("ok"), (seed, gap_s, after)
    for result, true in zip(results, made.truth, strict=True):
        if result.status == "ok":
            best = result.candidates[0]
            t = np.eye(4)
            t[:3, :3], t[:3, 3] = true.R, true.t
            error = poses.difference(best.T_slice_model, t)
            assert error @ np.linalg.solve(best.covariance, error) < WRONG_D2, (seed, gap_s, result.index)
