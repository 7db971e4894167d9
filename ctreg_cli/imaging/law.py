"""The covariance of fitted centres: one that owns up to streaks.

It has the two parts by which pixels were weighted, noise and structure (:mod:`.uncertainty`), both measured in the
window; added to these is what a steep edge seen in few pixels costs, and of a long spot the chance that it is two rods
(:mod:`.plateau`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctreg_cli.arrays import BoolArray, FloatArray, IntArray
from ctreg_cli.imaging.profile import N_PARAMETERS, SHAPE, in_pixels
from ctreg_cli.imaging.profiles import RIM_PX, Profiles, steepness
from ctreg_cli.imaging.uncertainty import (
    HIDING_SHARE,
    KEPT,
    KEPT_ABOVE_FLOOR,
    at_floor,
    centre_covariance,
    even_variance,
    noise_at_floor,
    noise_field,
    odd_variance,
    odd_variance_above_floor,
    responses,
)

#: what pixels cost a perfect fit: an edge that falls by so much of the height in a pixel shifts the profile by this sd,
#: px, a gentler one by this power of its slope less (measured without noise)
STEEP, STEEP_SD_PX, STEEP_POWER = 0.8, 0.002, 5.5
#: what is left of it where pixels are taken as means over their areas, or tops as flat, px (measured without noise)
SHARP_SD_PX = 0.0005
#: what pixels cost of a spot that is cut off, where its edge falls by so much of the ceiling in a pixel: of such a
#: spot only the sides are seen
CUT, CUT_SD_PX, CUT_POWER = 1.5, 0.0042, 1.2
#: of a spot that is cut off, and that the profile does not fit (a sharp kernel's undershoot), the variance that noise
#: makes grows by this share of what the mean weighted square of its residuals exceeds 1 by
MISFIT_SHARE = 1.2
#: a faint spot's size and height come from the same noise as its centre, which makes it look surer than it is: its
#: variance is twice that of the linear law where it stands out by so many sd of the noise
FAINT_SD = 5.0
#: roots of weights below this share of the greatest are of pixels that were left out of the fit
LEAST_SHARE_OF_WEIGHT = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Law:
    """What noise and structure make of ``k`` fitted centres."""

    #: (3, k, 2, 2), see :func:`ctreg_cli.imaging.uncertainty.responses`
    response: FloatArray
    #: (k,) sd of the noise as a smooth field, and of what differs from pixel to pixel
    smooth: FloatArray
    rough: FloatArray
    #: (k,) variance of what else the background holds evenly, as tissue does
    texture: FloatArray
    #: (k,) factor for faint spots
    faint: FloatArray
    #: (k, 2, 2) covariance that a perfect fit has as well, px²
    least: FloatArray
    #: (k, 2, 2) px²: and what each unit by which the mean weighted square of residuals exceeds 1 adds; zero where
    #: nothing is cut off
    by_misfit: FloatArray

    def covariance(self, structure: FloatArray, misfit: FloatArray) -> FloatArray:
        """(k, 2, 2) px², for a ``structure`` of this variance (k,) about each spot and such residuals ``misfit`` (k,).

        The latter are mean weighted squares.
        """
        return self.scaled(self.made_by(structure), 1.0, misfit)

    def made_by(self, structure: FloatArray) -> FloatArray:
        """(k, 2, 2) px²: what noise, and structure of these variances (k,), make of centres in sure windows."""
        structure = np.maximum(structure, self.texture)
        return centre_covariance(self.response, smooth=self.smooth, rough=self.rough, structure=structure)

    def scaled(self, covariance: FloatArray, factor: FloatArray | float, misfit: FloatArray) -> FloatArray:
        """That ``covariance`` (k, 2, 2) and all else.

        ``factor`` (k,) is by how much worse, in variance, the centres are known now than where the law was measured.
        """
        scaled: FloatArray = covariance * (self.faint * factor)[:, None, None]
        scaled += self.least
        scaled += self.by_misfit * np.maximum(misfit - 1.0, 0.0)[:, None, None]
        return scaled

    def take(self, which: BoolArray | IntArray) -> Law:
        """Of some of the centres."""
        return Law(
            response=self.response[:, which],
            smooth=self.smooth[which],
            rough=self.rough[which],
            texture=self.texture[which],
            faint=self.faint[which],
            least=self.least[which],
            by_misfit=self.by_misfit[which],
        )

    def joined(self, other: Law) -> Law:
        """Of these centres and others."""
        return Law(
            response=np.concatenate([self.response, other.response], axis=1),
            smooth=np.concatenate([self.smooth, other.smooth]),
            rough=np.concatenate([self.rough, other.rough]),
            texture=np.concatenate([self.texture, other.texture]),
            faint=np.concatenate([self.faint, other.faint]),
            least=np.concatenate([self.least, other.least]),
            by_misfit=np.concatenate([self.by_misfit, other.by_misfit]),
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
    hidden = noise_at_floor(fitted.residuals, fitted.rows.values, fitted.quiet, fitted.height)
    hidden[fitted.n_clipped > 0] = 0.0  # what the fit leaves there is the edge's, and counts by itself
    rough, smooth = np.maximum(rough, hidden), np.maximum(smooth, hidden)
    response = responses(influence, radius, length)
    least = _of_pixels(fitted)[:, None, None] * np.eye(2)
    cut = np.flatnonzero(fitted.n_clipped)
    by_misfit = np.zeros_like(least)
    by_misfit[cut] = (MISFIT_SHARE * rough[cut] ** 2)[:, None, None] * response[1, cut]
    if len(long):
        least[long.index] += long.pair_covariance(fitted.parameters, by_spot, fitted.normal)
    # what metal strong enough to be cut off does to its surroundings is no texture: it is looked at next to the spot
    texture = even_variance(fitted.residuals, fitted.quiet, smooth=smooth, rough=rough)
    texture[cut] = 0.0
    return Law(
        response=response,
        smooth=smooth,
        rough=rough,
        texture=texture,
        faint=1.0 + (FAINT_SD * rough / fitted.height) ** 3,
        least=least,
        by_misfit=by_misfit,
    )


def structure_near(fitted: Profiles, rough: FloatArray, radius: int) -> FloatArray:
    """Variance (k,) of the background structure that disturbs fitted centres, beyond noise of sd ``rough`` (k,)."""
    variance = odd_variance(fitted.residuals, fitted.near, fitted.centre, radius, rough) / KEPT
    values, near, quiet = fitted.rows.values, fitted.near, fitted.quiet
    low = at_floor(values, quiet)
    hides = np.count_nonzero(low & near, axis=1) > HIDING_SHARE * np.count_nonzero(near, axis=1)
    if hides.any():
        root_weights = fitted.rows.root_weights
        in_fit = root_weights > LEAST_SHARE_OF_WEIGHT * root_weights.max(axis=1, keepdims=True)
        shown = (near | ~quiet) & ~low & (values < fitted.ceiling) & in_fit
        above = odd_variance_above_floor(fitted.residuals, shown, fitted.centre, radius, rough) / KEPT_ABOVE_FLOOR
        variance = np.where(hides, np.maximum(variance, above), variance)
    return variance


def _of_pixels(fitted: Profiles) -> FloatArray:
    """Variance (k,) of the centre, px², because a steep edge is seen in few pixels, over which it is not averaged."""
    shape = fitted.parameters[SHAPE]
    at_edge, at_ceiling = steepness(fitted.parameters, fitted.long.mask, fitted.ceiling)
    width = np.exp(-np.maximum(shape[0], shape[2]))
    sd = STEEP_SD_PX * np.minimum(at_edge / STEEP, 1.5) ** STEEP_POWER / np.sqrt(width)
    cut_sd = CUT_SD_PX * np.minimum(at_ceiling / CUT, 2.0) ** CUT_POWER
    sd = np.where(fitted.sharp, SHARP_SD_PX, sd)
    sd = np.where(fitted.flat, SHARP_SD_PX, sd)
    cut_sd *= np.where(
        fitted.flat, np.minimum(RIM_PX / width, 1.0) ** 2, 1.0
    )  # of an edge, the longer the rim the less
    return np.asarray(np.where(fitted.n_clipped > 0, np.maximum(sd, cut_sd), sd) ** 2)
