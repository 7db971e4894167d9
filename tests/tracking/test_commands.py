"""``ctreg track`` and ``ctreg servo`` from end to end: columns, trajectories, smoothed motion, figures, mistakes."""

from __future__ import annotations

import csv
import json
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from ctreg_cli.cli.app import app
from ctreg_cli.geometry.pose import from_quaternion
from ctreg_cli.io.results import read_results
from ctreg_cli.io.rod_file import load_rod_model
from tests.tracking.sequences import Sequence, error_of, sequence

RUNNER = CliRunner()
CUBE = "rod-cube-30x30x40"


def ctreg(*arguments: str, code: int = 0) -> str:
    result = RUNNER.invoke(app, list(arguments))
    assert result.exit_code == code, result.output
    return result.output


def table(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text().splitlines()))


@pytest.fixture(scope="module")
def moving(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Sequence]:
    """A spots file of the breathing cube."""
    made = sequence(
        3, kind="breathing", n=20, model=load_rod_model(CUBE), sd_px=0.05, p_missing=0.0, most_false=1, interval_s=0.25
    )
    path = tmp_path_factory.mktemp("moving") / "spots.csv"
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["slice", "time_s", "s_x_mm", "s_y_mm", "u_px", "v_px", "sd_u_px", "sd_v_px"])
        for i, item in enumerate(made.slices):
            for u, v in item.spots.uv_px:
                writer.writerow([i, item.info.time_s, 0.5, 0.5, u, v, 0.05, 0.05])
    return path, made


def test_velocities_missing_and_false_spots_are_columns(moving: tuple[Path, Sequence], tmp_path: Path) -> None:
    spots, made = moving
    ctreg("track", str(spots), "-m", CUBE, "-o", str(tmp_path / "track.csv"), "-q")
    rows = table(tmp_path / "track.csv")
    assert all(row["status"] == "ok" for row in rows)
    assert rows[0]["vx_mm_s"] == ""
    for row, item, true in zip(rows[1:], made.slices[1:], made.truth[1:], strict=True):
        assert float(row["sd_vz_mm_s"]) > 0
        assert float(row["sd_wx_deg_s"]) > 0
        assert int(row["n_missing"]) == 0
        assert int(row["n_false"]) == len(item.spots) - len(true.rods)
    speeds = [float(row["vz_mm_s"]) for row in rows[3:-1]]
    moved = np.gradient([float(row["tz_mm"]) for row in rows], 0.25)[3:-1]
    assert np.corrcoef(speeds, moved)[0, 1] > 0.8


def test_tum_trajectory_holds_the_poses_of_the_table_in_metres(moving: tuple[Path, Sequence], tmp_path: Path) -> None:
    spots, _ = moving
    ctreg("track", str(spots), "-m", CUBE, "-o", str(tmp_path / "t.csv"), "-o", str(tmp_path / "t.tum"), "-q")
    lines = (tmp_path / "t.tum").read_text().splitlines()
    assert lines[0].startswith("#")
    table = read_results(tmp_path / "t.csv")
    assert len(lines) - 1 == len(table)
    for line, row in zip(lines[1:], table, strict=True):
        time, *pose = (float(word) for word in line.split())
        assert time == pytest.approx(row.time_s)
        T = from_quaternion(np.array(pose[3:]), 1e3 * np.array(pose[:3]))
        assert row.T_slice_model is not None
        np.testing.assert_allclose(T, row.T_slice_model, atol=1e-6)


