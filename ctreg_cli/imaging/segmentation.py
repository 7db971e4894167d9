"""Spots of a slice: every bright (or dark) place that a rod could have left, best first, each with its covariance.

No threshold is in Hounsfield units and no size is fixed: contrast is judged against the surroundings and the noise of the
image itself, sizes against the field of view, or against the rods and the slab where these are known. Recall goes before
precision: clutter costs the matcher a little time, a lost rod costs the pose.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ctreg_cli.arrays import BoolArray, FloatArray, IntArray
from ctreg_cli.imaging.blob import Blobs, measure_blobs
from ctreg_cli.imaging.localisation import fit_centres
from ctreg_cli.imaging.peaks import Peaks, above_blocks, image_noise, local_maxima, rate_peaks, smoothed
from ctreg_cli.imaging.slice import Slice
from ctreg_cli.imaging.spots import RejectedSpot, Spots
from ctreg_cli.imaging.window import UprightImage

Polarity = Literal["bright", "dark", "auto"]


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmentationOptions:
    """Defaults suit CT and MR slices of any scanner; every field is an option of ``ctreg segment``."""

    #: whether rods are brighter or darker than what surrounds them; ``auto`` takes what stands out more
    polarity: Polarity = "bright"
    #: (least, greatest) rod diameter, mm; sets the expected size where the slice has a scale
    rod_diameter_mm: tuple[float, float] | None = None
    #: at most so many spots a slice, the best ones
    max_spots: int = 40
    #: a spot stands at least so many noise sd above its surroundings
    min_contrast_sd: float = 8.0
    #: and at least this share of the strongest spot's contrast: rods of one frame look alike
    min_relative_contrast: float = 0.1
    #: rods steeper than this against the slice normal are not looked for, degrees
    max_tilt_deg: float = 60.0
    #: without a known rod diameter: a spot is at most this share of the image's longer side thick
    max_width_of_image: float = 0.02


#: radii of the windows tried, px, until a spot fits with background about it
WINDOW_RADII_PX = (7, 11, 17, 26)
#: blur and clipping make a spot look wider than its rod: by this factor and this many pixels
BLOOM_FACTOR = 1.5
BLOOM_PX = 4.0
#: the slab blurs over more than its nominal thickness
SLAB_FACTOR = 1.5
#: elongation allowed where the slab thickness is unknown
MAX_ELONGATION = 5.0
#: candidates measured in windows, at most so many for one spot asked for: bounds the time on noise-like images
CANDIDATES_PER_SPOT = 6
#: at most so many rejected candidates are reported
MAX_REJECTED = 100


def find_spots(slice_: Slice, options: SegmentationOptions = SegmentationOptions()) -> Spots:
    """Spots of the whole slice, most rod-like first; what was looked at and left out is in ``rejected``.

    Rejection reasons: ``low_contrast``, ``too_large``, ``too_elongated``, ``at_border``, ``too_many``.
    """
    if options.polarity == "auto":
        both = [_find(slice_, options, bright=bright) for bright in (True, False)]
        return max(both, key=_prominence)
    return _find(slice_, options, bright=options.polarity == "bright")


def measure_spots(
    slice_: Slice,
    uv_px: FloatArray,
    radius_px: float | FloatArray,
    options: SegmentationOptions = SegmentationOptions(),
) -> Spots:
    """Spots within ``radius_px`` (a number, or (k,)) of predicted centres ``uv_px`` (k, 2), and nowhere else.

    A spot near two predictions is returned once; where nothing is there, nothing is returned. Centres are the same as
    :func:`find_spots` gives: both measure the same windows in the same way. With ``polarity="auto"`` bright is tried
    first and dark only when nothing bright was found.
    """
    if options.polarity == "auto":
        bright = _measure(slice_, uv_px, radius_px, options, bright=True)
        return bright if len(bright) else _measure(slice_, uv_px, radius_px, options, bright=False)
    return _measure(slice_, uv_px, radius_px, options, bright=options.polarity == "bright")


def _prominence(spots: Spots) -> float:
    """How strongly an image's best spots stand out."""
    return float(np.sort(spots.contrast)[::-1][:8].sum()) if len(spots) else 0.0


