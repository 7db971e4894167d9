"""Results on disk: one row a slice whatever became of it, the contract's columns, strict JSON, all or nothing."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ctreg_cli.arrays import FloatArray
from ctreg_cli.errors import InputError
from ctreg_cli.imaging.slice import SliceInfo
from ctreg_cli.imaging.spots import Spots
from ctreg_cli.io.results import ResultsHeader, read_results, results_encoding, write_results
from ctreg_cli.io.sinks import open_sinks
from ctreg_cli.pipeline import FrameResult, TargetAccuracy
from ctreg_cli.registration.result import Candidate
from ctreg_cli.rods import Rod, RodModel
from ctreg_cli.scale import Scale

HEADER_LINE = (
    "slice,source,time_s,status,reason,method,n_spots,n_matched,rms_px,tx_mm,ty_mm,tz_mm,qx,qy,qz,qw,"
    "sd_tx_mm,sd_ty_mm,sd_tz_mm,sd_rx_deg,sd_ry_deg,sd_rz_deg,iterations"
)
CONTRACT_COLUMNS = HEADER_LINE.split(",")
POSE_COLUMNS = CONTRACT_COLUMNS[CONTRACT_COLUMNS.index("rms_px") :]

MODEL = RodModel(
    name="three",
    sha256="0" * 64,
    rods=tuple(Rod(id=f"r{i}", start=np.array([i, 0.0, 0.0]), end=np.array([i, i * i, 9.0])) for i in range(4)),
)
HEADER = ResultsHeader(model=MODEL, scale_from="dicom", options={"command": "pose", "alert_limit_mm": None})


def a_candidate(rng: np.random.Generator) -> Candidate:
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    T[:3, 3] = rng.uniform(-300, 300, 3)
    root = rng.normal(size=(6, 6))
    return Candidate(
        T_slice_model=T,
        covariance=root @ root.T * 1e-3,
        rod_index=np.array([0, 1, 3]),
        spot_index=np.array([4, 0, 2]),
        residual_px=rng.normal(size=(3, 2)),
        lambda_mm=rng.uniform(0, 9, 3),
        missing_rods=np.array([2]),
        rms_px=0.123456789,
        chi2=np.inf,
        degrees_of_freedom=0,
        log_odds=12.0,
    )


def a_result(index: int, status: str, rng: np.random.Generator, n_candidates: int = 1) -> FrameResult:
    T_patient_slice: FloatArray = np.eye(4)
    T_patient_slice[:3, 3] = [1.0, 2.0, 3.0]
    return FrameResult(
        index=index,
        info=SliceInfo(
            source=f"s, {index}.dcm",
            time_s=0.1 * index,
            scale=Scale(s_x=0.5, s_y=0.25),
            T_patient_slice=T_patient_slice,
            uids={"sop_instance": "1.2.3"},
        ),
        spots=Spots.from_points(rng.uniform(0, 512, (5, 2))),
        status=status,  # type: ignore[arg-type]
        reason="" if status == "ok" else "too_few_spots",
        method="registered",
        candidates=tuple(a_candidate(rng) for _ in range(n_candidates)),
        targets=(TargetAccuracy(id="tip", position_slice=np.ones(3), position_patient=None, tre_mm=0.5),),
        warnings=(("weak_geometry", "tilt is known to 9° only"), ("spot_sd_assumed", "0.25 px")),
    )


@pytest.fixture
def results() -> list[FrameResult]:
    rng = np.random.default_rng(7)
    return [
        a_result(0, "ok", rng),
        a_result(1, "ambiguous", rng, n_candidates=2),
        a_result(2, "no_pose", rng, n_candidates=0),
        # whatever was tried on the way: no_pose shows no pose
        a_result(3, "no_pose", rng, n_candidates=1),
    ]


def test_the_table_starts_with_the_contract_columns_and_has_a_row_a_slice(
    tmp_path: Path, results: list[FrameResult]
) -> None:
    write_results(results, tmp_path / "poses.csv", HEADER)
    with (tmp_path / "poses.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert list(rows[0])[: len(CONTRACT_COLUMNS)] == CONTRACT_COLUMNS
    assert [int(row["slice"]) for row in rows] == [0, 1, 2, 3]
    for row, result in zip(rows, results, strict=True):
        filled = [bool(row[name]) for name in POSE_COLUMNS]
        assert all(filled) if result.status != "no_pose" else not any(filled)
    assert float(rows[0]["qw"]) >= 0
    assert rows[0]["warnings"] == "weak_geometry;spot_sd_assumed"


def test_a_pose_comes_back_from_the_table(tmp_path: Path, results: list[FrameResult]) -> None:
    write_results(results, tmp_path / "poses.csv", HEADER)
    back = read_results(tmp_path / "poses.csv")
    for row, result in zip(back, results, strict=True):
        assert (row.index, row.status, row.source) == (result.index, result.status, result.info.source)
        assert row.time_s == result.info.time_s
        if result.status == "no_pose":
            assert row.T_slice_model is None
        else:
            assert row.T_slice_model is not None
            T = result.candidates[0].T_slice_model
            np.testing.assert_allclose(row.T_slice_model[:3, :3], T[:3, :3], atol=1e-14)
            np.testing.assert_allclose(row.T_slice_model[:3, 3], T[:3, 3], atol=1e-6)


@pytest.mark.parametrize("suffix", [".json", ".jsonl"])
def test_rows_are_the_same_whichever_format_they_were_written_in(
    tmp_path: Path, results: list[FrameResult], suffix: str
) -> None:
    for name in ("poses.csv", f"poses{suffix}"):
        write_results(results, tmp_path / name, HEADER)
    table, document = read_results(tmp_path / "poses.csv"), read_results(tmp_path / f"poses{suffix}")
    for row, other in zip(table, document, strict=True):
        for name in ("index", "source", "time_s", "status", "reason"):
            assert getattr(row, name) == getattr(other, name)
        assert (row.T_slice_model is None) == (other.T_slice_model is None)
        if row.T_slice_model is not None and other.T_slice_model is not None:
            np.testing.assert_allclose(row.T_slice_model, other.T_slice_model, atol=1e-6)
        assert {name: other.cells[name] for name in row.cells} == row.cells


def test_what_is_no_result_is_said_to_be_none(tmp_path: Path) -> None:
    columns = "slice,status,tx_mm,ty_mm,tz_mm,qx,qy,qz,qw"
    for content, wanted in {
        "": "no column slice, status",
        "slice,status\n0,ok\n": "no column tx_mm",
        f"{columns}\nnan,no_pose,,,,,,,\n": ":2: slice: a number",
        f"{columns}\n0,ok,inf,0,0,0,0,0,1\n": ":2: tx_mm, ty_mm, tz_mm: a number",
        f"{columns}\n0,ok,0,0,0,0,0,0,0\n": ":2: qx, qy, qz, qw: a quaternion of length 1",
    }.items():
        (tmp_path / "p.csv").write_text(content, encoding="utf-8")
        with pytest.raises(InputError, match=f"p.csv.*{wanted}.*ctreg pose or ctreg track"):
            read_results(tmp_path / "p.csv")
    (tmp_path / "p.csv").write_bytes(b"\xff\xfe")
    with pytest.raises(InputError, match="no UTF-8 text"):
        read_results(tmp_path / "p.csv")
    (tmp_path / "p.json").write_text("[]", encoding="utf-8")
    with pytest.raises(InputError, match="no list of results"):
        read_results(tmp_path / "p.json")
    with pytest.raises(InputError, match="name a file"):
        write_results([], "-", HEADER)
    with pytest.raises(InputError, match=r"header: None .*ResultsHeader\(model="):
        write_results([], tmp_path / "q.json", None)  # type: ignore[arg-type]
    assert not list(tmp_path.glob("*q*"))


def test_standard_deviations_are_roots_of_the_covariance_diagonal(tmp_path: Path, results: list[FrameResult]) -> None:
    write_results(results, tmp_path / "poses.csv", HEADER)
    cells = read_results(tmp_path / "poses.csv")[0].cells
    variance = np.diagonal(results[0].candidates[0].covariance)
    got = [float(cells[name]) for name in ("sd_tx_mm", "sd_ty_mm", "sd_tz_mm", "sd_rx_deg", "sd_ry_deg", "sd_rz_deg")]
    np.testing.assert_allclose(np.square(got[:3]), variance[:3], rtol=1e-5)
    np.testing.assert_allclose(np.square(np.radians(got[3:])), variance[3:], rtol=1e-5)


def refuse_constant(name: str) -> float:
    raise AssertionError(f"{name} is not JSON")


@pytest.mark.parametrize("suffix", [".json", ".jsonl"])
def test_the_document_is_strict_and_holds_the_evidence(tmp_path: Path, results: list[FrameResult], suffix: str) -> None:
    path = tmp_path / f"poses{suffix}"
    write_results(results, path, HEADER)
    text = path.read_text(encoding="utf-8")
    if suffix == ".json":
        document = json.loads(text, parse_constant=refuse_constant)
        records = document.pop("results")
    else:
        document, *records = [json.loads(line, parse_constant=refuse_constant) for line in text.splitlines()]
    assert document["schema"] == "ctreg/poses/1"
    assert document["model"] == {"name": "three", "sha256": "0" * 64}
    assert document["scale"] == {"s_x_mm": 0.5, "s_y_mm": 0.25, "from": "dicom"}
    assert document["options"] == {"command": "pose", "alert_limit_mm": None}

    first, second, third, fourth = records
    candidate = results[0].candidates[0]
    assert first["T_slice_model"] == candidate.T_slice_model.tolist()
    np.testing.assert_allclose(
        np.array(first["T_patient_model"])[:3, 3], candidate.T_slice_model[:3, 3] + [1, 2, 3], rtol=1e-15
    )
    assert first["covariance"] == candidate.covariance.tolist()
    assert [(match["rod"], match["spot"]) for match in first["matches"]] == [("r0", 4), ("r1", 0), ("r3", 2)]
    assert [first["matches"][0][key] for key in ("u_px", "v_px")] == results[0].spots.uv_px[4].tolist()
    assert first["unmatched_spots"] == [1, 3]
    assert first["unmatched_px"] == results[0].spots.uv_px[[1, 3]].tolist()
    assert first["missing_rods"] == ["r2"]
    assert first["targets"][0]["tre_mm"] == 0.5
    assert first["warnings"][0] == {"code": "weak_geometry", "text": "tilt is known to 9° only"}
    assert len(second["candidates"]) == 2
    assert all(item["rms_px"] == 0.123456789 for item in second["candidates"])
    for lost, result in ((third, results[2]), (fourth, results[3])):
        assert lost["T_slice_model"] is lost["T_patient_model"] is lost["covariance"] is lost["qw"] is None
        assert lost["matches"] == lost["candidates"] == lost["missing_rods"] == []
        assert lost["unmatched_spots"] == [0, 1, 2, 3, 4]
        assert lost["unmatched_px"] == result.spots.uv_px.tolist()


def test_table_and_document_say_the_same(tmp_path: Path, results: list[FrameResult]) -> None:
    write_results(results, tmp_path / "p.csv", HEADER)
    write_results(results, tmp_path / "p.json", HEADER)
    records = json.loads((tmp_path / "p.json").read_text(encoding="utf-8"))["results"]
    for row, record in zip(read_results(tmp_path / "p.csv"), records, strict=True):
        for name in CONTRACT_COLUMNS:
            if isinstance(record[name], float):
                assert float(row.cells[name]) == record[name]
            else:
                assert row.cells[name] == ("" if record[name] is None else str(record[name]))


def test_uids_only_when_asked_for(tmp_path: Path, results: list[FrameResult]) -> None:
    write_results(results, tmp_path / "without.json", HEADER)
    write_results(results, tmp_path / "with.json", HEADER, with_uids=True)
    write_results(results, tmp_path / "with.csv", HEADER, with_uids=True)
    assert "1.2.3" not in (tmp_path / "without.json").read_text(encoding="utf-8")
    assert '"uids": {"sop_instance": "1.2.3"}' in (tmp_path / "with.json").read_text(encoding="utf-8")
    assert "1.2.3" not in (tmp_path / "with.csv").read_text(encoding="utf-8")


def test_a_given_scale_overrides_each_slices_own(tmp_path: Path, results: list[FrameResult]) -> None:
    header = ResultsHeader(model=MODEL, scale=Scale(s_x=0.1, s_y=0.2), scale_from="option")
    write_results(results, tmp_path / "p.csv", header)
    write_results(results, tmp_path / "p.json", header)
    assert read_results(tmp_path / "p.csv")[0].cells["s_x_mm"] == "0.1"
    document = json.loads((tmp_path / "p.json").read_text(encoding="utf-8"))
    assert document["scale"] == {"s_x_mm": 0.1, "s_y_mm": 0.2, "from": "option"}


def breaking(results: list[FrameResult], error: type[BaseException]) -> Iterator[FrameResult]:
    yield from results[:2]
    raise error


@pytest.mark.parametrize("suffix", [".csv", ".json"])
def test_an_error_leaves_the_old_file_and_no_litter(tmp_path: Path, results: list[FrameResult], suffix: str) -> None:
    path = tmp_path / f"p{suffix}"
    path.write_text("old", encoding="utf-8")
    with pytest.raises(ZeroDivisionError):
        write_results(breaking(results, ZeroDivisionError), path, HEADER)
    assert path.read_text(encoding="utf-8") == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("suffix", [".csv", ".json", ".jsonl"])
def test_an_interrupt_keeps_what_was_finished(tmp_path: Path, results: list[FrameResult], suffix: str) -> None:
    whole, cut = tmp_path / f"whole{suffix}", tmp_path / f"cut{suffix}"
    write_results(results[:2], whole, HEADER)
    with pytest.raises(KeyboardInterrupt):
        write_results(breaking(results, KeyboardInterrupt), cut, HEADER)
    assert cut.read_bytes() == whole.read_bytes()


def test_lines_are_there_as_soon_as_the_slice_is_done(tmp_path: Path, results: list[FrameResult]) -> None:
    path = tmp_path / "p.jsonl"
    with open_sinks([str(path)], results_encoding(HEADER), None) as sinks:  # type: ignore[arg-type]
        for count, result in enumerate(results, start=1):
            sinks.write(result)
            assert len(path.read_text(encoding="utf-8").splitlines()) == 1 + count


def test_no_results_are_still_a_readable_file(tmp_path: Path) -> None:
    for suffix in (".csv", ".json", ".jsonl"):
        write_results([], tmp_path / f"p{suffix}", HEADER)
    assert read_results(tmp_path / "p.csv") == []
    assert json.loads((tmp_path / "p.json").read_text(encoding="utf-8"))["results"] == []
    assert json.loads((tmp_path / "p.jsonl").read_text(encoding="utf-8"))["schema"] == "ctreg/poses/1"


@pytest.mark.parametrize(
    ("name", "wanted"),
    [
        ("p.txt", r"\.csv, \.json, \.jsonl"),
        ("p", "suffix"),
        ("absent/p.csv", "absent does not exist"),
        ("d.csv", "folder"),
    ],
)
def test_a_place_that_cannot_be_written_is_named(tmp_path: Path, name: str, wanted: str) -> None:
    (tmp_path / "d.csv").mkdir()
    with pytest.raises(InputError, match=wanted):
        write_results([], tmp_path / name, HEADER)
    assert [path.name for path in tmp_path.iterdir()] == ["d.csv"]


def test_one_bad_output_of_several_leaves_nothing(tmp_path: Path) -> None:
    outputs = [str(tmp_path / "a.csv"), str(tmp_path / "absent" / "b.json")]
    with pytest.raises(InputError):
        open_sinks(outputs, results_encoding(HEADER), None)  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == []


def test_the_same_output_twice_is_refused(tmp_path: Path) -> None:
    path = str(tmp_path / "a.csv")
    with pytest.raises(InputError, match="twice"):
        open_sinks([path, path], results_encoding(HEADER), None)  # type: ignore[arg-type]


class LeftReader(io.StringIO):
    """Standard output whose reader leaves after two flushes."""

    patience = 2

    def flush(self) -> None:
        if not self.closed and self.patience <= 0:
            raise BrokenPipeError
        self.patience -= 1


def test_a_reader_that_leaves_takes_no_other_output_away(tmp_path: Path, results: list[FrameResult]) -> None:
    write_results(results, tmp_path / "wanted.csv", HEADER)
    with open_sinks(["-", str(tmp_path / "p.csv")], results_encoding(HEADER), LeftReader()) as sinks:
        for result in results:
            sinks.write(result)
            assert sinks.alive
    assert (tmp_path / "p.csv").read_bytes() == (tmp_path / "wanted.csv").read_bytes()
    with open_sinks(["-"], results_encoding(HEADER), LeftReader()) as sinks:
        for result in results[:3]:
            sinks.write(result)
        assert not sinks.alive


def test_a_link_keeps_pointing_where_it_did(tmp_path: Path, results: list[FrameResult]) -> None:
    (tmp_path / "real").mkdir()
    link = tmp_path / "latest.csv"
    link.symlink_to(tmp_path / "real" / "p.csv")
    write_results(results, link, HEADER)
    assert link.is_symlink()
    assert len(read_results(tmp_path / "real" / "p.csv")) == len(results)


def test_what_is_no_pose_table_is_said(tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text("slice,u_px\n0,1\n", encoding="utf-8")
    with pytest.raises(InputError, match="no column status"):
        read_results(tmp_path / "x.csv")
    write_results([], tmp_path / "p.csv", HEADER)
    with (tmp_path / "p.csv").open("a", encoding="utf-8") as stream:
        stream.write("0,s,,ok,,registered,5,5,0.1,one,2,3,0,0,0,1\n")
    with pytest.raises(InputError, match=r"p\.csv:2: .*tx_mm"):
        read_results(tmp_path / "p.csv")


class FullDisk:
    """An output that takes two items."""

    def __init__(self) -> None:
        self.taken, self.abandoned = 0, False

    def write(self, _item: object) -> None:
        if self.taken == 2:
            raise OSError(28, "No space left on device")
        self.taken += 1

    def finish(self) -> None:
        raise AssertionError("it has been left behind")

    def abandon(self) -> None:
        self.abandoned = True


def test_a_full_disk_ends_a_run_and_not_a_live_session(tmp_path: Path, results: list[FrameResult]) -> None:
    for live in (False, True):
        full, told = FullDisk(), list[str]()
        path = tmp_path / f"{live}.csv"
        sinks = open_sinks([str(path)], results_encoding(HEADER), io.StringIO())
        sinks.add("full.mat", full)
        if live:
            sinks.outlive_failures(told.append)
        with nullcontext() if live else pytest.raises(InputError, match=r"full\.mat: cannot be written"), sinks:
            for result in results:
                sinks.write(result)
        assert full.abandoned
        assert path.exists() == live
        assert told == sinks.lost == ["full.mat: cannot be written (No space left on device)"] * live
    assert len(read_results(tmp_path / "True.csv")) == len(results)


def test_a_line_the_disk_has_no_room_for_is_taken_back(
    tmp_path: Path, results: list[FrameResult], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file ends with a whole line, whatever the disk took of the next."""
    path = tmp_path / "p.jsonl"
    real = Path.open

    class Nearly(io.FileIO):
        room = 9000

        def write(self, data: Any, /) -> int:
            if not self.room:
                raise OSError(28, "No space left on device")
            n = super().write(bytes(data)[: self.room])
            self.room -= n
            return n

    def open_(self: Path, mode: str = "r", *arguments: Any, **options: Any) -> Any:
        return Nearly(self, mode) if mode == "ab" else real(self, mode, *arguments, **options)

    monkeypatch.setattr(Path, "open", open_)
    with pytest.raises(InputError, match="No space left"):
        write_results(results * 5, path, HEADER)
    text = path.read_text(encoding="utf-8")
    assert text.endswith("}\n")
    assert 2 <= len([json.loads(line) for line in text.splitlines()]) <= len(results) * 5
