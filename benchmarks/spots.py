"""Spot detectors side by side: ours, scikit-image's labels and blobs, trackpy where it is installed.

    python -m benchmarks.spots              all tables
    python -m benchmarks.spots --law        only the second and the third

Simulated slices are rendered here (blurred discs in noise, flat and clipped); the cube slices are those of sample_data.
A spot counts as found within 2 px of the truth. Times are medians over the slices, first call left out.

The second table holds our centres against the law: rms error over the least that white noise allows (Cramér–Rao) a
centre of whose rod all else is known ("known"; of correlated noise, what least squares makes of it), and nothing else
("unknown": contrast, diameter, blur, slope, background and its gradient; mean over the places in their pixels); the
mean squared error in own standard deviations, which is 1 where the covariance is true; and the greatest error without
noise. The two bounds differ where a spot is sharp, or cut off: then few pixels see it, and they do not lie evenly about
it. Rods are rendered by the tests' own renderer, which shares no code with the package.

The third table has two rods close together: how often they are one spot, and how often that spot (or one of the two) is
off by more than three of its own sd from the rod it is next to, or where it lies in the middle, from either.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import time
from collections.abc import Callable
from itertools import product
from pathlib import Path

import numpy as np
import pydicom
from scipy.ndimage import gaussian_filter

from ctreg_cli.imaging.segmentation import find_spots, measure_spots
from ctreg_cli.imaging.slice import Slice, SliceInfo
from ctreg_cli.scale import Scale
from tests.imaging.rendering import as_slice, attainable, cramer_rao, render_grid, render_rod

Scene = tuple[Slice, np.ndarray]
FOUND_PX = 2.0
OVERSAMPLING = 8


def simulated(n: int, ceiling: float, rng: np.random.Generator) -> list[Scene]:
    """Slices of 512 × 512 px with ten discs of 3 px, blurred by 0.9 px, 3000 HU above water, noise 30 HU."""
    scenes = []
    for _ in range(n):
        uv = np.array([(60 + 90 * (i % 5), 150 + 200 * (i // 5)) for i in range(10)]) + rng.uniform(-20, 20, (10, 2))
        image = np.zeros((512, 512))
        for u, v in uv:
            c, r, reach = round(u), round(v), 12
            fine = (np.arange((2 * reach + 1) * OVERSAMPLING) + 0.5) / OVERSAMPLING - 0.5 - reach
            x, y = np.meshgrid(fine - (u - c), fine - (v - r))
            disc = gaussian_filter((np.hypot(x, y) < 1.5).astype(float), 0.9 * OVERSAMPLING)
            pixels = disc.reshape(2 * reach + 1, OVERSAMPLING, 2 * reach + 1, OVERSAMPLING).mean(axis=(1, 3))
            height = 3000.0 if np.isinf(ceiling) else 9000.0
            image[r - reach : r + reach + 1, c - reach : c + reach + 1] += height * pixels
        values = np.minimum(image + rng.normal(0, 30, image.shape), ceiling)
        info = SliceInfo(source="simulated", scale=Scale(s_x=0.5, s_y=0.5), thickness_mm=2.0)
        scenes.append((Slice(info=info, stored=np.rint(values).astype(np.int16)), uv))
    return scenes


def cube() -> list[Scene]:
    """The simulated CT of sample_data, with the projected rods as truth."""
    scenes = []
    for truth_file in sorted((Path(__file__).parents[1] / "sample_data").glob("*/truth.json")):
        for truth in json.loads(truth_file.read_text()):
            dataset = pydicom.dcmread(truth_file.parent / truth["file"])
            spacing = (float(x) for x in dataset.PixelSpacing)
            info = SliceInfo(
                source=truth["file"],
                scale=Scale.from_pixel_spacing(*spacing),
                thickness_mm=float(dataset.SliceThickness),
            )
            stored = dataset.pixel_array.astype(np.int16)
            slice_ = Slice(info=info, stored=stored, intercept=float(dataset.RescaleIntercept))
            scenes.append((slice_, np.array([[s["u_px"], s["v_px"]] for s in truth["spots"]])))
    return scenes


def by_ctreg(slice_: Slice, uv: np.ndarray) -> np.ndarray:
    """Our search of the whole slice."""
    return find_spots(slice_).uv_px


def by_ctreg_tracking(slice_: Slice, uv: np.ndarray) -> np.ndarray:
    """Our measurement about predictions one pixel off."""
    return measure_spots(slice_, uv + 0.7, 5.0).uv_px


def by_labels(slice_: Slice, uv: np.ndarray) -> np.ndarray:
    """scikit-image: label above half of the greatest value, intensity-weighted centroids."""
    from skimage.measure import label, regionprops

    values = slice_.values()
    regions = regionprops(label(values > 0.5 * values.max()), intensity_image=values)
    return np.array([r.centroid_weighted[::-1] for r in regions]).reshape(-1, 2)


def by_blobs(slice_: Slice, uv: np.ndarray) -> np.ndarray:
    """scikit-image: Laplacian-of-Gaussian blobs."""
    from skimage.feature import blob_log

    values = slice_.values()
    scaled = (values - values.min()) / np.ptp(values)
    return np.asarray(blob_log(scaled, min_sigma=1, max_sigma=3, num_sigma=5, threshold=0.2))[:, 1::-1]


def by_trackpy(slice_: Slice, uv: np.ndarray) -> np.ndarray:
    """trackpy's locate, 9 px, with its own band-pass: the best of the settings tried (7, 9, 11 px; with and without)."""
    import trackpy

    values = np.maximum(slice_.values(), 0)
    return trackpy.locate(values, 9, minmass=5000)[["x", "y"]].to_numpy()


