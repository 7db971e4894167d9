"""How the tracker does on simulated sequences of spots: wrong poses, share of ``ok``, error against the bound.

    python -m benchmarks.tracking [--sequences 200] [--slices 150] [--jacobian updated|constant|both]
    python -m benchmarks.tracking --smooth             breathing at ten slices a period, smoothed
    python -m benchmarks.tracking --basin              the control law: start displacement × strategy → success, iterations

Sequences come from ``tests/tracking/sequences.py``, which shares no code with the package; so does what is *decidable*:

* at least five rods left a spot, and without any one of these spots the pose would still be known (20 mm, 20 degrees);
* the cost of the true match, fitted by SciPy, rises three sd from its lowest point by half to twice of what an
  ellipsoid promises (else no covariance describes what is known);
* the oracle's odds of the true match exceed 100 : 1 over chance and over every variant (a spot dropped, added, given to
  another rod, two exchanged) whose pose lies more than 6 sd away. The oracle knows where the frame was in the slice
  before to 2 mm and 2 degrees where it did not jump since; where that slice was neither settled nor decidable, it goes
  by the last that was, and knows each slice in between 2 mm and 2 degrees worse.

The oracle is asked about every slice that the tracker did not settle, and about every tenth that it did. Both
strategies run on the same sequences, and share what the oracle said of a slice.
"""

from __future__ import annotations

import argparse
import math
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.accuracy import DECIDABLE, WRONG_SD, at_arm, fitted, oracle_log_odds
from ctreg_cli import pipeline
from ctreg_cli.io.rod_file import load_rod_model
from ctreg_cli.registration.options import TrackingOptions
from ctreg_cli.tracking.experiment import displaced_start
from ctreg_cli.tracking.servo import Desired, ServoOptions, servo, view
from tests.oracle import OracleScene, bound, cross_lines, numeric_jacobian, twist_error
from tests.tracking.sequences import Sequence, TrueSlice, error_of, is_wrong, sequence

#: five spots are the fewest that leave something to check them by
DECIDABLE_RODS = 5
#: how well the oracle knows where the frame was before, mm and rad
PAST_SD = np.repeat([2.0, math.radians(2.0)], 3)
#: worst sd without any one of the spots, at the frame's middle, mm and rad
KNOWN_MM, KNOWN_RAD = 20.0, math.radians(20.0)
#: rise of χ² at three sd, where an ellipsoid promises 9
LEAST_RISE, MOST_RISE = 4.5, 18.0
#: spots farther than this from a rod's crossing are not tried with it, px
NEAR_PX = 25.0
#: displacements of the start, mm and degrees
BASIN = ((5, 2), (20, 10), (40, 20), (80, 20), (20, 45), (20, 60), (20, 75), (20, 90), (20, 120), (20, 150))
#: sequences between two reports
REPORT_EVERY = 10
#: one in so many settled slices is put to the oracle
SAMPLED = 10
Strategy = Literal["updated", "constant"]


@dataclass
class Tally:
    """What is counted over sequences."""

    counts: Counter[str] = field(default_factory=Counter)
    #: squared errors, and bounds, by axis; normalised squared errors by the pose's own covariance
    squares: list[np.ndarray] = field(default_factory=list)
    bounds: list[np.ndarray] = field(default_factory=list)
    nees: list[float] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    seconds: float = 0.0

    def add(self, other: Tally) -> None:
        self.counts.update(other.counts)
        for name in ("squares", "bounds", "nees", "notes"):
            getattr(self, name).extend(getattr(other, name))
        self.seconds += other.seconds


# --- the oracle -------------------------------------------------------------------------------------------------------


class Oracle:
    """What of a sequence is decidable; every slice is asked about once."""

    def __init__(self, made: Sequence, sd_px: float) -> None:
        self.made, self.sd_px = made, sd_px
        self.known: dict[tuple[int, int | None], bool] = {}

    def decidable(self, i: int, settled: list[bool]) -> bool:
        """Whether slice ``i`` is; ``settled`` says of which slices the tracker was sure."""
        truth, first = self.made.truth, i
        while first > 0 and not truth[first].has_jumped and not settled[first - 1]:
            first -= 1
        before = None if first == 0 or truth[first].has_jumped else first - 1
        for between in range(first, i):  # forwards: each rests on the last one before it that is known
            if self._decidable_after(between, before):
                before = between
        return self._decidable_after(i, before)

    def _decidable_after(self, i: int, before: int | None) -> bool:
        if (i, before) not in self.known:
            self.known[i, before] = is_decidable(self.made, i, self.sd_px, before)
        return self.known[i, before]


