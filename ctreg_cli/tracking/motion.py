"""How the frame moves: a Kalman filter of its pose and velocity that learns from the slices how steadily it moves.

The state is the pose and the velocity of the frame's middle, in axes that the table does not move (patient axes where
the slices have patient geometry, slice axes elsewhere). The velocity drifts as a Wiener process; its intensity, one
number along and one about every axis (breathing goes one way), follows the innovations by recursive maximum likelihood
with a fading memory (Ljung & Söderström, *Theory and Practice of Recursive Identification*, 1983, §3.7). Errors live in
the tangent space of the pose (``R ← exp([Ω]ₓ) R``, ``c ← c + V``), covariances are 12 × 12: pose error, then velocity
error.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from ctreg_cli.arrays import FloatArray
from ctreg_cli.tracking.single import carried, inverse_positive, shifted, updated

Prediction = Literal["velocity", "identity"]

_DEG = math.radians(1.0)
#: velocity of a frame of which nothing is known, sd, mm/s and rad/s: breathing, not a fall
FIRST_VELOCITY_SD = (6.0, 3.0 * _DEG)
#: intensity of the velocity's drift to start from, along and about the axes, mm²/s³ and rad²/s³; it is never taken to
#: be less than the second
FIRST_INTENSITY = (*3 * (20.0,), *3 * (20.0 * _DEG**2,))
LEAST_INTENSITY = (*3 * (0.05,), *3 * (0.05 * _DEG**2,))
MOST_INTENSITY = (*3 * (1e5,), *3 * (1e5 * _DEG**2,))
#: a slice is never predicted better than this, and the doubt grows with time, sd, mm and rad (a second: per √s)
LEAST_STEP_SD = (0.15, 0.15 * _DEG)
DOUBT_SD = (0.3, 0.3 * _DEG)
#: how fast old innovations are forgotten, and the longest step (ln) that one slice may change an intensity by
MEMORY, LEAST_LOG_STEP, MOST_LOG_STEP = 0.95, -0.5, 2.5
#: the variance of a velocity that is filtered from positions grows as this power of the intensity (Kalata 1984)
_SHARE_OF_VELOCITY = 0.75


class MotionState(NamedTuple):
    """What is known of the frame's motion at one time."""

    #: (4, 4) model axes, origin in the frame's middle → axes that the table does not move, mm
    T: FloatArray
    #: (6,) of the frame's middle, mm/s and rad/s
    velocity: FloatArray
    #: (12, 12) of pose and velocity, but for what lasts
    covariance: FloatArray
    #: (6,) intensity of the velocity's drift along and about the axes; the information gathered about its logarithm
    intensity: tuple[float, ...]
    information: tuple[float, ...]
    #: time that the motion has been watched for
    elapsed_s: float = 0.0
    #: (12, m) what errors that last (:mod:`.lasting`) do to pose and velocity, each of sd one; None: none
    lasting: FloatArray | None = None

    @property
    def pose_covariance(self) -> FloatArray:
        """(6, 6) of the pose, about the frame's middle."""
        return self._with_lasting(slice(6))

    @property
    def velocity_covariance(self) -> FloatArray:
        """(6, 6) of the velocity of the frame's middle."""
        return self._with_lasting(slice(6, 12))

    def _with_lasting(self, part: slice) -> FloatArray:
        covariance = self.covariance[part, part]
        return covariance if self.lasting is None else covariance + self.lasting[part] @ self.lasting[part].T


def start(
    T: FloatArray,
    covariance: FloatArray,
    kind: Prediction,
    intensity: tuple[float, ...] = FIRST_INTENSITY,
    lasting: FloatArray | None = None,
) -> MotionState:
    """The motion of a frame seen once.

    Args:
        T: (4, 4) its pose, origin in the middle.
        covariance: (6, 6) of it.
        kind: ``velocity``, or ``identity``: the frame stays where it is but for chance.
        intensity: what was learnt of the motion before.
        lasting: (6, m) what errors that last do to the pose, if any.
    """
    full = np.zeros((12, 12))
    full[:6, :6] = covariance
    if kind == "velocity":
        full.ravel()[_VELOCITY] = np.square(_each_axis(*FIRST_VELOCITY_SD))
    return MotionState(
        T=T,
        velocity=np.zeros(6),
        covariance=full,
        intensity=intensity,
        information=6 * (0.0,),
        lasting=None if lasting is None else np.concatenate([lasting, np.zeros_like(lasting)]),
    )


