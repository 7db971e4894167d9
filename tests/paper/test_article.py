"""What the article claims of its simulation (Doignon et al. 2008, §3.1, fig. 4 and 5), as numbers."""

from __future__ import annotations

import numpy as np
import pytest

from ctreg_cli.io.rod_file import load_rod_model
from ctreg_cli.scale import Scale
from ctreg_cli.tracking.experiment import ExperimentSettings, ServoRun, Strategy, displaced_start, run_servo
from tests.oracle import bound
from tests.tracking.sequences import frame_of

CUBE = load_rod_model("rod-cube-30x30x40")
SCALE = Scale(s_x=0.488, s_y=0.488)
STRATEGIES: tuple[Strategy, ...] = ("updated", "constant")
RUNS = 200


def poses() -> tuple[np.ndarray, np.ndarray]:
    from scipy.spatial.transform import Rotation

    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(np.radians([7.0, -5.0, 17.0])).as_matrix()
    T[:3, 3] = [125.0, 125.0, 0.0]
    return displaced_start(T, CUBE, np.array([27.0, -22.0, 5.0]), np.radians([-9.0, 7.0, 12.0])), T


def run(strategy: Strategy, *, noise_px: float = 0.0, seed: int = 0, iterations: int = 60) -> ServoRun:
    settings = ExperimentSettings(gain=0.1, noise_px=noise_px, iterations=iterations)
    return run_servo(CUBE, *poses(), SCALE, strategy, settings, np.random.default_rng(seed))


@pytest.fixture(scope="module")
def noisy() -> dict[Strategy, list[ServoRun]]:
    return {s: [run(s, noise_px=0.5, seed=k) for k in range(RUNS)] for s in STRATEGIES}


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_paths_are_about_70_px_long(strategy: Strategy) -> None:
    assert run(strategy).path_px.mean() == pytest.approx(70.0, abs=5.0)


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_without_noise_both_strategies_converge_to_zero(strategy: Strategy) -> None:
    """Figure 4 (c) to (f), and on for as long as it takes: the error goes to nothing, at the rate of the gain."""
    made = run(strategy, iterations=250)
    assert made.angle_sum_deg[-1] < 1e-8
    assert made.position_mm[-1] < 1e-8
    assert made.angle_sum_deg[100] / made.angle_sum_deg[80] == pytest.approx(0.9**20, rel=0.1)


def test_updated_paths_are_straight_and_constant_ones_curved() -> None:
    """Figure 4 (a) and (b). Straight but for the finite gain, and for more than three rods (the article's footnote)."""
    updated, constant = run("updated"), run("constant")
    assert updated.bend_px.max() < 0.01 * updated.path_px.mean()
    assert constant.bend_px.max() > 5 * updated.bend_px.max()


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_the_margin_stays_positive_all_the_way(strategy: Strategy) -> None:
    """Equation 17: the sufficient condition for stability."""
    assert run(strategy).margin.min() > 0.2


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_at_half_a_pixel_the_end_is_within_three_degrees_and_a_millimetre(
    noisy: dict[Strategy, list[ServoRun]], strategy: Strategy
) -> None:
    """Figure 5: "about 3 degrees in average" (sum of the absolute angles) "and less than 1 mm"."""
    assert np.mean([made.angle_sum_deg[-1] for made in noisy[strategy]]) <= 3.0
    assert np.mean([made.position_mm[-1] for made in noisy[strategy]]) < 1.0
    assert max(made.position_mm[-1] for made in noisy[strategy]) < 1.5


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_the_end_error_is_the_statistical_bound(noisy: dict[Strategy, list[ServoRun]], strategy: Strategy) -> None:
    _, T = poses()
    made = noisy[strategy]
    C = bound(frame_of(CUBE), made[0].rods.tolist(), T[:3, :3], T[:3, 3], SCALE.mm_per_px, 0.5)
    ends = np.array([one.error[-1] for one in made])
    nees = np.einsum("ki,ij,kj->k", ends, np.linalg.inv(C), ends)
    # mean of 200 χ²₆: 6 ± 0.25; a little more for a problem that is not quite linear
    assert np.mean(nees) == pytest.approx(6.0, abs=1.0)
    np.testing.assert_allclose(made[0].bound, C, rtol=1e-3, atol=1e-7)


def test_both_strategies_end_alike(noisy: dict[Strategy, list[ServoRun]]) -> None:
    """ "The two control strategies provide similar results"."""
    for a, b in zip(*noisy.values(), strict=True):
        # less than one sd apart, by the same noise
        sd = np.sqrt(np.diag(a.bound))
        assert np.abs((a.error[-1] - b.error[-1]) / sd).max() < 1.0
    mean = {s: np.mean([one.angle_sum_deg[-1] for one in noisy[s]]) for s in STRATEGIES}
    assert mean["constant"] == pytest.approx(mean["updated"], rel=0.05)
