"""An attack on ``ok``: real frames, turned far, with rods missing and displaced, among clutter that looks like them.

    python -m benchmarks.sceptic --seed 1 --scenes 500          verdicts by frame and clutter, and every wrong ``ok``
    python -m benchmarks.sceptic --seed 1 --only 137            one scene taken apart: candidates beside the truth

Harder than any scanner: half of the scenes have no mount, tilts have a sd of 17°, clutter is a line, a grid, or a moved
or mirrored copy of the frame's own spots. A pose is called wrong when it is turned or moved (at the frame's centre) by
more than six of its *own* sd.  Crossings come from ``tests/oracle.py``.
"""

from __future__ import annotations

import argparse
import math
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.accuracy import WRONG_SD, at_arm, model_of
from ctreg_cli.geometry.pose import make_pose
from ctreg_cli.imaging.spots import Spots
from ctreg_cli.io.rod_file import load_rod_model, shipped_frames
from ctreg_cli.registration.doubt import doubt
from ctreg_cli.registration.matching import search, weigh
from ctreg_cli.registration.options import RegistrationOptions
from ctreg_cli.registration.register import least_matches, make_scene, register
from ctreg_cli.registration.result import Registration
from ctreg_cli.registration.twins import with_twins
from ctreg_cli.rods import RodModel
from ctreg_cli.scale import Scale
from tests.oracle import cross_rod, random_frame, twist_error

CLUTTER = ("none", "random", "line", "grid", "copy", "mirror")
#: a slice is about so many pixels across the frame
ACROSS_PX = 300


@dataclass(frozen=True)
class Attack:
    """One scene."""

    model: RodModel
    kind: str
    mounted: bool
    noise_px: float
    uv_px: np.ndarray
    rod_of_spot: np.ndarray
    visible: int
    R: np.ndarray
    t: np.ndarray
    scale: Scale
    resolution_px: float

    @property
    def options(self) -> RegistrationOptions:
        """What ctreg may use."""
        return RegistrationOptions(use_mount=self.mounted)


def frame_names() -> list[str]:
    """The known frames, and a random one."""
    return [*sorted(shipped_frames()), "random"]


