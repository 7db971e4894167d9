"""The frame's path for trajectory tools and ROS, in **metres**; only poses of status ``ok`` are on it."""

from __future__ import annotations

import json
import re

from ctreg_cli.geometry.pose import quaternion
from ctreg_cli.interop.selection import MM_PER_M, Content

_NANOSECONDS = 1_000_000_000
#: what a ROS frame name may not hold
_NOT_IN_FRAME_NAME = re.compile(r"[^A-Za-z0-9_]+")


def tum(content: Content) -> bytes:
    """One line a pose, ``time tx ty tz qx qy qz qw`` (s, m); the format of the TUM RGB-D benchmark, which evo reads."""
    lines = [
        f"# pose of the frame {_word(content.model_name)} in {content.space} coordinates",
        "# time_s tx_m ty_m tz_m qx qy qz qw",
    ]
    for record, time_s in content.timed(content.usable):
        T = content.pose(record)
        numbers = [*(T[:3, 3] / MM_PER_M).tolist(), *quaternion(T).tolist()]
        lines.append(f"{time_s:.9f} {' '.join(f'{number:.15g}' for number in numbers)}")
    return _text(lines)


def kitti(content: Content) -> bytes:
    """One line a pose: the upper three rows of model → slice or patient, row by row (m)."""
    lines = []
    for record in content.usable:
        T = content.pose(record).copy()
        T[:3, 3] /= MM_PER_M
        lines.append(" ".join(f"{number:.15g}" for number in T[:3].ravel().tolist()))
    return _text(lines)


def tf_json(content: Content) -> bytes:
    """``tf2_msgs/TFMessage`` as JSON: each pose maps ``child_frame_id`` to ``header.frame_id`` coordinates (m)."""
    parent, child = f"ctreg_{content.space}", _frame_name(content.model_name)
    transforms = []
    for record, time_s in content.timed(content.usable):
        T = content.pose(record)
        translation, rotation = (T[:3, 3] / MM_PER_M).tolist(), quaternion(T).tolist()
        seconds, nanoseconds = divmod(round(time_s * _NANOSECONDS), _NANOSECONDS)
        transforms.append(
            {
                "header": {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": parent},
                "child_frame_id": child,
                "transform": {
                    "translation": dict(zip("xyz", translation, strict=True)),
                    "rotation": dict(zip("xyzw", rotation, strict=True)),
                },
            }
        )
    return _text([json.dumps({"transforms": transforms}, indent=1, allow_nan=False)])


def _frame_name(name: str) -> str:
    return _NOT_IN_FRAME_NAME.sub("_", name).strip("_") or "model"


def _word(name: str) -> str:
    return " ".join(name.split())


def _text(lines: list[str]) -> bytes:
    return ("\n".join(lines) + "\n").encode()
