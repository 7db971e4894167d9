"""Profiles of spots, fitted to all windows at once.

The profile of :mod:`.profile` is fitted (:mod:`.fit`) with pixels weighted by what can be wrong with them: noise
everywhere, and structure of the background (streaks, plate edges) that grows with the distance from the blob. Spots
that come out sharp or flat are fitted again with the profile that is made for them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ctreg_cli.arrays import BoolArray, FloatArray, IntArray
from ctreg_cli.imaging.blob import Blobs, axes_of, inverse_elements
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
    Areas,
    Rows,
    moments_of_shape,
)
from ctreg_cli.imaging.uncertainty import ring_spread
from ctreg_cli.imaging.window import dilated, disc, grid

#: background structure is correlated over a few pixels, which count as one: so its sd counts twice
STRUCTURE_WEIGHT = 2.0
#: how far beyond the blob's edge the structure that disturbs it is looked at, and from where on the pixel noise, px
NEAR_PX, NOISE_BEYOND_PX = (1.0, 4.0), 2.0
#: another blob that begins within this of the edge touches the spot: it is left out of the fit, not of the covariance
TOUCHING_PX = 2.0
#: weight of what is left out of a fit, over that of the rest: not zero, so that its residuals can be looked at
LEFT_OUT = 1e-12
#: where an edge falls by more of the height in a pixel, or one that is cut off by more of the ceiling, pixels are means
#: over their areas; as far as this beyond half height, px
SHARP, SHARP_CUT, SHARP_REACH_PX = 0.7, 2.2, 2.0
#: a top flatter than this (ln β) is not one that the common fit foresees
FLAT, FLAT_CUT = 0.6, 0.2
#: one that is cut off may be an edge as well where its mean weighted square of residuals is more than this
POOR = 3.0
#: by what share of the height its edge falls in a pixel, to start from
FLAT_EDGE = 0.4
#: fewer pixels above half height do not tell whether a spot is long; if it is taken for a long one, is nearly as steep,
#: and its mean weighted square of residuals is more than noise would make it, it is fitted in that way too
COARSE_PX2, SHARP_COARSE, COARSE_MISFIT = 10.0, 0.6, 1.15
#: what is cut off is seen so only if that lowers its mean weighted square of residuals to this share
CLEARLY_BETTER = 0.95
#: of a spot that is cut off the common profile tells enough up to this half width, px; beyond, an edge about a flat top
#: fits better
RIM_PX = 2.5
#: added to a blob's second moments to start from: the region of a sharp spot is one pixel, the spot is wider, px²
START_BLUR_PX2 = 0.1
#: start of ln β, between a Gaussian and a flat top
START_LOG_BETA = 0.15
#: of sharp spots
SHARP_START_LOG_BETA = 0.3
#: height over which a centre to start from is taken, in spot heights: background and its gradient do not reach there
START_LEVEL = 0.3
#: bounds for the first guess of a clipped spot's true height: of the share that is flat, and of log2 (true / seen)
MAX_FLAT_SHARE, MIN_LOG2_OVER = 0.7, 0.1


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
    #: (k,) of which profiles pixels were taken as means over their areas
    sharp: BoolArray
    #: (k,) which profiles are edges about flat tops
    flat: BoolArray
    #: value at which the image is cut off
    ceiling: float


def fit_profiles(blobs: Blobs, ceiling: float) -> Profiles:
    """Fit the profile to every blob; arguments as :func:`.localisation.fit_centres`."""
    k = len(blobs)
    at = disc(blobs.radius)
    u, v = (axis.ravel()[at] for axis in grid(blobs.radius))
    values = blobs.values.reshape(k, -1)[:, at]
    usable = ~np.isnan(values)
    if not usable.all():
        values = np.where(usable, values, blobs.background[:, None])
    edge = np.array(inverse_elements(4.0 * blobs.moments))
    distance = distance_beyond_edge(edge, u - blobs.centre[:, 0, None], v - blobs.centre[:, 1, None])
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

    pixels = _Pixels(u, v, values, clipped, root_weights)
    brightest = _brightest(blobs, values, usable & (distance < NEAR_PX[0]), u, v)
    long = LongSpots.of(blobs)
    rows = pixels.rows(long)
    fitted = _Fitted(*fit(rows, _start(blobs, n_clipped, brightest, long)), rows.by_spot, long)
    few = np.flatnonzero(_is_sharp(blobs, fitted, n_clipped > 0, ceiling))
    sharp = flat = few[:0]
    if len(few):
        some = blobs.take(few)
        round_start = _start(some, n_clipped[few], brightest[:, few], LongSpots.none(len(few)))
        first = np.where(long.mask[few], round_start, fitted.parameters[:, few])
        others = _fit_sharp(some, pixels.take(few), n_clipped[few], brightest[:, few], first)
        # of what is cut off (one pixel of every image is the brightest), and neither way explains (a sharp kernel's
        # undershoot), the common fit is the steadier one
        least = np.where(n_clipped[few] > 1, CLEARLY_BETTER, np.inf)
        fitted, sharp = fitted.with_better(few, others, least)
    is_poor = misfit_of(fitted.by_spot) > POOR
    may_be_flat = (n_clipped > 0) & ((fitted.parameters[FLATNESS] > FLAT_CUT) | is_poor)
    may_be_flat |= fitted.parameters[FLATNESS] > FLAT
    few = np.flatnonzero(may_be_flat & ~fitted.long.mask & (blobs.area > np.pi * RIM_PX**2))
    if len(few):
        first = _flat_start(fitted.parameters[:, few], blobs.take(few), n_clipped[few] > 0)
        others = _fit_flat(pixels.take(few), first, blobs.radius)
        fitted, flat = fitted.with_better(few, others, np.ones(len(few)))
    return Profiles(
        parameters=fitted.parameters,
        long=fitted.long,
        centre=fitted.long.turned_back(fitted.parameters[CENTRE]),
        normal=fitted.normal,
        rows=rows,
        residuals=fitted.by_spot[:, -1] / root_weights,
        noise=noise,
        structure_slope=structure_slope,
        near=near,
        quiet=usable & (distance > NOISE_BEYOND_PX),
        height=blobs.height,
        n_clipped=n_clipped,
        sharp=np.isin(np.arange(k), sharp),
        flat=np.isin(np.arange(k), flat),
        ceiling=ceiling,
    )


class _Pixels(NamedTuple):
    """The pixels of ``k`` windows, and how they are weighted."""

    #: (p,) coordinates
    u: FloatArray
    v: FloatArray
    #: (k, p)
    values: FloatArray
    #: (k, p) which of these are cut off; None where none is
    clipped: BoolArray | None
    #: (k, p)
    root_weights: FloatArray

    def take(self, which: IntArray) -> _Pixels:
        """Some of the windows."""
        clipped = None if self.clipped is None else self.clipped[which]
        return _Pixels(self.u, self.v, self.values[which], clipped, self.root_weights[which])

    def rows(self, long: LongSpots, reach: float | None = None, *, flat: bool = False) -> Rows:
        """For profiles of which some are ``long``, seen along their own axes; or of ``flat`` ones.

        Pixels up to ``reach`` from the middles are means over their areas; None: all are points.
        """
        areas, u, v = (None, self.u, self.v) if reach is None else Areas.within(self.u, self.v, reach)
        mask = None
        if len(long):
            (u, v), mask = long.coordinates(u, v), long.mask
        return Rows(u, v, self.values, self.clipped, self.root_weights, mask, areas, flat=flat)


class _Fitted(NamedTuple):
    """Profiles of ``k`` spots, as far as they have been fitted."""

    #: (10, k), (k, 10, 10), and derivatives and residuals (k, 11, p)
    parameters: FloatArray
    normal: FloatArray
    by_spot: FloatArray
    long: LongSpots

    def with_better(self, few: IntArray, others: _Fitted, least: FloatArray) -> tuple[_Fitted, IntArray]:
        """With those ``others`` of the spots ``few`` (f,) that misfit less than ``least`` (f,) times these; and which.

        All arrays are written to in place.
        """
        better = misfit_of(others.by_spot) < least * misfit_of(self.by_spot[few])
        few = few[better]
        self.parameters[:, few], self.normal[few] = others.parameters[:, better], others.normal[better]
        self.by_spot[few] = others.by_spot[better]
        return self._replace(long=self.long.replaced(few, others.long.take(better))), few


def misfit_of(by_spot: FloatArray) -> FloatArray:
    """Mean weighted squares (k,) of residuals, the last of the rows (k, 11, p)."""
    weighted = by_spot[:, -1]
    return np.asarray((weighted * weighted).sum(axis=1) / weighted.shape[1])


def _is_sharp(blobs: Blobs, fitted: _Fitted, clipped: BoolArray, ceiling: float) -> BoolArray:
    """Whether (k,) pixels are too wide to be seen as points of a fitted profile.

    Or whether a spot of few pixels was taken for a long one, and does not look like that.
    """
    long = fitted.long
    at_edge, at_ceiling = steepness(fitted.parameters, long.mask, ceiling)
    sharp = (at_edge > SHARP) | (clipped & (at_ceiling > SHARP_CUT))
    coarse = long.index[blobs.area[long.index] < COARSE_PX2]
    sharp[coarse] |= (at_edge[coarse] > SHARP_COARSE) & (misfit_of(fitted.by_spot[coarse]) > COARSE_MISFIT)
    return np.asarray(sharp)


def _reach(parameters: FloatArray, radius: int) -> float:
    """How far from the middles of windows of this radius profiles are so steep that pixels are no points, px."""
    half_axes = 0.5 * axes_of(moments_of_shape(parameters))[0]
    return SHARP_REACH_PX + float(np.minimum(half_axes, radius).max())


def _flat_start(parameters: FloatArray, blobs: Blobs, clipped: BoolArray) -> FloatArray:
    """Parameters (10, k) to start from: those of another profile, or of what is cut off, a rod half of which is seen.

    Of a thick rod the rim alone is seen there, which lies near the half-height contour whatever the height.
    """
    uu, uv, vv = inverse_elements(4.0 * blobs.moments)
    start, l_vv = parameters.copy(), np.sqrt(vv)
    shape = np.stack([0.5 * np.log(uu - uv * uv / vv), uv / l_vv, np.log(l_vv)])
    start[SHAPE] = np.where(clipped, shape, parameters[SHAPE])
    start[LOG_HEIGHT] = np.where(clipped, np.log(2.0 * blobs.height), parameters[LOG_HEIGHT])
    steep = -np.log(np.log(2.0)) - 0.5 * (shape[0] + shape[2]) + np.log(FLAT_EDGE)
    start[FLATNESS] = np.where(clipped, np.maximum(steep, FLAT), parameters[FLATNESS])
    return start


def _fit_flat(pixels: _Pixels, first: FloatArray, radius: int) -> _Fitted:
    """Fit edges about flat tops, from the ``first`` parameters (10, k), in windows of this radius."""
    none = LongSpots.none(first.shape[1])
    steep = np.log(2.0) * np.exp(first[FLATNESS] + np.maximum(first[SHAPE][0], first[SHAPE][2])) > SHARP
    points_do = pixels.clipped is None and not steep.any()
    rows = pixels.rows(none, None if points_do else _reach(first, radius), flat=True)
    return _Fitted(*fit(rows, first), rows.by_spot, none)


def _fit_sharp(blobs: Blobs, pixels: _Pixels, n_clipped: IntArray, brightest: FloatArray, first: FloatArray) -> _Fitted:
    """Fit profiles to pixels that are means over their areas.

    Which spots are long tells their fitted shape: few pixels above half height do not.

    Args:
        blobs: the windows.
        pixels: of these.
        n_clipped: (k,) how many of the blobs' own are cut off.
        brightest: (2, k) centres to start from.
        first: (10, k) parameters of spots that are not long, to start from.
    """
    reach = _reach(first, blobs.radius)
    rows = pixels.rows(LongSpots.none(len(blobs)), reach)
    start = first.copy()
    start[FLATNESS] = SHARP_START_LOG_BETA
    parameters, normal = fit(rows, start)
    shown = LongSpots.of_moments(moments_of_shape(parameters))
    if len(shown):
        few = shown.index
        long = shown.take(few)
        again = pixels.take(few).rows(long, reach)
        start = _start(blobs.take(few), n_clipped[few], brightest[:, few], long)
        parameters[:, few], normal[few] = fit(again, start)
        rows.by_spot[few] = again.by_spot
    return _Fitted(parameters, normal, rows.by_spot, shown)


def _clipped(values: FloatArray, own: BoolArray, ceiling: float) -> tuple[BoolArray | None, IntArray]:
    """Which pixels (k, p) are cut off, None if none is, and how many (k,) of each blob's own."""
    clipped = values >= ceiling
    n_clipped = np.count_nonzero(clipped & own, axis=1)
    return (clipped if n_clipped.any() else None), n_clipped


