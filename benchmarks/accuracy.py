"""Experiments behind the claims: errors at the bound, true covariances, and no wrong pose marked ``ok``.

    python -m benchmarks.accuracy                       all tables, at a tenth of the full size (some minutes)
    python -m benchmarks.accuracy --share 1             full size (hours on two cores)
    python -m benchmarks.accuracy --only matching       one table

Scenes, bounds and the odds that say what is decidable come from ``tests/oracle.py`` and this file, not from the package.
Every table prints its seed. poselib (extra ``bench``) is compared with where it is installed.
"""

from __future__ import annotations

import argparse
import math
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.special import gammaln
from scipy.stats import beta

from ctreg_cli.errors import SingularGeometryError
from ctreg_cli.imaging.slice import SliceInfo
from ctreg_cli.imaging.spot_slice import SpotSlice
from ctreg_cli.imaging.spots import Spots
from ctreg_cli.io.rod_file import load_rod_model
from ctreg_cli.registration.calibrate import calibrate
from ctreg_cli.registration.doubt import doubt
from ctreg_cli.registration.labelled import register_labelled
from ctreg_cli.registration.matching import search
from ctreg_cli.registration.options import RegistrationOptions
from ctreg_cli.registration.register import make_scene, register
from ctreg_cli.registration.twins import with_twins
from ctreg_cli.rods import Mount, Rod, RodModel, Target
from ctreg_cli.scale import Scale
from tests.oracle import (
    OracleFrame,
    OracleScene,
    bound,
    cross_lines,
    cross_rod,
    numeric_jacobian,
    random_frame,
    scene,
    twist_error,
)
from tests.registration.frames import on_its_mount

#: odds beyond which a scene is decidable, and sds of the bound beyond which an ``ok`` is wrong
DECIDABLE, WRONG_SD = math.log(100), 6.0
#: scenes of a row that SciPy's least squares is tried on: it takes long
MOST_NAIVE = 400
#: oracle's probability that a rod that is cut leaves a spot
P_SEEN = 0.8


def model_of(frame: OracleFrame, *, tolerance_mm: float = 0.0, targets: tuple[Target, ...] = ()) -> RodModel:
    """The oracle's frame as a rod model."""
    rods = tuple(
        Rod(id=f"r{i}", start=a, end=b, tolerance_mm=tolerance_mm)
        for i, (a, b) in enumerate(zip(frame.starts, frame.ends, strict=True))
    )
    return RodModel(name="oracle", rods=rods, targets=targets)


def scale_of(world: OracleScene) -> Scale:
    """Its scale."""
    return Scale(s_x=float(world.mm_per_px[0]), s_y=float(world.mm_per_px[1]))


def worlds(
    rng: np.random.Generator, frames: Callable[[], OracleFrame], count: int, **options: object
) -> Iterator[tuple[OracleFrame, OracleScene]]:
    """``count`` scenes, five to a frame."""
    made = 0
    while made < count:
        frame = frames()
        for _ in range(5):
            world = scene(rng, frame, **options)  # type: ignore[arg-type]
            if world is not None and made < count:
                made += 1
                yield frame, world


def errors(T: np.ndarray, frame: OracleFrame, world: OracleScene) -> tuple[float, float, np.ndarray]:
    """Rotation (rad) and position error at the frame's centre (mm), and the twist error."""
    centre = (frame.starts + frame.ends).mean(axis=0) / 2
    twist = twist_error(T[:3, :3], T[:3, 3], world.R, world.t)
    place = np.linalg.norm((T[:3, :3] - world.R) @ centre + T[:3, 3] - world.t)
    return float(np.linalg.norm(twist[3:])), float(place), twist


def at_arm(arm: np.ndarray) -> np.ndarray:
    """(3, 6) that takes a twist error to the error of a point at ``arm`` (3,) from the model origin: ``V + Ω × arm``."""
    return np.hstack([np.eye(3), np.cross(arm, np.eye(3))])


def bound_sds(frame: OracleFrame, world: OracleScene) -> tuple[float, float]:
    """Square roots of the bound on the mean square rotation and position error (rad, mm)."""
    G = at_arm(world.R @ (frame.starts + frame.ends).mean(axis=0) / 2)
    return math.sqrt(np.trace(world.bound[3:, 3:])), math.sqrt(np.trace(G @ world.bound @ G.T))


