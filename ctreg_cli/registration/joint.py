"""One rigid pose for all slices of a scan whose places are known from DICOM: what a scan of a frame at rest wants.

Every slice is registered alone, for its labels. The poses, carried into patient coordinates, must agree: the largest
set that does is kept (a frame with a symmetry has two such sets, and is ``ambiguous`` unless its ``mount`` settles it),
slices that are sure of another pose are named and left out. Then one pose is fitted to all spots, the frame's
``tolerance`` as a lasting error of each rod (:mod:`~ctreg_cli.registration.adjustment`): it does not average out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ctreg_cli.arrays import BoolArray, FloatArray, IntArray, frozen, frozen_index
from ctreg_cli.errors import InputError, MissingScaleError
from ctreg_cli.geometry import pose as poses
from ctreg_cli.geometry.projection import project
from ctreg_cli.imaging.spot_slice import SpotSlice
from ctreg_cli.registration.adjustment import Adjustment, ScanSpots, adjust
from ctreg_cli.registration.matching import nearest_assignment
from ctreg_cli.registration.options import RegistrationOptions
from ctreg_cli.registration.refine import Observations, linearise
from ctreg_cli.registration.register import RIVAL_LOG_ODDS, RIVAL_SD, make_scene, register, weakness
from ctreg_cli.registration.result import Candidate, Registration, Status
from ctreg_cli.rods import RodModel
from ctreg_cli.scale import Scale

#: slices whose poses are tried as the common one
_MOST_SEEDS = 12
#: odds (ln) that a slice without any candidate near a pose speaks against it, at most: as far as its search was kept
_UNSUPPORTED = -12.0
#: a joint fit whose spots lie so many times farther off than their sd allow is refused
_WORST_INFLATION = 4.0
#: spots a slice must show where the joint pose says, to confirm it; rods that must be there for their lack to deny it
_CONFIRMING, _DENYING = 3, 3
#: of the frame's size: spots known worse than this say nothing, rods cut nearer to an end than this need not show
_SHARP = 0.02


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JointRegistration:
    """One pose of the frame for a whole scan, and what each slice says to it."""

    status: Status
    reason: str
    #: (4, 4) model → patient, and (6, 6) covariance of its twist, patient axes, mm and rad; None without a pose
    T_patient_model: FloatArray | None = None
    covariance: FloatArray | None = None
    #: every slice's row: the joint pose in its own axes, or why it has none; in the order given
    slices: tuple[Registration, ...] = ()
    #: places of the slices whose spots the pose rests on
    used: tuple[int, ...] = ()
    #: place → reason of the slices left out
    left_out: dict[int, str] | None = None
    #: the fit, its slices in the order of ``used``; and its spots
    adjustment: Adjustment | None = None
    scan: ScanSpots | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _View:
    """A slice with a known place, and what it says on its own."""

    place: int
    item: SpotSlice
    scale: Scale
    T_patient_slice: FloatArray
    registration: Registration

    @property
    def candidates(self) -> tuple[Candidate, ...]:
        return () if self.registration.status == "no_pose" else self.registration.candidates

    def turned(self, C: FloatArray) -> FloatArray:
        """A twist covariance from slice to patient axes."""
        B = _both(self.T_patient_slice[:3, :3])
        return B @ C @ B.T


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Hypothesis:
    """A common pose, the candidate of each slice that agrees with it, and ln odds of all slices together."""

    T: FloatArray
    #: index of the view → its candidate
    members: dict[int, Candidate]
    log_odds: float


def register_joint(
    slices: Sequence[SpotSlice],
    model: RodModel,
    *,
    scale: Scale | None = None,
    options: RegistrationOptions | None = None,
) -> JointRegistration:
    """The pose of the frame in patient coordinates from all slices of one scan.

    Args:
        slices: spots of every slice; one that could not be read, or has no place in the patient, becomes ``no_pose``.
        model: the rods, mm.
        scale: mm per pixel of all slices; None: each slice's own.
        options: see :class:`RegistrationOptions`.

    Returns:
        The verdict on the scan and on each slice. A slice is ``ok`` when its spots confirm the joint pose, or when it
        has none to show (warning ``carried``); one that denies the pose is ``no_pose`` with reason ``inconsistent``.

    Raises:
        InputError: no slice has a place in the patient.
        MissingScaleError: no slice has a scale, and none was given.
    """
    options = options or RegistrationOptions()
    reasons = {place: reason for place, item in enumerate(slices) if (reason := unusable(item, scale))}
    if len(reasons) == len(slices):
        _refuse(slices, reasons)
    views = [_view(place, item, model, scale, options) for place, item in enumerate(slices) if place not in reasons]
    hypotheses = _hypotheses(views)
    if not hypotheses:
        own = {view.place: view.registration.reason for view in views}
        return _without_pose(slices, "no_consistent_match", own | reasons)
    fits = [_fit(views, hypothesis, model, options) for hypothesis in hypotheses]
    best = fits[0]
    if best.adjustment.inflation > _WORST_INFLATION:
        return _without_pose(slices, "bad_fit", reasons)
    rows = {view.place: _row(view, fits, model, options, index in best.places) for index, view in enumerate(views)}
    registrations = tuple(
        rows[place]
        if place in rows
        else Registration(status="no_pose", reason=reasons[place], n_spots=len(slices[place].spots))
        for place in range(len(slices))
    )
    return JointRegistration(
        status="ambiguous" if len(fits) > 1 else "ok",
        reason="rival_pose" if len(fits) > 1 else "",
        T_patient_model=frozen(best.T, (4, 4)),
        covariance=frozen(best.covariance, (6, 6)),
        slices=registrations,
        used=tuple(views[index].place for index in best.places),
        left_out={place: row.reason for place, row in enumerate(registrations) if row.status == "no_pose"},
        adjustment=best.adjustment,
        scan=best.scan,
    )


def _without_pose(slices: Sequence[SpotSlice], reason: str, reasons: dict[int, str]) -> JointRegistration:
    rows = tuple(
        Registration(status="no_pose", reason=reasons.get(place, reason), n_spots=len(item.spots))
        for place, item in enumerate(slices)
    )
    left_out = {place: row.reason for place, row in enumerate(rows)}
    return JointRegistration(status="no_pose", reason=reason, slices=rows, left_out=left_out)


def unusable(item: SpotSlice, scale: Scale | None) -> str:
    """Why a slice cannot take part; empty when it can."""
    if item.problem:
        return "unreadable"
    if item.info.T_patient_slice is None:
        return "no_position"
    return "no_scale" if scale is None and item.info.scale is None else ""


def _refuse(slices: Sequence[SpotSlice], reasons: dict[int, str]) -> None:
    """Say what is missing from every slice; nothing where none could be read, which the rows will say."""
    for place, reason in reasons.items():
        source = slices[place].info.name
        if reason == "no_position":
            raise InputError(
                f"{source}: no place in the patient (DICOM ImagePositionPatient and ImageOrientationPatient), "
                "and a joint pose rests on it; register every slice on its own"
            )
        if reason == "no_scale":
            raise MissingScaleError(f"{source}: no pixel scale in the input; give one in mm per pixel")


def _view(place: int, item: SpotSlice, model: RodModel, scale: Scale | None, options: RegistrationOptions) -> _View:
    own, T_patient_slice = scale or item.info.scale, item.info.T_patient_slice
    assert own is not None
    assert T_patient_slice is not None
    registration = register(
        item.spots,
        model,
        scale=own,
        T_patient_slice=T_patient_slice,
        thickness_mm=item.info.thickness_mm,
        shape=item.info.shape,
        options=replace(options, alert_limit_mm=None),
    )
    return _View(place=place, item=item, scale=own, T_patient_slice=T_patient_slice, registration=registration)


# --- consensus ------------------------------------------------------------------------------------------------------


def _hypotheses(views: list[_View]) -> list[_Hypothesis]:
    """The common pose most slices agree on, and those that come near its odds."""
    seeds = [(i, c) for i, view in enumerate(views) for c in view.candidates]
    seeds.sort(key=lambda seed: float(np.trace(seed[1].covariance[3:, 3:])))
    tried = [_agreeing(views, i, c) for i, c in seeds[:_MOST_SEEDS]]
    tried.sort(key=lambda h: -h.log_odds)
    kept: list[_Hypothesis] = []
    for hypothesis in tried:
        if hypothesis.log_odds < tried[0].log_odds - RIVAL_LOG_ODDS:
            break
        if all(set(map(id, hypothesis.members.values())).isdisjoint(map(id, k.members.values())) for k in kept):
            kept.append(hypothesis)
    return kept


def _agreeing(views: list[_View], seed_index: int, seed: Candidate) -> _Hypothesis:
    """The candidate of each slice that lies within the uncertainties of both, and the odds of all slices."""
    T = views[seed_index].T_patient_slice @ seed.T_slice_model
    C = views[seed_index].turned(seed.covariance)
    members: dict[int, Candidate] = {}
    odds = 0.0
    for i, view in enumerate(views):
        if not view.candidates:
            continue
        distances = [
            _distance_sd(view.T_patient_slice @ c.T_slice_model, T, C + view.turned(c.covariance))
            for c in view.candidates
        ]
        nearest = int(np.argmin(distances))
        if distances[nearest] <= RIVAL_SD:
            members[i] = view.candidates[nearest]
            odds += max(members[i].log_odds - view.candidates[0].log_odds, _UNSUPPORTED)
        else:
            odds += _UNSUPPORTED
    return _Hypothesis(T=T, members=members, log_odds=odds)


def _distance_sd(T: FloatArray, T_other: FloatArray, covariance: FloatArray) -> float:
    twist = poses.difference(T, T_other)
    return float(np.sqrt(twist @ np.linalg.pinv(covariance, hermitian=True) @ twist))


def _both(R: FloatArray) -> FloatArray:
    """(6, 6) turning translation and rotation of a twist alike."""
    result = np.zeros((6, 6))
    result[:3, :3] = result[3:, 3:] = R
    return result


# --- fit ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Fit:
    """A common pose fitted to the spots of the slices ``places`` (indices of views, in the order of the scan)."""

    T: FloatArray
    covariance: FloatArray
    places: tuple[int, ...]
    adjustment: Adjustment
    scan: ScanSpots
    #: the rods where they were found to be, their remaining uncertainty as tolerance
    found: RodModel


def _fit(views: list[_View], hypothesis: _Hypothesis, model: RodModel, options: RegistrationOptions) -> _Fit:
    """Fit to the slices that agree; then let all others look where the pose says rods are, and fit again."""
    labels = {i: candidate.spot_of_rod(len(model)) for i, candidate in hypothesis.members.items()}
    fit = _fit_labelled(views, labels, model, hypothesis.T)
    before: object = None
    for _ in range(2):
        for i, view in enumerate(views):
            if i in hypothesis.members or view.registration.status == "ok":
                continue  # a slice that is sure of another pose is no witness for this one
            assigned = _predicted_labels(view, fit, options)
            if (assigned >= 0).sum() >= _CONFIRMING:
                labels[i] = assigned
        if before is None and len(labels) == len(hypothesis.members):
            break
        fit, before = _fit_labelled(views, labels, model, fit.T), fit
    return fit


def _fit_labelled(views: list[_View], labels: dict[int, IntArray], model: RodModel, T: FloatArray) -> _Fit:
    order = tuple(sorted(labels))
    scan = scan_spots(
        model,
        [views[i].item for i in order],
        [views[i].scale for i in order],
        [labels[i] for i in order],
        np.stack([views[i].T_patient_slice for i in order]),
        np.zeros(len(order), dtype=np.intp),
    )
    found = adjust(model, T[None], scan)
    return _Fit(
        T=found.T_patient_model[0],
        covariance=found.covariance[0],
        places=order,
        adjustment=found,
        scan=scan,
        found=_model_found(model, found),
    )


def scan_spots(
    model: RodModel,
    items: Sequence[SpotSlice],
    scales: Sequence[Scale],
    labels: Sequence[IntArray],
    T_patient_slice: FloatArray,
    pose_index: IntArray,
) -> ScanSpots:
    """Labelled slices as the adjustment wants them; ``labels`` are (n,) spots by rod, −1 for none."""
    uv = np.zeros((len(items), len(model), 2))
    covariance = np.tile(np.eye(2), (len(items), len(model), 1, 1))
    for row, (item, label) in enumerate(zip(items, labels, strict=True)):
        rods = np.nonzero(label >= 0)[0]
        uv[row, rods] = item.spots.uv_px[label[rods]]
        covariance[row, rods] = item.spots.covariance_px[label[rods]]
    thickness = [item.info.thickness_mm or 0.0 for item in items]
    return ScanSpots(
        observations=Observations(
            uv_px=uv,
            covariance_px=covariance,
            matched=np.stack(labels) >= 0,
            mm_per_px=np.stack([scale.mm_per_px for scale in scales]),
            half_slab_mm=0.5 * float(np.median(thickness)),
        ),
        T_patient_slice=T_patient_slice,
        pose_index=pose_index,
    )


def _model_found(model: RodModel, found: Adjustment) -> RodModel:
    """The rods where the fit has found them; what is left of the tolerance is kept as it was, to be safe."""
    rods = tuple(
        replace(rod, start=rod.start + d[0], end=rod.end + d[1])
        for rod, d in zip(model.rods, found.shift_mm, strict=True)
    )
    return replace(model, rods=rods)


def _predicted_labels(view: _View, fit: _Fit, options: RegistrationOptions) -> IntArray:
    """(n,) the spots nearest to where the joint pose says rods are, −1 for none."""
    result = np.full(len(fit.found), -1, dtype=np.intp)
    info, spots = view.item.info, view.item.spots
    # a spot known worse than this would confirm any pose
    sharp = np.nonzero((spots.sd_px * view.scale.mm_per_px).max(axis=1) < _SHARP * fit.found.size_mm)[0]
    if len(sharp):
        T, C = _in_slice(view, fit)
        scene = make_scene(
            spots.take(sharp),
            fit.found,
            view.scale,
            T_patient_slice=info.T_patient_slice,
            thickness_mm=info.thickness_mm,
            shape=info.shape,
            options=options,
        )
        assigned = nearest_assignment(fit.found, scene, T[None], C)[0]
        result = np.where(assigned >= 0, sharp[assigned], -1)
    return result


def _in_slice(view: _View, fit: _Fit) -> tuple[FloatArray, FloatArray]:
    """The joint pose and its covariance in a slice's own axes."""
    B = _both(view.T_patient_slice[:3, :3].T)
    return poses.inverse(view.T_patient_slice) @ fit.T, B @ fit.covariance @ B.T


