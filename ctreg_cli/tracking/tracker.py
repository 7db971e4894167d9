"""The frame from slice to slice: predict, gate, assign, servo, verify, lose, re-register.

A tracked pose is believed for the same reasons as a registered one, and one more: it lies where the past said it would.
What fails a check is not forced: the slice is registered anew from all its spots, and if that fails too the frame is lost,
and said to be. A symmetric frame's second pose is excluded by the past only while the past is certain.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import chdtrc

from ctreg_cli.arrays import FloatArray, IntArray
from ctreg_cli.geometry import pose as poses
from ctreg_cli.geometry.motion_field import motion_field
from ctreg_cli.geometry.projection import project
from ctreg_cli.imaging.slice import SliceInfo
from ctreg_cli.imaging.spots import Spots
from ctreg_cli.registration.evidence import PosePrior, log_odds
from ctreg_cli.registration.matching import Scene, assign, nearest_assignment, observations, visibility
from ctreg_cli.registration.options import TrackingOptions
from ctreg_cli.registration.refine import covariance_from_information, linearise
from ctreg_cli.registration.register import (
    BAD_FIT_P,
    accepted_log_odds,
    assemble_candidate,
    fit_warnings,
    make_scene,
    register,
)
from ctreg_cli.registration.result import Candidate, Registration
from ctreg_cli.rods import RodModel
from ctreg_cli.scale import Scale
from ctreg_cli.tracking.servo import LEAST_MARGIN, ServoOptions, servo, weighted_pseudoinverse

#: a new pose farther from the prediction than this (χ² of six degrees of freedom) is not a continuation
_INNOVATION2 = 35.0
#: motion between two slices before any has been seen: standard deviations, mm and rad
_FIRST_STEP = (3.0, math.radians(3.0))
#: motion never taken to be steadier than this from slice to slice, mm and rad
_LEAST_STEP = (0.3, math.radians(0.3))
#: weight of the newest innovation in the running estimate of how the frame moves
_ADAPT = 0.25
#: matches below which a tracked pose is registered anew
_LEAST_MATCHES = 5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tracked:
    """The verdict on one slice of a sequence."""

    registration: Registration
    #: ``registered`` | ``updated`` | ``constant`` | ``reacquired``; empty without a pose
    method: str
    #: smallest eigenvalue of the symmetric part of Ĵ⁺J, scaled; None without a pose
    stability: float | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prediction:
    """Where the frame should be in the next slice."""

    T: FloatArray
    #: (6, 6) of the twist from the prediction to the truth
    covariance: FloatArray
    #: (n, 2) px, and whether each rod may be seen
    spots_px: FloatArray
    visible: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]
    #: (n,) radius within which each spot should lie, px
    radius_px: FloatArray


@dataclass(slots=True)
class _Past:
    """All the tracker remembers."""

    T: FloatArray
    covariance: FloatArray
    info: SliceInfo
    #: (6,) motion from slice to slice (or a second), and its spread: mean square innovation, mm² and rad²
    velocity: FloatArray = field(default_factory=lambda: np.zeros(6))
    spread: FloatArray = field(default_factory=lambda: np.repeat(np.square(np.array(_FIRST_STEP, dtype=np.float64)), 3))
    steps: int = 0


class Tracker:
    """Follow one frame through slices in the order of time.

    ``predict`` says where to look in the next slice (so that only windows need be segmented); ``step`` takes the spots found
    and gives the verdict. Not thread-safe; one tracker a sequence.
    """

    def __init__(self, model: RodModel, options: TrackingOptions | None = None) -> None:
        self.model = model
        self.options = options or TrackingOptions()
        self._past: _Past | None = None
        self._J_plus: FloatArray | None = None
        self._registered_rods: IntArray | None = None
        self._was_lost = False

    def predict(self, info: SliceInfo, scale: Scale) -> Prediction | None:
        """The pose and spots expected in the next slice; None while there is no past to go by."""
        past = self._past
        if past is None or past.info.series != info.series:
            return None
        T, covariance = self._predicted_pose(past, info)
        projection = project(T, self.model.starts, self.model.directions)
        J = np.nan_to_num(motion_field(T, projection))
        s = scale.mm_per_px
        variance = np.einsum("nij,jk,nik->ni", J, covariance, J).max(axis=1)
        slack = 0.5 * (info.thickness_mm or 0.0)
        reach = np.sqrt(variance)
        visible = (
            np.isfinite(projection.lambda_mm)
            & (projection.lambda_mm >= -slack - 3 * reach)
            & (projection.lambda_mm <= self.model.lengths + slack + 3 * reach)
        )
        return Prediction(
            T=T,
            covariance=covariance,
            spots_px=projection.xy_mm / s,
            visible=visible,
            radius_px=4 * reach / float(s.min()),
        )

    def _predicted_pose(self, past: _Past, info: SliceInfo) -> tuple[FloatArray, FloatArray]:
        """Constant velocity from the last pose; a table that moved in between is taken out by the patient geometry."""
        T = past.T
        here, there = past.info.T_patient_slice, info.T_patient_slice
        if here is not None and there is not None:
            T = poses.inverse(there) @ here @ T
        T = poses.update(T, past.velocity)
        covariance = past.covariance + np.diag(past.spread)
        return T, covariance

    def step(self, spots: Spots, info: SliceInfo, scale: Scale) -> Tracked:
        """The verdict on the next slice.

        Args:
            spots: its spots, px.
            info: what is known of the slice.
            scale: mm per pixel.
        """
        prediction = self.predict(info, scale)
        if prediction is None:
            self._was_lost = self._past is not None or self._was_lost
            self._past = None
        else:
            tracked = self._follow(prediction, spots, info, scale)
            if tracked is not None:
                return self._remember(tracked, prediction, info)
        return self.register(spots, info, scale)

    def follows(self, spots: Spots, info: SliceInfo, scale: Scale) -> Tracked | None:
        """Like :meth:`step`, but None (and nothing remembered) instead of registering anew."""
        prediction = self.predict(info, scale)
        if prediction is None:
            return None
        tracked = self._follow(prediction, spots, info, scale)
        return None if tracked is None else self._remember(tracked, prediction, info)

    def register(self, spots: Spots, info: SliceInfo, scale: Scale) -> Tracked:
        """Register a slice from all its spots, without labels; the past only settles what is ambiguous."""
        prediction = self.predict(info, scale)
        registration = register(
            spots,
            self.model,
            scale=scale,
            T_patient_slice=info.T_patient_slice,
            thickness_mm=info.thickness_mm,
            shape=info.shape,
            options=self.options.registration,
        )
        if registration.status == "ambiguous" and prediction is not None and registration.reason == "rival_pose":
            registration = _settled_by_past(registration, prediction)
        if registration.status != "ok":
            self._was_lost = self._was_lost or self._past is not None
            self._past = None
            return Tracked(
                registration=registration, method="registered" if registration.candidates else "", stability=None
            )
        best = registration.candidates[0]
        method = "reacquired" if self._was_lost or self._past is not None else "registered"
        self._was_lost = False
        self._keep_jacobian(best, spots, scale)
        margin = 1.0  # Ĵ is J here
        return self._remember(Tracked(registration=registration, method=method, stability=margin), prediction, info)

    def _keep_jacobian(self, best: Candidate, spots: Spots, scale: Scale) -> None:
        """Ĵ⁺ at the desired features of this registration, for the constant strategy."""
        seen = observations(_spot_scene(spots, scale), _spot_of_rod(self.model, best))
        self._J_plus = weighted_pseudoinverse(linearise(self.model, best.T_slice_model[None], seen))
        self._registered_rods = best.rod_index

    def _follow(self, prediction: Prediction, spots: Spots, info: SliceInfo, scale: Scale) -> Tracked | None:
        """Predict, gate, assign, servo, verify; None when a check fails."""
        model, options = self.model, self.options
        if len(spots) < _LEAST_MATCHES:
            return None
        scene = make_scene(
            spots,
            model,
            scale,
            T_patient_slice=info.T_patient_slice,
            thickness_mm=info.thickness_mm,
            shape=info.shape,
            options=options.registration,
        )
        spot_of_rod = nearest_assignment(model, scene, prediction.T[None], prediction.covariance)
        T = prediction.T
        # twice: the first servo brings the pose near, so that all spots can be assigned with small gates
        for _ in range(2):
            if (spot_of_rod >= 0).sum() < _LEAST_MATCHES:
                return None
            J_plus = None
            if options.jacobian == "constant":
                J_plus = self._constant_for(spot_of_rod[0])
                if J_plus is None:
                    return None
            try:
                moved = servo(
                    model,
                    T,
                    observations(scene, spot_of_rod),
                    options=ServoOptions(gain=options.gain),
                    J_plus=J_plus,
                )
            except np.linalg.LinAlgError:
                return None
            if not moved.converged or moved.margin < LEAST_MARGIN:
                return None
            again = assign(model, scene, moved.T[None], moved.linearisation)
            T, same = moved.T, bool((again == spot_of_rod).all())
            spot_of_rod = again
            if same:
                break
        else:
            return None
        return self._verified(prediction, spots, scene, scale, T, spot_of_rod, moved.iterations, moved.margin)

    def _constant_for(self, spot_of_rod: IntArray) -> FloatArray | None:
        """The kept Ĵ⁺, if the rods seen now are those it was made for."""
        rods = np.nonzero(spot_of_rod >= 0)[0]
        if self._J_plus is None or self._registered_rods is None or not np.array_equal(rods, self._registered_rods):
            return None
        return self._J_plus

    def _verified(
        self,
        prediction: Prediction,
        spots: Spots,
        scene: Scene,
        scale: Scale,
        T: FloatArray,
        spot_of_rod: IntArray,
        iterations: int,
        margin: float,
    ) -> Tracked | None:
        """All the checks a registered pose must pass, and that it continues the past."""
        model = self.model
        fit = linearise(model, T[None], observations(scene, spot_of_rod))
        projection = project(T[None], model.starts, model.directions)
        may, must = visibility(model, scene, projection.lambda_mm, projection.slope, projection.xy_mm)
        matched = spot_of_rod >= 0
        if not (may | ~matched).all() or not scene.prior.allows(T[:3, :3]):
            return None
        H, _ = fit.normal_equations()
        covariance, condition = covariance_from_information(H[0], model.size_mm)
        if not np.isfinite(condition):
            return None
        innovation = poses.difference(T, prediction.T)
        total = prediction.covariance + covariance
        distance2 = float(innovation @ np.linalg.solve(total, innovation))
        if distance2 > _INNOVATION2:
            return None
        _, logdet = np.linalg.slogdet(total)
        log_prior = np.array([-0.5 * distance2 - 3 * math.log(2 * math.pi) - 0.5 * logdet])
        odds = log_odds(model, scene.prior, scene.xy_mm, T[None], fit, matched, must, log_prior_density=log_prior)
        best = assemble_candidate(
            model, spots, scale, T, fit, spot_of_rod[0], must[0], covariance, float(odds[0]), iterations
        )
        if (
            best.log_odds < accepted_log_odds(len(best.rod_index))
            or len(best.rod_index) < max(_LEAST_MATCHES, len(best.missing_rods))
            or chdtrc(best.degrees_of_freedom, best.chi2) < BAD_FIT_P
        ):
            return None
        registration = Registration(
            status="ok", reason="", candidates=(best,), n_spots=len(spots), warnings=fit_warnings(model, spots, best)
        )
        return Tracked(registration=registration, method=self.options.jacobian, stability=margin)

    def _remember(self, tracked: Tracked, prediction: Prediction | None, info: SliceInfo) -> Tracked:
        best = tracked.registration.candidates[0]
        past = self._past
        velocity, spread, steps = np.zeros(6), None, 0
        if past is not None and prediction is not None:
            innovation = poses.difference(best.T_slice_model, prediction.T)
            moved = innovation + past.velocity
            # a first step is not yet a velocity; then half the innovation is taken for a change of it
            velocity = moved if past.steps == 0 else past.velocity + 0.5 * innovation
            square = np.repeat((innovation**2).reshape(2, 3).mean(axis=1), 3)
            blend = _ADAPT if past.steps > 1 else 0.5
            spread = (1 - blend) * past.spread + blend * np.maximum(4 * square, np.repeat(np.square(_LEAST_STEP), 3))
            steps = past.steps + 1
            # a reacquired frame has jumped: what came before says nothing of how it moves now
            if tracked.method in ("registered", "reacquired"):
                velocity, spread, steps = np.zeros(6), None, 0
        self._past = _Past(T=best.T_slice_model, covariance=best.covariance, info=info, velocity=velocity, steps=steps)
        if spread is not None:
            self._past.spread = spread
        return tracked


def _settled_by_past(registration: Registration, prediction: Prediction) -> Registration:
    """An ambiguous slice becomes ``ok`` when the past, certain until now, allows exactly one of its poses."""
    allowed = []
    for c in registration.candidates:
        innovation = poses.difference(c.T_slice_model, prediction.T)
        if float(innovation @ np.linalg.solve(prediction.covariance + c.covariance, innovation)) < _INNOVATION2:
            allowed.append(c)
    if len(allowed) != 1:
        return registration
    return replace(
        registration,
        status="ok",
        reason="",
        candidates=(allowed[0],),
        warnings=(*registration.warnings, ("settled_by_past", "another pose explains the spots; the past excludes it")),
    )


def _spot_of_rod(model: RodModel, best: Candidate) -> IntArray:
    spot_of_rod = np.full((1, len(model)), -1, dtype=np.intp)
    spot_of_rod[0, best.rod_index] = best.spot_index
    return spot_of_rod


def _spot_scene(spots: Spots, scale: Scale) -> Scene:
    s = scale.mm_per_px
    return Scene(xy_mm=spots.uv_px * s, covariance_mm=spots.covariance_px * (s[:, None] * s), prior=PosePrior())
