"""A series: slices, their truth as results, and their place in the patient."""

from __future__ import annotations

import numpy as np
import pytest

from ctreg_cli.geometry.pose import is_pose
from ctreg_cli.simulation.defaults import suitable_settings
from ctreg_cli.simulation.motion import MotionSettings, advance, move, slice_times
from ctreg_cli.simulation.scene import frame_radius_mm
from ctreg_cli.simulation.series import simulate_series, truth
from ctreg_cli.simulation.start import parse_orientation
from tests.simulation.scenes import bare, pose_near_middle, small_frame


def test_slices_come_lazily_in_order_and_the_truth_matches_them() -> None:
    model, settings, rng = small_frame(), bare(missing=("c",)), np.random.default_rng(2)
    trajectory = move(pose_near_middle(settings, rng, 0.2), model.centre, slice_times(5, 0.5), MotionSettings(), rng)
    slices = simulate_series(model, trajectory, settings, np.eye(3), rng)
    for i, simulated in enumerate(slices):
        result = truth(i, simulated)
        assert result.info.source == f"slice_{i:04}.dcm"
        assert result.info.time_s == pytest.approx(0.5 * i)
        assert result.status == "ok"
        assert result.best is not None
        assert np.array_equal(result.best.T_slice_model, trajectory.T_slice_model[i])
        assert len(result.spots) == len(result.best.rod_index) == len(simulated.uv_px)
        assert [model.ids[rod] for rod in result.best.missing_rods] in (["c"], [])
        assert "c" not in [model.ids[rod] for rod in result.best.rod_index]


def test_a_frame_at_rest_keeps_its_place_in_the_patient_while_it_is_scanned() -> None:
    model, settings, rng = small_frame(), bare(), np.random.default_rng(2)
    R = parse_orientation("15,-8,40")
    still = move(pose_near_middle(settings, rng), model.centre, slice_times(4, 1.0), MotionSettings(kind="still"), rng)
    in_patient = []
    for simulated in simulate_series(model, advance(still, 3.0), settings, R, rng):
        T_patient_slice = simulated.slice.info.T_patient_slice
        assert T_patient_slice is not None
        assert is_pose(T_patient_slice)
        in_patient.append(T_patient_slice @ simulated.T_slice_model)
    assert np.allclose(in_patient, in_patient[0])


def test_defaults_hold_the_frame() -> None:
    model = small_frame()
    settings = suitable_settings(model, (200, 300))
    assert settings.field_of_view_mm > 2 * frame_radius_mm(model)
    assert suitable_settings(model, noise_hu=3.0).noise_hu == 3.0
