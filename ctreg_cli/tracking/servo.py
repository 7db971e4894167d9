"""The control law: image-based visual servoing of a virtual frame (Doignon et al. 2008, eq. 16 and 17).

``ξ = −g Ĵ⁺ (s − s*)``: s are the spots predicted from the current pose, s* the spots measured; the pose follows the
twist, ``R ← exp([Ω]ₓ) R``, ``t ← t + V``, until the step is small. Ĵ is either recomputed at every step (*updated*:
Gauss–Newton with a gain; straight spot paths) or kept from the desired features of the last registration (*constant*;
curved paths). Stable while the symmetric part of ``Ĵ⁺ J`` is positive definite (eq. 17); its smallest eigenvalue is the
margin, and means something only with the rotation columns brought to millimetres by the frame's size.

One pose at a time and the seen rods only, in closed forms: this is what a tracked slice costs. What is made anew in
every step is a NamedTuple, which costs half of a frozen dataclass.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ctreg_cli.arrays import FloatArray, IntArray
from ctreg_cli.rods import RodModel
from ctreg_cli.tracking.single import (
    Crossing,
    cross,
    greatest_tolerance_mm,
    inverse_2x2,
    inverse_positive,
    lambdas,
    lines_of,
    model_lines,
    solve_positive,
    updated,
)

#: a step never turns the frame by more than this, rad
_MAX_TURN_RAD = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoOptions:
    """When the servo goes on, and when it stops."""

    #: share of the spot error taken back in one step, 0 < gain ≤ 1
    gain: float = 1.0
    #: stop when a full step would move the pose by less than this share of the frame's size (and as many rad) ...
    step_tolerance: float = 1e-9
    #: ... or the spots by less than this altogether, in standard deviations of theirs ...
    spot_tolerance_sd: float = 1e-3
    #: ... or when the spots are this close to the measured ones (rms, in their unit)
    residual_tolerance: float = 1e-9
    #: a full step of the *updated* law is the last, and taken without looking again, if what it leaves is less than so
    #: much (sd of all spots together) even when it converges no faster than the step before
    left_over_sd: float = 0.0
    max_iterations: int = 400


class Desired(NamedTuple):
    """The desired features s*: ``k`` measured spots and the rods they belong to."""

    #: (4, 2k) the rods (:func:`~ctreg_cli.tracking.single.lines`), model frame, mm, and (k,) their tolerances
    lines: FloatArray
    tolerances: FloatArray
    #: (k, 2) spots and (k, 2, 2) their covariances, px
    uv_px: FloatArray
    covariance_px: FloatArray
    #: (2,) ``[s_x, s_y]``; None where the spots are given in millimetres (then read mm for px)
    mm_per_px: FloatArray | None
    #: (k, 2, 2) inverse of ``covariance_px`` where that is all there is; None where tolerances add to it by the pose
    weight: FloatArray | None = None

    @classmethod
    def of(
        cls,
        model: RodModel,
        rods: IntArray,
        uv_px: FloatArray,
        covariance_px: FloatArray,
        mm_per_px: FloatArray | None = None,
    ) -> Desired:
        """The spots ``uv_px`` (k, 2) of the rods with the indices ``rods`` (k,)."""
        whole = len(rods) == len(model) and rods.tolist() == list(range(len(model)))
        return cls(
            lines=model_lines(model) if whole else lines_of(model, rods),
            tolerances=model.tolerances if whole else model.tolerances[rods],
            uv_px=uv_px,
            covariance_px=covariance_px,
            mm_per_px=mm_per_px,
            weight=None if greatest_tolerance_mm(model) > 0 else inverse_2x2(covariance_px),
        )


class View(NamedTuple):
    """The desired features seen from a pose."""

    #: (k, 2) spots of this pose, and measured minus these, px
    spots_px: FloatArray
    residual_px: FloatArray
    #: (k, 2, 2) covariance of a residual (spot noise and the frame's tolerance) and its inverse
    covariance_px: FloatArray
    weight: FloatArray
    #: (2k, 6) motion field, px per mm and rad
    jacobian: FloatArray
    #: the rods and the slice, mm
    crossing: Crossing

    def stepped(self, twist: FloatArray, lambda_mm: FloatArray) -> View:
        """What is seen after a small twist (6,), to first order in spots and residuals; λ (k,) is what it is there."""
        shift = self.jacobian.dot(twist).reshape(-1, 2)
        return View(
            spots_px=self.spots_px + shift,
            residual_px=self.residual_px - shift,
            covariance_px=self.covariance_px,
            weight=self.weight,
            jacobian=self.jacobian,
            crossing=self.crossing._replace(lambda_mm=lambda_mm),
        )

    @property
    def chi2(self) -> float:
        """Σ rᵀ W r."""
        r = self.residual_px[:, :, None]
        return float((self.weight @ r).ravel().dot(r.ravel()))

    @property
    def rms_px(self) -> float:
        """Root mean square of the residuals over both coordinates."""
        return math.sqrt(self.sum_of_squares_px2 / self.residual_px.size)

    @property
    def sum_of_squares_px2(self) -> float:
        """Σ rᵀ r."""
        r = self.residual_px.ravel()
        return float(r.dot(r))

    def weighted(self, jacobian: FloatArray) -> FloatArray:
        """``W J`` (2k, 6) of a Jacobian (2k, 6)."""
        product: FloatArray = (self.weight @ jacobian.reshape(-1, 2, 6)).reshape(-1, 6)
        return product


def view(desired: Desired, T: FloatArray, crossing: Crossing | None = None) -> View:
    """The desired features from the pose ``T`` (4, 4); not finite where one of the rods lies in the slice.

    ``crossing``: of these rods with ``T``, where it has been worked out already.
    """
    crossing = crossing or cross(T, desired.lines)
    spots, jacobian, s = crossing.xy_mm, crossing.jacobian, desired.mm_per_px
    if s is not None:
        spots = spots / s
        jacobian = jacobian / s[:, None]
    covariance, weight = desired.covariance_px, desired.weight
    if weight is None:
        k = crossing.slope
        tolerance = k[:, :, None] * k[:, None, :]
        tolerance[:, 0, 0] += 1.0
        tolerance[:, 1, 1] += 1.0
        tolerance *= (desired.tolerances**2)[:, None, None]
        if s is not None:
            tolerance /= s[:, None] * s
        covariance = covariance + tolerance
        weight = inverse_2x2(covariance)
    return View(
        spots_px=spots,
        residual_px=desired.uv_px - spots,
        covariance_px=covariance,
        weight=weight,
        jacobian=jacobian.reshape(-1, 6),
        crossing=crossing,
    )


class ServoResult(NamedTuple):
    """Where the servo ended, and the way there."""

    T: FloatArray
    view: View
    #: (6, 6) of the pose error ``[V; Ω]``, mm and rad: the Cramér–Rao bound for *updated*, a little more for *constant*
    covariance: FloatArray
    #: (6, 6) ``Jᵀ W J`` with the true Jacobian there
    information: FloatArray
    #: Σ rᵀ W r of what is left
    chi2: float
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
    return solve_positive(WJ.T @ jacobian, WJ.T)


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
    crossing: Crossing | None = None,
    keep_path: bool = False,
) -> ServoResult:
    """Move the pose until its spots are the measured ones.

    Args:
        model: the frame; its size brings rotation to millimetres.
        T: (4, 4) start.
        desired: s*.
        options: see :class:`ServoOptions`.
        jacobian: (2k, 6) Ĵ of the *constant* strategy; None: recomputed at every step (*updated*).
        crossing: of the rods with ``T``, where it has been worked out already.
        keep_path: also return every pose and spot on the way.

    Raises:
        numpy.linalg.LinAlgError: the spots do not determine the pose, or a rod came to lie in the slice on the way.
    """
    options = options or ServoOptions()
    size_mm = model.size_mm
    here = view(desired, T, crossing)
    law = ControlLaw.of(here, jacobian)
    path = [(T, here, law.margin(here, size_mm))] if keep_path else []
    iterations, before_sd = 0, 0.0
    looks_no_more = jacobian is None and options.gain == 1.0 and not keep_path
    while True:
        step, moved_sd2 = law.full_step(here)
        if not math.isfinite(moved_sd2):
            raise np.linalg.LinAlgError("a rod came to lie in the slice")
        converged = (
            moved_sd2 <= options.spot_tolerance_sd**2
            or _greatest_mm(step, size_mm) <= options.step_tolerance * size_mm
            or here.sum_of_squares_px2 <= options.residual_tolerance**2 * here.residual_px.size
        )
        if converged or iterations >= options.max_iterations:
            break
        if looks_no_more and moved_sd2 <= options.left_over_sd * before_sd:
            T = updated(T, step)
            here = here.stepped(step, lambdas(T, desired.lines))
            iterations, converged = iterations + 1, True
            break
        before_sd = math.sqrt(moved_sd2)
        turn = options.gain * math.hypot(*step[3:].tolist())
        step *= options.gain if turn <= _MAX_TURN_RAD else options.gain * _MAX_TURN_RAD / turn
        iterations += 1
        T = updated(T, step)
        here = view(desired, T)
        if jacobian is None:
            law = ControlLaw.of(here)
        if keep_path:
            path.append((T, here, law.margin(here, size_mm)))
    return ServoResult(
        T=T,
        view=here,
        covariance=law.covariance(here),
        information=law.information if jacobian is None else here.weighted(here.jacobian).T @ here.jacobian,
        chi2=here.chi2,
        iterations=iterations,
        converged=converged,
        margin=law.margin(here, size_mm) if converged else -np.inf,
        path_T=np.stack([p for p, _, _ in path]) if keep_path else None,
        path_px=np.stack([seen.spots_px for _, seen, _ in path]) if keep_path else None,
        path_margin=np.array([m for _, _, m in path]) if keep_path else None,
    )


class ControlLaw(NamedTuple):
    """``ξ = Ĵ⁺ (s* − s)`` with one Ĵ."""

    #: (2k, 6) ``W Ĵ``, and (6, 6) ``Ĵᵀ W Ĵ`` and its inverse
    weighted: FloatArray
    information: FloatArray
    inverse: FloatArray
    #: (6, 2k) Ĵ⁺ of the constant strategy; None where Ĵ is the Jacobian at hand
    J_plus: FloatArray | None

    @classmethod
    def of(cls, here: View, jacobian: FloatArray | None = None) -> ControlLaw:
        J = here.jacobian if jacobian is None else jacobian
        WJ = here.weighted(J)
        information = WJ.T.dot(J)
        inverse = inverse_positive(information)
        J_plus = None if jacobian is None else inverse.dot(WJ.T)
        return cls(weighted=WJ, information=information, inverse=inverse, J_plus=J_plus)

    def full_step(self, here: View) -> tuple[FloatArray, float]:
        """The twist (6,) of gain one, and how far it would move the spots: Σ ‖Δs‖² in sd, to first order."""
        gradient = here.residual_px.reshape(-1).dot(self.weighted)
        step = self.inverse.dot(gradient)
        return step, float(gradient.dot(step))

    def margin(self, here: View, size_mm: float) -> float:
        """:func:`stability_margin`; one where Ĵ is the Jacobian itself."""
        return 1.0 if self.J_plus is None else stability_margin(self.J_plus, here.jacobian, size_mm)

    def covariance(self, here: View) -> FloatArray:
        """(6, 6) of the pose where the law comes to rest."""
        if self.J_plus is None:
            return self.inverse
        # noise moves the pose where Ĵᵀ W r = 0 by (Ĵ⁺ J)⁻¹ Ĵ⁺
        influence = np.linalg.solve(self.J_plus @ here.jacobian, self.J_plus)
        spread = (influence.reshape(6, -1, 2).transpose(1, 0, 2) @ here.covariance_px).transpose(1, 0, 2)
        covariance: FloatArray = spread.reshape(6, -1) @ influence.T
        return covariance


def _greatest_mm(twist: FloatArray, size_mm: float) -> float:
    """The greatest part of a twist (6,), rotation measured in frame sizes, mm."""
    x, y, z, *turn = map(abs, twist.tolist())
    return float(max(x, y, z, size_mm * max(turn)))


def _unit(size_mm: float) -> FloatArray:
    return np.array([1.0, 1.0, 1.0, size_mm, size_mm, size_mm])
