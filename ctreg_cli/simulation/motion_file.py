"""A motion read from a table of poses: any pose CSV ctreg writes, or times and poses from elsewhere."""

from __future__ import annotations

import csv
import math
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ctreg_cli.arrays import frozen
from ctreg_cli.errors import InputError
from ctreg_cli.simulation.motion import MOTION_KINDS, Trajectory, slice_times

POSE_COLUMNS = ("tx_mm", "ty_mm", "tz_mm", "qx", "qy", "qz", "qw")
TIME_COLUMN = "time_s"
#: mistakes shown before the rest is only counted
SHOWN_MISTAKES = 20
#: a quaternion may miss unit length by this, from rounding in the file
NORM_TOLERANCE = 1e-3


def read_motion(path: str | Path, interval_s: float, frames: int | None = None) -> Trajectory:
    """The motion in a file, as :func:`parse_motion` reads it; only its first ``frames`` slices, if given.

    Raises:
        InputError: no such file, a mistake in it, or fewer poses than ``frames``.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "it is no UTF-8 text"
        raise InputError(
            f"motion: {path}: cannot be read ({why}); give {', '.join(MOTION_KINDS)}, or a CSV file of poses"
        ) from error
    trajectory = parse_motion(text, str(path), interval_s)
    if frames is None or frames == len(trajectory):
        return trajectory
    if frames > len(trajectory):
        raise InputError(f"motion: {path} has {len(trajectory)} poses, fewer than the {frames} slices asked for")
    return Trajectory(
        times_s=trajectory.times_s[:frames],
        T_slice_model=trajectory.T_slice_model[:frames],
        plane_mm=trajectory.plane_mm[:frames],
    )


def parse_motion(text: str, source: str, interval_s: float) -> Trajectory:
    """Trajectory of a CSV with the columns ``tx_mm … qw`` and, if known, ``time_s``; one slice a row, in order.

    Rows without a pose (a lost slice of a track) are left out. Without ``time_s`` a slice follows every ``interval_s``.

    Args:
        source: name of the file, for messages.

    Raises:
        InputError: every mistake with file, line and column.
    """
    table = csv.DictReader(text.splitlines())
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
    times_s = known_times or slice_times(len(rows), interval_s)
    if any(later <= earlier for earlier, later in pairwise(times_s)):
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
