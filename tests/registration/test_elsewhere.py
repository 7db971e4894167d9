"""What the spots allow without one of them lies within the protection level, however far from the pose."""

from __future__ import annotations

import math

import numpy as np

from ctreg_cli.arrays import BoolArray, FloatArray
from ctreg_cli.geometry import pose as poses
from ctreg_cli.registration.linearity import length_of_the_valley
from ctreg_cli.registration.refine import Observations, covariance_from_information, linearise, refine
from ctreg_cli.rods import RodModel, Target
from tests.oracle import OracleScene, random_frame
from tests.registration.frames import model_of, registered, scene_of, some_scene

TIP = np.array([0.0, 0.0, 60.0])
#: rise of χ² that is still a percent of the best in odds
PERCENT = 9.0


def a_scene(rng: np.random.Generator, *, sd_px: float) -> tuple[RodModel, OracleScene]:
    """Six rods, all seen, and a target below them."""
    frame = random_frame(rng, 6)
    model = model_of(frame)
    return RodModel(name=model.name, rods=model.rods, targets=(Target(id="tip", point=TIP),)), some_scene(
        rng, frame, sd_px=sd_px, least=6
    )


def seen_by(model: RodModel, world: OracleScene, b: int) -> Observations:
    """``b`` times the true labels, mm."""
    uv = np.zeros((len(model), 2))
    uv[world.rod_of_spot] = world.uv_px * world.mm_per_px
    return Observations(
        uv_px=np.repeat(uv[None], b, axis=0),
        covariance_px=np.tile(np.eye(2) * (world.sd_px * world.mm_per_px[0]) ** 2, (b, len(model), 1, 1)),
        matched=np.ones((b, len(model)), dtype=bool),
        mm_per_px=np.ones(2),
    )


def cut_inside(model: RodModel, lambda_mm: FloatArray, seen: Observations) -> BoolArray:
    """(b,) whether every matched rod is cut well within its ends."""
    inside = (lambda_mm > 1.0) & (lambda_mm < model.lengths - 1.0)
    return np.asarray((inside | ~seen.matched).all(axis=1))


def test_every_pose_that_the_spots_allow_without_one_lies_within_the_level() -> None:
    rng = np.random.default_rng(941)
    starts, elsewhere, checked = 48, 0, 0
    for _ in range(12):
        model, world = a_scene(rng, sd_px=0.1)
        scene, result = scene_of(world, model), registered(world, model)
        if result.status != "ok":
            continue
        T, level = result.candidates[0].T_slice_model, result.candidates[0].protection_mm[0]
        for rod in range(6):
            seen = seen_by(model, world, starts)
            seen.matched[:, rod] = False
            turns = rng.normal(size=(starts, 3)) * 0.3
            T0 = poses.update(np.repeat(T[None], starts, axis=0), np.hstack([np.zeros((starts, 3)), turns]))
            # turned about where the frame is cut
            T0[:, :2, 3] += scene.xy_mm.mean(axis=0) - (T0[:, :3, :3] @ model.centre + T0[:, :3, 3])[:, :2]
            T1, fit, _ = refine(model, T0, seen, iterations=60)
            H, _ = fit.normal_equations()
            good = cut_inside(model, fit.lambda_mm, seen) & (fit.chi2 < fit.chi2.min() + PERCENT)
            good &= np.linalg.cond(H) < 1e10
            off = np.linalg.norm((T1 - T)[good, :3, :3] @ TIP + (T1 - T)[good, :3, 3], axis=-1)
            assert (off <= level).all()
            elsewhere += int((off > 5).any())
            checked += 1
    assert checked > 40
    assert elsewhere > 0  # else nothing was tried


def test_a_valley_is_as_long_as_the_poses_in_it_say() -> None:
    """Random walks among the poses that cost less than 5.5 sd say how far the target may be."""
    rng = np.random.default_rng(942)
    sds, walkers, longer_than_linear = 5.5, 96, 0
    for _ in range(11):
        model, world = a_scene(rng, sd_px=0.1)
        seen = seen_by(model, world, 1)
        seen.matched[:, int(rng.integers(6))] = False
        T, fit, _ = refine(model, world.T[None], seen, iterations=40)
        C, _ = covariance_from_information(fit.normal_equations()[0], model.size_mm)
        factor = float(length_of_the_valley(model, T, C, seen, TIP[None], sds)[0, 0])
        assert factor >= 1
        arm = T[0, :3, :3] @ TIP
        G = np.hstack([np.eye(3), np.cross(np.eye(3), arm).T])
        sd = math.sqrt(np.linalg.eigvalsh(G @ C[0] @ G.T)[-1])

        many = seen.subset(np.zeros(walkers, dtype=np.intp))
        at, root = np.repeat(T, walkers, axis=0), np.linalg.cholesky(C[0])
        farthest = 0.0
        for _ in range(200):
            size = rng.choice([0.3, 1.0], size=(walkers, 1))
            new = poses.update(at, size * rng.normal(size=(walkers, 6)) @ root.T)
            there = linearise(model, new, many)
            kept = (there.chi2 < fit.chi2[0] + sds**2) & cut_inside(model, there.lambda_mm, many)
            at[kept] = new[kept]
            moved = (at[:, :3, :3] @ TIP + at[:, :3, 3]) - (arm + T[0, :3, 3])
            farthest = max(farthest, float(np.linalg.norm(moved, axis=1).max()))
        assert farthest <= 1.05 * factor * sds * sd
        longer_than_linear += farthest > 1.05 * sds * sd
    assert longer_than_linear > 0  # else the covariance alone would do
