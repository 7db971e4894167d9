"""Poses as a TUM trajectory (``evo_ape tum truth.tum track.tum``): ``timestamp tx ty tz qx qy qz qw`` a line.

The format is Sturm's (TUM RGB-D benchmark, 2012): seconds and **metres**. Poses are ``T_slice_model``, as in the pose
table; only slices that are ``ok`` have a line. Seconds and slice numbers never mix, since ``evo`` pairs poses by time:
a pose without a time is left out where any other has one, and only where none has does the slice's number stand for it.
"""

from __future__ import annotations

from collections.abc import Iterator

from ctreg_cli.geometry.pose import quaternion
from ctreg_cli.io.sinks import Stamped
from ctreg_cli.pipeline import FrameResult

HEADER = "# timestamp[s] tx ty tz [m] qx qy qz qw: T_slice_model"
_M_PER_MM = 1e-3


def tum_lines(result: FrameResult) -> Iterator[Stamped]:
    """The line of an ``ok`` result; none of any other."""
    if result.status != "ok":
        return
    T = result.candidates[0].T_slice_model
    numbers = [*(_M_PER_MM * T[:3, 3]).tolist(), *quaternion(T).tolist()]
    text = " ".join(f"{number:.12g}" for number in numbers)
    yield Stamped(number=result.index, time_s=result.info.time_s, text=text)
