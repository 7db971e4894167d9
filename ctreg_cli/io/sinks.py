"""Where a stream of results goes: CSV, JSON and JSON Lines files, and CSV on standard output, several at once.

What is written is an :class:`Encoding`'s business, how it reaches the disk a sink's.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Generic, Protocol, Self, TextIO, TypeVar

import numpy as np

from ctreg_cli.errors import InputError
from ctreg_cli.io.atomic import AtomicFile, check_folder
from ctreg_cli.io.interrupts import records, uninterrupted

Item = TypeVar("Item", contravariant=True)

#: suffix → what it means, for help texts and errors
FORMATS: Mapping[str, str] = {
    ".csv": "table",
    ".json": "one document",
    ".jsonl": "one line a slice, as it is done",
    ".tum": "trajectory, poses only",
}
STANDARD_OUTPUT = "-"


@dataclass(frozen=True, slots=True, kw_only=True)
class Stamped:
    """A line of a trajectory without its time stamp."""

    #: of the slice
    number: int
    time_s: float | None
    text: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Encoding(Generic[Item]):
    """How one item (a slice's result, a slice's spots) becomes rows and records."""

    columns: Sequence[str]
    #: values in the order of ``columns``; None becomes an empty cell
    rows: Callable[[Item], Iterable[Sequence[object]]]
    #: JSON object of one item
    record: Callable[[Item], Mapping[str, object]]
    #: head of a JSON document; gets the first item, or None when there was none
    header: Callable[[Item | None], Mapping[str, object]]
    #: key of the list of records in a JSON document
    records_key: str
    #: lines of a trajectory, and the comment above them; None where there is none
    trajectory: Callable[[Item], Iterable[Stamped]] | None = None
    trajectory_header: str = ""


class Sink(Protocol[Item]):
    """One output."""

    def write(self, item: Item) -> None: ...
    def finish(self) -> None: ...
    def abandon(self) -> None: ...


def plain(value: Any) -> Any:
    """The value as strict JSON has it: arrays as lists, a number that is not finite as null."""
    if isinstance(value, np.ndarray | np.generic):
        if np.isfinite(value).all():
            return value.tolist()
        value = value.tolist()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return value


def rounded(value: float, digits: int) -> float:
    """The nearest number of that many significant digits: no noise in a file, and the same in CSV and JSON."""
    return float(f"{value:.{digits}g}")


def cell(value: object) -> str:
    """Text of a CSV cell: shortest form that reads back the same, empty for None and NaN."""
    if isinstance(value, str):
        return value
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    if isinstance(value, float):
        text = repr(float(value))
        return text.removesuffix(".0")
    return str(value)


def _json(value: object) -> str:
    try:
        return json.dumps(value, allow_nan=False, ensure_ascii=False, default=plain)
    except ValueError:  # a number is not finite; looking for it beforehand would cost more than all the rest
        return json.dumps(plain(value), allow_nan=False, ensure_ascii=False)


class CsvStream(Generic[Item]):
    """CSV on an open stream, flushed after every item: the next program in a pipe sees a slice once it is done."""

    def __init__(self, stream: TextIO, encoding: Encoding[Item]) -> None:
        self._stream, self._encoding = stream, encoding
        self._writer = csv.writer(stream, lineterminator="\n")
        self._started = False

    def _start(self) -> None:
        if not self._started:
            self._writer.writerow(self._encoding.columns)
            self._started = True

    def write(self, item: Item) -> None:
        self._start()
        self._writer.writerows([cell(value) for value in row] for row in self._encoding.rows(item))
        self._stream.flush()

    def finish(self) -> None:
        self._start()
        self._stream.flush()

    def abandon(self) -> None:
        """What has left cannot be called back."""


class CsvFile(CsvStream[Item]):
    """A table that appears when complete."""

    def __init__(self, path: Path, encoding: Encoding[Item]) -> None:
        self._file = AtomicFile(path)
        super().__init__(self._file.stream, encoding)

    def finish(self) -> None:
        super().finish()
        self._file.commit()

    def abandon(self) -> None:
        self._file.abandon()


class JsonFile(Generic[Item]):
    """A document that appears when complete; one record a line, so that memory stays flat and diffs are readable."""

    def __init__(self, path: Path, encoding: Encoding[Item]) -> None:
        self._file, self._encoding = AtomicFile(path), encoding
        self._separator = ""

    def _start(self, item: Item | None) -> None:
        head = _json(self._encoding.header(item)).removesuffix("}")
        self._file.stream.write(f"{head}, {_json(self._encoding.records_key)}: [\n")

    def write(self, item: Item) -> None:
        if not self._separator:
            self._start(item)
        self._file.stream.write(self._separator + _json(self._encoding.record(item)))
        self._separator = ",\n"

    def finish(self) -> None:
        if not self._separator:
            self._start(None)
        self._file.stream.write("\n]}\n")
        self._file.commit()

    def abandon(self) -> None:
        self._file.abandon()


class JsonLinesFile(Generic[Item]):
    """Header on the first line, then a record a line, each flushed: the one file another program may watch grow."""

    def __init__(self, path: Path, encoding: Encoding[Item]) -> None:
        self._encoding = encoding
        check_folder(path)
        self._path, self._is_new = path, not path.exists()
        try:
            # not "w": an earlier file stays until there is something to put in its place; not buffered: what could not
            # be written shall not be tried again by closing
            self._stream = path.open("ab", buffering=0)
        except OSError as error:
            raise InputError(f"{path}: cannot be written ({error.strerror})") from error
        self._is_file = path.is_file()
        self._started = False
        #: bytes of whole lines
        self._whole = 0

    def _line(self, value: object) -> None:
        data = f"{_json(value)}\n".encode()
        left = memoryview(data)
        try:
            while left:
                left = left[self._stream.write(left) :]
        except OSError:  # the disk is full: the part of a line that went in goes out again
            self._cut(self._whole)
            raise
        self._whole += len(data)

    def _cut(self, length: int) -> None:
        """Leave so many bytes of a file; of a pipe or a device nothing can be taken back."""
        if self._is_file:
            self._stream.truncate(length)

    def _start(self, item: Item | None) -> None:
        if not self._started:
            self._cut(0)
            self._line(self._encoding.header(item))
            self._started = True

    def write(self, item: Item) -> None:
        self._start(item)
        self._line(self._encoding.record(item))

    def finish(self) -> None:
        self._start(None)
        self._stream.close()

    def abandon(self) -> None:
        """The lines written are whole and stay."""
        self._stream.close()
        if self._is_new and not self._started:
            self._path.unlink(missing_ok=True)


class TrajectoryFile(Generic[Item]):
    """Lines of text, a pose each, that appear when complete; stamped with seconds, or all with slice numbers.

    Whether any pose has a time may come out late. Numbers written by then are taken back, not the whole kept in mind.

    Raises:
        InputError: there are no poses in this encoding.
    """

    def __init__(self, path: Path, encoding: Encoding[Item]) -> None:
        if encoding.trajectory is None:
            raise InputError(f"-o {path}: a trajectory holds poses, and there are none here; use .csv, .json or .jsonl")
        self._lines = encoding.trajectory
        self._file = AtomicFile(path)
        header = encoding.trajectory_header + "\n"
        self._file.stream.write(header)
        #: where the poses begin
        self._body = len(header.encode())
        self._has_times: bool | None = None
        self._n_numbered = 0

    def write(self, item: Item) -> None:
        for line in self._lines(item):
            if line.time_s is None:
                self._write_timeless(line)
            else:
                self._write_timed(line, line.time_s)

    def _write_timed(self, line: Stamped, time_s: float) -> None:
        stream = self._file.stream
        if self._has_times is False:
            if not self._file.can_rewind:  # go on with numbers
                stream.write(f"{line.number:.6f} {line.text}\n")
                return
            stream.seek(self._body)
            stream.truncate()
            stream.write(f"# left out for want of a time: {self._n_numbered} poses at the start\n")
        self._has_times = True
        stream.write(f"{time_s:.6f} {line.text}\n")

    def _write_timeless(self, line: Stamped) -> None:
        stream = self._file.stream
        if self._has_times:
            stream.write(f"# left out for want of a time: slice {line.number}\n")
            return
        if self._has_times is None:
            self._has_times = False
            stream.write("# no times: the slice's number stands for the second\n")
        self._n_numbered += 1
        stream.write(f"{line.number:.6f} {line.text}\n")

    def finish(self) -> None:
        self._file.commit()

    def abandon(self) -> None:
        self._file.abandon()


class Sinks(Generic[Item]):
    """Several outputs as one context: all appear at a clean end **or an interrupt** (with what was finished), none
    after an error.

    A reader of standard output who leaves early (``| head``) takes only that output away; :attr:`alive` says whether
    anyone is still listening.

    Args:
        sinks: outputs, by the name they have in messages.
    """

    def __init__(self, sinks: Sequence[tuple[str, Sink[Item]]] = ()) -> None:
        self._sinks = list(sinks)
        self._handler = records()
        self._tell: Callable[[str], None] | None = None
        #: what was said of outputs that failed while the others went on
        self.lost: list[str] = []

    @property
    def alive(self) -> bool:
        return bool(self._sinks)

    def add(self, name: str, sink: Sink[Item], *, first: bool = False) -> None:
        """One more output, written before all others where it cannot wait."""
        self._sinks.insert(0 if first else len(self._sinks), (name, sink))

    def outlive_failures(self, tell: Callable[[str], None]) -> None:
        """From now on an output that cannot be written (a full disk) is left behind, and told; the others go on."""
        self._tell = tell

    def write(self, item: Item) -> None:
        """Give an item to every output.

        Raises:
            InputError: an output cannot be written, and the others shall not do without it.
        """
        with uninterrupted():
            for name, sink in tuple(self._sinks):
                try:
                    sink.write(item)
                except BrokenPipeError:
                    self._sinks.remove((name, sink))
                except OSError as error:
                    self.lose(_unwritable(name, error), error)
                    self._sinks.remove((name, sink))
                    sink.abandon()

    def lose(self, text: str, error: Exception) -> None:
        """Go on without an output that failed, if that is wanted.

        Raises:
            InputError: it is not.
        """
        if self._tell is None:
            raise InputError(text) from error
        self.lost.append(text)
        self._tell(text)

    def __enter__(self) -> Self:
        self._handler.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        finish = kind is None or issubclass(kind, KeyboardInterrupt)
        try:
            with uninterrupted():
                while self._sinks:
                    name, sink = self._sinks.pop(0)
                    try:
                        self._end(name, sink, finish)
                    except Exception:
                        for left in (sink, *(other for _, other in self._sinks)):
                            left.abandon()
                        raise
        finally:
            self._handler.__exit__(None, None, None)

    def _end(self, name: str, sink: Sink[Item], finish: bool) -> None:
        try:
            if finish:
                sink.finish()
            else:
                sink.abandon()
        except BrokenPipeError:
            return
        except (OSError, InputError) as error:
            self.lose(_unwritable(name, error), error)


def _unwritable(name: str, error: OSError | InputError) -> str:
    return str(error) if isinstance(error, InputError) else f"{name}: cannot be written ({error.strerror or error})"


def format_of(output: str) -> str:
    """The suffix that chooses the format of ``-o``; ``-`` is CSV.

    Raises:
        InputError: another suffix; the message lists those there are.
    """
    suffix = ".csv" if output == STANDARD_OUTPUT else Path(output).suffix.lower()
    if suffix not in FORMATS:
        raise InputError(f"-o {output}: the suffix chooses the format, and must be one of {', '.join(FORMATS)}")
    return suffix


def check_outputs(outputs: Sequence[str] | None, inputs: Sequence[str] = ()) -> list[str]:
    """The values of ``-o``, ``-`` when there are none; to be called before any work is done.

    Raises:
        InputError: an unknown suffix, the same output twice, one that is an input, or a folder that does not exist.
    """
    outputs = list(outputs or [STANDARD_OUTPUT])
    for output in outputs:
        format_of(output)
    files = [Path(output) for output in outputs if output != STANDARD_OUTPUT]
    for file in files:
        check_folder(file)
    if len({file.resolve() for file in files}) < len(files) or outputs.count(STANDARD_OUTPUT) > 1:
        raise InputError(f"-o {' -o '.join(outputs)}: the same output twice")
    for file in files:
        if file.resolve() in {Path(name).resolve() for name in inputs}:
            raise InputError(f"-o {file}: is an input, and would be replaced; name another file")
    return outputs


def open_sinks(outputs: Sequence[str], encoding: Encoding[Item], standard_output: TextIO) -> Sinks[Item]:
    """Sinks for the values of ``-o``; none means CSV on ``standard_output``.

    Raises:
        InputError: as :func:`check_outputs`, or a place that cannot be written; then nothing is left.
    """
    sinks: list[tuple[str, Sink[Item]]] = []
    try:
        for output in check_outputs(outputs):
            name = "standard output" if output == STANDARD_OUTPUT else output
            sinks.append((name, _open(output, format_of(output), encoding, standard_output)))
    except InputError:
        for _, sink in sinks:
            sink.abandon()
        raise
    return Sinks(sinks)


def _open(output: str, kind: str, encoding: Encoding[Item], standard_output: TextIO) -> Sink[Item]:
    if output == STANDARD_OUTPUT:
        return CsvStream(standard_output, encoding)
    if kind == ".csv":
        return CsvFile(Path(output), encoding)
    if kind == ".json":
        return JsonFile(Path(output), encoding)
    if kind == ".tum":
        return TrajectoryFile(Path(output), encoding)
    return JsonLinesFile(Path(output), encoding)
