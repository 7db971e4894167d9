"""Which spots lie where a pose expects them, and which rods it expects to see: for one pose, cheaply."""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np

from ctreg_cli.arrays import BoolArray, FloatArray, IntArray
from ctreg_cli.registration.matching import Scene, nearest_assignment
from ctreg_cli.rods import RodModel
from ctreg_cli.tracking.single import Crossing, cross

#: gates about predicted spots, in sd
GATE_SD = 4.5
#: how far beyond its ends a rod may still be seen: sd of a spot, and share of the frame's size
_END_SD, _END_SIZES = 4.0, 0.01


class Outlook:
    """What a pose expects of a slice."""

    def __init__(self, model: RodModel, scene: Scene, T: FloatArray) -> None:
        self.model, self.scene, self.T = model, scene, T
        self.crossing: Crossing = cross(T, model.starts, model.directions)

    @cached_property
    def _slack_mm(self) -> FloatArray:
        """(n,) along each rod."""
        S = self.scene.covariance_mm
        spot2 = 0.5 * float((S[:, 0, 0] + S[:, 1, 1]).max(initial=0.0))
        noise = math.sqrt(spot2 + float(self.model.tolerances.max()) ** 2)
        per_mm = np.sqrt(1 + (self.crossing.slope**2).sum(axis=1))
        slack: FloatArray = (self.scene.half_slab_mm + _END_SD * noise) * per_mm + _END_SIZES * self.model.size_mm
        return slack

    @cached_property
    def may_be_seen(self) -> BoolArray:
        """(n,) rods that the slab touches, inside the image."""
        lambda_mm = self.crossing.lambda_mm
        may: BoolArray = (lambda_mm >= -self._slack_mm) & (lambda_mm <= self.model.lengths + self._slack_mm)
        return may & self._in_field

    @cached_property
    def must_be_seen(self) -> BoolArray:
        """(n,) rods that the whole slab cuts, inside the image."""
        lambda_mm = self.crossing.lambda_mm
        must: BoolArray = (lambda_mm >= self._slack_mm) & (lambda_mm <= self.model.lengths - self._slack_mm)
        return must & self._in_field

    @cached_property
    def _in_field(self) -> BoolArray:
        field = self.scene.field_mm
        if field is None:
            return np.ones(len(self.model), dtype=bool)
        inside = (self.crossing.xy_mm >= field[0]) & (self.crossing.xy_mm <= field[1])
        return np.asarray(inside[:, 0] & inside[:, 1])

    def assigned(self, covariance: FloatArray) -> IntArray:
        """Spot of each rod (n,), −1 for none, one to one, within gates by the pose's ``covariance`` (6, 6)."""
        xy, J = self.scene.xy_mm, self.crossing.jacobian
        S = self.scene.covariance_mm
        G = J @ covariance @ J.transpose(0, 2, 1)
        if self.model.tolerances.any():
            k = self.crossing.slope
            G = G + (self.model.tolerances**2)[:, None, None] * (np.eye(2) + k[:, :, None] * k[:, None, :])
        a, b, c = (G[:, i, j, None] + S[:, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
        d_x = xy[:, 0] - self.crossing.xy_mm[:, 0, None]
        d_y = xy[:, 1] - self.crossing.xy_mm[:, 1, None]
        distance2 = (c * d_x * d_x - 2 * b * d_x * d_y + a * d_y * d_y) / (a * c - b * b)
        inside = (distance2 < GATE_SD**2) & self.may_be_seen[:, None]
        rods, spots = np.nonzero(inside)
        spot_of_rod = np.full(len(self.model), -1, dtype=np.intp)
        spot_of_rod[rods] = spots
        if len(set(rods.tolist())) < len(rods) or len(set(spots.tolist())) < len(spots):  # contested
            return np.asarray(nearest_assignment(self.model, self.scene, self.T[None], covariance)[0])
        return spot_of_rod
