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

import numpy as np
from scipy.special import chdtri

from ctreg_cli.arrays import FloatArray
from ctreg_cli.geometry.plucker import skew
from ctreg_cli.registration.refine import Observations, covariance_from_information, refine
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


def protection_levels(
    model: RodModel, T: FloatArray, covariance: FloatArray, seen: Observations, risk: float, *, inflation: float = 1.0
) -> FloatArray:
    """Protection level (p,) in mm at each of :func:`protected_points`.

    Args:
        model: the rods.
        T: (4, 4) the pose to protect.
        covariance: (6, 6) its covariance.
        seen: one hypothesis: the spots it rests on.
        risk: accepted probability, a slice, that the error exceeds the level.
        inflation: factor on the standard deviations of the leave-one-out solutions, as for the full one.
    """
    points = protected_points(model)
    matched = np.nonzero(seen.matched[0])[0]
    n = len(matched)
    if n < LEAST_MATCHES:
        return np.full(len(points), np.inf)
    quantile = math.sqrt(float(chdtri(3, risk / (n + 1))))
    without = np.repeat(seen.matched, n, axis=0)
    without[np.arange(n), matched] = False
    subsets = Observations(
        uv_px=np.repeat(seen.uv_px, n, axis=0),
        covariance_px=np.repeat(seen.covariance_px, n, axis=0),
        matched=without,
        mm_per_px=seen.mm_per_px,
        half_slab_mm=seen.half_slab_mm,
        resolved_mm=seen.resolved_mm,
    )
    T_without, fit, _ = refine(model, np.repeat(T[None], n, axis=0), subsets, iterations=6, step_tolerance=1e-6)
    H, _ = fit.normal_equations()
    C, _ = covariance_from_information(H, model.size_mm)
    place = points @ T[:3, :3].T + T[:3, 3]
    place_without = points @ np.swapaxes(T_without[:, :3, :3], 1, 2) + T_without[:, None, :3, 3]
    separation = np.linalg.norm(place_without - place, axis=-1)  # (n, p)
    sd_without = inflation * _largest_sd(C, points @ np.swapaxes(T_without[:, :3, :3], 1, 2))
    sd = _largest_sd(covariance[None], (points @ T[:3, :3].T)[None])
    level = np.concatenate([separation + quantile * sd_without, quantile * sd]).max(axis=0)
    result: FloatArray = np.where(level < _UNKNOWN * model.size_mm, level, np.inf)
    return result


def _largest_sd(C: FloatArray, arms: FloatArray) -> FloatArray:
    """(b, p) largest sd, in any direction, of points at ``arms`` (b, p, 3) from the model origin, mm."""
    G = np.concatenate([np.broadcast_to(np.eye(3), (*arms.shape[:-1], 3, 3)), -skew(arms)], axis=-1)
    values = np.linalg.eigvalsh(G @ C[:, None] @ np.swapaxes(G, -1, -2))
    result: FloatArray = np.sqrt(np.maximum(values[..., -1], 0))
    return result
