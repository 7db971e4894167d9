"""Weighted Gauss–Newton on the spots: the estimate that sits at the Cramér–Rao bound, and its covariance.

Minimised is Σ rᵀ W r over the twist, r = measured − predicted spot in pixels, with ``W⁻¹`` = the spot's own
covariance plus what the frame's ``tolerance`` τ allows: a rod displaced by δ across itself shifts its spot by ``[I₂ |
−k] δ``, covariance ``τ² (I₂ + k kᵀ)``. Everything works on a stack of ``b`` hypotheses at once, each with a spot (or
none) for each of the ``n`` rods, because the matcher has thousands of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from ctreg_cli.arrays import BoolArray, FloatArray, IntArray, frozen
from ctreg_cli.geometry import pose as poses
from ctreg_cli.geometry.motion_field import motion_field, scale_jacobian
from ctreg_cli.geometry.projection import Projection, project
from ctreg_cli.rods import RodModel

#: a pose farther than this many frame sizes from where it started has diverged
_MAX_TURN_RAD = 0.4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Observations:
    """Spots assigned to rods: for each of ``b`` hypotheses and ``n`` rods the measured spot, or nothing."""

    #: (b, n, 2) px; anything where ``matched`` is False
    uv_px: FloatArray
    #: (b, n, 2, 2) px²
    covariance_px: FloatArray
    #: (b, n)
    matched: BoolArray
    #: (2,) or (b, 2) ``[s_x, s_y]``
    mm_per_px: FloatArray
    #: half the slab's thickness, mm; a rod that ends inside the slab leaves a spot off its crossing
    half_slab_mm: float = 0.0
    #: two crossings nearer than this may have left one spot, mm (in the unit of ``uv_px × mm_per_px``); 0: never
    resolved_mm: float = 0.0

    def subset(self, rows: IntArray | BoolArray) -> Observations:
        """The hypotheses ``rows`` only."""
        scale = self.mm_per_px if self.mm_per_px.ndim == 1 else self.mm_per_px[rows]
        return Observations(
            uv_px=self.uv_px[rows],
            covariance_px=self.covariance_px[rows],
            matched=self.matched[rows],
            mm_per_px=scale,
            half_slab_mm=self.half_slab_mm,
            resolved_mm=self.resolved_mm,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Linearisation:
    """The spots about a pose: residuals, weights, Jacobians, and the χ² they make."""

    #: (b, n, 2) px, zero where not matched
    residual_px: FloatArray
    #: (b, n, 2, 2) weights, px⁻², zero where not matched
    weight: FloatArray
    #: (b, n, 2, 6) of the predicted spot with respect to the twist, px per mm and rad
    jacobian: FloatArray
    #: (b,) χ²; infinite where a matched rod lies in the slice
    chi2: FloatArray
    #: (b, n) where the slice cuts each rod, mm
    lambda_mm: FloatArray
    #: (b, n, 2) predicted spots, px
    predicted_px: FloatArray

    def subset(self, rows: IntArray | BoolArray) -> Linearisation:
        """The hypotheses ``rows`` only."""
        return Linearisation(**{name: getattr(self, name)[rows] for name in self.__dataclass_fields__})

    def take(self, rows: IntArray, others: Linearisation, chosen: BoolArray) -> None:
        """Overwrite these rows by the ``chosen`` ones of ``others``, in place: refinement does so at every step."""
        for name in self.__dataclass_fields__:
            getattr(self, name)[rows] = getattr(others, name)[chosen]

    def normal_equations(self) -> tuple[FloatArray, FloatArray]:
        """Information ``Jᵀ W J`` (b, 6, 6) and gradient ``Jᵀ W r`` (b, 6)."""
        b, n = self.residual_px.shape[:2]
        J = self.jacobian.reshape(b, 2 * n, 6)
        WJ = (self.weight @ self.jacobian).reshape(b, 2 * n, 6)
        gradient = (self.residual_px.reshape(b, 1, 2 * n) @ WJ)[:, 0]
        return J.transpose(0, 2, 1) @ WJ, gradient

    def promised_chi2(self, size_mm: float) -> FloatArray:
        """The χ² (b,) that one Gauss–Newton step would leave if the spots moved in straight lines."""
        H, g = self.normal_equations()
        unit = np.array([1, 1, 1, *(3 * [1 / size_mm])])
        g *= unit
        promised: FloatArray = self.chi2 - (g * gauss_newton_step(H * (unit[:, None] * unit), g)).sum(axis=1)
        return promised


def gauss_newton_step(H: FloatArray, g: FloatArray) -> FloatArray:
    """Steps (..., 6) of information ``H`` (..., 6, 6) and gradients (..., 6), rotation measured in frame sizes.

    ``H`` is damped in place by a billionth, so that what the spots say nothing of stays where it is.
    """
    diagonal = np.einsum("...ii->...i", H)  # a view
    diagonal += 1e-9 * diagonal.max(axis=-1, keepdims=True) + 1e-300
    return np.asarray(np.linalg.solve(H, g[..., None])[..., 0], dtype=np.float64)


#: share of a determinant that rounding can hide
_ROUNDING = 4e-16


def invert_2x2(matrices: FloatArray) -> FloatArray:
    """Inverses of positive definite (..., 2, 2) matrices, in closed form.

    Where rounding leaves no determinant (a rod with a tolerance that all but lies in the slice), it is taken to be as
    large as rounding can hide.
    """
    a, b, c, d = matrices[..., 0, 0], matrices[..., 0, 1], matrices[..., 1, 0], matrices[..., 1, 1]
    det = a * d
    det -= b * c
    if not (det > 0).all():
        det = np.maximum(det, _ROUNDING * (a * d))
    result: FloatArray = np.empty_like(matrices)
    result[..., 0, 0], result[..., 0, 1], result[..., 1, 0], result[..., 1, 1] = d, -b, -c, a
    result /= det[..., None, None]
    return result


#: diameter of rods whose frame file gives none, mm
UNKNOWN_DIAMETER_MM = 2.0


@lru_cache(maxsize=16)
def _radii(model: RodModel) -> FloatArray:
    """(n,) mm; cached, since a model is a value that never changes."""
    return frozen([0.5 * (rod.diameter_mm or UNKNOWN_DIAMETER_MM) for rod in model.rods], (None,))


@lru_cache(maxsize=16)
def rod_end_reach(model: RodModel, half_slab_mm: float) -> float:
    """Beyond this, mm of z, no end shifts a spot, however its rod lies; see :func:`rod_end_shift`."""
    radius = float(_radii(model).max())
    # a face is half a radius squared over half the slab at most
    return 2 * half_slab_mm + radius + 0.5 * radius * radius / half_slab_mm


def rod_end_shift(model: RodModel, slope: FloatArray, lambda_mm: FloatArray, half_slab_mm: float) -> FloatArray:
    """How far along ``slope`` (..., n), mm of z, a spot may lie off its crossing because its rod ends in the slab.

    The spot is the mean of what metal the slab holds. Where the end leaves a length of the slab's height empty, its
    middle lies half that length off the mid-plane, and the spot as much times the slope. Where the oblique face of the
    end crosses the slab, half-moons are left of discs, whose middles lie up to half a radius to the side. What is left
    is seen as long as it is a third of the metal: ``h + face``, ``h`` half the slab, bounds what that does.

    It is charged in full where the end may lie in the slab, and less and less as far beyond as it could have moved the
    pose: rods that end together carry the pose with them, and seen from there their ends are farther off by as much.

    Args:
        model: the rods.
        slope: (..., n, 2) of the rods.
        lambda_mm: (..., n) where along them they are crossed.
        half_slab_mm: half the slab's thickness, not zero.
    """
    squared = (slope * slope).sum(axis=-1)
    rise = 1 / np.sqrt(1 + squared)  # mm of z per mm of rod
    tangent = np.sqrt(squared)
    face_height = _radii(model) * tangent * rise  # of half the face, mm
    face = 0.5 * _radii(model) * np.minimum(1.0, face_height / half_slab_mm) / np.maximum(tangent, 1e-9)
    reach = 2 * half_slab_mm + face
    beyond = reach + face_height - np.minimum(lambda_mm, model.lengths - lambda_mm) * rise
    result: FloatArray = (half_slab_mm + face) * np.clip(beyond / reach, 0, 1)
    return result


def spot_covariance(
    model: RodModel,
    slope: FloatArray,
    covariance_px: FloatArray,
    mm_per_px: FloatArray,
    shift_mm: FloatArray | None = None,
) -> FloatArray:
    """Covariance (..., n, 2, 2) in px² of measured minus predicted spots: noise, the frame's tolerance, rod ends."""
    scale = mm_per_px[..., None, :]
    k = slope / scale
    extra = k[..., :, None] * k[..., None, :]
    extra[..., 0, 0] += 1 / scale[..., 0] ** 2
    extra[..., 1, 1] += 1 / scale[..., 1] ** 2
    result: FloatArray = covariance_px + (model.tolerances**2)[:, None, None] * extra
    if shift_mm is not None:
        result = result + (shift_mm**2)[..., None, None] * (k[..., :, None] * k[..., None, :])
    return result


