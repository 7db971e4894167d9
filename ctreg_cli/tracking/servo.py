"""The control law: image-based visual servoing of a virtual frame (Doignon et al. 2008, eq. 16 and 17).

``ξ = −g Ĵ⁺ (s − s*)``: s are the spots predicted from the current pose, s* the spots measured; the pose follows the
twist, ``R ← exp([Ω]ₓ) R``, ``t ← t + V``, until the step is small. Ĵ is either recomputed at every step (*updated*:
Gauss–Newton with a gain; straight spot paths) or kept from the desired features of the last registration (*constant*;
curved paths). Stable while the symmetric part of ``Ĵ⁺ J`` is positive definite (eq. 17); its smallest eigenvalue is the
margin, and means something only with the rotation columns brought to millimetres by the frame's size.

One pose at a time and the seen rods only, in closed forms: this is what a tracked slice costs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ctreg_cli.arrays import FloatArray, IntArray
from ctreg_cli.registration.refine import invert_2x2
from ctreg_cli.rods import RodModel
from ctreg_cli.tracking.single import cross, updated

#: a step never turns the frame by more than this, rad
_MAX_TURN_RAD = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoOptions:
    """When the servo goes on, and when it stops."""

    #: share of the spot error taken back in one step, 0 < gain ≤ 1
    gain: float = 1.0
    #: stop when a step moves the pose by less than this share of the frame's size (and as many rad) ...
    step_tolerance: float = 1e-9
    #: ... or the spots by less than this altogether, in standard deviations of theirs ...
    spot_tolerance_sd: float = 1e-3
    #: ... or when the spots are this close to the measured ones (rms, in their unit)
    residual_tolerance: float = 1e-9
    max_iterations: int = 400


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Desired:
    """The desired features s*: ``k`` measured spots and the rods they belong to."""

    #: (k, 3) starts and unit directions of the rods, model frame, mm, and (k,) their tolerances
    starts: FloatArray
    directions: FloatArray
    tolerances: FloatArray
    #: (k, 2) spots and (k, 2, 2) their covariances, px
    uv_px: FloatArray
    covariance_px: FloatArray
    #: (2,) ``[s_x, s_y]``; ones where the spots are given in millimetres
    mm_per_px: FloatArray
    #: (k, 2, 2) inverse of ``covariance_px`` where that is all there is; None where tolerances add to it by the pose
    weight: FloatArray | None = None

    @classmethod
    def of(
        cls, model: RodModel, rods: IntArray, uv_px: FloatArray, covariance_px: FloatArray, mm_per_px: FloatArray
    ) -> Desired:
        """The spots ``uv_px`` (k, 2) of the rods with the indices ``rods`` (k,)."""
        return cls(
            starts=model.starts[rods],
            directions=model.directions[rods],
            tolerances=model.tolerances[rods],
            uv_px=uv_px,
            covariance_px=covariance_px,
            mm_per_px=mm_per_px,
            weight=None if model.tolerances.any() else invert_2x2(covariance_px),
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """The desired features seen from a pose."""

    #: (k, 2) spots of this pose, and measured minus these, px
    spots_px: FloatArray
    residual_px: FloatArray
    #: (k, 2, 2) covariance of a residual (spot noise and the frame's tolerance) and its inverse
    covariance_px: FloatArray
    weight: FloatArray
    #: (2k, 6) motion field, px per mm and rad
    jacobian: FloatArray
    #: (k,) where the slice cuts each rod, mm
    lambda_mm: FloatArray

    @property
    def chi2(self) -> float:
        """Σ rᵀ W r."""
        r = self.residual_px
        return float(((self.weight @ r[:, :, None])[:, :, 0] * r).sum())

    @property
    def rms_px(self) -> float:
        """Root mean square of the residuals over both coordinates."""
        r = self.residual_px.ravel()
        return math.sqrt(float(r @ r) / len(r))

    def weighted(self, jacobian: FloatArray) -> FloatArray:
        """``W J`` (2k, 6) of a Jacobian (2k, 6)."""
        product: FloatArray = (self.weight @ jacobian.reshape(-1, 2, 6)).reshape(-1, 6)
        return product


def view(desired: Desired, T: FloatArray) -> View:
    """The desired features from the pose ``T`` (4, 4); not finite where one of the rods lies in the slice."""
    crossing = cross(T, desired.starts, desired.directions)
    spots = crossing.xy_mm / desired.mm_per_px
    covariance, weight = desired.covariance_px, desired.weight
    if weight is None:
        k = crossing.slope
        tolerance = k[:, :, None] * k[:, None, :]
        tolerance[:, 0, 0] += 1.0
        tolerance[:, 1, 1] += 1.0
        tolerance *= (desired.tolerances**2)[:, None, None] / (desired.mm_per_px[:, None] * desired.mm_per_px)
        covariance = covariance + tolerance
        weight = invert_2x2(covariance)
    jacobian = crossing.jacobian
    jacobian /= desired.mm_per_px[:, None]
    return View(
        spots_px=spots,
        residual_px=desired.uv_px - spots,
        covariance_px=covariance,
        weight=weight,
        jacobian=jacobian.reshape(-1, 6),
        lambda_mm=crossing.lambda_mm,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ServoResult:
    """Where the servo ended, and the way there."""

    T: FloatArray
    view: View
    #: (6, 6) of the pose error ``[V; Ω]``, mm and rad: the Cramér–Rao bound for *updated*, a little more for *constant*
    covariance: FloatArray
    iterations: int
    converged: bool
    #: smallest eigenvalue of the symmetric part of Ĵ⁺J at the end
    margin: float
    #: only when asked for: (i + 1, 4, 4) poses from start to end, (i + 1, k, 2) their spots, px, and (i + 1,) margins
    path_T: FloatArray | None = None
    path_px: FloatArray | None = None
    path_margin: FloatArray | None = None


def pseudoinverse(jacobian: FloatArray, here: View) -> FloatArray:
    """``Ĵ⁺ = (Ĵᵀ W Ĵ)⁻¹ Ĵᵀ W`` (6, 2k) with the weights of ``here``.

    Raises:
        numpy.linalg.LinAlgError: the spots do not determine the pose.
    """
    WJ = here.weighted(jacobian)
    return np.asarray(np.linalg.solve(WJ.T @ jacobian, WJ.T))


def stability_margin(J_plus: FloatArray, jacobian: FloatArray, size_mm: float) -> float:
    """Smallest eigenvalue of the symmetric part of ``Ĵ⁺ J`` (eq. 17), rotation measured in frame sizes.

    Args:
        J_plus: (6, 2k) the pseudo-inverse in use.
        jacobian: (2k, 6) the true Jacobian, px per mm and rad.
        size_mm: the frame's size.
    """
    unit = _unit(size_mm)
    M = (J_plus @ jacobian) * unit[:, None] / unit
    return float(np.linalg.eigvalsh(0.5 * (M + M.T))[0])


def servo(
    model: RodModel,
    T: FloatArray,
    desired: Desired,
    *,
    options: ServoOptions | None = None,
    jacobian: FloatArray | None = None,
    keep_path: bool = False,
) -> ServoResult:
    """Move the pose until its spots are the measured ones.

    Args:
        model: the frame; its size brings rotation to millimetres.
        T: (4, 4) start.
        desired: s*.
        options: see :class:`ServoOptions`.
        jacobian: (2k, 6) Ĵ of the *constant* strategy; None: recomputed at every step (*updated*).
        keep_path: also return every pose and spot on the way.

    Raises:
        numpy.linalg.LinAlgError: the spots do not determine the pose, or a rod came to lie in the slice on the way.
    """
    options = options or ServoOptions()
    unit = _unit(model.size_mm)
    here = view(desired, T)
    J_plus = pseudoinverse(here.jacobian if jacobian is None else jacobian, here)
    path = [(T, here.spots_px, stability_margin(J_plus, here.jacobian, model.size_mm))] if keep_path else []
    converged, iterations = False, 0
    while not converged and iterations < options.max_iterations:
        step = options.gain * (J_plus @ here.residual_px.reshape(-1))  # the residual is s* − s
        turn = math.sqrt(float(step[3:] @ step[3:]))
        if turn > _MAX_TURN_RAD:
            step *= _MAX_TURN_RAD / turn
        iterations += 1
        T = updated(T, step)
        last, here = here, view(desired, T)
        if not math.isfinite(float(here.residual_px.sum())):
            raise np.linalg.LinAlgError("a rod came to lie in the slice")
        if jacobian is None:
            J_plus = pseudoinverse(here.jacobian, here)
        if keep_path:
            path.append((T, here.spots_px, stability_margin(J_plus, here.jacobian, model.size_mm)))
        d = here.spots_px - last.spots_px
        moved_sd2 = float(((here.weight @ d[:, :, None])[:, :, 0] * d).sum())
        converged = (
            moved_sd2 <= (options.spot_tolerance_sd * options.gain) ** 2
            or float(np.abs(step * unit).max()) <= options.step_tolerance * options.gain * model.size_mm
            or here.rms_px <= options.residual_tolerance
        )
    influence = J_plus
    if jacobian is not None:  # noise moves the pose where Ĵᵀ W r = 0 by (Ĵ⁺ J)⁻¹ Ĵ⁺
        influence = np.asarray(np.linalg.solve(J_plus @ here.jacobian, J_plus))
    spread = (influence.reshape(6, -1, 2).transpose(1, 0, 2) @ here.covariance_px).transpose(1, 0, 2)
    return ServoResult(
        T=T,
        view=here,
        covariance=spread.reshape(6, -1) @ influence.T,
        iterations=iterations,
        converged=converged,
        margin=stability_margin(J_plus, here.jacobian, model.size_mm) if converged else -np.inf,
        path_T=np.stack([p for p, _, _ in path]) if keep_path else None,
        path_px=np.stack([s for _, s, _ in path]) if keep_path else None,
        path_margin=np.array([m for _, _, m in path]) if keep_path else None,
    )


def _unit(size_mm: float) -> FloatArray:
    return np.array([1.0, 1.0, 1.0, size_mm, size_mm, size_mm])
