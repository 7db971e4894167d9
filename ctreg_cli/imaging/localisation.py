"""Centres of spots at the statistical bound, with covariances that own up to streaks.

The profile of :mod:`.profile` is fitted to all windows at once (:mod:`.fit`). Pixels are weighted by what can be wrong
with them: noise everywhere, and structure of the background (streaks, plate edges) that grows with the distance from
the blob. The covariance has the same two parts (:mod:`.uncertainty`), both measured in the window.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctreg_cli.arrays import BoolArray, FloatArray, IntArray
from ctreg_cli.imaging.blob import Blobs, inverse_elements
from ctreg_cli.imaging.fit import fit
from ctreg_cli.imaging.profile import BACKGROUND, CENTRE, LOG_BETA, LOG_HEIGHT, N_PARAMETERS, SHAPE, Rows, in_pixels
from ctreg_cli.imaging.uncertainty import (
    KEPT,
    centre_covariance,
    noise_field,
    odd_variance,
    ring_spread,
)
from ctreg_cli.imaging.window import dilated, disc, grid

#: background structure is correlated over a few pixels, which count as one: so its sd counts twice
STRUCTURE_WEIGHT = 2.0
#: how far beyond the blob's edge the structure that disturbs it is looked at, and from where on the pixel noise, px
NEAR_PX, NOISE_BEYOND_PX = (1.0, 4.0), 2.0
#: another blob that begins within this of the edge touches the spot: it is left out of the fit, not of the covariance
TOUCHING_PX = 2.0
#: weight of what is left out of a fit, over that of the rest: not zero, so that its residuals can be looked at
LEFT_OUT = 1e-12
#: this many pixels at the image's ceiling inside one blob mean that it was cut off there
MIN_CLIPPED_PX = 3
#: what pixels cost a perfect fit: an edge sharper than a pixel shifts the profile by so much, px
MODEL_SD_PX = 0.005
#: and what a spot that is cut off costs beside: only its sides are fitted, two pixels wide where it is sharp
CLIPPED_SD_PX = 0.008
#: added to a blob's second moments to start from: the region of a sharp spot is one pixel, the spot is wider, px²
START_BLUR_PX2 = 0.1
#: start of ln β, between a Gaussian and a flat top
START_LOG_BETA = 0.15
#: height over which a centre to start from is taken, in spot heights: background and its gradient do not reach there
START_LEVEL = 0.3
#: bounds for the first guess of a clipped spot's true height: of the share that is flat, and of log2 (true / seen)
MAX_FLAT_SHARE, MIN_LOG2_OVER = 0.7, 0.1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Centres:
    """Fitted centres of ``k`` blobs, image coordinates."""

    #: (k, 2) px
    uv_px: FloatArray
    #: (k, 2, 2) px²
    covariance_px: FloatArray
    #: (k,) sd of what differs from pixel to pixel about each blob, stored units
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
    usable = ~np.isnan(values)
    if not usable.all():
        values = np.where(usable, values, blobs.background[:, None])
    distance = _distance_beyond_edge(blobs, u, v)
    near = (distance > NEAR_PX[0]) & (distance < NEAR_PX[1]) & usable
    if blobs.foreign.any():
        foreign = dilated(blobs.foreign).reshape(k, -1)[:, at] & usable
        near = (near & ~foreign) | (foreign & (distance < TOUCHING_PX))
        usable &= ~foreign
    clipped, n_clipped = _clipped(values, blobs.own.reshape(k, -1)[:, at], ceiling)

    noise, structure = ring_spread(blobs)
    reach = np.maximum(blobs.radius - np.sqrt(blobs.area / np.pi), 1.0)
    spread = (STRUCTURE_WEIGHT * structure / reach)[:, None] * distance
    spread *= spread
    spread += (noise * noise)[:, None]
    root_weights = np.sqrt(np.where(usable, 1.0, LEFT_OUT) / spread)

    rows = Rows(u, v, values, clipped, root_weights)
    parameters, normal = fit(
        rows, _start(blobs, n_clipped, _brightest(blobs, values, usable & (distance < NEAR_PX[0]), u, v))
    )

    shift = np.linalg.solve(normal, np.broadcast_to(np.eye(N_PARAMETERS, 2), (k, N_PARAMETERS, 2)))
    influence = (shift.transpose(0, 2, 1) @ rows.by_spot[:, :-1] * root_weights[:, None]).transpose(1, 0, 2)
    centre = parameters[CENTRE]
    residuals = rows.by_spot[:, -1] / root_weights
    rough, smooth, length = noise_field(residuals, usable & (distance > NOISE_BEYOND_PX), blobs.radius)
    structure = odd_variance(residuals, near, centre, blobs.radius, rough) / KEPT
    covariance = centre_covariance(
        in_pixels(parameters, influence), blobs.radius, smooth=(smooth, length), rough=rough, structure=structure
    )
    covariance += (MODEL_SD_PX**2 + CLIPPED_SD_PX**2 * (n_clipped > 0))[:, None, None] * np.eye(2)
    uv = centre.T
    away = ((uv - blobs.centre) ** 2).sum(axis=1)
    size = np.trace(blobs.moments, axis1=1, axis2=2)
    found = np.isfinite(uv).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2)) & (away <= size)
    if not found.all():
        uv = np.where(found[:, None], uv, blobs.centre)
        covariance = np.where(found[:, None, None], covariance, blobs.moments)
    return Centres(uv_px=blobs.middles + uv, covariance_px=covariance, noise=rough)


def _clipped(values: FloatArray, own: BoolArray, ceiling: float) -> tuple[BoolArray | None, IntArray]:
    """Which pixels (k, p) are cut off, None if none is, and how many (k,) of each blob's own."""
    clipped = values >= ceiling
    n_clipped = np.count_nonzero(clipped & own, axis=1)
    cut = n_clipped >= MIN_CLIPPED_PX
    if not cut.any():
        return None, np.zeros(len(values), dtype=np.intp)
    return clipped & cut[:, None], np.where(cut, n_clipped, 0)