def merged_covariance(
    model: RodModel, xy_mm: FloatArray, lambda_mm: FloatArray, matched: BoolArray, resolved_mm: float
) -> FloatArray | None:
    """Covariance (b, n, 2, 2) in mm² of what a rod without a spot does to the spot of a rod it crosses beside.

    The two may have left one spot, whose centre lies between the crossings: half the gap ``g`` off, ``g gᵀ / 4``. Fully
    so up to half the distance that two spots need, then less and less; smooth, so that the cost is.

    Args:
        model: the rods.
        xy_mm: (b, n, 2) crossings.
        lambda_mm: (b, n) where along the rods.
        matched: (b, n) rods with a spot.
        resolved_mm: how near two crossings may come and leave two spots.

    Returns:
        The covariances, or None where there are none.
    """
    lost = ~matched
    lost &= lambda_mm >= 0
    lost &= lambda_mm <= model.lengths
    row, rod = np.nonzero(lost)
    if not len(row):
        return None
    gap = xy_mm[row, rod][:, None] - xy_mm[row]  # (lost, matched, 2)
    distance2 = gap[..., 0] * gap[..., 0]
    distance2 += gap[..., 1] * gap[..., 1]
    is_near = distance2 < resolved_mm**2
    is_near &= matched[row]
    if not is_near.any():
        return None
    near = np.nonzero(is_near)
    g = gap[near]
    share = np.clip(2 - 2 * np.sqrt(distance2[near]) / resolved_mm, 0, 1)
    result = np.zeros((*matched.shape, 2, 2))
    np.add.at(result, (row[near[0]], near[1]), (share / 4)[:, None, None] * g[:, :, None] * g[:, None, :])
    return result


