"""How the tracker does on simulated sequences of spots: wrong poses, share of ``ok``, error against the bound.

    python benchmarks/tracking.py [--sequences 200] [--slices 150] [--jacobian updated]

Scenes come from ``tests/oracle.py``, which shares no code with the package.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent))

from ctreg_cli import pipeline
from ctreg_cli.registration.options import TrackingOptions
from tests.tracking.sequences import error_of, is_wrong, sequence

#: a slice is decidable when so many rods left a spot, and these bound every turn by so much (sd, rad): beyond, the
#: problem is not linear, and no pose with a covariance can be stated
DECIDABLE_RODS, DECIDABLE_SD_RAD = 5, math.radians(3.0)


def run(seed: int, *, n: int, jacobian: str, sd_px: float) -> dict[str, object]:
    """One sequence: counts, squared errors in units of the bound, and what went wrong."""
    made = sequence(seed, n=n, sd_px=sd_px)
    counts: Counter[str] = Counter()
    nees, squares, bounds, notes = [], [], [], []
    began = time.perf_counter()
    results = list(pipeline.track(made.slices, made.model, options=TrackingOptions(jacobian=jacobian)))
    seconds = time.perf_counter() - began
    for i, (result, true) in enumerate(zip(results, made.truth, strict=True)):
        decidable = len(true.rods) >= DECIDABLE_RODS and true.bound is not None
        decidable = decidable and math.sqrt(np.linalg.eigvalsh(true.bound[3:, 3:])[-1]) <= DECIDABLE_SD_RAD
        counts["decidable"] += decidable
        counts[f"{result.status}:{result.method or result.reason}"] += 1
        if decidable and result.status != "ok":
            counts["undecided"] += 1
            counts[
                f"undecided with {len(true.rods)} rods{' after a jump' if true.has_jumped else ''}: {result.reason}"
            ] += 1
        if result.status == "ok":
            best = result.candidates[0]
            error = error_of(best.T_slice_model, true)
            nees.append(error @ np.linalg.pinv(best.covariance, hermitian=True) @ error)
            if is_wrong(best.T_slice_model, best.covariance, true):
                counts["wrong"] += 1
                notes.append(
                    f"seed {seed} slice {i} {result.method} {len(true.rods)} rods, {len(best.rod_index)} matches: "
                    f"{np.linalg.norm(error[:3]):.2f} mm {np.degrees(np.linalg.norm(error[3:])):.2f} deg "
                    f"nees {nees[-1]:.0f} odds {best.log_odds:.1f}"
                )
            if decidable:
                squares.append(error**2)
                bounds.append(np.diag(true.bound))
    return {"counts": counts, "nees": nees, "squares": squares, "bounds": bounds, "notes": notes, "seconds": seconds}


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--sequences", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--slices", type=int, default=150)
    parser.add_argument("--jacobian", default="updated")
    parser.add_argument("--sd", type=float, default=0.3)
    parser.add_argument("--workers", type=int, default=1)
    a = parser.parse_args()
    counts: Counter[str] = Counter()
    nees, squares, bounds, seconds = [], [], [], 0.0
    job = partial(run, n=a.slices, jacobian=a.jacobian, sd_px=a.sd)
    with ProcessPoolExecutor(a.workers) as pool:
        for part in pool.map(job, range(a.first, a.first + a.sequences)):
            counts.update(part["counts"])
            nees += part["nees"]
            squares += part["squares"]
            bounds += part["bounds"]
            seconds += part["seconds"]
            for note in part["notes"]:
                print("WRONG", note)
    for name, count in sorted(counts.items()):
        print(f"{name:50} {count}")
    total = a.sequences * a.slices
    print(f"decidable slices that are ok: {1 - counts['undecided'] / max(counts['decidable'], 1):.4f}")
    ratio = np.sqrt(np.mean(squares, axis=0) / np.mean(bounds, axis=0))
    print("error / bound by axis", ratio.round(3), "all", np.sqrt(np.mean(ratio**2)).round(3))
    print(f"mean NEES {np.mean(nees):.2f} (6), {1e3 * seconds / total:.1f} ms a slice")


if __name__ == "__main__":
    main()
