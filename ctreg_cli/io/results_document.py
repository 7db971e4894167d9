"""Results read back with their evidence: the pose document (``.json``, ``.jsonl``), or the pose table (``.csv``).

What is read is checked: a pose that is no rigid motion, a status that is none, a number that is no number is an error
that names file and place, so that reports and exports never show what ctreg did not say.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from ctreg_cli.arrays import FloatArray, frozen
from ctreg_cli.errors import InputError
from ctreg_cli.geometry.pose import inverse, is_pose
from ctreg_cli.io.results import COLUMNS, SCHEMA, ResultsHeader, read_results, results_encoding
from ctreg_cli.io.sinks import plain
from ctreg_cli.pipeline import FrameResult
from ctreg_cli.registration.result import Status
from ctreg_cli.scale import Scale

REMEDY = "give what ctreg pose or ctreg track wrote with -o results.json"
#: columns of the pose table that hold words; all others are numbers
WORD_COLUMNS = ("source", "status", "reason", "method", "warnings")


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchRecord:
    """A rod and its spot; the residual is measured minus predicted."""

    rod: str
    spot: int
    u_px: float
    v_px: float
    residual_u_px: float
    residual_v_px: float
    lambda_mm: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TargetRecord:
    """A target: its place, mm, and the predicted rms error there."""

    id: str
    position_slice: FloatArray
    position_patient: FloatArray | None
    tre_mm: float
    #: protection level, mm; None where it is not known, or nothing bounds the error
    pl_mm: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SliceRecord:
    """One slice's verdict as it was written."""

    index: int
    source: str
    time_s: float | None
    status: Status
    reason: str
    #: (4, 4) model → slice and model → patient (LPS), mm; None where there is no pose, or no patient geometry
    T_slice_model: FloatArray | None
    T_patient_model: FloatArray | None
    #: (6, 6) of the twist ``[V; Ω]``, mm and rad; None without a pose, and in a pose table
    covariance: FloatArray | None
    matches: tuple[MatchRecord, ...]
    #: (k, 2) the spots no rod was matched to, px; none where the results do not say
    unmatched_px: FloatArray
    missing_rods: tuple[str, ...]
    targets: tuple[TargetRecord, ...]
    #: code and explanation
    warnings: tuple[tuple[str, str], ...]
    #: ``sop_instance``, ``frame_of_reference``, ...: only where the results were written with UIDs
    uids: Mapping[str, str]
    #: every column of the pose table, those added by later versions too
    columns: Mapping[str, object]

    @property
    def T_patient_slice(self) -> FloatArray | None:
        """(4, 4) slice → patient, mm, as far as the two poses tell it."""
        if self.T_patient_model is None or self.T_slice_model is None:
            return None
        T: FloatArray = self.T_patient_model @ inverse(self.T_slice_model)
        return T

    @property
    def sd(self) -> FloatArray | None:
        """(6,) standard deviations of the pose, mm and **degrees**; None without a pose."""
        names = ("sd_tx_mm", "sd_ty_mm", "sd_tz_mm", "sd_rx_deg", "sd_ry_deg", "sd_rz_deg")
        values = [self.columns.get(name) for name in names]
        return None if self.T_slice_model is None or None in values else np.array(values, dtype=np.float64)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ResultsDocument:
    """The results of a run."""

    #: what to call it in messages
    name: str
    records: tuple[SliceRecord, ...]
    version: str = ""
    model_name: str = ""
    model_sha256: str = ""
    scale: Scale | None = None
    scale_from: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def ok(self) -> tuple[SliceRecord, ...]:
        """The slices whose pose may be used: status ``ok``, nothing else."""
        return tuple(record for record in self.records if record.status == "ok" and record.T_slice_model is not None)


def _rigid(rows: list[list[float]]) -> FloatArray:
    T = np.array(rows, dtype=np.float64)
    if not is_pose(T):
        raise ValueError("is no rigid motion")
    return frozen(T, (4, 4))


def _covariance(rows: list[list[float]]) -> FloatArray:
    C = np.array(rows, dtype=np.float64)
    if not np.allclose(C, C.T, rtol=1e-6, atol=1e-12) or (np.diagonal(C) < 0).any():
        raise ValueError("is no covariance")
    return frozen(C, (6, 6))