def linearise(model: RodModel, T: FloatArray, observations: Observations) -> Linearisation:
    """Residuals, weights and Jacobians of ``b`` hypotheses at poses ``T`` (b, 4, 4)."""
    o = observations
    projection = project(T, model.starts, model.directions)
    scale = o.mm_per_px[..., None, :]
    predicted = projection.xy_mm / scale
    used, slope = o.matched, projection.slope
    cut = np.isfinite(predicted[..., 0])  # not where a rod lies in the slice
    all_cut = bool(cut.all())
    if not all_cut:
        used = used & cut
        slope = np.where(used[..., None], slope, 0.0)
    W = _weight(model, projection, slope, used, o)
    r = np.where(used[..., None], o.uv_px - predicted, 0.0)
    J = motion_field(T, projection)
    J /= scale[..., None]
    if not all_cut:
        J[~cut] = 0.0
    chi2 = ((W @ r[..., None])[..., 0] * r).sum(axis=(1, 2))
    if not all_cut:
        chi2[(used != o.matched).any(axis=1)] = np.inf
    return Linearisation(
        residual_px=r, weight=W, jacobian=J, chi2=chi2, lambda_mm=projection.lambda_mm, predicted_px=predicted
    )


def _weight(model: RodModel, projection: Projection, slope: FloatArray, used: BoolArray, o: Observations) -> FloatArray:
    """Weights (b, n, 2, 2) of the ``used`` (b, n) spots, zero elsewhere; ``slope`` (b, n, 2) is finite."""
    scale = o.mm_per_px[..., None, :]
    covariance, shift = o.covariance_px, None
    if o.half_slab_mm > 0:
        shift = rod_end_shift(model, slope, np.where(used, projection.lambda_mm, 0.5 * model.lengths), o.half_slab_mm)
        if not shift.any():
            shift = None
    if shift is not None or model.tolerances.any():
        covariance = spot_covariance(model, slope, covariance, o.mm_per_px, shift)
    if o.resolved_mm > 0:
        blur = merged_covariance(model, projection.xy_mm, projection.lambda_mm, used, o.resolved_mm)
        if blur is not None:
            covariance = covariance + blur / (scale[..., :, None] * scale[..., None, :])
    W = invert_2x2(covariance)
    W[~used] = 0.0
    return W