def score(method: Callable[[Slice, np.ndarray], np.ndarray], scenes: list[Scene]) -> str:
    """One row of the table."""
    method(*scenes[0])
    errors, times, missed, false = [], [], 0, 0
    for slice_, uv in scenes:
        start = time.perf_counter()
        found = method(slice_, uv)
        times.append(time.perf_counter() - start)
        if not len(found):
            missed += len(uv)
            continue
        distance = np.linalg.norm(found[:, None] - uv, axis=2)
        seen = distance.min(axis=0) < FOUND_PX
        errors.append((found[distance.argmin(axis=0)] - uv)[seen])
        missed += int((~seen).sum())
        false += int((distance.min(axis=1) >= FOUND_PX).sum())
    total = sum(len(uv) for _, uv in scenes)
    rms = np.sqrt(np.mean(np.concatenate(errors) ** 2)) if errors else np.nan
    return f"{1e3 * np.median(times):8.1f} {rms:8.4f} {100 * (1 - missed / total):7.1f} {false / len(scenes):8.1f}"


#: of the law: rod and scanner; peak in noise sd, or noise sd; ceiling; blur of the noise, px
CLIPPED = {"contrast": 8000.0, "slope": (0.3, 0.1)}
STEEP = {"thickness_mm": 5.0, "contrast": 9000.0}
LAW: dict[str, tuple[dict[str, object], float, float, float]] = {
    **{f"contrast {sd} sd": ({"blur_mm": 0.45}, sd, np.inf, 0.0) for sd in (5, 7, 10, 20, 50, 200)},
    **{f"blur {2 * b:g} px": ({"blur_mm": b}, 30, np.inf, 0.0) for b in (0.2, 0.25, 0.35, 0.6, 0.9)},
    **{
        f"clipped, blur {2 * b:g} px": ({**CLIPPED, "blur_mm": b}, -60, 3071.0, 0.0)
        for b in (0.2, 0.25, 0.35, 0.5, 0.8)
    },
    **{f"noise blurred {s:g} px": ({"blur_mm": 0.6}, 30, np.inf, s) for s in (0.5, 0.7, 1.0, 1.3)},
    **{f"2 mm, noise blurred {s:g} px": ({"diameter_mm": 2.0, "mm_per_px": 0.4}, 15, np.inf, s) for s in (0.7, 1.0)},
    **{
        f"tilt {d}°, 5 mm": ({**STEEP, "slope": (0.8 * t, 0.6 * t)}, 50, np.inf, 0.0)
        for d, t in ((15, 0.27), (30, 0.58), (45, 1.0))
    },
    "tilt 45°, 5 mm, clipped": ({**STEEP, "contrast": 15000.0, "slope": (0.8, 0.6)}, -60, 3071.0, 0.0),
}
SIDE, PITCH = 6, 34
#: exceeded by one in a thousand of χ² with two degrees of freedom
CHI2_999 = 13.816


