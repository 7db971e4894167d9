"""Slices of rods rendered apart from the package: supersampled tilted cylinders in a slab, blur, pixel means."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

from ctreg_cli.imaging.slice import Slice, SliceInfo
from ctreg_cli.scale import Scale

OVERSAMPLING = 5


def render_rod(
    shape: tuple[int, int],
    uv: tuple[float, float],
    *,
    mm_per_px: float = 0.5,
    diameter_mm: float = 1.0,
    thickness_mm: float = 2.0,
    slope: tuple[float, float] = (0.2, 0.1),
    blur_mm: float = 0.5,
    contrast: float = 4000.0,
) -> np.ndarray:
    """What a rod crossing the mid-plane at ``uv`` (px) with ``slope`` = d(x, y)/dz adds to a slice of ``shape``."""
    sub_px_mm = mm_per_px / OVERSAMPLING
    n_layers = max(5, int(np.ceil(thickness_mm * np.hypot(*slope) / sub_px_mm)))
    z = ((np.arange(n_layers) + 0.5) / n_layers - 0.5) * thickness_mm
    reach = int(np.ceil((diameter_mm / 2 + thickness_mm / 2 * np.hypot(*slope) + 5 * blur_mm) / mm_per_px + 3))
    column, row = round(uv[0]), round(uv[1])
    axis = np.array([*slope, 1.0]) / np.linalg.norm([*slope, 1.0])
    fine = ((np.arange((2 * reach + 1) * OVERSAMPLING) + 0.5) / OVERSAMPLING - 0.5 - reach) * mm_per_px
    x = fine[None, None, :] - (uv[0] - column) * mm_per_px - slope[0] * z[:, None, None]
    y = fine[None, :, None] - (uv[1] - row) * mm_per_px - slope[1] * z[:, None, None]
    off_axis = np.sqrt(np.maximum(x**2 + y**2 - (x * axis[0] + y * axis[1]) ** 2, 0.0))
    inside = np.clip((diameter_mm / 2 - off_axis) / sub_px_mm + 0.5, 0.0, 1.0).mean(axis=0)
    blurred = gaussian_filter(inside, blur_mm / sub_px_mm, truncate=6.0)
    pixels = blurred.reshape(2 * reach + 1, OVERSAMPLING, 2 * reach + 1, OVERSAMPLING).mean(axis=(1, 3))
    image = np.zeros((shape[0] + 2 * reach, shape[1] + 2 * reach))
    image[row : row + 2 * reach + 1, column : column + 2 * reach + 1] = contrast * pixels
    return image[reach:-reach, reach:-reach]


def render_grid(rng: np.random.Generator, side: int, pitch: int, **rod: object) -> tuple[np.ndarray, np.ndarray]:
    """side × side rods at random sub-pixel places, ``pitch`` px apart: image and true centres (side², 2)."""
    shape = (side * pitch, side * pitch)
    nodes = (np.arange(side) + 0.5) * pitch
    uv = np.stack(np.meshgrid(nodes, nodes), axis=-1).reshape(-1, 2) + rng.uniform(-0.5, 0.5, (side**2, 2))
    image = np.zeros(shape)
    for centre in uv:
        u0, v0 = (int(c) - pitch // 2 for c in centre)
        patch = render_rod((pitch, pitch), (centre[0] - u0, centre[1] - v0), **rod)  # type: ignore[arg-type]
        rows, columns = slice(max(v0, 0), v0 + pitch), slice(max(u0, 0), u0 + pitch)
        target = image[rows, columns]
        target += (
            patch[-target.shape[0] :, -target.shape[1] :]
            if v0 < 0 or u0 < 0
            else patch[: target.shape[0], : target.shape[1]]
        )
    return image, uv


def cramer_rao(noise: float, ceiling: float = np.inf, **rod: object) -> np.ndarray:
    """Least covariance (2, 2) of a rod's centre (px²) that white noise allows, by central differences of the renderer.

    Height, size, direction and flat background are even about the centre, and so cost the centre nothing.
    """
    shape, c, e = (71, 71), 35.0, 0.05

    def image(u: float, v: float) -> np.ndarray:
        return render_rod(shape, (u, v), **rod)  # type: ignore[arg-type]

    gradient = np.stack([image(c + e, c) - image(c - e, c), image(c, c + e) - image(c, c - e)]) / (2 * e)
    gradient = (gradient * (image(c, c) < ceiling)).reshape(2, -1)
    return np.linalg.inv(gradient @ gradient.T / noise**2)


def as_slice(
    image: np.ndarray,
    *,
    mm_per_px: float | None = 0.5,
    thickness_mm: float | None = 2.0,
    dtype: type = np.int16,
    **more: object,
) -> Slice:
    """A slice that stores ``image`` rounded to ``dtype``."""
    stored = np.rint(image).astype(dtype) if np.issubdtype(dtype, np.integer) else image.astype(dtype)
    scale = Scale(s_x=mm_per_px, s_y=mm_per_px) if mm_per_px is not None else None
    info = SliceInfo(
        source="rendered", scale=scale, thickness_mm=thickness_mm, shape=(stored.shape[0], stored.shape[1])
    )
    return Slice(info=info, stored=stored, **more)  # type: ignore[arg-type]
