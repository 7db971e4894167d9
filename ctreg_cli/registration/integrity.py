"""How wrong can it be? Protection levels, as aviation asks of a navigator (RAIM by solution separation).

For each target, ``pl_mm`` is a distance the true error exceeds with at most the stated risk, even if one of the
matched spots is faulty and nothing showed it (a streak, a neighbour, a bent rod). If spot k is the faulty one, the
solution without it is sound, and the triangle inequality bounds the error of the full one:

    |x − x_true| ≤ |x − x_k| + |x_k − x_true|,     |x_k − x_true| ≤ K σ_k   but for the risk,

with x_k the leave-one-rod-out solution, σ_k the largest standard deviation of its target error in any direction, and
``K² = χ²₃⁻¹(1 − risk / (n + 1))``: the risk is shared between the n possible faults and none. A fault is taken as
certain, not as rare. With fewer than five matches the solutions left over cannot be told from others: the level is
infinite.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from ctreg_cli.arrays import FloatArray
from ctreg_cli.geometry.plucker import skew
from ctreg_cli.registration.evidence import PosePrior
from ctreg_cli.registration.linearity import length_of_the_valley
from ctreg_cli.registration.matching import distinct_poses
from ctreg_cli.registration.refine import Observations, covariance_from_information, linearise
from ctreg_cli.rods import RodModel

#: matches below which leaving one out leaves nothing to check it by
LEAST_MATCHES = 5
#: a target error no better known than this many frame sizes is not known
_UNKNOWN = 10.0


def protected_points(model: RodModel) -> FloatArray:
    """(p, 3) model points that levels are given for: the frame's targets, or its centre where it has none; mm."""
    if not model.targets:
        return model.centre[None]
    return np.array([target.point for target in model.targets])


def risk_of_each(risk: float, n_matches: int) -> float:
    """The share of the risk that each possible fault, and none, may use up: in noise, and in solutions neglected."""
    return risk / (n_matches + 1)


def protection_levels(
    model: RodModel,
    T: FloatArray,
    covariance: FloatArray,
    seen: Observations,
    solutions: Sequence[tuple[FloatArray, Observations]],
    risk: float,
    *,
    inflation: float = 1.0,
    prior: PosePrior | None = None,
) -> FloatArray:
    """Protection level (p,) in mm at each of :func:`protected_points`.

    Args:
        model: the rods.
        T: (4, 4) the pose to protect.
        covariance: (6, 6) its covariance.
        seen: one hypothesis: the spots it rests on.
        solutions: what may be sound in its place: poses (b, 4, 4) and the spots they rest on. Those without each of
            the spots that the pose rests on have to be among them.
        risk: accepted probability, a slice, that the error exceeds the level.
        inflation: factor on the standard deviations of the solutions, as for the full one.
        prior: rotations it does not allow need not be protected from.
    """
    points = protected_points(model)
    n = int(seen.matched.sum())
    if n < LEAST_MATCHES:
        return np.full(len(points), np.inf)
    quantile = math.sqrt(float(chdtri(3, risk_of_each(risk, n))))
    T_all, seen_all = _one_of_each(model, [(T[None], seen), *solutions])
    C, _ = covariance_from_information(linearise(model, T_all, seen_all).normal_equations()[0], model.size_mm)
    arms = points @ np.swapaxes(T_all[:, :3, :3], 1, 2)  # (b, p, 3)
    place = arms + T_all[:, None, :3, 3]
    separation = np.linalg.norm(place - place[0], axis=-1)
    longer = length_of_the_valley(model, T_all, C, seen_all, points, quantile * inflation, prior=prior)
    noise = quantile * inflation * longer * largest_sd(C[:, None], arms)
    level = np.concatenate([separation + noise, quantile * largest_sd(covariance, arms[:1])]).max(axis=0)
    result: FloatArray = np.where(level < _UNKNOWN * model.size_mm, level, np.inf)
    return result


def _one_of_each(
    model: RodModel, solutions: Sequence[tuple[FloatArray, Observations]]
) -> tuple[FloatArray, Observations]:
    """Solutions (b, 4, 4) with what they rest on: of the same rods and nearly the same pose only the first."""
    T = np.concatenate([T for T, _ in solutions])
    parts = [part for _, part in solutions]
    together = replace(
        parts[0],
        uv_px=np.concatenate([part.uv_px for part in parts]),
        covariance_px=np.concatenate([part.covariance_px for part in parts]),
        matched=np.concatenate([part.matched for part in parts]),
    )
    rods = np.unique(together.matched, axis=0, return_inverse=True)[1].reshape(-1)
    kept = distinct_poses(model, T, rods)
    return T[kept], together.subset(kept)


def largest_sd(C: FloatArray, arms: FloatArray) -> FloatArray:
    """Largest sd (...), in any direction, of points at ``arms`` (..., 3) from the model origin, mm.

    ``C``: (..., 6, 6) covariances of the poses.
    """
    G = np.concatenate([np.broadcast_to(np.eye(3), (*arms.shape[:-1], 3, 3)), -skew(arms)], axis=-1)
    values = np.linalg.eigvalsh(G @ C @ np.swapaxes(G, -1, -2))
    result: FloatArray = np.sqrt(np.maximum(values[..., -1], 0))
    return result
