"""The bright blob in the middle of a window: its background, height and half-height region, measured before any fit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from ctreg_cli.arrays import BoolArray, FloatArray, IntArray, frozen, frozen_index
from ctreg_cli.imaging.maxima import ascents, smoothed
from ctreg_cli.imaging.window import UprightImage, dilated, grid, nan_quantile, ring

#: share of the ring that neighbours, plate edges and streaks may brighten without lifting the background
BACKGROUND_QUANTILE = 0.75
#: heights at which a blob is searched for a valley through it; how deep it must be, in spreads of its ring
SPLIT_LEVELS, SPLIT_DEPTH = (0.65, 0.85), 12.0
#: width of the background that must be seen between a blob and the edge of its window, px
BACKGROUND_PX = 4.0
#: a window is moved to its blob's centre at most so often; once is nearly always enough
RECENTRINGS = 3
#: a blob's peak lies within this of its window's middle, px
CORE_PX = 2.0
#: beside a lone blob nothing stands out by more than so many spreads of the ring, which no noise does; but by a tenth
#: of its height in any case (what is fainter is no rod beside it), by a fifth in none
LONE_SPREADS, LONE_SHARES = 7.0, (0.1, 0.2)
#: a pixel is 1/12 px² wide in second moments
_PIXEL_VARIANCE = 1.0 / 12.0
_UNIT = np.eye(2)

_ARRAYS = ("middles", "values", "background", "height", "own", "foreign", "centre", "moments")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Blobs:
    """``k`` blobs in windows (k, n, n) of one radius; coordinates from the window's middle pixel, px."""

    #: (k, 2) integer pixel (column, row) in the middle of each window
    middles: IntArray
    radius: int
    #: (k, n, n) upright values, NaN outside the image
    values: FloatArray
    background: FloatArray
    #: (k,) peak above background
    height: FloatArray
    #: (k, n, n) pixels above half height joined to the middle, and those that are not
    own: BoolArray
    foreign: BoolArray
    #: (k, 2) centre of gravity and (k, 2, 2) second moments of ``own``
    centre: FloatArray
    moments: FloatArray

    def __len__(self) -> int:
        return len(self.middles)

    @property
    def uv_px(self) -> FloatArray:
        """(k, 2) centres of gravity in the image, px."""
        uv: FloatArray = self.middles + self.centre
        return uv

    @property
    def axes(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Full length (k,) of the long and the short axis of the uniform ellipse with these moments, px; angle, rad."""
        return axes_of(self.moments)

    @property
    def area(self) -> FloatArray:
        """(k,) pixels above half height."""
        return np.asarray(self.own.sum(axis=(1, 2), dtype=np.float64))

    @property
    def cut_off(self) -> BoolArray:
        """(k,) whether the blob leaves too little background about it: the window is too small."""
        return np.asarray(self.own.reshape(len(self), -1)[:, _outer(self.radius)].any(axis=1))

    @property
    def at_border(self) -> BoolArray:
        """(k,) whether the blob touches what is not image."""
        nothing = np.isnan(self.values)
        if not nothing.any():
            return np.zeros(len(self.values), dtype=bool)
        return np.asarray((dilated(nothing) & self.own).any(axis=(1, 2)))

    def take(self, which: BoolArray | IntArray) -> Blobs:
        """Some of the blobs."""
        return Blobs(radius=self.radius, **{name: getattr(self, name)[which] for name in _ARRAYS})

    def replaced(self, at: IntArray, by: Blobs) -> Blobs:
        """The same blobs but for those at the indices ``at``."""
        arrays = {name: getattr(self, name).copy() for name in _ARRAYS}
        for name, values in arrays.items():
            values[at] = getattr(by, name)
        return Blobs(radius=self.radius, **arrays)


def joined(parts: Sequence[Blobs]) -> Blobs:
    """All blobs of several sets in windows of one radius."""
    arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _ARRAYS}
    return Blobs(radius=parts[0].radius, **arrays)


def measure_blobs(image: UprightImage, peaks: IntArray, radius: int) -> Blobs:
    """Measure the blobs at ``peaks`` (k, 2) in windows centred on the blobs themselves.

    So whoever comes with another peak of the same blob gets the same window, and the same centre from it.
    """
    blobs = _measure(image, peaks, radius)
    for attempt in range(RECENTRINGS):
        middles = np.rint(blobs.uv_px).astype(np.intp)
        moved = (middles != blobs.middles).any(axis=1)
        if attempt:  # a long blob may fit once its middle is found; what still does not is given up here
            moved &= ~blobs.cut_off
        moved = np.flatnonzero(moved)
        if not len(moved):
            break
        blobs = blobs.replaced(moved, _measure(image, middles[moved], radius))
    return blobs


def measure_lone_blobs(image: UprightImage, middles: IntArray, radius: int) -> tuple[Blobs, BoolArray]:
    """The blobs at ``middles`` (k, 2) where nothing is beside them, and where (k,) that is so.

    Those are what :func:`measure_blobs` finds, but for the search of what hangs together: of a lone blob all that is
    bright is its own. Elsewhere the numbers mean nothing.
    """
    blobs, edge = _measure_lone(image, middles, radius)
    centred = np.rint(blobs.uv_px).astype(np.intp)
    if (centred != middles).any():
        blobs, edge = _measure_lone(image, centred, radius)
    return blobs, _is_lone(blobs, edge)


def _measure_lone(image: UprightImage, middles: IntArray, radius: int) -> tuple[Blobs, FloatArray]:
    """Blobs, and the sorted values (k, p) of the rings about them."""
    values = image.windows(middles, radius)
    flat = values.reshape(len(values), -1)
    edge = np.sort(flat[:, ring(radius)], axis=1)
    background = edge[:, round(BACKGROUND_QUANTILE * (edge.shape[1] - 1))]
    height = flat[:, _core(radius)].max(axis=1) - background
    own = values > (background + 0.5 * height)[:, None, None]
    return _with_moments(middles, radius, values, background, height, own, np.zeros_like(own)), edge


def _is_lone(blobs: Blobs, edge: FloatArray) -> BoolArray:
    """Whether (k,) a window holds one peak in its middle, and no more than its background at its ``edge``."""
    k, n = len(blobs), 2 * blobs.radius + 1
    low, high = (share * blobs.height for share in LONE_SHARES)
    spread = 0.5 * (blobs.background - edge[:, round((1.0 - BACKGROUND_QUANTILE) * (edge.shape[1] - 1))])
    most = blobs.background + np.minimum(np.maximum(LONE_SPREADS * spread, low), high)
    # NaN go last when sorted, and compare as false
    lone = (edge[:, -1] < most) & (np.maximum(*np.abs(blobs.centre.T)) <= 0.5) & ~blobs.cut_off
    smooth = smoothed(blobs.values)
    smooth[:, [0, -1]] = smooth[:, :, [0, -1]] = -np.inf
    peaks = ascents(smooth.ravel(), np.flatnonzero(smooth > most[:, None, None]), n)
    lone &= np.bincount(peaks // (n * n), minlength=k) == 1
    return np.asarray(lone)


def _measure(image: UprightImage, middles: IntArray, radius: int) -> Blobs:
    values = image.windows(middles, radius)
    k = len(values)
    background = np.nan_to_num(nan_quantile(values.reshape(k, -1)[:, ring(radius)], BACKGROUND_QUANTILE))
    above = np.where(np.isnan(values), -np.inf, values - background[:, None, None])
    core = _core(radius)
    peak = core[above.reshape(k, -1)[:, core].argmax(axis=1)]
    height = above.reshape(k, -1)[np.arange(k), peak]
    bright = above > 0.5 * height[:, None, None]
    own = _joined_to(bright, peak)
    spread = _spread(values.reshape(k, -1)[:, ring(radius)], background)
    for level in SPLIT_LEVELS:
        clear = np.flatnonzero((1.0 - level) * height > SPLIT_DEPTH * spread)
        if len(clear):
            high = above[clear] > level * height[clear, None, None]
            own[clear] = _apart_from_neighbour(own[clear], own[clear] & high, peak[clear])
    return _with_moments(middles, radius, values, background, height, own, bright & ~own)


def _with_moments(
    middles: IntArray,
    radius: int,
    values: FloatArray,
    background: FloatArray,
    height: FloatArray,
    own: BoolArray,
    foreign: BoolArray,
) -> Blobs:
    centre, moments = moments_of(own, radius)
    return Blobs(
        middles=middles,
        radius=radius,
        values=values,
        background=background,
        height=height,
        own=own,
        foreign=foreign,
        centre=centre,
        moments=moments,
    )


@cache
def _outer(radius: int) -> IntArray:
    """Flat indices of the pixels of a window in which no blob may lie."""
    return frozen_index(np.flatnonzero(np.hypot(*grid(radius)) > radius - BACKGROUND_PX))


@cache
def _core(radius: int) -> IntArray:
    """Flat indices of the pixels about the middle of a window in which its blob's peak lies."""
    return frozen_index(np.flatnonzero(np.hypot(*grid(radius)) < CORE_PX))


def axes_of(moments: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """:attr:`Blobs.axes` of second moments (k, 2, 2)."""
    uu, uv, vv = moments[:, 0, 0], moments[:, 0, 1], moments[:, 1, 1]
    half_trace, half_difference = 0.5 * (uu + vv), 0.5 * (uu - vv)
    root = np.hypot(half_difference, uv)
    major, minor = 4.0 * np.sqrt(half_trace + root), 4.0 * np.sqrt(np.maximum(half_trace - root, 0.0))
    return major, minor, 0.5 * np.arctan2(uv, half_difference)


def moments_of(own: BoolArray, radius: int) -> tuple[FloatArray, FloatArray]:
    """Centres of gravity (k, 2) and second moments (k, 2, 2) of regions (k, n, n) of windows, px."""
    sums = own.reshape(len(own), -1).astype(np.float64).dot(monomials(radius))
    sums /= np.maximum(sums[:, :1], 1.0)
    centre = sums[:, 1:3].copy()
    moments = sums[:, 3:].reshape(-1, 2, 2) - centre[:, :, None] * centre[:, None]
    moments += _PIXEL_VARIANCE * _UNIT
    return centre, moments


@cache
def monomials(radius: int) -> FloatArray:
    """(n², 7): 1; u, v; u², uv, uv, v² at the pixels of a window."""
    u, v = (axis.ravel() for axis in grid(radius))
    return frozen(np.stack([np.ones(u.size), u, v, u * u, u * v, u * v, v * v], axis=1), (u.size, 7))


def ellipse(n: float, u: float, v: float, uu: float, uv: float, _: float, vv: float) -> tuple[float, ...]:
    """The uniform ellipse of a region from its sums over the pixels (:func:`monomials`).

    As :func:`moments_of`, :func:`inverse_elements` and :func:`axes_of` make those of many; of one in plain numbers,
    which for a few costs a third.

    Returns:
        Its middle u, v, px; A, B, C of its edge ``A u² + 2 B u v + C v² = 1``, seen from there; its long and its short
        axis, px, and the angle of the long one, rad.
    """
    n = max(n, 1.0)
    u, v = u / n, v / n
    uu, uv, vv = uu / n - u * u + _PIXEL_VARIANCE, uv / n - u * v, vv / n - v * v + _PIXEL_VARIANCE
    scale = 0.25 / (uu * vv - uv * uv)  # such an ellipse has a quarter of its semi-axes squared
    half_trace, half_difference = 0.5 * (uu + vv), 0.5 * (uu - vv)
    root = math.hypot(half_difference, uv)
    long, thick = 4.0 * math.sqrt(half_trace + root), 4.0 * math.sqrt(max(half_trace - root, 0.0))
    return u, v, vv * scale, -uv * scale, uu * scale, long, thick, 0.5 * math.atan2(uv, half_difference)


def inverse_elements(symmetric: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Elements uu, uv, vv (k,) of the inverses of (k, 2, 2)."""
    uu, uv, vv = symmetric[:, 0, 0], symmetric[:, 0, 1], symmetric[:, 1, 1]
    determinant = uu * vv - uv * uv
    return vv / determinant, -uv / determinant, uu / determinant


def _spread(ring_values: FloatArray, background: FloatArray) -> FloatArray:
    """Half the range (k,) between the quartiles of the ring: about 0.7 sd of what is not flat there."""
    return np.asarray(background - np.nan_to_num(nan_quantile(ring_values, 1.0 - BACKGROUND_QUANTILE))) / 2


def _apart_from_neighbour(own: BoolArray, high: BoolArray, seed: IntArray) -> BoolArray:
    """Blobs (k, n, n) without what belongs to another peak, if their ``high`` parts hang together only below a valley.

    There another spot begins, whose tail has filled the valley up.
    """
    mine = _joined_to(high, seed)
    split = np.flatnonzero((high & ~mine).any(axis=(1, 2)))
    if not len(split):
        return own
    whole, mine, other = own[split], mine[split], (high & ~mine)[split]
    while True:  # both parts grow in turn until they share the blob out
        grown = dilated(mine) & whole & ~other
        beyond = dilated(other) & whole & ~grown
        if (grown == mine).all() and (beyond == other).all():
            break
        mine, other = grown, beyond
    own[split] = mine
    return own


def _joined_to(bright: BoolArray, seed: IntArray) -> BoolArray:
    """The connected region (8 neighbours) of each window of (k, n, n) that holds its ``seed`` pixel (flat index)."""
    from scipy.ndimage import label

    within_a_window = np.zeros((3, 3, 3), dtype=np.intp)
    within_a_window[1] = 1
    labels, _ = label(bright, structure=within_a_window)
    own = labels.reshape(len(labels), -1)[np.arange(len(labels)), seed]
    joined: BoolArray = (labels == own[:, None, None]) & bright
    return joined
