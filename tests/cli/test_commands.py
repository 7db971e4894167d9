"""The commands from end to end: right numbers, chained stages, formats that agree, scales in their order."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import Image
from typer.testing import CliRunner

from ctreg_cli import pipeline
from ctreg_cli.cli.app import app
from ctreg_cli.cli.run import ScaleChoice
from ctreg_cli.geometry.pose import rotation_angle
from ctreg_cli.imaging.segmentation import DEFAULT_OPTIONS, SegmentationOptions, find_spots
from ctreg_cli.imaging.slice import Slice, SliceInfo
from ctreg_cli.imaging.spots import Spots
from ctreg_cli.io.results import PoseRow, read_results
from ctreg_cli.io.spots_file import read_spots
from ctreg_cli.scale import Scale
from tests.cli.conftest import FRAME, SAMPLES, run_ctreg

#: 0.05 px spots on this cube bound a pose to about 0.2° and 0.05 mm; this is far outside, and far inside a wrong pose
FAR_DEG, FAR_MM = 1.5, 0.5


def rows_of(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def assert_near_truth(row: PoseRow, truth: dict[str, dict[str, Any]]) -> None:
    wanted = truth[row.source]["T_slice_model"]
    assert row.T_slice_model is not None
    assert np.degrees(rotation_angle(row.T_slice_model[:3, :3] @ wanted[:3, :3].T)) < FAR_DEG
    assert np.linalg.norm(row.T_slice_model[:3, 3] - wanted[:3, 3]) < FAR_MM


def test_segment_finds_every_rod(two_slices: Path, truth: dict[str, dict[str, Any]], tmp_path: Path) -> None:
    run_ctreg("segment", two_slices, "-o", tmp_path / "s.csv", "-o", tmp_path / "s.json")
    for spot_slice in read_spots(tmp_path / "s.csv"):
        for spot in truth[spot_slice.info.source]["spots"]:
            distance = np.linalg.norm(spot_slice.spots.uv_px - [spot["u_px"], spot["v_px"]], axis=1)
            assert distance.min() < 0.5
    for table, document in zip(read_spots(tmp_path / "s.csv"), read_spots(tmp_path / "s.json"), strict=True):
        np.testing.assert_array_equal(table.spots.uv_px, document.spots.uv_px)
        assert document.info.T_patient_slice is not None


@pytest.mark.parametrize("command", ["segment", "calibrate", "pose", "track", "model refine"])
def test_commands_that_know_the_frame_expect_its_rods(
    command: str, two_slices: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All the sample frame's rods are 1 mm thick."""
    expected = set()

    def find(slice_: Slice, options: SegmentationOptions = DEFAULT_OPTIONS) -> Spots:
        expected.add(options.rod_diameter_mm)
        return find_spots(slice_, options)

    monkeypatch.setattr(pipeline, "find_spots", find)
    out = tmp_path / ("out.csv" if command in ("segment", "pose", "track") else "out.yaml")
    # two slices do not determine the rods: what becomes of them is another test's business
    CliRunner().invoke(app, [*command.split(), str(two_slices), "-m", FRAME, "-o", str(out)])
    assert expected == {(1.0, 1.0)}


def test_pose_is_the_true_pose(two_slices: Path, truth: dict[str, dict[str, Any]], tmp_path: Path) -> None:
    run_ctreg("pose", two_slices, "-m", FRAME, "-o", tmp_path / "p.csv")
    rows = read_results(tmp_path / "p.csv")
    assert [(row.index, row.status) for row in rows] == [(0, "ok"), (1, "ok")]
    for row in rows:
        assert_near_truth(row, truth)


def test_track_follows_the_frame(truth: dict[str, dict[str, Any]], tmp_path: Path) -> None:
    for jacobian in ("updated", "constant"):
        run_ctreg("track", SAMPLES / "track", "-m", FRAME, "--jacobian", jacobian, "-o", tmp_path / "t.csv")
        rows = read_results(tmp_path / "t.csv")
        assert [row.index for row in rows] == list(range(16))
        assert {row.status for row in rows} == {"ok"}
        assert rows[0].cells["method"] == "registered"
        assert jacobian in {row.cells["method"] for row in rows}
        for row in rows:
            assert_near_truth(row, truth)


