"""A folder that a scanner or a PACS is filling, as slices in the order in which they are complete.

When is a file complete? Writers rename, write slowly, or copy over a network into a file that has its full length from
the start; and nobody says when they are done. So a file counts when its length and time of change have rested for a
moment **and** it reads as a whole image. One that does not read, or ends in nothing but zeros (room made beforehand),
may still be on its way: it gets more time, and only then counts as it is. Names that writers use for unfinished files
are not looked at. The folder is polled, since network shares tell nobody of changes.
"""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from ctreg_cli.errors import InputError
from ctreg_cli.imaging.slice import Slice, UnreadableSlice
from ctreg_cli.io.image_files import printable, shown
from ctreg_cli.io.image_record import ImageRecord, Kind
from ctreg_cli.io.images import read_image_file
from ctreg_cli.io.live_order import LiveOrder, arrival_order

UNFINISHED_SUFFIXES = (".part", ".partial", ".tmp", ".temp", ".filepart", ".crdownload", ".lock", "~")
#: a folder changed this recently may change again without a new time of change (file systems count in steps)
_TIME_STEP_NS = 2_500_000_000
_TAIL_BYTES = 4096
NOT_A_SLICE = "localizer or screen capture"


@dataclass(frozen=True, slots=True, kw_only=True)
class WatchOptions:
    """How long to wait for what."""

    #: from look to look
    poll_s: float = 0.05
    #: an image at rest this long is complete
    settle_s: float = 0.15
    #: what does not read as an image, or ends in zeros, is taken as it is after resting this long
    patience_s: float = 2.0
    #: the end, when nothing has come for this long; None: never
    idle_s: float | None = None
    #: the end, after so many slices; None: never
    count: int | None = None


@dataclass(slots=True)
class _Waiting:
    """A file not yet complete."""

    #: (bytes, time of change), as last seen
    state: tuple[int, int]
    since_s: float
    #: it rested, and did not look complete all the same
    doubtful: bool = False


@dataclass(slots=True)
class WatchedFolder:
    """Slices of a folder and its subfolders, each as soon as it is complete; those there already come first.

    Every file counts once, under the name it has when it is complete.

    Raises:
        InputError: there is no such folder, or it cannot be opened.
    """

    folder: Path
    options: WatchOptions = field(default_factory=WatchOptions)
    clock: Callable[[], float] = time.monotonic
    sleep: Callable[[float], None] = time.sleep
    #: why files were left out → how many
    skipped: Counter[str] = field(default_factory=Counter)
    #: folder → names seen in it
    _known: dict[Path, set[str]] = field(default_factory=dict)
    _changed_ns: dict[Path, int] = field(default_factory=dict)
    _waiting: dict[Path, _Waiting] = field(default_factory=dict)
    _order: LiveOrder = field(default_factory=LiveOrder)
    _second_chances: set[Path] = field(default_factory=set)

    def __post_init__(self) -> None:
        if not self.folder.is_dir():
            what = "is a file" if self.folder.exists() else "no such folder"
            raise InputError(f"{shown(self.folder)}: {what}; name the folder that will be filled")
        try:
            os.scandir(self.folder).close()
        except OSError as error:
            raise InputError(f"{shown(self.folder)}: the folder cannot be opened ({error.strerror})") from error
        self._known[self.folder] = set()

    def __iter__(self) -> Iterator[Slice | UnreadableSlice]:
        """Slices until nothing has come for ``idle_s``, or ``count`` have."""
        options, done = self.options, 0
        last_s = self.clock()
        while True:
            self._look_for_new()
            complete = self._complete()
            for record, path in complete:
                item = record.load()
                if isinstance(item, UnreadableSlice) and self._wait_again(record, path):
                    continue
                yield item
                done += 1
                if done == options.count:
                    return
            if complete or self._waiting:
                last_s = self.clock()
            elif options.idle_s is not None and self.clock() - last_s >= options.idle_s:
                return
            self.sleep(options.poll_s)

    def _look_for_new(self) -> None:
        """Put files not seen before on the waiting list."""
        for folder, known in list(self._known.items()):
            try:
                changed_ns = folder.stat().st_mtime_ns
                if changed_ns == self._changed_ns.get(folder):
                    continue
                with os.scandir(folder) as entries:
                    # an unfinished name is looked at again: a rename changes the folder
                    fresh = [entry for entry in entries if entry.name not in known and not _is_unfinished(entry.name)]
                for entry in fresh:
                    if entry.is_dir(follow_symlinks=False):
                        self._known.setdefault(Path(entry.path), set())
                    else:
                        self._waiting[Path(entry.path)] = _Waiting(state=(-1, -1), since_s=self.clock())
                    known.add(entry.name)
                if time.time_ns() - changed_ns > _TIME_STEP_NS:
                    self._changed_ns[folder] = changed_ns
            except OSError:  # the folder has gone, or the share is away for a moment: the next look will tell
                continue

    def _complete(self) -> list[tuple[ImageRecord, Path]]:
        """The images that are complete, in order, with their files."""
        found: list[tuple[ImageRecord, Path]] = []
        for path, waiting in list(self._waiting.items()):
            try:
                status = path.stat()
            except OSError:
                del self._waiting[path]  # renamed or deleted: its new name is a new file
                continue
            now_s, state = self.clock(), (status.st_size, status.st_mtime_ns)
            if state != waiting.state:
                self._waiting[path] = _Waiting(state=state, since_s=now_s)
                continue
            rested_s = now_s - waiting.since_s
            if rested_s < (self.options.patience_s if waiting.doubtful else self.options.settle_s):
                continue
            records = read_image_file(path, printable(path.relative_to(self.folder).as_posix()))
            looks_whole = not isinstance(records, str) and not any(record.problem for record in records)
            if not waiting.doubtful and not (looks_whole and not _ends_in_zeros(path)):
                waiting.doubtful = True
                continue
            del self._waiting[path]
            found += [(record, path) for record in self._slices(records)]
        places = {id(record): path for record, path in found}
        return [(record, places[id(record)]) for record in arrival_order([record for record, _ in found])]

    def _slices(self, records: list[ImageRecord] | str) -> list[ImageRecord]:
        """The records that are slices, with series and time; the others are counted."""
        if isinstance(records, str):
            self.skipped[records] += 1
            return []
        slices = [record for record in records if record.series.kind is Kind.SLICE]
        if len(slices) < len(records):
            self.skipped[NOT_A_SLICE] += len(records) - len(slices)
        return [self._order.place(record) for record in slices]

    def _wait_again(self, record: ImageRecord, path: Path) -> bool:
        """Give an image whose pixels cannot be decoded yet more time, once; a file of several frames gets none."""
        if record.problem or record.frame or path in self._second_chances:
            return False
        self._second_chances.add(path)
        self._waiting[path] = _Waiting(state=(-1, -1), since_s=self.clock(), doubtful=False)
        return True


def _is_unfinished(name: str) -> bool:
    return name.startswith(".") or name.lower().endswith(UNFINISHED_SUFFIXES)


def _ends_in_zeros(path: Path) -> bool:
    """Whether a file may have been given its length before its content."""
    try:
        with path.open("rb") as file:
            file.seek(0, os.SEEK_END)
            file.seek(max(0, file.tell() - _TAIL_BYTES))
            return not any(file.read())
    except OSError:
        return True