def is_wrong(T: np.ndarray, frame: OracleFrame, world: OracleScene) -> bool:
    """Whether a pose lies more than six sd of the bound from the truth, in rotation or at the frame's centre."""
    turn, place, _ = errors(T, frame, world)
    sd_turn, sd_place = bound_sds(frame, world)
    return turn > WRONG_SD * sd_turn or place > WRONG_SD * sd_place


# --- the oracle's own odds --------------------------------------------------------------------------------------------


def oracle_log_odds(
    frame: OracleFrame, world: OracleScene, R: np.ndarray, t: np.ndarray, rods: list[int], spots: list[int]
) -> float:
    """ln odds of a labelled match at a pose against clutter, with numeric derivatives and no prior on the tilt."""
    sd = world.sd_px
    predicted = cross_lines(frame.starts[rods], frame.ends[rods], R, t) / world.mm_per_px
    chi2 = float((((world.uv_px[spots] - predicted) / sd) ** 2).sum())
    J = numeric_jacobian(frame, rods, R, t, world.mm_per_px) / sd
    _, logdet = np.linalg.slogdet(J.T @ J)
    missed = 0
    for i in range(len(frame)):
        a, b = R @ frame.starts[i] + t, R @ frame.ends[i] + t
        if i not in rods and (a[2] > 0) != (b[2] > 0) and 0.03 < a[2] / (a[2] - b[2]) < 0.97:
            missed += 1
    centre = predicted.mean(axis=0)
    reach = 1.25 * np.linalg.norm(predicted - centre, axis=1).max()
    area = math.pi * reach**2
    m = max(int((np.linalg.norm(world.uv_px - centre, axis=1) <= reach).sum()), len(rods))
    n = len(rods)
    field = max(area, float(np.prod(np.ptp(world.uv_px, axis=0)))) * float(np.prod(world.mm_per_px))
    size = np.linalg.norm(frame.starts - frame.ends, axis=1).mean()
    prior = -math.log(field * size * 8 * math.pi**2)
    return (
        prior
        + 3 * math.log(2 * math.pi)
        - 0.5 * logdet
        + n * (math.log(P_SEEN) - math.log(2 * math.pi * sd**2) + math.log(area))
        - 0.5 * chi2
        + float(gammaln(m - n + 0.5) - gammaln(m + 0.5))
        + missed * math.log(1 - P_SEEN)
    )


def fitted(
    frame: OracleFrame, world: OracleScene, R: np.ndarray, t: np.ndarray, rods: list[int], spots: list[int]
) -> tuple[np.ndarray, np.ndarray]:
    """The oracle's own least squares from a start: the naive pipeline of SciPy."""

    starts, ends, seen = frame.starts[rods], frame.ends[rods], world.uv_px[spots]

    def residual(x: np.ndarray) -> np.ndarray:
        R1 = Rotation.from_rotvec(x[3:]).as_matrix() @ R
        return np.asarray((seen - cross_lines(starts, ends, R1, t + x[:3]) / world.mm_per_px).ravel())

    x = least_squares(residual, np.zeros(6), x_scale=[1, 1, 1, 0.03, 0.03, 0.03]).x
    return Rotation.from_rotvec(x[3:]).as_matrix() @ R, t + x[:3]


def _settled(
    frame: OracleFrame, world: OracleScene, R: np.ndarray, t: np.ndarray, rods: list[int], spots: list[int]
) -> bool:
    """Whether the spots, with their labels known, exclude at 100 : 1 every pose that would be called wrong.

    Where the least squares is not linear it can have a valley that leads from the truth to poses many sd of the bound
    away at next to no cost: no estimator can choose among them.
    """
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    if is_wrong(T, frame, world):
        return False
    G = at_arm(world.R @ (frame.starts + frame.ends).mean(axis=0) / 2)
    unit = np.array([1, 1, 1, 0.03, 0.03, 0.03])
    axes = np.linalg.eigh(world.bound / np.outer(unit, unit))[1] * unit[:, None]
    sd_turn, sd_place = bound_sds(frame, world)
    weak = axes[:, -1]
    step = WRONG_SD * min(sd_turn / np.linalg.norm(weak[3:]), sd_place / np.linalg.norm(G @ weak))

    starts, ends, seen = frame.starts[rods], frame.ends[rods], world.uv_px[spots]

    def residual(twist: np.ndarray, R0: np.ndarray, t0: np.ndarray) -> np.ndarray:
        R1 = Rotation.from_rotvec(twist[3:]).as_matrix() @ R0
        predicted = cross_lines(starts, ends, R1, t0 + twist[:3]) / world.mm_per_px
        return np.asarray((seen - predicted).ravel() / world.sd_px)

    least = (residual(np.zeros(6), R, t) ** 2).sum()
    for sign in (1, -1):
        there = least_squares(
            lambda y, sign=sign: residual(sign * step * weak + axes[:, :-1] @ y, world.R, world.t), np.zeros(5)
        )
        if 2 * there.cost < least + 2 * DECIDABLE:
            return False
    return True


