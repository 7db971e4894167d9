"""Square windows of a slice, as the fits want them: stored units, spots upright, padding as NaN.

Stored units are whole numbers, and are fitted as such. Pixels of floating point, whose range may be anything, are
stretched to the range of 16 bits first.

Nothing here touches the whole image except one search for its largest value: the tracking path looks at a few hundred
pixels of a quarter of a million.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctreg_cli.arrays import BoolArray, FloatArray, IntArray, frozen, frozen_index
from ctreg_cli.imaging.slice import Slice

#: steps over the range of an image of floating point
FLOAT_STEPS = 65536.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class UprightImage:
    """A slice seen so that its spots are bright: stored values times ``sign``; what is not image is NaN."""

    source: Slice
    #: +1 when spots are brighter than what surrounds them, −1 when darker; of floating-point pixels times a stretch
    sign: float
    #: the largest upright value of the image; pixels that hold it may be cut off (3071 HU, 255 in a PNG)
    ceiling: float

    @classmethod
    def of(cls, slice_: Slice, *, bright: bool) -> UprightImage:
        """View ``slice_`` with spots upright; a negative rescale slope turns the stored values over once more."""
        sign = (-1.0 if slice_.slope < 0 else 1.0) * (1.0 if bright else -1.0)
        stored = slice_.stored
        counted = np.issubdtype(stored.dtype, np.integer)
        extreme = (stored.max() if sign > 0 else stored.min()) if stored.size and counted else np.nan
        if not counted or (slice_.padding is not None and slice_.padding[0] <= extreme <= slice_.padding[1]):
            valid = stored[np.isfinite(stored) & ~slice_.is_padding(stored)]
            extreme = (valid.max() if sign > 0 else valid.min()) if valid.size else np.nan
            if not counted and valid.size:
                sign *= _stretch(float(valid.min()), float(valid.max()))
        ceiling = -np.inf if np.isnan(extreme) else float(extreme) * sign
        return cls(source=slice_, sign=sign, ceiling=ceiling)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        rows, columns = self.source.stored.shape
        return int(rows), int(columns)

    @property
    def unit(self) -> float:
        """The image's own units (HU) in one upright unit, always positive."""
        return abs(self.source.slope / self.sign)

    def dense(self) -> NDArray[Any]:
        """The whole image, float32 where that holds the stored values exactly; NaN outside the image."""
        stored = self.source.stored
        exact = np.issubdtype(stored.dtype, np.integer) and stored.dtype.itemsize <= 2
        image = stored.astype(np.float32 if exact else np.float64)
        if self.sign == -1.0:
            np.negative(image, out=image)
        elif self.sign != 1.0:
            np.multiply(image, self.sign, out=image)
            image[~np.isfinite(image)] = np.nan
        if self.source.padding is not None:
            image[self.source.is_padding(stored)] = np.nan
        return image

    def at(self, rows: IntArray, columns: IntArray) -> FloatArray:
        """Values (float64) at pixels given by index arrays; NaN beyond the border and in padding."""
        n_rows, n_columns = self.shape
        within = (
            rows.min(initial=0) >= 0
            and columns.min(initial=0) >= 0
            and rows.max(initial=0) < n_rows
            and columns.max(initial=0) < n_columns
        )
        flat = rows * n_columns + columns
        outside = None
        if not within:
            outside = (rows < 0) | (rows >= n_rows) | (columns < 0) | (columns >= n_columns)
            flat[outside] = 0
        stored = self.source.stored.ravel().take(flat)  # one flat index costs half of a pair
        values: FloatArray = stored * self.sign
        if abs(self.sign) != 1.0:
            values[~np.isfinite(values)] = np.nan
        padding = self.source.padding
        if padding is not None and stored.size and padding[1] >= stored.min() and padding[0] <= stored.max():
            values[self.source.is_padding(stored)] = np.nan
        if outside is not None:
            values[outside] = np.nan
        return values

    def windows(self, centres: IntArray, radius: int) -> FloatArray:
        """Square windows (k, n, n), n = 2 radius + 1, about integer pixels ``centres`` (k, 2) = (column, row)."""
        offset = np.arange(-radius, radius + 1)
        rows = centres[:, 1, None, None] + offset[:, None]
        columns = centres[:, 0, None, None] + offset[None, :]
        return self.at(rows, columns)


def _stretch(low: float, high: float) -> float:
    """Factor that takes a range to that of 16 bits; 1 where there is no range."""
    extent = high - low
    return FLOAT_STEPS / extent if 0.0 < extent < np.inf else 1.0


@cache
def grid(radius: int) -> tuple[FloatArray, FloatArray]:
    """Coordinates (u, v), each (n, n), of a window's pixels from its middle one, px."""
    offset = np.arange(-radius, radius + 1, dtype=np.float64)
    u, v = np.meshgrid(offset, offset)
    return frozen(u, u.shape), frozen(v, v.shape)


@cache
def disc(radius: int) -> IntArray:
    """Flat indices (p,) of the pixels of a window within its radius: its corners carry nothing but neighbours."""
    u, v = grid(radius)
    return frozen_index(np.flatnonzero(np.hypot(u, v) <= radius + 0.5))


@cache
def ring(radius: int) -> IntArray:
    """Flat indices (p,) of the outermost two pixels of that disc: where the background is seen."""
    u, v = grid(radius)
    r = np.hypot(u, v)
    return frozen_index(np.flatnonzero((r > radius - 2) & (r <= radius + 0.5)))


def nan_quantile(values: FloatArray, q: float) -> FloatArray:
    """Quantile over the last axis of (..., n), rounded to a sample, NaN ignored; NaN where nothing is left."""
    count = np.isfinite(values).sum(axis=-1)
    n = values.shape[-1]
    if (count == n).all():
        index = round(q * (n - 1))
        return np.asarray(np.partition(values, index, axis=-1)[..., index])
    index = np.rint(q * np.maximum(count - 1, 0)).astype(np.intp)
    ordered = np.sort(values, axis=-1)  # NaN go last
    return np.asarray(np.take_along_axis(ordered, index[..., None], axis=-1)[..., 0])


def dilated(mask: BoolArray) -> BoolArray:
    """Every window of ``mask`` (k, n, n) grown by its 8 neighbours."""
    rows = mask.copy()
    rows[:, 1:] |= mask[:, :-1]
    rows[:, :-1] |= mask[:, 1:]
    grown = rows.copy()
    grown[:, :, 1:] |= rows[:, :, :-1]
    grown[:, :, :-1] |= rows[:, :, 1:]
    return grown
