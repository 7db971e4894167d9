"""Long spots: a tilted rod in a thick slab, or two rods that run into one.

Both are seen along their own axes, where the plateau's flatness γ of :mod:`.profile` tells them apart: a slab blurs a
rod evenly along its way, so that γ goes with the ratio of the axes; two rods make the top flatter, or hollow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctreg_cli.arrays import BoolArray, FloatArray, IntArray
from ctreg_cli.imaging.blob import Blobs
from ctreg_cli.imaging.profile import FLATNESS, SHAPE

#: a spot of this ratio of axes is long
LONG_RATIO = 1.5
#: ln γ of a rod in a slab: so many times the log of its ratio of axes over this one (fitted to rendered rods)
ROD_SLOPE, ROD_FROM = 0.8, 1.4
#: ln γ of two rods: so many times what their ratio of axes exceeds this one (fitted to rendered rods)
PAIR_SLOPE, PAIR_FROM = 0.95, 1.27
#: how well both laws hold: sd of ln γ, and of where a spot stands between them (0 one rod, 1 two)
LAW_SD, BETWEEN_SD = 0.06, 0.15
#: odds, before its shape is looked at, that a long spot is two rods
PAIR_ODDS = 1e-3
#: variance of where one of two rods lies along their spot, in what its long axis exceeds the short one, both squared
PAIR_SHARE = 0.4
#: odds are not reckoned beyond e to this
_MOST = 50.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LongSpots:
    """Which of ``k`` spots are long, and how they are turned upon their axes; all others stay as they are."""

    #: (k,)
    mask: BoolArray
    #: (m,) the same as indices
    index: IntArray
    #: (m, 2, 2) rotations: image → along and across the spot
    turn: FloatArray

    @classmethod
    def of(cls, blobs: Blobs) -> LongSpots:
        """By the moments of the half-height regions."""
        major, minor, angle = blobs.axes
        mask = major > LONG_RATIO * minor
        cos, sin = np.cos(angle[mask]), np.sin(angle[mask])
        return cls(
            mask=mask, index=np.flatnonzero(mask), turn=np.stack([cos, sin, -sin, cos], axis=1).reshape(-1, 2, 2)
        )

    def __len__(self) -> int:
        return len(self.index)

    def coordinates(self, u: FloatArray, v: FloatArray) -> FloatArray:
        """Coordinates (2, p) of pixels as every spot sees them: (2, k, p)."""
        seen = np.repeat(np.stack([u, v])[:, None], len(self.mask), axis=1)
        seen[:, self.index] = (self.turn @ np.stack([u, v])).transpose(1, 0, 2)
        return seen

    def turned(self, vectors: FloatArray) -> FloatArray:
        """Vectors (2, k) of the image along and across the spots."""
        result = vectors.copy()
        result[:, self.index] = np.einsum("mij,jm->im", self.turn, vectors[:, self.index])
        return result

    def turned_moments(self, moments: FloatArray) -> FloatArray:
        """Second moments (k, 2, 2) along and across the spots."""
        result = moments.copy()
        result[self.index] = self.turn @ moments[self.index] @ self.turn.transpose(0, 2, 1)
        return result

    def turned_back(self, vectors: FloatArray) -> FloatArray:
        """Vectors (2, k, ...) along and across the spots in the image."""
        result = vectors.copy()
        result[:, self.index] = np.einsum("mji,jm...->im...", self.turn, vectors[:, self.index])
        return result

    def pair_covariance(self, parameters: FloatArray, variance: FloatArray) -> FloatArray:
        """What the centres (m, 2, 2), px², owe to the chance that the long spots are two rods each.

        Args:
            parameters: (10, k), fitted.
            variance: (k,) of ln γ among them.
        """
        fitted = parameters[:, self.index]
        along, across = np.exp(-fitted[SHAPE][0]), np.exp(-fitted[SHAPE][2])
        ratio = along / across
        rod = rod_flatness(ratio)
        gap = np.maximum(PAIR_SLOPE * (ratio - PAIR_FROM) - rod, 0.1)
        place = (fitted[FLATNESS] - rod) / gap
        place_variance = (variance[self.index] + LAW_SD**2) / gap**2 + BETWEEN_SD**2
        odds = PAIR_ODDS * np.exp(np.minimum((place - 0.5) / place_variance, _MOST))
        spread = odds / (1.0 + odds) * PAIR_SHARE * np.maximum(along**2 - across**2, 0.0)
        axis = self.turn[:, 0]
        return np.asarray(spread[:, None, None] * axis[:, :, None] * axis[:, None, :])


def rod_flatness(ratio: FloatArray) -> FloatArray:
    """ln γ (k,) of a tilted rod in a slab whose spot has this ratio of its axes (k,)."""
    return np.asarray(ROD_SLOPE * np.log(np.maximum(ratio / ROD_FROM, 1.0)))
