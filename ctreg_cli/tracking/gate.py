"""Which spots lie where a pose expects them, and which rods it expects to see: for one pose, cheaply."""

from __future__ import annotations

import math

import numpy as np

from ctreg_cli.arrays import BoolArray, FloatArray, IntArray
from ctreg_cli.registration.matching import MOST_BEYOND_END, Scene, nearest_assignment
from ctreg_cli.registration.refine import rod_end_reach, rod_end_shift
from ctreg_cli.rods import RodModel
from ctreg_cli.tracking.single import Crossing, cross, greatest_tolerance_mm, model_lines

#: gates about predicted spots, in sd
GATE_SD = 4.5
#: how far beyond its ends a rod may still be seen: sd of a spot, and share of the frame's size
_END_SD, _END_SIZES = 4.0, 0.01


def greatest_noise_mm(model: RodModel, scene: Scene) -> float:
    """A standard deviation of the worst spot about its rod, mm."""
    S = scene.covariance_mm
    spot2 = 0.5 * float((S[:, 0, 0] + S[:, 1, 1]).max(initial=0.0))
    return math.sqrt(spot2 + greatest_tolerance_mm(model) ** 2)


def spread(crossing: Crossing, covariance: FloatArray) -> FloatArray:
    """(n, 2, 2) covariance of crossings that a pose's ``covariance`` (6, 6) makes, mm²."""
    J = crossing.jacobian
    JC = J.reshape(-1, 6).dot(covariance).reshape(J.shape)  # one product of all rods costs less than one each
    result: FloatArray = JC @ J.transpose(0, 2, 1)
    return result


class Outlook:
    """What a pose expects of a slice."""

    def __init__(
        self,
        model: RodModel,
        scene: Scene,
        T: FloatArray,
        crossing: Crossing | None = None,
        noise_mm: float | None = None,
    ) -> None:
        """``crossing``, of all rods with ``T``, and :func:`greatest_noise_mm`, where they are worked out already."""
        self.model, self.scene, self.T = model, scene, T
        self.crossing = crossing or cross(T, model_lines(model))
        self.noise_mm = greatest_noise_mm(model, scene) if noise_mm is None else noise_mm
        along = self.crossing.lambda_mm
        #: (n,) along each rod from the crossing to the nearer end; negative beyond it
        self._to_end_mm = np.minimum(along, model.lengths - along)
        #: (n,) along each rod
        slack_mm = self.crossing.mm_per_height * (scene.half_slab_mm + _END_SD * self.noise_mm)
        # as in the matching: a rod that lies nearly in the slice is not seen wherever noise would carry its crossing
        self._slack_mm = np.minimum(slack_mm, MOST_BEYOND_END * model.lengths) + _END_SIZES * model.size_mm
        self._in_field = self._inside_image()

    def _inside_image(self) -> BoolArray | None:
        """(n,) crossings inside the image; None where all are."""
        field = self.scene.field_mm
        if field is None:
            return None
        (left, top), (right, bottom) = field.tolist()
        x, y = self.crossing.xy_mm.T
        xs, ys = x.tolist(), y.tolist()  # a rod that lies in the slice (NaN) may count as inside: it is not cut
        if left <= min(xs) and max(xs) <= right and top <= min(ys) and max(ys) <= bottom:
            return None
        return np.asarray((x >= left) & (x <= right) & (y >= top) & (y <= bottom))

    def may_be_seen(self) -> BoolArray:
        """(n,) rods that the slab touches, inside the image."""
        return self._inside(self._to_end_mm >= -self._slack_mm)

    def must_be_seen(self) -> BoolArray:
        """(n,) rods that the whole slab cuts, inside the image."""
        return self._inside(self._to_end_mm >= self._slack_mm)

    def _inside(self, cut: BoolArray) -> BoolArray:
        return cut if self._in_field is None else cut & self._in_field

    def has_ends_near(self, rods: IntArray) -> bool:
        """Whether one of ``rods`` ends in the slab, or so near that its spot may be off.

        See :func:`~ctreg_cli.registration.refine.rod_end_shift`.
        """
        half_slab_mm = self.scene.half_slab_mm
        if half_slab_mm == 0:
            return False
        crossing, farthest = self.crossing, rod_end_reach(self.model, half_slab_mm)
        if float((self._to_end_mm / crossing.mm_per_height)[rods].min()) > farthest:  # nearly always
            return False
        return bool(rod_end_shift(self.model, crossing.slope, crossing.lambda_mm, half_slab_mm)[rods].any())

    def assigned(self, covariance: FloatArray, spread_mm2: FloatArray | None = None) -> IntArray:
        """Spot of each rod (n,), −1 for none, one to one, within gates by the pose's ``covariance`` (6, 6).

        ``spread_mm2``: :func:`spread` of the crossings with it, where it has been worked out already.
        """
        xy = self.scene.xy_mm
        S = self.scene.covariance_mm
        G = spread(self.crossing, covariance) if spread_mm2 is None else spread_mm2
        if greatest_tolerance_mm(self.model) > 0:
            k = self.crossing.slope
            G = G + (self.model.tolerances**2)[:, None, None] * (np.eye(2) + k[:, :, None] * k[:, None, :])
        a, b, _, c = G.reshape(-1, 4).T[:, :, None] + S.reshape(-1, 4).T[:, None]  # each (n, m)
        d_x, d_y = xy.T[:, None] - self.crossing.xy_mm.T[:, :, None]
        distance2 = (c * d_x - (b + b) * d_y) * d_x + a * d_y * d_y
        inside = distance2 < GATE_SD**2 * (a * c - b * b)
        inside &= self.may_be_seen()[:, None]
        rods, spots = np.nonzero(inside)
        if len(set(rods.tolist())) < len(rods) or len(set(spots.tolist())) < len(spots):  # contested
            return np.asarray(nearest_assignment(self.model, self.scene, self.T[None], covariance)[0])
        spot_of_rod = np.empty(len(inside), dtype=np.intp)
        spot_of_rod.fill(-1)
        spot_of_rod[rods] = spots
        return spot_of_rod
