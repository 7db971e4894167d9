"""The whole motion in hindsight: a fixed-interval smoother on SE(3).

What :mod:`~ctreg_cli.tracking.motion` predicts forward is here estimated from all slices, before and after: a forward
Kalman filter and a backward Rauch–Tung–Striebel pass over pose and velocity, linearised about the estimate itself and
repeated (an iterated smoother). How the frame moves is learnt from the same slices: the intensity of the velocity's
drift, a full 6 × 6 matrix, by expectation maximisation (Shumway & Stoffer 1982). Breathing moves a frame to and fro
along *one* direction of six; in the other five the matrix becomes small, and many slices are averaged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ctreg_cli.arrays import FloatArray
from ctreg_cli.geometry import pose as poses
from ctreg_cli.tracking.motion import FIRST_INTENSITY, FIRST_VELOCITY_SD

#: rounds of expectation maximisation, and the slices from which the motion is learnt: more add time, not knowledge
ROUNDS, LEARN_FROM = 30, 400
#: rounds after which the smoother is linearised about its own result
_RELINEARISE = (1, 3, 6)
#: fewer slices do not tell how a motion changes: a drift learnt from them is too small more often than not, and with it
#: the covariance (three to six slices of a breath: NEES/6 of 2 to 9)
LEAST_SLICES = 10
#: what is believed of the drift beforehand counts as so many slices, and is so many times the tracker's first guess
PRIOR_SLICES, PRIOR_SHARE = 1.0, 0.02
#: shorter intervals are the same moment, s
_SAME_MOMENT_S = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TimedPose:
    """A pose in axes that the table does not move (:class:`~ctreg_cli.tracking.motion.StillAxes`)."""

    time_s: float
    #: (4, 4) and its (6, 6) covariance; mm and rad
    T: FloatArray
    covariance: FloatArray
    #: (6,) and (6, 6), mm/s and rad/s; of a measured pose nothing is known
    velocity: FloatArray | None = None
    velocity_covariance: FloatArray | None = None


def smooth(measured: Sequence[TimedPose]) -> list[TimedPose]:
    """The most probable motion through measured poses of one unbroken motion, in the order of time.

    A pose that repeats the one before to the last digit is the same slice twice, and counts once. The covariances are
    true from :data:`LEAST_SLICES` poses on.

    Returns:
        Pose and velocity at the same times, with their covariances. One pose alone comes back as it is.
    """
    if len(measured) < 2:
        return list(measured)
    times = np.array([m.time_s for m in measured])
    dt = np.maximum(np.diff(times), _SAME_MOMENT_S)
    z_T = np.stack([m.T for m in measured])
    z_C = np.stack([m.covariance for m in measured])
    new = np.array([True, *((a.T != b.T).any() for a, b in zip(measured[1:], measured[:-1], strict=True))])
    nominal = z_T.copy()
    drift = np.diag(FIRST_INTENSITY)
    n_learn = min(len(measured), LEARN_FROM)
    part = slice(0, n_learn)
    for round_ in range(ROUNDS):
        passed = _smooth_about(nominal[part], z_T[part], z_C[part], new[part], dt[: n_learn - 1], drift)
        if round_ in _RELINEARISE:
            nominal[part] = poses.update(nominal[part], passed.x[:, :6])
            passed = _smooth_about(nominal[part], z_T[part], z_C[part], new[part], dt[: n_learn - 1], drift)
        drift = _learnt(passed, dt[: n_learn - 1])
    for _ in range(2 if n_learn < len(measured) else 1):
        passed = _smooth_about(nominal, z_T, z_C, new, dt, drift)
        nominal = poses.update(nominal, passed.x[:, :6])
    return [
        TimedPose(
            time_s=float(time),
            T=T,
            covariance=P[:6, :6],
            velocity=x[6:],
            velocity_covariance=P[6:, 6:],
        )
        for time, T, x, P in zip(times, nominal, passed.x, passed.P, strict=True)
    ]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Pass:
    """One forward and backward pass over n slices."""

    #: (n, 12) pose relative to the nominal one, and velocity; (n, 12, 12)
    x: FloatArray
    P: FloatArray
    #: (n − 1, 12, 12) covariance of each state with the next
    P_next: FloatArray
    #: (n − 1, 12, 12) and (n − 1, 12): x_next = F x + b + drift
    F: FloatArray
    b: FloatArray


def _smooth_about(
    nominal: FloatArray, z_T: FloatArray, z_C: FloatArray, new: FloatArray, dt: FloatArray, drift: FloatArray
) -> _Pass:
    n = len(nominal)
    F = np.tile(np.eye(12), (n - 1, 1, 1))
    b = np.zeros((n - 1, 12))
    b[:, :6] = -_differences(nominal[1:], nominal[:-1])
    F[:, 3:6, 3:6] = poses.exp_rotation(-b[:, 3:6])
    F[:, np.arange(6), np.arange(6, 12)] = dt[:, None]
    z = _differences(z_T, nominal)
    Q = np.kron(_shape_of_drift(dt), drift)

    filtered_x, filtered_P = np.empty((n, 12)), np.empty((n, 12, 12))
    predicted_x, predicted_P = np.zeros((n, 12)), np.empty((n, 12, 12))
    spread = 1e3 * np.repeat(np.square([*FIRST_VELOCITY_SD, *FIRST_VELOCITY_SD]).reshape(2, 2), 3, axis=1).reshape(-1)
    predicted_P[0] = np.diag(spread)
    for k in range(n):
        if k:
            predicted_x[k] = F[k - 1] @ filtered_x[k - 1] + b[k - 1]
            predicted_P[k] = F[k - 1] @ filtered_P[k - 1] @ F[k - 1].T + Q[k - 1]
        x, P = predicted_x[k], predicted_P[k]
        if new[k]:
            gain = np.linalg.solve(P[:6, :6] + z_C[k], P[:6]).T
            x = x + gain @ (z[k] - x[:6])
            P = P - gain @ P[:6]
        filtered_x[k], filtered_P[k] = x, 0.5 * (P + P.T)

    x, P, P_next = filtered_x.copy(), filtered_P.copy(), np.empty((n - 1, 12, 12))
    gains = np.linalg.solve(predicted_P[1:], F @ filtered_P[:-1]).transpose(0, 2, 1)
    for k in range(n - 2, -1, -1):
        G = gains[k]
        x[k] += G @ (x[k + 1] - predicted_x[k + 1])
        P[k] += G @ (P[k + 1] - predicted_P[k + 1]) @ G.T
        P_next[k] = G @ P[k + 1]
    return _Pass(x=x, P=P, P_next=P_next, F=F, b=b)


def _learnt(passed: _Pass, dt: FloatArray) -> FloatArray:
    """The drift's intensity (6, 6) that is most probable given how far the smoothed motion strays from even motion."""
    use = dt > _SAME_MOMENT_S
    F, x, P = passed.F[use], passed.x, passed.P
    stray = x[1:][use] - (F @ x[:-1][use, :, None])[:, :, 0] - passed.b[use]
    cross = F @ passed.P_next[use]
    second = stray[:, :, None] * stray[:, None, :] + P[1:][use] - cross - cross.transpose(0, 2, 1)
    second += F @ P[:-1][use] @ F.transpose(0, 2, 1)
    inverse = np.linalg.inv(_shape_of_drift(dt[use]))
    blocks = second.reshape(-1, 2, 6, 2, 6)
    total = np.einsum("nij,niajb->ab", inverse, blocks)
    prior = PRIOR_SLICES * PRIOR_SHARE * np.diag(FIRST_INTENSITY)
    drift: FloatArray = (0.5 * total + prior) / (int(use.sum()) + PRIOR_SLICES)
    return 0.5 * (drift + drift.T)


def _shape_of_drift(dt: FloatArray) -> FloatArray:
    """(n, 2, 2) covariance of position and velocity after ``dt`` (n,) of drift of intensity one."""
    return np.stack([np.stack([dt**3 / 3, dt**2 / 2], axis=-1), np.stack([dt**2 / 2, dt], axis=-1)], axis=-2)


def _differences(T_to: FloatArray, T_from: FloatArray) -> FloatArray:
    """(n, 6) twists that take poses ``T_from`` (n, 4, 4) to ``T_to``."""
    turn = Rotation.from_matrix(T_to[:, :3, :3] @ T_from[:, :3, :3].transpose(0, 2, 1)).as_rotvec()
    return np.concatenate([T_to[:, :3, 3] - T_from[:, :3, 3], turn], axis=1)
