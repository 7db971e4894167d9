"""Motions: what moves, by how much, and about which point."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ctreg_cli.arrays import FloatArray
from ctreg_cli.errors import InputError
from ctreg_cli.geometry.pose import is_pose, rotation_angle
from ctreg_cli.simulation.motion import MOTION_KINDS, MotionSettings, Trajectory, advance, displaced, move, slice_times
from tests.simulation.scenes import bare, pose_near_middle

PIVOT = np.array([3.0, -2.0, 5.0])
START = pose_near_middle(bare(), np.random.default_rng(4))


def moved(kind: str, times_s: FloatArray, seed: int = 0, **changes: float) -> Trajectory:
    settings = MotionSettings(kind=kind, **changes)  # type: ignore[arg-type]
    return move(START, PIVOT, times_s, settings, np.random.default_rng(seed))


def middles(trajectory: Trajectory) -> FloatArray:
    """(n, 3) where the pivot is in slice coordinates."""
    T = trajectory.T_slice_model
    places: FloatArray = T[:, :3, :3] @ PIVOT + T[:, :3, 3]
    return places


@pytest.mark.parametrize("kind", MOTION_KINDS)
def test_every_motion_starts_at_the_start_is_rigid_and_keeps_to_its_amplitude(kind: str) -> None:
    trajectory = moved(kind, slice_times(33, 0.25), amplitude_mm=5.0, amplitude_deg=4.0)
    assert np.allclose(trajectory.T_slice_model[0], START)
    assert all(is_pose(T) for T in trajectory.T_slice_model)
    away = np.linalg.norm(middles(trajectory) - middles(trajectory)[0], axis=1)
    turned = np.degrees(rotation_angle(trajectory.T_slice_model[:, :3, :3] @ START[:3, :3].T))
    expected = (0.0, 0.0) if kind == "still" else (5.0, 4.0)
    assert (away.max(), turned.max()) == pytest.approx(expected, abs=1e-6)
    # turning is about the pivot: both go together
    assert np.allclose(away / 5.0, turned / 4.0, atol=1e-6)


def test_breathing_repeats_itself_and_rests_between_breaths() -> None:
    times = slice_times(80, 0.1)
    trajectory = moved("breathing", times, period_s=4.0)
    assert np.allclose(trajectory.T_slice_model[:40], trajectory.T_slice_model[40:])
    away = np.linalg.norm(middles(trajectory) - middles(trajectory)[0], axis=1)
    assert away.argmax() % 40 == 20
    # it does not matter when the clock started
    assert np.allclose(moved("breathing", times + 1234.5).T_slice_model, trajectory.T_slice_model)
    # longer near the start of a breath than near its height
    assert (away < 1.0).sum() > (away > 5.0).sum()


def test_a_jump_is_one_step_half_way() -> None:
    places = middles(moved("jump", slice_times(10, 1.0), amplitude_mm=7.0))
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert steps.argmax() == 4
    assert steps.max() == pytest.approx(7.0)
    assert np.delete(steps, 4) == pytest.approx(0.0, abs=1e-9)


def test_a_drift_is_even_and_its_direction_is_drawn() -> None:
    places = middles(moved("drift", slice_times(11, 1.0)))
    assert np.allclose(np.diff(places, axis=0), (places[-1] - places[0]) / 10)
    other = middles(moved("drift", slice_times(11, 1.0), seed=1))
    assert not np.allclose(other, places)
    assert len(moved("drift", slice_times(1, 1.0))) == 1


def test_a_scan_moves_the_plane_and_not_the_frame() -> None:
    still = moved("still", slice_times(5, 1.0))
    scan = advance(still, 2.0)
    assert scan.plane_mm == pytest.approx([-4, -2, 0, 2, 4])
    # a point of the frame keeps its place over the table
    assert np.allclose(scan.T_slice_model[:, 2, 3] + scan.plane_mm, START[2, 3])
    assert np.allclose(scan.T_slice_model[:, :2], still.T_slice_model[:, :2])
    assert np.allclose(advance(scan, -2.0).T_slice_model, still.T_slice_model)


def test_displacement_turns_about_the_pivot_and_is_undone_by_its_inverse() -> None:
    turn = np.array([0.1, -0.2, 0.3])
    there = displaced(START, PIVOT, np.zeros(3), turn)
    at = [T[:3, :3] @ PIVOT + T[:3, 3] for T in (START, there)]
    assert np.allclose(*at)
    assert math.isclose(float(rotation_angle(there[:3, :3] @ START[:3, :3].T)), float(np.linalg.norm(turn)))
    assert np.allclose(displaced(there, PIVOT, np.zeros(3), -turn), START)


@pytest.mark.parametrize(
    "wrong",
    [{"kind": "waltz"}, {"amplitude_mm": -1.0}, {"amplitude_deg": math.nan}, {"period_s": 0.0}, {"period_s": math.inf}],
)
def test_motions_that_are_none_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(InputError, match=f"{next(iter(wrong)).removesuffix('kind') or 'motion'}"):
        MotionSettings(**wrong)  # type: ignore[arg-type]


def test_times_and_steps_that_are_none_are_refused() -> None:
    with pytest.raises(InputError, match="interval_s"):
        slice_times(3, 0.0)
    with pytest.raises(InputError, match="step_mm"):
        advance(moved("still", slice_times(2, 1.0)), math.nan)