def is_decidable(frame: OracleFrame, world: OracleScene, model: RodModel) -> bool:
    """Whether the oracle's odds of the truth over chance, and over any other pose, exceed 100 : 1.

    Other poses are those the search can think of, and those along the valley of the truth's own least squares.
    """
    rods = [int(r) for r in world.rod_of_spot if r >= 0]
    spots = [s for s, r in enumerate(world.rod_of_spot) if r >= 0]
    R, t = fitted(frame, world, world.R, world.t, rods, spots)
    truth = oracle_log_odds(frame, world, R, t, rods, spots)
    if truth < DECIDABLE or not _settled(frame, world, R, t, rods, spots):
        return False
    own = bound(frame, rods, R, t, world.mm_per_px, world.sd_px)
    place = make_scene(
        Spots.from_points(world.uv_px, world.sd_px), model, scale_of(world), options=RegistrationOptions()
    )
    pool = search(model, place, least_matches=4)
    if pool is None:
        return True
    pool = with_twins(model, place, doubt(model, place, pool, least_matches=4), 4)
    for T, spot_of_rod in zip(pool.T, pool.spot_of_rod, strict=True):
        twist = twist_error(T[:3, :3], T[:3, 3], R, t)
        if math.sqrt(twist @ np.linalg.pinv(own, hermitian=True) @ twist) > 6:
            seen = [int(r) for r in np.nonzero(spot_of_rod >= 0)[0]]
            rival = oracle_log_odds(frame, world, T[:3, :3], T[:3, 3], seen, [int(spot_of_rod[r]) for r in seen])
            if rival > truth - DECIDABLE:
                return False
    return True


# --- tables -----------------------------------------------------------------------------------------------------------


def run_labelled(row: tuple[int, float, int, int]) -> str:
    """One row of the table of labelled spots."""
    n, noise, count, seed = row
    rng = np.random.default_rng([seed, n, int(100 * noise)])
    ratio, own, naive, several, curved = [], [], [], 0, 0
    for frame, world in worlds(
        rng,
        lambda: random_frame(rng, n, 90, 120),
        count,
        sd_px=noise,
        mm_per_px=(0.45, 0.6),
        least=n,
        tilt_rad=0.2,
    ):
        spots = Spots.from_points(world.uv_px, noise)
        try:
            found = register_labelled(spots, world.rod_of_spot, model_of(frame), scale=scale_of(world))
        except SingularGeometryError:  # four rods that happen to lie in a plane, and said so
            continue
        near = [c for c in found if c.chi2 < found[0].chi2 + 2 * DECIDABLE]
        several += len(near) > 1
        best = near[0]
        curved += not best.linear
        twist = errors(best.T_slice_model, frame, world)[2]
        if len(near) > 1 or not best.linear:
            continue
        information = np.linalg.pinv(world.bound, hermitian=True)
        ratio.append(twist @ information @ twist / 6)
        own.append(twist @ np.linalg.pinv(best.covariance, hermitian=True) @ twist / 6)
        if len(naive) < MOST_NAIVE:
            rods = [int(r) for r in world.rod_of_spot]
            e = twist_error(*fitted(frame, world, world.R, world.t, rods, list(range(len(rods)))), world.R, world.t)
            naive.append(e @ information @ e / 6)
    trimmed = np.sort(ratio)[: max(1, int(0.999 * len(ratio)))]
    return (
        f"  {n:2d}   {noise:8.2f}   {count:6d}   {math.sqrt(np.mean(trimmed)):17.3f}   {np.mean(np.sort(own)[: len(trimmed)]):17.3f}"
        f"   {several:9d}   {curved:10d}   {math.sqrt(np.mean(ratio[: len(naive)]) / np.mean(naive)):12.4f}"
    )