def refine(
    model: RodModel, T: FloatArray, observations: Observations, *, iterations: int = 12, step_tolerance: float = 1e-9
) -> tuple[FloatArray, Linearisation, int]:
    """Minimise χ² over the poses of a stack of hypotheses by Levenberg–Marquardt.

    Args:
        model: the rods.
        T: (b, 4, 4) starting poses.
        observations: spots assigned to rods, at least three a hypothesis.
        iterations: at most so many steps.
        step_tolerance: stop when no step moves any pose by more than this, in frame sizes and rad.

    Returns:
        Poses (b, 4, 4), the linearisation there, and the number of steps taken.
    """
    unit = np.array([1, 1, 1, *(3 * [1 / model.size_mm])])  # mm and rad brought to one size
    T = np.array(T)
    here = linearise(model, T, observations)
    damping = np.full(len(T), 1e-4)
    active = np.arange(len(T))
    steps = 0
    while steps < iterations and len(active):
        steps += 1
        part = here if len(active) == len(T) else here.subset(active)
        seen = observations if len(active) == len(T) else observations.subset(active)
        H, g = part.normal_equations()
        H *= unit[:, None] * unit
        diagonal = H.reshape(-1, 36)[:, ::7]  # a view
        damped = diagonal * (1.0 + damping[active, None])
        damped += 1e-12 * diagonal.max(axis=1, keepdims=True) + 1e-300
        diagonal[...] = damped
        step = np.linalg.solve(H, (g * unit)[..., None])[..., 0]
        step *= unit
        turn2 = (step[:, 3:] * step[:, 3:]).sum(axis=1)
        if turn2.max() > _MAX_TURN_RAD**2:
            step *= np.minimum(1, _MAX_TURN_RAD / np.sqrt(np.maximum(turn2, 1e-300)))[:, None]
        T_new = poses.update(T[active], step)
        there = linearise(model, T_new, seen)
        better = there.chi2 <= part.chi2
        damping[active] = np.where(better, damping[active] * 0.1, np.minimum(damping[active] * 10, 1e8))
        size = np.abs(step / unit).max(axis=1) / model.size_mm
        if len(active) == len(T) and better.all():
            T, here = T_new, there
        else:
            T[active[better]] = T_new[better]
            here.take(active[better], there, better)
        active = active[size > step_tolerance]
    return T, here, steps


