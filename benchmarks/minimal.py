"""Three rods, three spots, no noise: how often the true pose is among the solutions, beside PoseLib's ``gp3p``.

    python benchmarks/minimal.py [--trials 10000] [--seed 1]

Half of the triples are random, half come from a cube with four parallel rods and slanted ones on its faces, so that
parallel pairs and rods that meet at a corner are common. Spots come from the tests' oracle, which shares no code with
the package. (The matcher's ``scan_three`` trades such corners for speed; it is meant for frames as they are built.)
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parents[1]))

from ctreg_cli.registration.minimal import RodTriples, scan_three, solve_three
from tests.oracle import cross_rod

SIZE_MM = 20.0
CORNERS = [(x, y) for x in (-15, 15) for y in (-15, 15)]
CUBE = np.array(
    [[(x, y, -20), (x, y, 20)] for x, y in CORNERS]
    + [[(-15, 15, -20), (15, 15, 20)], [(15, -15, -20), (15, 15, 20)], [(-15, -15, -20), (15, -15, 20)]]
    + [[(-15, -15, -20), (-15, 15, 20)], [(-15, 15, -20), (15, -15, 20)]],
    dtype=float,
)


class Scene:
    """A rod triple at a pose, and its spots."""

    def __init__(self, rods: np.ndarray, R: np.ndarray, t: np.ndarray, xy: np.ndarray) -> None:
        self.rods, self.R, self.t, self.xy = rods, R, t, xy


def scene(rng: np.random.Generator, *, cube: bool) -> Scene:
    """One the pose of which three spots can fix: not all rods parallel, spots no worse than nearly on one line."""
    while True:
        rods = CUBE[rng.choice(len(CUBE), 3, replace=False)] if cube else rng.uniform(-SIZE_MM, SIZE_MM, (3, 2, 3))
        d = rods[:, 1] - rods[:, 0]
        d = d / np.linalg.norm(d, axis=1, keepdims=True)
        if np.linalg.svd(d, compute_uv=False)[1] < 1e-3:
            continue
        R = (
            Rotation.from_rotvec(rng.normal(size=3) * 0.3).as_matrix()
            if cube
            else Rotation.random(random_state=rng).as_matrix()
        )
        R = Rotation.from_rotvec([0, 0, rng.uniform(-np.pi, np.pi)]).as_matrix() @ R
        t = np.append(rng.uniform(-100, 100, 2), rng.uniform(-18, 18))
        hits = [cross_rod(a, b, R, t) for a, b in rods]
        if any(hit is None for hit in hits):
            continue
        xy = np.array([hit[0] for hit in hits if hit is not None])
        a, b = xy[1] - xy[0], xy[2] - xy[0]
        if abs(a[0] * b[1] - a[1] * b[0]) > 1e-3 * max(a @ a, b @ b):
            return Scene(rods, R, t, xy)


def distances(T: np.ndarray, world: Scene) -> np.ndarray:
    """Of poses (r, 4, 4) from the true one: largest difference in R, plus that of t in frame sizes."""
    rotation = np.abs(T[:, :3, :3] - world.R).max(axis=(1, 2), initial=0)
    return rotation + np.abs(T[:, :3, 3] - world.t).max(axis=1, initial=0) / SIZE_MM


def ours(solver: Callable[..., tuple[np.ndarray, np.ndarray]], scenes: list[Scene]) -> tuple[np.ndarray, float, float]:
    """Error of the nearest solution of each scene, solutions a scene, and microseconds a scene."""
    rods = np.stack([world.rods for world in scenes])
    d = rods[:, :, 1] - rods[:, :, 0]
    length = np.linalg.norm(d, axis=2)
    triples = RodTriples(starts=rods[:, :, 0], directions=d / length[..., None], lengths=length)
    started = time.perf_counter()
    T, which = solver(triples, np.stack([world.xy for world in scenes]))
    seconds = time.perf_counter() - started
    error = np.array([distances(T[which == i], world).min(initial=np.inf) for i, world in enumerate(scenes)])
    return error, len(T) / len(scenes), 1e6 * seconds / len(scenes)


def poselib_share(scenes: list[Scene]) -> tuple[np.ndarray, float, float]:
    """The same for PoseLib: rods as rays from their starts, spots as points of a plane."""
    import poselib

    errors, n, seconds = [], 0, 0.0
    for world in scenes:
        starts, d = world.rods[:, 0], world.rods[:, 1] - world.rods[:, 0]
        started = time.perf_counter()
        found = poselib.gp3p(
            list(starts),
            list(d / np.linalg.norm(d, axis=1, keepdims=True)),
            list(np.column_stack([world.xy, np.zeros(3)])),
        )
        seconds += time.perf_counter() - started
        n += len(found)
        T = np.zeros((len(found), 4, 4))
        for i, camera in enumerate(found):  # λ x = R_c X + t_c − p: slice → model, so the pose is its inverse
            T[i, :3, :3] = np.asarray(camera.R).T
            T[i, :3, 3] = -np.asarray(camera.R).T @ np.asarray(camera.t)
        errors.append(distances(T, world).min(initial=np.inf))
    return np.array(errors), n / len(scenes), 1e6 * seconds / len(scenes)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    print(f"seed {arguments.seed}; share with the true pose found to 1e-6, 1e-4 and 1e-2; solutions and time a triple")
    for name, cube in (("random triples", False), ("cube with parallel rods", True)):
        scenes = [scene(rng, cube=cube) for _ in range(arguments.trials // 2)]
        for solver, result in (
            ("solve_three", ours(solve_three, scenes)),
            ("scan_three", ours(lambda *a: scan_three(*a, slack_mm=0.1, noise_mm=0.01), scenes)),
            ("poselib gp3p", poselib_share(scenes)),
        ):
            error, n, microseconds = result
            shares = "  ".join(f"{(error < limit).mean():8.2%}" for limit in (1e-6, 1e-4, 1e-2))
            print(f"{name:24} {solver:13} {shares}   {n:5.2f} solutions  {microseconds:6.0f} us")


if __name__ == "__main__":
    main()
