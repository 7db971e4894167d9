"""Results as files: the pose table and the pose document (one schema for ``pose``, ``track`` and simulated truth)."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ctreg_cli._version import __version__
from ctreg_cli.arrays import FloatArray
from ctreg_cli.checks import demand
from ctreg_cli.errors import InputError
from ctreg_cli.geometry.pose import from_quaternion
from ctreg_cli.io.sinks import FORMATS, STANDARD_OUTPUT, Encoding, cell, open_sinks, rounded
from ctreg_cli.io.tum import HEADER, tum_lines
from ctreg_cli.pipeline import FrameResult
from ctreg_cli.registration.result import Candidate
from ctreg_cli.rods import RodModel
from ctreg_cli.scale import Scale
from ctreg_cli.tracking.single import quaternion
from ctreg_cli.tracking.tracker import Velocity

SCHEMA = "ctreg/poses/1"
#: digits cut off by a spreadsheet are no mistake
_QUATERNION_TOLERANCE = 1e-3
_REMEDY = "a pose table is what ctreg pose or ctreg track writes"

#: columns of the pose table in order, with the significant digits of a number (None: as it is). 9 digits are under
#: 1e-6 mm in a scanner's bore; a quaternion of 15 digits gives its rotation back to rounding error.
COLUMNS: Mapping[str, int | None] = {
    "slice": None,
    "source": None,
    "time_s": None,
    "status": None,
    "reason": None,
    "method": None,
    "n_spots": None,
    "n_matched": None,
    "rms_px": 6,
    "tx_mm": 9,
    "ty_mm": 9,
    "tz_mm": 9,
    "qx": 15,
    "qy": 15,
    "qz": 15,
    "qw": 15,
    "sd_tx_mm": 6,
    "sd_ty_mm": 6,
    "sd_tz_mm": 6,
    "sd_rx_deg": 6,
    "sd_ry_deg": 6,
    "sd_rz_deg": 6,
    "iterations": None,
    # beyond the columns other programs may rely on
    "s_x_mm": None,
    "s_y_mm": None,
    "log_odds": 6,
    "inflation": 6,
    "stability": 6,
    "warnings": None,
    "n_missing": None,
    "n_false": None,
    "pl_mm": 6,
    **dict.fromkeys(("vx_mm_s", "vy_mm_s", "vz_mm_s", "wx_deg_s", "wy_deg_s", "wz_deg_s"), 6),
    **dict.fromkeys(("sd_vx_mm_s", "sd_vy_mm_s", "sd_vz_mm_s", "sd_wx_deg_s", "sd_wy_deg_s", "sd_wz_deg_s"), 6),
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ResultsHeader:
    """What the results rest on: the head of the JSON document."""

    model: RodModel
    #: the scale used for every slice; None: each slice's own
    scale: Scale | None = None
    #: where the scale is from: ``dicom``, ``spots``, ``calibration`` or ``option``
    scale_from: str = "dicom"
    #: options as resolved, defaults included
    options: Mapping[str, object] = field(default_factory=dict)


def results_encoding(header: ResultsHeader, *, with_uids: bool = False) -> Encoding[FrameResult]:
    """How a :class:`FrameResult` becomes a row of the pose table and a record of the pose document."""

    def row(result: FrameResult) -> list[Sequence[object]]:
        value_of = _fields(result, header).get
        return [[_shortened(value_of(name), format_) for name, format_ in _CELL_FORMATS]]

    def record(result: FrameResult) -> dict[str, object]:
        fields = {name: _rounded(value, COLUMNS[name]) for name, value in _fields(result, header).items()}
        uids: dict[str, object] = {"uids": dict(result.info.uids)} if with_uids else {}
        warnings = [{"code": code, "text": text} for code, text in result.warnings]
        return {name: fields.get(name) for name in COLUMNS} | uids | _evidence(result, header) | {"warnings": warnings}

    def head(first: FrameResult | None) -> dict[str, object]:
        scale = header.scale or (first.info.scale if first else None)
        return {
            "schema": SCHEMA,
            "ctreg": __version__,
            "model": {"name": header.model.name, "sha256": header.model.sha256},
            "scale": {
                "s_x_mm": scale.s_x if scale else None,
                "s_y_mm": scale.s_y if scale else None,
                "from": header.scale_from,
            },
            "options": header.options,
        }

    return Encoding(
        columns=list(COLUMNS),
        rows=row,
        record=record,
        header=head,
        records_key="results",
        trajectory=tum_lines,
        trajectory_header=HEADER,
    )


def write_results(
    results: Iterable[FrameResult], path: str | Path, header: ResultsHeader, *, with_uids: bool = False
) -> None:
    """Write results to one file whose suffix (``.csv``, ``.json``, ``.jsonl``, ``.tum``) chooses the format.

    Raises:
        InputError: another suffix, or a place that cannot be written.
    """
    demand(isinstance(header, ResultsHeader), "header", header, "ResultsHeader(model=...)")
    if str(path) == STANDARD_OUTPUT:
        raise InputError(f"{path}: name a file; its suffix, one of {', '.join(FORMATS)}, chooses the format")
    with open_sinks([str(path)], results_encoding(header, with_uids=with_uids), io.StringIO()) as sinks:
        for result in results:
            sinks.write(result)


def accepted(result: FrameResult) -> tuple[Candidate, ...]:
    """The poses a reader may see: none with ``no_pose``, whatever was tried on the way."""
    return () if result.status == "no_pose" else result.candidates


def _fields(result: FrameResult, header: ResultsHeader) -> dict[str, object]:
    """Values by column name; what is absent is empty."""
    info = result.info
    scale = header.scale or info.scale
    fields: dict[str, object] = {
        "slice": result.index,
        "source": info.source,
        "time_s": info.time_s,
        "status": result.status,
        "reason": result.reason,
        "method": result.method,
        "n_spots": len(result.spots),
        "n_matched": 0,
        "s_x_mm": scale.s_x if scale else None,
        "s_y_mm": scale.s_y if scale else None,
        "stability": result.stability,
        "warnings": ";".join(code for code, _ in result.warnings),
    }
    for candidate in accepted(result)[:1]:
        fields |= _pose_fields(candidate)
        if len(candidate.protection_mm):  # the worst target; infinite where nothing bounds the error (null in JSON)
            fields["pl_mm"] = float(candidate.protection_mm.max())
        fields["n_missing"] = len(candidate.missing_rods)
        fields["n_false"] = len(result.spots) - len(candidate.spot_index)
    if result.velocity is not None:
        fields |= _velocity_fields(result.velocity)
    return fields


def _rounded(value: object, digits: int | None) -> object:
    if not isinstance(value, float) or digits is None or not math.isfinite(value):
        return value
    return rounded(value, digits)


#: columns of the pose table, and how a number is written in them: in its significant digits, or (None) as it is
_CELL_FORMATS = [(name, None if digits is None else f".{digits}g") for name, digits in COLUMNS.items()]


def _shortened(value: object, format_: str | None) -> object:
    """What a cell of the pose table shows: of a number, the text of :func:`_rounded`, formatted once."""
    if format_ is None or not isinstance(value, float) or not math.isfinite(value):
        return value
    text = format(value, format_)
    return text if "e+" not in text else float(text)  # %g writes large numbers as powers of ten


def _pose_fields(candidate: Candidate) -> dict[str, object]:
    T = candidate.T_slice_model
    tx, ty, tz = T[:3, 3].tolist()
    qx, qy, qz, qw = quaternion(T)
    sd_tx, sd_ty, sd_tz, sd_rx, sd_ry, sd_rz = map(math.sqrt, candidate.covariance.diagonal().tolist())
    return {
        "n_matched": len(candidate.rod_index),
        "rms_px": float(candidate.rms_px),
        "tx_mm": tx,
        "ty_mm": ty,
        "tz_mm": tz,
        "qx": qx,
        "qy": qy,
        "qz": qz,
        "qw": qw,
        "sd_tx_mm": sd_tx,
        "sd_ty_mm": sd_ty,
        "sd_tz_mm": sd_tz,
        "sd_rx_deg": math.degrees(sd_rx),
        "sd_ry_deg": math.degrees(sd_ry),
        "sd_rz_deg": math.degrees(sd_rz),
        "iterations": int(candidate.iterations),
        "log_odds": float(candidate.log_odds),
        "inflation": float(candidate.inflation),
    }


def _velocity_fields(velocity: Velocity) -> dict[str, object]:
    vx, vy, vz, wx, wy, wz = velocity.twist.tolist()
    sd_vx, sd_vy, sd_vz, sd_wx, sd_wy, sd_wz = map(math.sqrt, velocity.covariance.diagonal().tolist())
    return {
        "vx_mm_s": vx,
        "vy_mm_s": vy,
        "vz_mm_s": vz,
        "wx_deg_s": math.degrees(wx),
        "wy_deg_s": math.degrees(wy),
        "wz_deg_s": math.degrees(wz),
        "sd_vx_mm_s": sd_vx,
        "sd_vy_mm_s": sd_vy,
        "sd_vz_mm_s": sd_vz,
        "sd_wx_deg_s": math.degrees(sd_wx),
        "sd_wy_deg_s": math.degrees(sd_wy),
        "sd_wz_deg_s": math.degrees(sd_wz),
    }


def _evidence(result: FrameResult, header: ResultsHeader) -> dict[str, object]:
    """What the document has beyond the table: matrices, matches, alternatives, targets."""
    candidates = accepted(result)
    best = candidates[0] if candidates else None
    matched = set(best.spot_index.tolist()) if best else set()
    unmatched = [spot for spot in range(len(result.spots)) if spot not in matched]
    ids = header.model.ids
    return {
        "T_slice_model": best.T_slice_model if best else None,
        "T_patient_model": _in_patient(result, best.T_slice_model) if best else None,
        "covariance": best.covariance if best else None,
        "matches": _matches(best, result, header) if best else [],
        "unmatched_spots": unmatched,
        "unmatched_px": result.spots.uv_px[unmatched],
        "missing_rods": [ids[rod] for rod in best.missing_rods] if best else [],
        "candidates": [_alternative(candidate, result, header) for candidate in candidates],
        "targets": [
            {
                "id": target.id,
                "position_slice": target.position_slice,
                "position_patient": target.position_patient,
                "tre_mm": target.tre_mm,
                "pl_mm": target.pl_mm,
            }
            for target in result.targets
        ],
    }


def _in_patient(result: FrameResult, T_slice_model: FloatArray) -> FloatArray | None:
    T_patient_slice = result.info.T_patient_slice
    return None if T_patient_slice is None else T_patient_slice @ T_slice_model


def _matches(candidate: Candidate, result: FrameResult, header: ResultsHeader) -> list[dict[str, object]]:
    uv = result.spots.uv_px
    return [
        {
            "rod": header.model.ids[rod],
            "spot": int(spot),
            "u_px": float(uv[spot, 0]),
            "v_px": float(uv[spot, 1]),
            "residual_u_px": float(residual[0]),
            "residual_v_px": float(residual[1]),
            "lambda_mm": float(lambda_mm),
        }
        for rod, spot, residual, lambda_mm in zip(
            candidate.rod_index, candidate.spot_index, candidate.residual_px, candidate.lambda_mm, strict=True
        )
    ]


def _alternative(candidate: Candidate, result: FrameResult, header: ResultsHeader) -> dict[str, object]:
    return {
        "T_slice_model": candidate.T_slice_model,
        "T_patient_model": _in_patient(result, candidate.T_slice_model),
        "covariance": candidate.covariance,
        "rms_px": float(candidate.rms_px),
        "chi2": float(candidate.chi2),
        "degrees_of_freedom": int(candidate.degrees_of_freedom),
        "log_odds": float(candidate.log_odds),
        "matches": [
            {"rod": header.model.ids[rod], "spot": int(spot)}
            for rod, spot in zip(candidate.rod_index, candidate.spot_index, strict=True)
        ],
    }


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseRow:
    """One row of a pose table read back."""

    index: int
    source: str
    time_s: float | None
    status: str
    reason: str
    #: (4, 4) model → slice, mm; None where the row holds no pose
    T_slice_model: FloatArray | None
    #: every column of the table by name, as text
    cells: Mapping[str, str]


def read_results(path: str | Path) -> list[PoseRow]:
    """The rows of results (``.csv``, ``.json``, ``.jsonl``) as written by :func:`write_results`.

    Raises:
        InputError: not such results; the message names file, line and column.
    """
    if Path(path).suffix.lower() in (".json", ".jsonl"):
        # documents need pydantic, and tables do not
        from ctreg_cli.io.results_document import read_document

        return [
            PoseRow(
                index=record.index,
                source=record.source,
                time_s=record.time_s,
                status=record.status,
                reason=record.reason,
                T_slice_model=record.T_slice_model,
                cells={name: cell(value) for name, value in record.columns.items()},
            )
            for record in read_document(path).records
        ]
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        why = f" ({error.strerror})" if isinstance(error, OSError) else ": is no UTF-8 text"
        raise InputError(f"{path}: cannot be read as a pose table{why}; {_REMEDY}") from error
    reader = csv.DictReader(io.StringIO(text, newline=""))
    needed = ("slice", "status", "tx_mm", "ty_mm", "tz_mm", "qx", "qy", "qz", "qw")
    absent = [name for name in needed if name not in (reader.fieldnames or ())]
    if absent:
        raise InputError(f"{path}: no column {', '.join(absent)}; {_REMEDY}")
    try:
        return [_pose_row(row, f"{path}:{reader.line_num}") for row in reader]
    except csv.Error as error:
        raise InputError(f"{path}:{reader.line_num}: {error}; {_REMEDY}") from error


def _pose_row(row: Mapping[str, str], place: str) -> PoseRow:
    def numbers(*names: str) -> list[float]:
        try:
            values = [float(row[name]) for name in names]
        except (TypeError, ValueError):
            values = [math.nan]
        if not all(map(math.isfinite, values)):
            raise InputError(f"{place}: {', '.join(names)}: a number is missing or is none; {_REMEDY}")
        return values

    cells = {key: value or "" for key, value in row.items() if key}
    T = None
    if cells["qw"]:
        q = np.array(numbers("qx", "qy", "qz", "qw"))
        if abs(np.linalg.norm(q) - 1) > _QUATERNION_TOLERANCE:
            raise InputError(f"{place}: qx, qy, qz, qw: a quaternion of length 1 is needed; {_REMEDY}")
        T = from_quaternion(q, np.array(numbers("tx_mm", "ty_mm", "tz_mm")))
    return PoseRow(
        index=int(numbers("slice")[0]),
        source=cells.get("source", ""),
        time_s=numbers("time_s")[0] if cells.get("time_s") else None,
        status=cells["status"],
        reason=cells.get("reason", ""),
        T_slice_model=T,
        cells=cells,
    )