@pytest.mark.parametrize("suffix", [".csv", ".json", ".jsonl"])
def test_stages_chain(two_slices: Path, tmp_path: Path, suffix: str) -> None:
    direct, chained = tmp_path / "direct.json", tmp_path / "chained.json"
    run_ctreg("pose", two_slices, "-m", FRAME, "-o", direct)
    run_ctreg("segment", two_slices, "-o", tmp_path / f"s{suffix}")
    run_ctreg("pose", tmp_path / f"s{suffix}", "-m", FRAME, "-o", chained)
    first, second = (json.loads(path.read_text(encoding="utf-8")) for path in (direct, chained))
    assert (first["scale"]["from"], second["scale"]["from"]) == ("dicom", "spots")
    for one, other in zip(first["results"], second["results"], strict=True):
        assert (one["slice"], one["source"], one["status"]) == (other["slice"], other["source"], other["status"])
        np.testing.assert_allclose(one["T_patient_model"], other["T_patient_model"], rtol=1e-12)
        np.testing.assert_allclose(one["covariance"], other["covariance"], rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("orientation", ["-1,0,0,0,1,0", "-1,0,0,0,-1,0", "1,0,0,0,-1,0"])
def test_a_mount_is_the_patients_through_a_pipe_too(tmp_path: Path, orientation: str) -> None:
    """Of a patient feet first or prone; the frame has a twin that only the mount tells from it."""
    slices, frame = tmp_path / "scan", "leksell-g-3-panel"
    still = ("--frames", "1", "--motion", "still", "--tilt-deg", "4", "3", "2", "-q")
    run_ctreg("simulate", "-m", frame, "-o", slices, f"--orientation={orientation}", *still)
    run_ctreg("segment", slices, "-o", tmp_path / "s.csv", "-q")
    run_ctreg("pose", tmp_path / "s.csv", "-m", frame, "-o", tmp_path / "p.csv", "-q")
    (row,) = read_results(tmp_path / "p.csv")
    (true,) = read_results(slices / "truth.csv")
    assert row.status == "ok"
    assert row.T_slice_model is not None
    assert true.T_slice_model is not None
    # near by, and not half a turn off
    np.testing.assert_allclose(row.T_slice_model[:3, :3], true.T_slice_model[:3, :3], atol=0.05)


def test_standard_output_and_input_are_tables(two_slices: Path) -> None:
    spots = run_ctreg("segment", two_slices, "-q")
    assert spots.stderr == ""
    poses = run_ctreg("pose", "-", "-m", FRAME, stdin=spots.stdout)
    assert [row["status"] for row in rows_of(poses.stdout)] == ["ok", "ok"]
    assert "2 ok" in poses.stderr


def test_all_formats_at_once_say_the_same(spots_csv: Path, tmp_path: Path) -> None:
    outputs = [tmp_path / f"p{suffix}" for suffix in (".csv", ".json", ".jsonl")]
    arguments = [word for output in outputs for word in ("-o", output)]
    result = run_ctreg("pose", spots_csv, "-m", FRAME, *arguments, "-o", "-")
    table = read_results(outputs[0])
    document = json.loads(outputs[1].read_text(encoding="utf-8"))
    header, *lines = map(json.loads, outputs[2].read_text(encoding="utf-8").splitlines())
    assert document["results"] == lines
    assert {key: value for key, value in document.items() if key != "results"} == header
    assert result.stdout == outputs[0].read_text(encoding="utf-8")
    assert [float(row.cells["tx_mm"]) for row in table] == [line["tx_mm"] for line in lines]
    assert header["model"]["name"] == "rod-cube-30x30x40"
    assert header["options"]["registration"]["use_mount"] is True


def test_scale_option_before_calibration_before_dicom(two_slices: Path, tmp_path: Path) -> None:
    calibration = tmp_path / "c.yaml"
    result = run_ctreg("calibrate", SAMPLES / "calib", "-m", FRAME, "-o", calibration)
    assert "PixelSpacing 0.488281" in result.stderr
    found = yaml.safe_load(calibration.read_text(encoding="utf-8"))
    assert found["schema"] == "ctreg/calibration/1"
    assert abs(found["s_x_mm"] - 0.488299) < 5 * found["sd_s_x_mm"] + 1e-4

    def scale_of(*arguments: object) -> dict[str, Any]:
        path = tmp_path / "p.json"
        run_ctreg("pose", two_slices, "-m", FRAME, "-o", path, "-q", *arguments)
        scale: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))["scale"]
        return scale

    assert scale_of() == {"s_x_mm": 0.48828125, "s_y_mm": 0.48828125, "from": "dicom"}
    by_file = {"s_x_mm": found["s_x_mm"], "s_y_mm": found["s_y_mm"], "from": "calibration"}
    assert scale_of("-c", calibration) == by_file
    by_hand = {"s_x_mm": 0.488, "s_y_mm": 0.489, "from": "option"}
    assert scale_of("-c", calibration, "--scale", 0.488, 0.489) == by_hand


def test_a_calibration_with_another_frame_is_warned_of(spots_csv: Path, tmp_path: Path) -> None:
    calibration = tmp_path / "c.yaml"
    run_ctreg("calibrate", SAMPLES / "calib", "-m", FRAME, "-o", calibration, "-q")
    other = tmp_path / "other.yaml"
    other.write_text(Path(FRAME).read_text(encoding="utf-8") + "\n# another file\n", encoding="utf-8")
    assert "another frame file" in run_ctreg("pose", spots_csv, "-m", other, "-c", calibration).stderr
    assert "another frame file" not in run_ctreg("pose", spots_csv, "-m", FRAME, "-c", calibration).stderr


