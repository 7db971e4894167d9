"""What is in the slice beside the rods: body, acrylic, streaks, noise, and the edge of the field of view.

Values are round numbers of CT practice (HU): air −1000, fat −100, soft tissue 40, brain 35, bone 700, acrylic 120.
"""

from __future__ import annotations

import math
from functools import lru_cache
from itertools import combinations

import numpy as np
import scipy.fft

from ctreg_cli.arrays import BoolArray, FloatArray
from ctreg_cli.rods import RodModel
from ctreg_cli.simulation.cylinders import FWHM_PER_SD, Patch
from ctreg_cli.simulation.settings import ScannerSettings

AIR_HU, FAT_HU, TISSUE_HU, ORGAN_HU, BRAIN_HU, BONE_HU, ACRYLIC_HU = -1000.0, -100.0, 40.0, 65.0, 35.0, 700.0, 120.0

#: acrylic reaches this far beyond the rods; a frame larger than ``SOLID_BLOCK_MM`` is hollow, with walls this thick
BLOCK_MARGIN_MM, WALL_MM, SOLID_BLOCK_MM = 2.5, 8.0, 100.0
#: layers through the slab when a block is averaged
BLOCK_LAYERS = 8

#: streaks: width of the dark band between two rods, how far it reaches beyond them, and how fast rays fade, mm
BAND_SD_MM, BAND_REACH_MM, RAY_FADE_MM, RAY_WIDTH_MM = 0.7, 25.0, 6.0, 1.5
#: rays around a rod: how many turns of bright and dark, and their height as a share of the band's depth
RAY_TURNS, RAY_SHARE = (2, 3, 5), 0.6


@lru_cache(maxsize=4)
def body_hu(settings: ScannerSettings, radius_mm: float) -> FloatArray:
    """(rows, columns) the patient without the frame, read-only.

    Args:
        radius_mm: of the frame: an abdomen lies below it, a head within it.
    """
    image = np.full(settings.shape, AIR_HU)
    width, height = settings.extent_mm
    cx, cy = settings.centre_mm
    if settings.body == "abdomen":
        top = cy + radius_mm + 5.0
        b = max((cy + 0.47 * height - top) / 2, 0.05 * height)
        a, y = min(1.7 * b, 0.45 * width), top + b
        organs = [
            (cx, y, a, b, FAT_HU),
            (cx, y, 0.95 * a, 0.92 * b, TISSUE_HU),
            (cx + 0.4 * a, y - 0.1 * b, 0.35 * a, 0.45 * b, ORGAN_HU),
            (cx, y + 0.6 * b, 0.15 * a, 0.2 * b, BONE_HU),
            *((cx + side * 0.86 * a, y + 0.25 * sign * b, 0.03 * a, 0.1 * b, BONE_HU)
              for side in (-1, 1) for sign in (-1, 1)),
        ]  # fmt: skip
    elif settings.body == "head":
        a, b = min(75.0, 0.6 * radius_mm), min(95.0, 0.75 * radius_mm)
        organs = [
            (cx, cy, a, b, TISSUE_HU),
            (cx, cy, 0.95 * a, 0.96 * b, BONE_HU),
            (cx, cy, 0.87 * a, 0.9 * b, BRAIN_HU),
        ]
    else:
        organs = []
    for x, y, a, b, hu in organs:
        image += _ellipse(x, y, a, b, settings) * (hu - image)
    image.flags.writeable = False
    return image


def _ellipse(x_mm: float, y_mm: float, a_mm: float, b_mm: float, settings: ScannerSettings) -> FloatArray:
    """(rows, columns) share of an ellipse in each pixel, its edge blurred over about the point-spread function."""
    x, y = _axes_mm(settings)
    r = np.hypot((x - x_mm) / a_mm, (y - y_mm)[:, None] / b_mm)
    edge_mm = settings.psf_fwhm_mm + max(settings.scale.s_x, settings.scale.s_y)
    share: FloatArray = np.clip(0.5 + (1 - r) * min(a_mm, b_mm) / edge_mm, 0.0, 1.0)
    return share


def _axes_mm(settings: ScannerSettings) -> tuple[FloatArray, FloatArray]:
    rows, columns = settings.shape
    return np.arange(float(columns)) * settings.scale.s_x, np.arange(float(rows)) * settings.scale.s_y


def frame_radius_mm(model: RodModel) -> float:
    """Radius of the ball about the rod model's centre that holds the frame's acrylic, mm."""
    both = np.concatenate([model.starts, model.ends]) - model.centre
    return float(np.linalg.norm(both, axis=1).max()) + BLOCK_MARGIN_MM


def is_large(model: RodModel) -> bool:
    """Whether a frame goes round a head; a smaller one is a solid block on a body."""
    return 2 * frame_radius_mm(model) > SOLID_BLOCK_MM


