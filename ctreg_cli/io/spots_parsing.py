"""Reading spots files: text to records at their lines, table or document, every mistake named at its place."""

from __future__ import annotations

import csv
import io
import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import TypeAdapter, ValidationError

from ctreg_cli.checks import SPOT_SDS_PX, demand, is_number
from ctreg_cli.errors import SpotsFileError
from ctreg_cli.imaging.spot_slice import SpotSlice
from ctreg_cli.imaging.spots import DEFAULT_SPOT_SD_PX
from ctreg_cli.io.spots_file import COLUMNS, SCHEMA
from ctreg_cli.io.spots_schema import SliceRecord, SpotsDocument

NEEDED = ("slice", "u_px", "v_px")
#: what is the same in every line of a slice
SLICE_COLUMNS = frozenset(
    (
        *("slice", "source", "time_s", "s_x_mm", "s_y_mm", "thickness_mm", "rows", "columns", "problem"),
        *("series", "image_position_mm", "image_orientation"),
    )
)
#: mistakes quoted from one file; the rest are counted
MAX_MISTAKES = 20
#: a wrong value longer than this is not quoted
MAX_QUOTED = 40
REMEDY = "a spots file is what ctreg segment writes"

_SLICES = TypeAdapter(list[SliceRecord])


def parse_spots(
    content: bytes, name: str, *, spot_sd_px: float = DEFAULT_SPOT_SD_PX
) -> tuple[list[SpotSlice], tuple[str, ...]]:
    """Slices and warnings from a spots file's content; ``name`` stands for the file in messages.

    Raises:
        SpotsFileError: as :func:`ctreg_cli.io.spots_file.read_spots`.
    """
    is_sd = is_number(spot_sd_px) and SPOT_SDS_PX[0] <= spot_sd_px <= SPOT_SDS_PX[1]
    demand(is_sd, "spot_sd_px", spot_sd_px, f"pixels from {SPOT_SDS_PX[0]:g} to {SPOT_SDS_PX[1]:g}")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise SpotsFileError(f"{name}: is no UTF-8 text; {REMEDY}") from error
    if not text.strip():
        raise SpotsFileError(f"{name}: is empty; {REMEDY}")
    is_json = text.lstrip().startswith(("{", "["))
    records = _parse_json(text, name) if is_json else _parse_table(text, name)
    if not records:
        raise SpotsFileError(f"{name}: holds no slice; {REMEDY}")
    numbers = Counter(record.slice for record in records)
    twice = [f"{name}: slice {number} is given {count} times" for number, count in numbers.items() if count > 1]
    if twice:
        raise _error(twice)
    records.sort(key=lambda record: record.slice)
    renumbered = [str(record.slice) for record in records if record.is_renumbered]
    warnings = [f"{name}: spots were left out, so the rest is numbered anew in slice {', '.join(renumbered)}"]
    return [record.spot_slice(spot_sd_px) for record in records], tuple(warnings if renumbered else ())


def _parse_table(text: str, name: str) -> list[SliceRecord]:
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    mistakes: list[str] = []
    slices: dict[str, _SliceRows] = {}
    try:
        columns = _columns(next(reader, []), name)
        for cells in reader:
            if not any(map(str.strip, cells)):
                continue  # a blank line, or a spreadsheet's row of commas
            if len(cells) != len(columns):
                mistakes.append(
                    f"{name}:{reader.line_num}: {len(cells)} cells under {len(columns)} columns; "
                    "cells are separated by ',' and numbers have a decimal point"
                )
                continue
            row = _filled(columns, cells)
            rows = slices.setdefault(_number_text(row.get("slice", "")), _SliceRows())
            mistakes += [f"{name}:{reader.line_num}: {mistake}" for mistake in rows.add(row, reader.line_num)]
    except csv.Error as error:
        raise SpotsFileError(
            f"{name}:{reader.line_num}: {error}; a quote must be closed, and doubled inside"
        ) from error

    groups = list(slices.values())
    try:
        records = _SLICES.validate_python([rows.record() for rows in groups])
    except ValidationError as error:
        for mistake in error.errors():
            index, *inside = mistake["loc"]
            mistakes.append(f"{name}:{groups[int(index)].line_of(inside)}: {_sentence(mistake, _column_of(inside))}")
        records = []
    if mistakes:
        raise _error(sorted(mistakes, key=_line_of_message))
    return _placed(sorted(records, key=lambda record: record.slice))


def _column_of(inside: Sequence[int | str]) -> list[str]:
    """The column where a mistake was found in a record, if it is one column's: places in lists are no columns."""
    return [part for part in inside if isinstance(part, str) and part != "spots"][:1]


def _placed(records: Sequence[SliceRecord]) -> list[SliceRecord]:
    """Slices without spots, of which a table says nothing more, belong where the slice before lies, or the next."""
    told = [record for record in records if record.spots]
    placed, last = [], told[0] if told else None
    for record in records:
        if record.spots:
            last = record
        elif last is not None and record.image_orientation is None and not record.series:
            there = {name: getattr(last, name) for name in ("series", "image_position_mm", "image_orientation")}
            record = record.model_copy(update=there)
        placed.append(record)
    return placed


