"""Slices in, results out: the method on one page.

Everything is a generator, so that a progress bar, a robot and a file can each take a result as soon as it is there.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from ctreg_cli.arrays import FloatArray, IntArray, frozen
from ctreg_cli.errors import MissingScaleError, UnreadableSliceError
from ctreg_cli.geometry.plucker import skew
from ctreg_cli.imaging.follow import Follower
from ctreg_cli.imaging.segmentation import SegmentationOptions, find_spots
from ctreg_cli.imaging.slice import Slice, SliceInfo, UnreadableSlice
from ctreg_cli.imaging.spot_slice import SpotSlice
from ctreg_cli.imaging.spots import Spots
from ctreg_cli.registration.joint import register_joint, unusable
from ctreg_cli.registration.options import RegistrationOptions, TrackingOptions
from ctreg_cli.registration.register import register
from ctreg_cli.registration.result import Candidate, Registration, Status
from ctreg_cli.rods import RodModel
from ctreg_cli.scale import Scale, check_scale
from ctreg_cli.tracking.lasting import lasting_influence
from ctreg_cli.tracking.motion import StillAxes
from ctreg_cli.tracking.servo import Desired, view
from ctreg_cli.tracking.smoother import LEAST_SLICES, TimedPose, smooth
from ctreg_cli.tracking.tracker import Prediction, Tracked, Tracker, Velocity


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TargetAccuracy:
    """A target of the frame: where it is, and how well that is known."""

    id: str
    #: (3,) mm
    position_slice: FloatArray
    position_patient: FloatArray | None
    #: predicted root-mean-square error of the position, mm
    tre_mm: float
    #: protection level: the error exceeds it with at most the stated risk, mm; infinite where nothing bounds it,
    #: None where it was not worked out
    pl_mm: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameResult:
    """One row of the output: slice ``index`` (zero-based, the join key) and what was found in it."""

    index: int
    info: SliceInfo
    spots: Spots
    status: Status
    reason: str
    #: ``registered`` | ``joint`` | ``updated`` | ``constant`` | ``reacquired``; empty without a pose
    method: str
    candidates: tuple[Candidate, ...] = ()
    targets: tuple[TargetAccuracy, ...] = ()
    warnings: tuple[tuple[str, str], ...] = ()
    #: smallest eigenvalue of the symmetric part of Ĵ⁺J (tracking only): the servo is stable while it is positive
    stability: float | None = None
    #: how fast the frame moves (tracking only, where slices have times); slice axes, the table's own motion taken out
    velocity: Velocity | None = None
    #: the motion before, if any, does not lead here (tracking only): the first slice, or one after a jump
    begins: bool = False

    @property
    def best(self) -> Candidate | None:
        """The pose to use, if any; only ``status == "ok"`` may move a robot."""
        return self.candidates[0] if self.candidates else None


SliceLike = Slice | SpotSlice | UnreadableSlice


def segment(slices: Iterable[SliceLike], options: SegmentationOptions) -> Iterator[SpotSlice]:
    """Spots of every slice; what already is spots, or could not be read, passes through."""
    for slice_ in slices:
        yield spots_of(slice_, options)


def spots_of(slice_: SliceLike, options: SegmentationOptions) -> SpotSlice:
    """The spots of one slice."""
    match slice_:
        case SpotSlice():
            return slice_
        case UnreadableSlice():
            return SpotSlice(info=slice_.info, spots=no_spots(), problem=slice_.problem)
        case Slice():
            try:
                return SpotSlice(info=slice_.info, spots=find_spots(slice_, options))
            except UnreadableSliceError as error:  # its file was taken away or cut short a moment ago
                return SpotSlice(info=slice_.info, spots=no_spots(), problem=str(error))


def expecting(model: RodModel, segmentation: SegmentationOptions | None) -> SegmentationOptions:
    """The options, with the diameters of the model's rods where it knows them all and the options say nothing."""
    options = segmentation or SegmentationOptions()
    known = [rod.diameter_mm for rod in model.rods if rod.diameter_mm is not None]
    if options.rod_diameter_mm is not None or len(known) < len(model.rods):
        return options
    return replace(options, rod_diameter_mm=(min(known), max(known)))


def no_spots() -> Spots:
    """A slice in which nothing was found."""
    return Spots(uv_px=np.empty((0, 2)), covariance_px=np.empty((0, 2, 2)))


