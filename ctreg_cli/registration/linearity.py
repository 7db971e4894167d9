"""Is the covariance true? The profile of the cost along the direction the spots say least about (method §8).

A covariance says that the cost rises by 1, 4 and 9 at one, two and three standard deviations. With few spots, or a
frame cut where its rods cross alike, it does not: the valley of the cost is flatter on one side, or bends. Where an
ellipsoid can still hold it, the covariance is made to; where not, nothing smaller than the truth is said.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ctreg_cli.arrays import FloatArray
from ctreg_cli.geometry import pose as poses
from ctreg_cli.registration.refine import Observations, covariance_from_information, linearise
from ctreg_cli.rods import RodModel

#: χ² that three sd must cost (a straight cost: 9) for the covariance to be believed as it is
_STRAIGHT_RISE = 5.4
#: how far, in sd², the valley may bend on the way
_STRAIGHT_BEND2 = 9.0
#: a flatter valley widens the covariance, but no more than so many times
_MOST_WIDENED = 2.5
#: a truth that costs no more χ² than this must not find the pose wrong by so many of *its* sd
_PLAUSIBLE_RISE, _WRONG_SD = 7.0, 6.0
#: points of the profile on each side
_POINTS = 8


def covariance_along_the_valley(
    model: RodModel, T: FloatArray, covariance: FloatArray, seen: Observations, *, inflation: float = 1.0
) -> tuple[FloatArray | None, float]:
    """Check that the cost rises along the weakest direction as the covariance predicts (± 3 sd), else widen it.

    Where it rises less, or its valley bends out of the ellipsoid, the profile is followed outward until it has risen by
    the 9 that three sd must cost, and the covariance is made to reach both ends.

    Args:
        model: the rods.
        T: (4, 4) the pose, at the minimum of the cost.
        covariance: (6, 6) what its curvature there says, mm and rad, times ``inflation²``.
        seen: one hypothesis: the spots the pose rests on.
        inflation: factor by which spots lie farther off than their sd allows.

    Returns:
        ``covariance`` itself where it is true; a wider one, with the factor; or None where no ellipsoid describes what
        is known: the profile stays flat for too long, or the truth may lie where the spots say so much more that
        this pose would be wrong by six of the standard deviations there.
    """
    unit = np.array([1, 1, 1, *(3 * [model.size_mm])])
    values, vectors = np.linalg.eigh(covariance / inflation**2 * (unit[:, None] * unit))
    axes = vectors / unit[:, None]
    sd = math.sqrt(max(float(values[-1]), 0.0))

    inward = np.linspace(3, 0, _POINTS, endpoint=False)
    rise, offset, surprise = _profile(model, T, seen, axes, sd * np.concatenate([inward, -inward]))
    if _may_be_wrong(rise, surprise):
        return None, math.inf
    ends = np.array([0, len(inward)])
    bend2 = ((offset[ends] @ np.linalg.inv(axes).T)[:, :-1] ** 2 / np.maximum(values[:-1], 1e-300)).sum(axis=1)
    if float(rise[ends].min()) > _STRAIGHT_RISE and float(bend2.max()) < _STRAIGHT_BEND2:
        return covariance, 1.0

    factors = np.linspace(1, _MOST_WIDENED, _POINTS)
    rise, offset, surprise = _profile(model, T, seen, axes, 3 * sd * np.concatenate([factors, -factors]))
    risen = np.maximum.accumulate(rise.reshape(2, -1), axis=1) >= 9
    if not risen.any(axis=1).all() or _may_be_wrong(rise, surprise):
        return None, math.inf
    ends = risen.argmax(axis=1)
    # the valley may bend: the ellipsoid has to reach its ends where they are, not where its axis points
    reach, straight = offset.reshape(2, -1, 6)[[0, 1], ends] / 3, axes[:, -1] * sd
    spread = reach.T @ reach / 2 - np.outer(straight, straight)
    return covariance + inflation**2 * positive_part(spread), float(factors[ends].max())


def positive_part(M: FloatArray) -> FloatArray:
    """A symmetric matrix without its negative eigenvalues."""
    values, vectors = np.linalg.eigh(M)
    result: FloatArray = (vectors * np.maximum(values, 0)) @ vectors.T
    return result


def _may_be_wrong(rise: FloatArray, surprise: FloatArray) -> bool:
    return float(np.where(rise <= _PLAUSIBLE_RISE, surprise, 0).max()) > _WRONG_SD


def _profile(
    model: RodModel, T: FloatArray, seen: Observations, axes: FloatArray, steps: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """How much χ² rises (b,) at ``steps`` (b,) along the last of ``axes`` (6, 6) while the others give way.

    Returns the rises; the twists (b, 6) from the pose to where they are reached; and how many standard deviations *of
    there* the pose is off, in rotation or place (b,): what its error would be called if the truth were there.
    """
    b = len(steps)
    repeated = replace(
        seen,
        uv_px=np.repeat(seen.uv_px, b, axis=0),
        covariance_px=np.repeat(seen.covariance_px, b, axis=0),
        matched=np.repeat(seen.matched, b, axis=0),
    )
    least = linearise(model, T[None], seen).chi2[0]
    moved = poses.update(np.repeat(T[None], b, axis=0), steps[:, None] * axes[:, -1])
    basis = axes[:, :-1]
    for _ in range(5):
        H, g = linearise(model, moved, repeated).normal_equations()
        Hc = basis.T @ H @ basis
        Hc += 1e-12 * np.eye(5) * np.trace(Hc, axis1=1, axis2=2)[:, None, None]
        moved = poses.update(moved, np.linalg.solve(Hc, (g @ basis)[..., None])[..., 0] @ basis.T)
    there = linearise(model, moved, repeated)
    rise = there.chi2 - least
    offset = poses.difference(moved, T)
    C, _ = covariance_from_information(there.normal_equations()[0], model.size_mm)
    variance = np.einsum("bii->bi", C)
    error2 = np.stack([(offset[:, part] ** 2).sum(axis=1) for part in (slice(3), slice(3, 6))], axis=1)
    own2 = np.stack([variance[:, part].sum(axis=1) for part in (slice(3), slice(3, 6))], axis=1)
    return np.where(np.isfinite(rise), rise, 9.0), offset, np.sqrt((error2 / np.maximum(own2, 1e-300)).max(axis=1))