def _must_show(view: _View, model: RodModel, T: FloatArray) -> BoolArray:
    """(n,) rods that the slice cuts well between their ends and inside the image."""
    projection = project(T, model.starts, model.directions)
    info = view.item.info
    with np.errstate(invalid="ignore"):
        per_mm = np.sqrt(1 + (projection.slope**2).sum(axis=1))
        slack = 0.5 * (info.thickness_mm or 0.0) * per_mm + _SHARP * model.size_mm
        result: BoolArray = (projection.lambda_mm > slack) & (projection.lambda_mm < model.lengths - slack)
        if info.shape is not None:
            uv = projection.xy_mm / view.scale.mm_per_px
            result &= ((uv >= 0) & (uv <= np.array([info.shape[1] - 1, info.shape[0] - 1]))).all(axis=1)
    return result


# --- rows -----------------------------------------------------------------------------------------------------------


def _row(view: _View, fits: list[_Fit], model: RodModel, options: RegistrationOptions, used: bool) -> Registration:
    """The joint pose as the row of one slice."""
    own, n_spots = view.registration, len(view.item.spots)
    denied = Registration(status="no_pose", reason="inconsistent", n_spots=n_spots)
    if own.status == "ok" and not used:
        return denied
    candidates = tuple(_candidate(view, fit, model, options) for fit in fits)
    best = candidates[0]
    confirmed = len(best.rod_index) >= _CONFIRMING
    if not confirmed and len(best.missing_rods) >= _DENYING:
        return denied
    warnings: list[tuple[str, str]] = []
    if not confirmed:
        warnings.append(("carried", "no spot of this slice confirms the pose; it is that of the other slices"))
    if best.inflation > 1:
        warnings.append(
            ("inflated", f"spots lie farther off than their sd allows; sd widened {best.inflation:.2f} times")
        )
    weak = weakness(model, best.covariance)
    if weak:
        warnings.append(("weak_geometry", weak))
    if view.item.spots.sd_assumed:
        warnings.append(("assumed_sd", "the spots came without sd; the covariance rests on an assumed one"))
    ambiguous = len(fits) > 1
    return Registration(
        status="ambiguous" if ambiguous else "ok",
        reason="rival_pose" if ambiguous else "",
        candidates=candidates,
        n_spots=n_spots,
        warnings=tuple(warnings),
    )


