"""``ctreg simulate`` as a user runs it."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pydicom
import pytest
import typer
from typer.testing import CliRunner, Result

from ctreg_cli.cli.simulate import simulate
from ctreg_cli.errors import InputError
from ctreg_cli.imaging.slice import Slice
from ctreg_cli.io.images import open_images
from ctreg_cli.io.results import read_results
from ctreg_cli.io.spots_file import read_spots

FRAME = "rod-cube-30x30x40"
#: a small image, so that a run takes a moment
SMALL = ("--size", "128", "140", "--scale", "0.5", "0.55")


def run(*arguments: object) -> Result:
    app = typer.Typer()
    app.command()(simulate)
    return CliRunner().invoke(app, ["-m", FRAME, *map(str, arguments)])


def test_a_series_and_its_truth(tmp_path: Path) -> None:
    folder = tmp_path / "series"
    result = run("-o", folder, "--frames", 4, "--false", 2, "--missing", "r3", "--tilt-deg", -3, 2, 1, *SMALL)
    assert result.exit_code == 0
    assert result.stdout == ""
    assert "4 slices" in result.stderr
    names = sorted(path.name for path in folder.iterdir())
    assert names == [*(f"slice_{i:04}.dcm" for i in range(4)), "truth.csv", "truth.json", "truth_spots.csv"]

    rows = read_results(folder / "truth.csv")
    document = json.loads((folder / "truth.json").read_text())
    with (folder / "truth_spots.csv").open() as stream:
        spots = list(csv.DictReader(stream))
    for i, row in enumerate(rows):
        assert (row.index, row.source, row.status) == (i, f"slice_{i:04}.dcm", "ok")
        assert row.cells["n_spots"] == "7"
        exact = document["results"][i]
        assert np.allclose(exact["T_slice_model"], row.T_slice_model, atol=1e-6)
        assert exact["missing_rods"] == ["r3"]
        here = [spot for spot in spots if spot["slice"] == str(i)]
        assert [spot["rod"] for spot in here] == [*(match["rod"] for match in exact["matches"]), "", ""]
        hu = pydicom.dcmread(folder / row.source).pixel_array - 1024
        for spot in here[:-2]:
            assert hu[round(float(spot["v_px"])), round(float(spot["u_px"]))] > 1500


def test_the_same_seed_gives_the_same_bytes_and_another_option_another_identity(tmp_path: Path) -> None:
    options = ("--frames", 2, "--start", "random", "--missing-count", 1, "--false", 3, "--streak-hu", 80, *SMALL)
    for name, more in (("a", ()), ("b", ()), ("c", ("--seed", 5)), ("d", ("--orientation", "0,0,9"))):
        assert run("-o", tmp_path / name, *options, *more).exit_code == 0
    contents = {
        name: {path.name: path.read_bytes() for path in (tmp_path / name).iterdir()} for name in ("a", "b", "c", "d")
    }
    assert contents["a"] == contents["b"]
    first = [pydicom.dcmread(tmp_path / name / "slice_0000.dcm") for name in ("a", "c", "d")]
    assert len({ds.SOPInstanceUID for ds in first}) == len({ds.SeriesInstanceUID for ds in first}) == 3
    assert contents["a"]["truth.csv"] != contents["c"]["truth.csv"]


def test_a_series_follows_the_truth_of_another(tmp_path: Path) -> None:
    assert run("-o", tmp_path / "a", "--frames", 3, "--motion", "drift", *SMALL).exit_code == 0
    motion = tmp_path / "a" / "truth.csv"
    assert run("-o", tmp_path / "b", "--motion", motion, "--noise-hu", 0, *SMALL).exit_code == 0
    before, after = (read_results(tmp_path / name / "truth.csv") for name in ("a", "b"))
    assert [row.T_slice_model.tolist() for row in before if row.T_slice_model is not None] == [
        row.T_slice_model.tolist() for row in after if row.T_slice_model is not None
    ]


def test_overwriting_is_asked_for(tmp_path: Path) -> None:
    assert run("-o", tmp_path / "a", "--frames", 2, *SMALL).exit_code == 0
    refused = run("-o", tmp_path / "a", "--frames", 1, *SMALL)
    assert isinstance(refused.exception, InputError)
    assert "--overwrite" in str(refused.exception)
    assert run("-o", tmp_path / "a", "--frames", 1, "--overwrite", *SMALL).exit_code == 0
    assert len(list((tmp_path / "a").glob("*.dcm"))) == 1


@pytest.mark.parametrize(
    ("options", "what"),
    [
        (("--missing", "r99"), "no rod r99"),
        (("--motion", "waltz"), "waltz: cannot be read"),
        (("--motion", "truth.csv", "--start", "random"), "cannot go with a motion file"),
        (("--start", "1,2,3"), "start"),
        (("--orientation", "askew"), "orientation"),
        (("--scale", "0", "1"), "s_x"),
        (("--thickness-mm", "nan"), "thickness_mm"),
        (("--interval-s", "0"), "interval_s"),
        (("--tilt-deg", "nan", "0", "0"), "tilt"),
        (("--size", "1", "1"), "shape"),
    ],
)
def test_a_bad_option_is_one_sentence_and_leaves_nothing(options: tuple[str, ...], what: str, tmp_path: Path) -> None:
    result = run("-o", tmp_path / "a", "--frames", 1, *options)
    assert isinstance(result.exception, InputError)
    assert what in str(result.exception)
    assert "\n" not in str(result.exception)
    assert list(tmp_path.iterdir()) == []


def test_ctregs_own_readers_find_the_truth_again(tmp_path: Path) -> None:
    folder = tmp_path / "series"
    options = ("--frames", 3, "--orientation", "14,-6,30", "--step-mm", 1.5, "--false", 1)
    assert run("-o", folder, *options, *SMALL).exit_code == 0
    document = json.loads((folder / "truth.json").read_text())["results"]
    images, spots = open_images([folder]), read_spots(folder / "truth_spots.csv")
    for image, spot_slice, true in zip(images, spots, document, strict=True):
        assert isinstance(image, Slice)
        assert image.info.source == spot_slice.info.source == true["source"]
        assert image.info.time_s == spot_slice.info.time_s == true["time_s"]
        assert image.info.scale == spot_slice.info.scale
        assert image.info.T_patient_slice is not None
        in_patient = image.info.T_patient_slice @ np.array(true["T_slice_model"])
        assert np.allclose(in_patient, true["T_patient_model"], atol=1e-9)
        places = [(match["u_px"], match["v_px"]) for match in true["matches"]]
        assert np.allclose(spot_slice.spots.uv_px[:-1], places, atol=1e-9)