def test_a_scale_of_another_field_of_view_is_warned_of(spots_csv: Path, tmp_path: Path) -> None:
    calibration = tmp_path / "c.yaml"
    run_ctreg("calibrate", SAMPLES / "calib", "-m", FRAME, "-o", calibration, "-q")
    assert "field of view" not in run_ctreg("pose", spots_csv, "-m", FRAME, "-c", calibration).stderr
    text = calibration.read_text(encoding="utf-8")
    calibration.write_text(text.replace("0.48828125", "0.5"), encoding="utf-8")
    said = run_ctreg("pose", spots_csv, "-m", FRAME, "-c", calibration).stderr
    assert said.count("another field of view") == 1


@pytest.mark.parametrize(
    ("own", "stated", "tolerance", "doubtful"),
    [
        ((0.5, 0.5), (0.5, 0.5), 0.0, False),
        ((0.5, 0.5), (0.51, 0.5), 0.05, False),
        ((0.5, 0.4), (0.4, 0.5), 0.05, True),
    ],
)
def test_a_scale_is_doubted_when_slices_state_another(
    own: tuple[float, float], stated: tuple[float, float], tolerance: float, doubtful: bool
) -> None:
    scale = Scale(s_x=stated[0], s_y=stated[1])
    choice = ScaleChoice(scale=scale, origin="option", stated=scale, tolerance=tolerance)
    assert bool(choice.doubt(SliceInfo(source="s", scale=Scale(s_x=own[0], s_y=own[1])))) is doubtful
    assert not choice.doubt(SliceInfo(source="s"))


def test_calibrate_writes_yaml_to_standard_output() -> None:
    result = run_ctreg("calibrate", SAMPLES / "calib", "-m", FRAME, "-q")
    assert yaml.safe_load(result.stdout)["n_slices"] == 4
    assert result.stderr == ""


def test_spots_without_sd_are_given_one_and_it_is_said(truth: dict[str, dict[str, Any]], tmp_path: Path) -> None:
    bare = tmp_path / "bare.csv"
    spots = truth["track_000.dcm"]["spots"]
    bare.write_text(
        "slice,u_px,v_px\n" + "".join(f"3,{spot['u_px']},{spot['v_px']}\n" for spot in spots), encoding="utf-8"
    )
    scale = ("--scale", truth["track_000.dcm"]["s_x_mm"], truth["track_000.dcm"]["s_y_mm"])

    def pose_of(*arguments: object) -> dict[str, str]:
        (row,) = rows_of(run_ctreg("pose", bare, "-m", FRAME, *scale, *arguments).stdout)
        return row

    usual, worse = pose_of(), pose_of("--spot-sd", 0.5)
    assert usual["slice"] == "3"
    assert "assumed" in usual["warnings"]
    assert float(worse["sd_tx_mm"]) == pytest.approx(2 * float(usual["sd_tx_mm"]), rel=0.05)


def test_overlays_are_pictures(two_slices: Path, tmp_path: Path) -> None:
    for command in (["segment"], ["pose", "-m", FRAME], ["track", "-m", FRAME]):
        folder = tmp_path / command[0]
        run_ctreg(*command, two_slices, "--overlay", folder, "-q")
        assert sorted(path.name for path in folder.iterdir()) == ["slice_0000.png", "slice_0001.png"]
        with Image.open(folder / "slice_0000.png") as image:
            assert np.ptp(np.asarray(image.convert("L"))) > 100


def test_uids_only_when_asked_for(two_slices: Path, tmp_path: Path) -> None:
    for command in (["segment"], ["pose", "-m", FRAME]):
        run_ctreg(*command, two_slices, "-o", tmp_path / "without.json")
        run_ctreg(*command, two_slices, "-o", tmp_path / "with.json", "--with-uids")
        assert "uid" not in (tmp_path / "without.json").read_text(encoding="utf-8").lower()
        assert '"sop_instance": "' in (tmp_path / "with.json").read_text(encoding="utf-8")


def test_no_patient_text_gets_out(two_slices: Path, tmp_path: Path) -> None:
    """The sample slices carry the word in every patient field."""
    assert any(b"CANARY" in path.read_bytes() for path in two_slices.iterdir())
    heard = ""
    for command in (["segment"], ["pose", "-m", FRAME], ["track", "-m", FRAME]):
        outputs = [word for suffix in ("csv", "json", "jsonl") for word in ("-o", tmp_path / f"{command[0]}.{suffix}")]
        heard += run_ctreg(*command, two_slices, *outputs, "-v", "--with-uids").output
    heard += run_ctreg("calibrate", SAMPLES / "calib", "-m", FRAME, "-v").output
    heard += run_ctreg("info", two_slices).output
    written = b"".join(path.read_bytes() for path in tmp_path.iterdir())
    assert b"canary" not in written.lower()
    assert "canary" not in heard.lower()
