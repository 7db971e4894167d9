"""One pose at a time: what :mod:`ctreg_cli.geometry` does for stacks, with a third of the calls.

A tracked slice costs a few hundred operations on arrays of a dozen numbers: what counts is how many, not how large.
Tests hold every function here equal to its counterpart.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ctreg_cli.arrays import FloatArray
from ctreg_cli.geometry.projection import MIN_DIRECTION_Z


class Crossing(NamedTuple):
    """``n`` rods and the slice; NaN where a rod lies in the plane."""

    #: (n, 2) mm
    xy_mm: FloatArray
    #: (n,) along the rod, mm
    lambda_mm: FloatArray
    #: (n, 2) ``d_xy / d_z``
    slope: FloatArray
    #: (n, 2, 6) motion field, mm per mm and rad
    jacobian: FloatArray


def cross(T: FloatArray, starts: FloatArray, directions: FloatArray) -> Crossing:
    """:func:`~ctreg_cli.geometry.projection.project` and the motion field, at once."""
    Rt = T[:3, :3].T
    a = starts @ Rt
    a += T[:3, 3]
    d = directions @ Rt
    a_z, d_z = a[:, 2], d[:, 2]
    if (np.abs(d_z) <= MIN_DIRECTION_Z).any():
        d_z = np.where(np.abs(d_z) > MIN_DIRECTION_Z, d_z, np.nan)
    slope = d[:, :2] / d_z[:, None]
    xy = a[:, :2] - a_z[:, None] * slope
    q = xy - T[:2, 3]
    q_z = -T[2, 3]
    J = np.empty((len(a), 2, 6))
    J[:, :, :2] = _EYE
    J[:, :, 2] = -slope
    J[:, :, 3] = slope * -q[:, 1, None]
    J[:, 1, 3] -= q_z
    J[:, :, 4] = slope * q[:, 0, None]
    J[:, 0, 4] += q_z
    J[:, 0, 5] = -q[:, 1]
    J[:, 1, 5] = q[:, 0]
    return Crossing(xy_mm=xy, lambda_mm=-a_z / d_z, slope=slope, jacobian=J)


def updated(T: FloatArray, twist: FloatArray) -> FloatArray:
    """:func:`ctreg_cli.geometry.pose.update` of one pose."""
    v_x, v_y, v_z, x, y, z = twist.tolist()
    angle2 = x * x + y * y + z * z
    angle = math.sqrt(angle2)
    if angle < _SMALL_RAD:
        a, b = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0
    else:
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle2
    turn = np.array(
        [
            [1 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y],
            [b * x * y + a * z, 1 - b * (x * x + z * z), b * y * z - a * x],
            [b * x * z - a * y, b * y * z + a * x, 1 - b * (x * x + y * y)],
        ]
    )
    moved = T.copy()
    moved[:3, :3] = turn @ T[:3, :3]
    moved[0, 3] += v_x
    moved[1, 3] += v_y
    moved[2, 3] += v_z
    return moved


def difference(T_to: FloatArray, T_from: FloatArray) -> FloatArray:
    """:func:`ctreg_cli.geometry.pose.difference`; turns of less than half a circle."""
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = (T_to[:3, :3] @ T_from[:3, :3].T).tolist()
    x, y, z = r21 - r12, r02 - r20, r10 - r01
    sine, cosine = 0.5 * math.sqrt(x * x + y * y + z * z), 0.5 * (r00 + r11 + r22 - 1.0)
    scale = 0.5 if sine < _SMALL_RAD else 0.5 * math.atan2(sine, cosine) / sine
    twist = np.empty(6)
    twist[:3] = T_to[:3, 3] - T_from[:3, 3]
    twist[3:] = scale * x, scale * y, scale * z
    return twist


#: below this an angle's sine is the angle, to double precision
_SMALL_RAD = 1e-5
_EYE = np.eye(2)
