"""When things go wrong: the contract's exit codes, one clear message, and no output half written."""

from __future__ import annotations

import csv
import io
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import ctreg_cli
from ctreg_cli.io.results import read_results
from ctreg_cli.io.spots_file import read_spots
from tests.cli.conftest import FRAME, SAMPLES, run_ctreg


@pytest.fixture
def a_broken_one(two_slices: Path, tmp_path: Path) -> Path:
    """Two good slices and one whose pixels end too early."""
    folder = tmp_path / "broken"
    shutil.copytree(two_slices, folder)
    content = (SAMPLES / "track" / "track_002.dcm").read_bytes()
    (folder / "track_002.dcm").write_bytes(content[: len(content) // 2])
    return folder


@pytest.fixture
def bare_spots(tmp_path: Path) -> Path:
    path = tmp_path / "bare.csv"
    rng = np.random.default_rng(3)
    rows = "".join(f"0,{u},{v}\n" for u, v in rng.uniform(0, 512, (4, 2)))
    path.write_text(f"slice,u_px,v_px\n{rows}", encoding="utf-8")
    return path


def assert_refused(*arguments: object, say: str) -> None:
    """Exit code 2 and one message; nothing on standard output."""
    result = run_ctreg(*arguments, code=2)
    assert result.stdout == ""
    assert say in result.stderr.replace("\n", " ")
    assert "Traceback" not in result.stderr


def test_a_broken_slice_is_a_row_and_one_warning(a_broken_one: Path, tmp_path: Path) -> None:
    result = run_ctreg("pose", a_broken_one, "-m", FRAME, "-o", tmp_path / "p.csv")
    rows = read_results(tmp_path / "p.csv")
    assert [(row.status, row.reason) for row in rows].count(("no_pose", "unreadable")) == 1
    assert [row.status for row in rows].count("ok") == 2
    assert result.stderr.count("track_002.dcm: Pixel Data (7FE0,0010)") == 1
    run_ctreg("pose", a_broken_one, "-m", FRAME, "-q", "--strict", code=1)


def test_a_broken_slice_stays_one_through_the_chain(a_broken_one: Path) -> None:
    spots = run_ctreg("segment", a_broken_one, "-q").stdout
    result = run_ctreg("pose", "-", "-m", FRAME, "-q", stdin=spots)
    assert [row["reason"] for row in csv.DictReader(io.StringIO(result.stdout))].count("unreadable") == 1
    run_ctreg("segment", a_broken_one, "-q", "--strict", code=1)


def test_no_pose_at_all_is_exit_code_1_with_the_results_written(bare_spots: Path, tmp_path: Path) -> None:
    run_ctreg("pose", bare_spots, "-m", FRAME, "--scale", 0.5, 0.5, "-o", tmp_path / "p.csv", code=1)
    (row,) = read_results(tmp_path / "p.csv")
    assert (row.status, row.T_slice_model) == ("no_pose", None)


def test_calibration_without_an_answer_is_exit_code_1(bare_spots: Path, tmp_path: Path) -> None:
    result = run_ctreg("calibrate", bare_spots, "-m", FRAME, "-o", tmp_path / "c.yaml", code=1)
    assert result.stderr.splitlines()[-1].startswith("ctreg: error: ")
    assert list(tmp_path.iterdir()) == [bare_spots]


@pytest.mark.parametrize("command", ["pose", "track"])
@pytest.mark.parametrize("suffix", [".csv", ".json", ".jsonl"])
def test_a_missing_scale_names_the_remedies(bare_spots: Path, tmp_path: Path, command: str, suffix: str) -> None:
    output = tmp_path / f"p{suffix}"
    assert_refused(command, bare_spots, "-m", FRAME, "-o", output, say="--scale SX SY")
    assert_refused(command, bare_spots, "-m", FRAME, say="-c CALIBRATION")
    assert list(tmp_path.iterdir()) == [bare_spots]


@pytest.mark.parametrize("command", ["pose", "track"])
def test_one_slice_without_scale_is_a_row_even_if_it_is_the_first(
    spots_csv: Path, tmp_path: Path, command: str
) -> None:
    header, *rows = csv.reader(io.StringIO(spots_csv.read_text(encoding="utf-8")))
    where = [header.index(name) for name in ("s_x_mm", "s_y_mm")]
    bare = [["" if row[0] == "0" and place in where else cell for place, cell in enumerate(row)] for row in rows]
    (tmp_path / "spots.csv").write_text("".join(f"{','.join(row)}\n" for row in [header, *bare]), encoding="utf-8")
    run_ctreg(command, tmp_path / "spots.csv", "-m", FRAME, "-o", tmp_path / "p.csv")
    found = read_results(tmp_path / "p.csv")
    assert [(row.status, row.reason) for row in found] == [("no_pose", "no_scale"), ("ok", "")]
    run_ctreg(command, tmp_path / "spots.csv", "-m", FRAME, "-q", "--strict", code=1)


def test_a_spots_table_without_scale_names_itself_and_its_columns(bare_spots: Path) -> None:
    assert_refused("pose", bare_spots, "-m", FRAME, say=f"{bare_spots}: columns s_x_mm, s_y_mm: no pixel scale")
    result = run_ctreg("track", "-", "-m", FRAME, stdin=bare_spots.read_text(encoding="utf-8"), code=2)
    assert "standard input: columns s_x_mm" in result.stderr


def test_an_image_without_scale_is_the_same(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    Image.fromarray(rng.integers(0, 50, (64, 64), dtype=np.uint8)).save(tmp_path / "a.png")
    assert_refused("pose", tmp_path / "a.png", "-m", FRAME, say="--scale SX SY")


@pytest.mark.parametrize(
    ("arguments", "say"),
    [
        (["pose", "SPOTS"], "--model"),
        (["pose", "-m", FRAME], "INPUT"),
        (["pose", "SPOTS", "-m", "no-such-frame"], "no-such-frame"),
        (["pose", "absent", "-m", FRAME], "absent"),
        (["pose", "absent.csv", "-m", FRAME], "absent.csv"),
        (["pose", "SPOTS", "-m", FRAME, "-c", "absent.yaml"], "absent.yaml"),
        (["pose", "SPOTS", "-m", FRAME, "-o", "p.txt"], ".csv, .json, .jsonl"),
        (["pose", "SPOTS", "-m", FRAME, "-o", "absent/p.csv"], "absent does not exist"),
        (["pose", "SPOTS", "-m", FRAME, "-o", "p.csv", "-o", "./p.csv"], "twice"),
        (["pose", "SPOTS", "-m", FRAME, "--scale", "-0.5", "0.5"], "s_x"),
        (["pose", "SPOTS", "-m", FRAME, "--scale", "0.5", "nan"], "s_y"),
        (["pose", "SPOTS", "-m", FRAME, "--scale", "0.5"], "--scale"),
        (["pose", "SPOTS", "-m", FRAME, "--spot-sd", "0"], "--spot-sd"),
        (["pose", "SPOTS", "-m", FRAME, "--spot-sd", "1e300"], "--spot-sd"),
        (["pose", "SPOTS", "", "-m", FRAME], "an input has no name"),
        (["track", "SPOTS", "-m", FRAME, "-o", "t.csv", "--smooth", "-"], "--smooth -"),
        (["pose", "SPOTS", "-m", FRAME, "--alert-limit", "-1"], "--alert-limit"),
        (["pose", "SPOTS", "-m", FRAME, "--integrity-risk", "1"], "--integrity-risk"),
        (["pose", "SPOTS", "-m", FRAME, "--overlay", "pictures"], "no pixels"),
        (["pose", "SPOTS", "-m", FRAME, "--colour"], "--colour"),
        (["pose", "SPOTS", "-3", "-m", FRAME], "-3"),
        (["track", "SPOTS", "-m", FRAME, "--gain", "0"], "0 < G <= 1"),
        (["track", "SPOTS", "-m", FRAME, "--gain", "1.5"], "0 < G <= 1"),
        (["track", "SPOTS", "-m", FRAME, "--gain", "-0.5"], "0 < G <= 1"),
        (["track", "SPOTS", "-m", FRAME, "--gain", "nan"], "0 < G <= 1"),
        (["track", "SPOTS", "-m", FRAME, "--jacobian", "broyden"], "broyden"),
        (["calibrate", "SPOTS", "-m", FRAME, "-o", "c.csv"], ".yaml or .yml"),
        (["segment", "SPOTS", "--series", "2"], "--series 2"),
        (["register", "SPOTS"], "register"),
    ],
)
def test_bad_usage_is_refused(
    monkeypatch: pytest.MonkeyPatch, spots_csv: Path, tmp_path: Path, arguments: list[str], say: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert_refused(*[spots_csv if word == "SPOTS" else word for word in arguments], say=say)
    assert list(tmp_path.iterdir()) == []


def test_one_unreadable_file_alone_is_an_error(a_broken_one: Path) -> None:
    assert_refused("pose", a_broken_one / "track_002.dcm", "-m", FRAME, say="track_002.dcm")


def test_mistakes_in_a_spots_file_are_shown_with_their_lines(tmp_path: Path) -> None:
    (tmp_path / "s.csv").write_text("slice,u_px,v_px\n0,a,1\n0,1,inf\n", encoding="utf-8")
    assert_refused("pose", tmp_path / "s.csv", "-m", FRAME, say="s.csv:3: v_px")


def test_an_earlier_output_survives_a_failed_run(bare_spots: Path, tmp_path: Path) -> None:
    for suffix in (".csv", ".json", ".jsonl"):
        earlier = tmp_path / f"p{suffix}"
        earlier.write_text("earlier", encoding="utf-8")
        assert_refused("pose", bare_spots, "-m", FRAME, "-o", earlier, say="--scale")
        assert earlier.read_text(encoding="utf-8") == "earlier"


def test_an_input_is_never_an_output(spots_csv: Path, two_slices: Path, tmp_path: Path) -> None:
    before = spots_csv.read_bytes()
    assert_refused("pose", spots_csv, "-m", FRAME, "-o", spots_csv, say="is an input")
    assert_refused("pose", two_slices, "-m", FRAME, "--overlay", two_slices, say="is an input")
    assert spots_csv.read_bytes() == before


def test_a_file_name_that_is_no_unicode_is_written_as_unicode(two_slices: Path, tmp_path: Path) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    shutil.copy(two_slices / "track_000.dcm", os.fsencode(folder) + b"/m\xe9tal.dcm")
    for suffix in (".csv", ".json", ".jsonl"):
        spots = tmp_path / f"s{suffix}"
        run_ctreg("segment", folder, "-o", spots, "-v")
        assert [spot_slice.info.source for spot_slice in read_spots(spots)] == ["m\ufffdtal.dcm"]
        run_ctreg("pose", spots, "-m", FRAME, "-v")


def test_quiet_says_nothing_and_verbose_says_more(spots_csv: Path) -> None:
    quiet = run_ctreg("pose", spots_csv, "-m", FRAME, "-q")
    usual = run_ctreg("pose", spots_csv, "-m", FRAME)
    verbose = run_ctreg("pose", spots_csv, "-m", FRAME, "-v")
    assert quiet.stdout == usual.stdout == verbose.stdout
    assert quiet.stderr == ""
    assert "slice 1 (track_001.dcm): ok" in verbose.stderr
    assert "slice 1 (track_001.dcm)" not in usual.stderr


def test_the_version_is_told() -> None:
    assert run_ctreg("--version").stdout == f"ctreg {ctreg_cli.__version__}\n"


@pytest.mark.parametrize("command", ["segment", "calibrate", "pose", "track"])
def test_help_shows_examples(command: str) -> None:
    text = run_ctreg(command, "--help").stdout
    assert f"\n    ctreg {command} " in text
    for line in text.splitlines():
        assert len(line) <= 80
