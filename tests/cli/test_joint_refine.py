"""``pose --joint`` and ``model refine`` from end to end, on a scan made with the oracle."""

from __future__ import annotations

import io
import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from ctreg_cli.io.results import read_results
from ctreg_cli.io.rod_file import load_rod_model, save_rod_model
from ctreg_cli.io.sinks import open_sinks
from ctreg_cli.io.spots_file import numbered, spots_encoding
from tests import oracle
from tests.cli.conftest import run_ctreg
from tests.registration.frames import model_of
from tests.registration.scans import Scan, make_scan

TOLERANCE_MM = 0.3


@pytest.fixture(scope="module")
def scanned(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Scan]:
    """A folder with a frame file and the spots of a scan of the true frame."""
    folder = tmp_path_factory.mktemp("scan")
    rng = np.random.default_rng(20)
    frame = oracle.random_frame(rng, 8, size=60.0, height=80.0)
    scan = make_scan(rng, frame, n_slices=8, tolerance_mm=TOLERANCE_MM)
    save_rod_model(model_of(frame, tolerance_mm=TOLERANCE_MM), folder / "frame.yaml")
    with open_sinks([str(folder / "spots.json")], spots_encoding(), io.StringIO()) as sinks:
        for item in numbered(scan.slices):
            sinks.write(item)
    return folder / "spots.json", folder / "frame.yaml", scan


def test_joint_writes_one_pose_in_a_row_a_slice(scanned: tuple[Path, Path, Scan], tmp_path: Path) -> None:
    spots, frame, scan = scanned
    run_ctreg("pose", spots, "-m", frame, "--joint", "-o", tmp_path / "p.json", "-o", tmp_path / "p.csv")
    document = json.loads((tmp_path / "p.json").read_text(encoding="utf-8"))
    assert document["options"]["joint"] is True
    results = document["results"]
    assert [row["slice"] for row in results] == list(range(8))
    assert Counter(row["status"] for row in results) == {"ok": 8}
    assert {row["method"] for row in results} == {"joint"}
    for row in results:
        np.testing.assert_allclose(row["T_patient_model"], results[0]["T_patient_model"], atol=1e-9)
    error = np.abs(scan.error(np.array(results[0]["T_patient_model"])))
    assert (error < 5 * np.sqrt(np.diag(results[0]["covariance"])).max()).all()
    assert [row.status for row in read_results(tmp_path / "p.csv")] == ["ok"] * 8


def test_a_carried_pose_has_no_residual(scanned: tuple[Path, Path, Scan], tmp_path: Path) -> None:
    """Nothing was measured in that slice: a residual of zero would be the best of all."""
    document = json.loads(scanned[0].read_text(encoding="utf-8"))
    beyond = document["slices"][-1]
    T = np.array(beyond["T_patient_slice"])
    T[:3, 3] += 200 * T[:3, 2]
    beyond |= {"T_patient_slice": T.tolist(), "spots": []}
    (tmp_path / "s.json").write_text(json.dumps(document), encoding="utf-8")
    arguments = ("pose", tmp_path / "s.json", "-m", scanned[1], "--joint", "-v")
    said = run_ctreg(*arguments, "-o", tmp_path / "p.json", "-o", tmp_path / "p.csv").stderr
    assert "nan" not in said
    row = read_results(tmp_path / "p.csv")[-1]
    assert (row.status, row.cells["n_matched"], row.cells["rms_px"]) == ("ok", "0", "")
    assert "carried" in row.cells["warnings"]
    record = json.loads((tmp_path / "p.json").read_text(encoding="utf-8"))["results"][-1]
    assert record["rms_px"] is None
    assert record["candidates"][0]["rms_px"] is None
    run_ctreg("report", tmp_path / "p.json", "-m", scanned[1], "-o", tmp_path / "r.html")


