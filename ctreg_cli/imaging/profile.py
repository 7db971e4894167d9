"""What a spot looks like: a blurred, flat-topped ellipse on a tilted background, cut off where the scanner clips.

``I(x) = a · 2^(−q^β) + b + g · x`` with ``q = |ξ|²``, ``ξ = L (x − c)``: ``q = 1`` is the contour of half height, β = 1
a Gaussian (a rod thinner than the blur), larger β the flatter top of a thick rod or of a tilted one in a thick slab.
The profile is even about its centre, so that no error in its shape can move the centre.

A tilted rod in a thick slab leaves a plateau with blurred ends, which no such ellipse resembles. Of long spots, seen
along their own axes, ``q = |ξ|^2γ + |η|²`` instead, β fixed: γ = 1 is the ellipse, larger γ the longer plateau.

Two more views are for spots that this does not describe. A sharp one changes within a pixel: there its pixels are means
over their areas, not points (:class:`Areas`). A thick rod is flat but for an edge as wide as the blur:
``I = a/2 · erfc(s (|ξ| − 1))``, with s such that β is the same slope at half height.

Parameters are (10, k), a row each. Steps of a fit are taken in the spot's own coordinates, where the derivatives are
products of ξ and η and all spots look alike: see :func:`moved`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from ctreg_cli.arrays import BoolArray, FloatArray, IntArray

#: order of the parameters: centre u, v; ln a; b; g_u, g_v; L = [[e^l0, 0], [l1, e^l2]]; ln β, or ln γ of a long spot
CENTRE: Final = slice(0, 2)
LOG_HEIGHT: Final = 2
BACKGROUND: Final = 3
GRADIENT: Final = slice(4, 6)
SHAPE: Final = slice(6, 9)
FLATNESS: Final = 9
N_PARAMETERS: Final = 10

#: of the edge of a flat spot, so that the slope at half height is that of the other profile with the same β
_EDGE = float(np.sqrt(np.pi) * np.log(2.0))
#: along each side of a pixel that is seen as the mean of points
POINTS: Final = 3

_LN2 = float(np.log(2.0))
#: keeps ln q finite at the very centre; (px/px)²
_TINY = 1e-9
#: rows of derivatives of the spot itself; that of its height is the spot
_OF_SPOT = (0, 1, LOG_HEIGHT, 6, 7, 8, FLATNESS)
#: β of long spots: that of a thin rod, blurred
LONG_BETA = 1.08


def moved(parameters: FloatArray, step: FloatArray) -> FloatArray:
    """Parameters (10, k) after a ``step`` (10, k) in the spots' own coordinates.

    Its first two rows shift the contours by −L δc; rows 6 to 8 stretch them, ``δξ = e0 ξ``, ``δη = e1 ξ + e2 η``; the
    others are added.
    """
    after: FloatArray = parameters + step
    (scale_u, _, scale_v), l1 = np.exp(parameters[SHAPE]), parameters[7]
    du = -step[0] / scale_u
    after[0] = parameters[0] + du
    after[1] = parameters[1] - (step[1] + l1 * du) / scale_v
    after[7] = l1 + step[7] * scale_u + l1 * step[8]
    return after


def in_pixels(parameters: FloatArray, shift: FloatArray) -> FloatArray:
    """What a ``shift`` (2, k, ...) in the spots' own coordinates moves the centres by, px: −L⁻¹ shift."""
    l0, l1, l2 = parameters[SHAPE].reshape(3, -1, *(1,) * (shift.ndim - 2))
    pixels = np.empty_like(shift)
    pixels[0] = -np.exp(-l0) * shift[0]
    pixels[1] = -np.exp(-l2) * (shift[1] + l1 * pixels[0])
    return pixels


def moments_of_shape(parameters: FloatArray) -> FloatArray:
    """Second moments (k, 2, 2), px², of the half-height ellipses of profiles (10, k) that are not long."""
    (l0, l2), l1 = np.exp(parameters[[6, 8]]), parameters[7]
    root = np.zeros((parameters.shape[1], 2, 2))  # of the inverse of L
    root[:, 0, 0], root[:, 1, 0], root[:, 1, 1] = 1.0 / l0, -l1 / (l0 * l2), 1.0 / l2
    return np.asarray(0.25 * root @ root.transpose(0, 2, 1))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Areas:
    """Pixels that are not points, but means over their areas: of points in them, by Gauss–Legendre quadrature."""

    #: (m,) which of the pixels
    pixels: IntArray
    #: (s,) weights of the points in each
    weights: FloatArray

    @classmethod
    def within(cls, u: FloatArray, v: FloatArray, radius: float) -> tuple[Areas, FloatArray, FloatArray]:
        """Those pixels (p,) not farther from the origin; coordinates (p + m · s,) of all pixels, then of the points."""
        nodes, weights = np.polynomial.legendre.leggauss(POINTS)
        step_v, step_u = (axis.ravel() for axis in np.meshgrid(0.5 * nodes, 0.5 * nodes, indexing="ij"))
        near = np.flatnonzero(np.hypot(u, v) <= radius)
        points = [np.concatenate([x, (x[near, None] + step).ravel()]) for x, step in ((u, step_u), (v, step_v))]
        return cls(pixels=near, weights=0.25 * np.outer(weights, weights).ravel()), points[0], points[1]


