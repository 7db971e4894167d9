"""How the frame moves from slice to slice.

Poses are ``T_slice_model``. Motions are displacements about the frame's middle in slice axes; the slice's plane may
advance besides (:func:`advance`), as it does in a scan.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from ctreg_cli.arrays import FloatArray, frozen
from ctreg_cli.errors import InputError

MotionKind = Literal["still", "breathing", "drift", "jump"]
MOTION_KINDS: tuple[str, ...] = get_args(MotionKind)

#: even and above 2: breathing rests long at the end of expiration, where it starts, and is short at its height
BREATHING_POWER = 4
#: share of the breathing amplitude along the slice's x, y (up is −y) and normal, and the axis of its nodding
BREATHING_DIRECTION, BREATHING_AXIS = (0.1, -0.35, 0.93), (1.0, 0.2, 0.1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trajectory:
    """A pose, a time and a place of the slice's plane for each of n slices."""

    #: (n,) seconds
    times_s: FloatArray
    #: (n, 4, 4)
    T_slice_model: FloatArray
    #: (n,) how far the slice's plane has gone along its normal, mm
    plane_mm: FloatArray

    def __len__(self) -> int:
        return len(self.times_s)


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionSettings:
    """How the frame moves.

    Raises:
        InputError: a kind that does not exist, or a value that is not a finite number of the right sign.
    """

    kind: MotionKind = "breathing"
    #: greatest displacement of the frame's middle, and greatest turn about it
    amplitude_mm: float = 6.0
    amplitude_deg: float = 3.0
    #: one breath
    period_s: float = 4.0

    def __post_init__(self) -> None:
        if self.kind not in MOTION_KINDS:
            raise InputError(f"motion: {self.kind!r} is unknown; it is one of {', '.join(MOTION_KINDS)}")
        for name in ("amplitude_mm", "amplitude_deg"):
            if not (math.isfinite(value := getattr(self, name)) and value >= 0):
                raise InputError(f"{name}: {value!r} is not allowed; it must be a number, 0 or more")
        if not (math.isfinite(self.period_s) and self.period_s > 0):
            raise InputError(f"period_s: {self.period_s!r} is not allowed; it must be a number, more than 0")


def slice_times(n: int, interval_s: float) -> FloatArray:
    """(n,) times of slices that follow each other evenly, s.

    Raises:
        InputError: the interval is not a positive number.
    """
    if not (math.isfinite(interval_s) and interval_s > 0):
        raise InputError(f"interval_s: {interval_s!r} is not allowed; it must be a number, more than 0")
    return interval_s * np.arange(float(n))


def move(
    T_start: FloatArray, pivot: FloatArray, times_s: FloatArray, settings: MotionSettings, rng: np.random.Generator
) -> Trajectory:
    """A trajectory from the pose ``T_start`` (4, 4).

    ``still``: no motion. ``breathing``: mostly through the slice, ``sin⁴(πt/T)``, periodic. ``drift``: even motion in a
    random direction that reaches the amplitude in the last slice. ``jump``: the whole amplitude at once, half way.

    Args:
        pivot: (3,) the frame's middle, model frame, mm.
        times_s: (n,) times of the slices.
    """
    times_s = frozen(times_s, (None,))
    n = len(times_s)
    direction, axis = (unit(rng.standard_normal(3)) for _ in range(2))
    if settings.kind == "breathing":
        direction, axis = unit(np.array(BREATHING_DIRECTION)), unit(np.array(BREATHING_AXIS))
        progress = np.sin(math.pi * (times_s - times_s[:1]) / settings.period_s) ** BREATHING_POWER
    elif settings.kind == "drift":
        progress = np.arange(n) / max(n - 1, 1)
    elif settings.kind == "jump":
        progress = (np.arange(n) >= (n + 1) // 2).astype(np.float64)
    else:
        progress = np.zeros(n)
    poses = [
        displaced(
            T_start, pivot, p * settings.amplitude_mm * direction, p * math.radians(settings.amplitude_deg) * axis
        )
        for p in progress
    ]
    return Trajectory(times_s=times_s, T_slice_model=frozen(poses, (None, 4, 4)), plane_mm=frozen(np.zeros(n), (n,)))


def advance(trajectory: Trajectory, step_mm: float) -> Trajectory:
    """The same motion scanned: the plane goes on by ``step_mm`` from slice to slice, its middle where it was.

    Raises:
        InputError: the step is not a finite number.
    """
    if not math.isfinite(step_mm):
        raise InputError(f"step_mm: {step_mm!r} is not a finite number")
    n = len(trajectory)
    plane = step_mm * (np.arange(n) - (n - 1) / 2)
    poses = trajectory.T_slice_model.copy()
    poses[:, 2, 3] -= plane
    return Trajectory(
        times_s=trajectory.times_s,
        T_slice_model=frozen(poses, (None, 4, 4)),
        plane_mm=frozen(trajectory.plane_mm + plane, (n,)),
    )


def displaced(T: FloatArray, pivot: FloatArray, shift_mm: FloatArray, turn_rad: FloatArray) -> FloatArray:
    """Pose after turning about ``pivot`` (model frame) by a rotation vector, then shifting; both (3,) in slice axes."""
    turn = Rotation.from_rotvec(turn_rad).as_matrix()
    place = T[:3, :3] @ pivot + T[:3, 3]
    moved = np.eye(4)
    moved[:3, :3] = turn @ T[:3, :3]
    moved[:3, 3] = turn @ (T[:3, 3] - place) + place + shift_mm
    return moved


def unit(v: FloatArray) -> FloatArray:
    """(3,) vector of length 1."""
    direction: FloatArray = v / np.linalg.norm(v)
    return direction
