"""Running ``ctreg`` in this process, on the sample series."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from ctreg_cli.cli.app import app

SAMPLES = Path(__file__).parents[2] / "sample_data"
FRAME = str(SAMPLES / "frame.yaml")

Run = Callable[..., Result]


def run_ctreg(*arguments: object, code: int = 0, stdin: str | None = None) -> Result:
    """Run a command, expecting an exit code; an exception that is no exit fails the test."""
    result = CliRunner().invoke(app, [str(argument) for argument in arguments], input=stdin)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    return result


@pytest.fixture(scope="session")
def two_slices(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the first two slices of the tracked series."""
    folder = tmp_path_factory.mktemp("two")
    for number in range(2):
        shutil.copy(SAMPLES / "track" / f"track_{number:03d}.dcm", folder)
    return folder


@pytest.fixture(scope="session")
def truth() -> dict[str, dict[str, Any]]:
    """True pose, scale and spots by file name."""
    found = {}
    for series in ("calib", "track"):
        for entry in json.loads((SAMPLES / series / "truth.json").read_text(encoding="utf-8")):
            found[entry["file"]] = {**entry, "T_slice_model": np.array(entry["T_slice_model"])}
    return found


@pytest.fixture(scope="session")
def spots_csv(two_slices: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What segment writes for the two slices."""
    path = tmp_path_factory.mktemp("spots") / "spots.csv"
    run_ctreg("segment", two_slices, "-o", path, "-q")
    return path
