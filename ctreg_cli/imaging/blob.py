"""The bright blob in the middle of a window: background, height, half-height region. The crude measure before the fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctreg_cli.arrays import BoolArray, FloatArray, IntArray
from ctreg_cli.imaging.window import UprightImage, dilated, grid, nan_quantile, ring

#: share of the ring that neighbours, plate edges and streaks may brighten without lifting the background
BACKGROUND_QUANTILE = 0.75
#: a pixel is 1/12 px² wide in second moments
_PIXEL_VARIANCE = 1.0 / 12.0


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

    @property
    def area(self) -> FloatArray:
        """(k,) pixels above half height."""
        area: FloatArray = self.own.sum(axis=(1, 2)).astype(np.float64)
        return area

    @property
    def cut_off(self) -> BoolArray:
        """(k,) whether the blob reaches the ring that should show its background: the window is too small."""
        u, v = grid(self.radius)
        edge = np.hypot(u, v) > self.radius - 2
        reached: BoolArray = (self.own & edge).any(axis=(1, 2))
        return reached

    @property
    def at_border(self) -> BoolArray:
        """(k,) whether the blob touches what is not image."""
        nothing = np.isnan(self.values)
        if not nothing.any():
            return np.zeros(len(self.values), dtype=bool)
        touching: BoolArray = (dilated(nothing) & self.own).any(axis=(1, 2))
        return touching

    def take(self, which: BoolArray | IntArray) -> Blobs:
        """Some of the blobs."""
        arrays = ("middles", "values", "background", "height", "own", "foreign", "centre", "moments")
        return Blobs(radius=self.radius, **{name: getattr(self, name)[which] for name in arrays})


def measure_blobs(image: UprightImage, peaks: IntArray, radius: int) -> Blobs:
    """Measure the blobs at ``peaks`` (k, 2), twice: the second time in windows centred on the blobs themselves.

    So whoever comes with a slightly other peak of the same blob gets the same windows, and the same centre from them.
    """
    first = _measure(image, peaks, radius)
    middles = first.middles + np.rint(first.centre).astype(np.intp)
    moved = (middles != first.middles).any(axis=1)
    return _measure(image, middles, radius) if moved.any() else first


def _measure(image: UprightImage, middles: IntArray, radius: int) -> Blobs:
    values = image.windows(middles, radius)
    k = len(values)
    u, v = grid(radius)
    background = np.nan_to_num(nan_quantile(values[:, ring(radius)], BACKGROUND_QUANTILE))
    above = np.where(np.isnan(values), -np.inf, values - background[:, None, None])
    core = np.hypot(u, v) < 2.0
    peak = np.where(core, above, -np.inf).reshape(k, -1).argmax(axis=1)
    height = above.reshape(k, -1)[np.arange(k), peak]
    bright = above > 0.5 * height[:, None, None]
    own = _joined_to(bright, peak)
    count = np.maximum(own.sum(axis=(1, 2)), 1)
    flat = own.reshape(k, -1).astype(np.float64)
    basis = np.stack([u, v, u * u, u * v, v * v]).reshape(5, -1)
    mean_u, mean_v, uu, uv, vv = (flat @ basis.T).T / count
    moments = np.empty((k, 2, 2))
    moments[:, 0, 0] = uu - mean_u**2 + _PIXEL_VARIANCE
    moments[:, 1, 1] = vv - mean_v**2 + _PIXEL_VARIANCE
    moments[:, 0, 1] = moments[:, 1, 0] = uv - mean_u * mean_v
    return Blobs(
        middles=middles,
        radius=radius,
        values=values,
        background=background,
        height=height,
        own=own,
        foreign=bright & ~own,
        centre=np.stack([mean_u, mean_v], axis=1),
        moments=moments,
    )


def _joined_to(bright: BoolArray, seed: IntArray) -> BoolArray:
    """The connected region (8 neighbours) of each window of (k, n, n) that holds its ``seed`` pixel (flat index)."""
    from scipy.ndimage import label

    within_a_window = np.zeros((3, 3, 3), dtype=np.intp)
    within_a_window[1] = 1
    labels, _ = label(bright, structure=within_a_window)
    own = labels.reshape(len(labels), -1)[np.arange(len(labels)), seed]
    joined: BoolArray = (labels == own[:, None, None]) & bright
    return joined