def _candidate(view: _View, fit: _Fit, model: RodModel, options: RegistrationOptions) -> Candidate:
    """The joint pose with the slice's own spots beside it: residuals are those from the rods as written."""
    T, C = _in_slice(view, fit)
    label = _predicted_labels(view, fit, options)
    scan = scan_spots(model, [view.item], [view.scale], [label], view.T_patient_slice[None], np.zeros(1, dtype=np.intp))
    lin = linearise(model, T[None], scan.observations)
    rods = np.nonzero(label >= 0)[0]
    missing = np.nonzero(_must_show(view, model, T) & (label < 0))[0]
    residual = lin.residual_px[0, rods]
    mine = view.registration.candidates[0].spot_of_rod(len(model)) if view.candidates else None
    agrees = mine is not None and bool((mine == label).all())
    return Candidate(
        T_slice_model=frozen(T, (4, 4)),
        covariance=frozen(C, (6, 6)),
        rod_index=frozen_index(rods),
        spot_index=frozen_index(label[rods]),
        residual_px=frozen(residual, (None, 2)),
        lambda_mm=frozen(lin.lambda_mm[0, rods], (None,)),
        missing_rods=frozen_index(missing),
        missing_px=frozen(lin.predicted_px[0, missing], (None, 2)),
        rms_px=float(np.sqrt((residual**2).mean())) if len(rods) else math.nan,
        chi2=float(lin.chi2[0]),
        degrees_of_freedom=2 * len(rods),
        log_odds=view.registration.candidates[0].log_odds if agrees else 0.0,
        inflation=fit.adjustment.inflation,
    )
