"""Start poses and slice orientations."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ctreg_cli.errors import InputError
from ctreg_cli.geometry.pose import is_pose, rotation_angle
from ctreg_cli.io.rod_file import load_rod_model, shipped_frames
from ctreg_cli.rods import Rod, RodModel
from ctreg_cli.simulation.crossings import rod_crossings
from ctreg_cli.simulation.defaults import suitable_settings
from ctreg_cli.simulation.start import centred_pose, parse_orientation, start_pose, tilted
from tests.simulation.scenes import bare, small_frame

AXIAL = np.eye(3)


@pytest.mark.parametrize("name", sorted(shipped_frames()))
def test_every_shipped_frame_stands_in_the_middle_and_shows_its_rods(name: str) -> None:
    model = load_rod_model(name)
    settings = suitable_settings(model)
    T = centred_pose(model, settings, AXIAL)
    assert is_pose(T)
    assert np.allclose(T[:3, :3] @ model.centre + T[:3, 3], [*settings.centre_mm, 0.0])
    assert rod_crossings(model, T, settings).visible.sum() >= len(model) - 2
    for seed in range(5):
        T = start_pose("random", model, settings, AXIAL, np.random.default_rng(seed))
        assert is_pose(T)
        assert rod_crossings(model, T, settings).visible.sum() >= 5
        if model.mount is not None:
            away = rotation_angle(T[:3, :3] @ model.mount.patient_from_model.T)
            assert math.degrees(away) <= model.mount.max_angle_deg + 1e-6


def test_a_frame_lying_down_is_stood_up() -> None:
    turned = RodModel(
        name="lying",
        rods=tuple(
            Rod(id=rod.id, start=rod.start[[2, 0, 1]], end=rod.end[[2, 0, 1]]) for rod in small_frame().rods
        ),
    )  # fmt: skip
    settings = bare()
    T = centred_pose(turned, settings, AXIAL)
    assert is_pose(T)
    assert rod_crossings(turned, T, settings).visible.all()


def test_a_mount_is_obeyed_in_an_oblique_slice() -> None:
    model = load_rod_model("leksell-g-3-panel")
    assert model.mount is not None
    R_patient_slice = parse_orientation("10,-5,3")
    T = centred_pose(model, suitable_settings(model), R_patient_slice)
    assert np.allclose(R_patient_slice @ T[:3, :3], model.mount.patient_from_model)


def test_a_pose_given_in_numbers_is_taken_as_it_is() -> None:
    T = start_pose("1,-2,3.5,0,0,0.6,0.8", small_frame(), bare(), AXIAL, np.random.default_rng(0))
    assert T[:3, 3] == pytest.approx([1, -2, 3.5])
    # a turn by 2 atan(0.6/0.8) about z takes x towards y
    assert T[:3, 0] == pytest.approx([0.28, 0.96, 0])
    turned = tilted(T, small_frame(), (0.0, 0.0, 90.0))
    assert turned[:3, 0] == pytest.approx([-0.96, 0.28, 0])


@pytest.mark.parametrize("text", ["axial", "coronal", "sagittal", "12,-7,33", "0.8,0.6,0,-0.6,0.8,0"])
def test_orientations_are_right_handed_rotations(text: str) -> None:
    R = parse_orientation(text)
    assert np.allclose(R @ R.T, np.eye(3))
    assert np.linalg.det(R) == pytest.approx(1)


def test_orientations_mean_what_dicom_means() -> None:
    assert np.allclose(parse_orientation("axial"), np.eye(3))
    # coronal: rows to the left (+x), columns to the feet (−z); sagittal: rows to the back (+y)
    assert np.allclose(parse_orientation("coronal")[:, 1], [0, 0, -1])
    assert np.allclose(parse_orientation("sagittal")[:, 0], [0, 1, 0])
    # turned about x alone: rows stay, columns tip towards +z
    tipped = parse_orientation("30,0,0")
    assert np.allclose(tipped[:, 0], [1, 0, 0])
    assert tipped[:, 1] == pytest.approx([0, math.cos(math.radians(30)), 0.5])


@pytest.mark.parametrize("text", ["upside", "1,2", "1,0,0,1,0,0", "2,0,0,0,1,0", "nan,0,0", "1,2,3,4"])
def test_orientations_that_are_none_are_refused(text: str) -> None:
    with pytest.raises(InputError, match="orientation"):
        parse_orientation(text)


@pytest.mark.parametrize("text", ["here", "1,2,3", "0,0,0,0,0,0,0", "0,0,0,1,1,1,1", "inf,0,0,0,0,0,1"])
def test_starts_that_are_none_are_refused(text: str) -> None:
    with pytest.raises(InputError, match="start"):
        start_pose(text, small_frame(), bare(), AXIAL, np.random.default_rng(0))


def test_a_tilt_that_is_none_is_refused() -> None:
    with pytest.raises(InputError, match="tilt"):
        tilted(np.eye(4), small_frame(), (math.nan, 0.0, 0.0))


def test_a_frame_no_random_pose_can_show_is_said_to_be_one() -> None:
    places = [(12 * math.cos(i), 12 * math.sin(i)) for i in range(6)]
    # stubs of two micrometres leave the slice at the least tilt
    stubs = tuple(
        Rod(id=str(i), start=np.array([x, y, -0.001]), end=np.array([x, y, 0.001])) for i, (x, y) in enumerate(places)
    )
    with pytest.raises(InputError, match="no random pose of stubs shows 6 rods"):
        start_pose("random", RodModel(name="stubs", rods=stubs), bare(), AXIAL, np.random.default_rng(0))
