"""The frame from slice to slice: predict, gate, assign, servo, verify, doubt, lose, register anew.

Three ways lead to a pose, each taken only when the one before does not settle the slice:

1. *Servo*: spots in the predicted gates, one to one; the control law brings the frame there. Believed at once only if
   nothing is in doubt (:mod:`~ctreg_cli.tracking.verify`).
2. *Doubt*: the same matches taken apart as a registration's are: other minima, exchanged and dropped spots.
3. *Register*: all spots, without labels.

In 2 and 3 the past enters as what it is, a prior on the pose (:mod:`~ctreg_cli.tracking.prior`): a symmetric frame's
second pose is excluded by the past only while the past is certain. The pose itself never leans on the past.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ctreg_cli.arrays import BoolArray, FloatArray, IntArray
from ctreg_cli.geometry import pose as poses
from ctreg_cli.imaging.slice import SliceInfo
from ctreg_cli.imaging.spots import Spots
from ctreg_cli.registration.doubt import doubt
from ctreg_cli.registration.linearity import positive_part
from ctreg_cli.registration.matching import Matches, Scene, distinct, join, observations, search, weigh
from ctreg_cli.registration.misfit import covariance_with_misfit
from ctreg_cli.registration.options import TrackingOptions
from ctreg_cli.registration.refine import Observations, covariance_from_information
from ctreg_cli.registration.register import (
    LEAST_MATCHES,
    RIVAL_SD,
    decide,
    fit_warnings,
    least_matches,
    make_scene,
    protected,
    refined_candidates,
    undetermined,
)
from ctreg_cli.registration.result import Candidate, Registration
from ctreg_cli.registration.twins import twins, with_twins
from ctreg_cli.rods import RodModel
from ctreg_cli.scale import Scale, check_scale
from ctreg_cli.tracking import motion
from ctreg_cli.tracking.gate import GATE_SD, Outlook, spread
from ctreg_cli.tracking.lasting import lasting_influence
from ctreg_cli.tracking.posterior import most_probable_pose
from ctreg_cli.tracking.prior import PastPrior, Weighed
from ctreg_cli.tracking.servo import Desired, ServoOptions, ServoResult, servo, view
from ctreg_cli.tracking.settle import (
    covering,
    covering_less,
    covering_reconciled,
    covering_valley,
    opposing,
    reconciled,
    straightened,
)
from ctreg_cli.tracking.single import Crossing, carried, cross, difference, greatest_tolerance_mm, model_lines
from ctreg_cli.tracking.valley import walked_along
from ctreg_cli.tracking.variants import with_other_rods
from ctreg_cli.tracking.verify import (
    CHECKABLE_MATCHES,
    VAGUE_POSE_RAD,
    agrees_with_past,
    is_vaguer,
    verified,
)

#: a pose farther from the prediction than this (χ² of six degrees of freedom: 4 in a million) is not a continuation
CONTINUES_D2 = 35.0
#: the margin below which a constant Jacobian is not trusted any more, and the most it may cost in variance
LEAST_MARGIN, MOST_VARIANCE_RATIO = 0.05, 1.1
#: spots are assigned anew after the servo has moved; by then labels that are right do not change any more
_ASSIGNMENTS = 3
#: the servo is done when all spots together move by less than this (sd); right labels never need so many full steps
_DONE_SD, _LEFT_OVER_SD, _MAX_FULL_STEPS = 3e-3, 0.03, 30
#: poses nearer than this (χ² of six degrees of freedom) at the same moment are of the same slice, read twice
_SAME_POSE_D2 = 1e-3
#: a match this near (ln odds, with the past) to one believed without it speaks against it
_OPPOSED_WITHIN = 7.0
#: fewer spots than make a pose can still say, with the past, where the frame is: as rivals they count
_LEAST_WITH_PAST = 3
#: so many spots where the past expects them speak for it even when they do not make a pose
_MATCHES_THAT_AGREE = 4


#: a past that knows place or turn no better (sd: sizes of the frame, rad) says nothing
_NOWHERE_SIZES, _NOWHERE_RAD = 5.0, 1.5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Velocity:
    """How fast the frame moves, the table's own motion taken out; slice axes."""

    #: (6,) ``[V; Ω]`` of the model origin, mm/s and rad/s, and its (6, 6) covariance
    twist: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tracked:
    """The verdict on one slice of a sequence."""

    registration: Registration
    #: ``registered`` | ``updated`` | ``constant`` | ``reacquired``; empty without a pose
    method: str
    #: smallest eigenvalue of the symmetric part of Ĵ⁺J, scaled; None without a pose
    stability: float | None = None
    #: None without a pose, without times, and in the first slice
    velocity: Velocity | None = None
    #: the motion before, if any, does not lead here: the first slice, or one after a jump
    begins: bool = False


