"""What a spot looks like: a blurred, flat-topped ellipse on a tilted background, cut off where the scanner clips.

``I(x) = a · 2^(−q^β) + b + g · x`` with ``q = |L (x − c)|²``: ``q = 1`` is the contour of half height, β = 1 a Gaussian
(a rod thinner than the blur), larger β the flatter top of a thick rod or of a tilted one in a thick slab. The profile
is even about its centre, so that no error in its shape can move the centre.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from ctreg_cli.arrays import BoolArray, FloatArray

#: order of the parameters (k, 10): centre u, v; ln a; b; g_u, g_v; L = [[e^l0, 0], [l1, e^l2]]; ln β
CENTRE: Final = slice(0, 2)
LOG_HEIGHT: Final = 2
BACKGROUND: Final = 3
GRADIENT: Final = slice(4, 6)
SHAPE: Final = slice(6, 9)
LOG_BETA: Final = 9
N_PARAMETERS: Final = 10

_LN2 = float(np.log(2.0))
#: keeps ln q finite at the very centre; (px/px)²
_TINY = 1e-9


def evaluate(
    parameters: FloatArray, u: FloatArray, v: FloatArray, values: FloatArray, clipped: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Residuals (k, p), measured minus profile, and the profile's Jacobian (k, 10, p).

    A clipped pixel says only "at least this bright": where the profile is brighter still, its residual and its row of
    the Jacobian are zero.

    Args:
        parameters: (k, 10), in the order given above.
        u, v: (p,) pixel coordinates.
        values, clipped: (k, p) measured values and whether they are cut off.
    """
    centre_u, centre_v, log_height, background, g_u, g_v, l0, l1, l2, log_beta = parameters.T[:, :, None]
    scale_u, scale_v, beta = np.exp(l0), np.exp(l2), np.exp(log_beta)
    x, y = u - centre_u, v - centre_v
    xi, eta = scale_u * x, l1 * x + scale_v * y
    q = xi * xi + eta * eta + _TINY
    log_q = np.log(q)
    q_beta = np.exp(beta * log_q)
    spot = np.exp(log_height - _LN2 * q_beta)
    residuals = values - (spot + background + g_u * u + g_v * v)
    steepness = _LN2 * beta * spot * q_beta
    d_q = -2 * steepness / q  # ∂I/∂q, with the 2 of ∂q/∂ξ = 2ξ
    d_xi, d_eta = d_q * xi, d_q * eta
    jacobian = np.empty((len(parameters), N_PARAMETERS, u.size))
    jacobian[:, 0] = -(d_xi * scale_u + d_eta * l1)
    jacobian[:, 1] = -d_eta * scale_v
    jacobian[:, LOG_HEIGHT] = spot
    jacobian[:, BACKGROUND] = 1.0
    jacobian[:, 4] = u
    jacobian[:, 5] = v
    jacobian[:, 6] = d_xi * xi
    jacobian[:, 7] = d_eta * x
    jacobian[:, 8] = d_eta * scale_v * y
    jacobian[:, LOG_BETA] = -steepness * log_q
    satisfied = clipped & (residuals <= 0)
    if satisfied.any():
        residuals[satisfied] = 0.0
        jacobian *= ~satisfied[:, None]
    return residuals, jacobian
