"""Is the covariance true? The profile of the cost along the direction the spots say least about (method §8).

A covariance says that the cost rises by 1, 4 and 9 at one, two and three standard deviations. With few spots, or a
frame cut where its rods cross alike, it does not: the valley of the cost is flatter on one side, or bends. Where an
ellipsoid can still hold it, the covariance is made to; where not, nothing smaller than the truth is said.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ctreg_cli.arrays import BoolArray, FloatArray
from ctreg_cli.geometry import pose as poses
from ctreg_cli.geometry.plucker import skew
from ctreg_cli.registration.evidence import PosePrior
from ctreg_cli.registration.refine import (
    Linearisation,
    Observations,
    covariance_from_information,
    linearise,
    principal_axes,
)
from ctreg_cli.rods import RodModel

#: χ² that three sd must cost (a straight cost: 9) for the covariance to be believed as it is
_STRAIGHT_RISE = 5.4
#: how far, in sd², the valley may bend on the way
_STRAIGHT_BEND2 = 9.0
#: a flatter valley widens the covariance, but no more than so many times
_MOST_WIDENED = 2.5
#: where the truth would find the pose wrong by so many of *its* sd, it may lie with this probability at most
_WRONG_SD, MOST_WRONG_P = 6.0, 0.02
#: points of the profile on each side
_POINTS = 8
#: how far beyond its ends (frame sizes) a matched rod may be cut for the truth to lie there
_BEYOND_END = 0.02
#: rise where a rod no longer crosses the slice, and ln of the room beyond which Laplace's method is not believed
_NO_WAY, _MOST_ROOM = 9.0, 30.0
#: how far the valley is walked outward, in the steps the covariance says it takes; if it has not ended by then, it has
#: no end
_OUTWARD = (1.0, 1.35, 1.8, 2.4, 3.2, 4.2)
#: a valley that rises at the first of them by this share of what it should (in sd) foretells where it ends
_AS_FORETOLD = 0.85
#: ... and by this share it is straight: the probability beyond K sd grows fivefold at most, and a protection level
#: shares its risk between more faults than that, of which one at most is there
_AS_SAID = 0.95


class Valley(NamedTuple):
    """What the profile of the cost says of a covariance."""

    #: (6, 6) true; None where no ellipsoid describes what is known
    covariance: FloatArray | None
    #: what the sd had to be multiplied by, infinity where that does not help
    factor: float
    #: probability that the truth lies where it would find the pose wrong; 1 where the profile never rises
    wrong_p: float


def covariance_along_the_valley(
    model: RodModel,
    T: FloatArray,
    covariance: FloatArray,
    seen: Observations,
    *,
    inflation: float = 1.0,
    prior: PosePrior | None = None,
) -> Valley:
    """Check that the cost rises along the weakest direction as the covariance predicts (± 3 sd), else widen it.

    Where it rises less, or its valley bends out of the ellipsoid, the profile is followed outward until it has risen by
    the 9 that three sd must cost, and the covariance is made to reach both ends.

    Args:
        model: the rods.
        T: (4, 4) the pose, at the minimum of the cost.
        covariance: (6, 6) what its curvature there says, mm and rad, times ``inflation²``.
        seen: one hypothesis: the spots the pose rests on.
        inflation: factor by which spots lie farther off than their sd allows.
        prior: what is known of the pose without the spots; None: nothing.

    Returns:
        With ``covariance`` itself where it is true; with a wider one; or with None where no ellipsoid describes what
        is known: the profile stays flat for too long, or the truth may well lie where the spots say so much more that
        this pose would be wrong by six of the standard deviations there.
    """
    values, axes = principal_axes(covariance / inflation**2, model.size_mm)
    sd = math.sqrt(max(float(values[-1]), 0.0))

    inward = np.linspace(3, 0, _POINTS, endpoint=False)
    profile = _profile(model, T, seen, axes, sd * np.concatenate([inward, -inward]), prior)
    wrong_p = profile.wrong_p()
    if wrong_p > MOST_WRONG_P:
        return Valley(None, math.inf, wrong_p)
    rise, offset = profile.rise, profile.offset
    ends = np.array([0, len(inward)])
    bend2 = ((offset[ends] @ np.linalg.inv(axes).T)[:, :-1] ** 2 / np.maximum(values[:-1], 1e-300)).sum(axis=1)
    if float(rise[ends].min()) > _STRAIGHT_RISE and float(bend2.max()) < _STRAIGHT_BEND2:
        return Valley(covariance, 1.0, wrong_p)

    factors = np.linspace(1, _MOST_WIDENED, _POINTS)
    outward = _profile(model, T, seen, axes, 3 * sd * np.concatenate([factors, -factors]), prior)
    risen = np.maximum.accumulate(outward.rise.reshape(2, -1), axis=1) >= 9
    if not risen.any(axis=1).all():
        return Valley(None, math.inf, 1.0)
    wrong_p = profile.joined(outward).wrong_p()
    if wrong_p > MOST_WRONG_P:
        return Valley(None, math.inf, wrong_p)
    offset = outward.offset
    ends = risen.argmax(axis=1)
    # the valley may bend: the ellipsoid has to reach its ends where they are, not where its axis points
    reach, straight = offset.reshape(2, -1, 6)[[0, 1], ends] / 3, axes[:, -1] * sd
    spread = reach.T @ reach / 2 - np.outer(straight, straight)
    return Valley(covariance + inflation**2 * positive_part(spread), float(factors[ends].max()), wrong_p)


def length_of_the_valley(
    model: RodModel,
    T: FloatArray,
    covariance: FloatArray,
    seen: Observations,
    points: FloatArray,
    sds: float,
    *,
    prior: PosePrior | None = None,
) -> FloatArray:
    """How many times farther points may be than the covariance says, where the cost has risen by ``sds²``.

    Args:
        model: the rods.
        T: (b, 4, 4) minima of the costs.
        covariance: (b, 6, 6) what the curvature there says, mm and rad.
        seen: the spots that each rests on.
        points: (p, 3) in the model, mm; each is moved the way it is known least.
        sds: standard deviations that the covariance is asked to be true for.
        prior: rotations outside its cone do not count.

    Returns:
        Factors (b, p), at least 1, infinite where no end was found.
    """
    b, p = len(T), len(points)
    unit = np.array([1, 1, 1, *(3 * [1 / model.size_mm])])
    arms = points @ np.swapaxes(T[:, :3, :3], 1, 2)
    G = np.concatenate([np.broadcast_to(np.eye(3), (b, p, 3, 3)), -skew(arms)], axis=-1)
    values, vectors = np.linalg.eigh(G @ covariance[:, None] @ np.swapaxes(G, -1, -2))
    moves = (vectors[..., None, :, -1] @ G)[..., 0, :]  # (b, p, 6): by how much a twist moves the point that way
    sd = np.sqrt(np.maximum(values[..., -1:], 1e-300))
    step = np.repeat(((covariance[:, None] @ moves[..., None])[..., 0] * (sds / sd)).reshape(b * p, 6), 2, axis=0)
    step[1::2] *= -1
    across = np.linalg.qr((moves * unit).reshape(b * p, 6, 1), mode="complete")[0][..., 1:] * unit[:, None]
    basis = np.repeat(across, 2, axis=0)
    both = seen.subset(np.repeat(np.arange(b), 2 * p))
    moved = np.repeat(T, 2 * p, axis=0)
    least = np.repeat(linearise(model, T, seen).chi2, 2 * p)
    point = np.tile(np.repeat(points, 2, axis=0), (b, 1))
    place = np.repeat((arms + T[:, None, :3, 3]).reshape(b * p, 3), 2, axis=0)
    foretold = np.repeat(sds * sd.reshape(b * p), 2)
    risen, gone, ends = np.zeros(2 * b * p), np.zeros(2 * b * p), np.full(2 * b * p, np.inf)
    active, before = np.arange(2 * b * p), 0.0
    for far in _OUTWARD:
        part = both.subset(active)
        there = poses.update(moved[active], (far - before) * step[active])
        there = _give_way(model, there, part, basis[active], 3)
        fit = linearise(model, there, part)
        now = np.sqrt(np.maximum(np.where(np.isfinite(fit.chi2), fit.chi2 - least[active], np.inf), 0))
        barred = ~_may_be_cut(model, fit, part)
        if prior is not None:
            barred |= ~prior.allows(there[:, :3, :3])
        now[barred] = np.inf
        # the valley may bend: how far the point is, not how far along
        here = (there[:, :3, :3] @ point[active][..., None])[..., 0] + there[:, :3, 3]
        distance = np.linalg.norm(here - place[active], axis=1) / foretold[active]
        over = now >= sds
        with np.errstate(invalid="ignore", divide="ignore"):
            share = np.where(np.isfinite(now), (sds - risen[active]) / (now - risen[active]), 1.0)
            end = gone[active] + share * (distance - gone[active])
            if before == 0.0:
                end = np.where(over, end, distance * sds / now)
                end[(now > _AS_SAID * sds) & (end < 1 / _AS_SAID)] = 1.0
                over |= now > _AS_FORETOLD * sds
        ends[active[over]] = end[over]
        moved[active], risen[active], gone[active] = there, now, distance
        active, before = active[~over], far
        if len(active) == 0:
            break
    result: FloatArray = np.maximum(ends.reshape(b, p, 2).max(axis=2), 1.0)
    return result


def _give_way(model: RodModel, T: FloatArray, seen: Observations, basis: FloatArray, steps: int) -> FloatArray:
    """Minimise the costs over the directions ``basis`` ((b,) 6, 5) only."""
    across = np.swapaxes(basis, -1, -2)
    for _ in range(steps):
        H, g = linearise(model, T, seen).normal_equations()
        Hc = across @ H @ basis
        Hc += 1e-12 * np.eye(5) * np.trace(Hc, axis1=1, axis2=2)[:, None, None]
        T = poses.update(T, (basis @ np.linalg.solve(Hc, across @ g[..., None]))[..., 0])
    return T


def _may_be_cut(model: RodModel, fit: Linearisation, seen: Observations) -> BoolArray:
    """(b,) whether the slice cuts all matched rods, or nearly."""
    beyond = np.maximum(-fit.lambda_mm, fit.lambda_mm - model.lengths) - seen.half_slab_mm
    cut = (beyond < _BEYOND_END * model.size_mm) | ~seen.matched
    return np.asarray(cut.all(axis=1))


def positive_part(M: FloatArray) -> FloatArray:
    """A symmetric matrix without its negative eigenvalues."""
    values, vectors = np.linalg.eigh(M)
    result: FloatArray = (vectors * np.maximum(values, 0)) @ vectors.T
    return result


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Profile:
    """The cost along one direction, ``b`` points, while the other five give way."""

    #: (b,) how far along, mm, and by how much χ² rises there
    step: FloatArray
    rise: FloatArray
    #: (b, 6) twists from the pose to there
    offset: FloatArray
    #: (b,) how many sd *of there* the pose is off, in rotation or place: what its error would be called were the truth
    #: there
    surprise: FloatArray
    #: (b,) ln of how much room the other five directions leave there, times the prior density, over that at the pose
    log_room: FloatArray

    def joined(self, other: _Profile) -> _Profile:
        """Both."""
        return _Profile(
            **{name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in self.__dataclass_fields__}
        )

    def wrong_p(self) -> float:
        """The posterior probability that the truth lies where it would find the pose wrong (Laplace's method)."""
        order = np.argsort(self.step)
        step = self.step[order]
        density = np.exp(-0.5 * np.maximum(self.rise, 0) + np.clip(self.log_room, -_MOST_ROOM, _MOST_ROOM))[order]
        wrong = density * (self.surprise[order] > _WRONG_SD)
        # the pose itself is a point of the profile too, of density 1
        at = int(np.searchsorted(step, 0.0))
        step, density, wrong = (np.insert(x, at, y) for x, y in ((step, 0.0), (density, 1.0), (wrong, 0.0)))
        half = np.diff(step) / 2
        return float(half @ (wrong[1:] + wrong[:-1])) / float(half @ (density[1:] + density[:-1]))


def _profile(
    model: RodModel,
    T: FloatArray,
    seen: Observations,
    axes: FloatArray,
    steps: FloatArray,
    prior: PosePrior | None,
) -> _Profile:
    """Follow the last of ``axes`` (6, 6) by ``steps`` (b,) while the others give way."""
    b = len(steps)
    repeated = seen.subset(np.zeros(b, dtype=np.intp))
    here = linearise(model, T[None], seen)
    moved = poses.update(np.repeat(T[None], b, axis=0), steps[:, None] * axes[:, -1])
    basis = axes[:, :-1]
    moved = _give_way(model, moved, repeated, basis, 5)
    there = linearise(model, moved, repeated)
    H, H_here = there.normal_equations()[0], here.normal_equations()[0]
    offset = poses.difference(moved, T)
    C, _ = covariance_from_information(H, model.size_mm)
    variance = np.einsum("bii->bi", C)
    error2 = np.stack([(offset[:, part] ** 2).sum(axis=1) for part in (slice(3), slice(3, 6))], axis=1)
    own2 = np.stack([variance[:, part].sum(axis=1) for part in (slice(3), slice(3, 6))], axis=1)
    rise = there.chi2 - here.chi2[0]
    room = 0.5 * (np.linalg.slogdet(basis.T @ H_here @ basis)[1] - np.linalg.slogdet(basis.T @ H @ basis)[1])
    if prior is not None:
        room += prior.log_density(moved[:, :3, :3]) - prior.log_density(T[None, :3, :3])
    room = np.where(_may_be_cut(model, there, repeated), room, -_MOST_ROOM)
    return _Profile(
        step=steps,
        rise=np.where(np.isfinite(rise), rise, _NO_WAY),
        offset=offset,
        surprise=np.sqrt((error2 / np.maximum(own2, 1e-300)).max(axis=1)),
        log_room=room,
    )
