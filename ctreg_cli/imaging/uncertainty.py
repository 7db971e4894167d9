"""What can be wrong with the pixels about a spot, and what that makes of its centre.

Three things are measured: the sd of the noise, how far neighbours' noise goes together (smooth reconstruction
kernels), and structure of the background (streaks, plate edges). Noise and structure are stationary fields with
Gaussian correlations; seen through the fit, in the frequency domain, they make the covariance.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from ctreg_cli.arrays import BoolArray, FloatArray, IntArray, frozen, frozen_index
from ctreg_cli.imaging.blob import Blobs
from ctreg_cli.imaging.window import disc, grid, nan_quantile, ring

#: correlation length of background structure, px: the width of streaks, which the same blur has made as the spots
STRUCTURE_LENGTH_PX = 2.0
#: share of the odd part of such structure about a spot that its fit leaves in the residuals (0.5 … 0.75 were computed)
KEPT = 0.65
#: where surroundings are cut off below, the spot's own pixels are looked at too, of which the fit leaves less; and how
#: many of the pairs it takes
KEPT_ABOVE_FLOOR, FITTED_ODD = 0.3, 2.0
#: surroundings of which more than this share hold the least value may hide structure
HIDING_SHARE = 0.05
#: in standard errors, what noise about a spot may look like by chance
SURE_OF_STRUCTURE, NEARLY_SURE_OF_STRUCTURE = 3.0, 2.0
#: sd of a normal distribution over its median absolute deviation
MAD_TO_SD = 1.4826
#: standard error of a ratio of two variances by medians, over that of one by the mean of squares
MEDIAN_LOSS = 2.33
#: a scanner stores whole numbers: noise is never less than rounding, in stored units
ROUNDING_SD = float(1.0 / np.sqrt(12.0))
#: what the ring holds counts as structure only beyond so many times the variance that its noise may seem to have
RING_NOISE = 1.3
#: surroundings of which a larger share holds their least value are cut off there
FLOOR_SHARE = 1 / 3
#: parameters of a profile that the pixels of a spot above the floor determine; what they show of noise is taken so many
#: times, since neighbours may share it; and in spot heights the most that it is taken to be
FITTED, FLOOR_SHARED, MOST_AT_FLOOR = 8, 1.5, 0.1
#: noise is looked at in at most so many pixels of a window
NOISE_SAMPLES = 256
#: correlation lengths of noise that are told apart, px
NOISE_LENGTHS_PX = np.concatenate([[0.0], np.geomspace(0.3, 3.0, 24)])
#: shorter correlation than this is none, px
LEAST_LENGTH_PX = 0.03
#: sum of the squared weights of a Laplacian: 4² + 4 · 1²
_SQUARED_WEIGHTS = 20.0
#: a mirrored pixel lies at most so far beyond the window, px
_MARGIN = 3


def ring_spread(blobs: Blobs) -> tuple[FloatArray, FloatArray]:
    """Sd (k,) of the noise on the ring about each blob, and sd (k,) of what the ring holds beyond it.

    Noise differs from pixel to pixel: it is seen by the Laplacian, which no gradient moves; structure is what is left
    when the ring's best plane is taken off.
    """
    k, at = len(blobs), ring(blobs.radius)
    values = blobs.values.reshape(k, -1)
    nothing = np.isnan(values)
    if nothing.any():
        values = np.where(nothing, blobs.background[:, None], values)
    seen = np.abs((values - blobs.background[:, None]) @ _ring_filters(blobs.radius))
    noise, spread = MAD_TO_SD * nan_quantile(seen.reshape(k, 2, len(at)), 0.5).T
    noise = np.maximum(noise, ROUNDING_SD)
    return noise, np.sqrt(np.maximum(spread**2 - RING_NOISE * noise**2, 0.0))


@cache
def _ring_filters(radius: int) -> FloatArray:
    """(n², 2p): a window → the Laplacian on the inner ring and what the best plane leaves on the outer ring."""
    n, at = 2 * radius + 1, ring(radius)
    u, v = (axis.ravel() for axis in grid(radius))
    inside = np.maximum(np.abs(u), np.abs(v)) < radius
    inner = np.flatnonzero(inside)[np.argsort(-np.hypot(u, v)[inside], kind="stable")][: len(at)]
    laplacian = np.zeros((len(at), n * n))
    _fill_laplacian(laplacian, inner, [inner + step for step in (-1, 1, -n, n)])
    plane = np.stack([np.ones(len(at)), u[at], v[at]], axis=1)
    flat = np.zeros((n * n, len(at)))
    flat[at] = np.eye(len(at)) - plane @ np.linalg.pinv(plane)
    return frozen(np.hstack([laplacian.T, flat]), (n * n, 2 * len(at)))


def noise_field(residuals: FloatArray, quiet: BoolArray, radius: int) -> tuple[FloatArray, FloatArray, float]:
    """What a fit left, as noise: what of it differs from pixel to pixel, and what neighbours share.

    Seen through Laplacians of one and of two pixels: of white noise both show the same, of smooth noise the second
    shows more. The correlation length is that of the scanner's kernel, so all windows tell it together.

    Args:
        residuals: (k, p), at the pixels of the disc.
        quiet: (k, p), where to look.
        radius: of the windows, px.

    Returns:
        Sd (k,) of the noise if it is white; if it is correlated as exp(−d²/2ℓ²) over the distance d; and ℓ, px.
    """
    k, (at, filters) = len(residuals), _noise_filters(radius)
    known = quiet[:, at][:, None]
    sample = np.where(known, np.abs(residuals @ filters).reshape(k, 2, len(at)), np.inf)
    sample.sort(axis=-1)
    count = np.count_nonzero(known, axis=-1)
    median = sample[np.arange(k), :, np.maximum(count[:, 0] - 1, 0) // 2]
    fine, coarse = np.maximum(MAD_TO_SD * np.where(count > 0, median, 0.0), ROUNDING_SD).T
    fine_gain, coarse_gain = _laplacian_gains()
    length = float(np.interp(np.sort(coarse / fine)[(k - 1) // 2], coarse_gain / fine_gain, NOISE_LENGTHS_PX))
    return fine, fine / np.interp(length, NOISE_LENGTHS_PX, fine_gain), length


def at_floor(values: FloatArray, quiet: BoolArray) -> BoolArray:
    """Which pixels (k, p) hold no more than the least of what is ``quiet`` (k, p) about them: the floor, perhaps."""
    return np.asarray(values <= np.where(quiet, values, np.inf).min(axis=1, keepdims=True))


def noise_at_floor(residuals: FloatArray, values: FloatArray, quiet: BoolArray, height: FloatArray) -> FloatArray:
    """Sd (k,) of the noise of spots whose surroundings are cut off below; 0 where they are not.

    Air at the least value that an image can hold (−1024 HU, 0 in a PNG) shows no noise, the spot has it all the same.
    It is then what the fit left in the pixels above; neighbours share some of it, unseen.

    Args:
        residuals: (k, p), at the pixels of the disc.
        values: (k, p) of the pixels.
        quiet: (k, p), where noise would be looked for.
        height: (k,) of the spots.
    """
    low = at_floor(values, quiet)
    cut = np.count_nonzero(low & quiet, axis=1) > FLOOR_SHARE * np.count_nonzero(quiet, axis=1)
    result = np.zeros(len(values))
    for k in np.flatnonzero(cut):
        above = residuals[k, ~low[k]]
        free = len(above) - FITTED
        seen = FLOOR_SHARED * float(np.sqrt((above**2).sum() / free)) if free > 0 else np.inf
        result[k] = min(seen, MOST_AT_FLOOR * height[k])
    return result


@cache
def _noise_filters(radius: int) -> tuple[IntArray, FloatArray]:
    """Pixels (m,) of the disc, outermost first, and (p, 2m): residuals on the disc → their Laplacians of 1 and 2 px."""
    n, at = 2 * radius + 1, disc(radius)
    u, v = (axis.ravel()[at] for axis in grid(radius))
    long, short = np.maximum(np.abs(u), np.abs(v)), np.minimum(np.abs(u), np.abs(v))
    fits = np.flatnonzero(np.hypot(long + 2.0, short) <= radius + 0.5)
    pixels = fits[np.argsort(-np.hypot(u, v)[fits], kind="stable")][:NOISE_SAMPLES]
    place = np.full(n * n, -1)
    place[at] = np.arange(len(at))
    filters = np.zeros((2, len(pixels), len(at)))
    for laplacian, d in zip(filters, (1, 2), strict=True):
        _fill_laplacian(laplacian, pixels, [place[at[pixels] + step] for step in (-d, d, -d * n, d * n)])
    return frozen_index(pixels), frozen(filters.reshape(-1, len(at)).T, (len(at), 2 * len(pixels)))


def _fill_laplacian(rows: FloatArray, middle: IntArray, neighbours: list[IntArray]) -> None:
    """Laplacians (m, p) at the pixels ``middle``; of white noise they show its own sd."""
    each = np.arange(len(middle))
    rows[each, middle] = 4.0 / np.sqrt(_SQUARED_WEIGHTS)
    for neighbour in neighbours:
        rows[each, neighbour] = -1.0 / np.sqrt(_SQUARED_WEIGHTS)


@cache
def _laplacian_gains() -> tuple[FloatArray, FloatArray]:
    """Sd of the Laplacians of one and of two pixels, of noise of sd 1 and the lengths ``NOISE_LENGTHS_PX``."""

    def gain(d: int) -> FloatArray:
        def rho(squared: int) -> FloatArray:
            with np.errstate(divide="ignore"):
                return np.exp(-0.5 * squared * (d / NOISE_LENGTHS_PX) ** 2)

        variance = _SQUARED_WEIGHTS - 32.0 * rho(1) + 8.0 * rho(2) + 4.0 * rho(4)
        return np.asarray(np.sqrt(variance / _SQUARED_WEIGHTS))

    return gain(1), gain(2)


def odd_variance(
    residuals: FloatArray, near: BoolArray, centre: FloatArray, radius: int, noise: FloatArray
) -> FloatArray:
    """Variance (k,) beyond noise of a field whose odd part about ``centre`` (2, k) is that of the residuals ``near``.

    What noise may look like by chance does not count: nothing up to three times its standard error, all of what is far
    beyond. A wrong shape of the profile leaves residuals that are even about the centre and do not move it; only odd
    ones do.
    """
    return _beyond_noise(*_odd_squares(residuals, near, centre, radius), noise, SURE_OF_STRUCTURE)


def odd_variance_above_floor(
    residuals: FloatArray, shown: BoolArray, centre: FloatArray, radius: int, noise: FloatArray
) -> FloatArray:
    """The same where surroundings are cut off below, by what is ``shown`` (k, p) of them and of the spot itself.

    Of a dark streak in air nothing is seen but where it crosses the spot. There the fit takes two of the few pairs, and
    chance is not easily told from structure: less is asked of it.
    """
    squares, pairs = _odd_squares(residuals, shown, centre, radius)
    return _beyond_noise(squares, pairs - FITTED_ODD, noise, NEARLY_SURE_OF_STRUCTURE)


def _odd_squares(
    residuals: FloatArray, where: BoolArray, centre: FloatArray, radius: int
) -> tuple[FloatArray, FloatArray]:
    """Sum of squares (k,) of the part of residuals that is odd about ``centre`` (2, k); and of how many pairs."""
    k, p = residuals.shape
    known = np.empty((k, p + 1))
    known.fill(np.nan)
    np.copyto(known[:, :p], residuals, where=where)
    twice = np.rint(np.fmax(np.fmin(2.0 * centre, _MARGIN), -_MARGIN)) + _MARGIN
    opposite = _opposite(radius).take((twice[1] * (2 * _MARGIN + 1) + twice[0]).astype(np.intp), axis=0)
    opposite += (p + 1) * np.arange(k)[:, None]
    odd = known[:, :p] - known.take(opposite)
    paired = odd == odd  # neither is NaN
    odd *= odd
    return 0.25 * np.fmax(odd, 0.0).sum(axis=1), 0.5 * paired.sum(axis=1)  # fmax passes NaN over


def _beyond_noise(squares: FloatArray, count: FloatArray, noise: FloatArray, sure: float) -> FloatArray:
    """Variance (k,) beyond noise of sums of ``count`` squares; ``sure``: standard errors that are taken for chance."""
    count = np.maximum(count, 1.0)
    excess = squares / count / noise**2 - 1.0
    return np.asarray(noise**2 * excess * _beyond_chance(excess, sure * np.sqrt(2.0 / count)))


def even_variance(residuals: FloatArray, quiet: BoolArray, *, smooth: FloatArray, rough: FloatArray) -> FloatArray:
    """Variance (k,) beyond ``rough`` noise of what lies evenly all over a window, where ``smooth`` noise is less.

    By the median, which a streak through a part of the window does not move; chance as in :func:`odd_variance`.
    """
    squares = np.where(quiet, residuals * residuals, np.nan)
    count = np.maximum(np.count_nonzero(quiet, axis=1), 1)
    variance = MAD_TO_SD**2 * np.nan_to_num(nan_quantile(squares, 0.5))
    excess = variance / smooth**2 - 1.0
    chance = SURE_OF_STRUCTURE * MEDIAN_LOSS * np.sqrt(2.0 / count)
    return (variance - rough**2) * _beyond_chance(excess, chance)


def _beyond_chance(excess: FloatArray, chance: FloatArray) -> FloatArray:
    """What share (k,) of an excess counts: nothing up to what ``chance`` makes, all of what is far beyond."""
    return np.asarray(np.maximum(1.0 - (chance / np.maximum(excess, chance)) ** 2, 0.0))


@cache
def _opposite(radius: int) -> IntArray:
    """(n², p): the pixel of the disc opposite each, by twice the row and column of the middle between them.

    The least of these is ``-_MARGIN``; where there is no such pixel, ``p`` stands, which is beyond the last.
    """
    u, v = (axis.ravel()[disc(radius)].astype(int).tolist() for axis in grid(radius))
    place = {pixel: i for i, pixel in enumerate(zip(u, v, strict=True))}
    steps = range(-_MARGIN, _MARGIN + 1)
    table = [[place.get((du - x, dv - y), len(u)) for x, y in place] for dv in steps for du in steps]
    return frozen_index(table).reshape(len(table), len(u))


def responses(influence: FloatArray, radius: int, length: float) -> FloatArray:
    """Covariances (3, k, 2, 2) of centres that fields of variance 1 make: smooth noise, white noise, and structure.

    Args:
        influence: (2, k, p), derivatives of the centres with respect to the pixels of the windows' discs.
        radius: of the windows, px.
        length: of the smooth noise's correlation, px.
    """
    k, n = influence.shape[1], 2 * radius + 1
    square = np.zeros((2, k, n * n))
    square[:, :, disc(radius)] = influence
    waves = _waves(radius).T
    half = (square.reshape(-1, n) @ waves).reshape(2 * k, n, n).transpose(0, 2, 1)  # two large products beat 4 k small
    spectrum = (half.reshape(-1, n) @ waves).reshape(2, k, n * n).transpose(1, 0, 2)
    along, across = _power_along(length, radius), _structure_power(radius)
    power = np.stack([np.outer(along, along).ravel(), np.ones(n * n), np.outer(across, across).ravel()])
    return np.asarray((spectrum * power[:, None, None]) @ spectrum.transpose(0, 2, 1))


def centre_covariance(
    response: FloatArray, *, smooth: FloatArray, rough: FloatArray, structure: FloatArray
) -> FloatArray:
    """Covariance (k, 2, 2) of centres, by whichever tells more: smooth noise alone, or white noise and structure.

    Few pixels cannot tell a smooth kernel's noise from a streak; each of the two explains all that is seen.

    Args:
        response: (3, k, 2, 2), see :func:`responses`.
        smooth: sd (k,) of the noise as a smooth field.
        rough: (k,) sd of what differs from pixel to pixel.
        structure: (k,) variance of background structure.
    """
    of_smooth = (smooth * smooth)[:, None, None] * response[0]
    of_white = (rough * rough)[:, None, None] * response[1]
    of_white += structure[:, None, None] * response[2]
    more = of_smooth[:, 0, 0] + of_smooth[:, 1, 1] > of_white[:, 0, 0] + of_white[:, 1, 1]
    return np.asarray(np.where(more[:, None, None], of_smooth, of_white))


@cache
def _waves(radius: int) -> FloatArray:
    """(n, n): orthonormal cosines and sines along one axis of a window, by rising frequency."""
    n = 2 * radius + 1
    phase = 2.0 * np.pi * np.outer(np.arange(1, radius + 1), np.arange(n)) / n
    waves = np.empty((n, n))
    waves[0] = np.sqrt(1.0 / n)
    waves[1::2], waves[2::2] = np.sqrt(2.0 / n) * np.cos(phase), np.sqrt(2.0 / n) * np.sin(phase)
    return frozen(waves, (n, n))


def _power_along(length: float, radius: int) -> FloatArray:
    """(n,): power, at the frequencies of :func:`_waves`, of a field of variance 1 and ``length`` of correlation, px."""
    step = np.arange(radius + 1)
    correlation = np.exp(-0.5 * (step / max(length, LEAST_LENGTH_PX)) ** 2)
    return np.asarray(correlation @ _cosines(radius))


@cache
def _structure_power(radius: int) -> FloatArray:
    """(n,): the same of background structure."""
    return frozen(_power_along(STRUCTURE_LENGTH_PX, radius), (2 * radius + 1,))


@cache
def _cosines(radius: int) -> FloatArray:
    """(radius + 1, n): a correlation over distances → its power at the frequencies of :func:`_waves`."""
    n = 2 * radius + 1
    frequency = (np.arange(n) + 1) // 2
    cosines = 2.0 * np.cos(2.0 * np.pi * np.outer(np.arange(radius + 1), frequency) / n)
    cosines[0] = 1.0
    return frozen(cosines, cosines.shape)
