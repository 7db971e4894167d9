"""Whatever way a writer takes, every slice comes out once, whole, and in order; on a clock of the test's own."""

from __future__ import annotations

import itertools
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from ctreg_cli.errors import InputError
from ctreg_cli.imaging.slice import Slice, UnreadableSlice
from ctreg_cli.io.images import read_slices
from ctreg_cli.io.watch import WatchedFolder, WatchOptions

SAMPLES = Path(__file__).parents[2] / "sample_data" / "track"
NAMES = [f"track_{number:03d}.dcm" for number in range(4)]

Step = Callable[[], None]


class Scanner:
    """Acts on the folder between looks: one step a poll, the clock of the watcher moving with it."""

    def __init__(self, steps: list[Step]) -> None:
        self.now_s = 0.0
        self._steps = iter(steps)
        self._writes = itertools.count(1)

    def clock(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        assert self.now_s < 600, "the watcher does not end"
        self.now_s += seconds
        step = next(self._steps, None)
        if step:
            step()

    def stamp(self, path: Path) -> None:
        """A time of change of its own for every write: file systems count in steps longer than a test's."""
        tick = 10**18 + next(self._writes) * 10**6
        os.utime(path, ns=(tick, tick))


def watch(folder: Path, scanner: Scanner, **options: float) -> list[Slice | UnreadableSlice]:
    chosen = WatchOptions(**({"idle_s": 5.0} | options))  # type: ignore[arg-type]
    return list(WatchedFolder(folder, chosen, clock=scanner.clock, sleep=scanner.sleep))


def data(name: str) -> bytes:
    return (SAMPLES / name).read_bytes()


def writer(folder: Path, scanner: Scanner, content: bytes, name: str) -> Callable[[int, int], Step]:
    """Writes part of a file, from a place to a place."""

    def write(start: int, stop: int) -> Step:
        def step() -> None:
            path = folder / name
            path.touch()
            with path.open("r+b") as file:
                file.seek(start)
                file.write(content[start:stop])
            scanner.stamp(path)

        return step

    return write


def same_as_sample(item: Slice | UnreadableSlice, name: str) -> bool:
    (expected,) = read_slices(SAMPLES / name)
    return isinstance(item, Slice) and np.array_equal(item.stored, expected.stored)


def nothing() -> None:
    pass


def test_files_there_already_come_in_order(tmp_path: Path) -> None:
    for name in reversed(NAMES):
        shutil.copy(SAMPLES / name, tmp_path)
    found = watch(tmp_path, Scanner([]))
    assert [item.info.source for item in found] == NAMES
    times = [item.info.time_s for item in found]
    expected = [slice_.info.time_s for slice_ in read_slices(*(SAMPLES / name for name in NAMES))]
    assert times == pytest.approx(expected)
    assert len({item.info.series for item in found}) == 1


def test_slow_write_is_waited_for(tmp_path: Path) -> None:
    """A writer that pauses longer than the settling time, in the header and in the pixels."""
    content, scanner = data(NAMES[0]), Scanner([])
    write = writer(tmp_path, scanner, content, "slow.dcm")
    cuts = [0, 100, 700, len(content) // 2, len(content) - 1, len(content)]
    steps: list[Step] = []
    for start, stop in itertools.pairwise(cuts):
        steps += [write(start, stop), *[nothing] * 20]  # 1 s between the parts
    scanner._steps = iter(steps)
    (item,) = watch(tmp_path, scanner)
    assert same_as_sample(item, NAMES[0])


def test_room_made_beforehand_is_waited_for(tmp_path: Path) -> None:
    """Full length at once, content later: header first, then pixels from the front."""
    content, scanner = data(NAMES[0]), Scanner([])
    write = writer(tmp_path, scanner, content, "room.dcm")

    def make_room() -> None:
        (tmp_path / "room.dcm").write_bytes(bytes(len(content)))
        scanner.stamp(tmp_path / "room.dcm")

    third = len(content) // 3
    pause = [nothing] * 20
    parts = [write(0, third), *pause, write(third, 2 * third), *pause, write(2 * third, len(content))]
    scanner._steps = iter([make_room, *pause, *parts])
    (item,) = watch(tmp_path, scanner)
    assert same_as_sample(item, NAMES[0])


@pytest.mark.parametrize("unfinished", [".hidden.dcm", "a.dcm.part", "a.dcm.tmp", "a.filepart"])
def test_rename_when_done(tmp_path: Path, unfinished: str) -> None:
    content, scanner = data(NAMES[1]), Scanner([])
    write = writer(tmp_path, scanner, content, unfinished)

    def rename() -> None:
        (tmp_path / unfinished).rename(tmp_path / "a.dcm")

    scanner._steps = iter([write(0, len(content)), *[nothing] * 80, rename])
    found = watch(tmp_path, scanner)
    assert [item.info.source for item in found] == ["a.dcm"]
    assert same_as_sample(found[0], NAMES[1])


def test_broken_file_becomes_a_row_and_others_go_on(tmp_path: Path) -> None:
    scanner = Scanner([])
    (tmp_path / "a.dcm").write_bytes(data(NAMES[0])[:5000])
    (tmp_path / "notes.txt").write_text("not an image")
    shutil.copy(SAMPLES / NAMES[1], tmp_path / "b.dcm")
    watched = WatchedFolder(tmp_path, WatchOptions(idle_s=5.0), clock=scanner.clock, sleep=scanner.sleep)
    found = {item.info.source: item for item in watched}
    assert isinstance(found["a.dcm"], UnreadableSlice)
    assert isinstance(found["b.dcm"], Slice)
    assert dict(watched.skipped) == {"not an image": 1}


def test_subfolders_made_later_are_followed(tmp_path: Path) -> None:
    def arrive() -> None:
        (tmp_path / "study" / "series").mkdir(parents=True)
        shutil.copy(SAMPLES / NAMES[2], tmp_path / "study" / "series")

    found = watch(tmp_path, Scanner([*[nothing] * 5, arrive]))
    assert [item.info.source for item in found] == [f"study/series/{NAMES[2]}"]


def test_count_ends_it(tmp_path: Path) -> None:
    for name in NAMES:
        shutil.copy(SAMPLES / name, tmp_path)
    assert len(watch(tmp_path, Scanner([]), count=2)) == 2


def test_idle_counts_from_the_last_slice(tmp_path: Path) -> None:
    scanner = Scanner([])

    def copies() -> Iterator[Step]:
        for name in NAMES:
            yield from [nothing] * 80  # 4 s: less than the idle time, together more
            yield lambda name=name: shutil.copy(SAMPLES / name, tmp_path) and None  # type: ignore[misc]

    scanner._steps = iter(list(copies()))
    assert len(watch(tmp_path, scanner)) == len(NAMES)


def test_a_file_that_goes_away_is_no_slice(tmp_path: Path) -> None:
    path = tmp_path / "a.dcm"
    path.write_bytes(data(NAMES[0])[:1000])
    assert watch(tmp_path, Scanner([nothing, nothing, path.unlink])) == []


def test_only_folders_can_be_watched(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        WatchedFolder(tmp_path / "nowhere")
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="is a file"):
        WatchedFolder(tmp_path / "file")
