"""What the user names, told apart: images, one spots file, standard input; never a mixture."""

from __future__ import annotations

import io
import shutil
import sys
from pathlib import Path

import pytest

from ctreg_cli.errors import InputError, SpotsFileError
from ctreg_cli.imaging.slice import Slice
from ctreg_cli.imaging.spot_slice import SpotSlice
from ctreg_cli.io.sources import open_sources

SLICES = Path(__file__).parents[2] / "sample_data" / "calib"
TABLE = "slice,u_px,v_px\n4,1,2\n9,3,4\n"


class Stdin(io.TextIOWrapper):
    def __init__(self, content: bytes, *, terminal: bool = False) -> None:
        super().__init__(io.BytesIO(content))
        self._terminal = terminal

    def isatty(self) -> bool:
        return self._terminal


@pytest.fixture
def table(tmp_path: Path) -> str:
    path = tmp_path / "spots.csv"
    path.write_text(TABLE, encoding="utf-8")
    return str(path)


def test_a_folder_of_images() -> None:
    source = open_sources([str(SLICES)])
    slices = list(source)
    assert source.kind == "images"
    assert len(source) == len(slices) == 4
    assert all(isinstance(slice_, Slice) for slice_ in slices)
    assert [slice_.info.source for slice_ in slices] == [f"calib_{i:03d}.dcm" for i in range(4)]
    assert sum(source.skipped.values()) == 1  # truth.json lies beside


def test_a_spots_file_keeps_its_numbers(table: str) -> None:
    source = open_sources([table], spot_sd_px=0.5)
    slices = list(source)
    assert source.kind == "spots"
    assert len(source) == 2
    for slice_, index in zip(slices, (4, 9), strict=True):
        assert isinstance(slice_, SpotSlice)
        assert slice_.index == index
        assert slice_.spots.sd_px.tolist() == [[0.5, 0.5]]


def test_standard_input(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", Stdin(TABLE.encode()))
    assert len(open_sources(["-"])) == 2


@pytest.mark.parametrize(
    ("content", "terminal", "wanted"),
    [(b"", False, "standard input: is empty"), (b"x\n", False, "standard input:1: no column"), (b"", True, "keyboard")],
)
def test_standard_input_without_spots(
    monkeypatch: pytest.MonkeyPatch, content: bytes, terminal: bool, wanted: str
) -> None:
    monkeypatch.setattr(sys, "stdin", Stdin(content, terminal=terminal))
    with pytest.raises(InputError, match=wanted):
        open_sources(["-"])


def test_a_mixture_is_refused(table: str) -> None:
    for inputs in ([table, str(SLICES)], [str(SLICES), table], [table, table], [table, "-"]):
        with pytest.raises(InputError, match="either images or one spots file"):
            open_sources(inputs)


def test_a_series_number_means_nothing_to_a_spots_file(table: str) -> None:
    with pytest.raises(InputError, match="--series 2"):
        open_sources([table], series=2)


def test_what_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(SpotsFileError, match=r"absent\.csv: cannot be read"):
        open_sources([str(tmp_path / "absent.csv")])
    with pytest.raises(InputError, match="absent"):
        open_sources([str(tmp_path / "absent")])


def test_a_folder_may_be_called_like_a_table(tmp_path: Path) -> None:
    folder = tmp_path / "run.csv"
    folder.mkdir()
    shutil.copy(SLICES / "calib_000.dcm", folder)
    assert open_sources([str(folder)]).kind == "images"
