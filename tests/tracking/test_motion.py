"""The motion filter learns how steadily a frame moves, each way for itself; its predictions are as good as it says."""

from __future__ import annotations

import numpy as np
import pytest

from ctreg_cli.geometry import pose as poses
from ctreg_cli.tracking import motion

DT_S = 0.4


def run(path: np.ndarray, sd: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Squared normalised prediction errors (n, 6), innovations' χ² (n,), and intensities, along a path (n, 6)."""
    C = np.diag(sd**2)
    T = np.eye(4)
    errors, chi2, learnt = [], [], []
    state: motion.MotionState | None = None
    for twist in path:
        true = poses.update(T, twist)
        measured = poses.update(true, sd * rng.normal(size=6))
        if state is None:
            state = motion.start(measured, C, "velocity")
            continue
        there = motion.advance(state, DT_S, "velocity")
        innovation = poses.difference(measured, there.T)
        off = poses.difference(true, there.T)
        errors.append(off**2 / np.diag(there.pose_covariance))
        chi2.append(innovation @ np.linalg.solve(there.pose_covariance + C, innovation))
        state = motion.correct(there, innovation, C, DT_S, "velocity")
        learnt.append(np.array(state.intensity))
    return np.array(errors), np.array(chi2), learnt


@pytest.mark.parametrize("seed", range(4))
def test_breathing_along_one_axis_is_learnt_along_that_axis(seed: int) -> None:
    rng = np.random.default_rng([31, seed])
    n = 200
    times = DT_S * np.arange(n)
    path = np.zeros((n, 6))
    path[:, 2] = 5.0 * np.sin(np.pi * (times / rng.uniform(3.5, 5.5) + rng.uniform())) ** 4
    sd = np.array([0.05, 0.05, 0.3, 0.01, 0.01, 0.003])
    errors, _, learnt = run(path, sd, rng)
    late = slice(40, None)
    # a prediction is off by what it says, also where the breath turns; along the axes that rest it is never vague
    assert errors[late, 2].mean() < 2.0, seed
    assert errors[late, 2].max() < 25.0, seed
    assert learnt[-1][2] > 5 * learnt[-1][:2].max(), seed


@pytest.mark.parametrize("seed", range(4))
def test_a_drift_of_known_intensity_makes_innovations_what_they_should_be(seed: int) -> None:
    rng = np.random.default_rng([32, seed])
    n, intensity = 400, np.array([0.3, 2.0, 30.0, 1e-5, 1e-5, 1e-5])
    shape = np.linalg.cholesky(np.array([[DT_S**3 / 3, DT_S**2 / 2], [DT_S**2 / 2, DT_S]]))
    place, velocity, path = np.zeros(6), np.zeros(6), []
    for _ in range(n):
        path.append(place.copy())
        noise = shape @ rng.normal(size=(2, 6)) * np.sqrt(intensity)
        place, velocity = place + DT_S * velocity + noise[0], velocity + noise[1]
    errors, chi2, learnt = run(np.array(path), np.array([0.1, 0.1, 0.2, 0.01, 0.01, 0.01]), rng)
    # on the safe side: no prediction claims to be better than a sixth of a millimetre
    assert 2.5 < chi2[100:].mean() < 7.2, (seed, chi2[100:].mean())
    assert (errors[100:, :3].mean(axis=0) < 1.5).all(), (seed, errors[100:].mean(axis=0))
    assert learnt[-1][2] > learnt[-1][1] > learnt[-1][0], (seed, learnt[-1])
