"""Scales from unlabelled spots: right with a nominal scale, with a wrong one, and with none."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ctreg_cli.errors import CalibrationError
from ctreg_cli.imaging.slice import SliceInfo
from ctreg_cli.imaging.spot_slice import SpotSlice
from ctreg_cli.imaging.spots import Spots
from ctreg_cli.io.rod_file import load_rod_model
from ctreg_cli.registration.calibrate import calibrate
from ctreg_cli.scale import Scale
from tests.oracle import OracleFrame, OracleScene, cross_rod
from tests.registration.frames import frame_of, some_scene

CUBE = load_rod_model("rod-cube-30x30x40")
SAMPLES = Path(__file__).parents[2] / "sample_data"


def slices(rng: np.random.Generator, count: int, said: Scale | None, **options: object) -> list[SpotSlice]:
    frame: OracleFrame = frame_of(CUBE)
    worlds: list[OracleScene] = [
        some_scene(rng, frame, mm_per_px=(0.47, 0.52), least=7, **options) for _ in range(count)
    ]
    return [
        SpotSlice(info=SliceInfo(source="oracle", scale=said), spots=Spots.from_points(w.uv_px, w.sd_px))
        for w in worlds
    ]


@pytest.mark.parametrize(
    ("said", "count"),
    [(Scale(s_x=0.47, s_y=0.52), 1), (Scale(s_x=0.475, s_y=0.517), 4), (Scale(s_x=0.6, s_y=0.6), 2), (None, 2)],
    ids=["nominal", "nominal a percent off", "nominal wrong", "none"],
)
def test_scales_come_out_whatever_is_said(said: Scale | None, count: int) -> None:
    rng = np.random.default_rng([921, count])
    found = calibrate(slices(rng, count, said, sd_px=0.05, false=2), CUBE).calibration
    assert abs(found.scale.s_x - 0.47) < 4 * found.sd_s_x
    assert abs(found.scale.s_y - 0.52) < 4 * found.sd_s_y
    assert found.sd_s_x < 0.003
    assert found.n_slices == count
    assert found.nominal == said


def test_more_slices_know_more() -> None:
    rng = np.random.default_rng(922)
    made = slices(rng, 6, Scale(s_x=0.47, s_y=0.52), sd_px=0.05)
    one, six = calibrate(made[:1], CUBE).calibration, calibrate(made, CUBE).calibration
    assert six.sd_s_x < one.sd_s_x
    assert six.sd_s_y < one.sd_s_y


def test_clutter_has_no_scale() -> None:
    rng = np.random.default_rng(923)
    uv = 250 + rng.uniform(-60, 60, (5, 2))
    item = SpotSlice(info=SliceInfo(source="oracle", scale=Scale(s_x=0.5, s_y=0.5)), spots=Spots.from_points(uv, 0.05))
    with pytest.raises(CalibrationError, match="no scale between"):
        calibrate([item], CUBE)


def test_too_few_spots_are_named() -> None:
    item = SpotSlice(info=SliceInfo(source="oracle"), spots=Spots.from_points(np.ones((3, 2)), 0.05))
    with pytest.raises(CalibrationError, match="5 spots"):
        calibrate([item], CUBE)


def test_slices_of_two_reconstructions_are_refused() -> None:
    rng = np.random.default_rng(924)
    made = [
        *slices(rng, 1, Scale(s_x=0.47, s_y=0.52), sd_px=0.05),
        *slices(rng, 1, Scale(s_x=0.4, s_y=0.4), sd_px=0.05),
    ]
    with pytest.raises(CalibrationError, match="different PixelSpacings"):
        calibrate(made, CUBE)


def test_the_sample_series_has_the_scale_of_its_truth() -> None:
    truth = json.loads((SAMPLES / "calib" / "truth.json").read_text())
    rng = np.random.default_rng(925)
    made = []
    for entry in truth:
        uv = np.array([[s["u_px"], s["v_px"]] for s in entry["spots"]])
        made.append(
            SpotSlice(
                info=SliceInfo(source=entry["file"], scale=Scale(s_x=0.488, s_y=0.488)),
                spots=Spots.from_points(uv + rng.normal(size=uv.shape) * 0.03, 0.03),
            )
        )
    found = calibrate(made, CUBE).calibration
    assert found.scale.s_x == pytest.approx(truth[0]["s_x_mm"], rel=0.003)
    assert found.scale.s_y == pytest.approx(truth[0]["s_y_mm"], rel=0.003)


@pytest.mark.parametrize("seed", range(4))
def test_rods_that_lean_do_not_pull_at_the_scales(seed: int) -> None:
    """Each end of a real box's rods lies off by the tolerance: sharp spots show it, and it is no scale."""
    rng = np.random.default_rng([925, seed])
    model = load_rod_model("leksell-g-3-panel")
    assert model.mount is not None
    s = np.array([0.62, 0.63])
    off = rng.normal(size=(2, len(model), 3)) * model.tolerances[:, None]
    starts, ends = model.starts + off[0], model.ends + off[1]
    tilt = Rotation.from_rotvec(rng.normal(size=3) * 0.04).as_matrix()
    R = tilt @ np.array(model.mount.patient_from_model)
    made = []
    for height in np.linspace(-45, 45, 10):
        t = np.array([160.0, 160.0, height]) - R @ model.centre
        hits = [cross_rod(a, b, R, t) for a, b in zip(starts, ends, strict=True)]
        uv = np.array([hit[0] for hit in hits if hit is not None]) / s
        uv = uv + rng.normal(size=uv.shape) * 0.03
        info = SliceInfo(source="oracle", scale=Scale(s_x=0.625, s_y=0.625))
        made.append(SpotSlice(info=info, spots=Spots.from_points(uv, 0.03)))
    found = calibrate(made, model).calibration
    assert found.n_slices == len(made)
    assert abs(found.scale.s_x - s[0]) < 3.5 * found.sd_s_x, (seed, found)
    assert abs(found.scale.s_y - s[1]) < 3.5 * found.sd_s_y, (seed, found)
    assert max(found.sd_s_x, found.sd_s_y) < 0.003