def covariance_from_information(H: FloatArray, size_mm: float) -> tuple[FloatArray, FloatArray]:
    """Pose covariances (..., 6, 6) and condition numbers (...,) from information matrices.

    Rotation is measured in frame sizes while judging rank; a direction the spots say nothing of gets an infinite
    condition and a huge, finite variance (10⁶ mm²), so that it shows instead of being lost.
    """
    unit = np.array([1, 1, 1, *(3 * [1 / size_mm])])
    values, vectors = np.linalg.eigh(H * (unit[:, None] * unit))
    largest = np.maximum(values[..., -1:], 1e-300)
    singular = values <= 1e-12 * largest
    variance = np.where(singular, 1e6, 1 / np.maximum(values, 1e-300))
    scaled = (vectors * variance[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    condition = np.sqrt(largest[..., 0] / np.maximum(values[..., 0], 1e-24 * largest[..., 0] + 1e-300))
    return scaled * (unit[:, None] * unit), np.where(singular.any(axis=-1), np.inf, condition)


def principal_axes(covariance: FloatArray, size_mm: float) -> tuple[FloatArray, FloatArray]:
    """Variances (6,), rising, and twists (6, 6), one a column, of a pose covariance (6, 6); rotation in frame sizes.

    A twist has the length of 1 mm, and the variances are mm².
    """
    unit = np.array([1, 1, 1, *(3 * [size_mm])])
    values, vectors = np.linalg.eigh(covariance * (unit[:, None] * unit))
    return values, vectors / unit[:, None]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScaleFit:
    """Shared pixel scales and one pose a slice."""

    mm_per_px: FloatArray
    #: (2, 2) covariance of ``[s_x, s_y]``
    covariance: FloatArray
    #: (b, 4, 4) poses, and (b, 6, 6) their covariances with the uncertain scale in them
    T: FloatArray
    pose_covariance: FloatArray
    linearisation: Linearisation
    #: total χ² and degrees of freedom
    chi2: float
    degrees_of_freedom: int
    converged: bool


def refine_scales(
    model: RodModel,
    T: FloatArray,
    observations: Observations,
    *,
    prior_mm_per_px: FloatArray | None = None,
    prior_sd: FloatArray | None = None,
    iterations: int = 50,
) -> ScaleFit:
    """Minimise χ² over the poses of ``b`` slices *and* the pixel scales they share (``observations.mm_per_px`` starts
    them).

    The normal equations are an arrow: a 6 × 6 block a slice, and two columns all slices share, eliminated by the Schur
    complement. The scales move in their logarithms, so that they stay positive.

    A frame's ``tolerance`` is a constant error of each rod: it does not average out over slices. It is therefore
    estimated along, two more shared unknowns a rod with the tolerance as prior, not treated as fresh noise in every
    slice.
    """
    n = len(model)
    loose = model.tolerances > 0
    n_shift = 2 * int(loose.sum())
    m = 2 + n_shift
    frames = across(model.directions)
    log_scale = np.log(np.asarray(observations.mm_per_px, dtype=np.float64))
    shift = np.zeros((n, 2))
    unit = np.array([1, 1, 1, *(3 * [1 / model.size_mm])])
    rigid = model_without_tolerance(model)
    damping, chi2, converged = 1e-4, np.inf, False
    prior_log = None if prior_mm_per_px is None else np.log(prior_mm_per_px)
    prior_weight = np.zeros(2) if prior_sd is None or prior_mm_per_px is None else (prior_mm_per_px / prior_sd) ** 2

    def evaluate(T: FloatArray, log_scale: FloatArray, shift: FloatArray) -> tuple[Linearisation, FloatArray, float]:
        moved = displaced(rigid, np.einsum("nij,nj->ni", frames, shift))
        scale = np.exp(log_scale)
        o = Observations(
            uv_px=observations.uv_px,
            covariance_px=observations.covariance_px,
            matched=observations.matched,
            mm_per_px=scale,
        )
        lin = linearise(moved, T, o)
        projection = project(T, moved.starts, moved.directions)
        K = np.zeros((len(T), n, 2, m))
        K[..., :2] = scale_jacobian(np.nan_to_num(projection.xy_mm), scale) * scale
        if n_shift:
            d_slice = np.einsum("bij,njk->bnik", T[:, :3, :3], frames)  # columns across the rod, slice axes
            slide = d_slice[:, :, :2, :] - projection.slope[..., :, None] * d_slice[:, :, 2:, :]
            slide = np.nan_to_num(slide) / scale[:, None]
            for column, rod in enumerate(np.nonzero(loose)[0]):
                K[:, rod, :, 2 + 2 * column : 4 + 2 * column] = slide[:, rod]
        cost = float(lin.chi2.sum())
        if prior_log is not None:
            cost += float((prior_weight * (log_scale - prior_log) ** 2).sum())
        cost += float(((shift[loose] / model.tolerances[loose, None]) ** 2).sum())
        return lin, K, cost

    lin, K, chi2 = evaluate(T, log_scale, shift)
    C = np.zeros((m, m))
    for _ in range(iterations):
        H, g = lin.normal_equations()
        H, g = H * (unit[:, None] * unit), g * unit
        WK = lin.weight @ K
        B = np.einsum("bnki,bnkj->bij", lin.jacobian, WK) * unit[:, None]  # (b, 6, m)
        C = np.einsum("bnki,bnkj->ij", K, WK)
        c = np.einsum("bnki,bnk->i", WK, lin.residual_px)
        C[:2, :2] += np.diag(prior_weight)
        if prior_log is not None:
            c[:2] -= prior_weight * (log_scale - prior_log)
        weight_shift = np.repeat(1 / model.tolerances[loose] ** 2, 2)
        C[np.arange(2, m), np.arange(2, m)] += weight_shift
        c[2:] -= weight_shift * shift[loose].reshape(-1)
        Hd = H.copy()
        diagonal = np.einsum("bii->bi", H)
        np.einsum("bii->bi", Hd)[...] += damping * diagonal + 1e-12 * diagonal.max(axis=1, keepdims=True) + 1e-300
        Hi_B, Hi_g = np.linalg.solve(Hd, B), np.linalg.solve(Hd, g[..., None])[..., 0]
        S = C + damping * np.diag(np.diag(C)) - np.einsum("bij,bik->jk", B, Hi_B)
        step_shared = np.linalg.lstsq(S, c - np.einsum("bij,bi->j", B, Hi_g), rcond=1e-14)[0]
        step_pose = (Hi_g - Hi_B @ step_shared) * unit
        turn = np.linalg.norm(step_pose[:, 3:], axis=1).max()
        shrink = min(
            1.0, _MAX_TURN_RAD / max(float(turn), 1e-300), 0.2 / max(float(np.abs(step_shared[:2]).max()), 1e-300)
        )
        T_new = poses.update(T, shrink * step_pose)
        log_new = log_scale + shrink * step_shared[:2]
        shift_new = shift.copy()
        shift_new[loose] += shrink * step_shared[2:].reshape(-1, 2)
        lin_new, K_new, chi2_new = evaluate(T_new, log_new, shift_new)
        small = max(float(np.abs(step_shared[:2]).max()), float(np.abs(step_pose / unit).max()) / model.size_mm) < 1e-9
        if chi2_new <= chi2:
            T, log_scale, shift, lin, K, chi2 = T_new, log_new, shift_new, lin_new, K_new, chi2_new
            damping *= 0.1
        else:
            damping = min(damping * 10, 1e8)
        if small:
            converged = True
            break
    scale = np.exp(log_scale)
    H, _ = lin.normal_equations()
    H = H * (unit[:, None] * unit)
    WK = lin.weight @ K
    B = np.einsum("bnki,bnkj->bij", lin.jacobian, WK) * unit[:, None]
    C = np.einsum("bnki,bnkj->ij", K, WK)
    C[:2, :2] += np.diag(prior_weight)
    C[np.arange(2, m), np.arange(2, m)] += np.repeat(1 / model.tolerances[loose] ** 2, 2)
    Hi, _ = covariance_from_information(H, 1.0)
    S = C - np.einsum("bij,bik,bkl->jl", B, Hi, B)
    shared_covariance = np.linalg.pinv(S, hermitian=True)
    Hi_B = Hi @ B
    pose_covariance = (Hi + Hi_B @ shared_covariance @ np.swapaxes(Hi_B, 1, 2)) * (unit[:, None] * unit)
    used = int(observations.matched.sum())
    return ScaleFit(
        mm_per_px=scale,
        covariance=shared_covariance[:2, :2] * (scale[:, None] * scale),
        T=T,
        pose_covariance=pose_covariance,
        linearisation=lin,
        chi2=chi2,
        degrees_of_freedom=2 * used - 6 * len(T) - (2 if prior_sd is None else 0),
        converged=converged,
    )


def across(directions: FloatArray) -> FloatArray:
    """(n, 3, 2) two unit columns across each rod."""
    helper = np.eye(3)[np.abs(directions).argmin(axis=1)]
    first = np.cross(directions, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(directions, first)], axis=2)


def displaced(model: RodModel, shift_mm: FloatArray) -> RodModel:
    """The model with each rod moved by ``shift_mm`` (n, 3) as a whole."""
    rods = tuple(
        replace(rod, start=rod.start + d, end=rod.end + d) for rod, d in zip(model.rods, shift_mm, strict=True)
    )
    return replace(model, rods=rods)


def model_without_tolerance(model: RodModel) -> RodModel:
    """The model with its rods taken to be exactly where they are written."""
    return replace(model, rods=tuple(replace(rod, tolerance_mm=0.0) for rod in model.rods))
