"""Cylinders as a scanner sees them: averaged through the slab, over each pixel, and blurred.

The simulator is the oracle of the estimator, so it shares no formula with it: nothing here intersects a line with the
slice. A voxel is metal when it is near enough to the axis segment, and a pixel is the mean of its voxels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from ctreg_cli.arrays import FloatArray
from ctreg_cli.simulation.settings import ScannerSettings

#: voxels across a cylinder's diameter, and the least and most voxels along a pixel's side
VOXELS_PER_DIAMETER = 8
MIN_VOXELS_PER_PIXEL, MAX_VOXELS_PER_PIXEL = 2, 16
#: layers of voxels through the slab: at least, at most, and so many while a tilted cylinder slides by its own width
MIN_LAYERS, MAX_LAYERS, LAYERS_PER_WIDTH = 8, 96, 6
#: the point-spread function is cut here, in standard deviations
PSF_REACH = 4.0
#: full width at half maximum of a Gaussian of standard deviation 1
FWHM_PER_SD = 2 * math.sqrt(2 * math.log(2))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cylinder:
    """A solid cylinder with flat ends; slice coordinates, mm."""

    #: (3,) ends of the axis
    start: FloatArray
    end: FloatArray
    diameter_mm: float
    #: value of its material
    hu: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Patch:
    """A window of the image and the share of material (0 to 1) in each of its pixels."""

    rows: slice
    columns: slice
    share: FloatArray


def blend(image_hu: FloatArray, patch: Patch, hu: float) -> None:
    """Put material of value ``hu`` into ``image_hu`` (rows, columns), in place: partial volume."""
    window = image_hu[patch.rows, patch.columns]
    window += patch.share * (hu - window)


def cylinder_patch(cylinder: Cylinder, settings: ScannerSettings) -> Patch | None:
    """Share of the cylinder in the pixels near it; None where it is not in the slab or not in the image.

    Voxels on the surface count by how far they are inside, so that the share varies smoothly with the pose.
    """
    half, radius = settings.thickness_mm / 2, cylinder.diameter_mm / 2
    inside = _clip_to_slab(cylinder, half + radius)
    if inside is None:
        return None
    psf_sd = settings.psf_fwhm_mm / FWHM_PER_SD
    step = settings.scale.mm_per_px
    blur = PSF_REACH * psf_sd + step
    reach = radius + blur
    first = np.floor((inside[:, :2].min(axis=0) - reach) / step).astype(int)
    last = np.ceil((inside[:, :2].max(axis=0) + reach) / step).astype(int)
    sides = np.array(settings.shape[::-1])
    # what lies further outside the image cannot reach it
    margin = np.ceil(blur / step).astype(int)
    first, last = np.maximum(first, -margin), np.minimum(last, sides - 1 + margin)
    if (first > sides - 1).any() or (last < 0).any():
        return None

    per_pixel = np.clip(
        np.ceil(VOXELS_PER_DIAMETER * step / cylinder.diameter_mm), MIN_VOXELS_PER_PIXEL, MAX_VOXELS_PER_PIXEL
    ).astype(int)
    voxel = step / per_pixel
    x, y = (
        (first[k] - 0.5) * step[k] + (np.arange((last[k] - first[k] + 1) * per_pixel[k]) + 0.5) * voxel[k]
        for k in (0, 1)
    )
    volume = _mean_through_slab(cylinder, x, y, voxel, half)
    if psf_sd > 0:
        volume = gaussian_filter(volume, (psf_sd / voxel[1], psf_sd / voxel[0]), mode="constant", truncate=PSF_REACH)
    share = volume.reshape(-1, per_pixel[1], len(x) // per_pixel[0], per_pixel[0]).mean(axis=(1, 3))

    low, high = np.maximum(first, 0), np.minimum(last, sides - 1)
    return Patch(
        rows=slice(low[1], high[1] + 1),
        columns=slice(low[0], high[0] + 1),
        share=share[low[1] - first[1] : high[1] - first[1] + 1, low[0] - first[0] : high[0] - first[0] + 1],
    )


def _clip_to_slab(cylinder: Cylinder, reach_mm: float) -> FloatArray | None:
    """(2, 3) ends of the part of the axis with ``|z| ≤ reach``; None where there is none."""
    z0, z1 = cylinder.start[2], cylinder.end[2]
    if min(z0, z1) > reach_mm or max(z0, z1) < -reach_mm:
        return None
    if z0 == z1:
        return np.stack([cylinder.start, cylinder.end])
    shares = np.clip((np.array([-reach_mm, reach_mm]) - z0) / (z1 - z0), 0.0, 1.0)
    part: FloatArray = cylinder.start + shares[:, None] * (cylinder.end - cylinder.start)
    return part


def _mean_through_slab(cylinder: Cylinder, x: FloatArray, y: FloatArray, voxel: FloatArray, half: float) -> FloatArray:
    """(len(y), len(x)) share of the voxel columns inside the cylinder, averaged over ``−half ≤ z ≤ half``."""
    axis = cylinder.end - cylinder.start
    length = float(np.linalg.norm(axis))
    direction = axis / length
    edge = float(voxel.mean())
    widths = 2 * half * math.hypot(direction[0], direction[1]) / cylinder.diameter_mm
    layers = int(np.clip(math.ceil(LAYERS_PER_WIDTH * widths), MIN_LAYERS, MAX_LAYERS))
    thickness = 2 * half / layers
    end_edge = max(edge, thickness * abs(direction[2]))

    dx, dy = x - cylinder.start[0], y - cylinder.start[1]
    distance2_xy = dx**2 + dy[:, None] ** 2
    along_xy = dx * direction[0] + dy[:, None] * direction[1]
    total = np.zeros((len(y), len(x)))
    for z in -half + (np.arange(layers) + 0.5) * thickness - cylinder.start[2]:
        along = along_xy + z * direction[2]
        across = np.sqrt(np.maximum(distance2_xy + z**2 - along**2, 0.0))
        within = np.clip(0.5 + (cylinder.diameter_mm / 2 - across) / edge, 0.0, 1.0)
        between = np.clip(0.5 + (length / 2 - np.abs(along - length / 2)) / end_edge, 0.0, 1.0)
        total += within * between
    return total / layers