def advance(state: MotionState, dt_s: float, kind: Prediction) -> MotionState:
    """The motion ``dt_s`` later."""
    F = _EYE12.copy()
    if kind == "velocity":
        F.ravel()[_POSE_VELOCITY] = dt_s
    P = carried(F, state.covariance)
    diagonals = P.ravel()  # a view: every 13th element is the next on the diagonal
    drifted = np.array(state.intensity)
    drifted *= dt_s
    if kind == "velocity":
        diagonals[_VELOCITY] += drifted
        drifted *= 0.5 * dt_s
        diagonals[_POSE_VELOCITY] += drifted
        diagonals[_VELOCITY_POSE] += drifted
        drifted *= dt_s / 1.5
    # never less than a doubt that grows with time
    drifted += _each_axis(_LEAST2[0] + dt_s * _DOUBT2[0], _LEAST2[1] + dt_s * _DOUBT2[1])
    diagonals[_POSE] += drifted
    lasting = state.lasting
    if lasting is not None:
        lasting = F.dot(lasting)
    return MotionState(
        T=updated(state.T, dt_s * state.velocity),
        velocity=state.velocity,
        covariance=P,
        intensity=state.intensity,
        information=state.information,
        elapsed_s=state.elapsed_s,
        lasting=lasting,
    )


def correct(
    predicted: MotionState,
    innovation: FloatArray,
    covariance: FloatArray,
    dt_s: float,
    kind: Prediction,
    lasting: FloatArray | None = None,
) -> MotionState:
    """The motion with a measured pose taken in.

    Args:
        predicted: the motion at the time of the measurement.
        innovation: (6,) twist about the frame's middle from the predicted to the measured pose.
        covariance: (6, 6) of the measured pose.
        dt_s: time since the last measurement.
        kind: as for :func:`start`.
        lasting: (6, m) what errors that last do to the measured pose, if any; ``covariance`` holds these too, as if
            they were another in every slice: they can only be larger than what they do to the state.
    """
    S_inverse = inverse_positive(predicted.covariance[:6, :6] + covariance)
    gain = predicted.covariance[:, :6].dot(S_inverse)
    step = gain.dot(innovation)
    P = predicted.covariance - gain.dot(predicted.covariance[:6])
    intensity, information = _learn(predicted, S_inverse, innovation, dt_s, kind)
    return MotionState(
        T=updated(predicted.T, step[:6]),
        velocity=predicted.velocity + step[6:],
        covariance=0.5 * (P + P.T),
        intensity=intensity,
        information=information,
        elapsed_s=predicted.elapsed_s + dt_s,
        lasting=_lasting(predicted.lasting, gain, lasting),
    )


def _lasting(predicted: FloatArray | None, gain: FloatArray, measured: FloatArray | None) -> FloatArray | None:
    """(12, m) what errors that last do to the state once a measurement with the ``gain`` (12, 6) has been taken in."""
    if measured is None:
        return predicted if predicted is None else predicted - gain @ predicted[:6]
    return gain @ measured if predicted is None else predicted + gain @ (measured - predicted[:6])


