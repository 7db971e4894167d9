"""Refinement against SciPy's least squares, and scales against an arrow solved whole."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from ctreg_cli.geometry import pose as poses
from ctreg_cli.registration.refine import (
    Observations,
    covariance_from_information,
    linearise,
    refine,
    refine_scales,
    rod_end_shift,
)
from ctreg_cli.rods import Rod, RodModel
from tests.oracle import OracleFrame, OracleScene, cross_line, random_frame
from tests.registration.frames import model_of, some_scene


def observed(frame: OracleFrame, worlds: list[OracleScene]) -> Observations:
    """The oracle's spots, rod by rod."""
    n = len(frame)
    uv, matched = np.zeros((len(worlds), n, 2)), np.zeros((len(worlds), n), dtype=bool)
    for row, world in enumerate(worlds):
        for spot, rod in enumerate(world.rod_of_spot):
            uv[row, rod], matched[row, rod] = world.uv_px[spot], True
    covariance = np.tile(np.eye(2) * worlds[0].sd_px ** 2, (len(worlds), n, 1, 1))
    return Observations(uv_px=uv, covariance_px=covariance, matched=matched, mm_per_px=worlds[0].mm_per_px)


def oracle_fit(frame: OracleFrame, worlds: list[OracleScene], *, scales: bool) -> np.ndarray:
    """The same minimum by SciPy from the truth, plain loops, numeric derivatives."""

    def residual(x: np.ndarray) -> np.ndarray:
        s = x[-2:] if scales else worlds[0].mm_per_px
        parts = []
        for row, world in enumerate(worlds):
            V, Omega = x[6 * row : 6 * row + 3], x[6 * row + 3 : 6 * row + 6]
            R, t = Rotation.from_rotvec(Omega).as_matrix() @ world.R, world.t + V
            for spot, rod in enumerate(world.rod_of_spot):
                if rod >= 0:
                    parts.append(world.uv_px[spot] - cross_line(frame.starts[rod], frame.ends[rod], R, t) / s)
        return np.concatenate(parts)

    start = np.zeros(6 * len(worlds) + 2 * scales)
    if scales:
        start[-2:] = worlds[0].mm_per_px
    return least_squares(residual, start, xtol=1e-14, ftol=1e-14, gtol=1e-14).x


@pytest.mark.parametrize("seed", range(6))
def test_the_minimum_is_scipys(seed: int) -> None:
    rng = np.random.default_rng([911, seed])
    frame = random_frame(rng, 8, 60, 80)
    world = some_scene(rng, frame, sd_px=0.3, mm_per_px=(0.45, 0.6), least=6)
    start = poses.update(world.T, rng.normal(size=6) * [1, 1, 1, 0.03, 0.03, 0.03])
    T, fit, _ = refine(model_of(frame), start[None], observed(frame, [world]), iterations=40)
    x = oracle_fit(frame, [world], scales=False)
    expected = poses.update(world.T, x)
    np.testing.assert_allclose(T[0], expected, atol=2e-5)
    # and there the gradient vanishes
    _, gradient = fit.normal_equations()
    assert np.abs(gradient).max() < 1e-3 * np.abs(fit.normal_equations()[0]).max()


def test_scales_and_poses_together_are_scipys() -> None:
    rng = np.random.default_rng(912)
    frame = random_frame(rng, 9, 60, 80)
    worlds = [some_scene(rng, frame, sd_px=0.1, mm_per_px=(0.45, 0.6), least=8) for _ in range(3)]
    o = observed(frame, worlds)
    start = Observations(
        uv_px=o.uv_px, covariance_px=o.covariance_px, matched=o.matched, mm_per_px=np.array([0.46, 0.59])
    )
    found = refine_scales(model_of(frame), np.stack([w.T for w in worlds]), start)
    x = oracle_fit(frame, worlds, scales=True)
    assert found.converged
    np.testing.assert_allclose(found.mm_per_px, x[-2:], rtol=2e-5)
    for row, world in enumerate(worlds):
        np.testing.assert_allclose(found.T[row], poses.update(world.T, x[6 * row : 6 * row + 6]), atol=5e-4)


def test_sd_of_the_scales_is_true() -> None:
    rng = np.random.default_rng(913)
    frame = random_frame(rng, 9, 60, 80)
    squares = []
    for _ in range(40):
        worlds = [some_scene(rng, frame, sd_px=0.2, mm_per_px=(0.5, 0.55), least=8) for _ in range(2)]
        found = refine_scales(model_of(frame), np.stack([w.T for w in worlds]), observed(frame, worlds))
        error = found.mm_per_px - [0.5, 0.55]
        squares.append(error @ np.linalg.inv(found.covariance) @ error)
    assert abs(np.mean(squares) - 2) < 3 * 2 / np.sqrt(len(squares)), np.mean(squares)


