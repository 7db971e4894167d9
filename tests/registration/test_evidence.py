"""The odds of a match: laws they must obey whatever the numbers."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ctreg_cli.geometry import pose as poses
from ctreg_cli.registration.evidence import PosePrior, log_odds
from ctreg_cli.registration.matching import Scene, observations, search
from ctreg_cli.registration.refine import refine
from ctreg_cli.rods import RodModel
from tests.oracle import OracleFrame, OracleScene, random_frame
from tests.registration.frames import model_of, some_scene


def true_odds(world: OracleScene, model: RodModel, extra_mm: np.ndarray | None = None, unit: float = 1.0) -> float:
    """ln odds of the true match, lengths in any unit."""
    xy = world.uv_px * world.mm_per_px * unit
    if extra_mm is not None:
        xy = np.concatenate([xy, extra_mm * unit])
    prior = PosePrior.of_rods(model.directions)
    sd = world.sd_px * float(world.mm_per_px[0]) * unit
    scene = Scene(xy_mm=xy, covariance_mm=np.tile(np.eye(2) * sd**2, (len(xy), 1, 1)), prior=prior)
    spot_of_rod = np.full((1, len(model)), -1, dtype=np.intp)
    for spot, rod in enumerate(world.rod_of_spot):
        if rod >= 0:
            spot_of_rod[0, rod] = spot
    T = np.array(world.T)
    T[:3, 3] *= unit
    T_fit, fit, _ = refine(model, T[None], observations(scene, spot_of_rod), iterations=30)
    matched = spot_of_rod >= 0
    return float(log_odds(model, prior, xy, T_fit, fit, matched, matched)[0])


@pytest.mark.parametrize("seed", range(4))
def test_odds_have_no_unit(seed: int) -> None:
    """Millimetres or metres: the odds are a pure number. A density forgotten anywhere would show."""
    rng = np.random.default_rng([901, seed])
    frame = random_frame(rng, 7)
    world = some_scene(rng, frame, sd_px=0.2, least=7)
    in_metres = OracleFrame(frame.starts * 1e-3, frame.ends * 1e-3)
    extra = 100 + rng.uniform(-20, 20, (3, 2))
    assert true_odds(world, model_of(in_metres), extra, unit=1e-3) == pytest.approx(
        true_odds(world, model_of(frame), extra), abs=1e-4
    )


def test_clutter_lowers_the_odds_and_sharper_spots_raise_them() -> None:
    rng = np.random.default_rng(902)
    frame = random_frame(rng, 8)
    world = some_scene(rng, frame, sd_px=0.2, least=8)
    model = model_of(frame)
    centre = (world.uv_px * world.mm_per_px).mean(axis=0)
    few = true_odds(world, model, centre + rng.uniform(-8, 8, (2, 2)))
    many = true_odds(world, model, centre + rng.uniform(-8, 8, (30, 2)))
    assert many < few < true_odds(world, model)
    sharp = some_scene(np.random.default_rng(902), frame, sd_px=0.02, least=8)
    assert true_odds(sharp, model) > true_odds(some_scene(np.random.default_rng(902), frame, sd_px=0.2, least=8), model)


def test_the_prior_over_rotations_is_a_density() -> None:
    """Its mean over uniformly random rotations, times the volume of SO(3), is one."""
    rng = np.random.default_rng(903)
    q = rng.normal(size=(40_000, 4))
    R = np.stack([poses.from_quaternion(x, np.zeros(3))[:3, :3] for x in q[:8000]])
    directions = np.array([[0.0, 0, 1], [0.1, 0, 1], [0, 0.2, 1]])
    prior = PosePrior.of_rods(directions / np.linalg.norm(directions, axis=1, keepdims=True))
    assert prior.axis_share > 0.8
    total = np.exp(prior.log_density(R)).mean() * 8 * math.pi**2
    assert total == pytest.approx(1, abs=0.06)  # 3 sd of the mean of 8,000
    cone = PosePrior(rotation=np.eye(3), max_angle_rad=math.radians(60))
    inside = cone.allows(R)
    assert (np.exp(cone.log_density(R)) * inside).mean() * 8 * math.pi**2 == pytest.approx(1, abs=0.15)


def test_chance_matches_obey_markovs_inequality() -> None:
    """Of scenes of pure clutter at most a share e^-x reaches ln odds x."""
    rng = np.random.default_rng(904)
    best = []
    for _ in range(30):
        model = model_of(random_frame(rng, 6))
        xy = 100 + rng.uniform(-15, 15, (int(rng.integers(6, 14)), 2))
        scene = Scene(
            xy_mm=xy,
            covariance_mm=np.tile(np.eye(2) * 0.05**2, (len(xy), 1, 1)),
            prior=PosePrior.of_rods(model.directions),
        )
        found = search(model, scene, least_matches=5)
        best.append(-np.inf if found is None else float(found.log_odds[0]))
    for x in (1.0, 2.0, 3.0):
        assert np.mean(np.array(best) > x) <= math.exp(-x) + 2 * math.sqrt(math.exp(-x) / len(best)), x


def test_a_rod_beside_a_matched_one_is_half_expected() -> None:
    """Of two rods without a spot, the one whose crossing falls on a matched rod's costs a match less."""
    rng = np.random.default_rng(905)
    frame = random_frame(rng, 7)
    world = some_scene(rng, frame, sd_px=0.1, least=7)
    model = model_of(frame)
    prior = PosePrior.of_rods(model.directions)
    xy = world.uv_px * world.mm_per_px
    scene = Scene(xy_mm=xy, covariance_mm=np.tile(np.eye(2) * 0.05**2, (len(xy), 1, 1)), prior=prior)
    spot_of_rod = np.full((1, len(model)), -1, dtype=np.intp)
    spot_of_rod[0, world.rod_of_spot] = np.arange(len(xy))
    spot_of_rod[0, 0] = -1
    matched = spot_of_rod >= 0
    T, fit, _ = refine(model, world.T[None], observations(scene, spot_of_rod), iterations=30)
    all_cut, first = np.ones_like(matched), np.arange(len(model))[None] == 0
    unseen = float(log_odds(model, prior, xy, T, fit, matched, all_cut)[0])
    beside = float(log_odds(model, prior, xy, T, fit, matched, all_cut & ~first, merged=first)[0])
    not_cut = float(log_odds(model, prior, xy, T, fit, matched, all_cut & ~first)[0])
    assert unseen < beside < not_cut
    assert beside - not_cut == pytest.approx(math.log(0.5), abs=0.1)  # but for the neighbourhood, which loses a rod