def test_joint_without_places_is_refused_in_one_sentence(scanned: tuple[Path, Path, Scan], tmp_path: Path) -> None:
    spots, frame, _ = scanned
    table = tmp_path / "spots.csv"
    document = json.loads(spots.read_text(encoding="utf-8"))
    lines = ["slice,source,u_px,v_px,s_x_mm,s_y_mm"]
    for item in document["slices"]:
        lines += [f"{item['slice']},x,{s['u_px']},{s['v_px']},0.5,0.6" for s in item["spots"]]
    table.write_text("\n".join(lines) + "\n", encoding="utf-8")
    result = run_ctreg("pose", table, "-m", frame, "--joint", "-o", tmp_path / "p.csv", code=2)
    assert "ImagePositionPatient" in result.stderr
    table.write_text("\n".join(line.replace(",x,", ",,") for line in lines) + "\n", encoding="utf-8")
    assert "spots: no place" in run_ctreg("pose", table, "-m", frame, "--joint", code=2).stderr
    assert "Traceback" not in result.stderr
    assert not (tmp_path / "p.csv").exists()


def test_joint_and_alert_limit_do_not_go_together(scanned: tuple[Path, Path, Scan]) -> None:
    spots, frame, _ = scanned
    assert "--joint" in run_ctreg("pose", spots, "-m", frame, "--joint", "--alert-limit", 1, code=2).output


def test_refine_writes_a_frame_that_fits_better(scanned: tuple[Path, Path, Scan], tmp_path: Path) -> None:
    spots, frame, _ = scanned
    result = run_ctreg("model", "refine", spots, "-m", frame, "-o", tmp_path / "refined.yaml", "--json")
    report = json.loads(result.stdout)
    assert report["rms_after_px"] < report["rms_before_px"] / 1.5
    assert [rod["id"] for rod in report["rods"]] == list(load_rod_model(frame).ids)
    assert "tolerance mm" in result.stderr
    before, after = load_rod_model(frame), load_rod_model(tmp_path / "refined.yaml")
    assert after.name == "oracle-refined"
    assert (after.tolerances < before.tolerances).all()
    shift = np.array([[rod["shift_start_mm"], rod["shift_end_mm"]] for rod in report["rods"]])
    np.testing.assert_allclose(after.starts - before.starts, shift[:, 0], atol=2e-4)
    np.testing.assert_allclose(after.ends - before.ends, shift[:, 1], atol=2e-4)
    assert str(tmp_path) not in after.description
    rms = []
    for name, file in (("before", frame), ("after", tmp_path / "refined.yaml")):
        run_ctreg("pose", spots, "-m", file, "-q", "-o", tmp_path / f"{name}.csv")
        cells = [row.cells["rms_px"] for row in read_results(tmp_path / f"{name}.csv") if row.cells["rms_px"]]
        rms.append(np.sqrt(np.mean(np.square([float(cell) for cell in cells]))))
    assert rms[1] < rms[0] * 2 / 3


def test_refine_to_standard_output_is_a_frame_file(scanned: tuple[Path, Path, Scan], tmp_path: Path) -> None:
    spots, frame, _ = scanned
    result = run_ctreg("model", "refine", spots, "-m", frame, "-q", "--scales")
    (tmp_path / "again.yaml").write_text(result.stdout, encoding="utf-8")
    assert len(load_rod_model(tmp_path / "again.yaml")) == 8
    assert result.stderr == ""


def test_refine_refuses_what_it_cannot_do(scanned: tuple[Path, Path, Scan], tmp_path: Path) -> None:
    spots, frame, scan = scanned
    one = tmp_path / "one.json"
    with open_sinks([str(one)], spots_encoding(), io.StringIO()) as sinks:
        sinks.write(next(numbered(scan.slices)))
    result = run_ctreg("model", "refine", one, "-m", frame, "-o", tmp_path / "r.yaml", code=1)
    assert "more slices are needed" in result.stderr
    assert not (tmp_path / "r.yaml").exists()
    assert "YAML" in run_ctreg("model", "refine", spots, "-m", frame, "-o", tmp_path / "r.csv", code=2).output
    assert "another file" in run_ctreg("model", "refine", spots, "-m", frame, "-o", frame, code=2).output
    exact = tmp_path / "exact.yaml"
    save_rod_model(model_of(oracle.OracleFrame(scan.frame.starts, scan.frame.ends)), exact)
    assert "tolerance 0" in run_ctreg("model", "refine", spots, "-m", exact, code=2).stderr
