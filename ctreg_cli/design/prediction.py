"""Rank, condition and predicted accuracy of a frame over seeded slices: the Cramér–Rao bound before any scan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctreg_cli.arrays import BoolArray, FloatArray, IntArray
from ctreg_cli.geometry.motion_field import motion_field, scaled_columns
from ctreg_cli.geometry.plucker import skew
from ctreg_cli.geometry.pose import exp_rotation, make_pose
from ctreg_cli.geometry.projection import Projection, project, within_bounds
from ctreg_cli.rods import RodModel

#: fewer rods in a slice never fix a pose
MIN_RODS_SEEN = 3
POSE_RANK, LINEAR_RANK = 6, 9
#: singular values below this share of the greatest are zero: columns are scaled, so singular ones are near 1e-16
RANK_TOLERANCE = 1e-8


@dataclass(frozen=True, slots=True, kw_only=True)
class DesignOptions:
    """The slices and spots to judge a frame for."""

    #: standard deviation of a spot's u and v, px
    noise_px: float = 0.1
    #: scale of the imagined slices
    mm_per_px: float = 0.5
    #: slices are tilted up to this (or the mount's ``max_angle_deg``, if less) from the frame's normal position
    max_tilt_deg: float = 30.0
    samples: int = 1000
    seed: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Accuracy:
    """Predicted errors: the median over slices, and the value that 95 of 100 slices keep."""

    #: root of the summed variances of the three rotations
    rotation_deg: float
    rotation_deg_95: float
    #: root-mean-square error of each target's position
    tre_mm: tuple[float, ...]
    tre_mm_95: tuple[float, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class SliceQuality:
    """All sampled slices that cut the same number of rods."""

    rods_seen: int
    #: of all sampled slices
    share: float
    #: of these: how many fix a pose (rank 6 of the motion field), and let the nine-unknown linear system be solved
    pose_share: float
    linear_share: float
    #: median conditions of the motion field and of the linear system, columns scaled by the frame's size; inf: singular
    condition: float
    linear_condition: float
    #: from spot noise alone, and with the rods' tolerance too; None where no slice fixes a pose
    spot_noise: Accuracy | None
    with_tolerance: Accuracy | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SampledSlices:
    """``s`` slices through a frame of ``n`` rods, about the frame's centre."""

    T: FloatArray
    projection: Projection
    #: (s, n) the slice cuts the rod itself
    seen: BoolArray
    #: (s, n, 2, 6) motion field in mm, zero for rods not seen
    J: FloatArray
    #: (s,) rank and condition of the scaled motion field and of the linear system
    pose_rank: IntArray
    pose_condition: FloatArray
    linear_rank: IntArray
    linear_condition: FloatArray


def sample_poses(model: RodModel, options: DesignOptions) -> FloatArray:
    """Poses (s, 4, 4) of the *centred* frame: random tilts from the mount (or rods upright), slices at all heights."""
    rng = np.random.default_rng(options.seed)
    max_tilt = np.radians(min(options.max_tilt_deg, model.mount.max_angle_deg if model.mount else np.inf))
    normal = model.mount.patient_from_model if model.mount else _upright(model)
    azimuth, tilt = rng.uniform(0, 2 * np.pi, options.samples), rng.uniform(0, max_tilt, options.samples)
    R = exp_rotation(tilt[:, None] * np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], axis=1)) @ normal
    z = np.concatenate([model.starts, model.ends] - model.centre) @ R[:, 2].T  # (2n, s)
    height = rng.uniform(z.min(axis=0), z.max(axis=0))
    return make_pose(R, np.stack([0 * height, 0 * height, -height], axis=1))


def sample_slices(model: RodModel, options: DesignOptions) -> SampledSlices:
    """Cut the frame with seeded slices, and see what each determines."""
    T = sample_poses(model, options)
    projection = project(T, model.starts - model.centre, model.directions)
    seen = within_bounds(projection.lambda_mm, model.lengths)
    J = np.where(seen[..., None, None], motion_field(T, projection), 0.0)
    pose_rank, pose_condition = _rank_and_condition(scaled_columns(J, model.size_mm).reshape(len(T), -1, POSE_RANK))
    linear_rank, linear_condition = _rank_and_condition(linear_system(projection, seen, model))
    return SampledSlices(
        T=T,
        projection=projection,
        seen=seen,
        J=J,
        pose_rank=pose_rank,
        pose_condition=pose_condition,
        linear_rank=linear_rank,
        linear_condition=linear_condition,
    )


