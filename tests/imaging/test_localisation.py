"""Centres at the Cramér–Rao bound, covariances that are true, and wider where something disturbs the spot."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from ctreg_cli.imaging.segmentation import SegmentationOptions, find_spots
from ctreg_cli.imaging.spots import Spots
from tests.imaging.rendering import as_slice, attainable, cramer_rao, render_grid, render_rod

SIDE, PITCH = 7, 34

#: rod and scanner; noise sd; value at which the scanner clips
CASES = {
    "thin rod": ({"contrast": 3000.0}, 100.0, np.inf),
    "faint rod": ({"contrast": 1500.0, "blur_mm": 0.45}, 60.0, np.inf),
    "thick rod": ({"diameter_mm": 2.0, "mm_per_px": 0.33, "blur_mm": 0.35, "contrast": 2500.0}, 100.0, np.inf),
    "clipped": ({"contrast": 11000.0, "slope": (0.3, 0.1)}, 150.0, 3071.0),
    "30° in 5 mm": ({"thickness_mm": 5.0, "slope": (0.5, 0.3), "contrast": 9000.0}, 100.0, np.inf),
    "45° in 5 mm": ({"thickness_mm": 5.0, "slope": (0.8, 0.6), "contrast": 9000.0}, 60.0, np.inf),
    "45°, clipped": ({"thickness_mm": 5.0, "slope": (0.8, 0.6), "contrast": 15000.0}, 60.0, 3071.0),
    "7 noise sd": ({"contrast": 1500.0, "blur_mm": 0.45}, 100.0, np.inf),
    "200 noise sd": ({"contrast": 3000.0, "blur_mm": 0.45}, 7.0, np.inf),
    "sharp": ({"contrast": 3000.0, "blur_mm": 0.2}, 80.0, np.inf),
    "sharp, clipped": ({"contrast": 8000.0, "slope": (0.3, 0.1), "blur_mm": 0.2}, 60.0, 3071.0),
    "rather sharp, clipped": ({"contrast": 8000.0, "slope": (0.3, 0.1), "blur_mm": 0.35}, 60.0, 3071.0),
    "very sharp": ({"contrast": 3000.0, "diameter_mm": 1.2, "blur_mm": 0.2, "slope": (0.0, 0.0)}, 25.0, np.inf),
    "small pixels, dark floor": ({"contrast": 400.0}, 15.0, np.inf),
}


@cache
def rendered(case: str) -> tuple[np.ndarray, np.ndarray]:
    return render_grid(np.random.default_rng(len(case)), SIDE, PITCH, **CASES[case][0])


def scanned(image: np.ndarray, noise: float, ceiling: float, rng: np.random.Generator, rod: dict[str, object]) -> Spots:
    values = np.minimum(image + 40.0 + rng.normal(0.0, noise, image.shape), ceiling)
    slice_ = as_slice(values, mm_per_px=rod.get("mm_per_px", 0.5), thickness_mm=rod.get("thickness_mm", 2.0))  # type: ignore[arg-type]
    return find_spots(slice_)


def errors(spots: Spots, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Errors (k, 2) and covariances (k, 2, 2) of the spots within 2 px of a true centre, each centre's nearest."""
    distance = np.linalg.norm(spots.uv_px[:, None] - uv, axis=2)
    nearest = distance.argmin(axis=0)
    seen = distance.min(axis=0) < 2.0
    return (spots.uv_px[nearest] - uv)[seen], spots.covariance_px[nearest][seen]


@pytest.mark.parametrize("case", CASES)
def test_centres_reach_the_cramer_rao_bound_and_covariances_are_true(case: str) -> None:
    """The bound is that of a rod of which nothing is known; of all but the sharp ones it is that of a known one."""
    rod, noise, ceiling = CASES[case]
    image, uv = rendered(case)
    rng = np.random.default_rng(1)
    parts = [errors(scanned(image, noise, ceiling, rng, rod), uv) for _ in range(4)]
    error, covariance = (np.concatenate(p) for p in zip(*parts, strict=True))
    assert len(error) >= (4 * 40 if case != "7 noise sd" else 120)  # max_spots of SIDE² = 49
    at_best = cramer_rao(noise, ceiling, **rod) if "sharp" not in case else attainable(noise, ceiling, uv[:12], **rod)
    assert np.sqrt((error**2).sum(axis=1).mean()) < 1.15 * np.sqrt(np.trace(at_best))
    chi2 = np.einsum("ki,kij,kj->k", error, np.linalg.inv(covariance), error).mean() / 2
    assert 0.8 < chi2 < 1.2