def _find(slice_: Slice, options: SegmentationOptions, *, bright: bool) -> Spots:
    image = UprightImage.of(slice_, bright=bright)
    dense = image.dense()
    noise = image_noise(dense)
    smooth = smoothed(dense)
    maxima = local_maxima(smooth) & above_blocks(smooth, options.min_contrast_sd * noise)
    rows, columns = np.nonzero(maxima)
    limits = _Limits.of(slice_, options)
    peaks = rate_peaks(
        image,
        np.stack([columns, rows], axis=1),
        smooth[rows, columns].astype(np.float64),
        0.5 * limits.width_px,
    )
    peaks = peaks.take(peaks.contrast > max(options.min_contrast_sd * noise, 0.0))
    peaks = peaks.take(np.argsort(-peaks.contrast, kind="stable"))
    return _spots_at(image, peaks, limits, options)


def _measure(
    slice_: Slice, uv_px: FloatArray, radius_px: float | FloatArray, options: SegmentationOptions, *, bright: bool
) -> Spots:
    uv = np.asarray(uv_px, dtype=np.float64).reshape(-1, 2)
    radius = np.broadcast_to(np.asarray(radius_px, dtype=np.float64), (len(uv),))
    usable = np.isfinite(uv).all(axis=1) & np.isfinite(radius)
    uv, radius = uv[usable], radius[usable]
    if not len(uv):
        return Spots(uv_px=np.empty((0, 2)), covariance_px=np.empty((0, 2, 2)))
    image = UprightImage.of(slice_, bright=bright)
    reach = int(np.ceil(radius.max())) + 1
    middles = np.rint(uv).astype(np.intp)
    windows = smoothed(image.windows(middles, reach))
    which, rows, columns = np.nonzero(local_maxima(windows))
    pixels = middles[which] + np.stack([columns, rows], axis=1) - reach
    near = ((pixels - uv[which]) ** 2).sum(axis=1) <= (radius[which] + 1.0) ** 2
    pixels, heights = pixels[near], windows[which, rows, columns][near]
    limits = _Limits.of(slice_, options)
    peaks = rate_peaks(image, pixels, heights, 0.5 * limits.width_px)
    peaks = peaks.take(peaks.contrast > 0)
    peaks = peaks.take(np.argsort(-peaks.contrast, kind="stable"))
    return _spots_at(image, peaks, limits, options)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Limits:
    """Greatest thickness and length of a spot, px."""

    width_px: float
    length_px: float

    @classmethod
    def of(cls, slice_: Slice, options: SegmentationOptions) -> _Limits:
        scale, thickness = slice_.info.scale, slice_.info.thickness_mm
        per_mm = 1.0 / min(scale.s_x, scale.s_y) if scale is not None else None
        if options.rod_diameter_mm is not None and per_mm is not None:
            width = BLOOM_FACTOR * options.rod_diameter_mm[1] * per_mm + BLOOM_PX
        else:
            width = max(options.max_width_of_image * max(slice_.stored.shape), BLOOM_PX)
        if thickness is not None and per_mm is not None:
            tilt = np.radians(options.max_tilt_deg)
            length = width / np.cos(tilt) + SLAB_FACTOR * thickness * per_mm * np.tan(tilt)
        else:
            length = MAX_ELONGATION * width
        return cls(width_px=width, length_px=float(length))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Found:
    """Measured spots before ranking; all arrays over ``k`` spots."""

    uv_px: FloatArray
    covariance_px: FloatArray
    area_px: FloatArray
    contrast: FloatArray
    noise: FloatArray
    major_px: FloatArray
    minor_px: FloatArray
    angle_rad: FloatArray


