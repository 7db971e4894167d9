"""Local maxima of a slightly smoothed image, or of windows of it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctreg_cli.arrays import BoolArray, IntArray


def smoothed(image: NDArray[Any]) -> NDArray[Any]:
    """Binomial 3 × 3 mean over the last two axes; the outermost pixels stay as they are, NaN become the least value."""
    if np.isnan(image.min(initial=0)):
        image = np.where(np.isnan(image), np.nanmin(image, initial=np.inf), image)
    out = image.copy()
    rows = image[..., :-2, :] + image[..., 2:, :]
    rows += 2 * image[..., 1:-1, :]
    inner = rows[..., :-2] + rows[..., 2:]
    inner += 2 * rows[..., 1:-1]
    inner *= 1 / 16
    out[..., 1:-1, 1:-1] = inner
    return out


def ascents(flat: NDArray[Any], at: IntArray, columns: int) -> IntArray:
    """Those of the pixels ``at`` of a flattened image that are not lower than their 8 neighbours.

    Of a flat top only the first in reading order; none of ``at`` may lie on the border.
    """
    for step in (1, columns, columns + 1, columns - 1):
        at = at[(flat[at] > flat[at - step]) & (flat[at] >= flat[at + step])]
    return at


def local_maxima(smooth: NDArray[Any]) -> BoolArray:
    """Pixels not lower than their 8 neighbours (last two axes); of a flat top only the first in reading order."""
    inner = smooth[..., 1:-1, 1:-1]
    rows, columns = smooth.shape[-2:]
    highest = np.ones(inner.shape, dtype=bool)
    for dr, dc in ((0, 1), (1, 0), (1, 1), (1, -1)):
        highest &= inner > smooth[..., 1 - dr : rows - 1 - dr, 1 - dc : columns - 1 - dc]
        highest &= inner >= smooth[..., 1 + dr : rows - 1 + dr, 1 + dc : columns - 1 + dc]
    maxima = np.zeros(smooth.shape, dtype=bool)
    maxima[..., 1:-1, 1:-1] = highest
    return maxima