def _learn(
    predicted: MotionState, S_inverse: FloatArray, innovation: FloatArray, dt_s: float, kind: Prediction
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """One step of maximum likelihood on the logarithms of the intensities; none where measurement noise drowns them."""
    z, weights = S_inverse.dot(innovation).tolist(), S_inverse.diagonal().tolist()
    variances = predicted.covariance.diagonal()[6:].tolist()
    intensities, gathered = [], []
    for k, (intensity, old) in enumerate(zip(predicted.intensity, predicted.information, strict=True)):
        # how much of the innovation's variance grows with the intensity: the drift since, and that of the slices
        # before, which is in the velocity's variance
        share = dt_s * intensity
        if kind == "velocity":
            share = dt_s**2 * (_SHARE_OF_VELOCITY * max(variances[k] - share, 0.0) + share / 3)
        score = 0.5 * share * (z[k] * z[k] - weights[k])
        information = MEMORY * old + 0.5 * (share * weights[k]) ** 2
        log_step = min(max(score / (1.0 + information), LEAST_LOG_STEP), MOST_LOG_STEP)
        intensities.append(min(max(intensity * math.exp(log_step), LEAST_INTENSITY[k]), MOST_INTENSITY[k]))
        gathered.append(information)
    return tuple(intensities), tuple(gathered)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StillAxes:
    """Between a slice and the axes in which motion is described, which the table does not move.

    There a pose has its origin in the frame's middle (wherever the frame file put its own), and its axes are the
    patient's where the slice has patient geometry; the slice's own elsewhere.
    """

    #: (3,) the frame's middle, model frame, mm
    middle: FloatArray
    #: (4, 4) or None
    T_patient_slice: FloatArray | None

    def pose(self, T_slice_model: FloatArray) -> FloatArray:
        """The pose there of a pose in the slice."""
        T = T_slice_model.copy()
        T[:3, 3] += T[:3, :3].dot(self.middle)
        return T if self.T_patient_slice is None else self.T_patient_slice.dot(T)

    def slice_pose(self, T: FloatArray) -> FloatArray:
        """``T_slice_model`` of a pose there."""
        placed = T.copy()
        if self.T_patient_slice is not None:
            placed[:3, 3] -= self.T_patient_slice[:3, 3]
            placed[:3] = self.T_patient_slice[:3, :3].T.dot(placed[:3])
        placed[:3, 3] -= placed[:3, :3].dot(self.middle)
        return placed

    def twist(self, T_slice_model: FloatArray) -> FloatArray:
        """(6, 6) that takes a twist at the model origin in slice axes to the one there."""
        G = shifted(T_slice_model[:3, :3].dot(self.middle))
        if self.T_patient_slice is not None:
            G[:3] = self.T_patient_slice[:3, :3].dot(G[:3])
            G[3:, 3:] = self.T_patient_slice[:3, :3]
        return G

    def slice_twist(self, T_slice_model: FloatArray) -> FloatArray:
        """The inverse of :meth:`twist`."""
        G = shifted(-T_slice_model[:3, :3].dot(self.middle))
        if self.T_patient_slice is not None:
            turn = self.T_patient_slice[:3, :3].T
            G[:3, 3:] = G[:3, 3:].dot(turn)
            G[:3, :3] = G[3:, 3:] = turn
        return G


def inverse_twist(G: FloatArray) -> FloatArray:
    """The inverse of a (6, 6) made by :meth:`StillAxes.twist`: ``[[R, L], [0, R]]``."""
    B = np.zeros((6, 6))
    R_inverse = G[3:, 3:].T
    B[:3, :3] = B[3:, 3:] = R_inverse
    B[:3, 3:] = -R_inverse.dot(G[:3, 3:]).dot(R_inverse)
    return B


def _each_axis(place: float, turn: float) -> FloatArray:
    """(6,) the same along every axis, and the same about every axis."""
    return np.array([place, place, place, turn, turn, turn])


_EYE12 = np.eye(12)
#: places in a (12, 12) covariance, row by row, of the diagonals of its four blocks
_POSE, _VELOCITY = slice(0, 72, 13), slice(78, None, 13)
_POSE_VELOCITY, _VELOCITY_POSE = slice(6, 72, 13), slice(72, 138, 13)
_LEAST2, _DOUBT2 = [sd * sd for sd in LEAST_STEP_SD], [sd * sd for sd in DOUBT_SD]
