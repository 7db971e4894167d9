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
BLOCK_MARGIN_MM, WALL_MM, SOLID_BLOCK_MM = 2.5, 8.0, 150.0
#: between the frame and the body
BODY_GAP_MM = 5.0
#: layers through the slab when a block is averaged
BLOCK_LAYERS = 4

#: streaks: width of the dark band between two rods and where it is cut (in standard deviations), how fast streaks
#: fade, how far they reach, and the width of a rod that has no rays in it, mm
BAND_SD_MM, BAND_CUT_SD, RAY_FADE_MM, REACH_MM, RAY_WIDTH_MM = 0.7, 3.5, 6.0, 20.0, 1.5
#: rays around a rod: how many turns of bright and dark, and their height as a share of the band's depth
RAY_TURNS, RAY_SHARE = (2, 3, 5), 0.6


@lru_cache(maxsize=4)
def body_hu(settings: ScannerSettings, room_mm: float) -> FloatArray:
    """(rows, columns) the patient without the frame, read-only.

    Args:
        room_mm: from the image's middle: an abdomen lies beyond it, a head within it.
    """
    image = np.full(settings.shape, AIR_HU)
    width, height = settings.extent_mm
    cx, cy = settings.centre_mm
    if settings.body == "abdomen":
        top = cy + room_mm
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
        a, b = min(75.0, room_mm), min(95.0, 1.2 * room_mm)
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


def room_mm(model: RodModel, settings: ScannerSettings) -> float:
    """Where an abdomen begins (below the frame) or a head ends (between the rods), mm from the frame's middle."""
    if settings.body == "abdomen":
        return frame_radius_mm(model) + BODY_GAP_MM
    to_rods = np.cross(model.starts - model.centre, model.directions)
    return max(float(np.linalg.norm(to_rods, axis=1).min()) - BODY_GAP_MM - WALL_MM, BODY_GAP_MM)


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
    margin = settings.psf_fwhm_mm + float(settings.scale.mm_per_px.max())
    rows, columns, x, y = _window(centre[:2] - reach[:2] - margin, centre[:2] + reach[:2] + margin, settings)
    x, y = x - centre[0], y - centre[1]
    edge = float(settings.scale.mm_per_px.mean()) + settings.psf_fwhm_mm
    hollow = is_large(model)
    inner = half - WALL_MM
    inner[np.abs(R[2]).argmax()] = np.inf
    share = np.zeros((y.size, x.size))
    layers = ((np.arange(BLOCK_LAYERS) + 0.5) / BLOCK_LAYERS - 0.5) * settings.thickness_mm - centre[2]
    for z in layers:
        q = [R[0, k] * x + R[1, k] * y + R[2, k] * z for k in range(3)]
        layer = _box_share(q, half, edge)
        share += layer - _box_share(q, inner, edge) if hollow else layer
    return Patch(rows=rows, columns=columns, share=np.maximum(share, 0.0) / BLOCK_LAYERS)


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
    if settings.streak_hu == 0:
        return
    depth = settings.streak_hu / math.sqrt(max(len(spots_mm), 1))
    for p, q in combinations(spots_mm, 2):
        length = float(np.linalg.norm(q - p))
        if length > BAND_SD_MM:
            _add_band(image_hu, p, (q - p) / length, length, -depth, settings)
    for p in spots_mm:
        _add_rays(image_hu, p, RAY_SHARE * settings.streak_hu, rng.uniform(0, 2 * math.pi, len(RAY_TURNS)), settings)


def _add_band(
    image_hu: FloatArray, p: FloatArray, e: FloatArray, length: float, hu: float, settings: ScannerSettings
) -> None:
    """A band from ``p`` (mm) along the unit vector ``e``, fading beyond its ends."""
    q = p + length * e
    rows, columns, x, y = _window(np.minimum(p, q) - REACH_MM, np.maximum(p, q) + REACH_MM, settings)
    along = (x - p[0]) * e[0] + (y - p[1]) * e[1]
    across = (y - p[1]) * e[0] - (x - p[0]) * e[1]
    beyond = np.maximum(np.maximum(-along, along - length), 0)
    near = (np.abs(across) < BAND_CUT_SD * BAND_SD_MM) & (beyond < REACH_MM)
    fall = (across[near] / BAND_SD_MM) ** 2 / 2 + beyond[near] / RAY_FADE_MM
    image_hu[rows, columns][near] += hu * np.exp(-fall)


def _add_rays(image_hu: FloatArray, p: FloatArray, hu: float, phases: FloatArray, settings: ScannerSettings) -> None:
    rows, columns, x, y = _window(p - REACH_MM, p + REACH_MM, settings)
    r, angle = np.hypot(x - p[0], y - p[1]), np.arctan2(y - p[1], x - p[0])
    turns = sum(np.cos(2 * n * angle + phase) for n, phase in zip(RAY_TURNS, phases, strict=True))
    image_hu[rows, columns] += hu * turns * np.exp(-r / RAY_FADE_MM) * np.minimum(r / RAY_WIDTH_MM, 1.0)


def _window(
    low_mm: FloatArray, high_mm: FloatArray, settings: ScannerSettings
) -> tuple[slice, slice, FloatArray, FloatArray]:
    """Rows and columns of a rectangle cut at the image's edges, and the x (1, c) and y (r, 1) of its pixels, mm."""
    step, sides = settings.scale.mm_per_px, np.array(settings.shape[::-1])
    first = np.clip(np.floor(low_mm / step).astype(int), 0, sides)
    last = np.clip(np.ceil(high_mm / step).astype(int) + 1, 0, sides)
    x, y = (np.arange(first[k], last[k]) * step[k] for k in (0, 1))
    return slice(first[1], last[1]), slice(first[0], last[0]), x[None, :], y[:, None]


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
