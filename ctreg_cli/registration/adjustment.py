"""Poses, rods and scales from many slices at once: least squares over all that they share (bundle adjustment).

A frame's ``tolerance`` τ is a lasting error of each rod: it does not average out over slices. So the rods' true
lines are unknowns too, two shifts across at either end of a rod. Their prior: the rod is off as a whole by τ, and
tilted by as much at its ends, which makes the shifts of the two ends independent with sd √2 τ. (A tenth of τ is left
for a bow, as noise of every spot.) What the slices do not say of a rod the prior decides, and the covariance of the
pose holds what remains open of both.

The normal equations are an arrow: a 6 × 6 block a pose, and the columns all poses share, eliminated by the Schur
complement as in :func:`~ctreg_cli.registration.refine.refine_scales`. A twist here is in *patient* axes:
``V_slice = R V_patient``, ``Ω`` alike, since both are taken at the model origin.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from ctreg_cli.arrays import BoolArray, FloatArray, IntArray
from ctreg_cli.geometry import pose as poses
from ctreg_cli.geometry.motion_field import scale_jacobian
from ctreg_cli.geometry.projection import project
from ctreg_cli.registration.refine import Linearisation, Observations, across, linearise
from ctreg_cli.registration.register import INFLATE_P
from ctreg_cli.rods import RodModel

#: a spot farther off than this (Mahalanobis², two degrees of freedom) belongs to no rod
_OUTLIER2 = 20.0
#: median of χ² with two degrees of freedom: what the middle spot's Mahalanobis² is when the covariances are true
_MEDIAN_CHI2_2 = 2 * math.log(2)
#: a rod that may lie off by its tolerance is not straight either: so much of it is left as noise of every spot
BOW_SHARE = 0.1
_ROUNDS = 6
_ITERATIONS = 60
_STEP_TOLERANCE = 1e-9
#: largest step: rotation in rad, and logarithm of a scale
_MAX_TURN_RAD, _MAX_LOG_SCALE = 0.4, 0.2
_FIRST_DAMPING, _MAX_DAMPING = 1e-4, 1e8


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScanSpots:
    """The labelled spots of ``b`` slices whose places are known, and which of ``g`` poses each slice shows."""

    #: (b, n, ·) spots by rod; ``mm_per_px`` is (b, 2)
    observations: Observations
    #: (b, 4, 4) slice → patient, mm
    T_patient_slice: FloatArray
    #: (b,) index of the pose
    pose_index: IntArray

    def matching(self, matched: BoolArray) -> ScanSpots:
        """The same with other matches (b, n)."""
        return replace(self, observations=replace(self.observations, matched=matched))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Adjustment:
    """Where the sum of squares is least, and how sure that is."""

    #: (g, 4, 4) model → patient, and (g, 6, 6) covariance of the twist, patient axes, mm and rad
    T_patient_model: FloatArray
    covariance: FloatArray
    #: (n, 2, 3) shift of each rod's start and end from the written ones, model frame, mm
    shift_mm: FloatArray
    #: (4 n, 4 n) covariance of the shifts' components across (rod, end, component), mm²; zero for rods held fast
    shift_covariance: FloatArray
    #: (2,) logarithm of estimated over stated scale, and (2, 2) its covariance; zero where the scales were held fast
    log_scale: FloatArray
    log_scale_covariance: FloatArray
    #: (b, n) spots that took part
    matched: BoolArray
    #: (b, n, 2) measured minus predicted, px, the rods where they were found to be
    residual_px: FloatArray
    #: χ² of spots and priors, its degrees of freedom, and what it makes of the standard deviations (all
    #: covariances above are widened by its square already)
    chi2: float
    degrees_of_freedom: int
    inflation: float

    @property
    def rms_px(self) -> float:
        """Over both coordinates of all spots that took part."""
        return float(np.sqrt((self.residual_px[self.matched] ** 2).mean()))


def adjust(
    model: RodModel, T_patient_model: FloatArray, scan: ScanSpots, *, free_scales: bool = False, reject: bool = True
) -> Adjustment:
    """Minimise χ² over poses, rods and, if asked, a factor on each scale; spots that fit nowhere are left out.

    Args:
        model: the rods; those with a tolerance may move.
        T_patient_model: (g, 4, 4) starting poses.
        scan: the labelled spots.
        free_scales: also estimate the scales.
        reject: leave out spots that fit nowhere.
    """
    problem = everything = _Problem(model, scan, free_scales)
    state = problem.start(T_patient_model)
    for _ in range(_ROUNDS):
        state = problem.minimise(state)
        if not reject:
            break
        keep = scan.observations.matched & ~_outliers(everything, state)
        if (keep == problem.scan.observations.matched).all():
            break
        problem = _Problem(model, scan.matching(keep), free_scales)
    return problem.report(state)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _State:
    """Values of all unknowns."""

    T: FloatArray
    #: (n, 2, 2) rod, end, component across
    shift: FloatArray
    log_scale: FloatArray


class _Problem:
    """The sum of squares and its derivatives."""

    def __init__(self, model: RodModel, scan: ScanSpots, free_scales: bool) -> None:
        self.model = model
        self.scan = scan
        rods = tuple(replace(rod, tolerance_mm=BOW_SHARE * rod.tolerance_mm) for rod in model.rods)
        self.written = replace(model, rods=rods)
        self.frames = across(model.directions)
        self.loose = np.nonzero(model.tolerances > 0)[0]
        self.n_scales = 2 if free_scales else 0
        self.n_shared = 4 * len(self.loose) + self.n_scales
        self.prior_weight = np.concatenate(
            [np.repeat(0.5 / model.tolerances[self.loose] ** 2, 4), np.zeros(self.n_scales)]
        )
        self.unit = np.array([1, 1, 1, *(3 * [1 / model.size_mm])])

    def start(self, T: FloatArray) -> _State:
        return _State(T=np.array(T), shift=np.zeros((len(self.model), 2, 2)), log_scale=np.zeros(2))

    def shared(self, state: _State) -> FloatArray:
        """The unknowns all poses share, as a vector."""
        values: FloatArray = np.concatenate([state.shift[self.loose].ravel(), state.log_scale[: self.n_scales]])
        return values

    def moved(self, state: _State, step_pose: FloatArray, step_shared: FloatArray) -> _State:
        shift = state.shift.copy()
        n_shift = 4 * len(self.loose)
        shift[self.loose] += step_shared[:n_shift].reshape(-1, 2, 2)
        log_scale = state.log_scale.copy()
        log_scale[: self.n_scales] += step_shared[n_shift:]
        return _State(T=poses.update(state.T, step_pose), shift=shift, log_scale=log_scale)

    def shift_mm(self, state: _State) -> FloatArray:
        """(n, 2, 3) shifts of starts and ends, model frame."""
        moved: FloatArray = np.einsum("nij,nej->nei", self.frames, state.shift)
        return moved

    def evaluate(self, state: _State) -> tuple[Linearisation, FloatArray, FloatArray, float]:
        """The spots about a state, Jacobians by pose (b, n, 2, 6) and by shared unknowns (b, n, 2, m), the cost."""
        o = self.scan.observations
        rods = tuple(
            replace(rod, start=rod.start + d[0], end=rod.end + d[1])
            for rod, d in zip(self.written.rods, self.shift_mm(state), strict=True)
        )
        model = replace(self.written, rods=rods)
        scale = o.mm_per_px * np.exp(state.log_scale)
        T = poses.inverse(self.scan.T_patient_slice) @ state.T[self.scan.pose_index]
        lin = linearise(model, T, replace(o, mm_per_px=scale))
        turn = np.swapaxes(self.scan.T_patient_slice[:, :3, :3], 1, 2)[:, None]
        by_pose = np.concatenate([lin.jacobian[..., :3] @ turn, lin.jacobian[..., 3:] @ turn], axis=-1)
        projection = project(T, model.starts, model.directions)
        by_shared = np.zeros((*lin.residual_px.shape, self.n_shared))
        if len(self.loose):
            share = lin.lambda_mm / model.lengths
            d_slice = np.einsum("bij,njk->bnik", T[:, :3, :3], self.frames)
            slide = d_slice[:, :, :2] - projection.slope[..., :, None] * d_slice[:, :, 2:]
            slide = slide / scale[:, None, :, None]
            for place, rod in enumerate(self.loose):
                for end, weight in enumerate((1 - share[:, rod], share[:, rod])):
                    column = 4 * place + 2 * end
                    by_shared[:, rod, :, column : column + 2] = weight[:, None, None] * slide[:, rod]
        if self.n_scales:
            for row, s in enumerate(scale):
                by_shared[row, ..., -2:] = scale_jacobian(projection.xy_mm[row], s) * s
        used = o.matched[..., None, None]
        by_shared = np.where(used, np.nan_to_num(by_shared), 0.0)
        cost = float(lin.chi2.sum()) + float(self.prior_weight @ self.shared(state) ** 2)
        return lin, by_pose, by_shared, cost

    def blocks(self, lin: Linearisation, by_pose: FloatArray, by_shared: FloatArray) -> tuple[FloatArray, ...]:
        """Information of poses (g, 6, 6), poses × shared (g, 6, m), shared (m, m); gradients (g, 6) and (m,)."""
        g = int(self.scan.pose_index.max()) + 1
        J = by_pose * self.unit
        WJ, WK = lin.weight @ J, lin.weight @ by_shared
        A, B, a = np.zeros((g, 6, 6)), np.zeros((g, 6, self.n_shared)), np.zeros((g, 6))
        np.add.at(A, self.scan.pose_index, np.einsum("bnki,bnkj->bij", J, WJ))
        np.add.at(B, self.scan.pose_index, np.einsum("bnki,bnkj->bij", J, WK))
        np.add.at(a, self.scan.pose_index, np.einsum("bnki,bnk->bi", WJ, lin.residual_px))
        C = np.einsum("bnki,bnkj->ij", by_shared, WK, optimize=True) + np.diag(self.prior_weight)
        c = np.einsum("bnki,bnk->i", WK, lin.residual_px)
        return A, B, C, a, c

    def minimise(self, state: _State) -> _State:
        """Levenberg–Marquardt."""
        lin, by_pose, by_shared, cost = self.evaluate(state)
        damping = _FIRST_DAMPING
        for _ in range(_ITERATIONS):
            A, B, C, a, c = self.blocks(lin, by_pose, by_shared)
            c = c - self.prior_weight * self.shared(state)
            diagonal = np.einsum("gii->gi", A)
            floor = 1e-12 * diagonal.max(axis=1, keepdims=True) + 1e-300
            A = A + np.eye(6) * (damping * diagonal + floor)[:, None, :]
            Ai_B, Ai_a = np.linalg.solve(A, B), np.linalg.solve(A, a[..., None])[..., 0]
            step_shared = np.zeros(self.n_shared)
            if self.n_shared:
                S = C + damping * np.diag(np.diag(C)) - np.einsum("gij,gik->jk", B, Ai_B)
                step_shared = np.linalg.lstsq(S, c - np.einsum("gij,gi->j", B, Ai_a), rcond=1e-14)[0]
            step_pose = (Ai_a - Ai_B @ step_shared) * self.unit
            shrink = 1.0
            for largest, limit in (
                (np.linalg.norm(step_pose[:, 3:], axis=1).max(), _MAX_TURN_RAD),
                (np.abs(step_shared[self.n_shared - self.n_scales :]).max(initial=0.0), _MAX_LOG_SCALE),
            ):
                shrink = min(shrink, limit / max(float(largest), 1e-300))
            there = self.moved(state, shrink * step_pose, shrink * step_shared)
            found = self.evaluate(there)
            size = max(float(np.abs(step_pose / self.unit).max()), float(np.abs(step_shared).max(initial=0.0)))
            if found[3] <= cost:
                state, (lin, by_pose, by_shared, cost) = there, found
                damping *= 0.1
            else:
                damping = min(damping * 10, _MAX_DAMPING)
            if size < _STEP_TOLERANCE * self.model.size_mm:
                break
        return state

    def report(self, state: _State) -> Adjustment:
        lin, by_pose, by_shared, cost = self.evaluate(state)
        A, B, C, _, _ = self.blocks(lin, by_pose, by_shared)
        Ai = np.linalg.pinv(A, hermitian=True)
        Ai_B = Ai @ B
        shared = np.linalg.pinv(C - np.einsum("gij,gik->jk", B, Ai_B), hermitian=True)
        covariance = (Ai + Ai_B @ shared @ np.swapaxes(Ai_B, 1, 2)) * (self.unit[:, None] * self.unit)
        dof = 2 * int(self.scan.observations.matched.sum()) - 6 * len(state.T) - self.n_scales
        inflation = math.sqrt(cost / dof) if dof > 0 and chdtrc(dof, cost) < INFLATE_P else 1.0
        n_shift = 4 * len(self.loose)
        place = (4 * self.loose[:, None] + np.arange(4)).ravel()
        shift_covariance = np.zeros((4 * len(self.model), 4 * len(self.model)))
        shift_covariance[np.ix_(place, place)] = shared[:n_shift, :n_shift] * inflation**2
        log_scale_covariance = np.zeros((2, 2))
        if self.n_scales:
            log_scale_covariance = shared[n_shift:, n_shift:] * inflation**2
        return Adjustment(
            T_patient_model=state.T,
            covariance=covariance * inflation**2,
            shift_mm=self.shift_mm(state),
            shift_covariance=shift_covariance,
            log_scale=state.log_scale,
            log_scale_covariance=log_scale_covariance,
            matched=self.scan.observations.matched,
            residual_px=lin.residual_px,
            chi2=cost,
            degrees_of_freedom=dof,
            inflation=inflation,
        )


def _outliers(problem: _Problem, state: _State) -> BoolArray:
    """Spots (b, n) that fit nowhere, also when all spots are worse than believed."""
    lin = problem.evaluate(state)[0]
    distance2 = np.einsum("bni,bnij,bnj->bn", lin.residual_px, lin.weight, lin.residual_px)
    usual = float(np.median(distance2[problem.scan.observations.matched]))
    result: BoolArray = distance2 > _OUTLIER2 * max(1.0, usual / _MEDIAN_CHI2_2)
    return result
