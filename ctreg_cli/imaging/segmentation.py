"""Spots of a slice: every bright (or dark) place that a rod could have left, best first, each with its covariance.

No threshold is in Hounsfield units and no size is fixed: contrast is judged against the surroundings and the noise of
the image itself, sizes against the field of view, or against the rods and the slab where these are known. Recall goes
before precision: clutter costs the matcher a little time, a lost rod costs the pose.

The way of the data: local maxima (:mod:`.peaks`) → half-height blobs in windows (:mod:`.blob`) → what is no spot is
sorted out, the rest ranked → centres and covariances (:mod:`.localisation`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from ctreg_cli.arrays import BoolArray, FloatArray, IntArray
from ctreg_cli.checks import demand, is_number
from ctreg_cli.imaging.blob import BACKGROUND_PX, Blobs, joined, measure_blobs, measure_lone_blobs
from ctreg_cli.imaging.localisation import Centres, fit_centres
from ctreg_cli.imaging.maxima import local_maxima, smoothed
from ctreg_cli.imaging.peaks import (
    BLOCK_PX,
    COARSE_PX,
    RING_RATIO,
    Peaks,
    image_noise,
    large_regions,
    maxima_above,
    rate_peaks,
)
from ctreg_cli.imaging.slice import Slice
from ctreg_cli.imaging.spots import RejectedSpot, Spots
from ctreg_cli.imaging.window import UprightImage, grid

Polarity = Literal["bright", "dark", "auto"]


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmentationOptions:
    """Defaults suit CT and MR slices of any scanner; commands set the polarity, and diameters from their frame file.

    Raises:
        InputError: a value that is not allowed.
    """

    #: whether rods are brighter or darker than what surrounds them; ``auto`` takes what stands out more
    polarity: Polarity = "bright"
    #: (least, greatest) rod diameter, mm; the greatest sets the expected size where the slice has a scale
    rod_diameter_mm: tuple[float, float] | None = None
    #: at most so many spots a slice, the best ones
    max_spots: int = 40
    #: a spot stands at least so many noise sd above its surroundings
    min_contrast_sd: float = 5.0
    #: and at least this share of the strongest spot's contrast: rods of one frame look alike
    min_relative_contrast: float = 0.1
    #: rods steeper than this against the slice normal are not looked for, degrees
    max_tilt_deg: float = 60.0

    def __post_init__(self) -> None:
        polarities, range_mm, most = get_args(Polarity), self.rod_diameter_mm, self.max_spots
        sd, share, tilt = self.min_contrast_sd, self.min_relative_contrast, self.max_tilt_deg
        demand(self.polarity in polarities, "polarity", self.polarity, f"one of {', '.join(map(repr, polarities))}")
        is_range = range_mm is None or (
            len(range_mm) == 2 and all(map(is_number, range_mm)) and 0 < range_mm[0] <= range_mm[1]
        )
        demand(is_range, "rod_diameter_mm", range_mm, "(least, greatest) in millimetres, or None")
        demand(isinstance(most, int) and most > 0, "max_spots", most, "a whole number from 1")
        demand(is_number(sd) and sd >= 0, "min_contrast_sd", sd, "a number from 0")
        demand(is_number(share) and 0 <= share <= 1, "min_relative_contrast", share, "a share between 0 and 1")
        demand(is_number(tilt) and 0 <= tilt < 90, "max_tilt_deg", tilt, "degrees from 0 to below 90")


DEFAULT_OPTIONS = SegmentationOptions()

#: share of a window's range that the top of its spot stands for
BRIGHTEST = 0.25
#: radii of the windows tried, px, until a spot fits with background about it
WINDOW_RADII_PX = (8, 12, 18, 26)
#: without a known rod diameter a spot is at most so thick: in mm, or where there is no scale as a share of the image
MAX_WIDTH_MM, MAX_WIDTH_OF_IMAGE, LEAST_MAX_WIDTH_PX = 6.0, 0.02, 8.0
#: but thicker by up to this factor if it stands out by this share of the best spot and fills this share of an ellipse:
#: rods of one frame look alike, bones are fainter than the metal beside them, and plates and clamps have corners
THICK_FACTOR, THICK_CONTRAST, THICK_FILL = 5 / 3, 0.5, 0.93
#: blur and clipping make a spot look wider than its rod: by this factor and this many pixels
BLOOM_FACTOR, BLOOM_PX = 1.5, 4.0
#: the slab blurs over more than its nominal thickness
SLAB_FACTOR = 1.5
#: elongation allowed where the slab thickness is unknown
MAX_ELONGATION = 5.0
#: the first look misses nothing that matters if the strongest spot has this share of the image's whole range
FIRST_LOOK = 0.5
#: smoothing lowers a sharp spot to about half: a peak is given up only below half the contrast asked of a spot
SMOOTHING_LOSS = 0.5
#: so many peaks are measured for one spot asked for: bounds the time on images of noise
PEAKS_PER_SPOT = 6
#: things are bright that lie above one of these shares of the range between the image's median and its brightest: in a
#: body that does so itself, its bones do
LARGE_SHARES = (0.25, 0.45)
#: at most so many rejected candidates are reported by their places; all are counted
MAX_REJECTED = 100


def find_spots(slice_: Slice, options: SegmentationOptions = DEFAULT_OPTIONS) -> Spots:
    """Spots of the whole slice, most rod-like first; what was looked at and left out is in ``rejected``.

    Reasons there: ``low_contrast``, ``too_large``, ``too_elongated``, ``at_border``, ``too_many``.
    """
    if options.polarity == "auto":
        both = [_find(slice_, options, bright=bright) for bright in (True, False)]
        return max(both, key=_prominence)
    return _find(slice_, options, bright=options.polarity == "bright")


def measure_spots(
    slice_: Slice, uv_px: FloatArray, radius_px: float | FloatArray, options: SegmentationOptions = DEFAULT_OPTIONS
) -> Spots:
    """Spots within ``radius_px`` (a number, or (k,)) of predicted centres ``uv_px`` (k, 2), and nowhere else.

    A spot near two predictions is returned once; where nothing is there, nothing is returned. Centres are those of
    :func:`find_spots`: both measure the same windows in the same way. With ``polarity="auto"`` dark spots are looked
    for only where nothing bright is found.
    """
    if options.polarity == "auto":
        spots = _measure(slice_, uv_px, radius_px, options, bright=True)
        return spots if len(spots) else _measure(slice_, uv_px, radius_px, options, bright=False)
    return _measure(slice_, uv_px, radius_px, options, bright=options.polarity == "bright")


def _prominence(spots: Spots) -> float:
    """How strongly the best spots of an image stand out; a frame shows at least three, seldom more than a dozen."""
    return float(np.sort(spots.contrast)[::-1][:8].sum())


def _find(slice_: Slice, options: SegmentationOptions, *, bright: bool) -> Spots:
    """Look at what stands out by a share of the image's whole range; look deeper only if nothing strong is there.

    The second look is needed only when the strongest spot is so faint that ``min_relative_contrast`` admits spots which
    the first look could not see.
    """
    image = UprightImage.of(slice_, bright=bright)
    dense = image.dense()
    smooth = smoothed(dense)
    limits = _Limits.of(slice_, options)
    least = SMOOTHING_LOSS * options.min_contrast_sd * image_noise(dense)
    share = SMOOTHING_LOSS * options.min_relative_contrast
    margin = max(least, FIRST_LOOK * share * (image.ceiling - float(smooth.min(initial=np.inf))))
    while True:
        rows, columns = maxima_above(smooth, margin)
        pixels, heights = np.stack([columns, rows], axis=1), smooth[rows, columns].astype(np.float64)
        peaks = rate_peaks(image, pixels, heights, 0.5 * limits.width_px)
        rejections = _Rejections()
        groups = _blobs_at(image, peaks.take(peaks.contrast > margin), limits.width_px, limits, options, rejections)
        spots = _spots_of(image, groups, limits, options, rejections)
        needed = max(least, share * float(spots.contrast.max(initial=0.0)) / image.unit)
        if margin <= needed:
            break
        margin = needed
    boxes = _large_boxes(image, smooth, 0.5 * limits.width_px)
    thick = _thick_blobs(image, smooth, boxes, spots, limits)
    if thick:
        spots = _spots_of(image, [*groups, *thick], limits, options, rejections)
    wide = (boxes[:, 2:] - boxes[:, :2]).min(axis=1) + COARSE_PX > limits.width_px
    rejections.add(_middles_of_unseen(boxes[wide], spots, rejections), "too_large", first=True)
    return rejections.of(spots)


def _large_boxes(image: UprightImage, smooth: NDArray[Any], least_px: float) -> FloatArray:
    """Boxes (m, 4) = (u, v from, u, v to) about what is bright and so large that it may have no peak of its own."""
    sample = smooth[::COARSE_PX, ::COARSE_PX]
    sample = sample[np.isfinite(sample)]
    if not sample.size:
        return np.empty((0, 4))
    common = float(np.median(sample))
    levels = common + np.array(LARGE_SHARES) * (image.ceiling - common)
    return np.vstack([large_regions(smooth, level, least_px) for level in levels[::-1]])


def _thick_blobs(
    image: UprightImage, smooth: NDArray[Any], boxes: FloatArray, spots: Spots, limits: _Limits
) -> list[Blobs]:
    """Blobs in the middle of ``boxes`` that stand out no less than is asked of thick ones beside ``spots``."""
    boxes = boxes[(boxes[:, 2:] - boxes[:, :2]).min(axis=1) <= limits.thick_px]
    boxes = boxes[~_within(spots.uv_px, boxes).any(axis=1)]
    pixels = np.unique((0.5 * (boxes[:, :2] + boxes[:, 2:])).astype(np.intp), axis=0)
    if not len(pixels):
        return []
    heights = smooth[pixels[:, 1], pixels[:, 0]].astype(np.float64)
    peaks = rate_peaks(image, pixels, heights, 0.75 * limits.thick_px)
    least = THICK_CONTRAST * float(spots.contrast.max(initial=0.0)) / image.unit
    strong = (peaks.contrast >= least) & np.isfinite(peaks.half_width)
    return _blobs(image, peaks.pixels[strong], limits, least, _Rejections())


def _middles_of_unseen(boxes: FloatArray, spots: Spots, rejections: _Rejections) -> FloatArray:
    """Middles (m, 2) of the ``boxes`` in which neither a spot nor a rejected candidate lies."""
    seen = np.vstack([spots.uv_px, *([[r.u_px, r.v_px]] for r in rejections.spots)])
    unseen = boxes[~_within(seen, boxes).any(axis=1)]
    return np.unique(0.5 * (unseen[:, :2] + unseen[:, 2:]), axis=0)


def _within(uv: FloatArray, boxes: FloatArray) -> BoolArray:
    """Which points (k, 2) lie in which boxes (m, 4): (m, k)."""
    inside: BoolArray = np.all((uv >= boxes[:, None, :2]) & (uv <= boxes[:, None, 2:]), axis=2)
    return inside


def _measure(
    slice_: Slice, uv_px: FloatArray, radius_px: float | FloatArray, options: SegmentationOptions, *, bright: bool
) -> Spots:
    uv = np.asarray(uv_px, dtype=np.float64).reshape(-1, 2)
    radius = np.broadcast_to(np.asarray(radius_px, dtype=np.float64), (len(uv),))
    usable = np.isfinite(uv).all(axis=1) & np.isfinite(radius)
    uv, radius = uv[usable], radius[usable]
    if not len(uv):
        return _EMPTY
    image, limits, rejections = UprightImage.of(slice_, bright=bright), _Limits.of(slice_, options), _Rejections()
    lone, settled = _lone_blobs(image, uv, radius, limits)
    groups = [lone] if len(lone) else []
    if not settled.all():
        peaks = _peaks_about(image, uv[~settled], radius[~settled], limits)
        width_px = RING_RATIO * limits.thick_px  # how thick it is shows better in its blob than between two rings
        groups += _blobs_at(image, peaks.take(peaks.contrast > 0), width_px, limits, options, rejections)
    spots = _spots_of(image, _merged(groups), limits, options, rejections)
    near = (np.linalg.norm(spots.uv_px[:, None] - uv, axis=2) <= radius).any(axis=1)
    return rejections.of(spots if near.all() else spots.take(near))


def _lone_blobs(image: UprightImage, uv: FloatArray, radius: FloatArray, limits: _Limits) -> tuple[Blobs, BoolArray]:
    """Blobs near those predictions that have one, well apart from all else; and which (k,) predictions these are.

    In such windows there is nothing to search for and nothing to sort out.
    """
    middles = np.rint(uv).astype(np.intp)
    reach = int(radius.max()) + 1
    u, v = grid(reach)
    off_u, off_v = u + (middles - uv)[:, 0, None, None], v + (middles - uv)[:, 1, None, None]
    within = off_u * off_u + off_v * off_v <= (radius * radius)[:, None, None]
    windows = np.where(within, image.windows(middles, reach), -np.inf)
    blobs, lone = measure_lone_blobs(image, middles + _brightest_place(windows), WINDOW_RADII_PX[0])
    major, minor, _ = blobs.axes
    lone &= (minor <= limits.width_px) & (major <= limits.length_px)
    lone &= np.hypot(*(blobs.uv_px - uv).T) + radius <= blobs.radius  # so that its window shows all that was looked at
    between = np.hypot(*(blobs.uv_px[:, None] - blobs.uv_px).transpose(2, 0, 1))
    lone &= np.count_nonzero(between <= blobs.radius, axis=1) == 1
    return (blobs if lone.all() else blobs.take(lone)), lone


def _brightest_place(windows: FloatArray) -> IntArray:
    """Offset (k, 2), px, from the middle of each window (k, n, n) to that of the brightest quarter of its range."""
    k, n, _ = windows.shape
    flat = windows.reshape(k, -1)
    top = flat.max(axis=1)
    least = np.where(np.isfinite(flat), flat, np.inf).min(axis=1)
    with np.errstate(invalid="ignore"):  # a window may show nothing of the image
        bright = (flat >= (top - BRIGHTEST * (top - least))[:, None]).astype(np.float64)
    u, v = (axis.ravel() for axis in grid(n // 2))
    sums = bright @ np.stack([u, v, np.ones(n * n)], axis=1)
    offset: IntArray = np.rint(sums[:, :2] / np.maximum(sums[:, 2:], 1.0)).astype(np.intp)
    return offset


def _peaks_about(image: UprightImage, uv: FloatArray, radius: FloatArray, limits: _Limits) -> Peaks:
    """All peaks near predictions; the prediction itself where the window has none: it may lie within a flat top."""
    reach = int(np.ceil(radius.max())) + 2
    middles = np.rint(uv).astype(np.intp)
    windows = smoothed(image.windows(middles, reach))
    which, rows, columns = np.nonzero(local_maxima(windows))
    pixels = middles[which] + np.stack([columns, rows], axis=1) - reach
    heights = windows[which, rows, columns]
    looked_at = ((pixels - uv[which]) ** 2).sum(axis=1) <= (radius[which] + 1.0) ** 2
    looked_at &= heights > np.median(windows, axis=(1, 2))[which]
    bare = ~np.isin(np.arange(len(uv)), which[looked_at])
    pixels = np.vstack([pixels[looked_at], middles[bare]])
    heights = np.concatenate([heights[looked_at], windows[bare, reach, reach]])
    return rate_peaks(image, pixels, heights, 0.5 * limits.thick_px)


def _merged(groups: Sequence[Blobs]) -> list[Blobs]:
    """The same blobs, those in windows of one size together."""
    radii = dict.fromkeys(group.radius for group in groups)
    same = ([group for group in groups if group.radius == radius] for radius in radii)
    return [parts[0] if len(parts) == 1 else joined(parts) for parts in same]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Limits:
    """Greatest thickness and length of a spot, px."""

    width_px: float
    #: of spots no thicker than that
    length_px: float
    #: greatest thickness of what stands out no less than the best spots
    thick_px: float
    max_tilt_deg: float

    @classmethod
    def of(cls, slice_: Slice, options: SegmentationOptions) -> _Limits:
        scale, thickness = slice_.info.scale, slice_.info.thickness_mm
        px_per_mm = 1.0 / min(scale.s_x, scale.s_y) if scale is not None else None
        if px_per_mm is None:
            width = MAX_WIDTH_OF_IMAGE * max(slice_.stored.shape)
        elif options.rod_diameter_mm is None:
            width = MAX_WIDTH_MM * px_per_mm
        else:
            width = BLOOM_FACTOR * options.rod_diameter_mm[1] * px_per_mm + BLOOM_PX
        width = max(width, LEAST_MAX_WIDTH_PX)
        known = px_per_mm is not None and options.rod_diameter_mm is not None
        length = MAX_ELONGATION * width
        if thickness is not None and px_per_mm is not None:
            tilt = np.radians(options.max_tilt_deg)
            length = float(width / np.cos(tilt) + SLAB_FACTOR * thickness * px_per_mm * np.tan(tilt))
        return cls(
            width_px=width,
            length_px=length,
            thick_px=width if known else THICK_FACTOR * width,
            max_tilt_deg=options.max_tilt_deg,
        )

    def lengths_px(self, width_px: FloatArray) -> FloatArray:
        """Greatest lengths (k,) of spots so thick (k,): tilt lengthens what is thicker the more."""
        beyond = np.maximum(width_px - self.width_px, 0.0)
        return np.asarray(self.length_px + beyond / np.cos(np.radians(self.max_tilt_deg)))


@dataclass(slots=True, kw_only=True)
class _Rejections:
    """What was left out so far."""

    spots: list[RejectedSpot] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)

    def add(self, uv: FloatArray | IntArray, reason: str, *, first: bool = False) -> None:
        """Count candidates (k, 2), and list them, after all others or before them, as far as there is room."""
        if len(uv):
            self.counts[reason] += len(uv)
            new = [RejectedSpot(u_px=float(u), v_px=float(v), reason=reason) for u, v in uv[:MAX_REJECTED]]
            self.spots = [*new, *self.spots][:MAX_REJECTED] if first else [*self.spots, *new][:MAX_REJECTED]

    def of(self, spots: Spots) -> Spots:
        """The spots with these rejections instead of their own, but for what is the inside of a spot."""
        rejected, counts = self.spots, self.counts.copy()
        if len(spots) and rejected:
            uv = np.array([[r.u_px, r.v_px] for r in rejected])
            inside = (np.linalg.norm(uv[:, None] - spots.uv_px, axis=2) < 0.5 * spots.minor_px).any(axis=1)
            counts -= Counter(r.reason for r, is_in in zip(rejected, inside, strict=True) if is_in)
            rejected = [r for r, is_in in zip(rejected, inside, strict=True) if not is_in]
        return spots.with_rejected(tuple(rejected), dict(counts))


def _blobs_at(
    image: UprightImage,
    peaks: Peaks,
    width_px: float,
    limits: _Limits,
    options: SegmentationOptions,
    rejections: _Rejections,
) -> list[Blobs]:
    """Blobs at ``peaks`` no wider than ``width_px`` that could be spots, in groups of one size of window."""
    peaks = peaks.take(np.argsort(-peaks.contrast, kind="stable"))
    large = peaks.half_width > 0.5 * width_px + 1.0
    rejections.add(_one_a_block(peaks.pixels[large]), "too_large")
    peaks = peaks.take(~large)
    least = SMOOTHING_LOSS * options.min_relative_contrast * peaks.contrast.max(initial=0.0)
    faint = (peaks.contrast < least) | (np.arange(len(peaks.pixels)) >= PEAKS_PER_SPOT * options.max_spots)
    groups = _blobs(image, peaks.pixels[~faint], limits, least, rejections)
    rejections.add(peaks.pixels[faint], "low_contrast")
    return groups


def _one_a_block(pixels: IntArray) -> IntArray:
    """Of many peaks (k, 2) on one large thing, one in each block of the image."""
    if not len(pixels):
        return pixels
    _, first = np.unique(pixels // BLOCK_PX, axis=0, return_index=True)
    return pixels[np.sort(first)]


def _spots_of(
    image: UprightImage,
    groups: Sequence[Blobs],
    limits: _Limits,
    options: SegmentationOptions,
    rejections: _Rejections,
) -> Spots:
    """The best blobs, fitted and ranked."""
    if not groups:
        return _EMPTY
    chosen = _choose(groups, limits, options, rejections)
    ends = np.cumsum([len(group) for group in groups])[:-1]
    parts = [group.take(part) for group, part in zip(groups, np.split(chosen, ends), strict=True) if part.any()]
    return _as_spots(parts, [fit_centres(part, image.ceiling) for part in parts], image.unit, options, rejections)


def _blobs(
    image: UprightImage, pending: IntArray, limits: _Limits, least: float, rejections: _Rejections
) -> list[Blobs]:
    """Blobs that could be spots, grouped by size of window: the smallest that shows background about them.

    Where nothing stands out by ``least``, the window may lie within something wider than itself: a larger one is tried.
    """
    groups, previous = [], 0
    faint = np.zeros(len(pending), dtype=bool)
    longest = max(limits.length_px, limits.thick_px)
    for radius in WINDOW_RADII_PX:
        if not len(pending) or previous > 0.5 * longest + BACKGROUND_PX:
            break
        blobs = measure_blobs(image, pending, radius)
        major, minor, _ = blobs.axes
        now_faint = (blobs.height <= 0) | (blobs.height < least)
        beside = faint & ~now_faint & (minor <= previous)  # something else stands out of the larger window's background
        rejections.add(blobs.uv_px[beside], "low_contrast")
        too_small = ~beside & (blobs.cut_off | now_faint)
        ragged = blobs.area < THICK_FILL * 0.25 * np.pi * major * minor
        good = ~beside & ~too_small
        for is_so, reason in (
            ((minor > limits.thick_px) | ((minor > limits.width_px) & ragged), "too_large"),
            (major > limits.lengths_px(minor), "too_elongated"),
            (blobs.at_border, "at_border"),
        ):
            rejections.add(np.unique(blobs.uv_px[good & is_so], axis=0), reason)
            good &= ~is_so
        if good.any():
            found = blobs.take(good)  # several peaks may lead to the same one
            groups.append(found.take(np.sort(np.unique(found.middles, axis=0, return_index=True)[1])))
        pending, faint, previous = pending[too_small], now_faint[too_small], radius
    rejections.add(pending[faint], "low_contrast")
    rejections.add(pending[~faint], "too_large")
    return groups


def _choose(
    groups: Sequence[Blobs], limits: _Limits, options: SegmentationOptions, rejections: _Rejections
) -> BoolArray:
    """Which blobs of all groups (in their order) become spots: the best, each blob once."""
    uv = np.concatenate([group.uv_px for group in groups])
    height = np.concatenate([group.height for group in groups])
    major, minor, _ = _axes(groups)
    thick = (minor > limits.width_px) & (height < THICK_CONTRAST * height.max())
    order = np.argsort(-_score(height, major, minor), kind="stable")
    order = order[_apart(uv[order], minor[order])]
    rejections.add(uv[order[thick[order]]], "too_large")
    order = order[~thick[order]]
    faint = height[order] < options.min_relative_contrast * height[order[0]]
    beyond = ~faint & (np.cumsum(~faint) > options.max_spots)
    rejections.add(uv[order[faint]], "low_contrast")
    rejections.add(uv[order[beyond]], "too_many")
    chosen = np.zeros(len(uv), dtype=bool)
    chosen[order[~faint & ~beyond]] = True
    return chosen


def _axes(groups: Sequence[Blobs]) -> FloatArray:
    """Long and short axis, px, and angle, rad, (3, k) of the blobs of all groups."""
    return np.concatenate([np.stack(group.axes) for group in groups], axis=1)


def _score(height: FloatArray, major: FloatArray, minor: FloatArray) -> FloatArray:
    """(k,) large for what stands out and is round."""
    score: FloatArray = height * np.sqrt(minor / major)
    return score


def _apart(uv: FloatArray, width: FloatArray) -> BoolArray:
    """Which of the spots (k, 2), best first, do not lie within half a width of a better one."""
    distance = np.linalg.norm(uv[:, None] - uv[None, :], axis=2)
    close = (distance < 0.5 * np.maximum(width[:, None], width[None, :])) & np.tri(len(uv), k=-1, dtype=bool)
    apart: BoolArray = ~close.any(axis=1)
    return apart


def _as_spots(
    blobs: Sequence[Blobs],
    centres: Sequence[Centres],
    unit: float,
    options: SegmentationOptions,
    rejections: _Rejections,
) -> Spots:
    """Blobs and their fitted centres as spots, best first, without those that the noise about them could have made."""
    major, minor, angle = _axes(blobs)
    height = np.concatenate([part.height for part in blobs])
    noise = np.concatenate([part.noise for part in centres])
    uv = np.concatenate([part.uv_px for part in centres])
    order = np.argsort(-_score(height, major, minor), kind="stable")
    faint = height[order] < options.min_contrast_sd * noise[order]
    rejections.add(uv[order[faint]], "low_contrast")
    keep = order[~faint]
    return Spots.of_own(
        uv_px=uv[keep],
        covariance_px=np.concatenate([part.covariance_px for part in centres])[keep],
        area_px=np.concatenate([part.area for part in blobs])[keep],
        contrast=height[keep] * unit,
        major_px=major[keep],
        minor_px=minor[keep],
        angle_rad=angle[keep],
    )


_EMPTY = Spots(uv_px=np.empty((0, 2)), covariance_px=np.empty((0, 2, 2)))