def test_a_direction_nobody_sees_gets_a_huge_variance() -> None:
    H = np.diag([1.0, 1, 1, 100, 100, 0])
    covariance, condition = covariance_from_information(H, 10.0)
    assert np.isinf(condition)
    assert covariance[5, 5] > 1e3
    np.testing.assert_allclose(np.diag(covariance)[:5], [1, 1, 1, 0.01, 0.01])


def metal_in_slab(z_end: float, tangent: float, radius: float, half_slab: float) -> tuple[float, float]:
    """Of a rod that comes from below and ends at ``z_end``: its mean, as mm of z along the rod, and its share.

    Discs of the slab, each cut by the end's face, which is square to the rod; summed up point by point.
    """
    cosine = 1 / np.hypot(1, tangent)
    z = np.linspace(-half_slab, half_slab, 81)[:, None, None]
    x, y = np.meshgrid(np.linspace(-1, 1, 61) * radius / cosine, np.linspace(-1, 1, 61) * radius)
    disc = (x * cosine) ** 2 + y**2 <= radius**2 * (1 + 1e-9)
    below = x * tangent * cosine + z / cosine <= z_end / cosine
    metal = disc & below
    return float(((z * tangent + x) * metal).sum() / max(metal.sum(), 1) / tangent), float(metal.mean() / disc.mean())


@pytest.mark.parametrize("diameter_mm", [1.0, 2.0, 5.0])
@pytest.mark.parametrize("tangent", [0.05, 0.3, 0.8])
@pytest.mark.parametrize("half_slab", [0.4, 1.5])
def test_what_the_end_of_a_rod_does_to_its_spot_is_charged(
    diameter_mm: float, tangent: float, half_slab: float
) -> None:
    rods = tuple(
        Rod(id=f"r{i}", start=[20.0 * i, 0, 0], end=[20.0 * i, 0, 60], diameter_mm=diameter_mm) for i in range(3)
    )
    model = RodModel(name="ends", rods=rods)
    slope = np.tile([0.6 * tangent, 0.8 * tangent], (3, 1))
    per_height = np.hypot(1, tangent)
    for z_end in np.linspace(-1, 1, 21) * (half_slab + 0.6 * diameter_mm):
        shift, share = metal_in_slab(z_end, tangent, diameter_mm / 2, half_slab)
        at_end = rod_end_shift(model, slope, np.full(3, 60 - z_end * per_height), half_slab)
        np.testing.assert_allclose(rod_end_shift(model, slope, np.full(3, z_end * per_height), half_slab), at_end)
        if share > 0.5:
            assert abs(shift) < 1.05 * at_end[0] + 1e-9, z_end
        elif share > 1 / 3:
            assert abs(shift) < 1.4 * at_end[0], z_end
        # also as it is seen from a pose that the shift of rods that end together has moved
        if share > 0.5:
            moved = rod_end_shift(model, slope, np.full(3, 60 - (z_end + abs(shift)) * per_height), half_slab)
            assert abs(shift) < 2.0 * moved[0] + 1e-9, z_end
    face = 0.5 * diameter_mm / 2 * min(1.0, 0.5 * diameter_mm * tangent / per_height / half_slab) / tangent
    far = (2 * half_slab + face + diameter_mm / 2 * tangent / per_height + 1e-9) * per_height
    np.testing.assert_array_equal(rod_end_shift(model, slope, np.full(3, far), half_slab), 0.0)
    np.testing.assert_array_equal(rod_end_shift(model, slope, np.full(3, 30.0), half_slab), 0.0)


def test_weights_follow_the_spots_covariances() -> None:
    """Spots known worse in u move the pose less: the estimate is the weighted minimum, not the plain one."""
    rng = np.random.default_rng(915)
    frame = random_frame(rng, 8, 60, 80)
    world = some_scene(rng, frame, sd_px=0.2, least=8)
    o = observed(frame, [world])
    covariance = np.array(o.covariance_px)
    covariance[:, :4] = np.diag([4.0, 0.01])
    weighted = Observations(uv_px=o.uv_px, covariance_px=covariance, matched=o.matched, mm_per_px=o.mm_per_px)
    T, _, _ = refine(model_of(frame), world.T[None], weighted, iterations=30)

    def cost(T_any: np.ndarray) -> float:
        return float(linearise(model_of(frame), T_any[None], weighted).chi2[0])

    best = cost(T[0])
    for _ in range(50):
        assert cost(poses.update(T[0], rng.normal(size=6) * 1e-3)) >= best