def table_labelled(share: float, seed: int) -> None:
    """Labelled spots: rms error over the bound, the square of error over own sd, and over the oracle's least squares."""
    print("labelled spots, anisotropic scale 0.45 × 0.6 mm/px")
    print(
        "where the estimate calls its cost an ellipsoid (Candidate.linear) and its minimum the only one; the rest is counted;"
        " last: rms error over that of SciPy's least_squares started at the truth"
    )
    print("  n   noise px   scenes   rms error / bound   (error / own sd)²   not alone   not linear   / least_squares")
    rows = [(n, noise, int(2000 * share) or 5, seed) for n in range(4, 13) for noise in (0.05, 0.3, 1.0)]
    with ProcessPoolExecutor() as pool:
        for line in pool.map(run_labelled, rows):
            print(line, flush=True)


DESIGNS = ("leksell-g-2-panel", "z-frame-z001", "z-frame-elongated", "plus-fcal-2.0")


def run_design(arguments: tuple[str, int, int]) -> str:
    """One row of the table of known frames: drawn exactly, every rod that is cut seen, at 0.1 px and 0.5 mm/px."""
    name, count, seed = arguments
    shipped = load_rod_model(name)
    rods = tuple(replace(rod, tolerance_mm=0.0) for rod in shipped.rods)
    # wires along y where there is no mount: they cross the slice
    nominal = (
        np.array(shipped.mount.patient_from_model) if shipped.mount else np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0.0]])
    )
    model = RodModel(name=name, rods=rods, mount=Mount(patient_from_model=nominal, max_angle_deg=45))
    frame = OracleFrame(np.array(model.starts), np.array(model.ends))
    rng = np.random.default_rng([seed, *name.encode()])
    noise, s = 0.1, np.array([0.5, 0.5])
    ratio, own = [], []
    tally: dict[bool, Counter[str]] = {True: Counter(), False: Counter()}
    while sum(tally[True].values()) < count:
        R = Rotation.from_rotvec(rng.normal(size=3) * [0.1, 0.1, 0.2]).as_matrix() @ nominal
        share = rng.uniform(0.25, 0.75, (len(frame), 1))
        inside = ((1 - share) * frame.starts + share * frame.ends)[rng.integers(len(frame))]
        t = np.append(s * 250, 0.0) - R @ inside
        hits = [cross_rod(a, b, R, t) for a, b in zip(frame.starts, frame.ends, strict=True)]
        seen = [i for i, hit in enumerate(hits) if hit is not None and 0.03 < hit[1] < 0.97]
        if len(seen) < len(frame):
            continue
        true = np.array([hit[0] / s for hit in hits if hit is not None])
        uv = true + rng.normal(size=true.shape) * noise
        C = bound(frame, seen, R, t, s, noise)
        world = OracleScene(R, t, uv, noise, np.array(seen), s, C, seen)
        spots = Spots.from_points(uv, noise)
        found = register_labelled(spots, world.rod_of_spot, model, scale=scale_of(world))
        # of several exact answers the one that was meant: the mount tells them apart
        best = min(found, key=lambda c: errors(c.T_slice_model, frame, world)[0])
        twist = errors(best.T_slice_model, frame, world)[2]
        if best.linear:
            ratio.append(twist @ np.linalg.pinv(C, hermitian=True) @ twist / 6)
            own.append(twist @ np.linalg.pinv(best.covariance, hermitian=True) @ twist / 6)
        for mounted, verdicts in tally.items():
            result = register(spots, model, scale=scale_of(world), options=RegistrationOptions(use_mount=mounted))
            verdicts[result.status] += 1
            verdicts["wrong"] += result.status == "ok" and is_wrong(result.candidates[0].T_slice_model, frame, world)
    mounted, free = ({k: v for k, v in sorted(tally[m].items()) if v} for m in (True, False))
    return (
        f"  {name:18s} {count:6d}   {math.sqrt(np.mean(ratio)):17.3f}   {np.mean(own):17.3f}   {count - len(ratio):10d}"
        f"   mount {mounted}, none {free}"
    )