def pose(
    slices: Iterable[SliceLike],
    model: RodModel,
    *,
    scale: Scale | None = None,
    options: RegistrationOptions | None = None,
    segmentation: SegmentationOptions | None = None,
) -> Iterator[FrameResult]:
    """Every slice on its own: one result for each, in order, as soon as it is there.

    Args:
        slices: images, or spots.
        model: the rods.
        scale: mm per pixel for all slices; None: each slice's own.
        options: see :class:`RegistrationOptions`.
        segmentation: see :class:`SegmentationOptions`.

    Raises:
        MissingScaleError: no slice has a scale, and none was given; one of several without is a row ``no_scale``.
    """
    options = options or RegistrationOptions()
    segmentation = expecting(model, segmentation)
    scales = _Scales(slices, scale)
    for place, item in enumerate(segment(slices, segmentation)):
        scales.note(item)
        yield register_slice(place, item, model, scale=scale, options=options)
    scales.settle()


def register_slice(
    place: int, item: SpotSlice, model: RodModel, *, scale: Scale | None, options: RegistrationOptions
) -> FrameResult:
    """The pose in one slice without any past."""
    index = place if item.index is None else item.index
    if item.problem:
        return failure(index, item, "unreadable")
    used = scale or item.info.scale
    if used is None:
        return failure(index, item, "no_scale")
    registration = register(
        item.spots,
        model,
        scale=used,
        T_patient_slice=item.info.T_patient_slice,
        thickness_mm=item.info.thickness_mm,
        shape=item.info.shape,
        options=options,
    )
    return frame_result(index, item, model, registration, method="registered")


def pose_joint(
    slices: Iterable[SliceLike],
    model: RodModel,
    *,
    scale: Scale | None = None,
    options: RegistrationOptions | None = None,
    segmentation: SegmentationOptions | None = None,
) -> Iterator[FrameResult]:
    """One rigid pose for all slices of a scan, carried into each by its DICOM geometry; a scan is a series.

    All slices are read before the first result comes.

    Args:
        slices: images or spots whose places in the patient are known.
        model: the rods.
        scale: mm per pixel for all slices; None: each slice's own.
        options: see :class:`RegistrationOptions`.
        segmentation: see :class:`SegmentationOptions`.

    Raises:
        InputError: no slice has a place in the patient.
        MissingScaleError: no slice has a scale, and none was given.
    """
    items = list(segment(slices, expecting(model, segmentation)))
    rows: dict[int, Registration] = {}
    reasons = [unusable(item, scale) for item in items]
    for series in dict.fromkeys(item.info.series for item in items):
        places = [place for place, item in enumerate(items) if item.info.series == series]
        if all(reasons[place] for place in places) and not all(reasons):  # another series has what this one lacks
            for place in places:
                rows[place] = Registration(status="no_pose", reason=reasons[place], n_spots=len(items[place].spots))
            continue
        joint = register_joint([items[place] for place in places], model, scale=scale, options=options)
        rows.update(zip(places, joint.slices, strict=True))
    for place, item in enumerate(items):
        yield frame_result(place if item.index is None else item.index, item, model, rows[place], method="joint")


def track(
    slices: Iterable[SliceLike],
    model: RodModel,
    *,
    scale: Scale | None = None,
    options: TrackingOptions | None = None,
    segmentation: SegmentationOptions | None = None,
) -> Iterator[FrameResult]:
    """The slices as one sequence in time: one result for each, in order, as soon as it is there.

    In images only windows about the predicted spots are looked at; the whole slice when that is not enough.

    Args:
        slices: images, or spots, in the order of time.
        model: the rods.
        scale: mm per pixel for all slices; None: each slice's own.
        options: see :class:`TrackingOptions`.
        segmentation: see :class:`SegmentationOptions`.

    Raises:
        MissingScaleError: no slice has a scale, and none was given; one of several without is a row ``no_scale``.
    """
    segmentation = expecting(model, segmentation)
    tracker, follower = Tracker(model, options), Follower(segmentation)
    scales = _Scales(slices, scale)
    for place, slice_ in enumerate(slices):
        scales.note(slice_)
        yield track_slice(place, slice_, tracker, follower, scale=scale)
    scales.settle()


def track_slice(
    place: int, slice_: SliceLike, tracker: Tracker, follower: Follower, *, scale: Scale | None
) -> FrameResult:
    """The next slice of a sequence; ``tracker`` and ``follower`` are the sequence's own."""
    if isinstance(slice_, Slice):
        try:
            followed = _followed(place, slice_, tracker, follower, scale)
        except UnreadableSliceError as error:
            slice_ = UnreadableSlice(info=slice_.info, problem=str(error))
        else:
            if followed is not None:
                return followed
    follower.forget()
    item = spots_of(slice_, follower.options)
    used = scale or item.info.scale
    if item.problem or used is None:
        tracker.miss()
        reason = "unreadable" if item.problem else "no_scale"
        return failure(place if item.index is None else item.index, item, reason)
    tracked = tracker.step(item.spots, item.info, used)
    return _tracked_result(place, item, tracker, tracked)


