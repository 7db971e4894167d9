"""The control law: image-based visual servoing of a virtual frame (Doignon et al. 2008, eq. 16 and 17).

``ξ = −g Ĵ⁺ (s − s*)``: s are the spots predicted from the current pose, s* the spots measured; the pose follows the twist,
``R ← exp([Ω]ₓ) R``, ``t ← t + V``, until the step is small. Ĵ⁺ is either recomputed at every step (*updated*: Gauss–Newton
with a gain; straight spot paths) or kept from the last full registration (*constant*: no new Jacobian; curved paths).
Stable while the symmetric part of ``Ĵ⁺ J`` is positive definite; its smallest eigenvalue is the margin, and means something
only with the rotation columns brought to millimetres by the frame's size.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctreg_cli.arrays import BoolArray, FloatArray
from ctreg_cli.geometry import pose as poses
from ctreg_cli.registration.refine import Linearisation, Observations, linearise
from ctreg_cli.rods import RodModel

#: the margin below which a constant Jacobian is not trusted any more
LEAST_MARGIN = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoOptions:
    """When the servo goes on, and when it stops."""

    #: share of the spot error taken back in one step, 0 < gain ≤ 1
    gain: float = 1.0
    #: stop when a step moves the pose by less than this share of the frame's size (and as many rad) ...
    step_tolerance: float = 1e-7
    #: ... or when the spots are this close to the measured ones (rms, px)
    residual_tolerance_px: float = 1e-9
    max_iterations: int = 200


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ServoResult:
    """Where the servo ended, and the way there."""

    T: FloatArray
    linearisation: Linearisation
    iterations: int
    converged: bool
    #: smallest eigenvalue of the symmetric part of Ĵ⁺J at the end
    margin: float
    #: (i + 1, 4, 4) poses from start to end, and (i + 1, n, 2) their spots, px; only when asked for
    path_T: FloatArray
    path_px: FloatArray


def weighted_pseudoinverse(fit: Linearisation) -> FloatArray:
    """``Ĵ⁺ = (Jᵀ W J)⁻¹ Jᵀ W`` (6, 2n) of a one-hypothesis linearisation; zero columns where nothing was matched.

    Raises:
        numpy.linalg.LinAlgError: the spots do not determine the pose.
    """
    H, _ = fit.normal_equations()
    n = fit.residual_px.shape[1]
    JtW = np.swapaxes((fit.weight @ fit.jacobian).reshape(2 * n, 6), 0, 1)
    result: FloatArray = np.linalg.solve(H[0], JtW)
    return result


def stability_margin(J_plus: FloatArray, jacobian: FloatArray, matched: BoolArray, size_mm: float) -> float:
    """Smallest eigenvalue of the symmetric part of ``Ĵ⁺ J`` (eq. 17), rotation measured in frame sizes.

    Args:
        J_plus: (6, 2n) the pseudo-inverse in use.
        jacobian: (n, 2, 6) the true Jacobian now, px per mm and rad.
        matched: (n,) rods with a spot now.
        size_mm: the frame's size.
    """
    unit = np.array([1, 1, 1, *(3 * [size_mm])])
    J = np.where(matched[:, None, None], jacobian, 0.0).reshape(-1, 6)
    M = (J_plus @ J) * unit[:, None] / unit
    return float(np.linalg.eigvalsh(0.5 * (M + M.T))[0])


def servo(
    model: RodModel,
    T: FloatArray,
    measured: Observations,
    *,
    options: ServoOptions | None = None,
    J_plus: FloatArray | None = None,
    keep_path: bool = False,
) -> ServoResult:
    """Move the pose until its spots are the measured ones.

    Args:
        model: the rods.
        T: (4, 4) start.
        measured: one hypothesis: the spot of each rod, px.
        options: see :class:`ServoOptions`.
        J_plus: (6, 2n) a constant Ĵ⁺; None: recomputed at every step (*updated*).
        keep_path: also return every pose and spot on the way.

    Raises:
        numpy.linalg.LinAlgError: *updated*, and the spots do not determine the pose.
    """
    options = options or ServoOptions()
    unit = np.array([1, 1, 1, *(3 * [model.size_mm])])
    here = linearise(model, T[None], measured)
    path_T, path_px = [T], [here.predicted_px[0]]
    converged, iterations = False, 0
    gain_matrix = J_plus
    while iterations < options.max_iterations:
        if J_plus is None:
            gain_matrix = weighted_pseudoinverse(here)
        assert gain_matrix is not None
        step = options.gain * gain_matrix @ here.residual_px[0].reshape(-1)  # residual is s* − s
        iterations += 1
        T = poses.update(T, step)
        here = linearise(model, T[None], measured)
        if keep_path:
            path_T.append(T)
            path_px.append(here.predicted_px[0])
        if not np.isfinite(T).all() or not np.isfinite(here.chi2[0]):
            break
        small = float(np.abs(step * unit).max()) <= options.step_tolerance * model.size_mm
        exact = float(np.sqrt((here.residual_px**2).mean())) <= options.residual_tolerance_px
        if small or exact:
            converged = True
            break
    used = gain_matrix if J_plus is not None else weighted_pseudoinverse(here)
    assert used is not None
    return ServoResult(
        T=T,
        linearisation=here,
        iterations=iterations,
        converged=converged,
        margin=stability_margin(used, here.jacobian[0], measured.matched[0], model.size_mm),
        path_T=np.stack(path_T),
        path_px=np.stack(path_px),
    )