@pytest.mark.parametrize(
    ("case", "most_px"),
    [
        ("thin rod", 0.01),
        ("thick rod", 0.01),
        ("sharp", 0.01),
        ("very sharp", 0.01),
        ("30° in 5 mm", 0.01),
        ("45° in 5 mm", 0.01),
        ("clipped", 0.03),
        ("45°, clipped", 0.03),
        ("sharp, clipped", 0.03),
        ("rather sharp, clipped", 0.03),
    ],
)
def test_where_in_its_pixel_a_rod_lies_does_not_move_the_centre(case: str, most_px: float) -> None:
    rod, _, ceiling = CASES[case]
    image, uv = rendered(case)
    error, _ = errors(scanned(image, 0.3, ceiling, np.random.default_rng(2), rod), uv)
    assert np.abs(error).max() < most_px


def test_a_sharp_clipped_spot_is_off_by_less_than_its_sd_says() -> None:
    rod = {"mm_per_px": 0.625, "diameter_mm": 2.0, "thickness_mm": 0.6, "slope": (1.0, 0.0), "blur_mm": 0.35}
    image, uv = render_grid(np.random.default_rng(3), SIDE, PITCH, contrast=8000.0, **rod)
    error, covariance = errors(scanned(image, 10.0, 3071.0, np.random.default_rng(4), rod), uv)
    assert np.abs(error).max() < 0.03
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    assert np.sqrt(((error / sd) ** 2).mean()) < 1.6


@pytest.mark.parametrize(("diameter_mm", "mm_per_px"), [(5.0, 0.5), (6.0, 0.5), (7.0, 0.8)])
def test_no_thick_clipped_spot_is_off_by_far_more_than_its_sd(diameter_mm: float, mm_per_px: float) -> None:
    """Only its rim is seen, and its height, size and centre are found together: the fit must go on until they are."""
    rod = {"diameter_mm": diameter_mm, "mm_per_px": mm_per_px, "contrast": 8000.0}
    own = []
    for seed in range(5):
        image, uv = render_grid(np.random.default_rng(seed), 5, 44, **rod)
        error, covariance = errors(scanned(image, 20.0, 3071.0, np.random.default_rng(50 + seed), rod), uv)
        assert len(error) == len(uv)
        assert np.abs(error).max() < 0.02
        own += np.einsum("ki,kij,kj->k", error, np.linalg.inv(covariance), error).tolist()
    assert np.mean(own) / 2 < 1.2
    assert max(own) < 22.0  # exceeded by one in 60 000


@pytest.mark.parametrize("ceiling", [np.inf, 3071.0])
@pytest.mark.parametrize("diameter_mm", [5.0, 7.0])
def test_a_thick_rod_reaches_the_bound_even_if_only_its_rim_is_seen(diameter_mm: float, ceiling: float) -> None:
    rod = {"diameter_mm": diameter_mm, "contrast": 8000.0, "slope": (0.0, 0.0)}
    squared, own = [], []
    for seed in range(5):
        image, uv = render_grid(np.random.default_rng(seed), 5, 44, **rod)
        error, covariance = errors(scanned(image, 60.0, ceiling, np.random.default_rng(50 + seed), rod), uv)
        assert len(error) == len(uv)
        squared.append((error**2).sum(axis=1))
        own.append(np.einsum("ki,kij,kj->k", error, np.linalg.inv(covariance), error) / 2)
    assert np.sqrt(np.concatenate(squared).mean()) < 1.15 * np.sqrt(np.trace(cramer_rao(60.0, ceiling, **rod)))
    assert 0.7 < np.concatenate(own).mean() < 1.2  # images of whole numbers are seen 0.3 units worse than they are


@pytest.mark.parametrize("ceiling", [np.inf, 3071.0])
def test_a_neighbour_four_pixels_away_is_another_spot_and_widens_both(ceiling: float) -> None:
    rng = np.random.default_rng(5)
    for angle in rng.uniform(0, np.pi, 8):
        first = np.array([35.0, 35.0]) + rng.uniform(-0.5, 0.5, 2)
        second = first + 4.2 * np.array([np.cos(angle), np.sin(angle)])
        alone = render_rod((71, 71), tuple(first), contrast=9000.0)
        both = alone + render_rod((71, 71), tuple(second), contrast=9000.0)
        noise = rng.normal(0.0, 20.0, both.shape)
        pair = find_spots(as_slice(np.minimum(both + noise, ceiling)))
        error, covariance = errors(pair, np.stack([first, second]))
        assert len(error) == 2
        assert np.abs(error).max() < 0.15
        assert np.sqrt(((error**2) / np.diagonal(covariance, axis1=1, axis2=2)).max()) < 3.0
        single = find_spots(as_slice(np.minimum(alone + noise, ceiling)))
        assert (np.trace(covariance, axis1=1, axis2=2) > 4 * np.trace(single.covariance_px[0])).all()


