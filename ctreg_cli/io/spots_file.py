"""Spots files: what ``segment`` writes, what other programs may write, and what every other command reads.

The table (CSV) is for people and spreadsheets; it gives centres back exactly and covariances to rounding error. The
document (JSON, JSON Lines) gives every number back exactly.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ctreg_cli._version import __version__
from ctreg_cli.arrays import FloatArray
from ctreg_cli.errors import SpotsFileError
from ctreg_cli.imaging.slice import SliceInfo
from ctreg_cli.imaging.spot_slice import SpotSlice
from ctreg_cli.imaging.spots import DEFAULT_SPOT_SD_PX, Spots
from ctreg_cli.io.sinks import Encoding, cell

SCHEMA = "ctreg/spots/1"

#: columns of the spots table that say something of a spot, in order
MEASURED = (
    *("u_px", "v_px", "sd_u_px", "sd_v_px", "area_px", "contrast"),
    # beyond the columns other programs may rely on
    *("cov_uv_px2", "major_px", "minor_px", "angle_rad"),
)
#: columns of the spots table in order
COLUMNS = (
    *("slice", "source", "time_s", "s_x_mm", "s_y_mm", "spot"),
    *MEASURED,
    *("sd_assumed", "thickness_mm", "rows", "columns", "problem"),
    # where the slice lies in the patient: without it a frame's mount is taken in slice axes
    *("series", "image_position_mm", "image_orientation"),
)


def read_spots(path: str | Path, *, spot_sd_px: float = DEFAULT_SPOT_SD_PX) -> list[SpotSlice]:
    """Slices of a spots file (CSV, JSON or JSON Lines), in the order of their numbers.

    Args:
        path: the file.
        spot_sd_px: standard deviation (px, each coordinate) for spots that come without one.

    Raises:
        SpotsFileError: one line a mistake, ``file:line: column: what is wrong, what is allowed``.
    """
    # reading needs pydantic, and writing is what every run of segment does
    from ctreg_cli.io.spots_parsing import parse_spots

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


def numbered(slices: Iterable[SpotSlice]) -> Iterator[SpotSlice]:
    """The same slices, each with its number: its own if it has one, else its place in the sequence."""
    for place, spot_slice in enumerate(slices):
        yield spot_slice if spot_slice.index is not None else replace(spot_slice, index=place)


def spots_encoding(*, options: Mapping[str, object] | None = None, with_uids: bool = False) -> Encoding[SpotSlice]:
    """How a numbered :class:`SpotSlice` becomes rows of the spots table and a record of the spots document."""
    # the series key may be a UID: what leaves is only which slices share one
    series_numbers: dict[str, int] = {}

    def series_number(info: SliceInfo) -> int:
        return series_numbers.setdefault(info.series, len(series_numbers))

    def rows(spot_slice: SpotSlice) -> list[Sequence[object]]:
        return _rows(spot_slice, series_number(spot_slice.info) if len(spot_slice.spots) else 0)

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
            "series": series_number(info),
            "problem": spot_slice.problem,
            "sd_assumed": spots.sd_assumed,
            "spots": _spot_records(spots),
            "rejected": [{"u_px": r.u_px, "v_px": r.v_px, "reason": r.reason} for r in spots.rejected],
        } | uids

    def head(_first: SpotSlice | None) -> dict[str, object]:
        return {"schema": SCHEMA, "ctreg": __version__, "options": options or {}}

    return Encoding(columns=COLUMNS, rows=rows, record=record, header=head, records_key="slices")


def _spot_records(spots: Spots) -> list[dict[str, object]]:
    measured = _measured(spots).tolist()
    return [
        {"spot": i, **dict(zip(MEASURED, values, strict=True)), "covariance_px2": covariance}
        for i, (values, covariance) in enumerate(zip(measured, spots.covariance_px.tolist(), strict=True))
    ]


def _measured(spots: Spots) -> FloatArray:
    """(m, 10) what is known of each spot, in the order of ``MEASURED``."""
    return np.column_stack(
        [
            *(spots.uv_px, spots.sd_px, spots.area_px, spots.contrast, spots.covariance_px[:, 0, 1]),
            *(spots.major_px, spots.minor_px, spots.angle_rad),
        ]
    )


def _rows(spot_slice: SpotSlice, series: int) -> list[Sequence[object]]:
    info, spots = spot_slice.info, spot_slice.spots
    scale = (info.scale.s_x, info.scale.s_y) if info.scale else (None, None)
    head = (spot_slice.index, info.source, info.time_s, *scale)
    if not len(spots):
        # the spot and all after it empty; only a slice that could not be read says why
        after = {"problem": spot_slice.problem}
        return [(*head, *map(after.get, COLUMNS[len(head) :]))]
    rows, columns = info.shape or (None, None)
    T = info.T_patient_slice
    place = (None, None) if T is None else (_values(T[:3, 3]), _values(T[:3, :2].T.ravel()))
    tail = (int(spots.sd_assumed), info.thickness_mm, rows, columns, None, series, *place)
    return [(*head, i, *values, *tail) for i, values in enumerate(_measured(spots).tolist())]


def _values(numbers: FloatArray) -> str:
    """Numbers in one cell, separated as DICOM separates values."""
    return "\\".join(map(cell, numbers.tolist()))
