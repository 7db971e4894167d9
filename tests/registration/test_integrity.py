"""Protection levels: an error above them is rarer than the stated risk, one faulty spot or none."""

from __future__ import annotations

import numpy as np

from ctreg_cli.imaging.spots import Spots
from ctreg_cli.registration.options import RegistrationOptions
from ctreg_cli.registration.register import register
from ctreg_cli.rods import RodModel, Target
from tests.oracle import random_frame
from tests.registration.frames import model_of, scale_of, some_scene

TIP = Target(id="tip", point=np.array([0.0, 0.0, 60.0]))


def with_target(model: RodModel) -> RodModel:
    return RodModel(name=model.name, rods=model.rods, targets=(TIP,))


def test_no_error_exceeds_its_level_though_one_spot_is_off() -> None:
    rng = np.random.default_rng(931)
    checked, levels = 0, []
    for _ in range(20):
        frame = random_frame(rng, int(rng.integers(6, 10)))
        world = some_scene(rng, frame, sd_px=0.1, least=6)
        uv, angle = np.array(world.uv_px), rng.uniform(0, 2 * np.pi)
        uv[rng.integers(len(uv))] += rng.uniform(0.5, 5) * np.array([np.cos(angle), np.sin(angle)])
        result = register(Spots.from_points(uv, 0.1), with_target(model_of(frame)), scale=scale_of(world))
        if result.status == "ok":
            best = result.candidates[0]
            T = best.T_slice_model
            error = np.linalg.norm((T[:3, :3] - world.R) @ TIP.point + T[:3, 3] - world.t)
            assert error < best.protection_mm[0]
            levels.append(best.protection_mm[0])
            checked += 1
    assert checked > 12
    assert np.median(levels) < 40  # a level that says nothing would hold too


def test_five_matches_or_more_are_needed_for_a_level() -> None:
    rng = np.random.default_rng(932)
    frame = random_frame(rng, 4, size=90, height=100)
    for _ in range(20):
        world = some_scene(rng, frame, sd_px=0.02, least=4)
        result = register(Spots.from_points(world.uv_px, 0.02), with_target(model_of(frame)), scale=scale_of(world))
        if result.best is not None:
            assert np.isinf(result.best.protection_mm).all() or not len(result.best.protection_mm)


def test_an_alert_limit_refuses_what_it_cannot_protect() -> None:
    rng = np.random.default_rng(933)
    frame = random_frame(rng, 8)
    model = with_target(model_of(frame))
    world = some_scene(rng, frame, sd_px=0.1, least=8)
    spots, scale = Spots.from_points(world.uv_px, 0.1), scale_of(world)
    level = float(register(spots, model, scale=scale).candidates[0].protection_mm[0])
    tight = register(spots, model, scale=scale, options=RegistrationOptions(alert_limit_mm=0.9 * level))
    assert (tight.status, tight.reason, tight.candidates) == ("no_pose", "unprotected", ())
    wide = register(spots, model, scale=scale, options=RegistrationOptions(alert_limit_mm=1.1 * level))
    assert wide.status == "ok"


def test_less_risk_means_a_wider_level() -> None:
    rng = np.random.default_rng(934)
    frame = random_frame(rng, 8)
    world = some_scene(rng, frame, sd_px=0.1, least=8)
    spots, model, scale = Spots.from_points(world.uv_px, 0.1), model_of(frame), scale_of(world)
    levels = [
        float(
            register(spots, model, scale=scale, options=RegistrationOptions(integrity_risk=r))
            .candidates[0]
            .protection_mm[0]
        )
        for r in (1e-2, 1e-5, 1e-8)
    ]
    assert levels[0] < levels[1] < levels[2]