def _columns(header: Sequence[str], name: str) -> list[str]:
    columns = [cell.strip() for cell in header]
    first = ",".join(columns)
    for separator, word in ((";", "';'"), ("\t", "tabs")):
        if separator in first:
            raise SpotsFileError(
                f"{name}:1: columns are separated by {word}; a spots file has ',' between columns and '.' in numbers"
            )
    absent = [column for column in NEEDED if column not in columns]
    if absent:
        raise SpotsFileError(
            f"{name}:1: no column {', '.join(absent)}; the first line must name at least {','.join(NEEDED)}"
        )
    twice = [column for column, count in Counter(columns).items() if column and count > 1]
    if twice:
        raise SpotsFileError(f"{name}:1: column {', '.join(twice)} is given twice")
    return columns


def _filled(columns: Sequence[str], cells: Sequence[str]) -> dict[str, str]:
    """The cells that hold something; other programs write an unknown number as nan."""
    row = {column: cell.strip() for column, cell in zip(columns, cells, strict=True) if column in COLUMNS}
    return {
        column: cell for column, cell in row.items() if cell and not (column not in NEEDED and cell.lower() == "nan")
    }


def _number_text(text: str) -> str:
    """One text for one number: spreadsheets turn 3 into 3.0."""
    return text[:-2] if text.endswith(".0") else text


class _SliceRows:
    """Lines of one slice, gathered."""

    def __init__(self) -> None:
        self.common: dict[str, str] = {}
        self.lines: list[int] = []
        self.spots: list[dict[str, str]] = []
        self.first_line = 0

    def add(self, row: Mapping[str, str], line: int) -> list[str]:
        """Take a line; returns what contradicts the lines before."""
        self.first_line = self.first_line or line
        mistakes = []
        for column in SLICE_COLUMNS & row.keys():
            known = self.common.setdefault(column, row[column])
            if known != row[column] and column != "slice":
                mistakes.append(f"{column}: differs from line {self.first_line} of the same slice")
        spot = {column: cell for column, cell in row.items() if column not in SLICE_COLUMNS}
        if spot:
            self.lines.append(line)
            self.spots.append(spot)
        return mistakes

    def record(self) -> dict[str, object]:
        return {"slice": "", **self.common, "spots": self.spots}

    def line_of(self, inside: Sequence[int | str]) -> int:
        """Line of the place inside the record where a mistake was found."""
        return self.lines[int(inside[1])] if inside[:1] == ["spots"] and len(inside) > 1 else self.first_line


def _parse_json(text: str, name: str) -> list[SliceRecord]:
    head, *lines = text.strip().splitlines()
    in_lines = _is_header_line(head)
    try:
        if in_lines:
            # as one list, in which line n is line n of the file
            return _SLICES.validate_json("[\n" + ",\n".join(lines) + "]", strict=True)
        return list(SpotsDocument.model_validate_json(text, strict=True).slices)
    except ValidationError as error:
        mistakes = []
        for mistake in error.errors():
            place, inside = name, mistake["loc"]
            if in_lines and inside:
                place, inside = f"{name}:{int(inside[0]) + 2}", inside[1:]
            mistakes.append(f"{place}: {_sentence(mistake, inside)}")
        raise _error(mistakes) from error


def _is_header_line(line: str) -> bool:
    """Whether this is the first line of JSON Lines, and not (a part of) a whole document."""
    try:
        head = json.loads(line)
    except (ValueError, RecursionError):
        return False
    return isinstance(head, dict) and head.get("schema") == SCHEMA and "slices" not in head


def _sentence(mistake: Mapping[str, Any], location: Sequence[int | str]) -> str:
    """``place: what is wrong, what is allowed``; the wrong value is quoted when it is short."""
    place = ".".join(str(part) for part in location)
    value = mistake["input"]
    is_short = isinstance(value, int | float | str) and len(str(value)) <= MAX_QUOTED
    quoted = f" (it is {value!r})" if is_short and mistake["type"] != "json_invalid" else ""
    hint = "; write a decimal point" if isinstance(value, str) and re.fullmatch(r"-?\d+,\d+", value) else ""
    return f"{place}{': ' if place else ''}{mistake['msg']}{quoted}{hint}"


def _line_of_message(message: str) -> int:
    found = re.search(r":(\d+): ", message)
    return int(found[1]) if found else 0


def _error(mistakes: Sequence[str]) -> SpotsFileError:
    """One error for all mistakes, the first ones quoted."""
    rest = len(mistakes) - MAX_MISTAKES
    return SpotsFileError("\n".join([*mistakes[:MAX_MISTAKES], *([f"... and {rest} more"] if rest > 0 else [])]))
