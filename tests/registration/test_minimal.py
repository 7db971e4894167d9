"""Three rods and three spots: every real pose, parallel pairs and corners included."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ctreg_cli.registration.minimal import RodTriples, scan_three, solve_three
from tests.oracle import cross_line, cross_rod, random_frame, scene

CORNERS = [(x, y) for x in (-15, 15) for y in (-15, 15)]
#: four parallel rods, and slanted ones on the faces that meet them at the corners
CUBE = np.array(
    [[(x, y, -20), (x, y, 20)] for x, y in CORNERS]
    + [[(-15, 15, -20), (15, 15, 20)], [(15, -15, -20), (15, 15, 20)], [(-15, -15, -20), (15, -15, 20)]],
    dtype=float,
)


def scenes(rng: np.random.Generator, n: int, *, cube: bool) -> tuple[RodTriples, np.ndarray, np.ndarray]:
    """Rod triples, spots (n, 3, 2) and true poses (n, 4, 4)."""
    rods_all, spots_all, poses_all = [], [], []
    while len(poses_all) < n:
        rods = CUBE[rng.choice(len(CUBE), 3, replace=False)] if cube else rng.uniform(-20, 20, (3, 2, 3))
        d = rods[:, 1] - rods[:, 0]
        if np.linalg.svd(d / np.linalg.norm(d, axis=1, keepdims=True), compute_uv=False)[1] < 1e-3:
            continue  # three parallel rods
        R = Rotation.from_rotvec(rng.normal(size=3) * [0.3, 0.3, 2]).as_matrix()
        t = np.append(rng.uniform(-100, 100, 2), rng.uniform(-18, 18))
        hits = [cross_rod(a, b, R, t) for a, b in rods]
        if any(hit is None for hit in hits):
            continue
        xy = np.array([hit[0] for hit in hits if hit is not None])
        a, b = xy[1] - xy[0], xy[2] - xy[0]
        if abs(a[0] * b[1] - a[1] * b[0]) < 1e-3 * max(a @ a, b @ b):
            continue  # spots on a line
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, t
        rods_all.append(rods)
        spots_all.append(xy)
        poses_all.append(T)
    return triples_of(np.stack(rods_all)), np.stack(spots_all), np.stack(poses_all)


def triples_of(rods: np.ndarray) -> RodTriples:
    """Rods (h, 3, 2, 3) as starts and ends."""
    d = rods[:, :, 1] - rods[:, :, 0]
    length = np.linalg.norm(d, axis=2)
    return RodTriples(starts=rods[:, :, 0], directions=d / length[..., None], lengths=length)


def found(T: np.ndarray, which: np.ndarray, true: np.ndarray, within: float) -> float:
    """Share of the scenes with their true pose among the solutions."""
    error = np.abs(T[:, :3] - true[which][:, :3]).max(axis=(1, 2))
    nearest = np.full(len(true), np.inf)
    np.minimum.at(nearest, which, error)
    return float((nearest < within).mean())


@pytest.mark.parametrize("cube", [False, True], ids=["random", "parallel-pairs"])
def test_the_true_pose_is_among_the_solutions(cube: bool) -> None:
    triples, xy, true = scenes(np.random.default_rng(1), 500, cube=cube)
    T, which = solve_three(triples, xy)
    assert found(T, which, true, 1e-2) >= 0.999
    assert found(T, which, true, 1e-4) >= 0.995
    assert len(T) <= 8 * len(true)


@pytest.mark.parametrize("cube", [False, True], ids=["random", "parallel-pairs"])
def test_every_solution_is_one(cube: bool) -> None:
    """Each pose is rigid, right-handed, and puts the spots where they were."""
    triples, xy, _ = scenes(np.random.default_rng(2), 100, cube=cube)
    T, which = solve_three(triples, xy)
    np.testing.assert_allclose(np.linalg.det(T[:, :3, :3]), 1, atol=1e-9)
    for pose, i in zip(T, which, strict=True):
        ends = triples.starts[i] + triples.directions[i] * triples.lengths[i][:, None]
        again = [cross_line(a, b, pose[:3, :3], pose[:3, 3]) for a, b in zip(triples.starts[i], ends, strict=True)]
        assert np.abs(np.array(again) - xy[i]).max() < 2e-4


def test_the_order_of_the_rods_does_not_matter() -> None:
    triples, xy, _ = scenes(np.random.default_rng(3), 100, cube=True)
    order = [2, 0, 1]
    turned = RodTriples(
        starts=triples.starts[:, order], directions=triples.directions[:, order], lengths=triples.lengths[:, order]
    )
    first, which = solve_three(triples, xy)
    again, which_again = solve_three(turned, xy[:, order])
    missed = sum(
        np.abs(again[which_again == i] - pose).max(axis=(1, 2)).min(initial=np.inf) > 1e-3
        for pose, i in zip(first, which, strict=True)
    )
    assert missed <= 0.01 * len(first)  # double roots may come out as one


def test_near_solutions_are_kept_under_noise() -> None:
    """Noise makes close pairs of roots complex; what is returned then is near enough to start a refinement from."""
    rng = np.random.default_rng(4)
    triples, xy, true = scenes(rng, 200, cube=True)
    noisy = xy + rng.normal(size=xy.shape) * 0.02
    T, which = solve_three(triples, noisy, slack_mm=0.5, noise_mm=0.02)
    assert found(T, which, true, 5.0) > 0.95


def test_the_fast_scan_finds_what_the_solver_finds() -> None:
    """On frames as they are built, under noise: within 12 degrees of the true pose just as often."""
    rng = np.random.default_rng(5)
    rods, spots, true = [], [], []
    while len(true) < 250:
        frame = random_frame(rng, 6, 60, 80)
        world = scene(rng, frame, sd_px=0.3, least=6)
        if world is None:
            continue
        seen = rng.choice(6, 3, replace=False)
        of = world.rod_of_spot[seen]
        rods.append(np.stack([frame.starts[of], frame.ends[of]], axis=1))
        spots.append(world.uv_px[seen] * world.mm_per_px)
        true.append(world.R)
    triples, xy = triples_of(np.stack(rods)), np.stack(spots)

    def share(T: np.ndarray, which: np.ndarray) -> float:
        cosine = (np.einsum("rij,rij->r", T[:, :3, :3], np.stack(true)[which]) - 1) / 2
        return len(set(which[cosine > np.cos(np.radians(12))].tolist())) / len(true)

    assert share(*scan_three(triples, xy, slack_mm=0.6, noise_mm=0.15)) > 0.6
    assert (
        share(*scan_three(triples, xy, slack_mm=0.6, noise_mm=0.15))
        > share(*solve_three(triples, xy, slack_mm=0.6, noise_mm=0.15)) - 0.03
    )


def test_three_parallel_rods_give_nothing() -> None:
    starts = np.array([[[0.0, 0, 0], [30, 0, 0], [0, 30, 0]]])
    triples = RodTriples(starts=starts, directions=np.tile([0.0, 0, 1], (1, 3, 1)), lengths=np.full((1, 3), 40.0))
    T, which = solve_three(triples, np.array([[[0.0, 0], [31, 0], [3, 30]]]))
    assert len(T) == len(which) == 0