def _followed(
    place: int, slice_: Slice, tracker: Tracker, follower: Follower, scale: Scale | None
) -> FrameResult | None:
    """The result of the windows about the predicted spots alone, if nothing is in doubt; else None.

    Raises:
        UnreadableSliceError: the slice's file was taken away or cut short a moment ago.
    """
    used, info = scale or slice_.info.scale, slice_.info
    prediction = None if used is None else tracker.predict(info, used)
    if used is None or prediction is None:
        return None
    rods = _rods_to_see(prediction, info.shape)
    spots = follower.measure(slice_, rods, prediction.spots_px.take(rods, axis=0), prediction.radius_px.take(rods))
    tracked = tracker.follow(spots, info, used)
    return None if tracked is None else _tracked_result(place, SpotSlice(info=info, spots=spots), tracker, tracked)


def smoothed(results: Sequence[FrameResult], model: RodModel, *, scale: Scale | None = None) -> list[FrameResult]:
    """The tracked motion in hindsight: each ``ok`` pose becomes the one most probable given all slices of its motion.

    A motion ends where the frame jumped, or a new series begins; slices without a sure pose stay without one. A motion
    of a few slices, or of slices of which only some have a time, says too little of itself: its poses stay as they are.
    A smoothed pose has no protection level.

    Args:
        results: of :func:`track`, all of them.
        model: the rods.
        scale: as given to :func:`track`.
    """
    after = list(results)
    sure = [i for i, result in enumerate(results) if result.status == "ok"]
    starts = [n for n, i in enumerate(sure) if results[i].begins or not n]
    for first, end in pairwise([*starts, len(sure)]):
        places = sure[first:end]
        # numbers of slices do not stand in for some of the times
        if len(places) < LEAST_SLICES or len({results[i].info.time_s is None for i in places}) > 1:
            continue
        motion = [_timed_pose(results[i], model) for i in places]
        if any(m.time_s < before.time_s for before, m in pairwise(motion)):
            continue
        for i, pose_ in zip(places, smooth(motion), strict=True):
            after[i] = _with_pose(results[i], model, pose_, scale)
    return after


def _timed_pose(result: FrameResult, model: RodModel) -> TimedPose:
    best = result.candidates[0]
    axes = StillAxes(middle=model.centre, T_patient_slice=result.info.T_patient_slice)
    G = axes.twist(best.T_slice_model)
    return TimedPose(
        time_s=float(result.index) if result.info.time_s is None else result.info.time_s,
        T=axes.pose(best.T_slice_model),
        covariance=G @ best.covariance @ G.T,
    )


def _with_pose(result: FrameResult, model: RodModel, pose_: TimedPose, scale: Scale | None) -> FrameResult:
    """The result with a smoothed pose in place of its own; matches stay, their residuals are those of the new pose."""
    best, info = result.candidates[0], result.info
    axes = StillAxes(middle=model.centre, T_patient_slice=info.T_patient_slice)
    T = axes.slice_pose(pose_.T)
    G = axes.slice_twist(T)
    used = scale or info.scale
    assert used is not None  # there would be no pose
    rods, spots = best.rod_index, best.spot_index
    desired = Desired.of(model, rods, result.spots.uv_px[spots], result.spots.covariance_px[spots], used.mm_per_px)
    seen = view(desired, T)
    # rods beside their drawing err alike in all slices: what that adds to the pose is not averaged away
    lasting = lasting_influence(model, T, rods, seen, used.mm_per_px)
    covariance = G @ pose_.covariance @ G.T + lasting @ lasting.T
    candidate = replace(
        best,
        T_slice_model=frozen(T, (4, 4)),
        covariance=frozen(covariance, (6, 6)),
        residual_px=frozen(seen.residual_px, (None, 2)),
        lambda_mm=frozen(seen.crossing.lambda_mm, (None,)),
        rms_px=seen.rms_px,
        chi2=seen.chi2,
        # the level was that of the slice alone
        protection_mm=frozen([], (None,)),
    )
    velocity = result.velocity
    if velocity is not None and pose_.velocity is not None and pose_.velocity_covariance is not None:
        velocity = Velocity(twist=G @ pose_.velocity, covariance=G @ pose_.velocity_covariance @ G.T)
    return replace(
        result,
        method="smoothed",
        candidates=(candidate,),
        targets=target_accuracy(model, candidate, info.T_patient_slice),
        velocity=velocity,
    )


