"""The pose where it is known which rod left which spot: every minimum, at the Cramér–Rao bound, with its covariance.

For experiments, phantoms with marked rods, and users with a labelling of their own; without labels see
:func:`~ctreg_cli.registration.register.register`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from scipy.special import chdtrc

from ctreg_cli.arrays import FloatArray, IntArray, frozen, frozen_index
from ctreg_cli.errors import InputError, SingularGeometryError
from ctreg_cli.geometry.projection import project, within_bounds
from ctreg_cli.imaging.spots import Spots
from ctreg_cli.registration.linear import LinearSolutions, solve_labelled
from ctreg_cli.registration.linearity import covariance_along_the_valley
from ctreg_cli.registration.minimal import RodTriples, solve_three
from ctreg_cli.registration.refine import (
    Observations,
    covariance_from_information,
    refine,
    refine_scales,
)
from ctreg_cli.registration.register import INFLATE_P
from ctreg_cli.registration.result import Candidate
from ctreg_cli.rods import RodModel
from ctreg_cli.scale import Scale

#: starts from rod triples beside the linear one: twin minima show in most triples
_MOST_TRIPLES = 24
#: starts that are refined to the end
_MOST_STARTS = 32
#: steps of a refinement until starts that run together can be told, and to the end (it stops by itself before)
_FIRST_ITERATIONS, _ITERATIONS = 6, 40
#: beyond this condition number (rotation in frame sizes) a pose is not determined
_SINGULAR_CONDITION = 1e7
#: poses within this many frame sizes and rad of each other are one minimum; or are about to be
_SAME, _SAME_YET = 1e-4, 1e-3
#: a minimum whose χ² lies so far above the best's is no answer (odds under 1 : 10^10)
_RULED_OUT = 50.0
#: how far beyond a rod's end its spot may lie: this share of the frame's size, and so many standard deviations
_SLACK_SHARE, _SLACK_SD = 0.02, 4.0


def register_labelled(
    spots: Spots, rod_index: Sequence[int] | IntArray, model: RodModel, *, scale: Scale | None
) -> list[Candidate]:
    """Every pose that labelled spots allow, best first: the minima of χ² (method §3).

    Starts are the linear solutions (:mod:`~ctreg_cli.registration.linear`) and all roots of rod triples; each is
    refined on all spots. Few rods have several exact answers (three up to 8, four often 2): the caller sees them all.

    Args:
        spots: spots of one slice, px.
        rod_index: (m,) rod of each spot in the model; −1 for a spot that is none.
        model: the rods, mm.
        scale: mm per pixel; None: estimated along (``Candidate.scale``), from four spots on.

    Returns:
        The minima that cut every labelled rod between its ends; empty where there are none (wrong labels). Check
        ``Candidate.linear``: where it is False the covariance is smaller than what the spots leave open.

    Raises:
        InputError: ``rod_index`` does not fit the spots or the model, or names a rod twice.
        SingularGeometryError: too few, parallel or coplanar rods, or a pose these spots leave undetermined.
    """
    rods, chosen = _checked(spots, rod_index, model)
    part = model.subset(rods.tolist()) if len(rods) >= 3 else None
    if part is None:
        raise SingularGeometryError(f"{len(rods)} labelled spots, but at least {3 if scale else 4} are needed")
    uv, covariance = spots.uv_px[chosen], spots.covariance_px[chosen]
    noise_px = float(np.sqrt(np.trace(covariance, axis1=1, axis2=2).mean() / 2))
    starts = _starts(part, uv, scale, noise_px)
    if scale:
        found = _fit_poses(part, starts.T, uv, covariance, scale)
    else:
        found = [_fit_scales(part, T, s, uv, covariance) for T, s in zip(starts.T, starts.mm_per_px, strict=True)]
    found = _distinct(part, [candidate for candidate in found if _cuts_its_rods(part, candidate)])
    if scale:
        found = [_with_true_covariance(part, candidate, uv, covariance, scale) for candidate in found]
    if found and all(_condition(part, candidate) > _SINGULAR_CONDITION for candidate in found):
        raise SingularGeometryError("these spots leave the pose undetermined: there is a direction that moves none")
    whole = []
    for candidate in found:
        used = scale or candidate.scale
        assert used is not None  # one or the other
        whole.append(_in_the_whole_frame(model, rods, chosen, candidate, used))
    return whole


def _checked(spots: Spots, rod_index: Sequence[int] | IntArray, model: RodModel) -> tuple[IntArray, IntArray]:
    """Rods and spots of the labelled pairs."""
    labels = np.asarray(rod_index)
    if labels.shape != (len(spots),) or not np.issubdtype(labels.dtype, np.integer):
        raise InputError(f"rod_index: {len(spots)} whole numbers are needed, one a spot; got shape {labels.shape}")
    if len(labels) and not (labels.min() >= -1 and labels.max() < len(model)):
        raise InputError(f"rod_index: rods are 0 to {len(model) - 1}, and -1 for none; got {labels.tolist()}")
    chosen = np.nonzero(labels >= 0)[0]
    rods = labels[chosen].astype(np.intp)
    if len(np.unique(rods)) < len(rods):
        raise InputError(f"rod_index: a rod leaves one spot, but one is named twice in {labels.tolist()}")
    return rods, chosen


def _starts(model: RodModel, uv: FloatArray, scale: Scale | None, noise_px: float) -> LinearSolutions:
    mm_per_px = None if scale is None else scale.mm_per_px
    linear = solve_labelled(model, uv, mm_per_px=mm_per_px, noise_px=noise_px)
    if mm_per_px is None or len(model) == 3:
        return linear
    xy = uv * mm_per_px
    triples = np.array(list(combinations(range(len(model)), 3)), dtype=np.intp)
    triples = triples[:: -(-len(triples) // _MOST_TRIPLES)]
    noise_mm = noise_px * float(mm_per_px.max())
    T, _ = solve_three(RodTriples.of(model, triples), xy[triples], slack_mm=3 * noise_mm, noise_mm=noise_mm)
    # most of these are far off, and say so at once
    miss = ((xy - project(T, model.starts, model.directions).xy_mm) ** 2).sum(axis=(1, 2))
    nearest = np.argsort(np.nan_to_num(miss, nan=np.inf), kind="stable")[:_MOST_STARTS]
    T = np.concatenate([linear.T, T[nearest]])
    return LinearSolutions(T=T, mm_per_px=np.broadcast_to(mm_per_px, (len(T), 2)), rank=linear.rank)


def _fit_poses(model: RodModel, T: FloatArray, uv: FloatArray, covariance: FloatArray, scale: Scale) -> list[Candidate]:
    """Minima reached from starting poses (r, 4, 4), the scale known; matches are numbered as in ``uv``."""
    if len(T) == 0:
        return []
    seen = Observations(
        uv_px=np.broadcast_to(uv, (len(T), *uv.shape)),
        covariance_px=np.broadcast_to(covariance, (len(T), *covariance.shape)),
        matched=np.ones((len(T), len(uv)), dtype=bool),
        mm_per_px=scale.mm_per_px,
    )
    T, fit, _ = refine(model, T, seen, iterations=_FIRST_ITERATIONS)
    apart = _apart(model, T, fit.chi2, _SAME_YET)
    T, fit, steps = refine(model, T[apart], seen.subset(apart), iterations=_ITERATIONS)
    C, _ = covariance_from_information(fit.normal_equations()[0], model.size_mm)
    return [
        _candidate(T[r], C[r], fit.residual_px[r], fit.lambda_mm[r], float(fit.chi2[r]), 2 * len(uv) - 6, steps)
        for r in np.nonzero(np.isfinite(fit.chi2))[0]
    ]


def _with_true_covariance(
    model: RodModel, candidate: Candidate, uv: FloatArray, covariance: FloatArray, scale: Scale
) -> Candidate:
    """The candidate, its covariance widened or disowned (``linear``) where the cost is no ellipsoid."""
    if candidate.degrees_of_freedom <= 0:
        return candidate
    seen = Observations(
        uv_px=uv[None], covariance_px=covariance[None], matched=np.ones((1, len(uv)), bool), mm_per_px=scale.mm_per_px
    )
    widened = covariance_along_the_valley(
        model, candidate.T_slice_model, candidate.covariance, seen, inflation=candidate.inflation
    ).covariance
    if widened is None:
        return replace(candidate, linear=False)
    return replace(candidate, covariance=frozen(widened, (6, 6)))


def _fit_scales(model: RodModel, T: FloatArray, s: FloatArray, uv: FloatArray, covariance: FloatArray) -> Candidate:
    """The minimum reached from one starting pose and scale, both free."""
    seen = Observations(
        uv_px=uv[None], covariance_px=covariance[None], matched=np.ones((1, len(uv)), dtype=bool), mm_per_px=s
    )
    fit = refine_scales(model, T[None], seen)
    lin = fit.linearisation
    candidate = _candidate(
        fit.T[0],
        fit.pose_covariance[0],
        lin.residual_px[0],
        lin.lambda_mm[0],
        fit.chi2,
        fit.degrees_of_freedom,
        iterations=0,
    )
    scale = Scale(s_x=float(fit.mm_per_px[0]), s_y=float(fit.mm_per_px[1]))
    return replace(candidate, scale=scale, scale_covariance=frozen(fit.covariance * candidate.inflation**2, (2, 2)))


def _candidate(
    T: FloatArray,
    covariance: FloatArray,
    residual_px: FloatArray,
    lambda_mm: FloatArray,
    chi2: float,
    degrees_of_freedom: int,
    iterations: int,
) -> Candidate:
    inflation = 1.0
    if degrees_of_freedom > 0 and chdtrc(degrees_of_freedom, chi2) < INFLATE_P:
        inflation = math.sqrt(chi2 / degrees_of_freedom)
    every = np.arange(len(residual_px))
    return Candidate(
        T_slice_model=frozen(T, (4, 4)),
        covariance=frozen(covariance * inflation**2, (6, 6)),
        rod_index=frozen_index(every),
        spot_index=frozen_index(every),
        residual_px=frozen(residual_px, (None, 2)),
        lambda_mm=frozen(lambda_mm, (None,)),
        missing_rods=frozen_index([]),
        rms_px=float(np.sqrt((residual_px**2).mean())),
        chi2=chi2,
        degrees_of_freedom=degrees_of_freedom,
        log_odds=math.inf,
        inflation=inflation,
        iterations=iterations,
    )


def _cuts_its_rods(model: RodModel, candidate: Candidate) -> bool:
    """Whether every labelled rod is cut between its ends, or as near to them as the pose's uncertainty allows."""
    T = candidate.T_slice_model
    projection = project(T, model.starts, model.directions)
    x, y = (projection.xy_mm - T[:2, 3]).T
    zero, one = np.zeros_like(x), np.ones_like(x)
    height = np.stack([zero, zero, one, y, -x, zero], axis=1)  # z part of V + Ω × (Q − t)
    sd_height = np.sqrt(np.einsum("ni,ij,nj->n", height, candidate.covariance, height))
    per_mm = np.sqrt(1 + (projection.slope**2).sum(axis=1))  # mm of rod per mm of height
    slack = _SLACK_SHARE * model.size_mm + _SLACK_SD * sd_height * per_mm
    return bool(((candidate.lambda_mm >= -slack) & (candidate.lambda_mm <= model.lengths + slack)).all())