def is_decidable(made: Sequence, i: int, sd_px: float, before: int | None) -> bool:
    """Whether the spots of slice ``i``, and where the frame was in slice ``before``, leave no doubt (see above)."""
    true = made.truth[i]
    if len(true.rods) < DECIDABLE_RODS:
        return False
    world = _world(made, i, sd_px)
    rods, spots = true.rods, true.spots
    R, t = fitted(made.frame, world, true.R, true.t, rods, spots)
    own = bound(made.frame, rods, R, t, world.mm_per_px, sd_px)
    if not all(is_known(made, world, R, t, [r for r in rods if r != left_out]) for left_out in rods):
        return False
    if not all(LEAST_RISE <= rise <= MOST_RISE for rise in rises(made, world, R, t, rods, spots, own)):
        return False
    past = None if before is None else Past(made.truth[before], (i - before) * PAST_SD)
    odds = _log_odds(made, world, R, t, rods, spots, past)
    if odds < DECIDABLE:
        return False
    information = np.linalg.pinv(own, hermitian=True)
    for other_rods, other_spots in variants(made, world, R, t, rods, spots):
        R1, t1 = fitted(made.frame, world, R, t, other_rods, other_spots)
        apart = twist_error(R1, t1, R, t)
        if apart @ information @ apart > WRONG_SD**2:
            rival = _log_odds(made, world, R1, t1, other_rods, other_spots, past)
            if rival > odds - DECIDABLE:
                return False
    return True


@dataclass
class Past:
    """Where the frame was, and how well that says where it is: sd at its middle, mm and rad."""

    true: TrueSlice
    sd: np.ndarray


def _world(made: Sequence, i: int, sd_px: float) -> OracleScene:
    true, spots = made.truth[i], made.slices[i].spots
    scale = made.slices[i].info.scale
    assert scale is not None
    assert true.bound is not None
    rod_of_spot = np.full(len(spots), -1)
    rod_of_spot[true.spots] = true.rods
    return OracleScene(
        R=true.R,
        t=true.t,
        uv_px=np.array(spots.uv_px),
        sd_px=sd_px,
        rod_of_spot=rod_of_spot,
        mm_per_px=np.array([scale.s_x, scale.s_y]),
        bound=true.bound,
    )


def _log_odds(
    made: Sequence,
    world: OracleScene,
    R: np.ndarray,
    t: np.ndarray,
    rods: list[int],
    spots: list[int],
    past: Past | None,
) -> float:
    """The oracle's odds; where the frame was before takes the place of "anywhere"."""
    odds = oracle_log_odds(made.frame, world, R, t, rods, spots)
    if past is None:
        return odds
    G = np.eye(6)
    G[:3] = at_arm(R @ (made.frame.starts.mean(axis=0) + made.frame.ends.mean(axis=0)) / 2)
    # the prior is averaged over all poses that the spots leave open, not taken at the best of them
    S = np.diag(past.sd**2) + G @ bound(made.frame, rods, R, t, world.mm_per_px, world.sd_px) @ G.T
    moved = _about_middle(made, R, t, past.true.R, past.true.t)
    density = -0.5 * float(moved @ np.linalg.solve(S, moved)) - 0.5 * np.linalg.slogdet(2 * math.pi * S)[1]
    predicted = cross_lines(made.frame.starts[rods], made.frame.ends[rods], R, t) / world.mm_per_px
    reach = 1.25 * np.linalg.norm(predicted - predicted.mean(axis=0), axis=1).max()
    area = max(math.pi * reach**2, float(np.prod(np.ptp(world.uv_px, axis=0)))) * float(np.prod(world.mm_per_px))
    size = np.linalg.norm(made.frame.starts - made.frame.ends, axis=1).mean()
    anywhere = -math.log(area * size * 8 * math.pi**2)
    return odds - anywhere + density


def _about_middle(made: Sequence, R: np.ndarray, t: np.ndarray, R0: np.ndarray, t0: np.ndarray) -> np.ndarray:
    middle = (made.frame.starts.mean(axis=0) + made.frame.ends.mean(axis=0)) / 2
    return twist_error(R, R @ middle + t, R0, R0 @ middle + t0)