def block_patch(model: RodModel, T_slice_model: FloatArray, settings: ScannerSettings) -> Patch | None:
    """Acrylic of the frame: the rods' box in the model axes; of a large frame only the walls round its opening."""
    both = np.concatenate([model.starts, model.ends])
    low, high = both.min(axis=0) - BLOCK_MARGIN_MM, both.max(axis=0) + BLOCK_MARGIN_MM
    middle, half = (low + high) / 2, (high - low) / 2
    R, t = T_slice_model[:3, :3], T_slice_model[:3, 3]
    centre = R @ middle + t
    reach = np.abs(R) @ half
    if abs(centre[2]) > reach[2] + settings.thickness_mm / 2:
        return None
    step, sides = settings.scale.mm_per_px, np.array(settings.shape[::-1])
    first = np.clip(np.floor((centre[:2] - reach[:2]) / step).astype(int) - 1, 0, sides)
    last = np.clip(np.ceil((centre[:2] + reach[:2]) / step).astype(int) + 2, 0, sides)
    if (last <= first).any():
        return None

    x, y = (np.arange(first[k], last[k]) * step[k] - centre[k] for k in (0, 1))
    edge = float(step.mean()) + settings.psf_fwhm_mm
    hollow = is_large(model)
    inner = half - WALL_MM
    inner[np.abs(R[2]).argmax()] = np.inf
    share = np.zeros((len(y), len(x)))
    layers = ((np.arange(BLOCK_LAYERS) + 0.5) / BLOCK_LAYERS - 0.5) * settings.thickness_mm - centre[2]
    for z in layers:
        q = [R[0, k] * x + (R[1, k] * y)[:, None] + R[2, k] * z for k in range(3)]
        layer = _box_share(q, half, edge)
        share += layer - _box_share(q, inner, edge) if hollow else layer
    return Patch(
        rows=slice(first[1], last[1]), columns=slice(first[0], last[0]), share=np.maximum(share, 0.0) / BLOCK_LAYERS
    )


def _box_share(q_mm: list[FloatArray], half_mm: FloatArray, edge_mm: float) -> FloatArray:
    """Share of a box at offsets ``q`` from its middle along its axes, its faces blurred over ``edge``."""
    depth = np.minimum.reduce([h - np.abs(q) for q, h in zip(q_mm, half_mm, strict=True) if math.isfinite(h)])
    share: FloatArray = np.clip(0.5 + depth / edge_mm, 0.0, 1.0)
    return share


def add_streaks(
    image_hu: FloatArray, spots_mm: FloatArray, settings: ScannerSettings, rng: np.random.Generator
) -> None:
    """Beam-hardening bands between metal spots (m, 2) and rays about each of them, in place.

    A sketch of what metal does in filtered back-projection: two rods starve the rays through both, which leaves a dark
    band along their line; each rod alone leaves fine rays of both signs.
    """
    if len(spots_mm) == 0 or settings.streak_hu == 0:
        return
    step, sides = settings.scale.mm_per_px, np.array(settings.shape[::-1])
    first = np.clip(np.floor((spots_mm.min(axis=0) - BAND_REACH_MM) / step).astype(int), 0, sides)
    last = np.clip(np.ceil((spots_mm.max(axis=0) + BAND_REACH_MM) / step).astype(int) + 1, 0, sides)
    x, y = np.arange(first[0], last[0]) * step[0], (np.arange(first[1], last[1]) * step[1])[:, None]
    change = np.zeros((len(y), len(x)))
    for p, q in combinations(spots_mm, 2):
        length = float(np.linalg.norm(q - p))
        if length < BAND_SD_MM:
            continue
        e = (q - p) / length
        along, across = (x - p[0]) * e[0] + (y - p[1]) * e[1], (y - p[1]) * e[0] - (x - p[0]) * e[1]
        outside = np.maximum(np.maximum(-along, along - length), 0.0)
        change -= np.exp(-((across / BAND_SD_MM) ** 2) / 2) * np.exp(-outside / RAY_FADE_MM) / math.sqrt(len(spots_mm))
    for p in spots_mm:
        r, angle = np.hypot(x - p[0], y - p[1]), np.arctan2(y - p[1], x - p[0])
        turns = sum(np.cos(2 * n * angle + rng.uniform(0, 2 * math.pi)) for n in RAY_TURNS)
        change += RAY_SHARE * turns * np.exp(-r / RAY_FADE_MM) * np.minimum(r / RAY_WIDTH_MM, 1.0)
    image_hu[first[1] : last[1], first[0] : last[0]] += settings.streak_hu * change


def add_noise(image_hu: FloatArray, settings: ScannerSettings, rng: np.random.Generator) -> None:
    """Gaussian noise of the settings' standard deviation and texture, in place."""
    if settings.noise_hu == 0:
        return
    noise = rng.standard_normal(settings.shape, dtype=np.float32)
    if settings.noise_texture == "fbp":
        spectrum = scipy.fft.rfft2(noise) * _fbp_amplitude(settings)
        noise = scipy.fft.irfft2(spectrum, s=settings.shape)
    image_hu += settings.noise_hu * noise


@lru_cache(maxsize=4)
def _fbp_amplitude(settings: ScannerSettings) -> FloatArray:
    """Amplitude over the half-plane of frequencies that turns white noise into that of filtered back-projection.

    The noise power of a ramp-filtered image is ``|f| MTF²(f)``; scaled so that the variance stays 1.
    """
    rows, columns = settings.shape
    f = np.hypot(
        scipy.fft.fftfreq(rows, settings.scale.s_y)[:, None], scipy.fft.fftfreq(columns, settings.scale.s_x)[None, :]
    )
    psf_sd = settings.psf_fwhm_mm / FWHM_PER_SD
    amplitude = np.sqrt(f) * np.exp(-2 * (math.pi * psf_sd * f) ** 2)
    amplitude /= math.sqrt(float((amplitude**2).mean()))
    half: FloatArray = amplitude[:, : columns // 2 + 1].astype(np.float32)
    return half


@lru_cache(maxsize=4)
def outside_view(settings: ScannerSettings) -> BoolArray:
    """(rows, columns) pixels whose centre lies outside the circular field of view."""
    x, y = _axes_mm(settings)
    cx, cy = settings.centre_mm
    outside: BoolArray = np.hypot(x - cx, (y - cy)[:, None]) > settings.field_of_view_mm / 2
    return outside
