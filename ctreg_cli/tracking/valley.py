"""What spots and past together really say along the direction they say least about.

A covariance is the curvature of the cost at its lowest point. With few spots the valley of the cost bends, and flattens
as it goes: a straight ellipsoid promises more than the cost then charges. A filter that believes the promise a few
times over is sure of a wrong place. So the valley is walked along, and no more is believed than it has charged.
"""

from __future__ import annotations

from functools import cache
from itertools import product
from typing import NamedTuple

import numpy as np

from ctreg_cli.arrays import FloatArray
from ctreg_cli.geometry import pose as poses
from ctreg_cli.registration.refine import Observations, linearise
from ctreg_cli.rods import RodModel

#: how far the valley is walked along, sd of what the curvature says
_LOOKED_AT_SD = (3.0, 4.5, 6.0, 8.0)
#: directions that are walked along: those known at most this much better than the worst, and how many of them
_WEAK, _MOST_WEAK = 5.0, 3
#: a cost that rises by this share of what an ellipsoid promises is one
_ENOUGH_SHARE = 0.75
#: places where the cost has risen by this (χ²) are out of the question, however near
_OUT_OF_THE_QUESTION = 32.0
#: steps by which the other directions give way; times that an ellipsoid is widened to reach what it did not
_STEPS, _MOST_WIDENINGS = 4, 8


class Valley(NamedTuple):
    """The cost of spots and past about its lowest point."""

    #: (6, 6) covariance that promises nowhere more than the cost charges
    covariance: FloatArray
    #: the least share of the promise of its curvature that the cost keeps, and the greatest three sd out
    least_share: float
    steepest_share: float


def walked_along(
    model: RodModel, seen: Observations, T: FloatArray, T_predicted: FloatArray, predicted_covariance: FloatArray
) -> Valley:
    """Follow the valley of the cost both ways from its lowest point.

    Args:
        model: the rods.
        seen: one hypothesis.
        T: (4, 4) the most probable pose with the past taken in.
        T_predicted: (4, 4) where the past expected the frame.
        predicted_covariance: (6, 6) of it.
    """
    past = np.linalg.inv(predicted_covariance)
    information = linearise(model, T[None], seen).normal_equations()[0][0] + past
    unit = np.array([1, 1, 1, *(3 * [1 / model.size_mm])])
    values, vectors = np.linalg.eigh(information * (unit[:, None] * unit))
    axes = unit[:, None] * vectors
    sd = np.sqrt(np.maximum(values, 1e-300))
    weak = int(np.count_nonzero(sd[:_MOST_WEAK] < _WEAK * sd[0]))
    ways = _ways(weak)
    far = np.repeat(_LOOKED_AT_SD, len(ways))
    out = np.tile(ways / sd[:weak] @ axes[:, :weak].T, (len(_LOOKED_AT_SD), 1))
    several = seen.subset(np.zeros(len(far), dtype=np.intp))

    def cost(stack: FloatArray, observed: Observations) -> FloatArray:
        off = poses.difference(stack, T_predicted)
        return np.asarray(linearise(model, stack, observed).chi2 + np.einsum("bi,ij,bj->b", off, past, off))

    moved = poses.update(np.repeat(T[None], len(far), axis=0), far[:, None] * out)
    basis = axes[:, weak:]
    for _ in range(_STEPS):
        H, g = linearise(model, moved, several).normal_equations()
        g = g - poses.difference(moved, T_predicted) @ past
        step = np.linalg.solve(basis.T @ (H + past) @ basis, (g @ basis)[..., None])[..., 0]
        moved = poses.update(moved, step @ basis.T)
    rise = cost(moved, several) - cost(T[None], seen)
    rise = np.where(np.isfinite(rise), rise, np.inf)
    share = rise / far**2
    counts = rise < _OUT_OF_THE_QUESTION
    return Valley(
        covariance=_reaching(np.linalg.inv(information), poses.difference(moved, T)[counts], rise[counts]),
        least_share=float(share[counts].min(initial=np.inf)),
        steepest_share=float(share[:2].max()),
    )


@cache
def _ways(weak: int) -> FloatArray:
    """(w, weak) unit vectors along the axes and between them; along the first, both ways, first of all."""
    ways = np.array([way for way in product((0, 1, -1), repeat=weak) if any(way)], dtype=np.float64)
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    return ways[np.argsort(-np.abs(ways[:, 0]), kind="stable")]


def _reaching(covariance: FloatArray, offset: FloatArray, rise: FloatArray) -> FloatArray:
    """``covariance`` (6, 6), widened until it promises at offsets (k, 6) little more than the cost's rises (k,) there.

    One direction at a time, the one that lacks most first: in units of the sd, ``I → I + (d²/rise − 1) ôôᵀ``.
    """
    for _ in range(_MOST_WIDENINGS):
        promised = np.einsum("ki,ki->k", offset, np.linalg.solve(covariance, offset.T).T)
        lack = promised * _ENOUGH_SHARE / np.maximum(rise, 1.0)
        if not lack.max(initial=0.0) > 1.0:
            break
        k = int(lack.argmax())
        covariance = covariance + (promised[k] / max(rise[k], 1.0) - 1.0) / promised[k] * np.outer(offset[k], offset[k])
    return covariance