def _distance_beyond_edge(blobs: Blobs, u: FloatArray, v: FloatArray) -> FloatArray:
    """Distance (k, p) of pixels outside the ellipse of the blob's half-height moments, px; 0 inside."""
    x, y = u - blobs.centre[:, 0, None], v - blobs.centre[:, 1, None]
    uu, uv, vv = inverse_elements(
        4.0 * blobs.moments
    )  # a uniform ellipse has moments of a quarter of its semi-axes squared
    xx, yy = x * x, y * y
    q = uu[:, None] * xx
    q += vv[:, None] * yy
    x *= y
    x *= 2.0 * uv[:, None]
    q += x
    xx += yy
    distance = np.sqrt(xx)
    distance -= np.sqrt(xx / np.maximum(q, 1e-18))
    return np.maximum(distance, 0.0, out=distance)


def _brightest(blobs: Blobs, values: FloatArray, about: BoolArray, u: FloatArray, v: FloatArray) -> FloatArray:
    """Centre of gravity (2, k) of what stands out of the background, taken high enough that it does not count."""
    weights = values - (blobs.background + START_LEVEL * blobs.height)[:, None]
    np.maximum(weights, 0.0, out=weights)
    weights *= about
    sums: FloatArray = np.stack([u, v, np.ones(len(u))]) @ weights.T
    centre: FloatArray = sums[:2] / sums[2]
    return centre


def _start(blobs: Blobs, n_clipped: IntArray, centre: FloatArray) -> FloatArray:
    """First parameters (10, k) from the blob's moments, the number (k,) of its pixels cut off, and its ``centre``.

    Of a clipped blob the true height shows in how much of it is flat: for a Gaussian of height a·h cut off at h the
    flat part covers ``log2 a / (1 + log2 a)`` of what lies above h/2.
    """
    flat = np.minimum(n_clipped / blobs.area, MAX_FLAT_SHARE)
    log2_over = np.maximum(flat / (1.0 - flat), MIN_LOG2_OVER)
    uu, uv, vv = inverse_elements(4.0 * (blobs.moments + START_BLUR_PX2 * np.eye(2)))
    wider = (1.0 + log2_over) ** np.exp(-START_LOG_BETA)
    l_vv = np.sqrt(vv * wider)
    l_uv = uv * wider / l_vv
    start = np.zeros((N_PARAMETERS, len(blobs)))
    start[CENTRE] = centre
    start[LOG_HEIGHT] = log2_over * np.log(2.0) + np.log(blobs.height)
    start[BACKGROUND] = blobs.background
    start[SHAPE] = 0.5 * np.log(uu * wider - l_uv * l_uv), l_uv, np.log(l_vv)
    start[LOG_BETA] = START_LOG_BETA
    return start
