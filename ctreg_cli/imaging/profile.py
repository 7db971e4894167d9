"""What a spot looks like: a blurred, flat-topped ellipse on a tilted background, cut off where the scanner clips.

``I(x) = a · 2^(−q^β) + b + g · x`` with ``q = |ξ|²``, ``ξ = L (x − c)``: ``q = 1`` is the contour of half height, β = 1
a Gaussian (a rod thinner than the blur), larger β the flatter top of a thick rod or of a tilted one in a thick slab.
The profile is even about its centre, so that no error in its shape can move the centre.

A tilted rod in a thick slab leaves a plateau with blurred ends, which no such ellipse resembles. Of long spots, seen
along their own axes, ``q = |ξ|^2γ + |η|²`` instead, β fixed: γ = 1 is the ellipse, larger γ the longer plateau.

Parameters are (10, k), a row each. Steps of a fit are taken in the spot's own coordinates, where the derivatives are
products of ξ and η and all spots look alike: see :func:`moved`.
"""

from __future__ import annotations

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

_LN2 = float(np.log(2.0))
#: keeps ln q finite at the very centre; (px/px)²
_TINY = 1e-9
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
    ) -> None:
        """Take pixel coordinates ``u``, ``v``, ``values``, whether they are ``clipped``, and roots of weights.

        The last three are (k, p); ``clipped`` is None where nothing is. Coordinates are (p,), or where some of the
        spots (k,) are ``long`` (k, p), of those turned so that u runs along the spot.
        """
        self._u, self._v, self._values, self._clipped, self.root_weights = u, v, values, clipped, root_weights
        self.long = long
        self._long_at = None if long is None else np.flatnonzero(long)
        self._weighted_values = values * root_weights
        self._rows = np.empty((N_PARAMETERS + 1, *values.shape))
        self._fill_background()
        #: whether the last evaluation left pixels out, and so cleared them in the constant rows too
        self._has_left_out = False
        #: (k, 11, p): derivatives with respect to the ten steps of :func:`moved`, and in the last row the residuals;
        #: filled anew by every evaluation
        self.by_spot = self._rows.transpose(1, 0, 2)

    @property
    def cut_off(self) -> BoolArray:
        """(k,) whether pixels of a spot are clipped."""
        if self._clipped is None:
            return np.zeros(len(self._values), dtype=bool)
        return np.asarray(self._clipped.any(axis=1))

    def _fill_background(self) -> None:
        """The derivatives with respect to the background and its gradient, which no parameter changes."""
        self._rows[BACKGROUND] = self.root_weights
        np.multiply(self.root_weights, self._u, out=self._rows[4])
        np.multiply(self.root_weights, self._v, out=self._rows[5])

    def take(self, which: IntArray) -> Rows:
        """Some of the spots."""
        clipped = None if self._clipped is None else self._clipped[which]
        turned = self._u.ndim > 1
        u, v = (self._u[which], self._v[which]) if turned else (self._u, self._v)
        long = None if self.long is None else self.long[which]
        return Rows(u, v, self._values[which], clipped, self.root_weights[which], long)

    def evaluate(self, parameters: FloatArray) -> FloatArray:
        """Fill :attr:`by_spot` for ``parameters`` (10, k); products of its rows (k, 11, 11), summed over the pixels.

        These hold the normal matrix, in the last column the gradient, in the last place the sum of squares. A clipped
        pixel says only "at least this bright": where the profile is brighter still, it takes no part.
        """
        rows = self._rows
        if self._has_left_out:
            self._fill_background()
        centre_u, centre_v, log_height, background, g_u, g_v, _, l1, _, _ = parameters[:, :, None]
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
        spot *= self.root_weights
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
        residuals = np.subtract(self._weighted_values, spot, out=rows[-1])
        residuals -= background * rows[BACKGROUND]
        residuals -= g_u * rows[4]
        residuals -= g_v * rows[5]
        if self._clipped is not None:
            satisfied = np.flatnonzero(self._clipped & (residuals <= 0))
            rows.reshape(len(rows), -1)[:, satisfied] = 0.0
            self._has_left_out = len(satisfied) > 0
        return np.asarray(self.by_spot @ rows.transpose(1, 2, 0))
