"""Labelled spots: at the Cramér–Rao bound, with true covariance, and with every other minimum named."""

from __future__ import annotations

import numpy as np
import pytest

from ctreg_cli.arrays import FloatArray
from ctreg_cli.errors import InputError, SingularGeometryError
from ctreg_cli.imaging.spots import Spots
from ctreg_cli.registration.labelled import register_labelled
from ctreg_cli.registration.result import Candidate
from ctreg_cli.scale import Scale
from tests import oracle
from tests.registration.frames import model_of, scale_of, some_scene, spots_of

MM_PER_PX = (0.45, 0.62)
#: a pose known worse than this is not described by a covariance: the spots are not linear in it so far out
MOST_SD_RAD = 0.03
#: a second minimum within this Δχ² leaves the choice to chance; no estimator is at the bound there
TWIN_CHI2 = 12.0


def error_of(candidate: Candidate, world: oracle.OracleScene) -> FloatArray:
    T = candidate.T_slice_model
    error: FloatArray = oracle.twist_error(T[:3, :3], T[:3, 3], world.R, world.t)
    return error


def well_posed(rng: np.random.Generator, n: int, sd_px: float) -> tuple[oracle.OracleFrame, oracle.OracleScene]:
    while True:
        frame = oracle.random_frame(rng, n, size=60.0, height=80.0)
        world = oracle.scene(rng, frame, sd_px=sd_px, mm_per_px=MM_PER_PX, least=n)
        if world is None:
            continue
        variance = np.linalg.eigvalsh(world.bound)
        if variance[0] < 1e-12 * variance[-1]:  # four rods in one plane: a pseudo-inverse, no bound
            continue
        if np.sqrt(np.trace(world.bound[3:, 3:])) < MOST_SD_RAD:
            return frame, world


@pytest.mark.parametrize(
    ("n", "sd_px", "trials"), [(4, 0.05, 30), (5, 0.1, 25), (6, 0.3, 25), (9, 1.0, 12), (12, 0.05, 10)]
)
def test_error_is_at_the_bound_and_the_covariance_true(n: int, sd_px: float, trials: int) -> None:
    rng = np.random.default_rng(100 * n)
    against_bound, against_own = [], []
    for _ in range(trials):
        frame, world = well_posed(rng, n, sd_px)
        candidates = register_labelled(spots_of(world), world.rod_of_spot, model_of(frame), scale=scale_of(world))
        if len(candidates) > 1 and candidates[1].chi2 - candidates[0].chi2 < TWIN_CHI2:
            continue
        error = error_of(candidates[0], world)
        against_bound.append(error @ np.linalg.solve(world.bound, error) / 6)
        against_own.append(error @ np.linalg.solve(candidates[0].covariance, error) / 6)
    # χ² with 6 degrees of freedom: three sd of the mean over the trials
    allowed = 3 * np.sqrt(2 / 6 / len(against_bound))
    assert len(against_bound) > 0.7 * trials
    assert abs(np.mean(against_bound) - 1) < allowed
    assert abs(np.mean(against_own) - 1) < allowed


def test_scales_found_along_are_at_their_bound() -> None:
    rng = np.random.default_rng(3)
    normalised = []
    while len(normalised) < 12:
        frame, world = well_posed(rng, 8, 0.1)
        (best, *_) = register_labelled(spots_of(world), world.rod_of_spot, model_of(frame), scale=None)
        assert best.scale is not None
        assert best.scale_covariance is not None
        error = best.scale.mm_per_px - world.mm_per_px
        normalised.append(error @ np.linalg.solve(best.scale_covariance, error) / 2)
    assert abs(np.mean(normalised) - 1) < 3 * np.sqrt(1 / 12)


@pytest.mark.parametrize("n", [3, 4, 5])
def test_the_true_pose_is_among_the_minima_of_exact_spots(n: int) -> None:
    rng = np.random.default_rng(n)
    several = 0
    for _ in range(20):
        frame, world = well_posed(rng, n, 0.1)
        exact = np.array(
            [oracle.cross_line(frame.starts[i], frame.ends[i], world.R, world.t) for i in world.rod_of_spot]
        )
        spots = Spots.from_points(exact / world.mm_per_px, 0.1)
        found = register_labelled(spots, world.rod_of_spot, model_of(frame), scale=scale_of(world))
        several += len(found) > 1
        assert min(np.abs(error_of(candidate, world) * [1, 1, 1, 60, 60, 60]).max() for candidate in found) < 1e-3
        assert [c.chi2 for c in found] == sorted(c.chi2 for c in found)
    assert n == 5 or several > 5  # three and four rods do have several answers


def test_the_order_of_the_spots_does_not_matter() -> None:
    rng = np.random.default_rng(5)
    frame, world = well_posed(rng, 7, 0.3)
    order = rng.permutation(7)
    spots, model, scale = spots_of(world), model_of(frame), scale_of(world)
    first = register_labelled(spots, world.rod_of_spot, model, scale=scale)[0]
    again = register_labelled(spots.take(order), world.rod_of_spot[order], model, scale=scale)[0]
    np.testing.assert_allclose(again.T_slice_model, first.T_slice_model, atol=1e-7)
    np.testing.assert_allclose(again.covariance, first.covariance, rtol=1e-5, atol=1e-12)
    assert dict(zip(order[again.spot_index], again.rod_index, strict=True)) == dict(
        zip(first.spot_index, first.rod_index, strict=True)
    )


def test_spots_without_a_rod_are_left_alone_and_rods_without_a_spot_named() -> None:
    rng = np.random.default_rng(6)
    frame = oracle.random_frame(rng, 8)
    world = some_scene(rng, frame, sd_px=0.1, missing=1, false=3, least=6, height=(0.4, 0.6))
    best = register_labelled(spots_of(world), world.rod_of_spot, model_of(frame), scale=scale_of(world))[0]
    assert sorted(best.spot_index) == sorted(np.nonzero(world.rod_of_spot >= 0)[0])
    unseen = set(world.visible) - set(world.rod_of_spot.tolist())
    assert unseen <= set(best.missing_rods.tolist())
    assert best.missing_rods.size <= len(frame) - best.rod_index.size


def test_a_spot_beyond_its_rods_end_is_no_answer() -> None:
    """Rods a tenth as long: the pose that fits their lines does not cut them."""
    rng = np.random.default_rng(7)
    frame, world = well_posed(rng, 8, 0.1)
    shorter = oracle.OracleFrame(frame.starts, frame.starts + 0.05 * (frame.ends - frame.starts))
    assert register_labelled(spots_of(world), world.rod_of_spot, model_of(shorter), scale=scale_of(world)) == []


def test_labels_that_make_no_sense_are_refused() -> None:
    frame, world = well_posed(np.random.default_rng(8), 5, 0.1)
    spots, model, scale = spots_of(world), model_of(frame), Scale(s_x=0.5, s_y=0.5)
    for labels, words in (([0, 1], "one a spot"), ([0, 1, 2, 3, 5], "0 to 4"), ([0, 1, 2, 3, 3], "twice")):
        with pytest.raises(InputError, match=words):
            register_labelled(spots, labels, model, scale=scale)
    with pytest.raises(SingularGeometryError, match="2 labelled spots"):
        register_labelled(spots, [0, 1, -1, -1, -1], model, scale=scale)
