"""What a tracked slice costs, from DICOM file to CSV row, beside pydicom's own ``dcmread(f).pixel_array`` of the same files.

    python benchmarks/speed.py [FOLDER -m FRAME] [--slices 64] [--repeats 9]

Prints slices a second, the ratio to pydicom (goal: 2), the split by stage, a naive pipeline (pydicom, scikit-image
regionprops, scipy least_squares) and the memory of 10,000 slices against 100. Stages are timed slice by slice in turn
with pydicom, and the fastest of all repeats counts, so that other work on the machine does not. Whole runs are timed too.
"""

from __future__ import annotations

import argparse
import io
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pydicom
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from ctreg_cli import pipeline
from ctreg_cli.geometry.projection import project
from ctreg_cli.imaging.follow import Follower
from ctreg_cli.io.images import open_images
from ctreg_cli.io.results import ResultsHeader, results_encoding
from ctreg_cli.io.rod_file import load_rod_model
from ctreg_cli.io.sinks import open_sinks
from ctreg_cli.rods import RodModel
from ctreg_cli.tracking.tracker import Tracker

GOAL = 2.0


def simulated(folder: Path, n: int) -> Path:
    """A breathing cube in ``n`` slices."""
    out = folder / "slices"
    command = [sys.executable, "-m", "ctreg_cli", "simulate", "-m", "rod-cube-30x30x40", "-o", str(out), "-q"]
    subprocess.run([*command, "--frames", str(n), "--interval-s", "0.25", "--seed", "1"], check=True)
    return out


class Stages:
    """Fastest time of every stage of every slice."""

    def __init__(self, n: int) -> None:
        self.best: dict[str, np.ndarray] = {}
        self.n = n

    def note(self, name: str, slice_: int, seconds: float) -> None:
        times = self.best.setdefault(name, np.full(self.n, np.inf))
        times[slice_] = min(times[slice_], seconds)

    def mean_ms(self, name: str) -> float:
        """Of the slices after the first few, which are registered."""
        return 1e3 * float(np.mean(self.best[name][4:]))


def time_stages(files: list[Path], model: RodModel, repeats: int) -> Stages:
    """All stages in turn, slice by slice; ``spots`` and ``tracker`` are parts of ``track``."""
    stages = Stages(len(files))
    clock = time.perf_counter
    measure = Follower.measure
    spent = 0.0

    def timed(*arguments: object, **named: object) -> object:
        nonlocal spent
        began = clock()
        found = measure(*arguments, **named)  # type: ignore[arg-type]
        spent += clock() - began
        return found

    Follower.measure = timed  # type: ignore[method-assign, assignment]
    try:
        for _ in range(repeats):
            tracker, follower = Tracker(model), Follower(pipeline.expecting(model, None))
            # all headers at once are too long for the machine to leave them undisturbed: processor time
            t0 = time.thread_time()
            series = open_images([files[0].parent])
            header = (time.thread_time() - t0) / len(files)
            with open_sinks(["-"], results_encoding(ResultsHeader(model=model)), io.StringIO()) as sinks:
                for i, (file, record) in enumerate(zip(files, series.records, strict=True)):
                    spent = 0.0
                    t0 = clock()
                    pydicom.dcmread(file).pixel_array  # noqa: B018
                    t1 = clock()
                    slice_ = record.open()
                    t2 = clock()
                    result = pipeline.track_slice(i, slice_, tracker, follower, scale=None)
                    t3 = clock()
                    sinks.write(result)
                    t4 = clock()
                    stages.note("pydicom", i, t1 - t0)
                    stages.note("header", i, header)
                    stages.note("pixels", i, t2 - t1)
                    stages.note("spots", i, spent)
                    stages.note("tracker", i, t3 - t2 - spent)
                    stages.note("row", i, t4 - t3)
    finally:
        Follower.measure = measure  # type: ignore[method-assign]
    return stages


def whole_run_ms(files: list[Path], model: RodModel, repeats: int) -> tuple[float, float]:
    """What a slice more costs a run from files to table, and pydicom, ms; nothing left out, fastest of all repeats."""
    clock, half = time.perf_counter, len(files) // 2
    spent: dict[str, float] = {"some": np.inf, "all": np.inf, "pydicom": np.inf}
    for _ in range(repeats):
        for name, part in (("some", files[:half]), ("all", files)):
            began = clock()
            with open_sinks(["-"], results_encoding(ResultsHeader(model=model)), io.StringIO()) as sinks:
                for result in pipeline.track(open_images(part), model):
                    sinks.write(result)
            spent[name] = min(spent[name], clock() - began)
        began = clock()
        for file in files[half:]:
            pydicom.dcmread(file).pixel_array  # noqa: B018
        spent["pydicom"] = min(spent["pydicom"], clock() - began)
    more = len(files) - half
    return 1e3 * (spent["all"] - spent["some"]) / more, 1e3 * spent["pydicom"] / more