@pytest.mark.parametrize("ratio", [1.0, 0.7])
@pytest.mark.parametrize("distance_px", [3.0, 3.4])
def test_two_rods_that_run_into_one_spot_are_not_taken_for_a_sure_one(distance_px: float, ratio: float) -> None:
    rng = np.random.default_rng(8)
    for angle in rng.uniform(0, np.pi, 8):
        middle = np.array([35.0, 35.0]) + rng.uniform(-0.5, 0.5, 2)
        half = 0.5 * distance_px * np.array([np.cos(angle), np.sin(angle)])
        rods = np.stack([middle - half, middle + half])
        image = render_rod((71, 71), tuple(rods[0])) + ratio * render_rod((71, 71), tuple(rods[1]))
        spots = find_spots(as_slice(image + rng.normal(0.0, image.max() / 50, image.shape)))
        assert len(spots) in (1, 2)
        for uv, covariance in zip(spots.uv_px, spots.covariance_px, strict=True):
            error = rods - uv
            own = np.einsum("ki,ij,kj->k", error, np.linalg.inv(covariance), error) / 2
            of_one = np.linalg.norm(error, axis=1).min() < 0.35 * distance_px
            assert (own.min() if of_one else own.max()) < 3.0**2  # in the middle it may be taken for either


@pytest.mark.parametrize("tilt", [0.6, 1.0, 1.4])
def test_a_tilted_rod_in_a_thick_slab_is_not_taken_for_two(tilt: float) -> None:
    rod = {"thickness_mm": 5.0, "slope": (0.8 * tilt, 0.6 * tilt), "contrast": 9000.0}
    image, uv = render_grid(np.random.default_rng(9), SIDE, PITCH, **rod)
    _, covariance = errors(scanned(image, image.max() / 50, np.inf, np.random.default_rng(10), rod), uv)
    bound = cramer_rao(image.max() / 50, **rod)
    assert np.percentile(np.trace(covariance, axis1=1, axis2=2), 90) < 2.0 * np.trace(bound)


@pytest.mark.parametrize(("contrast", "undershoot"), [(6000.0, 1.0), (12000.0, 1.0), (12000.0, 1.5)])
def test_a_sharp_kernel_s_undershoot_about_a_clipped_spot_is_not_believed_to_fit(
    contrast: float, undershoot: float
) -> None:
    """The profile has no undershoot; where only the flank of a spot is seen that moves the centre a little."""
    own = []
    for seed in range(4):
        image, uv = render_grid(np.random.default_rng(seed), SIDE, PITCH, contrast=contrast, blur_mm=0.35)
        sharp = image + undershoot * (image - gaussian_filter(image, 1.2))
        spots = scanned(sharp, 40.0, 3071.0, np.random.default_rng(60 + seed), {})
        error, covariance = errors(spots, uv)
        assert np.abs(error).max() < 0.2
        own.append(np.einsum("ki,kij,kj->k", error, np.linalg.inv(covariance), error) / 2)
    assert np.concatenate(own).mean() < 1.7


@pytest.mark.parametrize("n_cut", [1, 2])
def test_a_spot_with_one_pixel_cut_off_is_fitted_without_it(n_cut: int) -> None:
    """The few brightest pixels lowered to the ceiling say that they were at least so bright, and nothing more."""
    image, uv = render_grid(np.random.default_rng(11), 2, PITCH, contrast=3000.0, blur_mm=0.3)
    whole = image + np.random.default_rng(12).normal(0.0, 3.0, image.shape)
    cut = np.minimum(whole, np.sort(whole.ravel())[-n_cut] - 400.0)
    error, _ = errors(find_spots(as_slice(cut)), uv)
    assert len(error) == 4
    assert np.abs(error).max() < 0.03


def test_a_streak_through_a_spot_widens_it() -> None:
    rng = np.random.default_rng(6)
    row, column = np.mgrid[:71, :71]
    scaled, widened = [], []
    for _ in range(30):
        uv = np.array([35.0, 35.0]) + rng.uniform(-0.5, 0.5, 2)
        angle, offset = rng.uniform(0, np.pi), rng.uniform(-3, 3)
        across = (column - uv[0]) * np.sin(angle) - (row - uv[1]) * np.cos(angle) - offset
        clean = render_rod((71, 71), tuple(uv), contrast=9000.0) + rng.normal(0.0, 20.0, (71, 71))
        streak = find_spots(as_slice(np.minimum(clean + 400 * np.exp(-0.5 * (across / 1.5) ** 2), 3071)))
        alone = find_spots(as_slice(np.minimum(clean, 3071)))
        error, covariance = errors(streak, uv[None])
        widened.append(np.trace(covariance[0]) / np.trace(alone.covariance_px[0]))
        scaled.append(error[0] / np.sqrt(np.diag(covariance[0])))
    assert np.median(widened) > 4.0  # a streak through the very middle moves nothing
    assert np.sqrt(np.mean(np.square(scaled))) < 2.0