def noise_of(shape: tuple[int, int], blur_px: float, rng: np.random.Generator) -> np.ndarray:
    """Noise of sd 1, smooth if asked."""
    noise = rng.normal(0.0, 1.0, shape)
    if not blur_px:
        return noise
    noise = gaussian_filter(noise, blur_px, mode="wrap")
    return noise / noise.std()


def least_error_px(rod: dict[str, object], noise: float, ceiling: float, blur_px: float) -> float:
    """Root of the trace of the covariance that the noise leaves at best."""
    if not blur_px:
        return float(np.sqrt(np.trace(cramer_rao(noise, ceiling, **rod))))
    n, c, e = 41, 20.0, 0.05

    def image(u: float, v: float) -> np.ndarray:
        return render_rod((n, n), (u, v), **rod)  # type: ignore[arg-type]

    gradient = np.stack([image(c + e, c) - image(c - e, c), image(c, c + e) - image(c, c - e)]).reshape(2, -1) / (2 * e)
    row, column = (axis.ravel() for axis in np.mgrid[:n, :n])
    squared = (row[:, None] - row) ** 2 + (column[:, None] - column) ** 2
    influence = np.linalg.inv(gradient @ gradient.T) @ gradient
    return float(noise * np.sqrt(np.trace(influence @ np.exp(-squared / (4 * blur_px**2)) @ influence.T)))


