"""The truth about spots: where the axis of each rod passes through the middle of the slab.

Written apart from :mod:`ctreg_cli.geometry.projection` on purpose, as the two-point form of a line: the simulator is
the estimator's oracle and must not repeat its mistakes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctreg_cli.arrays import BoolArray, FloatArray
from ctreg_cli.rods import RodModel
from ctreg_cli.simulation.settings import ScannerSettings


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Crossings:
    """Every rod of a model against the slice; n rods, NaN where a rod lies in the plane."""

    #: (n, 2) crossing of the axis with the slab's middle, px
    uv_px: FloatArray
    #: (n,) its distance from the rod's start, mm
    lambda_mm: FloatArray
    #: (n,) the rod itself passes there, inside the image and the field of view
    visible: BoolArray
    #: (n,) the rod crosses the whole slab with all its width: the spot's centroid is the crossing
    through: BoolArray


def rod_ends(model: RodModel, T_slice_model: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n, 3) starts and ends of the rods in slice coordinates, mm."""
    R, t = T_slice_model[:3, :3], T_slice_model[:3, 3]
    starts = np.array([R @ rod.start + t for rod in model.rods])
    ends = np.array([R @ rod.end + t for rod in model.rods])
    return starts, ends


def rod_crossings(model: RodModel, T_slice_model: FloatArray, settings: ScannerSettings) -> Crossings:
    """Cross the rods of ``model`` with the slice of ``settings`` at a pose (4, 4), mm."""
    starts, ends = rod_ends(model, T_slice_model)
    drop = starts[:, 2] - ends[:, 2]
    flat = drop == 0
    share = np.where(flat, np.nan, starts[:, 2] / np.where(flat, 1.0, drop))
    places = starts + share[:, None] * (ends - starts)
    uv = places[:, :2] / [settings.scale.s_x, settings.scale.s_y]

    lengths = np.linalg.norm(ends - starts, axis=1)
    radii = rod_diameters(model, settings) / 2
    sines = np.sqrt(np.maximum(1 - (drop / lengths) ** 2, 0.0))
    beyond = settings.thickness_mm / 2 + radii * sines
    low, high = np.minimum(starts[:, 2], ends[:, 2]), np.maximum(starts[:, 2], ends[:, 2])
    return Crossings(
        uv_px=uv,
        lambda_mm=share * lengths,
        visible=(share >= 0) & (share <= 1) & in_view(uv, settings),
        through=(low <= -beyond) & (high >= beyond),
    )


def rod_diameters(model: RodModel, settings: ScannerSettings) -> FloatArray:
    """(n,) diameters, mm: the frame file's, or the settings' where it gives none."""
    return np.array([settings.rod_diameter_mm if rod.diameter_mm is None else rod.diameter_mm for rod in model.rods])


def in_view(uv_px: FloatArray, settings: ScannerSettings) -> BoolArray:
    """(n,) whether places (n, 2) lie in the image, and not in its padding."""
    rows, columns = settings.shape
    u, v = uv_px.T
    inside: BoolArray = (u >= -0.5) & (u <= columns - 0.5) & (v >= -0.5) & (v <= rows - 0.5)
    if not settings.padding:
        return inside
    radii = np.linalg.norm(uv_px * settings.scale.mm_per_px - settings.centre_mm, axis=1)
    round_view: BoolArray = inside & (radii <= settings.field_of_view_mm / 2)
    return round_view
