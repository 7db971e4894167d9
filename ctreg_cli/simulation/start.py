"""Where the frame is before it moves, and how the slice lies in the patient."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from ctreg_cli.arrays import FloatArray
from ctreg_cli.errors import InputError
from ctreg_cli.rods import RodModel
from ctreg_cli.simulation.crossings import rod_crossings, rod_ends
from ctreg_cli.simulation.motion import displaced, unit
from ctreg_cli.simulation.settings import ScannerSettings

#: a rod steeper than this against the slice (cosine to its normal) leaves a spot and no long streak
STEEP = 0.5
#: random start poses: tilt where the frame has no mount, in-plane place (share of the field of view), height (share of
#: the frame's extent along the slice's normal), tries until enough rods are seen
RANDOM_TILT_DEG, RANDOM_PLACE, RANDOM_HEIGHT, RANDOM_TRIES = 20.0, 0.06, 0.25, 200
#: rods a random start pose must show, where the frame can show so many
WANTED_RODS = 6
#: a rotation given in numbers may miss orthonormality by this
ROTATION_TOLERANCE = 1e-3
#: a frame farther off than this is in no scanner
FARTHEST_MM = 1e5

#: (row, column) directions of the usual planes in patient coordinates (LPS)
PLANES: Mapping[str, tuple[float, ...]] = {
    "axial": (1, 0, 0, 0, 1, 0),
    "coronal": (1, 0, 0, 0, 0, -1),
    "sagittal": (0, 1, 0, 0, 0, -1),
}


def parse_orientation(text: str) -> FloatArray:
    """(3, 3) slice axes x, y, normal (columns) in patient coordinates.

    Args:
        text: ``axial``, ``coronal``, ``sagittal``; ``RX,RY,RZ``, degrees by which an axial slice is turned about the
            patient's axes, x first; or the six numbers of ImageOrientationPatient.

    Raises:
        InputError: none of these, or six numbers that are not two directions at a right angle.
    """
    values = PLANES.get(text) or _numbers(text)
    if len(values) == 3:
        turn: FloatArray = Rotation.from_euler("xyz", values, degrees=True).as_matrix()
        return turn
    if len(values) != 6:
        raise InputError(
            f"orientation: {text!r} is none of {', '.join(PLANES)}, three angles RX,RY,RZ, or six direction cosines"
        )
    x, y = np.array(values[:3]), np.array(values[3:])
    if max(abs(x @ x - 1), abs(y @ y - 1), abs(x @ y)) > ROTATION_TOLERANCE:
        raise InputError(f"orientation: {text!r}: the two directions must have length 1 and stand at a right angle")
    x = unit(x)
    y = unit(y - (x @ y) * x)
    return np.column_stack([x, y, np.cross(x, y)])


def start_pose(
    text: str,
    model: RodModel,
    settings: ScannerSettings,
    R_patient_slice: FloatArray,
    rng: np.random.Generator,
    *,
    option: str = "start",
) -> FloatArray:
    """(4, 4) pose ``T_slice_model``.

    Args:
        text: ``centred``, ``random``, or the seven numbers ``TX,TY,TZ,QX,QY,QZ,QW`` of a pose.
        model: the frame.
        settings: the image the frame is to be seen in.
        R_patient_slice: (3, 3) slice axes in the patient.
        rng: for ``random``.
        option: where the text is from, for messages.

    Raises:
        InputError: none of these, or a quaternion that is not of length 1.
    """
    if text == "centred":
        return centred_pose(model, settings, R_patient_slice)
    if text == "random":
        return random_pose(model, settings, R_patient_slice, rng)
    values = _numbers(text)
    if len(values) != 7:
        raise InputError(
            f"{option}: {text!r} is neither centred, nor random, nor a pose: seven finite numbers TX,TY,TZ,QX,QY,QZ,QW"
        )
    if abs(math.hypot(*values[3:]) - 1) > ROTATION_TOLERANCE:
        raise InputError(f"{option}: {text!r}: the quaternion QX,QY,QZ,QW must have length 1")
    if max(map(abs, values[:3])) > FARTHEST_MM:
        raise InputError(f"{option}: {text!r}: TX,TY,TZ are millimetres, none beyond {FARTHEST_MM:g}")
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(values[3:]).as_matrix()
    T[:3, 3] = values[:3]
    return T


def tilted(T: FloatArray, model: RodModel, tilt_deg: tuple[float, float, float]) -> FloatArray:
    """The pose turned about the frame's middle by a rotation vector in slice axes, degrees.

    Raises:
        InputError: the angles are not finite.
    """
    if not all(math.isfinite(angle) for angle in tilt_deg):
        raise InputError(f"tilt: {tilt_deg} must be three finite angles in degrees")
    return displaced(T, model.centre, np.zeros(3), np.radians(tilt_deg))


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
        turn = math.radians(limit_deg) * rng.uniform() * unit(rng.standard_normal(3))
        place = rng.uniform(-1, 1, 3) * [*2 * [RANDOM_PLACE * settings.field_of_view_mm], RANDOM_HEIGHT * height]
        pose = displaced(centred, model.centre, place, turn)
        if _steep_rods(model, pose, settings) >= wanted:
            return pose
    raise InputError(
        f"start: no random pose of {model.name} shows {wanted} rods in this image; enlarge it or its scale"
    )


def _centred(model: RodModel, R: FloatArray, settings: ScannerSettings) -> FloatArray:
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = np.array([*settings.centre_mm, 0.0]) - R @ model.centre
    return T


def _steep_rods(model: RodModel, T: FloatArray, settings: ScannerSettings) -> int:
    starts, ends = rod_ends(model, T)
    steep = np.abs(ends - starts)[:, 2] > STEEP * model.lengths
    return int((rod_crossings(model, T, settings).visible & steep).sum())


def _numbers(text: str) -> tuple[float, ...]:
    """Finite numbers between commas; none where there is anything else."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        return ()
    return values if all(math.isfinite(value) for value in values) else ()