def table_designs(share: float, seed: int) -> None:
    """Frames with a twin, or with parallel wires: at the bound with labels, and what is said without."""
    print(
        "known frames drawn exactly, all rods seen, 0.1 px: with labels, and then without, with the mount and without"
    )
    print("  frame              scenes   rms error / bound   (error / own sd)²   not linear")
    with ProcessPoolExecutor() as pool:
        for line in pool.map(run_design, [(name, int(2000 * share) or 5, seed) for name in DESIGNS]):
            print(line, flush=True)


@dataclass
class Cell:
    """One cell of the unlabelled experiment."""

    rods: int
    missing: int
    false: int
    noise: float
    count: int
    seed: int


def run_cell(cell: Cell) -> tuple[Cell, Counter[str], float]:
    """Scenes of a cell: verdicts, wrong ``ok``, decidable scenes, and the median time."""
    rng = np.random.default_rng([cell.seed, cell.rods, cell.missing, cell.false, int(1000 * cell.noise)])
    tally: Counter[str] = Counter()
    times = []
    for frame, world in worlds(
        rng, lambda: random_frame(rng, cell.rods), cell.count, sd_px=cell.noise, missing=cell.missing, false=cell.false
    ):
        model = model_of(frame)
        begin = time.perf_counter()
        result = register(Spots.from_points(world.uv_px, cell.noise), model, scale=scale_of(world))
        times.append(time.perf_counter() - begin)
        tally[result.status] += 1
        right = False
        if result.status == "ok":
            right = not is_wrong(result.candidates[0].T_slice_model, frame, world)
            tally["wrong"] += not right
        if is_decidable(frame, world, model):
            tally["decidable"] += 1
            tally["solved"] += right
    return cell, tally, float(np.median(times))


def table_matching(share: float, seed: int) -> None:
    """Unlabelled spots with rods missing and spots false: verdicts by cell."""
    print("unlabelled: 5–9 rods × 0–4 missing × 0–10 false, at least 5 true spots")
    print("  rods missing false noise   scenes     ok  wrong  ambiguous  no_pose   decidable  solved    ms")
    cells = [
        Cell(rods, missing, false, noise, max(4, int(110 * share)), seed)
        for rods in range(5, 10)
        for missing in range(5)
        if rods - missing >= 5
        for false in (0, 2, 4, 7, 10)
        for noise in (0.1, 0.3)
    ]
    total: Counter[str] = Counter()
    with ProcessPoolExecutor() as pool:
        for cell, tally, median in pool.map(run_cell, cells):
            total += tally
            total["scenes"] += cell.count
            print(
                f"  {cell.rods:4d} {cell.missing:7d} {cell.false:5d} {cell.noise:5.2f}   {cell.count:6d} {tally['ok']:6d} {tally['wrong']:6d}"
                f" {tally['ambiguous']:10d} {tally['no_pose']:8d}   {tally['decidable']:9d} {tally['solved']:7d} {1e3 * median:5.0f}",
                flush=True,
            )
    share_solved = 100 * total["solved"] / max(total["decidable"], 1)
    print(f"  all: {dict(total)}; solved {share_solved:.2f} % of the decidable")


def run_clutter(arguments: tuple[int, int]) -> Counter[str]:
    """Scenes of nothing but clutter."""
    seed, count = arguments
    rng = np.random.default_rng(seed)
    tally: Counter[str] = Counter()
    for _ in range(count):
        model = model_of(random_frame(rng, int(rng.integers(5, 10))))
        uv = 250 + rng.uniform(-40, 40, (int(rng.integers(3, 41)), 2))
        sd = float(rng.choice([0.05, 0.1, 0.3, 0.5]))
        tally[register(Spots.from_points(uv, sd), model, scale=Scale(s_x=0.5, s_y=0.5)).status] += 1
    return tally