def naive(file: Path, model: RodModel, T: np.ndarray) -> np.ndarray:
    """What one would write in an afternoon: threshold, regionprops, nearest labels, least squares from the last pose."""
    from skimage.measure import label, regionprops

    dataset = pydicom.dcmread(file)
    hu = dataset.pixel_array * float(dataset.RescaleSlope) + float(dataset.RescaleIntercept)
    s = np.array([float(dataset.PixelSpacing[1]), float(dataset.PixelSpacing[0])])
    regions = regionprops(label(hu > 1500), intensity_image=hu)
    spots = np.array([r.centroid_weighted[::-1] for r in regions if 3 <= r.area <= 100]) * s
    predicted = project(T, model.starts, model.directions).xy_mm
    nearest = np.linalg.norm(spots[None] - predicted[:, None], axis=2).argmin(axis=1)

    def residuals(x: np.ndarray) -> np.ndarray:
        moved = T.copy()
        moved[:3, :3] = Rotation.from_rotvec(x[3:]).as_matrix() @ T[:3, :3]
        moved[:3, 3] += x[:3]
        return (project(moved, model.starts, model.directions).xy_mm - spots[nearest]).ravel()

    x = least_squares(residuals, np.zeros(6)).x
    moved = T.copy()
    moved[:3, :3] = Rotation.from_rotvec(x[3:]).as_matrix() @ T[:3, :3]
    moved[:3, 3] += x[:3]
    return moved


def time_naive(files: list[Path], model: RodModel, repeats: int) -> float:
    first = next(iter(pipeline.track(open_images([files[0]]), model))).candidates[0].T_slice_model
    stages = Stages(len(files))
    for _ in range(repeats):
        T = np.array(first)
        for i, file in enumerate(files):
            t0 = time.perf_counter()
            T = naive(file, model, T)
            stages.note("naive", i, time.perf_counter() - t0)
    return stages.mean_ms("naive")


def memory_mb(folder: Path, frame: str, n: int) -> float:
    """Peak memory of a process of its own that tracks ``n`` slices (the same files again and again), MB."""
    command = [sys.executable, __file__, str(folder), "-m", frame, "--only-track", str(n)]
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def only_track(folder: Path, model: RodModel, n: int) -> None:
    """Track ``n`` slices to a CSV that nobody keeps, and print the peak memory."""
    records = open_images([folder]).records
    # there and back again, so that the motion has no jump
    turn = [*range(len(records)), *range(len(records) - 2, 0, -1)]

    def slices() -> object:
        for i in range(n):
            slice_ = records[turn[i % len(turn)]].load()
            yield replace(slice_, info=replace(slice_.info, time_s=0.25 * i))

    with open_sinks(["-"], results_encoding(ResultsHeader(model=model)), Path("/dev/null").open("w")) as sinks:
        for result in pipeline.track(slices(), model):  # type: ignore[arg-type]
            sinks.write(result)
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", nargs="?", type=Path)
    parser.add_argument("-m", "--model", default="rod-cube-30x30x40")
    parser.add_argument("--slices", type=int, default=64)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--memory", action="store_true", help="also compare the memory of 10,000 slices with 100")
    parser.add_argument("--only-track", type=int, help=argparse.SUPPRESS)
    a = parser.parse_args()
    model = load_rod_model(a.model)
    if a.only_track:
        only_track(a.folder, model, a.only_track)
        return
    with tempfile.TemporaryDirectory() as temporary:
        folder = a.folder or simulated(Path(temporary), a.slices)
        files = [folder / record.info.source for record in open_images([folder]).records]
        stages = time_stages(files, model, a.repeats)
        reference = stages.mean_ms("pydicom")
        split = {name: stages.mean_ms(name) for name in ("header", "pixels", "spots", "tracker", "row")}
        total = sum(split.values())
        print(f"{len(files)} slices; pydicom dcmread().pixel_array {reference:.2f} ms")
        for name, ms in split.items():
            print(f"  {name:8} {ms:6.2f} ms  {ms / reference:5.2f}")
        print(
            f"  all      {total:6.2f} ms, {1e3 / total:.0f} slices/s: {total / reference:.2f} × pydicom (goal {GOAL:g})"
        )
        ours, theirs = whole_run_ms(files, model, a.repeats)
        print(f"  whole runs, a slice more: {ours:.2f} ms, pydicom {theirs:.2f} ms: {ours / theirs:.2f} × pydicom")
        print(f"  naive    {time_naive(files, model, 3):6.2f} ms")
        if a.memory:
            few, many = (memory_mb(folder, a.model, n) for n in (100, 10_000))
            print(f"memory: {few:.0f} MB for 100 slices, {many:.0f} MB for 10,000: {many - few:+.0f} MB (goal 60)")


if __name__ == "__main__":
    main()