@pytest.mark.parametrize("timeless", [{0, 1}, {5}, {0, 1, 7, 19}, set(range(20)), set()], ids=len)
def test_seconds_and_slice_numbers_never_mix_in_a_trajectory(
    moving: tuple[Path, Sequence], tmp_path: Path, timeless: set[int]
) -> None:
    header, *rows = (line.split(",") for line in moving[0].read_text().splitlines())
    spots = tmp_path / "spots.csv"
    later = [[n, "" if int(n) in timeless else str(100 + 0.25 * int(n)), *rest] for n, _, *rest in rows]
    spots.write_text("".join(f"{','.join(row)}\n" for row in [header, *later]))
    ctreg("pose", str(spots), "-m", CUBE, "-o", str(tmp_path / "t.tum"), "-o", str(tmp_path / "t.json"), "-q")
    ctreg("export", str(tmp_path / "t.json"), "-o", str(tmp_path / "again.tum"), "--coordinates", "slice", "-q")
    trajectory, again = np.loadtxt(tmp_path / "t.tum"), np.loadtxt(tmp_path / "again.tum")
    times = [100 + 0.25 * n for n in range(20) if n not in timeless] or list(range(20))
    np.testing.assert_allclose(trajectory[:, 0], times)
    np.testing.assert_allclose(trajectory, again, atol=1e-6)
    assert ("stands for the second" in (tmp_path / "t.tum").read_text()) == (len(timeless) == 20)


def test_what_a_pipe_has_taken_is_not_taken_back(moving: tuple[Path, Sequence], tmp_path: Path) -> None:
    header, *rows = (line.split(",") for line in moving[0].read_text().splitlines())
    spots, pipe = tmp_path / "spots.csv", tmp_path / "pipe.tum"
    later = [[n, "" if int(n) < 3 else n, *rest] for n, _, *rest in rows]
    spots.write_text("".join(f"{','.join(row)}\n" for row in [header, *later]))
    os.mkfifo(pipe)
    with ThreadPoolExecutor() as reader:
        read = reader.submit(pipe.read_text)
        ctreg("pose", str(spots), "-m", CUBE, "-o", str(pipe), "-q")
        lines = read.result(timeout=60).splitlines()
    assert [float(line.split()[0]) for line in lines if not line.startswith("#")] == list(range(20))


def test_smoothed_motion_is_nearer_to_the_truth(moving: tuple[Path, Sequence], tmp_path: Path) -> None:
    spots, made = moving
    ctreg("track", str(spots), "-m", CUBE, "-o", str(tmp_path / "a.csv"), "--smooth", str(tmp_path / "b.csv"), "-q")
    squares = []
    for name in ("a.csv", "b.csv"):
        rows = read_results(tmp_path / name)
        each = [
            error_of(r.T_slice_model, t) for r, t in zip(rows, made.truth, strict=True) if r.T_slice_model is not None
        ]
        assert len(each) == len(rows)
        squares.append(np.mean(np.square(each), axis=0))
    assert (squares[1] < squares[0]).sum() >= 5
    assert {row.cells["method"] for row in read_results(tmp_path / "b.csv")} == {"smoothed"}


@pytest.mark.parametrize("sure", [0, 1, 9])
def test_a_sequence_without_a_motion_is_smoothed_to_itself(
    moving: tuple[Path, Sequence], tmp_path: Path, sure: int
) -> None:
    header, *rows = moving[0].read_text().splitlines()
    kept = [row if int(row.split(",")[0]) < sure else ",".join([*row.split(",")[:4], *4 * [""]]) for row in rows]
    spots = tmp_path / "spots.csv"
    spots.write_text("\n".join([header, *dict.fromkeys(kept)]) + "\n")
    a, b = tmp_path / "a.csv", tmp_path / "b.csv"
    ctreg("track", str(spots), "-m", CUBE, "-o", str(a), "--smooth", str(b), "-q", code=0 if sure else 1)
    columns = ["slice", "status", "reason", "tx_mm", "qw", "sd_tx_mm"]
    assert [[r[c] for c in columns] for r in table(b)] == [[r[c] for c in columns] for r in table(a)]
    assert sum(r["status"] == "ok" for r in table(b)) == sure


def test_smoothed_motion_never_replaces_another_output(moving: tuple[Path, Sequence], tmp_path: Path) -> None:
    spots, _ = moving
    same = str(tmp_path / "same.csv")
    assert "twice" in ctreg("track", str(spots), "-m", CUBE, "-o", same, "--smooth", same, code=2)
    assert "is an input" in ctreg("track", str(spots), "-m", CUBE, "--smooth", str(spots), code=2)