class Rows:
    """Weighted residuals and derivatives of ``k`` profiles at the ``p`` pixels of their windows.

    Every number is multiplied by the root of its pixel's weight, so that one matrix product makes the normal equations.
    """

    def __init__(
        self,
        u: FloatArray,
        v: FloatArray,
        values: FloatArray,
        clipped: BoolArray | None,
        root_weights: FloatArray,
        long: BoolArray | None = None,
        areas: Areas | None = None,
        *,
        flat: bool = False,
    ) -> None:
        """Take pixel coordinates ``u``, ``v``, ``values``, whether they are ``clipped``, and roots of weights.

        The last three are (k, p); ``clipped`` is None where nothing is. Coordinates are (p,), or where some of the
        spots (k,) are ``long`` (k, p), of those turned so that u runs along the spot. Where some pixels are ``areas``,
        coordinates are (..., p + m · s), those of the points in them last. All are ``flat``, or none.
        """
        self._u, self._v, self._values, self._clipped, self.root_weights = u, v, values, clipped, root_weights
        self.long, self._areas, self.flat = long, areas, flat
        self._long_at = None if long is None else np.flatnonzero(long)
        p = values.shape[1]
        self._pixel_u, self._pixel_v = u[..., :p], v[..., :p]
        if areas is not None:
            self._points = np.empty((N_PARAMETERS + 1, len(values), u.shape[-1]))
        self._weighted_values = values * root_weights
        self._rows = np.empty((N_PARAMETERS + 1, *values.shape))
        self._fill_background()
        #: whether the last evaluation left pixels out, and so cleared them in the constant rows too
        self._has_left_out = False
        #: (k, 11, p): derivatives with respect to the ten steps of :func:`moved`, and in the last row the residuals;
        #: filled anew by every evaluation
        self.by_spot = self._rows.transpose(1, 0, 2)

    @property
    def unusual(self) -> bool:
        """Whether these are spots of which less is known beforehand: sharp or flat ones."""
        return self._areas is not None or self.flat

    @property
    def values(self) -> FloatArray:
        """(k, p) of the pixels."""
        return self._values

    @property
    def cut_off(self) -> BoolArray:
        """(k,) whether pixels of a spot are clipped."""
        if self._clipped is None:
            return np.zeros(len(self._values), dtype=bool)
        return np.asarray(self._clipped.any(axis=1))

    def _fill_background(self) -> None:
        """The derivatives with respect to the background and its gradient, which no parameter changes."""
        self._rows[BACKGROUND] = self.root_weights
        np.multiply(self.root_weights, self._pixel_u, out=self._rows[4])
        np.multiply(self.root_weights, self._pixel_v, out=self._rows[5])

    def take(self, which: IntArray) -> Rows:
        """Some of the spots."""
        clipped = None if self._clipped is None else self._clipped[which]
        turned = self._u.ndim > 1
        u, v = (self._u[which], self._v[which]) if turned else (self._u, self._v)
        long = None if self.long is None else self.long[which]
        return Rows(u, v, self._values[which], clipped, self.root_weights[which], long, self._areas, flat=self.flat)

    def evaluate(self, parameters: FloatArray) -> FloatArray:
        """Fill :attr:`by_spot` for ``parameters`` (10, k); products of its rows with the derivatives, over the pixels.

        These (k, 11, 10) hold the normal matrix, and in the last row the gradient. A clipped pixel says only "at least
        this bright": where the profile is brighter still, it takes no part.
        """
        rows = self._rows
        if self._has_left_out:
            self._fill_background()
        fill = self._fill_edge if self.flat else self._fill_spot
        if self._areas is None:
            fill(rows, parameters, self.root_weights)
        else:
            fill(self._points, parameters, None)
            k, p, at = rows.shape[1], rows.shape[2], self._areas.pixels
            for row in _OF_SPOT:
                rows[row] = self._points[row, :, :p]
                rows[row][:, at] = self._points[row, :, p:].reshape(k, len(at), -1) @ self._areas.weights
                rows[row] *= self.root_weights
        background, g_u, g_v = parameters[BACKGROUND : GRADIENT.stop, :, None]
        spot = rows[LOG_HEIGHT]
        residuals = np.subtract(self._weighted_values, spot, out=rows[-1])
        residuals -= background * rows[BACKGROUND]
        residuals -= g_u * rows[4]
        residuals -= g_v * rows[5]
        if self._clipped is not None:
            satisfied = np.flatnonzero(self._clipped & (residuals <= 0))
            rows.reshape(len(rows), -1)[:, satisfied] = 0.0
            self._has_left_out = len(satisfied) > 0
        # without the last row on one side: a matrix times its own transpose takes BLAS three times as long at this size
        return np.asarray(self.by_spot @ rows[:N_PARAMETERS].transpose(1, 2, 0))

    def _fill_edge(self, rows: FloatArray, parameters: FloatArray, root_weights: FloatArray | None) -> None:
        """The same of spots of thick rods: flat but for an edge that is blurred."""
        from scipy.special import erfc

        centre_u, centre_v, log_height, _, _, _, _, l1, _, _ = parameters[:, :, None]
        scale_u, _, scale_v, beta = np.exp(parameters[SHAPE.start :, :, None])
        x = self._u - centre_u
        xi = scale_u * x
        eta = l1 * x + scale_v * (self._v - centre_v)
        rho = np.sqrt(xi * xi + eta * eta + _TINY)
        sharpness = _EDGE * beta
        height = np.exp(log_height) if root_weights is None else np.exp(log_height) * root_weights
        beyond = sharpness * (rho - 1.0)
        rows[LOG_HEIGHT] = 0.5 * height * erfc(beyond)
        slope = height * np.exp(-beyond * beyond) * (-1.0 / np.sqrt(np.pi))
        rows[FLATNESS] = slope * beyond
        slope *= sharpness / rho
        d_xi = np.multiply(slope, xi, out=rows[0])
        d_eta = np.multiply(slope, eta, out=rows[1])
        np.multiply(d_xi, xi, out=rows[6])
        np.multiply(d_eta, xi, out=rows[7])
        np.multiply(d_eta, eta, out=rows[8])

    def _fill_spot(self, rows: FloatArray, parameters: FloatArray, root_weights: FloatArray | None) -> None:
        """Fill the ``rows`` (11, k, ...) of the spots' own derivatives, multiplied by ``root_weights``."""
        centre_u, centre_v, log_height, _, _, _, _, l1, _, _ = parameters[:, :, None]
        scale_u, _, scale_v, beta = np.exp(parameters[SHAPE.start :, :, None])
        x = self._u - centre_u
        xi = scale_u * x
        eta = self._v - centre_v
        eta *= scale_v
        x *= l1
        eta += x
        q = xi * xi
        # all powers and logarithms of pixels are to base 2: exp2 costs less than exp
        at = self._long_at
        if at is not None:
            square, gamma = q.take(at, axis=0), beta.take(at, axis=0)
            square += _TINY
            log2_along = np.log2(square)
            along = np.exp2(gamma * log2_along)
            gamma_along = gamma * along
            q[at], beta[at] = along, LONG_BETA
        q += eta * eta
        q += _TINY
        log2_q = np.log2(q)
        steepness = beta * log2_q
        np.exp2(steepness, out=steepness)
        spot = np.subtract(log_height / _LN2, steepness, out=rows[LOG_HEIGHT])
        np.exp2(spot, out=spot)
        if root_weights is not None:
            spot *= root_weights
        steepness *= spot
        steepness *= -2.0 * _LN2 * beta
        log2_q *= 0.5 * _LN2
        np.multiply(steepness, log2_q, out=rows[FLATNESS])
        steepness /= q  # ∂I/∂q, with the 2 of ∂q/∂ξ = 2ξ
        d_xi = np.multiply(steepness, xi, out=rows[0])
        if at is not None:
            d_xi[at] *= gamma_along / square  # ∂q/∂ξ = 2ξ γ (ξ²)^(γ − 1) there
            gamma_along *= log2_along
            gamma_along *= 0.5 * _LN2
            gamma_along *= steepness.take(at, axis=0)
            rows[FLATNESS, at] = gamma_along
        d_eta = np.multiply(steepness, eta, out=rows[1])
        np.multiply(d_xi, xi, out=rows[6])
        np.multiply(d_eta, xi, out=rows[7])
        np.multiply(d_eta, eta, out=rows[8])