Finite = Annotated[float, Field(allow_inf_nan=False)]
Vector = Annotated[list[Finite], Field(min_length=3, max_length=3)]
_Pair = Annotated[list[Finite], Field(min_length=2, max_length=2)]
_Row4 = Annotated[list[Finite], Field(min_length=4, max_length=4)]
_Row6 = Annotated[list[Finite], Field(min_length=6, max_length=6)]
Matrix4 = Annotated[list[_Row4], Field(min_length=4, max_length=4), AfterValidator(_rigid)]
Matrix6 = Annotated[list[_Row6], Field(min_length=6, max_length=6), AfterValidator(_covariance)]


class _Loose(BaseModel):
    """Later versions may add keys."""

    model_config = ConfigDict(extra="ignore")


class _Target(_Loose):
    id: str
    position_slice: Vector
    position_patient: Vector | None = None
    tre_mm: Finite
    pl_mm: Finite | None = None


class _Warning(_Loose):
    code: str
    text: str = ""


class _Result(_Loose):
    slice: int
    source: str = ""
    time_s: Finite | None = None
    status: Status
    reason: str = ""
    T_slice_model: Matrix4 | None = None
    T_patient_model: Matrix4 | None = None
    covariance: Matrix6 | None = None
    matches: list[MatchRecord] = []
    unmatched_px: list[_Pair] = []
    missing_rods: list[str] = []
    targets: list[_Target] = []
    warnings: list[_Warning] = []
    uids: dict[str, str] = {}


class _Model(_Loose):
    name: str
    sha256: str = ""


class _Scale(_Loose):
    s_x_mm: Finite | None = None
    s_y_mm: Finite | None = None
    origin: str = Field(default="", alias="from")


class _Head(_Loose):
    schema_: Literal["ctreg/poses/1"] = Field(alias="schema")
    ctreg: str = ""
    model: _Model
    scale: _Scale = _Scale()
    options: dict[str, Any] = {}


def read_document(path: str | Path) -> ResultsDocument:
    """The results in a ``.json``, ``.jsonl`` or ``.csv`` file.

    A pose table holds poses and standard deviations only: its records have no matches, targets or patient geometry.
    The last line of a ``.jsonl`` that is still being written may be incomplete; it is left out.

    Raises:
        InputError: no such file, or not such results; the message names file and place.
    """
    path = Path(path)
    if path.suffix.lower() == ".csv":
        rows = read_results(path)
        _check_statuses(path, [row.status for row in rows])
        return ResultsDocument(
            name=str(path),
            records=tuple(
                SliceRecord(
                    index=row.index,
                    source=row.source,
                    time_s=row.time_s,
                    status=row.status,  # type: ignore[arg-type]
                    reason=row.reason,
                    T_slice_model=row.T_slice_model,
                    T_patient_model=None,
                    covariance=None,
                    matches=(),
                    unmatched_px=frozen([], (0, 2)),
                    missing_rods=(),
                    targets=(),
                    warnings=tuple((code, "") for code in row.cells.get("warnings", "").split(";") if code),
                    uids={},
                    columns=_numbers(row.cells),
                )
                for row in rows
            ),
        )
    if path.suffix.lower() not in (".json", ".jsonl"):
        raise InputError(f"{path}: results are .json, .jsonl or .csv; {REMEDY}")
    head, results = _parse(path)
    return _document(str(path), head, results)


def record_of(result: FrameResult, header: ResultsHeader, *, with_uids: bool = False) -> SliceRecord:
    """The record that reading back the written result would give."""
    written = plain(results_encoding(header, with_uids=with_uids).record(result))
    return _record(_Result.model_validate(written), written)


def document_of(header: ResultsHeader, records: Iterable[SliceRecord], name: str = "results") -> ResultsDocument:
    """A document of records that have not been written."""
    head = _Head.model_validate(plain(results_encoding(header).header(None)))
    return _with_head(name, head, tuple(records))