def attack(seed: int, index: int) -> Attack:
    """Scene ``index`` of a seed, whatever the others were."""
    rng = np.random.default_rng([seed, index])
    names = frame_names()
    while True:
        name = names[index % len(names)]
        model = model_of(random_frame(rng, int(rng.integers(5, 10)))) if name == "random" else load_rod_model(name)
        mounted = model.mount is not None and bool(rng.integers(2))
        if model.mount is not None:
            upright = np.asarray(model.mount.patient_from_model)
        else:
            axis = np.linalg.svd(model.directions)[2][0]
            upright = Rotation.align_vectors([[0, 0, 1]], [axis])[0].as_matrix()
        tilt = Rotation.from_rotvec(rng.normal(size=3) * [0.3, 0.3, 0.1 if mounted else 0.0]).as_matrix()
        if mounted and math.degrees(Rotation.from_matrix(tilt).magnitude()) > model.mount.max_angle_deg:
            continue
        spin = np.eye(3) if mounted else Rotation.from_rotvec([0, 0, rng.uniform(-np.pi, np.pi)]).as_matrix()
        R = spin @ tilt @ upright
        along = rng.uniform(0.15, 0.85)
        inside = (1 - along) * model.starts.mean(axis=0) + along * model.ends.mean(axis=0)
        extent = np.ptp(np.concatenate([model.starts, model.ends]), axis=0).max()
        mm = extent / ACROSS_PX * rng.uniform(0.7, 1.4)
        scale = Scale(s_x=mm, s_y=mm * (1 if rng.integers(2) else rng.uniform(0.97, 1.03)))
        t = np.append(scale.mm_per_px * rng.uniform(150, 350, 2), 0.0) - R @ inside
        shift = np.zeros((len(model), 3))
        if name != "random" and rng.integers(2):  # rods are displaced by what the frame file allows
            shift = rng.normal(size=(len(model), 3)) * model.tolerances[:, None]
            shift -= (shift * model.directions).sum(axis=1)[:, None] * model.directions
        rods, places = [], []
        for i in range(len(model)):
            hit = cross_rod(model.starts[i] + shift[i], model.ends[i] + shift[i], R, t)
            if hit is not None and 0.02 < hit[1] < 0.98:
                rods.append(i)
                places.append(hit[0] / scale.mm_per_px)
        missing = int(rng.integers(0, 4))
        if len(rods) - missing < 5:
            continue
        noise = float(rng.choice([0.05, 0.1, 0.3]))
        # where two rods cross the slice within a spot's width they leave one spot between them
        resolution = float(rng.uniform(2, 5))
        true, labels = merge(np.array(places), rods, resolution)
        kept = np.sort(rng.permutation(len(true))[: len(true) - missing])
        true, labels = true[kept], labels[kept]
        if len(true) < 5:
            continue
        kind = CLUTTER[(index // len(names)) % len(CLUTTER)]
        clutter = make_clutter(rng, kind, true)
        uv = np.concatenate([true + rng.normal(size=true.shape) * noise, clutter])
        labels = np.concatenate([labels, np.full(len(clutter), -1)])
        order = rng.permutation(len(uv))
        return Attack(
            model=model,
            kind=kind,
            mounted=mounted,
            noise_px=noise,
            uv_px=uv[order],
            rod_of_spot=labels[order],
            visible=len(rods),
            R=R,
            t=t,
            scale=scale,
            resolution_px=resolution,
        )


def merge(places: np.ndarray, rods: list[int], resolution_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Spots of rods that cross nearer than ``resolution_px`` made one, halfway (labelled as the first)."""
    groups: list[list[int]] = []
    for i, place in enumerate(places):
        for group in groups:
            if np.linalg.norm(places[group].mean(axis=0) - place) < resolution_px:
                group.append(i)
                break
        else:
            groups.append([i])
    return np.array([places[g].mean(axis=0) for g in groups]), np.array([rods[g[0]] for g in groups])


def make_clutter(rng: np.random.Generator, kind: str, true: np.ndarray) -> np.ndarray:
    """False spots (k, 2) of a kind."""
    centre = true.mean(axis=0)
    reach = 1.3 * float(np.abs(true - centre).max())
    if kind == "none":
        return np.empty((0, 2))
    if kind == "random":
        return centre + rng.uniform(-reach, reach, (int(rng.integers(1, 9)), 2))
    if kind == "line":
        angle, step = rng.uniform(0, np.pi), rng.uniform(0.1, 0.3) * reach
        along = np.arange(int(rng.integers(4, 10))) * step
        line = np.stack([along * np.cos(angle), along * np.sin(angle)], axis=-1)
        return centre + rng.uniform(-reach, reach, 2) + line - line.mean(axis=0)
    if kind == "grid":
        step = rng.uniform(0.15, 0.5) * reach
        grid = np.stack(np.meshgrid(np.arange(3.0), np.arange(3.0)), axis=-1).reshape(-1, 2) * step
        return centre + rng.uniform(-0.5, 0.5, 2) * reach + grid - grid.mean(axis=0)
    image = true - centre
    if kind == "mirror":
        image = image * [-1, 1]
    angle = rng.uniform(-np.pi, np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    some = rng.permutation(len(image))[: int(rng.integers(3, len(image) + 1))]
    return centre + image[some] @ turn.T + rng.uniform(-1, 1, 2) * reach + rng.normal(size=(len(some), 2))


def seen(scene: Attack) -> Spots:
    """Its spots, as wide as they are resolved."""
    spots = Spots.from_points(scene.uv_px, scene.noise_px)
    width = np.full(len(scene.uv_px), scene.resolution_px / 2)
    return replace(spots, major_px=width, minor_px=width)


def asked(scene: Attack) -> Registration:
    """What ctreg says of it."""
    return register(seen(scene), scene.model, scale=scene.scale, options=scene.options)


def own_sds(scene: Attack, T: np.ndarray, covariance: np.ndarray) -> tuple[float, float, float]:
    """How many of its own sd a pose is off (the worse of turn and place), the turn in degrees and the place in mm."""
    arm = scene.R @ scene.model.centre
    twist = twist_error(T[:3, :3], T[:3, 3], scene.R, scene.t)
    G = at_arm(arm)
    turn, place = float(np.linalg.norm(twist[3:])), float(np.linalg.norm(G @ twist))
    q = max(turn / math.sqrt(np.trace(covariance[3:, 3:])), place / math.sqrt(np.trace(G @ covariance @ G.T)))
    return q, math.degrees(turn), place


def run(arguments: tuple[int, int]) -> tuple[int, str, str, str, str]:
    """One scene: index, frame, clutter, verdict, and a line about it if it is wrong."""
    seed, index = arguments
    scene = attack(seed, index)
    result = asked(scene)
    if result.status != "ok":
        return index, scene.model.name, scene.kind, f"{result.status}:{result.reason}", ""
    best = result.candidates[0]
    q, turn, place = own_sds(scene, best.T_slice_model, best.covariance)
    if q <= WRONG_SD:
        return index, scene.model.name, scene.kind, "ok", ""
    right = int((scene.rod_of_spot[best.spot_index] == best.rod_index).sum())
    return (
        index,
        scene.model.name,
        scene.kind,
        "wrong",
        (
            f"  {index}: {scene.model.name} {scene.kind} noise {scene.noise_px} mounted {scene.mounted}: {q:.1f} own sd,"
            f" {turn:.2f} deg {place:.2f} mm; {right} of {len(best.rod_index)} matches right,"
            f" {int((scene.rod_of_spot >= 0).sum())} of {scene.visible} rods seen, {len(scene.uv_px)} spots,"
            f" ln odds {best.log_odds:.1f} {[code for code, _ in result.warnings]}"
        ),
    )


def take_apart(seed: int, index: int) -> None:
    """Print a scene's candidates beside the match of the truth."""
    print(run((seed, index)))
    scene = attack(seed, index)
    place = make_scene(seen(scene), scene.model, scene.scale, options=scene.options)
    least = least_matches(len(scene.uv_px), len(scene.model))
    matches = search(scene.model, place, least_matches=least)
    true = np.full((1, len(scene.model)), -1, dtype=np.intp)
    for spot, rod in enumerate(scene.rod_of_spot):
        if rod >= 0:
            true[0, rod] = spot
    print("truth", true[0], "noise", scene.noise_px, "scale", scene.scale)
    weighed = weigh(scene.model, place, make_pose(scene.R, scene.t)[None], true, 3)
    if weighed is not None:
        turned = own_sds(scene, weighed.T[0], np.eye(6))
        print(
            f"  its odds {weighed.log_odds[0]:.2f}, chi2 {weighed.fit.chi2[0]:.1f}, off {turned[1]:.2f} deg {turned[2]:.2f} mm"
        )
    if matches is None:
        print("  nothing found")
        return
    for name, stage in (
        ("search", matches),
        ("doubt", with_twins(scene.model, place, doubt(scene.model, place, matches, least_matches=least), least)),
    ):
        print(name)
        for row in range(min(len(stage), 12)):
            off = own_sds(scene, stage.T[row], np.eye(6))
            print(
                f"  {stage.log_odds[row]:7.2f} chi2 {stage.fit.chi2[row]:6.1f} {stage.spot_of_rod[row]}"
                f" expected {stage.expected[row].sum()} off {off[1]:.2f} deg {off[2]:.2f} mm"
            )


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--scenes", type=int, default=500)
    parser.add_argument("--only", type=int)
    parser.add_argument("--workers", type=int)
    arguments = parser.parse_args()
    if arguments.only is not None:
        take_apart(arguments.seed, arguments.only)
        return
    tally: Counter[str] = Counter()
    by_kind: Counter[tuple[str, str]] = Counter()
    by_frame: Counter[tuple[str, str]] = Counter()
    with ProcessPoolExecutor(arguments.workers) as pool:
        work = [(arguments.seed, index) for index in range(arguments.scenes)]
        for _, frame, kind, verdict, line in pool.map(run, work, chunksize=4):
            tally[verdict] += 1
            short = verdict.split(":")[0]
            by_kind[kind, short] += 1
            by_frame[frame, short] += 1
            if line:
                print(line, flush=True)
    print(f"seed {arguments.seed}: {dict(tally.most_common())}")
    for title, table in (("clutter", by_kind), ("frame", by_frame)):
        for name in sorted({key for key, _ in table}):
            print(
                f"  {title:8s} {name:24s} "
                + "  ".join(f"{v} {table[name, v]}" for v in ("ok", "wrong", "ambiguous", "no_pose"))
            )


if __name__ == "__main__":
    main()
