"""Square windows of a slice, as the fits want them: stored units, spots upright, padding as NaN.

Nothing here touches the whole image except one search for its largest value: the tracking path looks at a few hundred
pixels of a quarter of a million.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctreg_cli.arrays import BoolArray, FloatArray, IntArray
from ctreg_cli.imaging.slice import Slice


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class UprightImage:
    """A slice seen so that its spots are bright: stored values times ``sign``; what is not image is NaN."""

    source: Slice
    #: +1 when spots are brighter than what surrounds them, −1 when darker
    sign: float
    #: the largest upright value of the image; pixels that hold it may be cut off (3071 HU, 255 in a PNG)
    ceiling: float

    @classmethod
    def of(cls, slice_: Slice, *, bright: bool) -> UprightImage:
        """View ``slice_`` with spots upright; a negative rescale slope turns the stored values over once more."""
        sign = float(np.sign(slice_.slope)) * (1.0 if bright else -1.0)
        stored = slice_.stored
        if slice_.padding is not None:
            valid = stored[~slice_.is_padding(stored)]
        else:
            valid = stored.ravel() if np.issubdtype(stored.dtype, np.integer) else stored[np.isfinite(stored)]
        ceiling = float(valid.max() if sign > 0 else valid.min()) * sign if valid.size else -np.inf
        return cls(source=slice_, sign=sign, ceiling=ceiling)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        rows, columns = self.source.stored.shape
        return int(rows), int(columns)

    @property
    def unit(self) -> float:
        """The image's own units (HU) in one stored unit, always positive."""
        return abs(self.source.slope)

    def dense(self) -> NDArray[Any]:
        """The whole image, float32 where that holds the stored values exactly; NaN outside the image."""
        stored = self.source.stored
        exact = np.issubdtype(stored.dtype, np.integer) and stored.dtype.itemsize <= 2
        image = stored.astype(np.float32 if exact else np.float64)
        if self.sign < 0:
            np.negative(image, out=image)
        if self.source.padding is not None:
            image[self.source.is_padding(stored)] = np.nan
        return image

    def at(self, rows: IntArray, columns: IntArray) -> FloatArray:
        """Values (float64) at pixels given by index arrays of one shape; NaN beyond the border and in padding."""
        n_rows, n_columns = self.shape
        outside = (rows < 0) | (rows >= n_rows) | (columns < 0) | (columns >= n_columns)
        off_image = bool(outside.any())
        if off_image:
            rows, columns = np.where(outside, 0, rows), np.where(outside, 0, columns)
        stored = self.source.stored[rows, columns]
        values = stored.astype(np.float64) * self.sign
        if self.source.padding is not None:
            values[self.source.is_padding(stored)] = np.nan
        if off_image:
            values[outside] = np.nan
        return values

    def windows(self, centres: IntArray, radius: int) -> FloatArray:
        """Square windows (k, n, n), n = 2 radius + 1, about integer pixels ``centres`` (k, 2) = (column, row)."""
        offset = np.arange(-radius, radius + 1)
        rows = centres[:, 1, None, None] + offset[:, None]
        columns = centres[:, 0, None, None] + offset[None, :]
        return self.at(*np.broadcast_arrays(rows, columns))


def grid(radius: int) -> tuple[FloatArray, FloatArray]:
    """Coordinates (u, v), each (n, n), of a window's pixels from its middle one, px."""
    offset = np.arange(-radius, radius + 1, dtype=np.float64)
    u, v = np.meshgrid(offset, offset)
    return u, v


def nan_quantile(values: FloatArray, q: float) -> FloatArray:
    """Quantile (k,) over the last axis of (k, n), NaN ignored; NaN where nothing is left (rounded to a sample)."""
    ordered = np.sort(values, axis=-1)  # NaN go last
    count = np.isfinite(ordered).sum(axis=-1)
    index = np.rint(q * np.maximum(count - 1, 0)).astype(np.intp)
    result: FloatArray = np.take_along_axis(ordered, index[..., None], axis=-1)[..., 0]
    return result


def ring(radius: int) -> BoolArray:
    """The outermost two pixels (n, n) of the disc in a window: where the background is seen."""
    u, v = grid(radius)
    r = np.hypot(u, v)
    inside: BoolArray = (r > radius - 2) & (r <= radius + 0.5)
    return inside


def dilated(mask: BoolArray) -> BoolArray:
    """Every window of ``mask`` (k, n, n) grown by its 8 neighbours."""
    rows = mask.copy()
    rows[:, 1:] |= mask[:, :-1]
    rows[:, :-1] |= mask[:, 1:]
    grown = rows.copy()
    grown[:, :, 1:] |= rows[:, :, :-1]
    grown[:, :, :-1] |= rows[:, :, 1:]
    return grown