def linear_system(projection: Projection, seen: BoolArray, model: RodModel) -> FloatArray:
    """Matrices (s, 3n, 9) of ``[y]ₓ (x l1 + y l2 + c) = −w`` (method §2), lengths in units of the frame's size.

    The spots' mean is taken off x and y: that changes c alone, and rank and condition then belong to the frame.
    """
    xy = np.where(seen[..., None], projection.xy_mm, 0.0)
    count = np.maximum(seen.sum(axis=1), 1)
    xy = (xy - (xy.sum(axis=1) / count[:, None])[:, None]) / model.size_mm
    K = skew(model.directions)  # (n, 3, 3)
    weights = np.where(seen[..., None], np.concatenate([xy, np.ones((*seen.shape, 1))], axis=-1), 0.0)  # (s, n, 3)
    system: FloatArray = np.einsum("snb,nij->snibj", weights, K).reshape(len(seen), -1, LINEAR_RANK)
    return system


def qualities(model: RodModel, slices: SampledSlices, options: DesignOptions) -> tuple[SliceQuality, ...]:
    """What the slices promise, one entry for each number of rods seen, most rods first."""
    rods_seen = slices.seen.sum(axis=1)
    fixed = (slices.pose_rank == POSE_RANK) & (rods_seen >= MIN_RODS_SEEN)
    errors = [predict(model, slices, fixed, tolerance, options) for tolerance in (0.0, 1.0)]
    found = []
    for count in range(len(model), MIN_RODS_SEEN - 1, -1):
        here = rods_seen == count
        if here.any():
            spot_noise, with_tolerance = (_summary(rotation[here[fixed]], tre[here[fixed]]) for rotation, tre in errors)
            found.append(
                SliceQuality(
                    rods_seen=count,
                    share=float(here.mean()),
                    pose_share=float(fixed[here].mean()),
                    linear_share=float((slices.linear_rank[here] == LINEAR_RANK).mean()),
                    condition=float(np.median(slices.pose_condition[here])),
                    linear_condition=float(np.median(slices.linear_condition[here])),
                    spot_noise=spot_noise,
                    with_tolerance=with_tolerance,
                )
            )
    return tuple(found)


def predict(
    model: RodModel, slices: SampledSlices, fixed: BoolArray, tolerance: float, options: DesignOptions
) -> tuple[FloatArray, FloatArray]:
    """Rotation error (k,) in degrees and target errors (k, targets) in mm of the slices that fix a pose.

    A rod off its place by ``e`` across itself moves its spot by ``[I₂ | −k] e``: covariance ``σ² (I + k kᵀ)``.
    ``tolerance`` multiplies the model's.
    """
    k = np.where(slices.seen[fixed][..., None], slices.projection.slope[fixed], 0.0)
    place_variance = (tolerance * model.tolerances) ** 2
    spot_variance = (options.noise_px * options.mm_per_px) ** 2
    C = spot_variance * np.eye(2) + place_variance[:, None, None] * (np.eye(2) + k[..., :, None] * k[..., None, :])
    J = scaled_columns(slices.J[fixed], model.size_mm)
    information = np.einsum("snai,snab,snbj->sij", J, np.linalg.inv(C), J)
    covariance = np.linalg.inv(information)
    rotation = np.degrees(np.sqrt(np.trace(covariance[:, 3:, 3:], axis1=1, axis2=2)) / model.size_mm)
    arms = np.einsum("sij,kj->ski", slices.T[fixed][:, :3, :3], target_points(model) - model.centre)
    shift = np.concatenate([np.broadcast_to(np.eye(3), (*arms.shape, 3)), -skew(arms) / model.size_mm], axis=-1)
    tre = np.sqrt(np.einsum("skai,sij,skaj->sk", shift, covariance, shift))
    return rotation, tre


def target_points(model: RodModel) -> FloatArray:
    """(k, 3) the frame's centre and then its targets, model frame, mm."""
    return np.stack([model.centre, *(target.point for target in model.targets)])


def _summary(rotation: FloatArray, tre: FloatArray) -> Accuracy | None:
    if not len(rotation):
        return None
    return Accuracy(
        rotation_deg=float(np.median(rotation)),
        rotation_deg_95=float(np.quantile(rotation, 0.95)),
        tre_mm=tuple(np.median(tre, axis=0).tolist()),
        tre_mm_95=tuple(np.quantile(tre, 0.95, axis=0).tolist()),
    )


def _rank_and_condition(matrices: FloatArray) -> tuple[IntArray, FloatArray]:
    values = np.linalg.svd(matrices, compute_uv=False)
    nonzero = values > RANK_TOLERANCE * values[:, :1]
    full = nonzero.all(axis=1)
    condition = np.where(full, values[:, 0] / np.where(full, values[:, -1], 1.0), np.inf)
    return nonzero.sum(axis=1).astype(np.intp), condition


def _upright(model: RodModel) -> FloatArray:
    """A rotation that stands the rods' common direction along z."""
    scatter = (model.directions * model.lengths[:, None]).T @ model.directions
    axes = np.linalg.eigh(scatter)[1].T  # rows, the common direction last
    axes[0] *= np.sign(np.linalg.det(axes))
    return axes