def variants(
    made: Sequence, world: OracleScene, R: np.ndarray, t: np.ndarray, rods: list[int], spots: list[int]
) -> list[tuple[list[int], list[int]]]:
    """One match dropped, added or given another spot, or two exchanged, where the spots lie near enough."""
    crossing = cross_lines(made.frame.starts, made.frame.ends, R, t) / world.mm_per_px
    near = np.linalg.norm(crossing[:, None] - world.uv_px, axis=2) < NEAR_PX
    free = [j for j in range(len(world.uv_px)) if j not in spots]
    found: list[dict[int, int]] = []
    match = dict(zip(rods, spots, strict=True))
    found += [{r: s for r, s in match.items() if r != rod} for rod in rods]
    found += [match | {rod: j} for rod in range(len(crossing)) for j in free if near[rod, j]]
    for a in rods:
        for b in range(len(crossing)):
            if near[b, match[a]] and b not in match:  # another rod takes the spot
                found.append({r: s for r, s in match.items() if r != a} | {b: match[a]})
            elif b in match and a < b and near[b, match[a]] and near[a, match[b]]:
                found.append(match | {a: match[b], b: match[a]})
    return [(list(f), list(f.values())) for f in found if len(f) >= 3]


def is_known(made: Sequence, world: OracleScene, R: np.ndarray, t: np.ndarray, rods: list[int]) -> bool:
    """Whether these rods alone bound the pose."""
    C = bound(made.frame, rods, R, t, world.mm_per_px, world.sd_px)
    G = at_arm(R @ (made.frame.starts.mean(axis=0) + made.frame.ends.mean(axis=0)) / 2)
    place, turn = (math.sqrt(np.linalg.eigvalsh(c)[-1]) for c in (G @ C @ G.T, C[3:, 3:]))
    return place <= KNOWN_MM and turn <= KNOWN_RAD


