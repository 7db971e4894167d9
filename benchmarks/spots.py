"""Spot detectors side by side: ours, scikit-image's labels and blobs, trackpy where it is installed.

    python benchmarks/spots.py

Simulated slices are rendered here (blurred discs in noise, flat and clipped); the cube slices are those of sample_data.
A spot counts as found within 2 px of the truth. Times are medians over the slices, first call left out.
"""

from __future__ import annotations

import importlib.util
import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pydicom
from scipy.ndimage import gaussian_filter

from ctreg_cli.imaging.segmentation import find_spots, measure_spots
from ctreg_cli.imaging.slice import Slice, SliceInfo
from ctreg_cli.scale import Scale

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
    """trackpy's locate, 7 px."""
    import trackpy

    values = np.maximum(slice_.values(), 0)
    return trackpy.locate(values, 7, minmass=5000, preprocess=False)[["x", "y"]].to_numpy()


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


def main() -> None:
    """Print the table."""
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
