"""Where a spot could be: local maxima that stand out of the rings about them. Cheap and generous."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctreg_cli.arrays import BoolArray, FloatArray, IntArray
from ctreg_cli.imaging.blob import BACKGROUND_QUANTILE
from ctreg_cli.imaging.maxima import ascents
from ctreg_cli.imaging.window import UprightImage, nan_quantile

#: side of the blocks whose least value is the first, generous background, px
BLOCK_PX = 16
#: step in which large things are looked for, px
COARSE_PX = 4
#: samples on each ring, and each ring's radius over the last one's
RING_SAMPLES, RING_RATIO = 16, 1.3
#: an image whose pixels differ from their neighbours in no more than this share shows no noise
LEAST_NOISY = 0.02


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Peaks:
    """``k`` local maxima."""

    #: (k, 2) (column, row)
    pixels: IntArray
    #: (k,) smoothed peak above its surroundings, stored units
    contrast: FloatArray
    #: (k,) radius at which the surroundings fall to half of it, px; infinite where they never do
    half_width: FloatArray

    def take(self, which: BoolArray | IntArray) -> Peaks:
        """Some of the peaks."""
        return Peaks(pixels=self.pixels[which], contrast=self.contrast[which], half_width=self.half_width[which])


def image_noise(image: NDArray[Any]) -> float:
    """Sd of the pixel noise of an image by the median Laplacian of every eighth row; flat (clipped) air is left out.

    Where nearly all is flat there is no noise to be seen: what is not are the edges of a mask.
    """
    inner = image[1:-1:8, 1:-1]
    laplacian = 4 * inner - image[:-2:8, 1:-1] - image[2::8, 1:-1] - image[1:-1:8, :-2] - image[1:-1:8, 2:]
    size = np.abs(laplacian[np.isfinite(laplacian) & (laplacian != 0)])
    if size.size <= LEAST_NOISY * laplacian.size:
        return 0.0
    return float(1.4826 * np.median(size) / np.sqrt(20.0))


def maxima_above(smooth: NDArray[Any], margin: float) -> tuple[IntArray, IntArray]:
    """Rows and columns of local maxima that stand more than ``margin`` above the least value of their block."""
    rows, columns = smooth.shape
    pad = (-rows % BLOCK_PX, -columns % BLOCK_PX)
    padded = np.pad(smooth, ((0, pad[0]), (0, pad[1])), mode="edge") if any(pad) else smooth
    blocks = padded.reshape(padded.shape[0] // BLOCK_PX, BLOCK_PX, padded.shape[1] // BLOCK_PX, BLOCK_PX)
    limit = blocks.min(axis=1).min(axis=2) + smooth.dtype.type(margin)
    above = (blocks > limit[:, None, :, None]).reshape(padded.shape)[:rows, :columns]
    above[[0, -1]] = above[:, [0, -1]] = False
    return np.divmod(ascents(smooth.ravel(), np.flatnonzero(above), columns), columns)


def rate_peaks(image: UprightImage, pixels: IntArray, heights: FloatArray, max_half_width: float) -> Peaks:
    """Contrast and half width of peaks ``pixels`` (k, 2) of smoothed values ``heights`` (k,), from rings about them.

    On each ring the 75th percentile counts: a plate, a streak or a long spot crosses a smaller part of it, while an
    edge or the inside of something large fills it. The background is the darkest ring. Peaks that are cut off lie on
    the edge of their flat tops, and are moved to the middle first.
    """
    flat = np.flatnonzero(heights >= image.ceiling)
    if len(flat):
        pixels = pixels.copy()
        pixels[flat] = _middles_of_tops(image, pixels[flat], int(np.ceil(2.0 * max_half_width)))
    steps = np.arange(np.ceil(np.log(max_half_width + 3.0) / np.log(RING_RATIO)) + 1)
    radii = np.unique(np.rint(RING_RATIO**steps))
    angles = 2 * np.pi * np.arange(RING_SAMPLES) / RING_SAMPLES
    columns = np.rint(radii[:, None] * np.cos(angles)).astype(np.intp)
    rows = np.rint(radii[:, None] * np.sin(angles)).astype(np.intp)
    samples = image.at(pixels[:, 1, None, None] + rows, pixels[:, 0, None, None] + columns)
    rings = nan_quantile(samples, BACKGROUND_QUANTILE)
    rings = np.where(np.isnan(rings), heights[:, None], rings)
    with np.errstate(invalid="ignore"):  # a place may show nothing of the image
        contrast = heights - rings.min(axis=1)
        fallen = rings < (heights - 0.5 * contrast)[:, None]
    half_width = np.where(fallen.any(axis=1), radii[fallen.argmax(axis=1)], np.inf)
    return Peaks(pixels=pixels, contrast=contrast, half_width=half_width)


def _middles_of_tops(image: UprightImage, pixels: IntArray, reach: int) -> IntArray:
    """Pixels (k, 2) in the middle of flat tops, whose first ones in reading order are given; ``reach`` px at most."""
    ahead = np.arange(1, reach + 1)

    def run(du: int, dv: int) -> IntArray:
        top = image.at(rows[:, None] + dv * ahead, columns[:, None] + du * ahead) >= image.ceiling
        return np.asarray(np.where(top.all(axis=1), reach, top.argmin(axis=1)))

    columns, rows = pixels.T
    rows = rows + run(0, 1) // 2
    columns = columns + (run(1, 0) - run(-1, 0)) // 2
    return np.stack([columns, rows], axis=1)


def large_regions(smooth: NDArray[Any], level: float, least_px: float) -> FloatArray:
    """Boxes (m, 4) = (u, v from, u, v to) of bright regions wider and higher than ``least_px``, on a coarse grid."""
    from skimage import measure

    find: Any = measure  # it comes without types
    regions = find.regionprops(find.label(smooth[::COARSE_PX, ::COARSE_PX] > level, connectivity=1))
    boxes = np.array([region.bbox for region in regions], dtype=np.intp).reshape(-1, 4)  # rows and columns, half open
    first, last = boxes[:, 1::-1], boxes[:, :1:-1] - 1
    is_large = (last - first + 1).min(axis=1) * COARSE_PX > least_px
    return np.asarray(COARSE_PX * np.hstack([first, last])[is_large], dtype=np.float64)
