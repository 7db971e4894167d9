"""Doubt: what else explains the spots is found, wherever the search has ended."""

from __future__ import annotations

import numpy as np
import pytest

from ctreg_cli.geometry import pose as poses
from ctreg_cli.imaging.spots import Spots
from ctreg_cli.registration.doubt import doubt
from ctreg_cli.registration.labelled import register_labelled
from ctreg_cli.registration.matching import Matches, Scene, search, weigh
from ctreg_cli.registration.options import RegistrationOptions
from ctreg_cli.registration.register import make_scene
from ctreg_cli.rods import RodModel
from ctreg_cli.scale import Scale
from tests.oracle import cross_rod, random_frame
from tests.registration.frames import model_of, scene_of, some_scene, true_match

HALF_MM = Scale(s_x=0.5, s_y=0.5)


@pytest.mark.parametrize("seed", [134, 140, *range(10)])
def test_every_minimum_of_the_true_match_is_found(seed: int) -> None:
    """The labelled solver starts elsewhere; what it ends in, doubt must know of (the first two have two minima)."""
    rng = np.random.default_rng([861, seed])
    frame = random_frame(rng, 5 + seed % 2)
    world = some_scene(rng, frame, sd_px=0.3, least=5)
    model, spots = model_of(frame), Spots.from_points(world.uv_px, 0.3)
    minima = register_labelled(spots, world.rod_of_spot, model, scale=HALF_MM)
    scene, true = scene_of(world, model), true_match(world, model)
    found = search(model, scene, least_matches=4)
    assert found is not None, seed
    found = doubt(model, scene, found, least_matches=4)
    same = [T for T, match in zip(found.T, found.spot_of_rod, strict=True) if (match == true).all()]
    for minimum in (m for m in minima if m.chi2 < minima[0].chi2 + 9):
        turns = [poses.rotation_angle(T[:3, :3] @ minimum.T_slice_model[:3, :3].T) for T in same]
        assert min(turns) < np.radians(2), seed


@pytest.mark.parametrize("seed", [0, 3, 4, 19, 23])
def test_doubt_leads_from_a_poor_minimum_to_the_true_match(seed: int) -> None:
    """One true match short, these scenes have a second minimum, where the spot left over fits no rod."""
    rng = np.random.default_rng([867, seed])
    frame = random_frame(rng, 6)
    world = some_scene(rng, frame, sd_px=0.3, least=6)
    model, spots = model_of(frame), Spots.from_points(world.uv_px, 0.3)
    short = np.array(world.rod_of_spot)
    short[0] = -1
    minima = register_labelled(spots, short, model, scale=HALF_MM)
    turned = [m for m in minima if poses.rotation_angle(m.T_slice_model[:3, :3] @ world.R.T) > np.radians(15)]
    scene, true = scene_of(world, model), true_match(world, model)[None]
    less = np.where(true == 0, -1, true)
    poor = weigh(model, scene, turned[0].T_slice_model[None], less, 4)
    full = weigh(model, scene, poses.make_pose(world.R, world.t)[None], true, 4)
    assert poor is not None
    assert full is not None
    assert full.log_odds[0] > poor.log_odds[0] + 4
    found = doubt(model, scene, poor, least_matches=4)
    assert found.log_odds[0] > full.log_odds[0] - 1e-3
    # and doubt has been cast on it in turn: the match short of a spot, at the pose of the full one, is there too
    near = [poses.rotation_angle(T[:3, :3] @ found.T[0, :3, :3].T) < np.radians(5) for T in found.T[1:]]
    assert any(near), seed


def planted(seed: int) -> tuple[RodModel, Scene, Matches, Matches] | None:
    """A match of six true spots and a false one in their other minimum, and the true one of eight; None: no such."""
    rng = np.random.default_rng([868, seed])
    frame = random_frame(rng, 8)
    world = some_scene(rng, frame, sd_px=0.3, least=8)
    model, spots = model_of(frame), Spots.from_points(world.uv_px, 0.3)
    lost = world.rod_of_spot[:2]
    six = np.where(np.isin(world.rod_of_spot, lost), -1, world.rod_of_spot)
    turned = [
        m.T_slice_model
        for m in register_labelled(spots, six, model, scale=HALF_MM)
        if poses.rotation_angle(m.T_slice_model[:3, :3] @ world.R.T) > np.radians(15)
    ]
    for T in turned:
        hit = cross_rod(frame.starts[lost[0]], frame.ends[lost[0]], T[:3, :3], T[:3, 3])
        if hit is None or not 0.1 < hit[1] < 0.9:
            continue
        uv = np.concatenate([world.uv_px, (hit[0] / 0.5 + rng.normal(size=2) * 0.3)[None]])
        scene = make_scene(Spots.from_points(uv, 0.3), model, HALF_MM, options=RegistrationOptions())
        true = true_match(world, model)[None]
        false = true.copy()
        false[0, lost] = 8, -1
        poor = weigh(model, scene, T[None], false, 4)
        full = weigh(model, scene, poses.make_pose(world.R, world.t)[None], true, 4)
        if poor is not None and full is not None and full.log_odds[0] > poor.log_odds[0]:
            return model, scene, poor, full
    return None


@pytest.mark.parametrize("seed", [43, 74, 127, 132, 157, 3, 7, 8])
def test_one_false_spot_does_not_hold_six_true_ones_in_their_other_minimum(seed: int) -> None:
    """In the first five the true pose is no minimum of the match with the false spot in it."""
    scene_of_two = planted(seed)
    assert scene_of_two is not None
    model, scene, poor, full = scene_of_two
    assert doubt(model, scene, poor, least_matches=4).log_odds[0] > full.log_odds[0] - 1e-3, seed
