"""Poses as a TUM trajectory (``evo_ape tum truth.tum track.tum``): ``timestamp tx ty tz qx qy qz qw`` a line.

The format is Sturm's (TUM RGB-D benchmark, 2012): seconds and **metres**. Poses are ``T_slice_model``, as in the pose
table; only slices that are ``ok`` have a line. Without times the slice's number stands for the second.
"""

from __future__ import annotations

from collections.abc import Iterator

from ctreg_cli.geometry.pose import quaternion
from ctreg_cli.pipeline import FrameResult

HEADER = "# timestamp[s] tx ty tz [m] qx qy qz qw: T_slice_model"
_M_PER_MM = 1e-3


def tum_lines(result: FrameResult) -> Iterator[str]:
    """The line of an ``ok`` result; none of any other."""
    if result.status != "ok":
        return
    T = result.candidates[0].T_slice_model
    time = float(result.index) if result.info.time_s is None else result.info.time_s
    numbers = [*(_M_PER_MM * T[:3, 3]).tolist(), *quaternion(T).tolist()]
    yield f"{time:.6f} " + " ".join(f"{number:.12g}" for number in numbers)
