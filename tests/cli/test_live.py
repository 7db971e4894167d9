"""``track --watch``, ``--igtl``, ``export`` and ``report`` from end to end."""

from __future__ import annotations

import csv
import json
import shutil
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from .conftest import FRAME, SAMPLES, run_ctreg

N = 3


def arrive(folder: Path, n: int) -> threading.Thread:
    """A scanner that writes a slice now and then."""

    def work() -> None:
        for number in range(n):
            time.sleep(0.1)
            shutil.copy(SAMPLES / "track" / f"track_{number:03d}.dcm", folder)

    thread = threading.Thread(target=work)
    thread.start()
    return thread


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def watched(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what ``track --watch`` wrote of slices that came while it ran."""
    folder = tmp_path_factory.mktemp("watched")
    incoming, out = folder / "in", folder / "out"
    incoming.mkdir()
    out.mkdir()
    scanner = arrive(incoming, N)
    outputs = [
        option for name in ("t.csv", "t.json", "t.jsonl", "t.seq.mha", "t_{slice}.tfm") for option in ("-o", out / name)
    ]
    run_ctreg("track", "--watch", incoming, "-m", FRAME, "--count", N, "--with-uids", "--igtl", "0", *outputs)
    scanner.join()
    return out


def test_watch_gives_what_the_folder_gives(watched: Path, tmp_path: Path) -> None:
    """Slices that came one by one are tracked as the finished folder would be."""
    folder = tmp_path / "whole"
    folder.mkdir()
    arrive(folder, N).join()
    run_ctreg("track", folder, "-m", FRAME, "-o", tmp_path / "t.csv", "-q")
    assert rows(watched / "t.csv") == rows(tmp_path / "t.csv")


def test_outputs_of_other_programs_beside_tables(watched: Path) -> None:
    assert sorted(path.name for path in watched.iterdir()) == sorted(
        ["t.csv", "t.json", "t.jsonl", "t.seq.mha", *(f"t_{number:04d}.tfm" for number in range(N))]
    )
    assert len((watched / "t.jsonl").read_text(encoding="utf-8").splitlines()) == N + 1


def test_export_of_results_is_what_track_exports(watched: Path, tmp_path: Path) -> None:
    run_ctreg("export", watched / "t.json", "-o", tmp_path / "t.seq.mha", "-o", tmp_path / "t_{slice}.tfm")
    for path in tmp_path.iterdir():
        assert path.read_bytes() == (watched / path.name).read_bytes()


def test_registration_of_a_tracked_slice(watched: Path, tmp_path: Path) -> None:
    import pydicom

    run_ctreg("export", watched / "t.json", "--slice", 1, "-o", tmp_path / "r.dcm")
    ds = pydicom.dcmread(tmp_path / "r.dcm")
    image = pydicom.dcmread(SAMPLES / "track" / "track_001.dcm")
    assert ds.FrameOfReferenceUID == image.FrameOfReferenceUID
    assert ds.StudyInstanceUID == image.StudyInstanceUID
    (reference,) = ds.RegistrationSequence[0].ReferencedImageSequence
    assert reference.ReferencedSOPInstanceUID == image.SOPInstanceUID
    T = json.loads((watched / "t.json").read_text(encoding="utf-8"))["results"][1]["T_patient_model"]
    (matrix,) = ds.RegistrationSequence[1].MatrixRegistrationSequence[0].MatrixSequence
    written = np.array(matrix.FrameOfReferenceTransformationMatrix, dtype=float).reshape(4, 4)
    np.testing.assert_allclose(written, T, atol=1e-9)


def test_report_with_pictures(watched: Path, tmp_path: Path) -> None:
    page = tmp_path / "r.html"
    inputs = [part for number in range(N) for part in ("--slices", SAMPLES / "track" / f"track_{number:03d}.dcm")]
    run_ctreg("report", watched / "t.json", "-m", FRAME, *inputs, "-o", page)
    text = page.read_text(encoding="utf-8")
    assert text.count("data:image/jpeg") == N
    # the results hold UIDs; the page does not
    assert "2.25." not in text


def test_report_refuses_other_slices(watched: Path, tmp_path: Path) -> None:
    page = tmp_path / "r.html"
    result = run_ctreg("report", watched / "t.json", "--slices", SAMPLES / "calib", "-o", page, code=2)
    assert "give the input the results were made from" in result.stderr
    assert not page.exists()


def test_canary_reaches_no_export_and_no_report(watched: Path, tmp_path: Path) -> None:
    """The patient fields of the samples hold the word CANARY."""
    inputs = [part for number in range(N) for part in ("--slices", SAMPLES / "track" / f"track_{number:03d}.dcm")]
    run_ctreg("report", watched / "t.json", "-m", FRAME, *inputs, "-o", tmp_path / "r.html")
    names = ["m_{slice}.mrk.json", "r_{slice}.dcm", "t.mat", "t.tf.json", "t.kitti", "t.tum"]
    run_ctreg("export", watched / "t.json", "-m", FRAME, *(part for name in names for part in ("-o", tmp_path / name)))
    assert b"CANARY" in (SAMPLES / "track" / "track_000.dcm").read_bytes()
    files = [*tmp_path.iterdir(), *watched.iterdir()]
    assert len(files) > 15
    for path in files:
        assert b"CANARY" not in path.read_bytes(), path.name
        if path.suffix != ".dcm" and path.name not in ("t.json", "t.jsonl"):
            assert b"2.25." not in path.read_bytes(), path.name


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("track", "-m", FRAME), "--watch DIR"),
        (("track", "x", "--watch", ".", "-m", FRAME), "takes no INPUT"),
        (("track", "--watch", "nowhere", "-m", FRAME), "no such folder"),
        (("track", "x", "--idle", "3", "-m", FRAME), "go with --watch"),
        (("track", SAMPLES / "track", "-m", FRAME, "--igtl", "nonsense"), "HOST"),
        (("track", SAMPLES / "track", "-m", FRAME, "-o", "x.dcm"), "{slice}"),
        (("track", SAMPLES / "track", "-m", FRAME, "-o", "nowhere/x.mat"), "does not exist"),
        (("export", "nowhere.json", "-o", "x.mat"), "nowhere.json"),
        (("export", "nowhere.json", "-o", "x.xyz"), ".seq.mha"),
        (("report", "nowhere.json"), "-o report.html"),
        (("report", "nowhere.json", "-o", "x.pdf"), ".html"),
    ],
)
def test_mistakes_are_one_message(
    arguments: tuple[object, ...], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = run_ctreg(*arguments, code=2)
    assert message in result.stderr
    assert "Traceback" not in result.stderr
    assert not list(tmp_path.iterdir())
