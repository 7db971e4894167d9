"""Where the frame is in every slice: start poses, and how it moves from there.

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
from ctreg_cli.rods import RodModel
from ctreg_cli.simulation.crossings import rod_crossings, rod_ends
from ctreg_cli.simulation.settings import ScannerSettings

MotionKind = Literal["still", "breathing", "drift", "jump"]
MOTION_KINDS: tuple[str, ...] = get_args(MotionKind)

#: breathing rests at the end of expiration: displacement 1 − cos⁴(πt/T) would rest at the other end (Lujan et al. 1999)
BREATHING_POWER = 4
#: share of the breathing amplitude along the slice's x, y (up is −y) and normal, and the axis of its nodding
BREATHING_DIRECTION, BREATHING_AXIS = (0.1, -0.35, 0.93), (1.0, 0.2, 0.1)
#: a rod steeper than this against the slice (cosine to its normal) leaves a spot and no long streak
STEEP = 0.5
#: random start poses: tilt where the frame has no mount, in-plane place (share of the field of view), height (share of
#: the frame's extent along the slice's normal), tries until enough rods are seen
RANDOM_TILT_DEG, RANDOM_PLACE, RANDOM_HEIGHT, RANDOM_TRIES = 20.0, 0.06, 0.25, 200
#: rods a random start pose must show, where the frame can show so many
WANTED_RODS = 6


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


def move(
    T_start: FloatArray, pivot: FloatArray, times_s: FloatArray, settings: MotionSettings, rng: np.random.Generator
) -> Trajectory:
    """A trajectory from the pose ``T_start`` (4, 4).

    ``still``: no motion. ``breathing``: mostly through the slice, ``sin⁴(πt/T)``, periodic. ``drift``: even motion in a random
    direction that reaches the amplitude in the last slice. ``jump``: the whole amplitude at once, half way.

    Args:
        pivot: (3,) the frame's middle, model frame, mm.
        times_s: (n,) times of the slices.
    """
    times_s = frozen(times_s, (None,))
    n = len(times_s)
    direction, axis = (_unit(rng.standard_normal(3)) for _ in range(2))
    if settings.kind == "breathing":
        direction, axis = _unit(np.array(BREATHING_DIRECTION)), _unit(np.array(BREATHING_AXIS))
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
    """The same motion scanned: the plane goes on by ``step_mm`` from slice to slice, its middle where it was."""
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


def centred_pose(model: RodModel, settings: ScannerSettings, R_patient_slice: FloatArray) -> FloatArray:
    """(4, 4) pose with the frame's middle in the image's middle, turned as its mount says.

    Without a mount: turned so that most rods are cut steeply; among equals, as little as can be.
    """
    if model.mount is not None:
        return _centred(model, R_patient_slice.T @ model.mount.patient_from_model, settings)
    turns = Rotation.create_group("O")
    ordered = turns[np.argsort(turns.magnitude(), kind="stable")].as_matrix()
    seen = [_steep_rods(model, _centred(model, R, settings), settings) for R in ordered]
    return _centred(model, np.rint(ordered[int(np.argmax(seen))]), settings)


def random_pose(
    model: RodModel, settings: ScannerSettings, R_patient_slice: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """(4, 4) pose tilted, shifted and raised at random about the centred one, with enough rods in the slice.

    Raises:
        InputError: no such pose was found: the frame does not fit the field of view.
    """
    centred = centred_pose(model, settings, R_patient_slice)
    limit_deg = min(RANDOM_TILT_DEG, model.mount.max_angle_deg if model.mount else math.inf)
    starts, ends = rod_ends(model, centred)
    height = float(np.ptp(np.concatenate([starts, ends])[:, 2]))
    wanted = min(WANTED_RODS, _steep_rods(model, centred, settings))
    for _ in range(RANDOM_TRIES):
        turn = math.radians(limit_deg) * rng.uniform() * _unit(rng.standard_normal(3))
        place = rng.uniform(-1, 1, 3) * [*2 * [RANDOM_PLACE * settings.field_of_view_mm], RANDOM_HEIGHT * height]
        pose = displaced(centred, model.centre, place, turn)
        if _steep_rods(model, pose, settings) >= wanted:
            return pose
    raise InputError(f"start: no random pose of {model.name} shows {wanted} rods in this image; enlarge it or its scale")


def _centred(model: RodModel, R: FloatArray, settings: ScannerSettings) -> FloatArray:
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = np.array([*settings.centre_mm, 0.0]) - R @ model.centre
    return T


def _steep_rods(model: RodModel, T: FloatArray, settings: ScannerSettings) -> int:
    starts, ends = rod_ends(model, T)
    steep = np.abs(ends - starts)[:, 2] > STEEP * model.lengths
    return int((rod_crossings(model, T, settings).visible & steep).sum())


def _unit(v: FloatArray) -> FloatArray:
    unit: FloatArray = v / np.linalg.norm(v)
    return unit