def _spots_at(image: UprightImage, peaks: Peaks, limits: _Limits, options: SegmentationOptions) -> Spots:
    """Measure the blobs at ``peaks`` (best first), sort out what is no spot, fit and rank the rest."""
    rejected: list[RejectedSpot] = []

    def reject(uv: FloatArray, reason: str) -> None:
        rejected.extend(RejectedSpot(u_px=float(u), v_px=float(v), reason=reason) for u, v in uv)

    large = peaks.half_width > 0.5 * limits.width_px + 1.0
    reject(peaks.pixels[large], "too_large")
    peaks = peaks.take(~large)
    limit = CANDIDATES_PER_SPOT * options.max_spots
    reject(peaks.pixels[limit:], "low_contrast")
    pending = peaks.take(np.arange(min(limit, len(peaks.pixels)))).pixels
    found: list[_Found] = []
    for radius in WINDOW_RADII_PX:
        if not len(pending):
            break
        blobs = measure_blobs(image, pending, radius)
        again = blobs.cut_off
        pending = pending[again]
        blobs = blobs.take(~again)
        blobs = blobs.take(_first_of_each(blobs))
        major, minor, _ = _axes(blobs.moments)
        for bad, reason in (
            (minor > limits.width_px, "too_large"),
            (major > limits.length_px, "too_elongated"),
            (blobs.at_border, "at_border"),
            (blobs.height <= 0, "low_contrast"),
        ):
            reject((blobs.middles + blobs.centre)[bad], reason)
        good = (minor <= limits.width_px) & (major <= limits.length_px) & ~blobs.at_border & (blobs.height > 0)
        if good.any():
            found.append(_fit(blobs.take(good), image))
    reject(pending.astype(np.float64), "too_large")
    if not found:
        return Spots(uv_px=np.empty((0, 2)), covariance_px=np.empty((0, 2, 2)), rejected=tuple(rejected[:MAX_REJECTED]))
    spots = _joined(found)
    return _ranked(spots, rejected, options)


def _fit(blobs: Blobs, image: UprightImage) -> _Found:
    centres = fit_centres(blobs, image.ceiling)
    major, minor, angle = _axes(blobs.moments)
    return _Found(
        uv_px=centres.uv_px,
        covariance_px=centres.covariance_px,
        area_px=blobs.area,
        contrast=blobs.height * image.unit,
        noise=centres.noise * image.unit,
        major_px=major,
        minor_px=minor,
        angle_rad=angle,
    )


def _joined(parts: list[_Found]) -> _Found:
    return _Found(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in _Found.__slots__})


def _ranked(found: _Found, rejected: list[RejectedSpot], options: SegmentationOptions) -> Spots:
    """The best ``max_spots``: high contrast and round before faint and long."""
    score = found.contrast * np.sqrt(found.minor_px / found.major_px)
    order = np.argsort(-score, kind="stable")
    order = order[_apart(found.uv_px[order], found.minor_px[order])]
    contrast, noise = found.contrast[order], found.noise[order]
    faint = (contrast < options.min_contrast_sd * noise) | (contrast < options.min_relative_contrast * contrast[0])
    beyond = np.cumsum(~faint) > options.max_spots
    for which, reason in ((faint, "low_contrast"), (beyond & ~faint, "too_many")):
        rejected.extend(RejectedSpot(u_px=float(u), v_px=float(v), reason=reason) for u, v in found.uv_px[order[which]])
    keep = order[~faint & ~beyond]
    return Spots(
        uv_px=found.uv_px[keep],
        covariance_px=found.covariance_px[keep],
        area_px=found.area_px[keep],
        contrast=found.contrast[keep],
        major_px=found.major_px[keep],
        minor_px=found.minor_px[keep],
        angle_rad=found.angle_rad[keep],
        rejected=tuple(rejected[:MAX_REJECTED]),
    )


def _axes(moments: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Full lengths (k,) of the axes of uniform ellipses with these second moments, px, and the long axis' angle, rad."""
    values, vectors = np.linalg.eigh(moments)
    minor, major = 4.0 * np.sqrt(np.maximum(values, 0.0)).T
    angle = np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])
    return major, minor, angle


def _first_of_each(blobs: Blobs) -> IntArray:
    """Indices of blobs whose windows differ: several peaks of one blob lead to one window."""
    _, first = np.unique(blobs.middles, axis=0, return_index=True)
    return np.sort(first)


def _apart(uv: FloatArray, width: FloatArray) -> BoolArray:
    """Which of the spots (k, 2), best first, do not lie within half a width of a better one."""
    distance = np.linalg.norm(uv[:, None] - uv[None, :], axis=2)
    close = (distance < 0.5 * np.maximum(width[:, None], width[None, :])) & np.tri(len(uv), k=-1, dtype=bool)
    return ~close.any(axis=1)
