"""The smoother: better than single slices by what it promises, with a true covariance, about any origin."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from ctreg_cli import pipeline
from ctreg_cli.io.rod_file import load_rod_model
from ctreg_cli.rods import RodModel
from ctreg_cli.tracking.motion import StillAxes
from ctreg_cli.tracking.smoother import LEAST_SLICES, TimedPose, smooth
from tests.tracking.sequences import Sequence, error_of, sequence

CUBE = load_rod_model("rod-cube-30x30x40")
#: ten slices a period of four seconds
BREATHING = {"kind": "breathing", "interval_s": 0.4, "model": CUBE, "sd_px": 0.3, "p_missing": 0.0, "most_false": 0}


def noisy_poses(made: Sequence, rng: np.random.Generator) -> list[TimedPose]:
    """Single-slice poses at their bound, without any registration."""
    axes = StillAxes(middle=made.model.centre, T_patient_slice=None)
    measured = []
    for i, true in enumerate(made.truth):
        assert true.bound is not None
        e = rng.multivariate_normal(np.zeros(6), true.bound)
        T = np.eye(4)
        T[:3, :3] = _turn(e[3:]) @ true.R
        T[:3, 3] = true.t + e[:3]
        G = axes.twist(T)
        measured.append(TimedPose(time_s=0.4 * i, T=axes.pose(T), covariance=G @ true.bound @ G.T))
    return measured


def _turn(w: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    matrix: np.ndarray = Rotation.from_rotvec(w).as_matrix()
    return matrix


def errors(poses: list[TimedPose], made: Sequence) -> np.ndarray:
    axes = StillAxes(middle=made.model.centre, T_patient_slice=None)
    result = []
    for pose, true in zip(poses, made.truth, strict=True):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = true.R, true.t
        result.append(error_of(pose.T, replace(true, R=true.R, t=axes.pose(T)[:3, 3])))
    return np.array(result)


@pytest.fixture(scope="module")
def smoothed() -> list[tuple[Sequence, list[TimedPose], list[TimedPose]]]:
    made = [sequence(seed, n=80, **BREATHING) for seed in (1, 2, 3)]  # type: ignore[arg-type]
    measured = [noisy_poses(m, np.random.default_rng(k)) for k, m in enumerate(made)]
    return [(m, z, smooth(z)) for m, z in zip(made, measured, strict=True)]


def test_breathing_comes_out_a_third_better_than_the_single_slice_bound(
    smoothed: list[tuple[Sequence, list[TimedPose], list[TimedPose]]],
) -> None:
    after = np.concatenate([errors(s, m) for m, _, s in smoothed])
    bound = np.concatenate([[np.diag(p.covariance) for p in z] for _, z, _ in smoothed])
    ratio = np.sqrt((after**2).mean(axis=0) / bound.mean(axis=0))
    assert ratio.max() < 0.7
    assert np.sqrt(np.mean(ratio**2)) < 0.6


def test_its_covariance_is_true(smoothed: list[tuple[Sequence, list[TimedPose], list[TimedPose]]]) -> None:
    nees = [e @ np.linalg.solve(p.covariance, e) for m, _, s in smoothed for p, e in zip(s, errors(s, m), strict=True)]
    assert 4.0 < np.mean(nees) < 7.5  # six degrees of freedom


def test_a_motion_without_noise_is_left_alone() -> None:
    made = sequence(5, n=30, **{**BREATHING, "sd_px": 0.01})  # type: ignore[arg-type]
    exact = [replace(p, T=_true(made, i)) for i, p in enumerate(noisy_poses(made, np.random.default_rng(0)))]
    for before, after in zip(exact, smooth(exact), strict=True):
        np.testing.assert_allclose(after.T, before.T, atol=0.02)


def _true(made: Sequence, i: int) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = made.truth[i].R, made.truth[i].t
    return StillAxes(middle=made.model.centre, T_patient_slice=None).pose(T)


def test_backwards_in_time_is_the_same_motion() -> None:
    made = sequence(6, n=30, **BREATHING)  # type: ignore[arg-type]
    measured = noisy_poses(made, np.random.default_rng(0))
    mirrored = [replace(p, time_s=-p.time_s) for p in reversed(measured)]
    for forth, back in zip(smooth(measured), reversed(smooth(mirrored)), strict=True):
        np.testing.assert_allclose(forth.T, back.T, atol=2e-2)
        np.testing.assert_allclose(forth.covariance, back.covariance, rtol=0.05, atol=1e-6)


def test_a_slice_given_twice_counts_once() -> None:
    made = sequence(7, n=20, **BREATHING)  # type: ignore[arg-type]
    measured = noisy_poses(made, np.random.default_rng(0))
    doubled = [copy for p in measured for copy in (p, p)]
    once, twice = smooth(measured), smooth(doubled)
    for single, double in zip(once, twice[::2], strict=True):
        np.testing.assert_allclose(double.covariance, single.covariance, rtol=1e-3, atol=1e-9)


def test_one_pose_comes_back_as_it_is() -> None:
    only = TimedPose(time_s=0.0, T=np.eye(4), covariance=np.eye(6))
    assert smooth([only]) == [only]
    assert smooth([]) == []


@pytest.mark.parametrize("shift_mm", [0.0, 150.0])
def test_in_the_pipeline_whatever_the_model_origin(shift_mm: float) -> None:
    """Jumps part the motion; slices that are not ok stay so, and so do short motions; the rows are the track's."""
    rods = tuple(replace(rod, start=rod.start + shift_mm, end=rod.end + shift_mm) for rod in CUBE.rods)
    model = RodModel(name="shifted", rods=rods)
    made = sequence(8, n=48, **{**BREATHING, "model": model, "kind": "mixed", "sd_px": 0.1})  # type: ignore[arg-type]
    made.slices[10] = replace(made.slices[10], spots=made.slices[10].spots.take(np.arange(2)))
    tracked = list(pipeline.track(made.slices, model))
    after = pipeline.smoothed(tracked, model)
    assert [r.status for r in after] == [r.status for r in tracked]
    assert after[10].status == "no_pose"
    assert after[10].best is None
    starts = [i for i, r in enumerate(tracked) if r.status == "ok" and (r.begins or not i)]
    for first, end in pairwise([*starts, len(tracked)]):
        motion = [i for i in range(first, end) if tracked[i].status == "ok"]
        if len(motion) < LEAST_SLICES:
            assert all(after[i] is tracked[i] for i in motion)
        else:
            assert {after[i].method for i in motion} == {"smoothed"}
    assert {r.method for r in after} > {"smoothed", ""}
    nees = []
    for result, true in zip(after, made.truth, strict=True):
        if result.status == "ok":
            best = result.candidates[0]
            error = error_of(best.T_slice_model, true)
            nees.append(error @ np.linalg.solve(best.covariance, error))
            own = tracked[result.index].candidates[0]
            assert np.trace(best.covariance) <= 1.05 * np.trace(own.covariance)
    assert np.mean(nees) < 9
