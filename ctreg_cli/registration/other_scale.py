"""Would more spots be rods', were the pixels not as large as they say? A rival pose that no other search finds.

Where a scale is off by a few percent, most rods of a frame can still be made to fit: a tilt stretches a frame as a
scale does, and a frame that is nearly its own image has a twin to choose. What gives it away are rods that then seem to
be missing, and spots left over that would be theirs with another scale, however far from their places they lie. Such an
explanation needs no chance but one error, and is weighed against the pose as any rival is (:mod:`.evidence`): more
matches, two scales more, and what is believed of scales beforehand.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.special import gammaln

from ctreg_cli.arrays import FloatArray, IntArray
from ctreg_cli.geometry.motion_field import scale_jacobian
from ctreg_cli.geometry.projection import within_bounds
from ctreg_cli.registration.evidence import P_SEEN
from ctreg_cli.registration.matching import Matches, Scene, observations, search
from ctreg_cli.registration.misfit import RELATIVE_SD
from ctreg_cli.registration.refine import Observations, linearise, refine_scales
from ctreg_cli.rods import RodModel

#: the ln odds that a scale is off
LOG_PRIOR = math.log(0.01)
#: how far off a wrong frame or scale may put the spots, in frame sizes
LOOSE_SHARE = 0.02
#: so many of the loose matches are tried
_MOST_TRIED = 6
#: so close to its end (in rod lengths) a rod need not be seen
_NEAR_END = 0.05


def loose_matches(model: RodModel, scene: Scene, least_matches: int) -> Matches | None:
    """Matches of so many spots or more where these, or the frame, may be a few percent off; None if there are none."""
    slack = (LOOSE_SHARE * model.size_mm) ** 2
    loose = replace(scene, covariance_mm=scene.covariance_mm + slack * np.eye(2))
    return search(model, loose, least_matches=least_matches)


def log_odds_of_other_scale(
    model: RodModel, scene: Scene, T: FloatArray, spot_of_rod: IntArray, loose: Matches | None
) -> float:
    """ln odds of the best explanation with free scales and more matches, over a pose; −∞ where there is none.

    Args:
        model: the rods.
        scene: the spots, mm.
        T: (4, 4) the pose.
        spot_of_rod: (n,) its matches, −1 for none.
        loose: what :func:`loose_matches` found of more.
    """
    if loose is None:
        return -math.inf
    as_it_is = _log_evidence(model, scene, T, observations(scene, spot_of_rod[None]), with_scales=False)
    best = -math.inf
    tried: set[bytes] = set()
    for start, more in zip(loose.T, loose.spot_of_rod, strict=True):
        if more.tobytes() in tried or len(tried) >= _MOST_TRIED:
            continue
        tried.add(more.tobytes())
        seen = observations(scene, more[None])
        one = np.ones(2)
        fit = refine_scales(model, start[None], seen, prior_mm_per_px=one, prior_sd=RELATIVE_SD * one, iterations=20)
        if np.isfinite(fit.chi2):
            seen = replace(seen, mm_per_px=fit.mm_per_px)
            best = max(best, _log_evidence(model, scene, fit.T[0], seen, with_scales=True))
    return best + LOG_PRIOR - as_it_is


def _log_evidence(model: RodModel, scene: Scene, T: FloatArray, seen: Observations, *, with_scales: bool) -> float:
    """ln of the probability of all spots by Laplace's method, but for what is the same of every pose of a slice.

    With scales: their logarithms are two unknowns more, with a prior of their own.
    """
    fit = linearise(model, T[None], seen)
    used = seen.matched[0]
    A = fit.jacobian[0, used]
    chi2 = float(fit.chi2[0])
    volume = 0.0
    if with_scales:
        scale = seen.mm_per_px
        A = np.concatenate([A, scale_jacobian(fit.predicted_px[0, used] * scale, scale) * scale], axis=2)
        off = np.log(scale) / RELATIVE_SD
        chi2 += float(off @ off)
        volume -= 2 * math.log(RELATIVE_SD)
    H = np.einsum("nki,nkl,nlj->ij", A, fit.weight[0, used], A)
    if with_scales:
        H[6:, 6:] += np.eye(2) / RELATIVE_SD**2
    volume -= 0.5 * float(np.linalg.slogdet(H)[1])
    weights = float(np.linalg.slogdet(fit.weight[0, used])[1].sum())
    # what no rod explains is clutter, evenly about the slice
    n, m = int(used.sum()), len(scene.xy_mm)
    centre = scene.xy_mm.mean(axis=0)
    area = math.pi * float(np.square(scene.xy_mm - centre).sum(axis=1).max())
    cut = within_bounds(fit.lambda_mm[0], model.lengths, -_NEAR_END * model.lengths)
    return (
        volume
        - 0.5 * chi2
        + 0.5 * weights
        + n * math.log(P_SEEN * area / (2 * math.pi))
        + float(gammaln(m - n + 0.5))
        + int((cut & ~used).sum()) * math.log(1 - P_SEEN)
    )
