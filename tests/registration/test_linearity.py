"""A covariance that is not true is not said: errors against it, where few noisy spots make the cost a bent valley."""

from __future__ import annotations

import numpy as np

from ctreg_cli.imaging.spots import Spots
from ctreg_cli.registration.labelled import register_labelled
from ctreg_cli.registration.linearity import covariance_along_the_valley
from ctreg_cli.registration.refine import Observations
from ctreg_cli.scale import Scale
from tests.oracle import OracleFrame, OracleScene, bound, cross_line, random_frame, twist_error
from tests.registration.frames import model_of, some_scene


def labelled_error(frame: OracleFrame, world: OracleScene) -> tuple[float, bool]:
    """(error / own sd)² / 6 of the best labelled pose, and whether its covariance is meant to be believed."""
    found = register_labelled(
        Spots.from_points(world.uv_px, world.sd_px), world.rod_of_spot, model_of(frame), scale=Scale(s_x=0.5, s_y=0.5)
    )
    best = found[0]
    error = twist_error(best.T_slice_model[:3, :3], best.T_slice_model[:3, 3], world.R, world.t)
    alone = len(found) == 1 or found[1].chi2 > found[0].chi2 + 9
    return float(error @ np.linalg.inv(best.covariance) @ error) / 6, best.linear and alone


def test_covariances_of_few_noisy_spots_are_true_where_they_are_said() -> None:
    rng = np.random.default_rng(890)
    nees, disowned = [], 0
    for _ in range(36):
        frame = random_frame(rng, 6)
        world = some_scene(rng, frame, sd_px=0.3, least=5)
        value, believed = labelled_error(frame, world)
        disowned += not believed
        if believed:
            nees.append(value)
    assert 0 < disowned < 18
    # the mean of n values of χ²₆ / 6 has an sd of √(1 / (3 n))
    assert abs(np.mean(nees) - 1) < 4 / np.sqrt(3 * len(nees))
    assert max(nees) < 6


def test_a_well_seen_frame_keeps_its_covariance() -> None:
    rng = np.random.default_rng(891)
    frame = random_frame(rng, 9)
    world = some_scene(rng, frame, sd_px=0.05, least=9)
    order = [int(r) for r in world.rod_of_spot]
    uv = np.empty((1, len(frame), 2))
    for rod in order:  # without noise the truth is the minimum
        uv[0, rod] = cross_line(frame.starts[rod], frame.ends[rod], world.R, world.t) / world.mm_per_px
    seen = Observations(
        uv_px=uv,
        covariance_px=np.broadcast_to(world.sd_px**2 * np.eye(2), (1, len(frame), 2, 2)),
        matched=np.isin(np.arange(len(frame)), order)[None],
        mm_per_px=world.mm_per_px,
    )
    C = bound(frame, order, world.R, world.t, world.mm_per_px, world.sd_px)
    covariance, factor, _ = covariance_along_the_valley(model_of(frame), world.T, C, seen)
    assert factor == 1.0
    assert covariance is C
