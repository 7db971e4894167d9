"""Spots files: what ``segment`` writes, what other programs may write, and what every other command reads.

The table (CSV) is for people and spreadsheets; it gives centres back exactly and covariances to rounding error. The
document (JSON, JSON Lines) also carries the slice's patient geometry and gives every number back exactly.
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from ctreg_cli._version import __version__
from ctreg_cli.errors import SpotsFileError
from ctreg_cli.imaging.spots import DEFAULT_SPOT_SD_PX, Spots
from ctreg_cli.io.sinks import Encoding
from ctreg_cli.io.spots_schema import SCHEMA, SliceRecord, SpotsDocument
from ctreg_cli.pipeline import SpotSlice

NEEDED = ("slice", "u_px", "v_px")
#: what is the same in every line of a slice
SLICE_COLUMNS = frozenset(
    ("slice", "source", "time_s", "s_x_mm", "s_y_mm", "thickness_mm", "rows", "columns", "problem")
)
#: columns of the spots table in order
COLUMNS = (
    *("slice", "source", "time_s", "s_x_mm", "s_y_mm", "spot", "u_px", "v_px", "sd_u_px", "sd_v_px"),
    *("area_px", "contrast"),
    # beyond the columns other programs may rely on
    *("cov_uv_px2", "major_px", "minor_px", "angle_rad", "sd_assumed", "thickness_mm", "rows", "columns", "problem"),
)

#: mistakes quoted from one file; the rest are counted
MAX_MISTAKES = 20
#: a wrong value longer than this is not quoted
MAX_QUOTED = 40
REMEDY = "a spots file is what ctreg segment writes"

_SLICES = TypeAdapter(list[SliceRecord])


# ---------------------------------------------------------------------------------------------------------- writing


def numbered(slices: Iterable[SpotSlice]) -> Iterator[SpotSlice]:
    """The same slices, each with its number: its own if it has one, else its place in the sequence."""
    for place, spot_slice in enumerate(slices):
        yield spot_slice if spot_slice.index is not None else replace(spot_slice, index=place)


def spots_encoding(*, options: Mapping[str, object] | None = None, with_uids: bool = False) -> Encoding[SpotSlice]:
    """How a numbered :class:`SpotSlice` becomes rows of the spots table and a record of the spots document."""
    # the series key may be a UID: what leaves is only which slices share one
    series_numbers: dict[str, int] = {}

    def record(spot_slice: SpotSlice) -> dict[str, object]:
        info, spots = spot_slice.info, spot_slice.spots
        uids: dict[str, object] = {"uids": dict(info.uids)} if with_uids else {}
        return {
            "slice": spot_slice.index,
            "source": info.source,
            "time_s": info.time_s,
            "s_x_mm": info.scale.s_x if info.scale else None,
            "s_y_mm": info.scale.s_y if info.scale else None,
            "thickness_mm": info.thickness_mm,
            "rows": info.shape[0] if info.shape else None,
            "columns": info.shape[1] if info.shape else None,
            "T_patient_slice": info.T_patient_slice,
            "series": series_numbers.setdefault(info.series, len(series_numbers)),
            "problem": spot_slice.problem,
            "sd_assumed": spots.sd_assumed,
            "spots": [_spot_record(spots, i) for i in range(len(spots))],
            "rejected": [{"u_px": r.u_px, "v_px": r.v_px, "reason": r.reason} for r in spots.rejected],
        } | uids

    def head(_first: SpotSlice | None) -> dict[str, object]:
        return {"schema": SCHEMA, "ctreg": __version__, "options": options or {}}

    return Encoding(columns=COLUMNS, rows=_rows, record=record, header=head, records_key="slices")


def _spot_record(spots: Spots, i: int) -> dict[str, object]:
    sd = spots.sd_px[i]
    return {
        "spot": i,
        "u_px": spots.uv_px[i, 0],
        "v_px": spots.uv_px[i, 1],
        "sd_u_px": sd[0],
        "sd_v_px": sd[1],
        "covariance_px2": spots.covariance_px[i],
        "area_px": spots.area_px[i],
        "contrast": spots.contrast[i],
        "major_px": spots.major_px[i],
        "minor_px": spots.minor_px[i],
        "angle_rad": spots.angle_rad[i],
    }


def _rows(spot_slice: SpotSlice) -> list[Sequence[object]]:
    info, spots = spot_slice.info, spot_slice.spots
    scale = (info.scale.s_x, info.scale.s_y) if info.scale else (None, None)
    head = (spot_slice.index, info.source, info.time_s, *scale)
    if not len(spots):
        # the spot and all after it empty; only a slice that could not be read says why
        after = [None] * (len(COLUMNS) - len(head) - 1)
        return [(*head, *after, spot_slice.problem)]
    rows, columns = info.shape or (None, None)
    tail = (int(spots.sd_assumed), info.thickness_mm, rows, columns, None)
    measured = np.column_stack(
        [
            *(spots.uv_px, spots.sd_px, spots.area_px, spots.contrast, spots.covariance_px[:, 0, 1]),
            *(spots.major_px, spots.minor_px, spots.angle_rad),
        ]
    ).tolist()
    return [(*head, i, *values, *tail) for i, values in enumerate(measured)]


# ---------------------------------------------------------------------------------------------------------- reading


def read_spots(path: str | Path, *, spot_sd_px: float = DEFAULT_SPOT_SD_PX) -> list[SpotSlice]:
    """Slices of a spots file (CSV, JSON or JSON Lines), in the order of their numbers.

    Args:
        path: the file.
        spot_sd_px: standard deviation (px, each coordinate) for spots that come without one.

    Raises:
        SpotsFileError: one line a mistake, ``file:line: column: what is wrong, what is allowed``.
    """
    return parse_spots(read_bytes(path), str(path), spot_sd_px=spot_sd_px)[0]


def read_bytes(path: str | Path) -> bytes:
    """Content of a spots file.

    Raises:
        SpotsFileError: it cannot be read.
    """
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise SpotsFileError(f"{path}: cannot be read ({error.strerror})") from error


def parse_spots(
    content: bytes, name: str, *, spot_sd_px: float = DEFAULT_SPOT_SD_PX
) -> tuple[list[SpotSlice], tuple[str, ...]]:
    """Slices and warnings from a spots file's content; ``name`` stands for the file in messages.

    Raises:
        SpotsFileError: as :func:`read_spots`.
    """
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
            mistakes.append(f"{name}:{groups[int(index)].line_of(inside)}: {_sentence(mistake, inside[-1:])}")
        records = []
    if mistakes:
        raise _error(sorted(mistakes, key=_line_of_message))
    return records


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
        return self.lines[int(inside[1])] if len(inside) > 1 else self.first_line


def _parse_json(text: str, name: str) -> list[SliceRecord]:
    head, *lines = text.strip().splitlines()
    try:
        if _is_header_line(head):
            # as one list, in which line n is line n of the file
            return _SLICES.validate_json("[\n" + ",\n".join(lines) + "]", strict=True)
        return list(SpotsDocument.model_validate_json(text, strict=True).slices)
    except ValidationError as error:
        mistakes = error.errors()
        raise _error([f"{name}: {_sentence(mistake, mistake['loc'])}" for mistake in mistakes]) from error


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
