"""Forward model: where rods at a given pose cross the slice plane z = 0 (Doignon et al. 2008, eq. 2–4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctreg_cli.arrays import BoolArray, FloatArray

#: a rod whose direction has a smaller |z| than this lies *in* the slice: it leaves a line, no spot
MIN_DIRECTION_Z = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Projection:
    """Where n rods cross the slice; NaN where a rod lies in the plane."""

    #: (n, 2) crossing (x, y) in slice coordinates, mm
    xy_mm: FloatArray
    #: (n,) distance along the rod from its start, mm
    lambda_mm: FloatArray
    #: (n, 2) how fast the crossing slides along x and y as the plane moves along z: ``d_xy / d_z``
    slope: FloatArray


def project(T: FloatArray, points: FloatArray, directions: FloatArray) -> Projection:
    """Cross rods with the slice: ``a = R p + t``, ``d = R y``, ``λ = −a_z / d_z``, ``Q = a + λ d``.

    Works on a stack of poses at once: ``T`` (..., 4, 4) gives results (..., n, ·).

    Args:
        T: pose ``T_slice_model``, mm.
        points: (n, 3) starts of the rods, model frame, mm.
        directions: (n, 3) unit directions, model frame.
    """
    R_t = np.swapaxes(T[..., :3, :3], -1, -2)
    a = points @ R_t + T[..., None, :3, 3]
    d = directions @ R_t
    d_z = np.where(np.abs(d[..., 2]) > MIN_DIRECTION_Z, d[..., 2], np.nan)
    lambda_mm = -a[..., 2] / d_z
    slope = d[..., :2] / d_z[..., None]
    return Projection(
        xy_mm=a[..., :2] - a[..., 2, None] * slope,
        lambda_mm=lambda_mm,
        slope=slope,
    )


def within_bounds(lambda_mm: FloatArray, lengths: FloatArray, slack_mm: FloatArray | float = 0.0) -> BoolArray:
    """Whether the slice cuts the rod itself and not only its line: ``−slack ≤ λ ≤ length + slack`` (eq. 3)."""
    inside: BoolArray = (lambda_mm >= -slack_mm) & (lambda_mm <= lengths + slack_mm)
    return inside


def to_pixels(xy_mm: FloatArray, mm_per_px: FloatArray) -> FloatArray:
    """Slice millimetres (..., 2) to pixels (u, v); ``mm_per_px`` = ``[s_x, s_y]``."""
    return xy_mm / mm_per_px


def to_mm(uv_px: FloatArray, mm_per_px: FloatArray) -> FloatArray:
    """Pixels (u, v) (..., 2) to slice millimetres."""
    return uv_px * mm_per_px
