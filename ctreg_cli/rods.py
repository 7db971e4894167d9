"""The rod model: named bounded rods, and what a frame file says about them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from ctreg_cli.arrays import FloatArray, frozen
from ctreg_cli.checks import is_number
from ctreg_cli.errors import RodModelError
from ctreg_cli.geometry.plucker import moments

#: how far a mount may be from a rotation, element by element
_ROTATION_TOLERANCE = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rod:
    """A bounded rod, model frame, mm."""

    id: str
    #: (3,) where λ = 0
    start: FloatArray
    #: (3,) where λ = length
    end: FloatArray
    diameter_mm: float | None = None
    #: sd of the rod's true place about the written one, across the rod, mm; the same error all along the rod
    tolerance_mm: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Mount:
    """How the frame normally sits: the rotation model → patient (LPS; slice axes without patient geometry).

    Raises:
        RodModelError: what is given is no rotation, or the angle none.
    """

    #: (3, 3)
    patient_from_model: FloatArray
    max_angle_deg: float = 45.0

    def __post_init__(self) -> None:
        R, angle = np.asarray(self.patient_from_model), self.max_angle_deg
        if R.shape != (3, 3) or not (np.abs(R @ R.T - np.eye(3)).max() < _ROTATION_TOLERANCE and np.linalg.det(R) > 0):
            raise RodModelError(
                f"mount: patient_from_model: {R.tolist()} is no rotation; give an orthonormal 3 × 3 matrix"
            )
        if not (is_number(angle) and 0 < angle <= 180):
            raise RodModelError(f"mount: max_angle_deg: {angle!r} is wrong; give degrees above 0, up to 180")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Target:
    """A point at which accuracy is reported, model frame, mm."""

    id: str
    point: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RodModel:
    """Rods of a frame (the frame file as data), with the stacked arrays the mathematics wants.

    Raises:
        RodModelError: fewer than three rods, a duplicate id, a rod of no length, a coordinate that is not finite, a
            diameter or a tolerance that is none.
    """

    name: str
    rods: tuple[Rod, ...]
    mount: Mount | None = None
    targets: tuple[Target, ...] = ()
    description: str = ""
    #: SHA-256 of the frame file's bytes (hex), or of the rods when the model was built in memory
    sha256: str = ""

    #: (n, 3) starts, (n, 3) unit directions, (n, 3) moments, (n,) lengths and (n,) tolerances; model frame, mm
    starts: FloatArray = field(init=False)
    directions: FloatArray = field(init=False)
    moments: FloatArray = field(init=False)
    lengths: FloatArray = field(init=False)
    tolerances: FloatArray = field(init=False)
    #: (3,) mean of the rods' middles, and rms distance of the rods' ends from it, mm: the frame's place and size
    centre: FloatArray = field(init=False)
    size_mm: float = field(init=False)

    def __post_init__(self) -> None:
        if len(self.rods) < 3:
            raise RodModelError(f"{self.name}: {len(self.rods)} rods, but at least 3 are needed")
        ids = [rod.id for rod in self.rods]
        if len(set(ids)) < len(ids):
            raise RodModelError(f"{self.name}: rod ids must differ, got {ids}")
        starts = frozen([rod.start for rod in self.rods], (None, 3))
        ends = frozen([rod.end for rod in self.rods], (None, 3))
        if not (np.isfinite(starts).all() and np.isfinite(ends).all()):
            raise RodModelError(f"{self.name}: every coordinate must be a finite number")
        for rod in self.rods:
            diameter, tolerance = rod.diameter_mm, rod.tolerance_mm
            if not (diameter is None or (is_number(diameter) and diameter > 0)):
                raise RodModelError(
                    f"{self.name}: rod {rod.id}: diameter_mm: {diameter!r} is no positive number, nor None"
                )
            if not (is_number(tolerance) and tolerance >= 0):
                raise RodModelError(f"{self.name}: rod {rod.id}: tolerance_mm: {tolerance!r} is no number from 0")
        target_ids = [target.id for target in self.targets]
        if len(set(target_ids)) < len(target_ids):
            raise RodModelError(f"{self.name}: target ids must differ, got {target_ids}")
        for target in self.targets:
            if np.shape(target.point) != (3,) or not np.isfinite(target.point).all():
                raise RodModelError(f"{self.name}: target {target.id}: a point is three finite numbers, mm")
        lengths = np.linalg.norm(ends - starts, axis=1)
        if not (lengths > 1e-6).all():
            raise RodModelError(f"{self.name}: rod {ids[int(lengths.argmin())]} has no length")
        directions = (ends - starts) / lengths[:, None]
        centre = (starts + ends).mean(axis=0) / 2
        set_ = object.__setattr__
        set_(self, "rods", tuple(self.rods))
        set_(self, "starts", starts)
        set_(self, "directions", frozen(directions, (None, 3)))
        set_(self, "moments", frozen(moments(starts, directions), (None, 3)))
        set_(self, "lengths", frozen(lengths, (None,)))
        set_(self, "tolerances", frozen([rod.tolerance_mm for rod in self.rods], (None,)))
        set_(self, "centre", frozen(centre, (3,)))
        both = np.concatenate([starts, ends]) - centre
        set_(self, "size_mm", float(np.sqrt((both**2).sum(axis=1).mean())))

    def __len__(self) -> int:
        return len(self.rods)

    @property
    def ids(self) -> tuple[str, ...]:
        """Names of the rods, in the order of every (n, ...) array."""
        return tuple(rod.id for rod in self.rods)

    @property
    def ends(self) -> FloatArray:
        """(n, 3) ends, model frame, mm."""
        return self.starts + self.lengths[:, None] * self.directions

    def subset(self, indices: Sequence[int]) -> RodModel:
        """The same frame with only these rods."""
        return RodModel(
            name=self.name,
            rods=tuple(self.rods[i] for i in indices),
            mount=self.mount,
            targets=self.targets,
            description=self.description,
            sha256=self.sha256,
        )


@lru_cache(maxsize=16)
def common_direction(model: RodModel) -> FloatArray:
    """(3,) that the rods have in common, more or less; cached, since a model is a value that never changes."""
    return frozen(np.linalg.svd(model.directions)[2][0], (3,))
