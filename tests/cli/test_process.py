"""As a real process: pipes, readers that leave, and Ctrl-C."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from ctreg_cli.io.results import read_results
from tests.cli.conftest import FRAME

CTREG = [sys.executable, "-m", "ctreg_cli"]
N_MANY = 400
PATIENCE_S = 60


@pytest.fixture(scope="module")
def many_spots(spots_csv: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A spots file long enough for something to happen in the middle."""
    head, *rows = spots_csv.read_text(encoding="utf-8").splitlines()
    first = [row.partition(",")[2] for row in rows if row.startswith("0,")]
    path = tmp_path_factory.mktemp("many") / "spots.csv"
    lines = [f"{index},{row}" for index in range(N_MANY) for row in first]
    path.write_text("\n".join([head, *lines, ""]), encoding="utf-8")
    return path


def test_stages_in_a_pipe(two_slices: Path) -> None:
    segment = subprocess.Popen(
        [*CTREG, "segment", two_slices, "-o", "-"], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    pose = subprocess.run([*CTREG, "pose", "-", "-m", FRAME], stdin=segment.stdout, capture_output=True, text=True)
    _, segment_said = segment.communicate()
    assert (segment.returncode, pose.returncode) == (0, 0), pose.stderr
    assert [line.split(",")[3] for line in pose.stdout.splitlines()] == ["status", "ok", "ok"]
    assert b"spots" in segment_said
    assert "2 ok" in pose.stderr


def test_a_reader_that_leaves_is_no_error(many_spots: Path) -> None:
    process = subprocess.Popen(
        [*CTREG, "pose", many_spots, "-m", FRAME], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stderr is not None
    assert process.stdout.readline().startswith("slice,")
    process.stdout.close()
    said = process.stderr.read()
    process.stderr.close()
    assert process.wait(PATIENCE_S) == 0
    assert "Error" not in said
    assert "Exception" not in said


def test_an_interrupt_writes_what_is_finished(many_spots: Path, tmp_path: Path) -> None:
    table, document, lines = (tmp_path / f"p{suffix}" for suffix in (".csv", ".json", ".jsonl"))
    outputs = [word for path in (table, document, lines) for word in ("-o", str(path))]
    process = subprocess.Popen([*CTREG, "pose", many_spots, "-m", FRAME, *outputs], stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + PATIENCE_S
    while not lines.exists() or lines.read_text(encoding="utf-8").count("\n") < 4:
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130, said
    assert "Traceback" not in said
    assert "interrupted" in said
    rows = read_results(table)
    records = json.loads(document.read_text(encoding="utf-8"))["results"]
    assert 3 <= len(rows) == len(records) == len(lines.read_text(encoding="utf-8").splitlines()) - 1 < N_MANY
    assert [row.index for row in rows] == list(range(len(rows)))
    assert sorted(tmp_path.iterdir()) == sorted([table, document, lines])


@pytest.mark.parametrize("loading", ["typer", "ctreg_cli.cli.segment"])
def test_an_interrupt_while_loading_is_silent(loading: str) -> None:
    script = f"""
import os, signal, sys
class Finger:
    def find_spec(self, name, path=None, target=None):
        if name == {loading!r}:
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Finger())
from ctreg_cli.__main__ import main
sys.argv = ["ctreg", "--version"]
main()
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=PATIENCE_S)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


FULL = Path("/dev/full")
FULL_NAMES = ("full.csv", "full.json", "full.jsonl", "full.tum")


@pytest.mark.skipif(not FULL.exists(), reason="this system has no /dev/full")
@pytest.mark.parametrize(
    ("outputs", "place"), [([], "standard output"), *((["-o", name], name) for name in FULL_NAMES)]
)
def test_a_full_disk_is_named(two_slices: Path, tmp_path: Path, outputs: list[str], place: str) -> None:
    for name in FULL_NAMES:
        (tmp_path / name).symlink_to(FULL)
    with FULL.open("w") as full:
        done = subprocess.run(
            [*CTREG, "pose", two_slices, "-m", FRAME, *outputs, "-q"],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            cwd=tmp_path,
            timeout=PATIENCE_S,
        )
    assert done.returncode == 2
    assert done.stderr == f"ctreg: error: {place}: cannot be written (No space left on device)\n"


@pytest.mark.skipif(not FULL.exists(), reason="this system has no /dev/full")
def test_help_that_cannot_be_said_is_no_traceback() -> None:
    with FULL.open("w") as full:
        done = subprocess.run([*CTREG, "--help"], stdout=full, stderr=subprocess.PIPE, text=True, timeout=PATIENCE_S)
    assert done.returncode == 2
    assert done.stderr == "ctreg: error: standard output: No space left on device\n"