@pytest.mark.parametrize("depth", [30.0, 100.0, 200.0])
@pytest.mark.parametrize("ceiling", [np.inf, 4095.0])
def test_dark_streaks_that_air_at_the_floor_hides_are_owned_up_to(depth: float, ceiling: float) -> None:
    """From every rod three go out into air that stands 24 above the image's least value: there they are cut off."""
    rng = np.random.default_rng(6)
    image, uv = render_grid(rng, SIDE, PITCH, contrast=6000.0)
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    for centre in uv:
        for angle in rng.uniform(0, 2 * np.pi, 3):
            x, y = u - centre[0], v - centre[1]
            along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
            shape = np.exp(-0.5 * (across / 1.5) ** 2 - np.maximum(along, -3.0 * along) / 12.0)
            image -= depth * shape * (np.hypot(x, y) < PITCH / 2)
    own = []
    for _ in range(3):
        noisy = np.clip(image + 24.0 + rng.normal(0.0, 15.0, image.shape), 0.0, ceiling)
        error, covariance = errors(find_spots(as_slice(noisy)), uv)
        own.append(np.einsum("ki,kij,kj->k", error, np.linalg.inv(covariance), error) / 2)
    assert np.concatenate(own).mean() < 1.5


@pytest.mark.parametrize("blur_px", [0.5, 1.0])
def test_a_smooth_kernel_s_noise_is_not_taken_for_white(blur_px: float) -> None:
    """Neighbours' noise goes together; the centre then scatters more than white noise of the same sd would make it."""
    image, uv = rendered("thin rod")
    rng = np.random.default_rng(7)
    squared = []
    for _ in range(8):
        noise = gaussian_filter(rng.normal(0.0, 1.0, image.shape), blur_px, mode="wrap")
        spots = find_spots(as_slice(image + 60.0 * noise / noise.std()))
        error, covariance = errors(spots, uv)
        squared.append(np.einsum("ki,kij,kj->k", error, np.linalg.inv(covariance), error) / 2)
    assert 0.75 < np.concatenate(squared).mean() < 1.25


@pytest.mark.parametrize("length_px", [2.0, 3.0])
def test_tissue_s_texture_about_a_dark_spot_is_owned_up_to(length_px: float) -> None:
    """White noise hides from the Laplacian that the background is uneven over a few pixels."""
    image, uv = render_grid(np.random.default_rng(13), 5, 40, contrast=800.0, diameter_mm=2.0, blur_mm=0.4)
    rng, own = np.random.default_rng(14), []
    for _ in range(6):
        texture = gaussian_filter(rng.normal(0.0, 1.0, image.shape), length_px, mode="wrap")
        noisy = 1200.0 - image + rng.normal(0.0, 20.0, image.shape) + 60.0 * texture / texture.std()
        spots = find_spots(as_slice(noisy), SegmentationOptions(polarity="dark"))
        error, covariance = errors(spots, uv)
        own.append(np.einsum("ki,kij,kj->k", error, np.linalg.inv(covariance), error) / 2)
    assert 0.6 < np.concatenate(own).mean() < 1.5


@pytest.mark.parametrize("case", ["air at the floor", "air beneath it", "soft kernel", "a PNG's black"])
def test_where_the_surroundings_are_cut_off_below_noise_is_not_taken_for_none(case: str) -> None:
    """Air at the least value that the image can hold shows no noise: the spot has it all the same.

    White noise is taken to be worse than it is, since nothing tells that neighbours share none of it.
    """
    rng, chi2 = np.random.default_rng([47, len(case)]), []
    for _ in range(2):
        image, uv = render_grid(rng, 6, 30, contrast=2500.0, mm_per_px=1.0 if case == "a PNG's black" else 0.5)
        field = rng.normal(0.0, 1.0, image.shape)
        if case == "soft kernel":
            field = gaussian_filter(field, 0.6)
        beneath = 60.0 if case == "air beneath it" else 25.0
        values = np.maximum(image - beneath + 20.0 * field / field.std(), 0.0)
        slice_ = as_slice(values / 10.0, dtype=np.uint8) if case == "a PNG's black" else as_slice(values)
        found = find_spots(slice_)
        nearest = np.linalg.norm(found.uv_px[:, None] - uv, axis=2).argmin(axis=0)
        error = found.uv_px[nearest] - uv
        assert np.abs(error).max() < 1.0
        chi2.append(np.einsum("ki,kij,kj->k", error, np.linalg.inv(found.covariance_px[nearest]), error) / 2)
    assert (0.15 if case == "air beneath it" else 0.25) < np.mean(chi2) < 2.0
