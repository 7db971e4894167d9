"""Two rods that leave one spot: it is believed no more than the gap between their crossings allows."""

from __future__ import annotations

import numpy as np
import pytest

from ctreg_cli.geometry.projection import project
from ctreg_cli.imaging.spots import Spots
from ctreg_cli.registration.refine import merged_covariance
from ctreg_cli.registration.register import register
from ctreg_cli.rods import Rod, RodModel
from ctreg_cli.scale import Scale
from tests.oracle import cross_rod, random_frame, scene, twist_error
from tests.registration.frames import model_of

HALF_MM = Scale(s_x=0.5, s_y=0.5)


def pair(gap_mm: float) -> RodModel:
    """Two rods that cross the slice ``gap_mm`` apart, and a third far off."""
    starts = np.array([[0, 0, -10.0], [gap_mm, 0, -10], [50, 50, -10]])
    rods = tuple(Rod(id=f"r{i}", start=start, end=start + np.array([0, 0, 20.0])) for i, start in enumerate(starts))
    return RodModel(name="pair", rods=rods)


def blur(gap_mm: float, *, matched: tuple[bool, bool, bool] = (True, False, True)) -> np.ndarray:
    model = pair(gap_mm)
    at = project(np.eye(4)[None], model.starts, model.directions)
    found = merged_covariance(model, at.xy_mm, at.lambda_mm, np.array([matched]), 2.0)
    return np.zeros((3, 2, 2)) if found is None else found[0]


def test_half_the_gap_is_the_sd_along_it_and_nothing_across() -> None:
    for gap in (0.1, 0.5, 1.0):
        expected = np.zeros((3, 2, 2))
        expected[0, 0, 0] = (gap / 2) ** 2
        np.testing.assert_allclose(blur(gap), expected, atol=1e-12)


def test_it_fades_until_two_spots_can_be_told() -> None:
    gaps = np.linspace(1.0, 2.2, 61)
    sd = np.array([np.sqrt(blur(gap)[0, 0, 0]) for gap in gaps])
    assert sd[gaps >= 2.0].max() < 1e-6
    assert np.abs(np.diff(sd**2)).max() < 0.02  # no step, or the cost would have one


def test_a_rod_with_a_spot_of_its_own_blurs_none() -> None:
    assert not blur(0.5, matched=(True, True, True)).any()


@pytest.mark.parametrize("seed", range(12))
def test_a_pose_with_a_spot_of_two_rods_is_covered(seed: int) -> None:
    """Drawn exactly, spots sharp: only the two rods in one spot are amiss, and the covariance knows of it."""
    rng = np.random.default_rng([871, seed])
    while True:
        frame = random_frame(rng, 8)
        world = scene(rng, frame, sd_px=0.05, least=8)
        if world is None:
            continue
        hits = [cross_rod(a, b, world.R, world.t) for a, b in zip(frame.starts, frame.ends, strict=True)]
        at = np.array([hit[0] / 0.5 for hit in hits if hit is not None])
        gap = np.linalg.norm(at[:, None] - at[None], axis=-1) + 99 * np.eye(len(at))
        a, b = np.unravel_index(int(gap.argmin()), gap.shape)
        if 0.8 < gap[a, b] < 2.4:
            break
    share = rng.uniform(0.4, 0.6)
    apart = np.delete(at, [a, b], axis=0)
    uv = np.vstack([apart, share * at[a] + (1 - share) * at[b]])
    result = register(Spots.from_points(uv + rng.normal(size=uv.shape) * 0.05, 0.05), model_of(frame), scale=HALF_MM)
    if result.status == "ok":
        best = result.candidates[0]
        error = twist_error(best.T_slice_model[:3, :3], best.T_slice_model[:3, 3], world.R, world.t)
        assert np.sqrt(error @ np.linalg.inv(best.covariance) @ error) < 6, seed
