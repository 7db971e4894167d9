"""Calibration files: the round trip, what may be left out, and how mistakes are told."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ctreg_cli.errors import CalibrationFileError, InputError
from ctreg_cli.io.calibration_file import calibration_to_yaml, load_calibration, save_calibration
from ctreg_cli.registration.calibrate import Calibration
from ctreg_cli.scale import Scale

positive = st.floats(1e-9, 1e6, allow_subnormal=False)
scales = st.builds(Scale, s_x=positive, s_y=positive)
calibrations = st.builds(
    Calibration,
    scale=scales,
    sd_s_x=st.floats(0, 1),
    sd_s_y=st.floats(0, 1),
    n_slices=st.integers(0, 10**9),
    n_spots=st.integers(0, 10**9),
    rms_px=st.floats(0, 100),
    nominal=st.none() | scales,
    model_name=st.sampled_from(["rod-cube-30x30x40", "no", "012", "1e3", "Würfel: #5", "null"]),
    model_sha256=st.just("") | st.text("0123456789abcdef", min_size=64, max_size=64) | st.just("1e" + "0" * 62),
)

TEXT = calibration_to_yaml(
    Calibration(
        scale=Scale(s_x=0.488, s_y=0.49),
        sd_s_x=1e-5,
        sd_s_y=2e-5,
        n_slices=4,
        n_spots=30,
        rms_px=0.08,
        nominal=Scale(s_x=0.4881, s_y=0.4882),
        model_name="cube",
        model_sha256="ab" * 32,
    )
)


@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(calibration=calibrations)
def test_what_is_saved_is_loaded_to_the_last_bit(tmp_path: Path, calibration: Calibration) -> None:
    path = tmp_path / "calibration.yaml"
    save_calibration(calibration, path)
    assert load_calibration(path) == calibration


def test_keys_are_those_of_the_interface() -> None:
    """By an ordinary YAML reader, as another program would."""
    content = yaml.safe_load(TEXT)
    assert content == {
        "schema": "ctreg/calibration/1",
        "s_x_mm": 0.488,
        "s_y_mm": 0.49,
        "sd_s_x_mm": 1e-5,
        "sd_s_y_mm": 2e-5,
        "n_slices": 4,
        "n_spots": 30,
        "rms_px": 0.08,
        "nominal": {"s_x_mm": 0.4881, "s_y_mm": 0.4882},
        "model": {"name": "cube", "sha256": "ab" * 32},
    }


def test_nominal_may_be_null_or_left_out(tmp_path: Path) -> None:
    content = yaml.safe_load(TEXT)
    path = tmp_path / "calibration.yaml"
    for change in ({"nominal": None}, {}):
        path.write_text(yaml.safe_dump({**{k: v for k, v in content.items() if k != "nominal"}, **change}))
        assert load_calibration(path).nominal is None


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("s_x_mm: 0.488", "s_x_mm: -0.488", "2:9: s_x_mm: -0.488 is out of range; it must be more than 0"),
        ("s_x_mm: 0.488", "s_x_mm: 0,488", "2:9: s_x_mm: '0,488' is not a number"),
        ("s_x_mm: 0.488", "s_x_mm: .inf", "2:9: s_x_mm: .inf is not a finite number"),
        ("s_x_mm: 0.488", "sx_mm: 0.488", "2:1: sx_mm: unknown key; did you mean s_x_mm?"),
        ("s_x_mm: 0.488\n", "", "1:1: s_x_mm: is missing"),
        ("n_slices: 4", "n_slices: 4.5", "6:11: n_slices: 4.5 is not a whole number"),
        ("n_slices: 4", "n_slices: -4", "6:11: n_slices: -4 is out of range"),
        (
            "calibration/1",
            "calibration/9",
            "1:9: schema: 'ctreg/calibration/9' is not allowed; write 'ctreg/calibration/1'",
        ),
        ("  s_y_mm: 0.4882\n", "", "10:3: nominal.s_y_mm: is missing"),
        ("  name: cube\n", "", "13:3: model.name: is missing"),
        (TEXT, "", "is empty"),
    ],
)
def test_each_mistake_is_named_with_its_place(tmp_path: Path, old: str, new: str, says: str) -> None:
    assert old in TEXT
    path = tmp_path / "calibration.yaml"
    path.write_text(TEXT.replace(old, new, 1))
    with pytest.raises(CalibrationFileError) as caught:
        load_calibration(path)
    assert says in str(caught.value)
    assert str(path) in str(caught.value)


def test_a_frame_file_in_its_place_says_so(tmp_path: Path) -> None:
    path = tmp_path / "frame.yaml"
    path.write_text("schema: ctreg/frame/1\nname: x\nrods: []\n")
    with pytest.raises(CalibrationFileError) as caught:
        load_calibration(path)
    assert str(caught.value) == (
        f"{path}:1:9: schema: this is a frame file, but a calibration file ('ctreg/calibration/1') is needed here"
    )


def test_missing_files_and_folders(tmp_path: Path) -> None:
    with pytest.raises(CalibrationFileError, match="no such file"):
        load_calibration(tmp_path / "none.yaml")
    path = tmp_path / "calibration.yaml"
    path.write_text(TEXT)
    with pytest.raises(InputError, match="does not exist"):
        save_calibration(load_calibration(path), tmp_path / "no" / "where.yaml")
