"""A motion read from a table of poses: any pose CSV ctreg writes, or times and poses from elsewhere."""

from __future__ import annotations

import csv
import math

import numpy as np
from scipy.spatial.transform import Rotation

from ctreg_cli.arrays import frozen
from ctreg_cli.errors import InputError
from ctreg_cli.simulation.motion import Trajectory

POSE_COLUMNS = ("tx_mm", "ty_mm", "tz_mm", "qx", "qy", "qz", "qw")
TIME_COLUMN = "time_s"
#: mistakes shown before the rest is only counted
SHOWN_MISTAKES = 20
#: a quaternion may miss unit length by this, from rounding in the file
NORM_TOLERANCE = 1e-3


def parse_motion(text: str, source: str, interval_s: float) -> Trajectory:
    """Trajectory of a CSV with the columns ``tx_mm … qw`` and, if known, ``time_s``; one slice a row, in order.

    Rows without a pose (a lost slice of a track) are left out. Without ``time_s`` slices follow each other by ``interval_s``.

    Args:
        source: name of the file, for messages.

    Raises:
        InputError: every mistake with file, line and column.
    """
    table = csv.DictReader(text.removeprefix("\ufeff").splitlines())
    lacking = [name for name in POSE_COLUMNS if name not in (table.fieldnames or ())]
    if lacking:
        raise InputError(
            f"{source}:1: column {', '.join(lacking)} is missing; a motion file has {','.join(POSE_COLUMNS)} "
            f"and, if known, {TIME_COLUMN}"
        )
    timed = TIME_COLUMN in (table.fieldnames or ())
    mistakes: list[str] = []
    rows: list[list[float]] = []
    times: list[float | None] = []
    for row in table:
        place = f"{source}:{table.line_num}"
        texts = [(row[name] or "").strip() for name in POSE_COLUMNS]
        if not any(texts):
            continue
        values = [_number(text) for text in texts]
        mistakes += [
            f"{place}: {name}: {text!r} is not a finite number"
            for name, text, value in zip(POSE_COLUMNS, texts, values, strict=True)
            if value is None
        ]
        known = [value for value in values if value is not None]
        if len(known) == len(values):
            norm = math.hypot(*known[3:])
            if abs(norm - 1) > NORM_TOLERANCE:
                mistakes.append(f"{place}: qx,qy,qz,qw: length {norm:.6g}, but a rotation has a quaternion of length 1")
            rows.append(known)
            times.append(_number((row[TIME_COLUMN] or "").strip()) if timed else None)
    if timed and (any(t is not None for t in times) and any(t is None for t in times)):
        mistakes.append(f"{source}: {TIME_COLUMN} must be a finite number in all rows, or empty in all")
    if mistakes:
        more = [f"and {len(mistakes) - SHOWN_MISTAKES} more"] if len(mistakes) > SHOWN_MISTAKES else []
        raise InputError("\n".join(mistakes[:SHOWN_MISTAKES] + more))
    if not rows:
        raise InputError(f"{source}: holds no pose; a motion needs at least one row with {','.join(POSE_COLUMNS)}")

    known_times = [t for t in times if t is not None]
    times_s = known_times or [i * interval_s for i in range(len(rows))]
    if any(later <= earlier for earlier, later in zip(times_s, times_s[1:], strict=False)):
        raise InputError(f"{source}: {TIME_COLUMN} must grow from row to row")
    values_array = np.array(rows)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(values_array[:, 3:]).as_matrix()
    poses[:, :3, 3] = values_array[:, :3]
    n = len(rows)
    return Trajectory(
        times_s=frozen(times_s, (n,)), T_slice_model=frozen(poses, (n, 4, 4)), plane_mm=frozen(np.zeros(n), (n,))
    )


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
