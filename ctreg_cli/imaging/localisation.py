"""Centres of spots at the statistical bound, with covariances that own up to streaks.

The profile of :mod:`ctreg_cli.imaging.profile` is fitted to all windows at once by Levenberg–Marquardt. Pixels are
weighted by what can be wrong with them: noise everywhere, and structure of the background (streaks, plate edges) that
grows with the distance from the blob. The covariance has the same two parts: the noise seen through the estimator, and
the structure *left over* around the blob seen through it as a correlated field. Both are measured in the window.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from ctreg_cli.arrays import BoolArray, FloatArray, IntArray, frozen
from ctreg_cli.imaging.blob import Blobs
from ctreg_cli.imaging.profile import BACKGROUND, CENTRE, LOG_BETA, LOG_HEIGHT, N_PARAMETERS, SHAPE, evaluate
from ctreg_cli.imaging.window import dilated, disc, grid, nan_quantile, ring

#: steps of the fit at most; a centre that moves by less than this (px) is done, whatever the others do
ITERATIONS, DONE_PX = 5, 2e-4
#: background structure is correlated over about 3 × 3 px: nine pixels count as one, so its sd counts three times
STRUCTURE_WEIGHT = 3.0
#: correlation length of background structure, px: the width of streaks, which the same blur has made as the spots
STRUCTURE_LENGTH_PX = 2.0
#: how far beyond the blob's edge the structure that disturbs it is looked at, and from where on the pixel noise, px
NEAR_PX, NOISE_BEYOND_PX = (1.0, 4.0), 2.0
#: another blob that begins within this of the edge touches the spot: it is left out of the fit, not of the covariance
TOUCHING_PX = 2.0
#: this many pixels at the image's ceiling inside one blob mean that it was cut off there
MIN_CLIPPED_PX = 3
#: parameters that are odd about the centre (centre, gradient), and the least share of odd structure they can leave
ODD, LEAST_KEPT = [0, 1, 4, 5], 0.2
#: what pixels cost a perfect fit: an edge sharper than a pixel shifts the profile by so much, px
MODEL_SD_PX = 0.005
#: added to a blob's second moments to start from: the region of a sharp spot is one pixel, the spot is wider, px²
START_BLUR_PX2 = 0.1
#: start of ln β, between a Gaussian and a flat top, and its range: from tails heavier than a Gaussian's to nearly a box
START_LOG_BETA, LOG_BETA_RANGE = 0.15, (-0.5, 1.5)
#: inverse variances (10,) of the parameters about their start: the shape is known within a factor of two; a trace of
#: certainty about the rest keeps the matrix regular where a window is all padding
PRIOR = np.array([1e-9] * 2 + [0.7**-2] + [1e-9] * 3 + [0.7**-2] * 3 + [0.5**-2])
#: farthest from the start (10,): px for the centre, a factor of eight for height and shape
MAX_CHANGE = np.array([2.0] * 2 + [2.0] + [np.inf] * 3 + [2.0] * 4)
#: Levenberg–Marquardt damping
FIRST_DAMPING, DAMPING_FACTOR = 1e-3, 10.0
#: bounds for the first guess of a clipped spot's true height: of the share that is flat, and of log2 (true / seen)
MAX_FLAT_SHARE, MIN_LOG2_OVER = 0.7, 0.1
#: sd of a normal distribution over its median absolute deviation
MAD_TO_SD = 1.4826
#: a scanner stores whole numbers: noise is never less than rounding, in stored units
ROUNDING_SD = float(1.0 / np.sqrt(12.0))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Centres:
    """Fitted centres of ``k`` blobs, image coordinates."""

    #: (k, 2) px
    uv_px: FloatArray
    #: (k, 2, 2) px²
    covariance_px: FloatArray
    #: (k,) sd of the pixel noise about each blob, stored units
    noise: FloatArray


def fit_centres(blobs: Blobs, ceiling: float) -> Centres:
    """Fit the profile to every blob.

    Where a fit runs away (more than the blob's own size from its centre of gravity), the centre of gravity is returned
    with a covariance of the blob's size: known badly, and said so.

    Args:
        blobs: windows of one radius.
        ceiling: value at which the image is cut off; pixels of that value are taken as "at least so bright".
    """
    k = len(blobs)
    at = disc(blobs.radius)
    u, v = (axis.ravel()[at] for axis in grid(blobs.radius))
    values = blobs.values.reshape(k, -1)[:, at]
    missing = np.isnan(values)
    values = np.where(missing, blobs.background[:, None], values)
    clipped = values >= ceiling
    own = blobs.own.reshape(k, -1)[:, at]
    clipped &= ((clipped & own).sum(axis=1) >= MIN_CLIPPED_PX)[:, None]
    distance = _distance_beyond_edge(blobs, u, v)
    foreign = dilated(blobs.foreign).reshape(k, -1)[:, at]
    usable = ~missing & ~foreign
    noise = _pixel_noise(blobs, usable & (distance > NOISE_BEYOND_PX))
    structure = _background_structure(blobs, noise)
    reach = np.maximum(blobs.radius - np.sqrt(blobs.area / np.pi), 1.0)
    spread = STRUCTURE_WEIGHT * structure[:, None] * distance / reach[:, None]
    weights = usable / (noise[:, None] ** 2 + spread**2)

    start = _start(blobs, (clipped & own).sum(axis=1))
    parameters, residuals, jacobian, normal = _levenberg_marquardt(start, u, v, values, clipped, weights)

    influence = np.linalg.inv(normal)[:, ODD] @ (jacobian * weights[:, None])  # (k, 4, p): d parameter / d pixel
    centre = parameters[:, CENTRE]
    near = usable & (distance > NEAR_PX[0]) & (distance < NEAR_PX[1])
    near |= foreign & ~missing & (distance < TOUCHING_PX)
    odd_variance = _odd_variance(residuals, near, centre, blobs.radius, noise)
    seen, kept = _through_fit(influence, jacobian[:, ODD], near, blobs.radius)
    covariance = _seen_noise(influence[:, CENTRE], noise) + (odd_variance / kept)[:, None, None] * seen
    covariance += MODEL_SD_PX**2 * np.eye(2)
    away = ((centre - blobs.centre) ** 2).sum(axis=1)
    size = np.trace(blobs.moments, axis1=1, axis2=2)
    lost = ~(np.isfinite(centre).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2)) & (away <= size))
    centre = np.where(lost[:, None], blobs.centre, centre)
    covariance = np.where(lost[:, None, None], blobs.moments, covariance)
    return Centres(uv_px=blobs.middles + centre, covariance_px=covariance, noise=noise)


def _distance_beyond_edge(blobs: Blobs, u: FloatArray, v: FloatArray) -> FloatArray:
    """Distance (k, p) of pixels outside the ellipse of the blob's half-height moments, px; 0 inside."""
    x, y = u - blobs.centre[:, 0, None], v - blobs.centre[:, 1, None]
    metric = np.linalg.inv(4.0 * blobs.moments)  # a uniform ellipse has moments of a quarter of its semi-axes squared
    radius = np.sqrt(metric[:, 0, 0, None] * x * x + 2 * metric[:, 0, 1, None] * x * y + metric[:, 1, 1, None] * y * y)
    return np.asarray(np.hypot(x, y) * np.maximum(0.0, 1.0 - 1.0 / np.maximum(radius, 1e-9)))


def _pixel_noise(blobs: Blobs, quiet: BoolArray) -> FloatArray:
    """Sd (k,) of the noise that differs from pixel to pixel: by the Laplacian, which no gradient or wide streak moves.

    ``quiet`` (k, p) says which pixels of the disc lie apart from any blob.
    """
    w = blobs.values
    laplacian = np.full(w.shape, np.nan)
    laplacian[:, 1:-1, 1:-1] = (
        4 * w[:, 1:-1, 1:-1] - w[:, :-2, 1:-1] - w[:, 2:, 1:-1] - w[:, 1:-1, :-2] - w[:, 1:-1, 2:]
    )
    sample = np.where(quiet, np.abs(laplacian.reshape(len(w), -1)[:, disc(blobs.radius)]), np.nan)
    sd = MAD_TO_SD * nan_quantile(sample, 0.5) / np.sqrt(20.0)  # 4² + 4 · 1² = 20
    return np.asarray(np.maximum(np.nan_to_num(sd), ROUNDING_SD))


def _background_structure(blobs: Blobs, noise: FloatArray) -> FloatArray:
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


def _start(blobs: Blobs, n_clipped: IntArray) -> FloatArray:
    """First parameters (k, 10) from the blob's moments and the number (k,) of its pixels that are cut off.

    Of a clipped blob the true height shows in how much of it is flat: for a Gaussian of height a·h cut off at h the
    flat part covers ``log2 a / (1 + log2 a)`` of what lies above h/2.
    """
    flat = np.minimum(n_clipped / blobs.area, MAX_FLAT_SHARE)
    log2_over = np.maximum(flat / (1.0 - flat), MIN_LOG2_OVER)
    metric = (
        np.linalg.inv(4.0 * (blobs.moments + START_BLUR_PX2 * np.eye(2)))
        * ((1.0 + log2_over) ** np.exp(-START_LOG_BETA))[:, None, None]
    )
    l_vv = np.sqrt(metric[:, 1, 1])
    l_uv = metric[:, 0, 1] / l_vv
    l_uu = np.sqrt(np.linalg.det(metric)) / l_vv
    start = np.zeros((len(blobs), N_PARAMETERS))
    start[:, CENTRE] = blobs.centre
    start[:, LOG_HEIGHT] = log2_over * np.log(2.0) + np.log(blobs.height)
    start[:, BACKGROUND] = blobs.background
    start[:, SHAPE] = np.stack([np.log(l_uu), l_uv, np.log(l_vv)], axis=1)
    start[:, LOG_BETA] = START_LOG_BETA
    return start


def _levenberg_marquardt(
    start: FloatArray, u: FloatArray, v: FloatArray, values: FloatArray, clipped: BoolArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Parameters, residuals, Jacobian and normal matrix at the minimum of Σ w r² plus weak priors on the shape.

    Every spot has its own damping and stops on its own, so that its centre does not depend on who is fitted beside it.
    """
    k = len(start)
    low, high = start - MAX_CHANGE, start + MAX_CHANGE
    low[:, LOG_BETA], high[:, LOG_BETA] = LOG_BETA_RANGE

    def attempt(parameters: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        residuals, jacobian = evaluate(parameters, u, v, values, clipped)
        cost = (weights * residuals**2).sum(axis=1) + (PRIOR * (parameters - start) ** 2).sum(axis=1)
        return parameters, residuals, jacobian, cost

    best = attempt(start)
    damping, done = np.full(k, FIRST_DAMPING), np.zeros(k, dtype=bool)
    for _ in range(ITERATIONS):
        parameters, residuals, jacobian, cost = best
        normal = _normal_matrix(jacobian, weights)
        gradient = (jacobian @ (weights * residuals)[:, :, None])[:, :, 0] - PRIOR * (parameters - start)
        normal *= 1.0 + damping[:, None, None] * np.eye(N_PARAMETERS)
        step = np.linalg.solve(normal, gradient[:, :, None])[:, :, 0]
        trial = attempt(np.clip(parameters + step, low, high))
        better = (trial[-1] <= cost) & ~done
        done |= better & (np.abs(step[:, CENTRE]).max(axis=1) < DONE_PX)
        damping *= np.where(better, 1 / DAMPING_FACTOR, DAMPING_FACTOR)
        best = trial if better.all() else _chosen(better, trial, best)
        if done.all():
            break
    parameters, residuals, jacobian, _ = best
    return parameters, residuals, jacobian, _normal_matrix(jacobian, weights)


def _chosen(
    which: BoolArray, these: tuple[FloatArray, ...], others: tuple[FloatArray, ...]
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Rows of ``these`` where ``which`` (k,) holds, of ``others`` elsewhere."""
    a, b, c, d = (
        np.where(which.reshape(-1, *(1,) * (this.ndim - 1)), this, other)
        for this, other in zip(these, others, strict=True)
    )
    return a, b, c, d


def _normal_matrix(jacobian: FloatArray, weights: FloatArray) -> FloatArray:
    return np.asarray((jacobian * weights[:, None]) @ jacobian.transpose(0, 2, 1) + np.diag(PRIOR))


def _seen_noise(influence: FloatArray, noise: FloatArray) -> FloatArray:
    """Covariance (k, 2, 2) of the centre from white noise of sd ``noise``."""
    return np.asarray(influence @ influence.transpose(0, 2, 1) * noise[:, None, None] ** 2)


def _odd_variance(
    residuals: FloatArray, near: BoolArray, centre: FloatArray, radius: int, noise: FloatArray
) -> FloatArray:
    """Variance (k,) beyond noise of a field whose odd part about the centre is that of the residuals ``near`` the blob.

    Only what exceeds noise by its own standard error counts. A wrong shape of the profile leaves residuals that are
    even about the centre and do not move it; only odd ones do.
    """
    n = 2 * radius + 1
    k = len(residuals)
    square, known = np.zeros((k, n * n)), np.zeros((k, n * n), dtype=bool)
    square[:, disc(radius)], known[:, disc(radius)] = residuals, near
    u, v = (axis.ravel()[disc(radius)] for axis in grid(radius))
    twice = np.rint(2 * np.where(np.isfinite(centre), centre, 0.0))
    mirror_u, mirror_v = twice[:, 0, None] - u, twice[:, 1, None] - v
    inside = (np.abs(mirror_u) <= radius) & (np.abs(mirror_v) <= radius)
    mirror = np.where(inside, (mirror_v + radius) * n + mirror_u + radius, 0).astype(np.intp)
    paired = near & inside & np.take_along_axis(known, mirror, axis=1)
    odd = np.where(paired, 0.5 * (residuals - np.take_along_axis(square, mirror, axis=1)), 0.0)
    pairs = np.maximum(0.5 * paired.sum(axis=1), 1.0)
    variance = (odd**2).sum(axis=1) / pairs
    return np.asarray(np.maximum(variance - noise**2 * (1.0 + np.sqrt(2.0 / pairs)), 0.0))


def _through_fit(
    influence: FloatArray, jacobian: FloatArray, near: BoolArray, radius: int
) -> tuple[FloatArray, FloatArray]:
    """What the fit makes of structure of unit variance, correlated over the width of a streak.

    Args:
        influence, jacobian: (k, 4, p), derivatives of the odd parameters with respect to the pixels, and the reverse.
        near: (k, p) where the residuals are looked at.
        radius: of the window, px.

    Returns:
        Covariance (k, 2, 2) of the centre, and the share (k,) of the odd variance that the fit leaves in the residuals:
        it follows structure as if it were the spot.
    """
    n, at = 2 * radius + 1, disc(radius)
    square = np.zeros((*influence.shape[:2], n * n))
    square[:, :, at] = influence
    blur = _correlation(radius)
    field = (blur @ square.reshape(*square.shape[:2], n, n) @ blur).reshape(square.shape)[:, :, at]
    covariance = influence @ field.transpose(0, 2, 1)
    taken = 2.0 * (jacobian * field).sum(axis=1) - (jacobian * (covariance @ jacobian)).sum(axis=1)
    share = 2.0 * (taken * near).sum(axis=1) / np.maximum(near.sum(axis=1), 1)  # half of the variance is odd
    return covariance[:, CENTRE, CENTRE], np.maximum(1.0 - share, LEAST_KEPT)


@cache
def _correlation(radius: int) -> FloatArray:
    """(n, n): correlation of structure along one axis of a window."""
    index = np.arange(2 * radius + 1)
    step = (index[:, None] - index) / STRUCTURE_LENGTH_PX
    return frozen(np.exp(-0.5 * step**2), step.shape)
