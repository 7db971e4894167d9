"""Results as arrays for MATLAB, Octave and SciPy (``.mat``), and as a column table (``.parquet``).

Every slice is in them, also those without a pose: their numbers are NaN (null), and their status says why.
"""

from __future__ import annotations

import io

import numpy as np

from ctreg_cli.arrays import FloatArray
from ctreg_cli.interop.selection import Content
from ctreg_cli.io.optional import optional
from ctreg_cli.io.results_document import WORD_COLUMNS, SliceRecord

#: MATLAB cuts longer field names
_MAX_FIELD_NAME = 63


def mat(content: Content) -> bytes:
    """A MATLAB 5 file: the pose table's columns (n, 1), the poses (4, 4, n) and covariances (6, 6, n), mm and rad."""
    from scipy.io import savemat

    records = content.document.records
    variables: dict[str, object] = {
        "T_slice_model": _stack([record.T_slice_model for record in records], 4),
        "T_patient_model": _stack([record.T_patient_model for record in records], 4),
        "covariance": _stack([record.covariance for record in records], 6),
        "model": content.document.model_name,
    }
    for name in _columns(records):
        values = [record.columns.get(name) for record in records]
        if _is_number(name, values):
            numbers = [np.nan if value is None else float(str(value)) for value in values]
            variables[name[:_MAX_FIELD_NAME]] = np.array(numbers).reshape(-1, 1)
        else:
            words = np.empty((len(values), 1), dtype=object)
            words[:, 0] = ["" if value is None else str(value) for value in values]
            variables[name[:_MAX_FIELD_NAME]] = words
    stream = io.BytesIO()
    savemat(stream, variables, do_compression=True)
    return stream.getvalue()


def parquet(content: Content) -> bytes:
    """The pose table with its types, one row a slice.

    Raises:
        InputError: pyarrow is not installed.
    """
    pa = optional("pyarrow", extra="export", what="Parquet")
    pq = optional("pyarrow.parquet", extra="export", what="Parquet")
    records = content.document.records
    columns = {}
    for name in _columns(records):
        values = [record.columns.get(name) for record in records]
        if not _is_number(name, values):
            columns[name] = pa.array([None if value is None else str(value) for value in values], pa.string())
        elif name.startswith("n_") or name in ("slice", "iterations"):
            columns[name] = pa.array(values, pa.int64())
        else:
            columns[name] = pa.array([None if value is None else float(str(value)) for value in values], pa.float64())
    stream = io.BytesIO()
    pq.write_table(pa.table(columns), stream)
    return stream.getvalue()


def _columns(records: tuple[SliceRecord, ...]) -> list[str]:
    return list(dict.fromkeys(name for record in records for name in record.columns))


def _is_number(name: str, values: list[object]) -> bool:
    return name not in WORD_COLUMNS and all(value is None or isinstance(value, int | float) for value in values)


def _stack(matrices: list[FloatArray | None], size: int) -> FloatArray:
    """(size, size, n), NaN where there is none."""
    return np.stack([np.full((size, size), np.nan) if M is None else M for M in matrices], axis=-1)