def _distinct(model: RodModel, candidates: list[Candidate]) -> list[Candidate]:
    """One of each minimum, best first, without those that the spots rule out."""
    if not candidates:
        return []
    chi2 = np.array([c.chi2 for c in candidates])
    best = int(chi2.argmin())
    most = chi2[best] + _RULED_OUT * candidates[best].inflation ** 2
    apart = _apart(model, np.stack([c.T_slice_model for c in candidates]), chi2, _SAME)
    return [candidates[r] for r in apart if chi2[r] <= most]


def _apart(model: RodModel, T: FloatArray, chi2: FloatArray, within: float) -> IntArray:
    """Rows of poses (r, 4, 4) that differ by more than ``within`` (frame sizes, rad), in the order of their χ²."""
    moved = (T[:, :3] @ np.append(model.centre, 1.0)) / model.size_mm
    place = np.concatenate([T[:, :3, :3].reshape(-1, 9) / math.sqrt(2), moved], axis=1)  # |R − R'| = √2 · angle
    kept: list[int] = []
    for row in np.argsort(chi2, kind="stable"):
        if np.isfinite(chi2[row]) and (np.linalg.norm(place[kept] - place[row], axis=1) > within).all():
            kept.append(int(row))
    return np.array(kept, dtype=np.intp)


def _condition(model: RodModel, candidate: Candidate) -> float:
    """Ratio of the largest to the smallest standard deviation of the pose, rotation in frame sizes."""
    unit = np.array([1, 1, 1, *(3 * [model.size_mm])])
    variance = np.linalg.eigvalsh(candidate.covariance * (unit[:, None] * unit))
    return math.sqrt(float(variance[-1]) / max(float(variance[0]), 1e-300))


def _in_the_whole_frame(
    model: RodModel, rods: IntArray, chosen: IntArray, candidate: Candidate, scale: Scale
) -> Candidate:
    """The candidate with rods and spots numbered as the caller's are, and the rods that should have been seen too."""
    projection = project(candidate.T_slice_model, model.starts, model.directions)
    unseen = within_bounds(projection.lambda_mm, model.lengths)
    unseen[rods] = False
    missing = np.nonzero(unseen)[0]
    return replace(
        candidate,
        rod_index=frozen_index(rods),
        spot_index=frozen_index(chosen),
        missing_rods=frozen_index(missing),
        missing_px=frozen(projection.xy_mm[missing] / scale.mm_per_px, (None, 2)),
    )
