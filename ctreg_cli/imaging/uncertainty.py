"""What can be wrong with the pixels about a spot, and what that makes of its centre.

Three things are measured: the sd of the noise, how far neighbours' noise goes together (smooth reconstruction
kernels), and structure of the background (streaks, plate edges). Noise and structure are stationary fields with
Gaussian correlations; seen through the fit, in the frequency domain, they make the covariance.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from ctreg_cli.arrays import BoolArray, FloatArray, frozen
from ctreg_cli.imaging.blob import Blobs
from ctreg_cli.imaging.window import disc, grid, nan_quantile, ring

#: correlation length of background structure, px: the width of streaks, which the same blur has made as the spots
STRUCTURE_LENGTH_PX = 2.0
#: share of the odd part of such structure about a spot that its fit leaves in the residuals (0.5 … 0.75 were computed)
KEPT = 0.65
#: sd of a normal distribution over its median absolute deviation
MAD_TO_SD = 1.4826
#: a scanner stores whole numbers: noise is never less than rounding, in stored units
ROUNDING_SD = float(1.0 / np.sqrt(12.0))
#: correlation lengths of noise that are told apart, px
NOISE_LENGTHS_PX = np.concatenate([[0.0], np.geomspace(0.3, 3.0, 24)])
#: shorter correlation than this is none, px
LEAST_LENGTH_PX = 0.03
#: sum of the squared weights of a Laplacian: 4² + 4 · 1²
_SQUARED_WEIGHTS = 20.0
#: a mirrored pixel lies at most so far beyond the window, px
_MARGIN = 2


def rough_noise(blobs: Blobs, quiet: BoolArray) -> FloatArray:
    """Sd (k,) of what differs from pixel to pixel, before any fit, by the Laplacian, which no gradient moves.

    ``quiet`` (k, p) says which pixels of the disc lie apart from any blob.
    """
    laplacian = _laplacian(blobs.values, 1).reshape(len(blobs), -1)[:, disc(blobs.radius)]
    return _noise_sd(laplacian, quiet)


def noise_field(residuals: FloatArray, quiet: BoolArray, radius: int) -> tuple[FloatArray, float]:
    """Sd (k,) of the noise about each spot, and its correlation length ℓ, px: exp(−d²/2ℓ²) at distance d.

    Seen through Laplacians of one and of two pixels: of white noise both show the same, of smooth noise the second
    shows more. The length is that of the scanner's kernel, so all windows tell it together.

    Args:
        residuals: (k, p), what a fit left, at the pixels of the disc.
        quiet: (k, p), where to look.
        radius: of the windows, px.
    """
    k, n, at = len(residuals), 2 * radius + 1, disc(radius)
    square = np.full((k, n * n), np.nan)
    square[:, at] = residuals
    windows = square.reshape(k, n, n)
    fine, coarse = (_noise_sd(_laplacian(windows, d).reshape(k, -1)[:, at], quiet) for d in (1, 2))
    fine_gain, coarse_gain = _laplacian_gains()
    length = float(np.interp(np.median(coarse / fine), coarse_gain / fine_gain, NOISE_LENGTHS_PX))
    return fine / np.interp(length, NOISE_LENGTHS_PX, fine_gain), length


def _laplacian(w: FloatArray, d: int) -> FloatArray:
    """Of windows (k, n, n), with neighbours at ``d`` px; NaN at the border; of white noise, its own sd."""
    laplacian = np.full(w.shape, np.nan)
    inner = laplacian[:, d:-d, d:-d]
    np.multiply(w[:, d:-d, d:-d], 4.0, out=inner)
    for neighbour in (w[:, : -2 * d, d:-d], w[:, 2 * d :, d:-d], w[:, d:-d, : -2 * d], w[:, d:-d, 2 * d :]):
        inner -= neighbour
    inner *= 1.0 / np.sqrt(_SQUARED_WEIGHTS)
    return laplacian


def _noise_sd(sample: FloatArray, quiet: BoolArray) -> FloatArray:
    median = nan_quantile(np.where(quiet, np.abs(sample), np.nan), 0.5)
    return np.asarray(np.maximum(MAD_TO_SD * np.nan_to_num(median), ROUNDING_SD))


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


def background_structure(blobs: Blobs, noise: FloatArray) -> FloatArray:
    """Sd (k,) of what the ring about the blob holds beyond noise, after its best plane is taken off."""
    values = blobs.values.reshape(len(blobs), -1)[:, ring(blobs.radius)]
    values = np.where(np.isnan(values), blobs.background[:, None], values)
    left = values - values @ _plane_projector(blobs.radius)
    spread = MAD_TO_SD * nan_quantile(np.abs(left), 0.5)
    return np.sqrt(np.maximum(spread**2 - noise**2, 0.0))


@cache
def _plane_projector(radius: int) -> FloatArray:
    """(p, p): values on the ring → the best plane through them, there."""
    u, v = (axis.ravel()[ring(radius)] for axis in grid(radius))
    plane = np.stack([np.ones(len(u)), u, v], axis=1)
    return frozen(plane @ np.linalg.pinv(plane), (len(u), len(u)))


def odd_variance(
    residuals: FloatArray, near: BoolArray, centre: FloatArray, radius: int, noise: FloatArray
) -> FloatArray:
    """Variance (k,) beyond noise of a field whose odd part about ``centre`` (2, k) is that of the residuals ``near`` it.

    Only what exceeds noise by its own standard error counts. A wrong shape of the profile leaves residuals that are
    even about the centre and do not move it; only odd ones do.
    """
    k, side = len(residuals), 2 * (radius + _MARGIN) + 1
    u, v = (axis.ravel()[disc(radius)] for axis in grid(radius))
    at = ((v + radius + _MARGIN) * side + u + radius + _MARGIN).astype(np.intp)
    square = np.full((k, side * side), np.nan)
    known = np.where(near, residuals, np.nan)
    square[:, at] = known
    twice = np.rint(np.clip(2.0 * np.nan_to_num(centre), -_MARGIN, _MARGIN)).astype(np.intp)
    mirror = (twice[1] * side + twice[0] + side * side - 1 + side * side * np.arange(k))[:, None] - at
    odd = known - square.ravel().take(mirror)
    paired = ~np.isnan(odd)
    pairs = np.maximum(0.5 * np.count_nonzero(paired, axis=1), 1.0)
    variance = 0.25 * np.where(paired, odd * odd, 0.0).sum(axis=1) / pairs
    return np.asarray(np.maximum(variance - noise**2 * (1.0 + np.sqrt(2.0 / pairs)), 0.0))


def centre_covariance(
    influence: FloatArray, radius: int, *, smooth: tuple[FloatArray, float], rough: FloatArray, structure: FloatArray
) -> FloatArray:
    """Covariance (k, 2, 2) of centres, by whichever tells more: smooth noise alone, or white noise and structure.

    Few pixels cannot tell a smooth kernel's noise from a streak; each of the two explains all that is seen.

    Args:
        influence: (2, k, p), derivatives of the centres with respect to the pixels of the windows' discs.
        radius: of the windows, px.
        smooth: sd (k,) of the noise as a smooth field, and its correlation length, px.
        rough: (k,) sd of what differs from pixel to pixel.
        structure: (k,) variance of background structure.
    """
    k, n = influence.shape[1], 2 * radius + 1
    square = np.zeros((2, k, n * n))
    square[:, :, disc(radius)] = influence
    waves = _waves(radius)
    spectrum = (waves @ square.reshape(2, k, n, n) @ waves.T).reshape(2, k, n * n).transpose(1, 0, 2)
    noise, length = smooth
    along, across = _power_along(length, radius), _structure_power(radius)
    power = np.stack([np.outer(along, along).ravel(), np.ones(n * n), np.outer(across, across).ravel()])
    of_smooth, of_white, of_structure = (spectrum * power[:, None, None]) @ spectrum.transpose(0, 2, 1)
    of_smooth *= (noise * noise)[:, None, None]
    of_white *= (rough * rough)[:, None, None]
    of_white += structure[:, None, None] * of_structure
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
