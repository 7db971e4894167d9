"""The article's experiment: a frame servoed to the spots of another pose (Doignon et al. 2008, §3.1, fig. 4 and 5).

The spots of the desired pose are the measurement, with Gaussian noise if asked for; the frame starts elsewhere, and the
control law brings it there with the *updated* or the *constant* Jacobian. Everything on the way is kept.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from ctreg_cli.arrays import FloatArray, IntArray
from ctreg_cli.errors import SingularGeometryError
from ctreg_cli.geometry import pose as poses
from ctreg_cli.geometry.projection import project, within_bounds
from ctreg_cli.rods import RodModel
from ctreg_cli.scale import Scale
from ctreg_cli.tracking.servo import Desired, ServoOptions, servo, view

Strategy = Literal["updated", "constant"]
#: three pairs of rod and spot determine the twist
LEAST_RODS = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class ExperimentSettings:
    """The article's values where it gives them."""

    gain: float = 0.1
    #: sd of the noise on each coordinate of the desired spots, px
    noise_px: float = 0.0
    iterations: int = 200


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ServoRun:
    """One servoing, i + 1 poses from start to end."""

    strategy: Strategy
    #: (k,) rods that both poses show
    rods: IntArray
    #: (k, 2) spots servoed to, and (i + 1, k, 2) those of the poses, px
    desired_px: FloatArray
    spots_px: FloatArray
    #: (i + 1, 4, 4)
    T: FloatArray
    #: (i + 1, 6) error ``[V; Ω]`` against the true desired pose, mm and rad
    error: FloatArray
    #: (i + 1,) smallest eigenvalue of the symmetric part of Ĵ⁺J
    margin: FloatArray
    #: (6, 6) Cramér–Rao bound of the last error, mm and rad; zero without noise
    bound: FloatArray

    @property
    def angle_sum_deg(self) -> FloatArray:
        """(i + 1,) sum of the three absolute angles, the article's measure."""
        return np.asarray(np.degrees(np.abs(self.error[:, 3:]).sum(axis=1)))

    @property
    def position_mm(self) -> FloatArray:
        """(i + 1,) distance from the desired position."""
        return np.asarray(np.linalg.norm(self.error[:, :3], axis=1))

    @property
    def path_px(self) -> FloatArray:
        """(k,) length of each spot's path."""
        return np.asarray(np.linalg.norm(np.diff(self.spots_px, axis=0), axis=2).sum(axis=0))

    @property
    def bend_px(self) -> FloatArray:
        """(k,) greatest distance of each spot's path from its chord."""
        chord = self.spots_px[-1] - self.spots_px[0]
        length = np.maximum(np.linalg.norm(chord, axis=1), 1e-12)
        way = self.spots_px - self.spots_px[0]
        across = way[:, :, 0] * chord[:, 1] - way[:, :, 1] * chord[:, 0]
        return np.asarray(np.abs(across).max(axis=0) / length)


def run_servo(
    model: RodModel,
    T_start: FloatArray,
    T_desired: FloatArray,
    scale: Scale,
    strategy: Strategy,
    settings: ExperimentSettings,
    rng: np.random.Generator,
) -> ServoRun:
    """Servo the frame from ``T_start`` to the spots of ``T_desired`` (both (4, 4), mm).

    Raises:
        SingularGeometryError: the slice cuts fewer than three of the same rods at both poses, or rods that do not
            determine the pose.
    """
    s = scale.mm_per_px
    rods = shared_rods(model, T_start, T_desired)
    true_px = project(T_desired, model.starts[rods], model.directions[rods]).xy_mm / s
    noisy_px = true_px + settings.noise_px * rng.standard_normal(true_px.shape)
    unit_sd = np.broadcast_to(np.eye(2), (len(rods), 2, 2))  # all spots weigh the same
    desired = Desired.of(model, rods, noisy_px, unit_sd, s)
    at_desired = view(desired, T_desired)
    try:
        moved = servo(
            model,
            T_start,
            desired,
            options=ServoOptions(
                gain=settings.gain,
                step_tolerance=0.0,
                spot_tolerance_sd=0.0,
                residual_tolerance=0.0,
                max_iterations=settings.iterations,
            ),
            jacobian=at_desired.jacobian if strategy == "constant" else None,
            keep_path=True,
        )
    except np.linalg.LinAlgError as error:
        raise SingularGeometryError(f"{model.name}: the rods seen at both poses do not determine the pose") from error
    path = _path(moved.path_T)
    J = at_desired.jacobian
    return ServoRun(
        strategy=strategy,
        rods=rods,
        desired_px=noisy_px,
        spots_px=_path(moved.path_px),
        T=path,
        error=_errors(path, T_desired),
        margin=_path(moved.path_margin),
        bound=np.asarray(settings.noise_px**2 * np.linalg.inv(J.T @ J)),
    )


def shared_rods(model: RodModel, T_start: FloatArray, T_desired: FloatArray) -> IntArray:
    """Rods that the slice cuts at both poses.

    Raises:
        SingularGeometryError: fewer than three.
    """
    seen = np.ones(len(model), dtype=bool)
    for T in (T_start, T_desired):
        crossing = project(T, model.starts, model.directions)
        seen &= within_bounds(np.nan_to_num(crossing.lambda_mm, nan=-np.inf), model.lengths)
    rods = np.nonzero(seen)[0]
    if len(rods) < LEAST_RODS:
        raise SingularGeometryError(
            f"{model.name}: the slice cuts {len(rods)} of the same rods at both poses, 3 needed"
        )
    return rods


def _path(values: FloatArray | None) -> FloatArray:
    assert values is not None  # asked for
    return values


def _errors(T: FloatArray, T_desired: FloatArray) -> FloatArray:
    turn = Rotation.from_matrix(T[:, :3, :3] @ T_desired[:3, :3].T).as_rotvec()
    return np.concatenate([T[:, :3, 3] - T_desired[:3, 3], turn], axis=1)


def displaced_start(T: FloatArray, model: RodModel, shift_mm: FloatArray, turn_rad: FloatArray) -> FloatArray:
    """``T`` (4, 4) turned about the frame's middle by a rotation vector and shifted, slice axes."""
    middle = T[:3, :3] @ model.centre
    moved = poses.update(T, np.concatenate([shift_mm, turn_rad]))
    moved[:3, 3] += middle - moved[:3, :3] @ model.centre
    return moved
