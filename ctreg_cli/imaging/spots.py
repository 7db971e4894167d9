"""Spots: where rods (and other bright things) cross a slice."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ctreg_cli.arrays import BoolArray, FloatArray, IntArray, frozen
from ctreg_cli.checks import demand, is_number
from ctreg_cli.errors import InputError

#: standard deviation (px, each coordinate) given to spots that come without one
DEFAULT_SPOT_SD_PX = 0.25

#: relative asymmetry of a covariance that is no mistake
ROUNDING = 1e-9

_ARRAYS = ("uv_px", "covariance_px", "area_px", "contrast", "major_px", "minor_px", "angle_rad")


@dataclass(frozen=True, slots=True, kw_only=True)
class RejectedSpot:
    """A candidate the segmentation looked at and left out, with the reason in one short word_with_underscores."""

    u_px: float
    v_px: float
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Spots:
    """``m`` spots of one slice, in pixel coordinates ``(u, v)`` = (column, row), zero-based, centres on integers.

    Arrays are read-only float64. Unknown values are NaN, but for centres and their covariances, which must be known.
    ``covariance_px`` is that of the centre, not the shape.

    Raises:
        InputError: a centre that is not finite, or a covariance that is none.
        ValueError: an array of another shape.
    """

    #: (m, 2) centres, px
    uv_px: FloatArray
    #: (m, 2, 2) covariance of the centres, px²
    covariance_px: FloatArray
    #: (m,) area above half height, px
    area_px: FloatArray = field(default_factory=lambda: np.empty(0))
    #: (m,) peak above the local background, in the image's units (HU)
    contrast: FloatArray = field(default_factory=lambda: np.empty(0))
    #: (m,) full length at half height along the long and the short axis, px, and the long axis' angle from +u towards
    #: +v, rad
    major_px: FloatArray = field(default_factory=lambda: np.empty(0))
    minor_px: FloatArray = field(default_factory=lambda: np.empty(0))
    angle_rad: FloatArray = field(default_factory=lambda: np.empty(0))
    #: True where the sd was not measured but assumed (``DEFAULT_SPOT_SD_PX`` or ``--spot-sd``)
    sd_assumed: bool = False
    rejected: tuple[RejectedSpot, ...] = ()
    #: reason → how many were rejected; those of ``rejected`` where nothing else is said
    n_rejected: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        uv = frozen(self.uv_px, (None, 2))
        m = len(uv)
        set_(self, "uv_px", uv)
        set_(self, "covariance_px", frozen(self.covariance_px, (m, 2, 2)))
        self._check()
        for name in _ARRAYS[2:]:
            values = getattr(self, name)
            set_(self, name, frozen(values if len(values) else np.full(m, np.nan), (m,)))
        if self.rejected and not self.n_rejected:
            set_(self, "n_rejected", dict(Counter(spot.reason for spot in self.rejected)))

    def _check(self) -> None:
        for spot, (u, v) in enumerate(self.uv_px.tolist()):
            if not (math.isfinite(u) and math.isfinite(v)):
                raise InputError(
                    f"uv_px: spot {spot} has the centre {[u, v]}; give finite numbers, or leave the spot out"
                )
        # plain numbers: for a few spots a third of what arrays cost
        for spot, ((a, b), (c, d)) in enumerate(self.covariance_px.tolist()):
            is_symmetric = abs(b - c) <= ROUNDING * (a + d)
            if not (is_symmetric and a + d > math.hypot(a - d, b + c) and a + d < math.inf):
                raise InputError(
                    f"covariance_px: spot {spot} has {[[a, b], [c, d]]}; give a symmetric positive definite matrix in "
                    "px², or make spots of unknown accuracy with Spots.from_points"
                )

    def __len__(self) -> int:
        return len(self.uv_px)

    @classmethod
    def from_points(cls, uv_px: FloatArray, sd_px: float = DEFAULT_SPOT_SD_PX) -> Spots:
        """Spots known only by their centres (m, 2), all with the same assumed standard deviation (px)."""
        demand(is_number(sd_px) and sd_px > 0, "sd_px", sd_px, "a positive number of pixels")
        uv = np.asarray(uv_px, dtype=np.float64).reshape(-1, 2)
        return cls(uv_px=uv, covariance_px=np.tile(np.eye(2) * sd_px**2, (len(uv), 1, 1)), sd_assumed=True)

    @classmethod
    def without_error(cls, uv_px: FloatArray) -> Spots:
        """Centres (m, 2) that are the truth: to be written down, not to be registered."""
        m = len(uv_px)
        unknown: dict[str, Any] = {name: np.full(m, np.nan) for name in _ARRAYS[2:]}
        return cls.of_own(uv_px=frozen(uv_px, (None, 2)), covariance_px=np.zeros((m, 2, 2)), **unknown)

    @classmethod
    def of_own(
        cls,
        *,
        sd_assumed: bool = False,
        rejected: tuple[RejectedSpot, ...] = (),
        n_rejected: Mapping[str, int] | None = None,
        **arrays: FloatArray,
    ) -> Spots:
        """Spots of all arrays above that are nobody else's, float64 and of their shapes: taken over, neither copied nor
        checked.
        """
        spots, set_ = object.__new__(cls), object.__setattr__
        for name, values in arrays.items():
            values.flags.writeable = False
            set_(spots, name, values)
        set_(spots, "sd_assumed", sd_assumed)
        set_(spots, "rejected", rejected)
        set_(spots, "n_rejected", n_rejected or {})
        return spots

    def take(self, which: BoolArray | IntArray) -> Spots:
        """Some of the spots; the rejected candidates stay."""
        arrays = {name: getattr(self, name)[which] for name in _ARRAYS}
        return Spots.of_own(**arrays, sd_assumed=self.sd_assumed, rejected=self.rejected, n_rejected=self.n_rejected)

    def with_rejected(self, rejected: tuple[RejectedSpot, ...], n_rejected: Mapping[str, int]) -> Spots:
        """The same spots, with what was left out."""
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        return Spots.of_own(**arrays, sd_assumed=self.sd_assumed, rejected=rejected, n_rejected=n_rejected)

    def joined(self, other: Spots) -> Spots:
        """These spots and others of the same slice, all measured."""
        arrays: dict[str, Any] = {name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in _ARRAYS}
        return Spots.of_own(
            **arrays,
            rejected=(*self.rejected, *other.rejected),
            n_rejected=Counter(self.n_rejected) + Counter(other.n_rejected),
        )

    @property
    def sd_px(self) -> FloatArray:
        """(m, 2) standard deviations of u and v."""
        sd: FloatArray = np.sqrt(np.diagonal(self.covariance_px, axis1=1, axis2=2))
        return sd