def steepness(parameters: FloatArray, long: BoolArray, ceiling: float) -> tuple[FloatArray, FloatArray]:
    """By what share (k,) of the height profiles fall in a pixel at half height; of the ceiling, where they reach it."""
    width = np.exp(-np.maximum(parameters[SHAPE][0], parameters[SHAPE][2]))
    beta = np.where(long, LONG_BETA, np.exp(parameters[FLATNESS]))
    at_edge = np.log(2.0) * beta / width
    # 2^(−q^β) is the ceiling over the height where q^β is this; a profile with a peak (β < ½) is infinitely steep there
    at_ceiling = (parameters[LOG_HEIGHT] - np.log(np.maximum(ceiling - parameters[BACKGROUND], 1e-9))) / np.log(2.0)
    with np.errstate(divide="ignore"):
        return at_edge, at_edge * 2.0 * np.maximum(at_ceiling, 0.0) ** (1.0 - 0.5 / beta)


def distance_beyond_edge(edge: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """Distance (k, p) of points outside ellipses, along the lines to their middles, px; 0 inside.

    Args:
        edge: (3, k) A, B, C of each, ``A x² + 2 B x y + C y² = 1``: for a uniform ellipse, which has a quarter of its
            semi-axes squared, the inverse of four times its second moments.
        x: (k, p) from the ellipse's middle, px.
        y: likewise.
    """
    uu, uv, vv = edge[:, :, None]
    xx, yy = x * x, y * y
    q = uu * xx
    q += vv * yy
    xy = x * y
    xy *= uv + uv
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