def table_clutter(share: float, seed: int) -> None:
    """Pure clutter: how often it is taken for a frame."""
    count = max(40, int(5000 * share))
    with ProcessPoolExecutor() as pool:
        total = sum(pool.map(run_clutter, [(seed + 1000 + k, count // 20) for k in range(20)]), Counter())
    n = sum(total.values())
    upper = beta.ppf(0.95, total["ok"] + 1, n - total["ok"])
    print(
        f"pure clutter, 3–40 spots, seeds {seed + 1000}…: {dict(total)}; false alarms under {upper:.1e} a slice (95 %)"
    )


def table_grid(share: float, seed: int) -> None:
    """Nine rods among ninety false dots on a regular grid."""
    rng = np.random.default_rng([seed, 90])
    tally: Counter[str] = Counter()
    times = []
    for frame, world in worlds(rng, lambda: random_frame(rng, 9), max(5, int(100 * share)), sd_px=0.1, least=9):
        step = 12.0
        grid = np.stack(np.meshgrid(np.arange(10) * step, np.arange(9) * step), axis=-1).reshape(-1, 2)
        grid = grid - grid.mean(axis=0) + world.uv_px.mean(axis=0) + rng.uniform(-5, 5, 2)
        uv = np.concatenate([world.uv_px, grid + rng.normal(size=grid.shape) * 0.1])
        begin = time.perf_counter()
        result = register(Spots.from_points(uv, 0.1), model_of(frame), scale=scale_of(world))
        times.append(time.perf_counter() - begin)
        tally[result.status] += 1
        if result.status == "ok":
            tally["wrong"] += is_wrong(result.candidates[0].T_slice_model, frame, world)
    print(
        f"9 rods among 90 dots on a grid, seed {seed}: {dict(tally)}; median {np.median(times):.2f} s, worst {max(times):.2f} s"
    )


def table_speed(share: float, seed: int) -> None:
    """Nine rods and eight false spots, without a prior."""
    rng = np.random.default_rng([seed, 17])
    times = []
    for frame, world in worlds(
        rng, lambda: random_frame(rng, 9), max(20, int(300 * share)), sd_px=0.1, false=8, least=9
    ):
        model = model_of(frame)
        register(Spots.from_points(world.uv_px, 0.1), model, scale=scale_of(world))  # the frame's plan, once a frame
        begin = time.perf_counter()
        register(Spots.from_points(world.uv_px, 0.1), model, scale=scale_of(world))
        times.append(time.perf_counter() - begin)
    print(
        f"9 rods + 8 false, seed {seed}: median {1e3 * np.median(times):.0f} ms, 90 % {1e3 * np.quantile(times, 0.9):.0f} ms a slice"
    )


def run_displaced(arguments: tuple[int, int]) -> tuple[Counter[str], list[float], list[float]]:
    """Slices in which one spot is off by half a pixel to five."""
    seed, count = arguments
    rng = np.random.default_rng(seed)
    tally: Counter[str] = Counter()
    levels, ratios = [], []
    target = Target(id="tip", point=np.array([0.0, 0.0, 60.0]))
    for frame, world in worlds(rng, lambda: random_frame(rng, int(rng.integers(6, 10))), count, sd_px=0.1, least=6):
        uv = np.array(world.uv_px)
        angle = rng.uniform(0, 2 * math.pi)
        uv[rng.integers(len(uv))] += rng.uniform(0.5, 5) * np.array([math.cos(angle), math.sin(angle)])
        result = register(Spots.from_points(uv, 0.1), model_of(frame, targets=(target,)), scale=scale_of(world))
        tally[result.status] += 1
        if result.status == "ok":
            best = result.candidates[0]
            T = best.T_slice_model
            error = np.linalg.norm((T[:3, :3] - world.R) @ target.point + T[:3, 3] - world.t)
            levels.append(float(best.protection_mm[0]))
            ratios.append(error / levels[-1])
            tally["exceeded"] += ratios[-1] > 1
    return tally, levels, ratios


def table_integrity(share: float, seed: int) -> None:
    """One spot displaced: errors above the protection level."""
    count = max(40, int(20_000 * share))
    with ProcessPoolExecutor() as pool:
        parts = list(pool.map(run_displaced, [(seed + 2000 + k, count // 20) for k in range(20)]))
    total = sum((p[0] for p in parts), Counter())
    levels = np.concatenate([p[1] for p in parts])
    ratios = np.concatenate([p[2] for p in parts])
    n = total["ok"]
    upper = beta.ppf(0.95, total["exceeded"] + 1, max(n - total["exceeded"], 1))
    print(
        f"one spot off by 0.5–5 px, 6–9 rods, seeds {seed + 2000}…: {dict(total)}; median level {np.median(levels):.2f} mm,"
        f" greatest error / level {ratios.max():.2f}; risk under {upper:.1e} (95 %), stated 1e-5"
    )


def table_calibration(share: float, seed: int) -> None:
    """Scales from unlabelled spots of 1, 4 and 12 slices of the cube, PixelSpacing off by 0.5 %."""
    model = load_rod_model("rod-cube-30x30x40")
    frame = OracleFrame(np.array(model.starts), np.array(model.ends))
    for slices in (1, 4, 12):
        rng = np.random.default_rng([seed, slices])
        square, own, failed = [], [], 0
        for _ in range(max(6, int(200 * share))):
            made = [w for _, w in worlds(rng, lambda: frame, slices, sd_px=0.2, mm_per_px=(0.49, 0.52), least=8)]
            said = Scale(s_x=0.49 * 1.005, s_y=0.52 * 1.005)
            inputs = [
                SpotSlice(info=SliceInfo(source="oracle", scale=said), spots=Spots.from_points(w.uv_px, 0.2))
                for w in made
            ]
            try:
                run = calibrate(inputs, model).calibration
            except Exception as problem:  # noqa: BLE001  (a table, not a program: count and go on)
                failed += 1
                print("   ", problem)
                continue
            sds = _scale_bound(frame, made)
            error = np.array([run.scale.s_x - 0.49, run.scale.s_y - 0.52])
            square.extend((error / sds) ** 2)
            own.extend((error / np.array([run.sd_s_x, run.sd_s_y])) ** 2)
        print(
            f"calibration, {slices:2d} slices unlabelled, seed {seed}: error / bound {math.sqrt(np.mean(square)):.3f},"
            f" (error / own sd)² {np.mean(own):.3f}, failed {failed}"
        )


def _scale_bound(frame: OracleFrame, made: list[OracleScene]) -> np.ndarray:
    """Cramér–Rao bound on s_x and s_y (2,) sds, poses free: Schur complement of numeric derivatives."""
    shared = np.zeros((2, 2))
    for world in made:
        rods = [int(r) for r in world.rod_of_spot]
        J = numeric_jacobian(frame, rods, world.R, world.t, world.mm_per_px) / world.sd_px
        spots = cross_lines(frame.starts[rods], frame.ends[rods], world.R, world.t)
        K = np.zeros((2 * len(rods), 2))
        K[0::2, 0] = -spots[:, 0] / world.mm_per_px[0] ** 2 / world.sd_px
        K[1::2, 1] = -spots[:, 1] / world.mm_per_px[1] ** 2 / world.sd_px
        shared += K.T @ K - K.T @ J @ np.linalg.solve(J.T @ J, J.T @ K)
    return np.sqrt(np.diag(np.linalg.inv(shared)))


def table_wrong_model(share: float, seed: int) -> None:
    """Models wrong by two percent: never ``ok`` with an sd that does not own up to the error."""
    model = load_rod_model("rod-cube-30x30x40")
    frame = OracleFrame(np.array(model.starts), np.array(model.ends))
    for what in ("height", "scale", "one rod"):
        rng = np.random.default_rng([seed, len(what)])
        tally: Counter[str] = Counter()
        for _, world in worlds(rng, lambda: frame, max(20, int(500 * share)), sd_px=0.1, least=8):
            starts, ends, scale = np.array(model.starts), np.array(model.ends), scale_of(world)
            if what == "height":
                starts[:, 2] *= 1.02
                ends[:, 2] *= 1.02
            elif what == "scale":
                scale = Scale(s_x=scale.s_x * 1.02, s_y=scale.s_y * 1.02)
            else:
                starts[3, :2] *= 1.02
                ends[3, :2] *= 1.02
            result = register(Spots.from_points(world.uv_px, 0.1), model_of(OracleFrame(starts, ends)), scale=scale)
            tally[result.status if result.status != "no_pose" else result.reason] += 1
            if result.status == "ok":
                best = result.candidates[0]
                twist = errors(best.T_slice_model, frame, world)[2]
                if what == "scale":
                    twist[:2] -= 0.02 * world.t[:2]
                tally["not covered"] += bool(twist @ np.linalg.inv(best.covariance) @ twist > 36)
        print(f"model wrong by 2 % ({what}), seed {seed}: {dict(tally)}")
    for name in ("leksell-g-3-panel", "leksell-g-4-panel", "brw", "micromar-tm-03b"):
        mounted, tally = load_rod_model(name), Counter()
        for axis in (0, 1):
            rng = np.random.default_rng([seed, axis, len(name)])
            stretch = np.where(np.arange(2) == axis, 1.02, 1.0)
            for _ in range(max(20, int(200 * share))):
                R, xy_mm = on_its_mount(mounted, rng)
                uv = xy_mm / 0.5 + rng.normal(0.0, 0.1, xy_mm.shape)
                s_x, s_y = (0.5 * stretch).tolist()
                result = register(Spots.from_points(uv, 0.1), mounted, scale=Scale(s_x=s_x, s_y=s_y))
                tally[result.status if result.status != "no_pose" else result.reason] += 1
                if result.status == "ok":
                    best = result.candidates[0]
                    turn = Rotation.from_matrix(best.T_slice_model[:3, :3] @ R.T).as_rotvec()
                    tally["not covered"] += bool(turn @ np.linalg.inv(best.covariance[3:, 3:]) @ turn > 36)
        print(f"{name}, the scale of one axis wrong by 2 %, seed {seed}: {dict(tally)}")


def table_leksell(share: float, seed: int) -> None:
    """Every slice of the real Leksell scan alone, nominal and refined rods, against the rigid fit of all slices.

    The rods are refined on every other slice and tried on the rest. Only where the shared data are.
    """
    import json

    from ctreg_cli.imaging.segmentation import SegmentationOptions
    from ctreg_cli.io.images import open_images
    from ctreg_cli.pipeline import pose, segment
    from ctreg_cli.registration.bundle import refine_rods

    folder = Path(__file__).parents[2] / "shared/ct/leksell"
    if not folder.is_dir():
        print("leksell: no shared data here")
        return
    truth = np.array(json.loads((folder / "multislice_fit.json").read_text())["T_patient_model"])
    nominal = load_rod_model("leksell-g-3-panel")
    slices = list(segment(open_images([folder / "slices"]), SegmentationOptions()))
    refinement = refine_rods(slices[::2], nominal)
    print(
        f"leksell, rods refined on {refinement.n_slices} slices: residual {refinement.rms_before_px:.3f} px before,"
        f" {refinement.rms_after_px:.3f} px after"
    )
    for name, model, part in (
        ("nominal", nominal, slices),
        ("nominal, other slices", nominal, slices[1::2]),
        ("refined, other slices", refinement.model, slices[1::2]),
    ):
        turns, places, residuals, tally = [], [], [], Counter[str]()
        found = []
        for result in pose(part, model):
            tally[result.status] += 1
            if result.status == "ok" and result.info.T_patient_slice is not None and result.best is not None:
                T = result.info.T_patient_slice @ result.best.T_slice_model
                found.append(T)
                residuals.append(result.best.rms_px)
                turns.append(np.degrees(Rotation.from_matrix(T[:3, :3] @ truth[:3, :3].T).magnitude()))
                places.append(float(np.linalg.norm((T - truth)[:3, :3] @ [100, 100, 100] + (T - truth)[:3, 3])))
        R = Rotation.from_matrix([T[:3, :3] for T in found])
        scatter = np.degrees((R * R.mean().inv()).magnitude())
        print(
            f"leksell, {name}: {dict(tally)}; off the fit of all slices: rotation median {np.median(turns):.3f} max {max(turns):.3f} deg,"
            f" position median {np.median(places):.3f} max {max(places):.3f} mm; single-slice scatter {np.sqrt(np.mean(scatter**2)):.3f} deg rms;"
            f" residual {np.sqrt(np.mean(np.square(residuals))):.3f} px rms"
        )


TABLES: dict[str, Callable[[float, int], None]] = {
    "labelled": table_labelled,
    "calibration": table_calibration,
    "designs": table_designs,
    "matching": table_matching,
    "clutter": table_clutter,
    "grid": table_grid,
    "speed": table_speed,
    "integrity": table_integrity,
    "wrong_model": table_wrong_model,
    "leksell": table_leksell,
}


def main() -> None:
    """Print the tables asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=sorted(TABLES), action="append", help="one table; may be given several times")
    parser.add_argument("--share", type=float, default=0.1, help="share of the full number of scenes")
    parser.add_argument("--seed", type=int, default=2008)
    options = parser.parse_args()
    for name in options.only or TABLES:
        begin = time.perf_counter()
        TABLES[name](options.share, options.seed)
        print(f"  [{name}: {time.perf_counter() - begin:.0f} s, seed {options.seed}]\n", flush=True)


if __name__ == "__main__":
    main()