class Prediction(NamedTuple):
    """Where the frame should be in the next slice."""

    #: (4, 4), and the (6, 6) covariance of the twist from it to the truth
    T: FloatArray
    covariance: FloatArray
    #: all rods with this pose, mm
    crossing: Crossing
    #: (n, 2) px, and whether each rod may be seen
    spots_px: FloatArray
    visible: BoolArray
    #: (n, 2, 2) covariance of the crossings, and the (n,) radius within which each spot should lie, px
    spread_mm2: FloatArray
    radius_px: FloatArray
    #: the same as a motion, and the time it bridges: s, and slices
    motion: motion.MotionState
    dt_s: float
    n_slices: int


class _Past(NamedTuple):
    """The last slice with a sure pose."""

    motion: motion.MotionState
    info: SliceInfo
    scale: Scale
    spots_px: FloatArray
    tracked: Tracked
    #: its time, or, where it came without one, what the slices before make of it; None while none had a time
    time_s: float | None = None
    #: time from slice to slice, for slices that come without
    interval_s: float = 1.0
    #: slices since, in which the frame was not found
    n_missed: int = 0


class Tracker:
    """Follow one frame through slices in the order of time.

    ``predict`` says where to look in the next slice (so that only windows need be segmented); ``follow`` gives the
    verdict on spots from such windows, if it can; ``step`` the verdict on all spots of a slice; ``miss`` passes a slice
    by. One tracker a sequence; not thread-safe.
    """

    def __init__(self, model: RodModel, options: TrackingOptions | None = None) -> None:
        self.model = model
        self.options = options or TrackingOptions()
        self._past: _Past | None = None
        self._predicted: tuple[SliceInfo, Scale, Prediction | None] | None = None
        self._series: str | None = None
        #: (n, 2, 6) Ĵ of the constant strategy, mm per mm and rad
        self._kept_jacobian: FloatArray | None = None
        self._is_lost = False
        self._twins = twins(model)
        gain = self.options.gain
        self._servo_options = ServoOptions(
            gain=gain,
            spot_tolerance_sd=_DONE_SD,
            left_over_sd=_LEFT_OVER_SD,
            max_iterations=math.ceil(_MAX_FULL_STEPS / gain),
        )

    # --- where it should be ------------------------------------------------------------------------------------------

    def predict(self, info: SliceInfo, scale: Scale) -> Prediction | None:
        """The pose and spots expected in the next slice; None while there is no past to go by.

        Raises:
            MissingScaleError: the scale is None.
            InputError: the scale is no :class:`Scale`.
        """
        check_scale(scale)
        if self._predicted is None or self._predicted[0] is not info or self._predicted[1] != scale:
            self._predicted = (info, scale, self._predict(info, scale))
        return self._predicted[2]

    def _predict(self, info: SliceInfo, scale: Scale) -> Prediction | None:
        past, model = self._past, self.model
        if past is None or past.info.series != info.series:
            return None
        if (past.info.T_patient_slice is None) != (info.T_patient_slice is None):
            return None
        dt_s = _time_since(past, info)
        if dt_s is None:
            return None
        moved = motion.advance(past.motion, dt_s, self.options.prediction)
        axes = self._axes(info)
        T = axes.slice_pose(moved.T)
        G = axes.slice_twist(T)
        covariance = carried(G, moved.pose_covariance)
        if _says_nothing(model, covariance):
            return None
        crossing = cross(T, model_lines(model))
        spread_mm2 = spread(crossing, covariance)
        reach = np.sqrt(np.maximum(spread_mm2[:, 0, 0], spread_mm2[:, 1, 1]))
        # how far along a rod that moves the slice
        slack = (0.5 * (info.thickness_mm or 0.0) + 3 * reach) * crossing.mm_per_height
        visible = (crossing.lambda_mm >= -slack) & (crossing.lambda_mm <= model.lengths + slack)
        s = scale.mm_per_px
        return Prediction(
            T=T,
            covariance=covariance,
            crossing=crossing,
            spots_px=crossing.xy_mm / s,
            visible=visible,
            spread_mm2=spread_mm2,
            radius_px=reach * (GATE_SD / min(scale.s_x, scale.s_y)),
            motion=moved,
            dt_s=dt_s,
            n_slices=past.n_missed + 1,
        )

    # --- the verdict on a slice --------------------------------------------------------------------------------------

    def step(self, spots: Spots, info: SliceInfo, scale: Scale) -> Tracked:
        """The verdict on the next slice.

        Args:
            spots: all its spots, px.
            info: what is known of the slice.
            scale: mm per pixel.

        Raises:
            MissingScaleError: the scale is None.
            InputError: the scale is no :class:`Scale`.
        """
        prediction = self.predict(info, scale)
        if self._series != info.series:  # another sequence: nothing was lost in it yet
            self._series, self._is_lost = info.series, False
        if prediction is None:
            self._past = None
        elif (again := self._repeated(spots, info, scale)) is not None:
            return again
        scene = self._scene(spots, info, scale)
        followed, why = None, ""
        if prediction is not None:
            followed, why = self._servoed(prediction, scene)
        if prediction is not None and followed is not None:
            sure = self._verified(prediction, scene, spots, scale, followed)
            sure = sure or self._doubted(prediction, scene, spots, scale, followed)
            if sure is not None and sure.status != "ok":
                return self._lost(sure, prediction, scene)
            if sure is not None:
                return self._remember_followed(sure, followed, prediction, spots, info, scale)
        return self._registered(prediction, scene, spots, info, scale, followed, why)

    def follow(self, spots: Spots, info: SliceInfo, scale: Scale) -> Tracked | None:
        """The verdict on the next slice from spots about the predicted ones, if nothing is in doubt; else None.

        None leaves the tracker as it was: give ``step`` all spots of the slice.
        """
        prediction = self.predict(info, scale)
        if prediction is None:
            return None
        scene = self._scene(spots, info, scale)
        followed, _ = self._servoed(prediction, scene)
        sure = None if followed is None else self._verified(prediction, scene, spots, scale, followed)
        if followed is None or sure is None:
            return None
        return self._remember_followed(sure, followed, prediction, spots, info, scale)

    def miss(self) -> None:
        """A slice that could not be read: time passes."""
        self._is_lost = self._is_lost or self._past is not None
        if self._past is not None:
            self._past = self._past._replace(n_missed=self._past.n_missed + 1)

    def _axes(self, info: SliceInfo) -> motion.StillAxes:
        return motion.StillAxes(middle=self.model.centre, T_patient_slice=info.T_patient_slice)

    def _scene(self, spots: Spots, info: SliceInfo, scale: Scale) -> Scene:
        return make_scene(
            spots,
            self.model,
            scale,
            T_patient_slice=info.T_patient_slice,
            thickness_mm=info.thickness_mm,
            shape=info.shape,
            options=self.options.registration,
        )

    def _repeated(self, spots: Spots, info: SliceInfo, scale: Scale) -> Tracked | None:
        """The verdict on the last slice, if this one is the same again (to the last digit): it tells nothing new."""
        past = self._past
        if past is None or not _same_place(past, info, scale) or not np.array_equal(spots.uv_px, past.spots_px):
            return None
        return replace(past.tracked, begins=False)

    # --- 1. servo ----------------------------------------------------------------------------------------------------

    def _servoed(self, prediction: Prediction, scene: Scene) -> tuple[_Followed | None, str]:
        """The frame brought to the spots in its gates; or why not.

        A constant Jacobian that does not serve any more is given up for the one at hand, which is then kept.
        """
        if len(scene.xy_mm) < CHECKABLE_MATCHES:
            return None, ""
        if self.options.jacobian == "updated" or self._kept_jacobian is None:
            return self._servoed_with(None, prediction, scene)
        followed, why = self._servoed_with(self._kept_jacobian, prediction, scene)
        if followed is not None:
            why = _unfit(followed.servo)
            if not why:
                return followed, ""
        anew, _ = self._servoed_with(None, prediction, scene)
        return (None, why) if anew is None else (anew._replace(renewed=why), "")

    def _servoed_with(
        self, kept_jacobian: FloatArray | None, prediction: Prediction, scene: Scene
    ) -> tuple[_Followed | None, str]:
        model = self.model
        T, crossing = prediction.T, prediction.crossing
        outlook = Outlook(model, scene, T, crossing)
        spot_of_rod = outlook.assigned(prediction.covariance, prediction.spread_mm2)
        for _ in range(_ASSIGNMENTS):
            rods = np.nonzero(spot_of_rod >= 0)[0]
            if len(rods) < CHECKABLE_MATCHES:
                return None, f"only {len(rods)} spots lie where the past expects them"
            spots = spot_of_rod[rods]
            desired = Desired.of(model, rods, scene.xy_mm.take(spots, axis=0), scene.covariance_mm.take(spots, axis=0))
            kept = None if kept_jacobian is None else kept_jacobian[rods].reshape(-1, 6)
            all_seen = len(rods) == len(model)
            try:
                moved = servo(
                    model,
                    T,
                    desired,
                    options=self._servo_options,
                    jacobian=kept,
                    crossing=crossing if all_seen else None,
                )
            except np.linalg.LinAlgError:
                return None, "the spots do not determine the pose"
            if not moved.converged:
                return None, "the servo did not converge"
            T = moved.T
            outlook = Outlook(model, scene, T, moved.view.crossing if all_seen else None, outlook.noise_mm)
            crossing = outlook.crossing
            if all_seen and len(rods) == len(scene.xy_mm) and moved.chi2 < GATE_SD**2:
                break  # no rod or spot is left over, and none can be outside its gate
            again = outlook.assigned(moved.covariance)
            if np.array_equal(again, spot_of_rod):
                break
            spot_of_rod = again
        else:
            return None, "the matches did not settle"
        return _Followed(spot_of_rod=spot_of_rod, servo=moved, outlook=outlook), ""

    def _verified(
        self, prediction: Prediction, scene: Scene, spots: Spots, scale: Scale, followed: _Followed
    ) -> Registration | None:
        if self._twins and len(scene.xy_mm) > int((followed.spot_of_rod >= 0).sum()) and not self._all_seen(followed):
            return None  # put the other way round, it might miss no rod and leave no spot
        return verified(
            followed.outlook,
            scale,
            spots,
            prediction.T,
            prediction.covariance,
            followed.servo,
            followed.spot_of_rod,
            self.options.registration,
        )

    def _all_seen(self, followed: _Followed) -> bool:
        """Whether every rod that must be seen has a spot."""
        return not (followed.outlook.must_be_seen() & (followed.spot_of_rod < 0)).any()

    # --- 2. doubt ----------------------------------------------------------------------------------------------------

    def _doubted(
        self, prediction: Prediction, scene: Scene, spots: Spots, scale: Scale, followed: _Followed
    ) -> Registration | None:
        matches = weigh(self.model, scene, followed.servo.T[None], followed.spot_of_rod[None], LEAST_MATCHES)
        if matches is None:
            return None
        verdict = self._decided(self._rivals(matches, scene, _LEAST_WITH_PAST), prediction, scene, spots, scale)
        if verdict.status != "ok" or not continues(verdict.candidates[0], prediction):
            return None
        return self._straight(verdict, prediction, scene)

    def _rivals(self, matches: Matches, scene: Scene, least_matches: int) -> Matches:
        """Matches and all that could be said instead of the best of them."""
        matches = with_twins(self.model, scene, matches, least_matches)
        asked = matches.spot_of_rod[0]
        matches = with_other_rods(self.model, scene, matches, least_matches)
        matches = doubt(self.model, scene, matches, least_matches=least_matches)
        if not np.array_equal(matches.spot_of_rod[0], asked):  # the best is another now: ask the same of it
            matches = with_other_rods(self.model, scene, matches, least_matches)
        return matches

    def _decided(
        self, matches: Matches, prediction: Prediction | None, scene: Scene, spots: Spots, scale: Scale
    ) -> Registration:
        """The verdict on matches weighed with what the past says."""
        model = self.model
        if prediction is None:
            weighed = Weighed.alone(model, matches)
        else:
            weighed = PastPrior.of(model, scene, prediction, self._twins).applied(model, scene, matches)
        if int((weighed.matches.spot_of_rod[0] >= 0).sum()) < LEAST_MATCHES:
            return Registration(status="no_pose", reason="no_consistent_match", n_spots=len(spots))
        settled = reconciled(weighed)
        verdict = decide(
            model,
            scene,
            spots,
            scale,
            weighed.matches.subset(~settled),
            self.options.registration,
            frame_is_known=bool(weighed.near[0]),
        )
        if verdict.reason == "not_linear" and prediction is not None and len(verdict.candidates) == 1:
            verdict = self._straightened(verdict, weighed, prediction, scene, spots)
        if verdict.status != "ok":
            return verdict
        if prediction is not None and weighed.near[0] and not continues(verdict.candidates[0], prediction):
            # it is believed for what lies where the past is, and the spots' own pose is elsewhere
            return replace(verdict, status="ambiguous", reason="not_linear")
        best = covering_reconciled(verdict.candidates[0], weighed.subset(settled))
        rivals = opposing(model, weighed, best)
        if rivals.any():
            others = refined_candidates(model, scene, spots, scale, weighed.matches.subset(rivals))
            return replace(verdict, status="ambiguous", reason="rival_pose", candidates=(best, *others))
        best = covering(model, weighed, best)
        if prediction is not None and weighed.near[0] and is_vaguer(best.covariance, VAGUE_POSE_RAD):
            covered = covering_less(model, scene, weighed, best, prediction.T, prediction.covariance)
            if covered is None:
                return replace(verdict, status="ambiguous", reason="not_linear")
            best = covered
        if best.covariance is verdict.candidates[0].covariance:
            return verdict
        return self._protected(replace(verdict, candidates=(best,)), scene)

    def _straightened(
        self, verdict: Registration, weighed: Weighed, prediction: Prediction, scene: Scene, spots: Spots
    ) -> Registration:
        """A verdict ``not_linear``, or ``ok`` where the past leaves only a straight piece of the valley."""
        model = self.model
        best = straightened(model, scene, weighed, verdict.candidates[0], prediction.T, prediction.covariance)
        if best is None:
            return verdict
        seen = observations(scene, weighed.matches.spot_of_rod[:1])
        covariance, suspicion = covariance_with_misfit(model, best.T_slice_model, best.covariance, seen)
        if covariance is None or suspicion:
            return verdict
        warnings = (
            ("curved_cost", "the cost is no ellipsoid along its weakest direction; the past settles the pose"),
            *fit_warnings(model, spots, best),
        )
        straight = replace(verdict, status="ok", reason="", candidates=(best,), warnings=warnings)
        return self._protected(straight, scene)

    def _is_opposed(self, best: Candidate, matches: Matches, prediction: Prediction, scene: Scene) -> bool:
        """Whether the past speaks for another pose than one that was believed without it."""
        weighed = PastPrior.of(self.model, scene, prediction, self._twins).applied(self.model, scene, matches)
        distance2 = weighed.distance2(best.T_slice_model, best.covariance)
        same = distance2 < _SAME_POSE_D2
        own = float(weighed.matches.log_odds[same].max(initial=-np.inf))
        return bool(((weighed.matches.log_odds > own - _OPPOSED_WITHIN) & (distance2 > RIVAL_SD**2)).any())

    def _straight(self, verdict: Registration, prediction: Prediction, scene: Scene) -> Registration:
        """A pose that continues the past only thanks to a covariance too straight for it is not ``ok``.

        A badly known one gets a covariance that holds along the valley of the cost.
        """
        best = verdict.candidates[0]
        past = prediction.T, prediction.covariance
        if is_vaguer(best.covariance, VAGUE_POSE_RAD):
            covered = covering_valley(self.model, scene, best, *past)
            if covered is not None:
                return self._protected(replace(verdict, candidates=(covered,)), scene)
        elif agrees_with_past(self.model, scene, best, *past):
            return verdict
        return replace(verdict, status="ambiguous", reason="not_linear")

    def _protected(self, verdict: Registration, scene: Scene) -> Registration:
        """A verdict ``ok`` whose covariance was widened, with the protection levels of that; or why it is none."""
        best = verdict.candidates[0]
        if undetermined(self.model, best.T_slice_model, best.covariance):
            return Registration(status="no_pose", reason="singular_geometry", n_spots=verdict.n_spots)
        best = protected(self.model, scene, best, self.options.registration)
        limit_mm = self.options.registration.alert_limit_mm
        if limit_mm is not None and best.protection_mm.max() > limit_mm:
            return Registration(status="no_pose", reason="unprotected", n_spots=verdict.n_spots)
        return replace(verdict, candidates=(best,))

    # --- 3. register -------------------------------------------------------------------------------------------------

    def _registered(
        self,
        prediction: Prediction | None,
        scene: Scene,
        spots: Spots,
        info: SliceInfo,
        scale: Scale,
        followed: _Followed | None,
        why: str,
    ) -> Tracked:
        """Register a slice from all its spots, without labels; the past is a prior on the pose."""
        model = self.model
        least = least_matches(len(spots), len(model))
        pool = [] if len(spots) < least else [search(model, scene, least_matches=least)]
        if followed is not None:
            pool.append(weigh(model, scene, followed.servo.T[None], followed.spot_of_rod[None], least))
        found = [matches for matches in pool if matches is not None]
        if found:
            # what is looked for must be able to stand alone; what speaks against it need not
            fewest = LEAST_MATCHES if prediction is None else _LEAST_WITH_PAST
            matches = self._rivals(join(found), scene, fewest)
            expected = None if prediction is None else self._expected(prediction, scene)
            if expected is not None:
                matches = distinct(model, join([matches, expected]), within=np.inf, most=2 * len(matches))
            verdict = self._decided(matches, prediction, scene, spots, scale)
            if prediction is not None and verdict.status == "no_pose":
                # nothing sure where the past expects it: the past may be wrong, and the slice stands on its own
                alone = self._decided(matches, None, scene, spots, scale)
                if alone.status != "ok" or not self._is_opposed(alone.candidates[0], matches, prediction, scene):
                    verdict = alone
        else:
            reason = "no_consistent_match" if pool else "too_few_spots"
            verdict = Registration(status="no_pose", reason=reason, n_spots=len(spots))
        follows_on = prediction is not None and verdict.status == "ok" and continues(verdict.candidates[0], prediction)
        if prediction is not None and follows_on:
            verdict = self._straight(verdict, prediction, scene)
        if verdict.status != "ok":
            lost = self._lost(verdict, prediction, scene)
            if prediction is not None and verdict.reason == "rival_pose":
                alone = self._decided(matches, None, scene, spots, scale)
                if alone.status == "ok" and not continues(alone.candidates[0], prediction):
                    self._past = None  # it is no longer certain that the frame is where the past has it
            return lost
        if why:
            verdict = replace(verdict, warnings=(*verdict.warnings, ("registered_anew", why)))
        if self._past is not None and not follows_on:
            self._is_lost = True
        return self._remember(verdict, "registered", 1.0, prediction if follows_on else None, spots, info, scale)

    def _expected(self, prediction: Prediction, scene: Scene) -> Matches | None:
        """What the past expects, however little speaks for it."""
        outlook = Outlook(self.model, scene, prediction.T, prediction.crossing)
        spot_of_rod = outlook.assigned(prediction.covariance, prediction.spread_mm2)
        return weigh(self.model, scene, prediction.T[None], spot_of_rod[None], _LEAST_WITH_PAST)

    def _lost(self, verdict: Registration, prediction: Prediction | None, scene: Scene) -> Tracked:
        """No sure pose: say so; the past stays only if nothing speaks against it."""
        if prediction is not None:
            agrees = len(scene.xy_mm) < CHECKABLE_MATCHES
            agrees |= any(continues(candidate, prediction) for candidate in verdict.candidates)
            if not agrees:
                outlook = Outlook(self.model, scene, prediction.T, prediction.crossing)
                gated = outlook.assigned(prediction.covariance, prediction.spread_mm2)
                agrees = int((gated >= 0).sum()) >= _MATCHES_THAT_AGREE
            self._is_lost = True
            self.miss()
            if not agrees:
                self._past = None
        return Tracked(registration=verdict, method="registered" if verdict.candidates else "")

    # --- memory ------------------------------------------------------------------------------------------------------

    def _remember_followed(
        self,
        sure: Registration,
        followed: _Followed,
        prediction: Prediction,
        spots: Spots,
        info: SliceInfo,
        scale: Scale,
    ) -> Tracked:
        """Take in a sure pose that the servo came to."""
        if followed.renewed:
            sure = replace(sure, warnings=(*sure.warnings, ("registered_anew", followed.renewed)))
        method = "registered" if followed.renewed else self.options.jacobian
        return self._remember(sure, method, followed.servo.margin, prediction, spots, info, scale)

    def _remember(
        self,
        sure: Registration,
        method: str,
        margin: float,
        prediction: Prediction | None,
        spots: Spots,
        info: SliceInfo,
        scale: Scale,
    ) -> Tracked:
        """Take a sure pose into the motion; ``prediction`` is None where a new motion begins."""
        best, model, past = sure.candidates[0], self.model, self._past
        if past is not None and prediction is not None and prediction.dt_s == 0 and _same_place(past, info, scale):
            apart = difference(best.T_slice_model, past.tracked.registration.candidates[0].T_slice_model)
            if float(apart @ np.linalg.solve(best.covariance, apart)) < _SAME_POSE_D2:
                # the same slice again, its spots perhaps in another order, tells nothing new
                return replace(past.tracked, registration=sure, begins=False)
        axes = self._axes(info)
        T, G = axes.pose(best.T_slice_model), axes.twist(best.T_slice_model)
        C = carried(G, best.covariance)
        lasting = self._lasting(best, spots, scale, G)
        kind = self.options.prediction
        time_s, interval_s = info.time_s, 1.0
        if past is not None and prediction is not None:
            if prediction.dt_s > 0:
                interval_s = prediction.dt_s / prediction.n_slices
            if time_s is None and past.time_s is not None:
                time_s = past.time_s + prediction.dt_s
        timed = past is not None and (past.time_s is None) == (time_s is None)
        if prediction is None or not timed:
            learnt = past.motion.intensity if past is not None and timed else motion.FIRST_INTENSITY
            state = motion.start(T, C, kind, learnt, lasting)
        else:
            innovation = difference(T, prediction.motion.T)
            if is_vaguer(C, VAGUE_POSE_RAD):
                innovation, C = self._straight_innovation(best, spots, scale, axes, prediction, innovation, C)
            state = motion.correct(prediction.motion, innovation, C, prediction.dt_s, kind, lasting)
        if method == "registered":
            self._kept_jacobian = np.nan_to_num(cross(best.T_slice_model, model_lines(model)).jacobian)
        tracked = Tracked(
            registration=sure,
            method="reacquired" if self._is_lost else method,
            stability=margin,
            velocity=self._velocity(state, G, info),
            begins=prediction is None,
        )
        self._is_lost = False
        self._past = _Past(
            motion=state,
            info=info,
            scale=scale,
            spots_px=spots.uv_px,
            tracked=tracked,
            time_s=time_s,
            interval_s=interval_s,
        )
        return tracked

    def _desired(self, best: Candidate, spots: Spots, scale: Scale) -> Desired:
        """The spots of a pose."""
        uv, covariance = spots.uv_px.take(best.spot_index, axis=0), spots.covariance_px.take(best.spot_index, axis=0)
        return Desired.of(self.model, best.rod_index, uv, covariance, scale.mm_per_px)

    def _lasting(self, best: Candidate, spots: Spots, scale: Scale, to_still: FloatArray) -> FloatArray | None:
        """(6, 2n) :func:`~.lasting.lasting_influence` on the frame's middle; None where rods are as drawn."""
        if greatest_tolerance_mm(self.model) == 0:
            return None
        T = best.T_slice_model
        seen = view(self._desired(best, spots, scale), T)
        return to_still @ lasting_influence(self.model, T, best.rod_index, seen, scale.mm_per_px)

    def _straight_innovation(
        self,
        best: Candidate,
        spots: Spots,
        scale: Scale,
        axes: motion.StillAxes,
        prediction: Prediction,
        innovation: FloatArray,
        covariance: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Innovation (6,) and covariance (6, 6) that take a badly known pose into the motion where both put it.

        The spots' own pose may lie far along a curved valley, where its covariance does not hold: the spots are
        linearised where the past leaves the frame (the iterated Kalman filter, Bell and Cathey 1993).
        """
        desired = self._desired(best, spots, scale)
        both = most_probable_pose(desired, prediction.T, prediction.covariance, best.T_slice_model)
        if both is None:
            return innovation, covariance
        seen = _observed(self.model, best, spots, scale)
        valley = walked_along(self.model, seen, both.T, prediction.T, prediction.covariance)
        # what the spots must say for the filter to end up knowing this much
        information = positive_part(np.linalg.inv(valley.covariance) - np.linalg.inv(prediction.covariance))
        C, _ = covariance_from_information(information, self.model.size_mm)
        gradient = both.seen.residual_px.reshape(-1) @ both.seen.weighted(both.seen.jacobian)
        G = axes.twist(both.T)
        there = difference(axes.pose(both.T), prediction.motion.T)
        measured = there + G @ (C @ gradient)
        C = carried(G, C * best.inflation**2)
        # spots in doubt and rivals: no slice is believed more than its verdict says
        return measured, C + positive_part(covariance - C)

    def _velocity(self, state: motion.MotionState, to_still: FloatArray, info: SliceInfo) -> Velocity | None:
        """The middle's velocity as the model origin's, slice axes; None where no time has passed, or none is known.

        ``to_still``: (6, 6) what takes a twist at the model origin in slice axes to the middle's.
        """
        if self.options.prediction == "identity" or info.time_s is None or not state.elapsed_s > 0:
            return None
        G = motion.inverse_twist(to_still)
        return Velocity(twist=G @ state.velocity, covariance=carried(G, state.velocity_covariance))


class _Followed(NamedTuple):
    """Where the servo brought the frame, and with which spots."""

    #: (n,) spot of each rod, −1 for none
    spot_of_rod: IntArray
    servo: ServoResult
    outlook: Outlook
    #: why the constant Jacobian was given up for the one at hand; empty where it was not
    renewed: str = ""


def _observed(model: RodModel, best: Candidate, spots: Spots, scale: Scale) -> Observations:
    """The spots of a pose, as refinement wants them."""
    spot_of_rod = best.spot_of_rod(len(model))
    return Observations(
        uv_px=spots.uv_px[spot_of_rod][None],
        covariance_px=spots.covariance_px[spot_of_rod][None],
        matched=(spot_of_rod >= 0)[None],
        mm_per_px=scale.mm_per_px,
    )


def _says_nothing(model: RodModel, covariance: FloatArray) -> bool:
    """Whether a prediction with this covariance (6, 6) is no better than none."""
    variances = covariance.diagonal().tolist()
    place, turn = sum(variances[:3]), sum(variances[3:])
    return not (place < (_NOWHERE_SIZES * model.size_mm) ** 2 and turn < _NOWHERE_RAD**2)


def _unfit(moved: ServoResult) -> str:
    """Why a constant Jacobian is not trusted any more; empty while it is."""
    if moved.margin < LEAST_MARGIN:
        return f"the constant Jacobian's stability margin fell to {moved.margin:.2g}"
    if float((moved.information * moved.covariance).sum()) > 6 * MOST_VARIANCE_RATIO:
        return "the constant Jacobian has become inefficient"
    return ""


def _time_since(past: _Past, info: SliceInfo) -> float | None:
    """Seconds from the last sure slice to this one, as far as slices say; None where time runs backwards."""
    if info.time_s is None or past.time_s is None:
        return (past.n_missed + 1) * past.interval_s
    dt_s = info.time_s - past.time_s
    if dt_s < 0:
        return None if past.info.time_s is not None else 0.0  # a reckoned time may be a little late
    return dt_s


def _same_place(past: _Past, info: SliceInfo, scale: Scale) -> bool:
    """Whether a slice is one of the same place, scale and thickness as the last sure one, with none between."""
    if past.n_missed or past.scale != scale or past.info.thickness_mm != info.thickness_mm:
        return False
    here, there = past.info.T_patient_slice, info.T_patient_slice
    return here is None or there is None or np.array_equal(here, there)


def continues(candidate: Candidate, prediction: Prediction) -> bool:
    """Whether a pose lies where the past said it would."""
    innovation = poses.difference(candidate.T_slice_model, prediction.T)
    distance2 = innovation @ np.linalg.solve(prediction.covariance + candidate.covariance, innovation)
    return bool(distance2 < CONTINUES_D2)
