"""Centres of spots at the statistical bound, with covariances that own up to streaks.

The profile of :mod:`.profile` is fitted to all windows at once (:mod:`.fit`). Pixels are weighted by what can be wrong
with them: noise everywhere, and structure of the background (streaks, plate edges) that grows with the distance from
the blob. The covariance has the same two parts (:mod:`.uncertainty`), both measured in the window; added to these is
what a steep edge seen in few pixels costs, and of a long spot the chance that it is two rods (:mod:`.plateau`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ctreg_cli.arrays import BoolArray, FloatArray, IntArray
from ctreg_cli.imaging.blob import Blobs, inverse_elements
from ctreg_cli.imaging.fit import fit
from ctreg_cli.imaging.plateau import LongSpots, rod_flatness
from ctreg_cli.imaging.profile import (
    BACKGROUND,
    CENTRE,
    FLATNESS,
    LOG_HEIGHT,
    LONG_BETA,
    N_PARAMETERS,
    SHAPE,
    Rows,
    in_pixels,
)
from ctreg_cli.imaging.uncertainty import (
    KEPT,
    centre_covariance,
    noise_field,
    odd_variance,
    responses,
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
#: what pixels cost a perfect fit: an edge that falls by so much of the height in a pixel shifts the profile by this sd,
#: px, a gentler one by this power of its slope less (measured without noise)
STEEP, STEEP_SD_PX, STEEP_POWER = 0.8, 0.002, 5.5
#: the same of a spot that is cut off, where its edge falls by so much of the ceiling in a pixel: of such a
#: spot only the sides are seen
CUT, CUT_SD_PX, CUT_POWER = 1.5, 0.0042, 1.2
#: of a spot that is cut off, and that the profile does not fit (a sharp kernel's undershoot), the variance that noise
#: makes grows by this share of what the mean weighted square of its residuals exceeds 1 by
MISFIT_SHARE = 0.6
#: a faint spot's size and height come from the same noise as its centre, which makes it look surer than it is: its
#: variance is twice that of the linear law where it stands out by so many sd of the noise
FAINT_SD = 5.0
#: a smooth kernel's noise makes peaks of the height of its whole sd, not of what differs from pixel to pixel; but part
#: of what seems to be such noise is structure, which hides no rod
SMOOTH_NOISE_SHARE = 0.7
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
    #: (k,) sd of the noise that a spot must stand out of, stored units
    noise: FloatArray


class Profiles(NamedTuple):
    """Profiles fitted to ``k`` blobs; ``p`` pixels in the disc of each window."""

    #: (10, k); long spots are seen along their own axes
    parameters: FloatArray
    long: LongSpots
    #: (2, k) from the windows' middles, px
    centre: FloatArray
    #: (k, 10, 10), of the steps of :func:`ctreg_cli.imaging.profile.moved`
    normal: FloatArray
    #: derivatives and weighted residuals at ``parameters``
    rows: Rows
    #: (k, p) residuals, not weighted
    residuals: FloatArray
    #: (k,) sd of the noise by which pixels were weighted, and by how much structure adds to that a pixel farther out
    noise: FloatArray
    structure_slope: FloatArray
    #: (k, p) where the structure that disturbs a blob is looked at, and where the pixel noise
    near: BoolArray
    quiet: BoolArray
    #: (k,) height of the blobs, as far as it is not cut off, and how many of their pixels are
    height: FloatArray
    n_clipped: IntArray
    #: value at which the image is cut off
    ceiling: float


def fit_centres(blobs: Blobs, ceiling: float) -> Centres:
    """Fit the profile to every blob.

    Where a fit runs away (more than the blob's own size from its centre of gravity), the centre of gravity is returned
    with a covariance of the blob's size: known badly, and said so.

    Args:
        blobs: windows of one radius.
        ceiling: value at which the image is cut off; pixels of that value are taken as "at least so bright".
    """
    fitted = fit_profiles(blobs, ceiling)
    law = centre_law(fitted, centre_columns(fitted.normal), blobs.radius)
    covariance = law.covariance(structure_near(fitted, law.rough, blobs.radius))
    uv = fitted.centre.T
    away = ((uv - blobs.centre) ** 2).sum(axis=1)
    size = np.trace(blobs.moments, axis1=1, axis2=2)
    found = np.isfinite(uv).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2)) & (away <= size)
    if not found.all():
        uv = np.where(found[:, None], uv, blobs.centre)
        covariance = np.where(found[:, None, None], covariance, blobs.moments)
    noise = np.maximum(law.rough, SMOOTH_NOISE_SHARE * law.smooth)
    return Centres(uv_px=blobs.middles + uv, covariance_px=covariance, noise=noise)


def fit_profiles(blobs: Blobs, ceiling: float) -> Profiles:
    """Fit the profile to every blob; arguments as :func:`fit_centres`."""
    k = len(blobs)
    at = disc(blobs.radius)
    u, v = (axis.ravel()[at] for axis in grid(blobs.radius))
    values = blobs.values.reshape(k, -1)[:, at]
    usable = ~np.isnan(values)
    if not usable.all():
        values = np.where(usable, values, blobs.background[:, None])
    distance = distance_beyond_edge(blobs.moments, u - blobs.centre[:, 0, None], v - blobs.centre[:, 1, None])
    near = (distance > NEAR_PX[0]) & (distance < NEAR_PX[1]) & usable
    if blobs.foreign.any():
        foreign = dilated(blobs.foreign).reshape(k, -1)[:, at] & usable
        near = (near & ~foreign) | (foreign & (distance < TOUCHING_PX))
        usable &= ~foreign
    clipped, n_clipped = _clipped(values, blobs.own.reshape(k, -1)[:, at], ceiling)

    noise, structure = ring_spread(blobs)
    reach = np.maximum(blobs.radius - np.sqrt(blobs.area / np.pi), 1.0)
    structure_slope = STRUCTURE_WEIGHT * structure / reach
    root_weights = root_pixel_weights(distance, noise, structure_slope)
    if not usable.all():
        root_weights = np.where(usable, root_weights, math.sqrt(LEFT_OUT) * root_weights)

    brightest = _brightest(blobs, values, usable & (distance < NEAR_PX[0]), u, v)
    long = LongSpots.of(blobs)
    if len(long):
        along, across = long.coordinates(u, v)
        rows = Rows(along, across, values, clipped, root_weights, long.mask)
    else:
        rows = Rows(u, v, values, clipped, root_weights)
    parameters, normal = fit(rows, _start(blobs, n_clipped, brightest, long))
    return Profiles(
        parameters=parameters,
        long=long,
        centre=long.turned_back(parameters[CENTRE]),
        normal=normal,
        rows=rows,
        residuals=rows.by_spot[:, -1] / root_weights,
        noise=noise,
        structure_slope=structure_slope,
        near=near,
        quiet=usable & (distance > NOISE_BEYOND_PX),
        height=blobs.height,
        n_clipped=n_clipped,
        ceiling=ceiling,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Law:
    """What noise and structure make of ``k`` fitted centres."""

    #: (3, k, 2, 2), see :func:`ctreg_cli.imaging.uncertainty.responses`
    response: FloatArray
    #: (k,) sd of the noise as a smooth field, and of what differs from pixel to pixel
    smooth: FloatArray
    rough: FloatArray
    #: (k,) factor for faint spots
    faint: FloatArray
    #: (k, 2, 2) covariance that a perfect fit has as well, px²
    least: FloatArray

    def covariance(self, structure: FloatArray) -> FloatArray:
        """(k, 2, 2) px², for a ``structure`` of this variance (k,) about each spot."""
        return self.scaled(self.made_by(structure), 1.0)

    def made_by(self, structure: FloatArray) -> FloatArray:
        """(k, 2, 2) px²: what noise, and structure of these variances (k,), make of centres in sure windows."""
        return centre_covariance(self.response, smooth=self.smooth, rough=self.rough, structure=structure)

    def scaled(self, covariance: FloatArray, factor: FloatArray | float) -> FloatArray:
        """That ``covariance`` (k, 2, 2) and all else.

        ``factor`` (k,) is by how much worse, in variance, the centres are known now than where the law was measured.
        """
        scaled: FloatArray = covariance * (self.faint * factor)[:, None, None]
        scaled += self.least
        return scaled

    def take(self, which: BoolArray | IntArray) -> Law:
        """Of some of the centres."""
        return Law(
            response=self.response[:, which],
            smooth=self.smooth[which],
            rough=self.rough[which],
            faint=self.faint[which],
            least=self.least[which],
        )

    def joined(self, other: Law) -> Law:
        """Of these centres and others."""
        return Law(
            response=np.concatenate([self.response, other.response], axis=1),
            smooth=np.concatenate([self.smooth, other.smooth]),
            rough=np.concatenate([self.rough, other.rough]),
            faint=np.concatenate([self.faint, other.faint]),
            least=np.concatenate([self.least, other.least]),
        )


def centre_columns(normal: FloatArray) -> FloatArray:
    """(k, 10, 2): the first two columns of the inverses of normal matrices (k, 10, 10)."""
    wanted = np.broadcast_to(np.eye(N_PARAMETERS, 2), (len(normal), N_PARAMETERS, 2))
    return np.asarray(np.linalg.solve(normal, wanted), dtype=np.float64)


def centre_law(fitted: Profiles, shift: FloatArray, radius: int) -> Law:
    """The law of fitted centres, measured in their windows.

    Args:
        fitted: the profiles.
        shift: (k, 10, 2), see :func:`centre_columns`.
        radius: of the windows, px.
    """
    by_spot, root_weights, long = fitted.rows.by_spot, fitted.rows.root_weights, fitted.long
    influence = (shift.transpose(0, 2, 1) @ by_spot[:, :-1] * root_weights[:, None]).transpose(1, 0, 2)
    influence = in_pixels(fitted.parameters, influence)
    if len(long):
        influence = long.turned_back(influence)
    rough, smooth, length = noise_field(fitted.residuals, fitted.quiet, radius)
    response = responses(influence, radius, length)
    least = _of_pixels(fitted.parameters, long.mask, fitted.n_clipped > 0, fitted.ceiling)[:, None, None] * np.eye(2)
    cut = np.flatnonzero(fitted.n_clipped)
    if len(cut):
        misfit = np.maximum((by_spot[cut, -1] ** 2).mean(axis=1) - 1.0, 0.0)
        least[cut] += (MISFIT_SHARE * misfit * rough[cut] ** 2)[:, None, None] * response[1, cut]
    if len(long):
        least[long.index] += long.pair_covariance(fitted.parameters, by_spot, fitted.normal)
    return Law(
        response=response,
        smooth=smooth,
        rough=rough,
        faint=1.0 + (FAINT_SD * rough / fitted.height) ** 3,
        least=least,
    )


def structure_near(fitted: Profiles, rough: FloatArray, radius: int) -> FloatArray:
    """Variance (k,) of the background structure that disturbs fitted centres, beyond noise of sd ``rough`` (k,)."""
    return odd_variance(fitted.residuals, fitted.near, fitted.centre, radius, rough) / KEPT


def _clipped(values: FloatArray, own: BoolArray, ceiling: float) -> tuple[BoolArray | None, IntArray]:
    """Which pixels (k, p) are cut off, None if none is, and how many (k,) of each blob's own."""
    clipped = values >= ceiling
    n_clipped = np.count_nonzero(clipped & own, axis=1)
    return (clipped if n_clipped.any() else None), n_clipped


def _of_pixels(parameters: FloatArray, long: BoolArray, clipped: BoolArray, ceiling: float) -> FloatArray:
    """Variance (k,) of the centre, px², because a steep edge is seen in few pixels, over which it is not averaged."""
    width = np.exp(-np.maximum(parameters[SHAPE][0], parameters[SHAPE][2]))
    beta = np.where(long, LONG_BETA, np.exp(parameters[FLATNESS]))
    steepness = np.log(2.0) * beta / width
    sd = STEEP_SD_PX * np.minimum(steepness / STEEP, 1.5) ** STEEP_POWER / np.sqrt(width)
    # 2^(−q^β) is the ceiling over the height where q^β is this
    at_ceiling = (parameters[LOG_HEIGHT] - np.log(np.maximum(ceiling - parameters[BACKGROUND], 1e-9))) / np.log(2.0)
    steepness *= 2.0 * np.maximum(at_ceiling, 0.0) ** (1.0 - 0.5 / beta)
    cut_sd = CUT_SD_PX * np.minimum(steepness / CUT, 2.0) ** CUT_POWER
    return np.asarray(np.where(clipped, np.maximum(sd, cut_sd), sd) ** 2)


def distance_beyond_edge(moments: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """Distance (k, p) of points outside the uniform ellipses with these second moments, px; 0 inside.

    Args:
        moments: (k, 2, 2) px².
        x: (k, p) from the ellipse's middle, px.
        y: likewise.
    """
    uu, uv, vv = inverse_elements(4.0 * moments)  # such an ellipse has a quarter of its semi-axes squared
    xx, yy = x * x, y * y
    q = uu[:, None] * xx
    q += vv[:, None] * yy
    xy = x * y
    xy *= 2.0 * uv[:, None]
    q += xy
    xx += yy
    distance = np.sqrt(xx)
    distance -= np.sqrt(xx / np.maximum(q, 1e-18))
    return np.maximum(distance, 0.0, out=distance)


def root_pixel_weights(distance: FloatArray, noise: FloatArray, structure_slope: FloatArray) -> FloatArray:
    """Roots of the weights (k, p) of pixels so far beyond an edge: noise (k,) everywhere, and structure that grows."""
    spread = structure_slope[:, None] * distance
    spread *= spread
    spread += (noise * noise)[:, None]
    np.sqrt(spread, out=spread)
    return np.asarray(1.0 / spread)


def _brightest(blobs: Blobs, values: FloatArray, about: BoolArray, u: FloatArray, v: FloatArray) -> FloatArray:
    """Centre of gravity (2, k) of what stands out of the background, taken high enough that it does not count."""
    weights = values - (blobs.background + START_LEVEL * blobs.height)[:, None]
    np.maximum(weights, 0.0, out=weights)
    weights *= about
    sums: FloatArray = np.stack([u, v, np.ones(len(u))]) @ weights.T
    centre: FloatArray = sums[:2] / sums[2]
    return centre


def _start(blobs: Blobs, n_clipped: IntArray, centre: FloatArray, long: LongSpots) -> FloatArray:
    """First parameters (10, k) from the blob's moments, the number (k,) of its pixels cut off, and its ``centre``.

    Of a clipped blob the true height shows in how much of it is flat: for a Gaussian of height a·h cut off at h the
    flat part covers ``log2 a / (1 + log2 a)`` of what lies above h/2.
    """
    flat = np.minimum(n_clipped / blobs.area, MAX_FLAT_SHARE)
    log2_over = np.maximum(flat / (1.0 - flat), MIN_LOG2_OVER)
    moments = long.turned_moments(blobs.moments) + START_BLUR_PX2 * np.eye(2)
    uu, uv, vv = inverse_elements(4.0 * moments)
    wider = (1.0 + log2_over) ** np.exp(-START_LOG_BETA)
    l_vv = np.sqrt(vv * wider)
    l_uv = uv * wider / l_vv
    start = np.zeros((N_PARAMETERS, len(blobs)))
    start[CENTRE] = long.turned(centre)
    start[LOG_HEIGHT] = log2_over * np.log(2.0) + np.log(blobs.height)
    start[BACKGROUND] = blobs.background
    start[SHAPE] = 0.5 * np.log(uu * wider - l_uv * l_uv), l_uv, np.log(l_vv)
    start[FLATNESS] = START_LOG_BETA
    start[FLATNESS, long.index] = rod_flatness(np.sqrt(moments[:, 0, 0] / moments[:, 1, 1])[long.index])
    return start
