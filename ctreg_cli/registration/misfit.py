"""Is it the scale, or the frame's height? A score test for the errors that a pose can hide.

χ² asks whether the residuals are too large in any of their directions, and hardly notices what moves all spots a
little and together: pixels that are not as large as they say, a frame drawn too tall. The score test (Rao 1948) asks
along just those directions. With ``K`` the derivative of the predicted spots with respect to these unknowns, ``J`` to
the pose, both weighted, what is left of K beside J is ``K' = K − J (JᵀJ)⁻¹ JᵀK``, and the unknowns' estimate is ``θ =
(K'ᵀK' + P)⁻¹ K'ᵀ r``, P the prior that drawings and scales are off by percents.
"""

from __future__ import annotations

import numpy as np
from scipy.special import chdtrc

from ctreg_cli.arrays import FloatArray
from ctreg_cli.geometry import pose as poses
from ctreg_cli.geometry.projection import project
from ctreg_cli.registration.linearity import positive_part
from ctreg_cli.registration.refine import Observations, linearise, refine_scales
from ctreg_cli.rods import RodModel, common_direction

#: a score less likely than this by chance is taken for an error of scale or height ...
SUSPECT_P = 1e-2
#: ... beyond doubt, so that there is no pose to be had ...
CERTAIN_P = 1e-9
#: ... if that error then explains the spots at least so well
_EXPLAINED_P = 1e-3
#: how far off (relative sd) a scale or a height may be
RELATIVE_SD = 0.05


def covariance_with_misfit(
    model: RodModel, T: FloatArray, covariance: FloatArray, seen: Observations
) -> tuple[FloatArray | None, str]:
    """A covariance that covers what an error of scale or height does to the pose, where the spots speak of one.

    Args:
        model: the rods.
        T: (4, 4) the pose.
        covariance: (6, 6) of it, mm and rad.
        seen: one hypothesis: the spots the pose rests on, and those beside the places of rods it misses: if the scale
            is wrong, it is why they do not fit.

    Returns:
        The covariance, itself where there is nothing to suspect, None where there is no doubt of the error; and the
        suspicion in plain words, or nothing.
    """
    fit = linearise(model, T[None], seen)
    used = seen.matched[0]
    root = np.swapaxes(np.linalg.cholesky(fit.weight[0, used]), 1, 2)
    r = (root @ fit.residual_px[0, used, :, None]).reshape(-1)
    J = (root @ fit.jacobian[0, used]).reshape(-1, 6)
    crossing = project(T, model.starts, model.directions)
    K = hidden_derivatives(model, T, crossing.xy_mm[used], crossing.slope[used]) / seen.mm_per_px[:, None]
    K = (root @ K).reshape(len(r), -1)
    J_plus = np.linalg.pinv(J)
    r_beside, beside = r - J @ (J_plus @ r), K - J @ (J_plus @ K)
    # the prior as three more observations: what the pose can imitate is then off by a few percent, not by half
    information = beside.T @ beside + np.eye(K.shape[1]) / RELATIVE_SD**2
    pull = beside.T @ r_beside
    theta = np.linalg.solve(information, pull)
    score = float(pull @ theta)
    left_over = len(r) - 6 - len(theta)
    explained = left_over > 0 and chdtrc(left_over, max(float(r_beside @ r_beside) - score, 0.0)) > _EXPLAINED_P
    chance = chdtrc(len(theta), score)
    if not explained or chance > SUSPECT_P:
        return covariance, ""
    worst = int(np.abs(theta).argmax())
    what = ("the scale along x", "the scale along y", "the frame's height")[worst]
    text = f"{what} seems {100 * abs(theta[worst]):.2g} % off; sd widened to cover it"
    if chance < CERTAIN_P:
        return None, text
    moved, shift = J_plus @ (r - K @ theta), J_plus @ K
    by_height = np.outer(moved, moved) + shift @ np.linalg.solve(information, shift.T)
    return covariance + by_height + _spread_by_scale(model, T, covariance, seen), text


def _spread_by_scale(model: RodModel, T: FloatArray, covariance: FloatArray, seen: Observations) -> FloatArray:
    """What freeing both scales adds to the covariance (6, 6): how far the pose then moves, and how much less is known.

    A tilt imitates a scale in its square, so that no derivative tells how far: the pose is refined anew.
    """
    start = linearise(model, T[None], seen)
    if not np.isfinite(start.chi2).all():
        return np.zeros((6, 6))
    fit = refine_scales(
        model, T[None], seen, prior_mm_per_px=seen.mm_per_px, prior_sd=RELATIVE_SD * seen.mm_per_px, iterations=15
    )
    # seen from the pixels, not from the corner of the image: the frame's centre stays at its spots
    T_free = np.array(fit.T[0])
    centre = T_free[:3, :3] @ model.centre
    T_free[:2, 3] = (T_free[:2, 3] + centre[:2]) * seen.mm_per_px / fit.mm_per_px - centre[:2]
    moved = poses.difference(T_free, T)
    result: FloatArray = np.outer(moved, moved) + positive_part(fit.pose_covariance[0] - covariance)
    return result


def hidden_derivatives(model: RodModel, T: FloatArray, xy_mm: FloatArray, slope: FloatArray) -> FloatArray:
    """(n, 2, 3) change of predicted spots, mm, with the relative error of both scales and of the frame's height.

    A taller frame moves what lies at a crossing by ``δ = h a`` along its axis ``a``, ``h`` as far as it lies above the
    frame's centre; the rod through it then crosses the slice ``δ_xy − slope · δ_z`` farther.

    Args:
        model: the rods.
        T: (4, 4) the pose.
        xy_mm: (n, 2) where rods are crossed, mm.
        slope: (n, 2) of the rods.
    """
    turn = T[:3, :3]
    axis, centre = turn.dot(common_direction(model)), turn.dot(model.centre) + T[:3, 3]
    height = (xy_mm - centre[:2]).dot(axis[:2]) - centre[2] * axis[2]
    K = np.zeros((len(xy_mm), 2, 3))
    np.negative(xy_mm[:, 0], out=K[:, 0, 0])
    np.negative(xy_mm[:, 1], out=K[:, 1, 1])
    np.multiply(height[:, None], axis[:2] - slope * axis[2], out=K[:, :, 2])
    return K
