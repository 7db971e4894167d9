"""The rods' true lines, from a scan of many slices: real frames are not their drawings (method §7).

Each rod has four unknowns, its two shifts across at either end, with the frame's ``tolerance`` as prior
(:mod:`~ctreg_cli.registration.adjustment`). Slices whose places are known from DICOM share one pose; without places
each has a pose of its own. Slices cannot see all rods moved together, for that is a pose: the mean rigid motion of the
rods is zero (in the prior's weights), and the standard deviations are those of what is left. So a refined frame keeps
its own coordinates as the mean of its rods, and targets written in them stay put to within the tolerance over √n.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ctreg_cli.arrays import BoolArray, FloatArray, frozen
from ctreg_cli.errors import InputError, MissingScaleError, SingularGeometryError
from ctreg_cli.geometry.plucker import skew
from ctreg_cli.imaging.spot_slice import SpotSlice
from ctreg_cli.registration.adjustment import BOW_SHARE, Adjustment, ScanSpots, adjust
from ctreg_cli.registration.joint import register_joint, scan_spots
from ctreg_cli.registration.options import RegistrationOptions
from ctreg_cli.registration.refine import across, model_without_tolerance
from ctreg_cli.registration.register import register
from ctreg_cli.rods import RodModel
from ctreg_cli.scale import Scale

#: slices must know a rod's shifts at least this much better than the frame file did (ratio of sd, rms over the ends)
MOST_REMAINING = 0.5
#: least share of the rods that must be known so
LEAST_DETERMINED = 0.7


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RodRefinement:
    """A frame with its rods where a scan found them, and how far and how sure."""

    #: the frame, each rod's tolerance what is left of its uncertainty, and a bow
    model: RodModel
    #: (n, 2, 3) shift of each rod's start and end, model frame, mm
    shift_mm: FloatArray
    #: (n, 2) sd of a shift across the rod, rms of the two directions, mm
    sd_mm: FloatArray
    #: (n,) slices in which the rod was seen, and (n,) whether they determine it
    n_seen: tuple[int, ...]
    determined: BoolArray
    n_slices: int
    n_spots: int
    #: whether the slices share one pose
    one_pose: bool
    #: root mean square residual of the same spots with the rods as written (poses fitted again) and as found, px
    rms_before_px: float
    rms_after_px: float
    #: factor by which the standard deviations were widened because the spots were worse than believed
    inflation: float
    #: estimated over stated scale along u and v, and its sd; None where the scales were taken as given
    scale_factor: FloatArray | None
    scale_factor_sd: FloatArray | None


def refine_rods(
    slices: Sequence[SpotSlice],
    model: RodModel,
    *,
    scale: Scale | None = None,
    tolerance_mm: float | None = None,
    free_scales: bool = False,
    options: RegistrationOptions | None = None,
) -> RodRefinement:
    """Estimate the rods' true lines from the slices of one scan.

    Args:
        slices: spots of every slice.
        model: the frame as written.
        scale: mm per pixel of all slices; None: each slice's own.
        tolerance_mm: how far rods may lie off (sd); None: as the frame file says.
        free_scales: also estimate a factor on each scale.
        options: see :class:`RegistrationOptions`.

    Raises:
        InputError: neither the frame file nor ``tolerance_mm`` says how far rods may lie off.
        MissingScaleError: no slice has a scale, and none was given.
        SingularGeometryError: the slices do not determine the rods; the sentence says what is missing.
    """
    if tolerance_mm is not None:
        model = replace(model, rods=tuple(replace(rod, tolerance_mm=tolerance_mm) for rod in model.rods))
    if not (model.tolerances > 0).all():
        raise InputError(
            f"{model.name}: rods of tolerance 0 are where they are written; "
            "write a tolerance into the frame file, or give one"
        )
    options = options or RegistrationOptions()
    if any(item.info.T_patient_slice is not None for item in slices):
        scan, T = _one_pose(slices, model, scale, options)
    else:
        scan, T = _own_poses(slices, model, scale, options)
    found = adjust(model, T, scan, free_scales=free_scales)
    return _refinement(model, scan, found, free_scales=free_scales)


def _one_pose(
    slices: Sequence[SpotSlice], model: RodModel, scale: Scale | None, options: RegistrationOptions
) -> tuple[ScanSpots, FloatArray]:
    joint = register_joint(slices, model, scale=scale, options=options)
    if joint.status != "ok" or joint.scan is None or joint.T_patient_model is None:
        raise SingularGeometryError(
            f"the slices have no common pose ({joint.reason}): see what each says with ctreg pose, or --joint"
        )
    return joint.scan, joint.T_patient_model[None]


def _own_poses(
    slices: Sequence[SpotSlice], model: RodModel, scale: Scale | None, options: RegistrationOptions
) -> tuple[ScanSpots, FloatArray]:
    used, scales, labels, T = [], [], [], []
    readable = [item for item in slices if not item.problem]
    if readable and scale is None and all(item.info.scale is None for item in readable):
        raise MissingScaleError(f"{readable[0].info.name}: no pixel scale in the input; give one in mm per pixel")
    for item in readable:
        own = scale or item.info.scale
        if own is None:
            continue
        verdict = register(
            item.spots,
            model,
            scale=own,
            thickness_mm=item.info.thickness_mm,
            shape=item.info.shape,
            options=replace(options, alert_limit_mm=None),
        )
        if verdict.status == "ok" and verdict.best is not None:
            used.append(item)
            scales.append(own)
            labels.append(verdict.best.spot_of_rod(len(model)))
            T.append(verdict.best.T_slice_model)
    if not used:
        raise SingularGeometryError("no slice gave a sure pose: see what each says with ctreg pose")
    places = np.broadcast_to(np.eye(4), (len(used), 4, 4))
    return scan_spots(model, used, scales, labels, places, np.arange(len(used))), np.stack(T)


def _refinement(model: RodModel, scan: ScanSpots, found: Adjustment, *, free_scales: bool) -> RodRefinement:
    n = len(model)
    P = _without_rigid_motion(model)
    frames = across(model.directions)
    components = np.einsum("nij,nei->nej", frames, found.shift_mm).ravel()
    shift = np.einsum("nij,nej->nei", frames, (P @ components).reshape(n, 2, 2))
    covariance = P @ found.shift_covariance @ P.T
    sd = np.sqrt(np.maximum(np.diag(covariance), 0).reshape(n, 2, 2).mean(axis=2))
    prior = P @ np.diag(np.repeat(2 * model.tolerances**2, 4)) @ P.T
    prior_sd = np.sqrt(np.diag(prior).reshape(n, 4).mean(axis=1))
    remaining = np.sqrt((sd**2).mean(axis=1))
    seen = found.matched.sum(axis=0)
    determined = (remaining <= MOST_REMAINING * prior_sd) & (seen > 0)
    _check_determined(model, scan, determined, remaining)
    rods = tuple(
        replace(
            rod,
            start=frozen(rod.start + d[0], (3,)),
            end=frozen(rod.end + d[1], (3,)),
            tolerance_mm=min(math.hypot(left, BOW_SHARE * rod.tolerance_mm), rod.tolerance_mm),
        )
        for rod, d, left in zip(model.rods, shift, remaining, strict=True)
    )
    before = adjust(model_without_tolerance(model), found.T_patient_model, scan.matching(found.matched), reject=False)
    factor = np.exp(found.log_scale)
    return RodRefinement(
        model=replace(model, rods=rods),
        shift_mm=frozen(shift, (n, 2, 3)),
        sd_mm=frozen(sd, (n, 2)),
        n_seen=tuple(int(count) for count in seen),
        determined=determined,
        n_slices=int(found.matched.any(axis=1).sum()),
        n_spots=int(found.matched.sum()),
        one_pose=len(found.T_patient_model) == 1,
        rms_before_px=before.rms_px,
        rms_after_px=found.rms_px,
        inflation=found.inflation,
        scale_factor=frozen(factor, (2,)) if free_scales else None,
        scale_factor_sd=frozen(factor * np.sqrt(np.diag(found.log_scale_covariance)), (2,)) if free_scales else None,
    )


def _without_rigid_motion(model: RodModel) -> FloatArray:
    """(4 n, 4 n) projection of shifts that takes out what a rigid motion of all rods explains, in the prior's weights.

    Components are ordered (rod, end, direction across), as in :class:`Adjustment`.
    """
    frames = across(model.directions)
    ends = np.stack([model.starts, model.ends], axis=1) - model.centre  # (n, 2, 3)
    moves = np.concatenate([np.broadcast_to(np.eye(3), (*ends.shape, 3)), -skew(ends) / model.size_mm], axis=-1)
    G = np.einsum("nij,neik->nejk", frames, moves).reshape(-1, 6)
    W = np.repeat(1 / model.tolerances**2, 4)[:, None]
    projection: FloatArray = np.eye(len(G)) - G @ np.linalg.pinv(G.T @ (W * G), hermitian=True) @ (W * G).T
    return projection


def _check_determined(model: RodModel, scan: ScanSpots, determined: BoolArray, remaining: FloatArray) -> None:
    """Refuse a scan that says little more of the rods than the frame file did.

    Raises:
        SingularGeometryError: in plain words.
    """
    if determined.mean() >= LEAST_DETERMINED:
        return
    n_slices = len(scan.pose_index)
    unknown = [
        f"{rod.id} ({left:.2g} mm)" for rod, left, ok in zip(model.rods, remaining, determined, strict=True) if not ok
    ]
    raise SingularGeometryError(
        f"{n_slices} usable slices tell little more of the rods than their tolerance ({model.tolerances.max():g} mm); "
        f"still unsure: {', '.join(unknown)}; more slices are needed, spread over the height of the frame"
    )
