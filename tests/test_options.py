"""What a caller gives from Python is checked where it comes in: one error that names field, value and remedy."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ctreg_cli import (
    InputError,
    MissingScaleError,
    Mount,
    RegistrationOptions,
    RodModelError,
    Scale,
    SegmentationOptions,
    Slice,
    SliceInfo,
    Spots,
    SpotSlice,
    Target,
    Tracker,
    TrackingOptions,
    calibrate,
    load_rod_model,
    pose,
    read_slices,
    register,
    segment,
    track,
)

SAMPLES = Path(__file__).parents[1] / "sample_data"
FRAME = load_rod_model(SAMPLES / "frame.yaml")
UV = np.random.default_rng(0).uniform(0, 512, (8, 2))
WRONG_NUMBERS = [math.nan, math.inf, -1, 0, "1", True]


@pytest.mark.parametrize(
    ("kind", "field", "values"),
    [
        (RegistrationOptions, "integrity_risk", [*WRONG_NUMBERS, 1, None]),
        (RegistrationOptions, "alert_limit_mm", WRONG_NUMBERS),
        (TrackingOptions, "gain", [*WRONG_NUMBERS, 1.01, None]),
        (TrackingOptions, "jacobian", ["foo", None, 1]),
        (TrackingOptions, "prediction", ["foo", "", None]),
        (TrackingOptions, "registration", [None, TrackingOptions()]),
        (SegmentationOptions, "polarity", ["foo", None]),
        (SegmentationOptions, "rod_diameter_mm", [(3, 1), (0, 1), (1, math.nan), (1, 2, 3)]),
        (SegmentationOptions, "max_spots", [0, -1, 2.5]),
        (SegmentationOptions, "min_contrast_sd", [-1, math.nan]),
        (SegmentationOptions, "min_relative_contrast", [-0.1, 1.1, math.nan]),
        (SegmentationOptions, "max_tilt_deg", [90, -1, math.nan]),
        (Scale, "s_x", [*WRONG_NUMBERS, None]),
    ],
)
def test_a_wrong_option_is_named_with_its_value(kind: Callable[..., object], field: str, values: list[object]) -> None:
    others = {"s_y": 1.0} if kind is Scale else {}
    for value in values:
        with pytest.raises(InputError) as caught:
            kind(**{field: value}, **others)
        assert str(caught.value).startswith(f"{field}: {value!r}")
        assert "\n" not in str(caught.value)


def test_what_is_allowed_is_taken() -> None:
    for risk in (1e-12, np.float64(0.5), np.float32(0.1)):
        assert RegistrationOptions(integrity_risk=float(risk), alert_limit_mm=np.float64(2)).integrity_risk == risk
    for gain in (1, 0.1, np.float64(1.0)):
        assert TrackingOptions(gain=gain, jacobian="constant", prediction="identity").gain == gain
    assert Scale(s_x=1, s_y=np.float64(0.5)).mm_per_px.tolist() == [1.0, 0.5]


@pytest.mark.parametrize("scale", [(0.5, 0.5), 0.5, "0.5", np.array([0.5, 0.5])], ids=lambda s: type(s).__name__)
def test_a_scale_that_is_none_is_refused_everywhere(scale: Any) -> None:
    spots = Spots.from_points(UV)
    own = SpotSlice(info=SliceInfo(source="a", scale=scale), spots=spots)
    with_scale = SpotSlice(info=SliceInfo(source="a", scale=Scale(s_x=0.5, s_y=0.5)), spots=spots)
    for ask in (
        lambda: register(spots, FRAME, scale=scale),
        lambda: list(pose([with_scale], FRAME, scale=scale)),
        lambda: list(track([with_scale], FRAME, scale=scale)),
        lambda: list(pose(iter([own]), FRAME)),
        lambda: list(track(iter([own]), FRAME)),
        lambda: Tracker(FRAME).step(spots, with_scale.info, scale),
        lambda: Tracker(FRAME).follow(spots, with_scale.info, scale),
    ):
        with pytest.raises(InputError, match=r"scale: .*Scale\(s_x=\.\.\., s_y=\.\.\.\)"):
            ask()


def test_registering_without_a_scale_says_so() -> None:
    with pytest.raises(MissingScaleError, match=r"Scale\(s_x"):
        register(Spots.from_points(UV), FRAME, scale=None)  # type: ignore[arg-type]
    with pytest.raises(MissingScaleError, match=r"Scale\(s_x"):
        Tracker(FRAME).step(Spots.from_points(UV), SliceInfo(source="a"), None)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "covariance",
    [
        [[-1, 0], [0, -1]],
        [[1, 0.5], [0, 1]],
        [[1, 2], [2, 1]],
        [[0, 0], [0, 0]],
        [[math.nan, 0], [0, 1]],
        [[math.inf, 0], [0, 1]],
    ],
    ids=["negative", "asymmetric", "indefinite", "zero", "nan", "infinite"],
)
def test_a_spot_whose_covariance_is_none_is_named(covariance: list[list[float]]) -> None:
    covariances = np.tile(np.eye(2), (len(UV), 1, 1))
    covariances[3] = covariance
    with pytest.raises(InputError, match=r"covariance_px: spot 3 has \[\[.*from_points"):
        Spots(uv_px=UV, covariance_px=covariances)


def test_a_spot_without_a_place_is_named() -> None:
    for value in (math.nan, math.inf):
        uv = UV.copy()
        uv[5, 1] = value
        with pytest.raises(InputError, match=r"uv_px: spot 5 has the centre .*leave the spot out"):
            Spots.from_points(uv)
    for sd in (0, -1, math.nan):
        with pytest.raises(InputError, match=r"sd_px: .*positive"):
            Spots.from_points(UV, sd)


def test_some_of_the_spots_are_what_they_were() -> None:
    spots = Spots.from_points(UV, 0.1)
    some = spots.take(np.array([3, 1]))
    assert some.sd_assumed
    np.testing.assert_array_equal(some.uv_px, UV[[3, 1]])
    np.testing.assert_array_equal(some.sd_px, np.full((2, 2), 0.1))
    assert not some.uv_px.flags.writeable
    assert len(spots.take(np.zeros(len(spots), dtype=bool))) == 0


def test_a_frame_made_in_memory_is_held_to_what_a_file_is() -> None:
    first, *others = FRAME.rods
    for change, words in (
        ({"tolerance_mm": -1}, "rod r1: tolerance_mm: -1"),
        ({"tolerance_mm": math.nan}, "rod r1: tolerance_mm: nan"),
        ({"diameter_mm": 0}, "rod r1: diameter_mm: 0"),
    ):
        with pytest.raises(RodModelError, match=words):
            replace(FRAME, rods=(replace(first, **change), *others))
    for point in ([0, 0, math.nan], [0, 0]):
        with pytest.raises(RodModelError, match=r"target tip: .*three finite"):
            replace(FRAME, targets=(Target(id="tip", point=np.array(point)),))
    with pytest.raises(RodModelError, match="target ids must differ"):
        replace(FRAME, targets=2 * (Target(id="tip", point=np.zeros(3)),))
    for R in (np.ones((3, 3)), np.diag([1, 1, -1]), np.eye(2), np.full((3, 3), math.nan)):
        with pytest.raises(RodModelError, match=r"patient_from_model: .*rotation"):
            Mount(patient_from_model=R)
    for angle in (0, -1, 181, math.nan):
        with pytest.raises(RodModelError, match="max_angle_deg"):
            Mount(patient_from_model=np.eye(3), max_angle_deg=angle)


@pytest.mark.parametrize(
    "change",
    [
        {"stored": np.zeros((4, 4, 4))},
        {"stored": np.zeros((0, 4))},
        {"stored": [[1, 2], [3, 4]]},
        {"stored": np.zeros((4, 4), dtype=complex)},
        {"slope": 0},
        {"slope": math.nan},
        {"intercept": math.inf},
    ],
    ids=str,
)
def test_an_image_that_is_none_is_refused(change: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=next(iter(change))):
        Slice(**{"info": SliceInfo(source="a"), "stored": np.zeros((4, 4)), **change})


def test_calibrate_takes_a_stream_of_spots_and_no_images() -> None:
    images = read_slices(SAMPLES / "calib")
    found = segment(images, SegmentationOptions())
    run = calibrate(found, FRAME)
    assert run.calibration.n_slices == len(images)
    with pytest.raises(InputError, match=r"slices\[0\]: 'Slice' .*segment"):
        calibrate(images, FRAME)  # type: ignore[arg-type]