def test_spots_have_no_trajectory(moving: tuple[Path, Sequence], tmp_path: Path) -> None:
    spots, _ = moving
    assert "trajectory" in ctreg("segment", str(spots), "-o", str(tmp_path / "no.tum"), code=2)
    assert not (tmp_path / "no.tum").exists()


def test_servo_writes_every_iteration(tmp_path: Path) -> None:
    out = tmp_path / "servo.csv"
    ctreg("servo", "-m", CUBE, "--iterations", "30", "--noise", "0.5", "--runs", "2", "-o", str(out), "-q")
    rows = table(out)
    assert len(rows) == 2 * 2 * 31
    assert {row["jacobian"] for row in rows} == {"updated", "constant"}
    first = [row for row in rows if row["run"] == "0" and row["jacobian"] == "updated"]
    rms = [float(row["rms_px"]) for row in first]
    assert rms == sorted(rms, reverse=True)
    assert float(first[0]["angle_sum_deg"]) == pytest.approx(28.0)
    ctreg("servo", "-m", CUBE, "--iterations", "3", "-o", str(tmp_path / "servo.json"), "-q")
    document = json.loads((tmp_path / "servo.json").read_text())
    assert document["schema"] == "ctreg/servo/1"
    assert len(document["iterations"]) == 2 * 4


def test_servo_goes_from_the_pose_given_to_the_pose_given(tmp_path: Path) -> None:
    out = tmp_path / "servo.csv"
    start, end = "120,125,1,0.02,0.05,0.1,0.993428", "125,125,0,0,0,0,1"
    ctreg("servo", "-m", CUBE, "--from", start, "--to", end, "--gain", "0.5", "-o", str(out), "-q")
    rows = [row for row in table(out) if row["jacobian"] == "updated"]
    assert float(rows[0]["tx_mm"]) == 120.0
    assert float(rows[-1]["tx_mm"]) == pytest.approx(125.0, abs=1e-6)
    assert float(rows[-1]["qw"]) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--to", "1,2,3"), "--to: '1,2,3' is neither"),
        (("--from", "1,2,nan,0,0,0,1"), "--from: '1,2,nan,0,0,0,1' is neither"),
        (("--from", "1,2,3,0,0,0,0"), "--from: '1,2,3,0,0,0,0': the quaternion"),
        (("--from", "1e9,2,3,0,0,0,1"), "--from: '1e9,2,3,0,0,0,1': TX,TY,TZ are millimetres"),
        (("--from", "125,125,900,0,0,0,1"), "of the same rods"),
        (("--scale", "0", "1"), "--scale 0 1: s_x: 0 is no scale"),
        (("--scale", "1", "1e300"), "--scale 1 1e+300: s_y: 1e+300 is no scale"),
        (("--noise", "inf"), "--noise"),
        (("--figure", "path.gif"), ".png, .svg"),
        (("--gain", "1.5"), "0 < G <= 1"),
        (("-o", "path.tum"), "trajectory"),
    ],
)
def test_servo_says_what_is_wrong(arguments: tuple[str, ...], words: str, tmp_path: Path) -> None:
    arguments = tuple(str(tmp_path / a) if a.startswith("path.") else a for a in arguments)
    result = RUNNER.invoke(app, ["servo", "-m", CUBE, *arguments])
    assert result.exit_code == 2
    assert words in " ".join(result.output.split())
    assert "Traceback" not in result.output
    assert list(tmp_path.iterdir()) == []


def test_servo_figures_are_drawn_and_repeat(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="extra report is not installed")
    names = [str(tmp_path / name) for name in ("a.png", "a.svg", "b.svg")]
    figures = [word for name in names for word in ("--figure", name)]
    ctreg("servo", "-m", CUBE, "--iterations", "5", "-o", str(tmp_path / "s.csv"), "-q", *figures)
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
    assert b"<svg" in (tmp_path / "a.svg").read_bytes()
