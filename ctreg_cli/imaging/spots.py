"""Spots: where rods (and other bright things) cross a slice."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ctreg_cli.arrays import BoolArray, FloatArray, IntArray, frozen

#: standard deviation (px, each coordinate) given to spots that come without one
DEFAULT_SPOT_SD_PX = 0.25

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

    Arrays are read-only float64. Unknown values are NaN. ``covariance_px`` is that of the centre, not the shape.
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
        for name in _ARRAYS[2:]:
            values = getattr(self, name)
            set_(self, name, frozen(values if len(values) else np.full(m, np.nan), (m,)))
        if self.rejected and not self.n_rejected:
            set_(self, "n_rejected", dict(Counter(spot.reason for spot in self.rejected)))

    def __len__(self) -> int:
        return len(self.uv_px)

    @classmethod
    def from_points(cls, uv_px: FloatArray, sd_px: float = DEFAULT_SPOT_SD_PX) -> Spots:
        """Spots known only by their centres (m, 2), all with the same assumed standard deviation (px)."""
        uv = np.asarray(uv_px, dtype=np.float64).reshape(-1, 2)
        return cls(uv_px=uv, covariance_px=np.tile(np.eye(2) * sd_px**2, (len(uv), 1, 1)), sd_assumed=True)

    @classmethod
    def of_own(cls, **arrays: FloatArray) -> Spots:
        """Measured spots of arrays that are nobody else's, float64 and of the shapes above: taken over, not copied."""
        spots = object.__new__(cls)
        for name, values in arrays.items():
            values.flags.writeable = False
            object.__setattr__(spots, name, values)
        for name, value in (("sd_assumed", False), ("rejected", ()), ("n_rejected", {})):
            object.__setattr__(spots, name, value)
        return spots

    def take(self, which: BoolArray | IntArray) -> Spots:
        """Some of the spots; the rejected candidates stay."""
        arrays = {name: getattr(self, name)[which] for name in _ARRAYS}
        return Spots(**arrays, sd_assumed=self.sd_assumed, rejected=self.rejected, n_rejected=self.n_rejected)

    def joined(self, other: Spots) -> Spots:
        """These spots and others of the same slice, all measured."""
        arrays: dict[str, Any] = {name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in _ARRAYS}
        return Spots(
            **arrays,
            rejected=(*self.rejected, *other.rejected),
            n_rejected=Counter(self.n_rejected) + Counter(other.n_rejected),
        )

    @property
    def sd_px(self) -> FloatArray:
        """(m, 2) standard deviations of u and v."""
        sd: FloatArray = np.sqrt(np.diagonal(self.covariance_px, axis1=1, axis2=2))
        return sd