def _parse(path: Path) -> tuple[object, list[object]]:
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read; {REMEDY}") from error
    lines: Sequence[str] = [text]
    if path.suffix.lower() == ".jsonl":
        lines = text.splitlines()
        if lines and not text.endswith("\n"):
            lines = lines[:-1]
    values = []
    for number, line in enumerate(lines, start=1):
        try:
            values.append(json.loads(line))
        except (ValueError, RecursionError) as error:
            place = f":{number}" if len(lines) > 1 else ""
            raise InputError(f"{path}{place}: is not JSON; {REMEDY}") from error
    if not values:
        raise InputError(f"{path}: is empty; {REMEDY}")
    head = values[0]
    if path.suffix.lower() == ".jsonl":
        return head, values[1:]
    results = head.get("results") if isinstance(head, dict) else None
    if not isinstance(results, list):
        raise InputError(f"{path}: has no list of results; {REMEDY}")
    return head, results


def _document(name: str, head: object, results: list[object]) -> ResultsDocument:
    try:
        checked = _Head.model_validate(head)
    except ValidationError as error:
        if not isinstance(head, dict) or head.get("schema") != SCHEMA:
            raise InputError(f"{name}: is not of schema {SCHEMA}; {REMEDY}") from error
        raise InputError(f"{name}: {_first(error)}") from error
    try:
        entries = TypeAdapter(list[_Result]).validate_python(results)
    except ValidationError as error:
        raise InputError(f"{name}: results.{_first(error)}") from error
    records = tuple(_record(entry, raw) for entry, raw in zip(entries, results, strict=True) if isinstance(raw, dict))
    return _with_head(name, checked, records)


def _with_head(name: str, head: _Head, records: tuple[SliceRecord, ...]) -> ResultsDocument:
    scale = head.scale
    return ResultsDocument(
        name=name,
        records=records,
        version=head.ctreg,
        model_name=head.model.name,
        model_sha256=head.model.sha256,
        scale=Scale(s_x=scale.s_x_mm, s_y=scale.s_y_mm) if scale.s_x_mm and scale.s_y_mm else None,
        scale_from=scale.origin,
        options=head.options,
    )


def _first(error: ValidationError) -> str:
    """The first mistake, as ``place: what``."""
    mistake = error.errors(include_url=False, include_input=False)[0]
    return f"{'.'.join(map(str, mistake['loc']))}: {mistake['msg'].removeprefix('Value error, ')}"


def _record(entry: _Result, raw: Mapping[str, object]) -> SliceRecord:
    # a pose without an accepted status is none, whatever the file holds
    has_pose = entry.status != "no_pose"
    # of what later versions add, columns are the plain values; an absent matrix is null too, and no column
    columns: dict[str, object] = {n: value for n, value in raw.items() if isinstance(value, str | int | float)}
    columns["warnings"] = ";".join(warning.code for warning in entry.warnings)
    return SliceRecord(
        index=entry.slice,
        source=entry.source,
        time_s=entry.time_s,
        status=entry.status,
        reason=entry.reason,
        T_slice_model=entry.T_slice_model if has_pose else None,  # type: ignore[arg-type]
        T_patient_model=entry.T_patient_model if has_pose else None,  # type: ignore[arg-type]
        covariance=entry.covariance if has_pose else None,  # type: ignore[arg-type]
        matches=tuple(entry.matches),
        unmatched_px=frozen(np.reshape(entry.unmatched_px, (-1, 2)), (None, 2)),
        missing_rods=tuple(entry.missing_rods),
        targets=tuple(
            TargetRecord(
                id=target.id,
                position_slice=frozen(target.position_slice, (3,)),
                position_patient=None if target.position_patient is None else frozen(target.position_patient, (3,)),
                tre_mm=target.tre_mm,
                pl_mm=target.pl_mm,
            )
            for target in entry.targets
        ),
        warnings=tuple((warning.code, warning.text) for warning in entry.warnings),
        uids=entry.uids,
        columns={name: columns.get(name) for name in COLUMNS} | columns,
    )


def _check_statuses(path: Path, statuses: Sequence[str]) -> None:
    for number, status in enumerate(statuses):
        if status not in get_args(Status):
            raise InputError(f"{path}: row {number + 1}: status {status!r} is none of {', '.join(get_args(Status))}")


def _numbers(cells: Mapping[str, str]) -> dict[str, object]:
    """Cells of a pose table: words as words, the rest as numbers, empty as None."""
    values: dict[str, object] = {}
    for name, text in cells.items():
        if name in WORD_COLUMNS:
            values[name] = text
            continue
        try:
            number = float(text) if text else None
        except ValueError:
            values[name] = text
            continue
        values[name] = int(number) if number is not None and number.is_integer() and "." not in text else number
    return values