def seen_in(values: np.ndarray, rod: dict[str, object], uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Errors (k, 2) and covariances (k, 2, 2) of the spots found at true centres."""
    slice_ = as_slice(values, mm_per_px=rod.get("mm_per_px", 0.5), thickness_mm=rod.get("thickness_mm", 2.0))  # type: ignore[arg-type]
    spots = find_spots(slice_)
    if not len(spots):
        return np.empty((0, 2)), np.empty((0, 2, 2))
    distance = np.linalg.norm(spots.uv_px[:, None] - uv, axis=2)
    nearest, seen = distance.argmin(axis=0), distance.min(axis=0) < FOUND_PX
    return (spots.uv_px[nearest] - uv)[seen], spots.covariance_px[nearest][seen]


#: two rods: diameter and blur, mm (0.5 mm a pixel); full width of one spot at half its height, px
PAIRS = {(1.0, 0.35): 2.3, (1.0, 0.5): 2.8, (2.0, 0.5): 3.9}
PAIR_NEAR, PAIR_SD = 0.35, 50.0


def pairs(repeats: int) -> None:
    """Print the third table."""
    print(
        f"{'rods, spot width':24s} {'contrasts':>9s} {'apart px':>9s} {'one spot %':>10s} {'sd px':>7s} {'beyond 3 sd %':>14s}"
    )
    for ((diameter, blur), width), ratio in product(PAIRS.items(), (1.0, 0.7)):
        rod = {"diameter_mm": diameter, "blur_mm": blur}
        for apart in (2.0, 2.5, 3.0, 3.5, 4.0):
            rng, one, sd, beyond = np.random.default_rng(13), 0, [], 0
            for _ in range(repeats):
                middle, angle = 35.0 + rng.uniform(-0.5, 0.5, 2), rng.uniform(0, np.pi)
                half = 0.5 * apart * np.array([np.cos(angle), np.sin(angle)])
                rods = np.stack([middle - half, middle + half])
                first, second = (render_rod((71, 71), tuple(uv), **rod) for uv in rods)  # type: ignore[arg-type]
                image = first + ratio * second
                spots = find_spots(as_slice(image + rng.normal(0.0, image.max() / PAIR_SD, image.shape)))
                one += len(spots) == 1
                sd += [np.sqrt(np.linalg.eigvalsh(covariance)[-1]) for covariance in spots.covariance_px]
                beyond += any(map(believes_too_much, spots.uv_px, spots.covariance_px, [rods] * len(spots)))
            name = f"{diameter:g} mm, {width:g} px"
            print(
                f"{name:24s} {f'1 : {ratio:g}':>9s} {apart:9.1f} {100 * one / repeats:10.0f} {np.median(sd):7.3f}"
                f" {100 * beyond / repeats:14.0f}"
            )


def believes_too_much(uv: np.ndarray, covariance: np.ndarray, rods: np.ndarray) -> bool:
    """Whether a spot is more than three of its sd from the rod it is next to; from either, if it is next to none."""
    error = rods - uv
    own = np.sqrt(np.einsum("ki,ij,kj->k", error, np.linalg.inv(covariance), error) / 2)
    distance = np.linalg.norm(error, axis=1)
    near = distance.min() < PAIR_NEAR * np.linalg.norm(rods[0] - rods[1])
    return bool((own[distance.argmin()] if near else own.max()) > 3.0)


def law(repeats: int) -> None:
    """Print the second table."""
    columns = ("found %", "rms px", "/known", "/unknown", "error²/own", "beyond 1‰", "max bias px")
    print(f"{'case':28s} " + " ".join(f"{column:>11s}" for column in columns))
    for case, (rod, peak, ceiling, blur_px) in LAW.items():
        image, uv = render_grid(np.random.default_rng(len(case)), SIDE, PITCH, **rod)
        noise = image.max() / peak if peak > 0 else -peak
        rng = np.random.default_rng(11)
        error, scaled = [], []
        for _ in range(repeats):
            values = np.minimum(image + 40 + noise * noise_of(image.shape, blur_px, rng), ceiling)
            off, covariance = seen_in(values, rod, uv)
            error.append(off)
            scaled.append(np.einsum("ki,kij,kj->k", off, np.linalg.inv(covariance), off) / 2)
        off, own = np.concatenate(error), np.concatenate(scaled)
        rms = np.sqrt((off**2).sum(axis=1).mean())
        found = 100 * len(off) / (repeats * len(uv))
        known = rms / least_error_px(rod, noise, ceiling, blur_px)
        unknown = "-" if blur_px else f"{rms / np.sqrt(np.trace(attainable(noise, ceiling, uv[:12], **rod))):.2f}"
        beyond = 1e3 * np.mean(own > CHI2_999 / 2)
        still, _ = seen_in(np.minimum(image + 40 + rng.normal(0.0, 0.3, image.shape), ceiling), rod, uv)
        print(
            f"{case:28s} {found:11.1f} {rms:11.4f} {known:11.2f} {unknown:>11s} {own.mean():11.2f} {beyond:10.1f}‰"
            f" {np.abs(still).max():11.4f}"
        )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--law", action="store_true", help="only our centres and covariances against the law")
    parser.add_argument("--repeats", type=int, default=24, help="noises a case of the law")
    a = parser.parse_args()
    if not a.law:
        detectors()
    law(a.repeats)
    pairs(a.repeats)


def detectors() -> None:
    """Print the first table."""
    methods: dict[str, Callable[[Slice, np.ndarray], np.ndarray]] = {
        "ctreg, whole slice": by_ctreg,
        "ctreg, predictions": by_ctreg_tracking,
        "label + regionprops": by_labels,
        "LoG blobs": by_blobs,
    }
    if importlib.util.find_spec("trackpy"):
        methods["trackpy"] = by_trackpy
    rng = np.random.default_rng(0)
    scenes = {
        "simulated, 10 discs": simulated(8, np.inf, rng),
        "simulated, clipped": simulated(8, 3071.0, rng),
        "cube CT (20 slices)": cube(),
    }
    print(f"{'scene':20s} {'method':20s} {'ms':>8s} {'rms px':>8s} {'found %':>7s} {'false':>8s}")
    for scene, slices in scenes.items():
        for name, method in methods.items():
            print(f"{scene:20s} {name:20s} {score(method, slices)}")


if __name__ == "__main__":
    main()