def _rods_to_see(prediction: Prediction, shape: tuple[int, int] | None) -> IntArray:
    """The rods that may be seen, and are predicted in the image of this ``shape``."""
    rows, columns = shape or (math.inf, math.inf)
    seen = zip(prediction.visible.tolist(), prediction.spots_px.tolist(), strict=True)
    rods = [rod for rod, (may_be, (u, v)) in enumerate(seen) if may_be and 0 <= u <= columns - 1 and 0 <= v <= rows - 1]
    return np.array(rods, dtype=np.intp)


def _tracked_result(place: int, item: SpotSlice, tracker: Tracker, tracked: Tracked) -> FrameResult:
    index = place if item.index is None else item.index
    return frame_result(index, item, tracker.model, tracked.registration, method=tracked.method, tracked=tracked)


class _Scales:
    """Whether any slice of a run has a scale: one without is a row of its own, all without are no input.

    Slices that are at hand are all asked before the first result; of others it is known only at their end.

    Raises:
        MissingScaleError: no slice at hand has a scale, and none was given.
        InputError: what was given, or a slice has, is no scale.
    """

    def __init__(self, slices: Iterable[SliceLike], given: Scale | None) -> None:
        if given is not None:
            check_scale(given)
        self._is_known = given is not None
        self._lacking = ""
        if isinstance(slices, Sequence):
            for slice_ in slices:
                self.note(slice_)
            self.settle()

    def note(self, slice_: SliceLike) -> None:
        """Take a slice into account."""
        if slice_.info.scale is not None:
            check_scale(slice_.info.scale)
            self._is_known = True
        if not self._lacking and (isinstance(slice_, Slice) or not slice_.problem):
            self._lacking = slice_.info.name

    def settle(self) -> None:
        """There are no more slices."""
        if self._lacking and not self._is_known:
            raise MissingScaleError(missing_scale(self._lacking))


def missing_scale(name: str) -> str:
    """What is said of a file, or the first of several, that has no scale."""
    return f"{name}: no pixel scale in the input; give --scale SX SY (mm per pixel) or -c CALIBRATION"


def failure(index: int, item: SpotSlice, reason: str) -> FrameResult:
    """A slice without a pose."""
    return FrameResult(index=index, info=item.info, spots=item.spots, status="no_pose", reason=reason, method="")


def frame_result(
    index: int,
    item: SpotSlice,
    model: RodModel,
    registration: Registration,
    *,
    method: str,
    tracked: Tracked | None = None,
) -> FrameResult:
    """A verdict, with the targets' places and accuracy, as a row; ``tracked`` where it is one of a sequence."""
    best = registration.best
    return FrameResult(
        index=index,
        info=item.info,
        spots=item.spots,
        status=registration.status,
        reason=registration.reason,
        method=method if best is not None else "",
        candidates=registration.candidates,
        targets=() if best is None else target_accuracy(model, best, item.info.T_patient_slice),
        warnings=registration.warnings,
        stability=tracked.stability if tracked else None,
        velocity=tracked.velocity if tracked else None,
        begins=tracked is not None and tracked.begins,
    )


def target_accuracy(model: RodModel, best: Candidate, T_patient_slice: FloatArray | None) -> tuple[TargetAccuracy, ...]:
    """Where the frame's targets are, and the predicted rms error there (TRE), from the pose covariance.

    ``δP = V + Ω × (R p)``, so that cov(P) = G C Gᵀ with ``G = [I₃ | −[R p]ₓ]``. The residual says nothing of it.
    """
    result = []
    T = best.T_slice_model
    for place, target in enumerate(model.targets):
        arm = T[:3, :3] @ target.point
        G = np.hstack([np.eye(3), -skew(arm)])
        position = arm + T[:3, 3]
        patient = None if T_patient_slice is None else T_patient_slice[:3, :3] @ position + T_patient_slice[:3, 3]
        tre = math.sqrt(float(np.trace(G @ best.covariance @ G.T)))
        level = float(best.protection_mm[place]) if len(best.protection_mm) else None
        result.append(
            TargetAccuracy(id=target.id, position_slice=position, position_patient=patient, tre_mm=tre, pl_mm=level)
        )
    return tuple(result)
