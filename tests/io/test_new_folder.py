"""A folder of outputs is complete or absent, and never replaces what is not its own."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from ctreg_cli.errors import InputError
from ctreg_cli.io.new_folder import new_folder

OWN = re.compile(r"part_\d+\.txt")


def make(target: Path, n: int, *, overwrite: bool = False) -> None:
    with new_folder(target, overwrite=overwrite, own=OWN) as unfinished:
        for i in range(n):
            (unfinished / f"part_{i}.txt").write_text(str(n))


def entries(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_new_folder_appears_with_all_it_holds_and_parents_are_made(tmp_path: Path) -> None:
    make(tmp_path / "a" / "b", 3)
    assert entries(tmp_path / "a" / "b") == ["part_0.txt", "part_1.txt", "part_2.txt"]
    assert entries(tmp_path / "a") == ["b"]


def test_it_is_not_there_before_the_end_nor_after_a_failure(tmp_path: Path) -> None:
    def fail() -> None:
        with new_folder(tmp_path / "x", own=OWN) as unfinished:
            (unfinished / "part_0.txt").write_text("")
            assert not (tmp_path / "x").exists()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert entries(tmp_path) == []


def test_an_empty_folder_is_used_a_full_one_refused(tmp_path: Path) -> None:
    (tmp_path / "x").mkdir()
    make(tmp_path / "x", 1)
    with pytest.raises(InputError, match=r"is not empty.*--overwrite"):
        make(tmp_path / "x", 2)
    assert (tmp_path / "x" / "part_0.txt").read_text() == "1"


def test_overwriting_replaces_all_of_an_earlier_run(tmp_path: Path) -> None:
    make(tmp_path / "x", 3)
    make(tmp_path / "x", 2, overwrite=True)
    assert entries(tmp_path / "x") == ["part_0.txt", "part_1.txt"]
    assert (tmp_path / "x" / "part_0.txt").read_text() == "2"
    assert entries(tmp_path) == ["x"]


def test_overwriting_spares_a_folder_with_anything_else_in_it(tmp_path: Path) -> None:
    make(tmp_path / "x", 1)
    (tmp_path / "x" / "thesis.tex").write_text("years of work")
    with pytest.raises(InputError, match=r"1 entries .* such as thesis\.tex"):
        make(tmp_path / "x", 1, overwrite=True)
    assert entries(tmp_path / "x") == ["part_0.txt", "thesis.tex"]


def test_a_failed_overwrite_keeps_the_earlier_run(tmp_path: Path) -> None:
    make(tmp_path / "x", 1)

    def fail() -> None:
        with new_folder(tmp_path / "x", overwrite=True, own=OWN):
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert entries(tmp_path / "x") == ["part_0.txt"]
    assert entries(tmp_path) == ["x"]


def test_a_file_in_the_way_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x").write_text("")
    with pytest.raises(InputError, match="is a file"):
        make(tmp_path / "x", 1, overwrite=True)
    with pytest.raises(InputError, match="cannot be made"):
        make(tmp_path / "x" / "y", 1)
