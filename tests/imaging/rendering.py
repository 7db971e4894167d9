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


def attainable(noise: float, ceiling: float, uv: np.ndarray, **rod: object) -> np.ndarray:
    """Least covariance (2, 2) of a rod's centre (px²) for whom nothing else is known, mean over the places ``uv``.

    Beside the centre unknown are: contrast, diameter and blur (within a factor of two), slope (within 1), background
    and its gradient. Where the rod is wide against the pixel that is :func:`cramer_rao`; a sharp one, or one whose top
    is cut off, is seen in few pixels, which do not lie evenly about its centre.
    """
    n, known = 41, {"diameter_mm": 1.0, "blur_mm": 0.5, "contrast": 4000.0, "slope": (0.2, 0.1), **rod}
    row, column = np.mgrid[:n, :n] - n // 2
    covariances = []
    for place in uv - np.rint(uv) + n // 2:

        def image(du: float = 0.0, dv: float = 0.0, place: np.ndarray = place, **change: object) -> np.ndarray:
            return render_rod((n, n), (place[0] + du, place[1] + dv), **{**known, **change})  # type: ignore[arg-type]

        e = 0.05
        columns = [(image(e) - image(-e)) / (2 * e), (image(0, e) - image(0, -e)) / (2 * e)]
        columns += [np.ones((n, n)), row, column, image()]
        for name in ("diameter_mm", "blur_mm"):
            by = {name: known[name] * np.exp(e)}, {name: known[name] / np.exp(e)}  # type: ignore[operator]
            columns.append((image(**by[0]) - image(**by[1])) / (2 * e))
        for step in ((e, 0.0), (0.0, e)):
            by = tuple({"slope": tuple(np.add(known["slope"], s * np.array(step)))} for s in (1, -1))  # type: ignore[assignment]
            columns.append((image(**by[0]) - image(**by[1])) / (2 * e))
        jacobian = np.stack([c[image() < ceiling] for c in columns], axis=1) / noise
        prior = np.diag([0.0] * 5 + [0.7**-2] * 3 + [1.0] * 2)
        covariances.append(np.linalg.inv(jacobian.T @ jacobian + prior)[:2, :2])
    return np.mean(covariances, axis=0)


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