def rises(
    made: Sequence,
    world: OracleScene,
    R: np.ndarray,
    t: np.ndarray,
    rods: list[int],
    spots: list[int],
    own: np.ndarray,
) -> list[float]:
    """How much χ² rises three sd up and down the worst-known direction, the others giving way."""
    frame, s = made.frame, world.mm_per_px
    size = np.linalg.norm(frame.starts - frame.ends, axis=1).mean() / 2
    unit = np.array([1, 1, 1, size, size, size])
    values, vectors = np.linalg.eigh(own * np.outer(unit, unit))

    def residual(R1: np.ndarray, t1: np.ndarray) -> np.ndarray:
        predicted = cross_lines(frame.starts[rods], frame.ends[rods], R1, t1) / s
        return np.asarray((world.uv_px[spots] - predicted).ravel() / world.sd_px)

    def turned(R1: np.ndarray, t1: np.ndarray, twist: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return Rotation.from_rotvec(twist[3:]).as_matrix() @ R1, t1 + twist[:3]

    found = []
    lowest = float(residual(R, t) @ residual(R, t))
    for sign in (-1, 1):
        R1, t1 = turned(R, t, sign * 3 * math.sqrt(max(values[-1], 0)) * vectors[:, -1] / unit)
        basis = vectors[:, :-1] / unit[:, None]
        for _ in range(4):
            J = numeric_jacobian(frame, rods, R1, t1, s) @ basis / world.sd_px
            R1, t1 = turned(R1, t1, basis @ np.linalg.lstsq(J, residual(R1, t1), rcond=None)[0])
        found.append(float(residual(R1, t1) @ residual(R1, t1)) - lowest)
    return found


# --- the experiment ---------------------------------------------------------------------------------------------------


def run(seed: int, *, n: int, strategies: tuple[Strategy, ...], sd_px: float) -> dict[Strategy, Tally]:
    """One sequence, with each strategy."""
    made = sequence(seed, n=n, sd_px=sd_px)
    oracle = Oracle(made, sd_px)
    return {strategy: run_with(strategy, seed, made, oracle) for strategy in strategies}


def run_with(strategy: Strategy, seed: int, made: Sequence, oracle: Oracle) -> Tally:
    """One sequence with one strategy."""
    tally = Tally()
    began = time.process_time()
    results = list(pipeline.track(made.slices, made.model, options=TrackingOptions(jacobian=strategy)))
    tally.seconds = time.process_time() - began
    settled = [result.status == "ok" for result in results]
    for i, (result, true) in enumerate(zip(results, made.truth, strict=True)):
        tally.counts[f"{result.status}:{result.method or result.reason}"] += 1
        if result.status != "ok":
            if oracle.decidable(i, settled):
                tally.counts["undecided, though decidable"] += 1
                after = " after a jump" if true.has_jumped else ""
                tally.counts[f"  with {len(true.rods)} rods{after}: {result.reason}"] += 1
                tally.notes.append(f"undecided: seed {seed} slice {i} {len(true.rods)} rods{after}: {result.reason}")
            continue
        best = result.candidates[0]
        error = error_of(best.T_slice_model, true)
        tally.nees.append(float(error @ np.linalg.pinv(best.covariance, hermitian=True) @ error))
        own = is_wrong(best.T_slice_model, best.covariance, true)
        true_bound = true.bound if true.bound is not None else np.full((6, 6), np.inf)
        beyond = is_beyond_bound(made, true, best.T_slice_model)
        tally.counts["wrong: beyond 6 sd of the bound"] += beyond
        tally.counts["wrong: beyond its own covariance"] += own
        if own or beyond:
            tally.notes.append(
                f"WRONG: seed {seed} slice {i} {result.method} {len(true.rods)} rods, {len(best.rod_index)} matches: "
                f"{np.linalg.norm(error[:3]):.2f} mm {np.degrees(np.linalg.norm(error[3:])):.2f} deg "
                f"nees {tally.nees[-1]:.0f} odds {best.log_odds:.1f} bound {beyond} own {own}"
            )
        tally.counts["ok"] += 1
        if (seed * len(results) + i) % SAMPLED == 0:
            tally.counts["sampled"] += 1
            if oracle.decidable(i, settled):
                tally.counts["sampled and decidable"] += 1
                tally.squares.append(error**2)
                tally.bounds.append(np.diag(true_bound))
    return tally


def is_beyond_bound(made: Sequence, true: TrueSlice, T: np.ndarray) -> bool:
    """Whether a pose lies more than six sd of the bound from the truth, in rotation or at the frame's middle."""
    if true.bound is None:
        return True
    middle = true.R @ (made.frame.starts.mean(axis=0) + made.frame.ends.mean(axis=0)) / 2
    G = np.hstack([np.eye(3), np.cross(middle, np.eye(3))])
    error = _about_middle(made, T[:3, :3], T[:3, 3], true.R, true.t)
    place, turn = np.trace(G @ true.bound @ G.T), np.trace(true.bound[3:, 3:])
    return bool(error[:3] @ error[:3] > WRONG_SD**2 * place or error[3:] @ error[3:] > WRONG_SD**2 * turn)


def report(jacobian: str, sequences: int, n: int, tally: Tally) -> None:
    """Print one table."""
    print(f"{jacobian}: {sequences} sequences of {n} slices")
    for note in tally.notes:
        print(" ", note)
    for name, count in sorted(tally.counts.items()):
        print(f"  {name:50} {count}")
    counts = tally.counts
    decidable_ok = counts["ok"] * counts["sampled and decidable"] / max(counts["sampled"], 1)
    share = decidable_ok / max(decidable_ok + counts["undecided, though decidable"], 1)
    print(f"  decidable slices that are ok: {share:.4f} (goal 0.99)")
    squares, bounds = np.array(tally.squares), np.array(tally.bounds)
    ratio = np.sqrt(np.mean(squares / bounds, axis=0))
    print(f"  error / bound by axis {ratio.round(3)}, all {np.sqrt(np.mean(ratio**2)):.3f} (goal 1.05; {len(bounds)})")
    print(f"  mean NEES {np.mean(tally.nees):.2f} (6), {1e3 * tally.seconds / (sequences * n):.1f} ms a slice")


def table_smooth(sequences: int, sd_px: float) -> None:
    """Breathing at ten slices a period: the smoothed error beside that of each slice on its own, and its covariance."""
    single, bounds, after, nees = [], [], [], []
    for seed in range(sequences):
        made = sequence(
            seed,
            kind="breathing",
            n=80,
            model=load_rod_model("rod-cube-30x30x40"),
            sd_px=sd_px,
            p_missing=0.0,
            most_false=0,
            interval_s=0.4,
            period_s=4.0,
        )
        tracked = list(pipeline.track(made.slices, made.model))
        for before, result, true in zip(tracked, pipeline.smoothed(tracked, made.model), made.truth, strict=True):
            if result.status != "ok" or true.bound is None:
                continue
            best = result.candidates[0]
            error = error_of(best.T_slice_model, true)
            nees.append(error @ np.linalg.solve(best.covariance, error))
            after.append(error**2)
            single.append(error_of(before.candidates[0].T_slice_model, true) ** 2)
            bounds.append(np.diag(true.bound))
    alone, smooth = (np.sqrt(np.mean(np.array(e) / np.array(bounds), axis=0)) for e in (single, after))
    print(f"breathing, 10 slices a period, {sequences} sequences of 80 slices: rms error / single-slice bound")
    print(f"  each slice alone {alone.round(3)}, all {np.sqrt(np.mean(alone**2)):.3f}")
    print(f"  smoothed         {smooth.round(3)}, all {np.sqrt(np.mean(smooth**2)):.3f} (goal 0.70)")
    print(f"  mean NEES of the smoothed poses {np.mean(nees):.2f} (6)")


def table_basin(starts: int, gain: float) -> None:
    """From how far the control law comes home: random directions of displacement, noise-free spots of the cube."""
    model = load_rod_model("rod-cube-30x30x40")
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(np.radians([7.0, -5.0, 17.0])).as_matrix()
    T[:3, 3] = np.array([125.0, 125.0, 0.0]) - T[:3, :3] @ model.centre
    spots = cross_lines(model.starts, model.starts + model.directions, T[:3, :3], T[:3, 3])
    unit_sd = np.broadcast_to(np.eye(2), (len(model), 2, 2))
    desired = Desired.of(model, np.arange(len(model)), spots, unit_sd)
    options = ServoOptions(gain=gain, spot_tolerance_sd=1e-6, max_iterations=400)
    print(
        f"rod cube, gain {gain:g}, {starts} starts each: share that comes home, median iterations (to 1e-6 mm of spots)"
    )
    print("  shift mm  turn deg    updated           constant")
    for shift_mm, turn_deg in BASIN:
        cells = []
        for strategy in ("updated", "constant"):
            rng = np.random.default_rng([shift_mm, turn_deg])
            kept = view(desired, T).jacobian if strategy == "constant" else None
            iterations = []
            for _ in range(starts):
                shift, axis = rng.normal(size=(2, 3))
                shift *= shift_mm / np.linalg.norm(shift)
                axis *= math.radians(turn_deg) / np.linalg.norm(axis)
                try:
                    moved = servo(
                        model, displaced_start(T, model, shift, axis), desired, options=options, jacobian=kept
                    )
                except np.linalg.LinAlgError:
                    continue
                if moved.converged and np.abs(moved.T - T).max() < 1e-4:
                    iterations.append(moved.iterations)
            median = f"{np.median(iterations):5.0f}" if iterations else "    –"
            cells.append(f"{100 * len(iterations) / starts:5.1f} % {median}")
        print(f"  {shift_mm:8}  {turn_deg:8}    {cells[0]}     {cells[1]}")


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--sequences", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--slices", type=int, default=150)
    parser.add_argument("--jacobian", default="both", choices=["updated", "constant", "both"])
    parser.add_argument("--sd", type=float, default=0.3)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--smooth", action="store_true")
    parser.add_argument("--basin", action="store_true")
    parser.add_argument("--gain", type=float, default=0.1, help="of --basin")
    a = parser.parse_args()
    if a.smooth:
        table_smooth(min(a.sequences, 40), a.sd)
        return
    if a.basin:
        table_basin(a.sequences, a.gain)
        return
    strategies: tuple[Strategy, ...] = ("updated", "constant") if a.jacobian == "both" else (a.jacobian,)
    totals = {strategy: Tally() for strategy in strategies}
    job = partial(run, n=a.slices, strategies=strategies, sd_px=a.sd)
    print(f"seeds {a.first} to {a.first + a.sequences - 1}, {a.slices} slices each, spots {a.sd} px", flush=True)
    with ProcessPoolExecutor(a.workers) as pool:
        for done, parts in enumerate(pool.map(job, range(a.first, a.first + a.sequences)), 1):
            for strategy, part in parts.items():
                totals[strategy].add(part)
            if done % REPORT_EVERY == 0 or done == a.sequences:
                for strategy, total in totals.items():
                    report(strategy, done, a.slices, total)


if __name__ == "__main__":
    main()
