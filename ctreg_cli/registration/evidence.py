"""How much a match is worth: its Bayesian odds against chance.

As astrometry.net decides whether it has recognised a field of stars (Lang et al. 2010), a match is accepted for its
odds, not for its residual. The two stories told about ``m`` spots in the frame's neighbourhood of area ``A``:

* *chance*: all are clutter, scattered at an unknown density (Jeffreys' prior on it, integrated out);
* *the frame is here*: at pose θ, ``n`` of the rods the slice cuts were seen (each with probability ``p``), with
residuals
  ``r_i ~ N(0, S_i)``; ``q`` were not; the other ``m − n`` spots are clutter.

The pose is integrated out over its prior by Laplace's method, which charges a match for every pose it could have had:

    ln E = ln π(θ) + 3 ln 2π + ½ ln|C| + Σ_i [ln p − ½ r_iᵀ S_i⁻¹ r_i − ln 2π − ½ ln|S_i|]
           + n ln A + ln Γ(m − n + ½) − ln Γ(m + ½) + q ln(1 − p)

with C the pose covariance, no wider than the prior where the spots leave a direction open, and π(θ) the prior density
(uniform in position over the searched field; rotation: see :class:`PosePrior`). ``Γ(m + ½)/Γ(m − n + ½)`` is the number
of ways to pick the n spots. Under *chance* the sum of E over all matches and poses has the mean 1, so by Markov's
inequality a slice of pure clutter reaches ln E > x with a probability of at most exp(−x); ``benchmarks/accuracy.py``
measures it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

from ctreg_cli.arrays import BoolArray, FloatArray, IntArray
from ctreg_cli.geometry.pose import rotation_angle
from ctreg_cli.registration.refine import Linearisation
from ctreg_cli.rods import RodModel

#: probability that a rod the slice cuts leaves a spot the segmentation finds
P_SEEN = 0.8
#: the same for a rod that crosses the slice beside another that left one
P_RESOLVED = 0.5
#: clutter fainter than this share of the faintest matched spot is not mistaken for a rod: rods are of one metal
_FAINTER = 0.75
#: how far Laplace's method may carry a rotation that the spots leave open
_WIDEST_TURN_RAD = 0.3
#: radius of the frame's neighbourhood, in units of the farthest crossing from their centre
_NEIGHBOURHOOD = 1.25


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PosePrior:
    """What is known of the pose before looking at the spots.

    Either a cone of rotations about a nominal one (the frame's mount), every one in it alike; or nothing but that a
    frame is built to be cut across its rods: the tilt of their common axis against the slice normal is small more often
    than not. Any other pose stays possible.
    """

    #: (3, 3) nominal rotation model → slice; None: any
    rotation: FloatArray | None = None
    max_angle_rad: float = math.pi
    #: (3,) the rods' common axis in the model, and how common it is: 0 (rods in all directions) to 1 (all parallel)
    axis: FloatArray | None = None
    axis_share: float = 0.0

    @classmethod
    def of_rods(cls, directions: FloatArray) -> PosePrior:
        """The prior of a frame without a mount, from its rods' directions (n, 3)."""
        values, vectors = np.linalg.eigh(directions.T @ directions / len(directions))
        share = max(0.0, (float(values[-1]) - 1 / 3) * 1.5)
        return cls(axis=vectors[:, -1], axis_share=share)

    def log_density(self, R: FloatArray) -> FloatArray:
        """ln of the prior density (...,) per rad³ at rotations (..., 3, 3)."""
        if self.rotation is not None:
            volume = 8 * math.pi * (self.max_angle_rad - math.sin(self.max_angle_rad))
            return np.full(R.shape[:-2], -math.log(volume))
        uniform = np.full(R.shape[:-2], 1.0)
        if self.axis is not None:
            tilt = np.arccos(np.clip(np.abs(R[..., 2, :] @ self.axis), 0, 1))
            share = self.axis_share * _UPRIGHT_SHARE
            uniform = (1 - share) + share * np.exp(-0.5 * (tilt / _UPRIGHT_SD_RAD) ** 2) / _UPRIGHT_MEAN
        density: FloatArray = np.log(uniform) - math.log(8 * math.pi**2)
        return density

    def allows(self, R: FloatArray) -> BoolArray:
        """Which rotations (..., 3, 3) lie within the cone."""
        if self.rotation is None:
            return np.ones(R.shape[:-2], dtype=bool)
        inside: BoolArray = rotation_angle(R @ self.rotation.T) <= self.max_angle_rad
        return inside


#: how often a frame of parallel rods is cut across them, and how steeply then
_UPRIGHT_SHARE, _UPRIGHT_SD_RAD = 0.9, 0.45
_tilts = np.linspace(0, math.pi / 2, 2001)
#: mean of the bell over the sphere, so that the density stays one
_UPRIGHT_MEAN = float(np.mean(np.exp(-0.5 * (_tilts / _UPRIGHT_SD_RAD) ** 2) * np.sin(_tilts)) * math.pi / 2)


def widest_information(size_mm: float) -> FloatArray:
    """(6, 6) information of the widest that a pose may be: about a frame's size, and a tilt; mm and rad.

    A direction the spots say nothing of is as wide as the prior, not 10⁶.
    """
    return np.diag([size_mm**-2.0] * 3 + [_WIDEST_TURN_RAD**-2.0] * 3)


def log_odds(
    model: RodModel,
    prior: PosePrior,
    spots_mm: FloatArray,
    T: FloatArray,
    fit: Linearisation,
    matched: BoolArray,
    expected: BoolArray,
    *,
    brightness: FloatArray | None = None,
    spot_of_rod: IntArray | None = None,
    merged: BoolArray | None = None,
    log_prior_density: FloatArray | None = None,
) -> FloatArray:
    """ln E (b,) of ``b`` refined hypotheses, in slice millimetres.

    Args:
        model: the rods.
        prior: what is known of the pose.
        spots_mm: (m, 2) every spot of the slice, mm.
        T: (b, 4, 4) refined poses.
        fit: their linearisation, in millimetres.
        matched: (b, n) rods with a spot.
        expected: (b, n) rods that would have to be seen, matched or not.
        brightness: (m,) contrast of every spot, where it was measured, with
        spot_of_rod: (b, n) the spot of each rod: clutter much fainter than any matched spot could not have been taken
        for it,
            and does not count.
        merged: (b, n) rods without a spot that cross so near a matched one that the two may have left one spot.
        log_prior_density: (b,) ln π(θ) where a prediction says more than ``prior`` (tracking), per mm³ rad³.
    """
    crossing = fit.predicted_px
    seen = matched | expected
    n_seen = np.maximum(seen.sum(axis=1), 1)
    usable = seen & np.isfinite(crossing).all(axis=-1)
    crossing = np.where(usable[..., None], crossing, 0.0)
    centre = crossing.sum(axis=1) / n_seen[:, None]
    reach = np.where(usable, np.linalg.norm(crossing - centre[:, None], axis=-1), 0).max(axis=1)
    reach = _NEIGHBOURHOOD * np.maximum(reach, 1e-3 * model.size_mm)
    near = np.linalg.norm(spots_mm[None] - centre[:, None], axis=-1) <= reach[:, None]
    if brightness is not None and spot_of_rod is not None:
        faintest = np.where(matched, brightness[spot_of_rod], np.inf).min(axis=1)
        near &= brightness >= _FAINTER * faintest[:, None]
    n = matched.sum(axis=1)
    m = np.maximum(near.sum(axis=1), n)
    area = math.pi * reach**2
    extent = np.ptp(spots_mm, axis=0) if len(spots_mm) else np.zeros(2)
    field = np.maximum(area, float(extent[0] * extent[1]))

    H, _ = fit.normal_equations()
    _, log_information = np.linalg.slogdet(H + widest_information(model.size_mm))
    log_prior = prior.log_density(T[:, :3, :3]) - np.log(field * 2 * model.size_mm)
    if log_prior_density is not None:
        log_prior = log_prior_density
    volume = np.minimum(log_prior + 3 * math.log(2 * math.pi) - 0.5 * log_information, 0.0)

    det_w = fit.weight[..., 0, 0] * fit.weight[..., 1, 1] - fit.weight[..., 0, 1] * fit.weight[..., 1, 0]
    per_spot = np.where(
        matched, math.log(P_SEEN) - math.log(2 * math.pi) + 0.5 * np.log(np.where(det_w > 0, det_w, 1)), 0
    )
    missed = (expected & ~matched).sum(axis=1) * math.log(1 - P_SEEN)
    if merged is not None:
        missed = missed + merged.sum(axis=1) * math.log(1 - P_RESOLVED)
    result: FloatArray = (
        volume
        + per_spot.sum(axis=1)
        - 0.5 * fit.chi2
        + n * np.log(area)
        + gammaln(m - n + 0.5)
        - gammaln(m + 0.5)
        + missed
    )
    return np.where(np.isfinite(result), result, -np.inf)
