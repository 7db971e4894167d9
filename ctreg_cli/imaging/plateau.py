"""Long spots: a tilted rod in a thick slab, or two rods that run into one.

Both are seen along their own axes, where the plateau's flatness γ of :mod:`.profile` tells them apart: a slab blurs a
rod evenly along its way, so that γ goes with the ratio of the axes; two rods make the top flatter, or hollow, or
brighter at one end.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctreg_cli.arrays import BoolArray, FloatArray, IntArray
from ctreg_cli.imaging.blob import Blobs, axes_of
from ctreg_cli.imaging.profile import FLATNESS, N_PARAMETERS, SHAPE

#: a spot of this ratio of axes is long
LONG_RATIO = 1.4
#: ln γ of a rod in a slab: so many times the log of its ratio of axes over this one, and bent into 0 below it (fitted
#: to rendered rods, as all of this)
ROD_SLOPE, ROD_FROM, ROD_BEND = 0.8, 1.4, 12
#: ln γ of two like rods: so many times what their ratio of axes exceeds this one; and the least difference looked at
PAIR_SLOPE, PAIR_FROM, LEAST_GAP = 0.95, 1.27, 0.1
#: how much the spot of two rods leans to one end, where one is half as bright as the other; rods in streaks lean by 0.1
PAIR_LEAN = 0.2
#: how well these laws hold: sd of ln γ, of the lean, and of where a spot stands between one rod and two
FLATNESS_SD, LEAN_SD, BETWEEN_SD = 0.03, 0.03, 0.12
#: odds, before its shape is looked at, that a long spot is two rods; logs of odds are not reckoned beyond
PAIR_ODDS, MOST_LOG_ODDS = 1e-3, 50.0
#: variance of where one of two rods lies along their spot, in what its long axis exceeds the short one, both squared;
#: and across it, in that along it
PAIR_SHARE, ASIDE = 0.4, 0.01


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LongSpots:
    """Which of ``k`` spots are long, and how they are turned upon their axes; all others stay as they are."""

    #: (k,)
    mask: BoolArray
    #: (m,) the same as indices
    index: IntArray
    #: (k, 2, 2) rotations: image → along and across the spot, or for those that are not long, none
    rotation: FloatArray

    @classmethod
    def of(cls, blobs: Blobs) -> LongSpots:
        """By the moments of the half-height regions."""
        return cls.of_moments(blobs.moments)

    @classmethod
    def none(cls, k: int) -> LongSpots:
        """None of ``k`` is long."""
        return cls.of_moments(np.broadcast_to(np.eye(2), (k, 2, 2)))

    @classmethod
    def of_moments(cls, moments: FloatArray) -> LongSpots:
        """By second moments (k, 2, 2)."""
        major, minor, angle = axes_of(moments)
        mask = major > LONG_RATIO * minor
        angle = np.where(mask, angle, 0.0)
        cos, sin = np.cos(angle), np.sin(angle)
        return cls(
            mask=mask, index=np.flatnonzero(mask), rotation=np.stack([cos, sin, -sin, cos], axis=1).reshape(-1, 2, 2)
        )

    def __len__(self) -> int:
        return len(self.index)

    def take(self, which: BoolArray | IntArray) -> LongSpots:
        """Of some of the spots."""
        mask = self.mask[which]
        return LongSpots(mask=mask, index=np.flatnonzero(mask), rotation=self.rotation[which])

    def replaced(self, at: IntArray, by: LongSpots) -> LongSpots:
        """The same but for the spots at the indices ``at``."""
        mask, rotation = self.mask.copy(), self.rotation.copy()
        mask[at], rotation[at] = by.mask, by.rotation
        return LongSpots(mask=mask, index=np.flatnonzero(mask), rotation=rotation)

    def joined(self, other: LongSpots) -> LongSpots:
        """Of these spots and others."""
        mask = np.concatenate([self.mask, other.mask])
        rotation = np.concatenate([self.rotation, other.rotation])
        return LongSpots(mask=mask, index=np.flatnonzero(mask), rotation=rotation)

    def coordinates(self, u: FloatArray, v: FloatArray) -> FloatArray:
        """Coordinates (2, p) of pixels as every spot sees them: (2, k, p)."""
        seen: FloatArray = (self.rotation @ np.stack([u, v])).transpose(1, 0, 2)
        return seen

    def turned(self, vectors: FloatArray) -> FloatArray:
        """Vectors (2, k) of the image along and across the spots."""
        result: FloatArray = (self.rotation @ vectors.T[:, :, None])[:, :, 0].T
        return result

    def turned_moments(self, moments: FloatArray) -> FloatArray:
        """Second moments (k, 2, 2) along and across the spots."""
        return np.asarray(self.rotation @ moments @ self.rotation.transpose(0, 2, 1))

    def turned_back(self, vectors: FloatArray) -> FloatArray:
        """Vectors (2, k) or (2, k, p) along and across the spots in the image."""
        by_spot = vectors.reshape(2, len(self.mask), -1).transpose(1, 0, 2)
        back = self.rotation.transpose(0, 2, 1) @ by_spot
        return np.asarray(back.transpose(1, 0, 2)).reshape(vectors.shape)

    def pair_covariance(self, parameters: FloatArray, by_spot: FloatArray, normal: FloatArray) -> FloatArray:
        """What the centres (m, 2, 2), px², owe to the chance that the long spots are two rods each.

        Args:
            parameters: (10, k), fitted.
            by_spot: (k, 11, p) derivatives and residuals there, as :class:`.profile.Rows` has them.
            normal: (k, 10, 10) matrices of the fit.
        """
        fitted, normal = parameters[:, self.index], normal[self.index]
        derivatives, residuals = by_spot[self.index, :-1], by_spot[self.index, -1]
        along, across = np.exp(-fitted[SHAPE][0]), np.exp(-fitted[SHAPE][2])
        ratio = along / across
        variance, lean, lean_variance = _flatness_and_lean(derivatives, residuals, normal)
        rod = rod_flatness(ratio)
        gap = np.maximum(PAIR_SLOPE * (ratio - PAIR_FROM) - rod, LEAST_GAP)
        log_odds = np.maximum(
            _log_odds((fitted[FLATNESS] - rod) / gap, (variance + FLATNESS_SD**2) / gap**2),
            _log_odds(np.abs(lean) / PAIR_LEAN, (lean_variance + LEAN_SD**2) / PAIR_LEAN**2),
        )
        spread = PAIR_SHARE * np.maximum(along**2 - across**2, 0.0) / (1.0 + np.exp(-log_odds) / PAIR_ODDS)
        axis = np.stack([np.ones(len(self)), -fitted[SHAPE][1] * across], axis=1)  # where η = 0
        axis = np.einsum("mji,mj->mi", self.rotation[self.index], axis / np.linalg.norm(axis, axis=1, keepdims=True))
        shape = axis[:, :, None] * axis[:, None, :] + ASIDE * np.eye(2)
        return np.asarray(spread[:, None, None] * shape)


def rod_flatness(ratio: FloatArray) -> FloatArray:
    """ln γ (k,) of a tilted rod in a slab whose spot has this ratio of its axes (k,)."""
    return np.asarray(ROD_SLOPE / ROD_BEND * np.log1p((ratio / ROD_FROM) ** ROD_BEND))


def _log_odds(place: FloatArray, variance: FloatArray) -> FloatArray:
    """Log (k,) of how much better two rods explain a spot than one, that stands at ``place`` between 0, one, and 1."""
    return np.asarray(np.clip((place - 0.5) / (variance + BETWEEN_SD**2), -MOST_LOG_ODDS, MOST_LOG_ODDS))


def _flatness_and_lean(
    derivatives: FloatArray, residuals: FloatArray, normal: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Variance (m,) of ln γ; how far (m,) one end is the brighter one; and its variance.

    The lean is the step, not taken in the fit, that shifts the contours by ``ξ²`` times itself: rods in a slab have
    none, and two unlike rods have much.
    """
    d_xi, d_xi_xi = derivatives[:, 0], derivatives[:, SHAPE.start]
    template = np.divide(d_xi_xi**2, d_xi, out=np.zeros_like(d_xi), where=np.abs(d_xi) > 1e-12)
    wanted = np.zeros((len(normal), N_PARAMETERS, 2))
    wanted[:, FLATNESS, 0] = 1.0
    wanted[:, :, 1] = np.einsum("mip,mp->mi", derivatives, template)
    solved = np.linalg.solve(normal, wanted)
    template -= np.einsum("mip,mi->mp", derivatives, solved[:, :, 1])
    power = np.maximum((template**2).sum(axis=1), 1e-12)
    lean: FloatArray = (template * residuals).sum(axis=1) / power
    return np.asarray(solved[:, FLATNESS, 0]), lean, 1.0 / power
