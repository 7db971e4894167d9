"""Every rod is found, whatever the scanner's numbers look like; what is no rod is named."""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import pydicom
import pytest
from scipy.ndimage import gaussian_filter

from ctreg_cli.imaging.segmentation import DEFAULT_OPTIONS, SegmentationOptions, find_spots, measure_spots
from ctreg_cli.imaging.slice import Slice, SliceInfo
from ctreg_cli.pipeline import expecting
from ctreg_cli.rods import Rod, RodModel
from ctreg_cli.scale import Scale
from tests.imaging.rendering import as_slice, render_grid, render_rod

SAMPLES = Path(__file__).parents[2] / "sample_data"
SHAPE = (128, 160)
UV = np.array([[30.3, 40.2], [80.7, 60.1], [120.2, 100.9]])


@pytest.fixture(scope="module")
def image() -> np.ndarray:
    rods = sum(render_rod(SHAPE, (u, v)) for u, v in UV)
    return np.clip(rods + 50.0 + np.random.default_rng(0).normal(0.0, 15.0, SHAPE), -1024, 3071)


def centres(slice_: Slice, options: SegmentationOptions = DEFAULT_OPTIONS) -> np.ndarray:
    """Centres found, in reading order of u."""
    uv = find_spots(slice_, options).uv_px
    return uv[np.argsort(uv[:, 0])]


# -------------------------------------------------------------------------------------------- simulated CT with truth


def cube_slices() -> Iterator[tuple[Slice, np.ndarray]]:
    for truth_file in sorted(SAMPLES.glob("*/truth.json")):
        for truth in json.loads(truth_file.read_text()):
            dataset = pydicom.dcmread(truth_file.parent / truth["file"])
            row_mm, column_mm = (float(x) for x in dataset.PixelSpacing)
            info = SliceInfo(
                source=truth["file"],
                scale=Scale.from_pixel_spacing(row_mm, column_mm),
                thickness_mm=float(dataset.SliceThickness),
            )
            slice_ = Slice(
                info=info,
                stored=dataset.pixel_array,
                slope=float(dataset.RescaleSlope),
                intercept=float(dataset.RescaleIntercept),
            )
            yield slice_, np.array([[s["u_px"], s["v_px"]] for s in truth["spots"]])


def test_every_rod_of_the_simulated_ct_is_found_at_a_twentieth_of_a_pixel_with_a_true_sd() -> None:
    error, scaled = [], []
    for slice_, uv in cube_slices():
        spots = find_spots(slice_)
        assert len(spots) <= 12
        nearest = np.linalg.norm(spots.uv_px[:, None] - uv, axis=2).argmin(axis=0)
        assert sorted(nearest) == list(range(len(uv)))  # the rods come first, whatever else there is
        difference = spots.uv_px[nearest] - uv
        error.append(difference)
        scaled.append(difference / spots.sd_px[nearest])
        tracked = measure_spots(slice_, uv + 1.0, 5.0)
        again = np.linalg.norm(tracked.uv_px[:, None] - uv, axis=2).argmin(axis=0)
        np.testing.assert_allclose(tracked.uv_px[again], spots.uv_px[nearest], atol=1e-3)
    assert len(error) == 20
    assert (np.sqrt((np.concatenate(error) ** 2).mean(axis=0)) < 0.05).all()
    assert np.abs(np.concatenate(error)).max() < 0.2
    assert 0.7 < np.sqrt((np.concatenate(scaled) ** 2).mean()) < 1.2


# ----------------------------------------------------------------------------------------------- whatever the numbers


def test_the_same_picture_in_other_numbers_gives_the_same_centres(image: np.ndarray) -> None:
    stored = np.rint(image).astype(np.int16)
    expected = centres(as_slice(image))
    np.testing.assert_allclose(expected, UV, atol=0.05)
    others = [
        as_slice(image + 1024, dtype=np.uint16, intercept=-1024.0),
        as_slice(stored, dtype=np.int32),
        as_slice(stored, dtype=np.float64),
        as_slice(2 * stored.astype(int), dtype=np.int32, slope=0.5),
        as_slice(-stored.astype(int), slope=-1.0),
        Slice(info=as_slice(image).info, stored=stored.astype(">i2")),
        Slice(info=as_slice(image).info, stored=np.asfortranarray(stored)),
    ]
    for other in others:
        np.testing.assert_allclose(centres(other), expected, atol=1e-6)
    np.testing.assert_allclose(centres(as_slice(image / 16 + 30, dtype=np.uint8)), expected, atol=0.03)


@pytest.mark.parametrize(("factor", "offset"), [(1e-6, 0.0), (1 / 4095, 0.25), (1e6, -3e8), (1e-200, 0.0)])
def test_floating_point_pixels_may_have_any_range(image: np.ndarray, factor: float, offset: float) -> None:
    expected = find_spots(as_slice(np.rint(image)))
    spots = find_spots(as_slice(np.rint(image) * factor + offset, dtype=np.float64))
    assert len(spots) == 3
    np.testing.assert_allclose(spots.uv_px, expected.uv_px, atol=1e-3)
    np.testing.assert_allclose(spots.contrast, expected.contrast * factor, rtol=1e-6)
    np.testing.assert_allclose(spots.covariance_px, expected.covariance_px, rtol=0.05)
    measured = measure_spots(as_slice(np.rint(image) * factor + offset, dtype=np.float64), UV, 4.0)
    assert np.linalg.norm(measured.uv_px[:, None] - expected.uv_px, axis=2).min(axis=0).max() < 1e-3


@pytest.mark.parametrize("nothing", [np.nan, np.inf, -np.inf])
def test_pixels_that_are_no_numbers_are_no_image(image: np.ndarray, nothing: float) -> None:
    values = np.rint(image)
    values[:20] = values[20:25, 20:24] = nothing
    spots = find_spots(as_slice(values, dtype=np.float64))
    np.testing.assert_allclose(spots.uv_px, find_spots(as_slice(image)).uv_px, atol=1e-3)
    assert np.isfinite(spots.covariance_px).all()


def test_contrast_is_in_the_units_of_the_image(image: np.ndarray) -> None:
    hounsfield = find_spots(as_slice(image + 1024, intercept=-1024.0)).contrast
    doubled = find_spots(as_slice(image + 1024, slope=2.0)).contrast
    np.testing.assert_allclose(doubled, 2 * hounsfield)


def test_dark_spots_are_found_when_asked_for_and_by_auto(image: np.ndarray) -> None:
    expected = centres(as_slice(image))
    inverted = as_slice(1000 - np.rint(image))
    np.testing.assert_allclose(centres(inverted, SegmentationOptions(polarity="dark")), expected, atol=1e-6)
    np.testing.assert_allclose(centres(inverted, SegmentationOptions(polarity="auto")), expected, atol=1e-6)
    np.testing.assert_allclose(centres(as_slice(image), SegmentationOptions(polarity="auto")), expected, atol=1e-6)
    assert len(measure_spots(inverted, UV, 4.0, SegmentationOptions(polarity="auto"))) == 3
    assert not len(find_spots(inverted))


def test_shifting_the_picture_shifts_and_turning_it_turns_the_centres(image: np.ndarray) -> None:
    expected = centres(as_slice(image))
    shifted = np.pad(image, ((5, 0), (7, 0)), mode="reflect")
    np.testing.assert_allclose(centres(as_slice(shifted)), expected + np.array([7, 5]), atol=1e-6)
    turned = find_spots(as_slice(image.T)).uv_px
    np.testing.assert_allclose(turned[np.argsort(turned[:, 1])], expected[:, ::-1], atol=2e-3)


def test_without_scale_and_thickness_the_rods_are_found_too(image: np.ndarray) -> None:
    np.testing.assert_allclose(centres(as_slice(image, mm_per_px=None, thickness_mm=None)), UV, atol=0.05)


@pytest.mark.parametrize("padding", [-3024, 3571])
def test_padding_is_neither_metal_nor_an_edge(image: np.ndarray, padding: int) -> None:
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]]
    outside = np.hypot(row - 64, column - 80) > 62
    padded = np.where(outside, padding, np.rint(image))
    spots = find_spots(as_slice(padded, padding=(padding, padding)))
    np.testing.assert_allclose(np.sort(spots.uv_px, axis=0), np.sort(centres(as_slice(image)), axis=0), atol=1e-3)


def test_a_long_tilted_spot_in_a_thick_slab_is_one_spot() -> None:
    rod = {"thickness_mm": 8.0, "slope": (0.9, 0.3), "contrast": 15000.0}
    values = np.minimum(render_rod((96, 96), (48.3, 47.6), **rod), 3071) + np.random.default_rng(1).normal(
        0, 20, (96, 96)
    )
    spots = find_spots(as_slice(values, thickness_mm=8.0))
    assert len(spots) == 1
    np.testing.assert_allclose(spots.uv_px[0], [48.3, 47.6], atol=0.05)
    assert spots.major_px[0] > 3 * spots.minor_px[0]
    assert np.tan(spots.angle_rad[0]) == pytest.approx(1 / 3, abs=0.05)


def test_any_peak_of_a_long_spot_leads_to_the_same_centre() -> None:
    rod = {"thickness_mm": 8.0, "slope": (0.9, 0.3), "contrast": 9000.0}
    values = render_rod((96, 96), (48.3, 47.6), **rod) + np.random.default_rng(1).normal(0, 20, (96, 96))
    slice_ = as_slice(values, thickness_mm=8.0)
    expected = find_spots(slice_).uv_px
    for along in (-5.0, -2.0, 2.0, 5.0):
        measured = measure_spots(slice_, expected + along * np.array([[0.9, 0.3]]), 6.0)
        np.testing.assert_allclose(measured.uv_px, expected, atol=1e-3)


def test_a_faint_rod_beside_bright_ones_stays(image: np.ndarray) -> None:
    faint = image + render_rod(SHAPE, (60.0, 20.0), contrast=1200.0)
    assert np.linalg.norm(find_spots(as_slice(faint)).uv_px - [60.0, 20.0], axis=1).min() < 0.2


# ----------------------------------------------------------------------------------------------------- what is no rod


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        (lambda row, column: 2000.0 * (np.hypot(row - 64, column - 80) < 10), "too_large"),
        (lambda row, column: 2000.0 * ((np.abs(row - 64) < 2) & (np.abs(column - 80) < 60)), "too_large"),
        (lambda row, column: 2000.0 * ((np.abs(row - 64) < 2) & (np.abs(column - 80) < 14)), "too_elongated"),
        (lambda row, column: render_rod(SHAPE, (1.3, 64.0)), "at_border"),
    ],
)
def test_what_is_no_rod_is_left_out_with_the_reason(values: object, reason: str) -> None:
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]]
    noise = np.random.default_rng(2).normal(0.0, 15.0, SHAPE)
    spots = find_spots(as_slice(values(row, column) + noise, thickness_mm=0.5))  # type: ignore[operator]
    assert not len(spots)
    assert reason in {r.reason for r in spots.rejected}


@pytest.mark.parametrize("radius_px", [13, 20, 60])
def test_what_is_far_too_large_is_named_once(radius_px: int) -> None:
    row, column = np.mgrid[:160, :160]
    body = 2000.0 * (np.hypot(row - 80, column - 76) < radius_px) + np.random.default_rng(2).normal(
        0.0, 15.0, (160, 160)
    )
    spots = find_spots(as_slice(body + render_rod((160, 160), (9.3, 9.2))))
    np.testing.assert_allclose(spots.uv_px, [[9.3, 9.2]], atol=0.05)
    (rejected,) = spots.rejected
    assert rejected.reason == "too_large"
    assert np.hypot(rejected.u_px - 76, rejected.v_px - 80) < 4.0


@pytest.mark.parametrize(("diameter_mm", "mm_per_px"), [(3.0, 0.3), (4.0, 0.5), (4.0, 0.35), (5.0, 0.8)])
def test_thick_rods_with_flat_tops_are_all_found_and_well(diameter_mm: float, mm_per_px: float) -> None:
    """No diameter is given; the first pixel of a flat top lies a radius from its middle."""
    rod = {"slope": (0.3, 0.1), "blur_mm": 0.3, "diameter_mm": diameter_mm, "mm_per_px": mm_per_px}
    image, uv = render_grid(np.random.default_rng(4), 5, int(34 + 8 / mm_per_px), contrast=8000.0, **rod)
    noise = np.random.default_rng(5).normal(0.0, 10.0, image.shape)
    spots = find_spots(as_slice(np.minimum(image + noise, 3071), mm_per_px=mm_per_px))
    distance = np.linalg.norm(spots.uv_px[:, None] - uv, axis=2).min(axis=0)
    assert distance.max() < 0.03


@pytest.mark.parametrize("ceiling", [np.inf, 3071.0])
@pytest.mark.parametrize(("diameter_mm", "mm_per_px"), [(4.0, 0.3), (8.0, 0.3), (5.5, 0.5), (8.0, 0.5), (7.0, 0.8)])
def test_rods_thicker_than_usual_are_found_if_nothing_stands_out_more(
    diameter_mm: float, mm_per_px: float, ceiling: float
) -> None:
    """No diameter is given; the smallest windows lie within such a rod, and show nothing."""
    rod = {"blur_mm": 0.4, "diameter_mm": diameter_mm, "mm_per_px": mm_per_px, "contrast": 5000.0}
    image, uv = render_grid(np.random.default_rng(6), 3, int(34 + 8 / mm_per_px), **rod)
    noisy = np.minimum(image + np.random.default_rng(7).normal(0.0, 10.0, image.shape), ceiling)
    slice_ = as_slice(noisy, mm_per_px=mm_per_px)
    spots = find_spots(slice_)
    assert len(spots) == len(uv)
    assert not spots.rejected
    assert np.linalg.norm(spots.uv_px[:, None] - uv, axis=2).min(axis=0).max() < 0.03
    measured = measure_spots(slice_, spots.uv_px + np.random.default_rng(8).uniform(-2, 2, spots.uv_px.shape), 5.0)
    nearest = np.linalg.norm(measured.uv_px[:, None] - spots.uv_px, axis=2).argmin(axis=0)
    assert (np.abs(measured.uv_px[nearest] - spots.uv_px) < spots.sd_px).all()  # windows may differ by a pixel


def test_what_is_thick_and_fainter_than_the_rods_is_left_out(image: np.ndarray) -> None:
    """As bones are beside metal; where the rods' diameter is known it is left out however strong it is."""
    values = image + render_rod(SHAPE, (60.0, 100.0), diameter_mm=8.0, contrast=600.0)
    spots = find_spots(as_slice(values))
    np.testing.assert_allclose(spots.uv_px[np.argsort(spots.uv_px[:, 0])], UV, atol=0.05)
    assert {r.reason for r in spots.rejected} == {"too_large"}
    strong = as_slice(image + render_rod(SHAPE, (60.0, 100.0), diameter_mm=8.0, contrast=3000.0))
    assert len(find_spots(strong)) == 4
    assert len(find_spots(strong, SegmentationOptions(rod_diameter_mm=(1.0, 2.0)))) == 3


@pytest.mark.parametrize("blur_px", [0.7, 1.0, 1.5])
def test_a_smooth_kernel_s_noise_makes_few_spots_and_hides_no_rod(blur_px: float) -> None:
    """CT fluoroscopy: neighbours' noise goes together, and its peaks look like faint spots."""
    n_false = []
    for seed in range(5):
        noise = gaussian_filter(np.random.default_rng(seed).normal(0.0, 1.0, (256, 256)), blur_px)
        rods = sum(render_rod((256, 256), (3 * u / 2, 2 * v)) for u, v in UV)
        spots = find_spots(as_slice(rods + 80.0 * noise / noise.std()))
        error = np.linalg.norm(spots.uv_px[:, None] - UV * (1.5, 2.0), axis=2)
        assert (error.argmin(axis=0) < 3).all()  # the rods come first
        assert error.min(axis=0).max() < 1.0
        n_false.append(len(spots) - 3)
    assert np.mean(n_false) < 0.5 * (DEFAULT_OPTIONS.max_spots - 3)  # judged pixel by pixel they fill all places


def test_all_that_is_left_out_is_counted_even_where_not_all_is_listed() -> None:
    noise = gaussian_filter(np.random.default_rng(9).normal(0.0, 1.0, (400, 400)), 1.5)
    spots = find_spots(as_slice(1000.0 + 200.0 * noise / noise.std()))
    assert sum(spots.n_rejected.values()) > len(spots.rejected) > 80
    assert set(spots.n_rejected) >= {r.reason for r in spots.rejected}
    row, column = np.mgrid[:400, :400]
    body = np.where(np.hypot(row - 200, column - 190) < 40, 3071.0, 1000.0 + 200.0 * noise / noise.std())
    large = find_spots(as_slice(body)).rejected
    assert min(np.hypot(r.u_px - 190, r.v_px - 200) for r in large) < 4.0  # what one sees first is listed first
    few = find_spots(as_slice(render_rod((96, 96), (1.3, 64.0))))
    assert few.n_rejected == {"at_border": 1}


def test_a_bone_within_a_body_is_named_too() -> None:
    """The body stands out of the air; the bone out of the body only, and has no peak of its own."""
    row, column = np.mgrid[:160, :160]
    values = np.where(np.hypot(row - 80, column - 76) < 70, 40.0, -1000.0)
    values[np.hypot(row - 100, column - 80) < 12] = 900.0
    values += render_rod((160, 160), (30.3, 60.2)) + np.random.default_rng(2).normal(0.0, 5.0, (160, 160))
    spots = find_spots(as_slice(np.minimum(values, 3071)))
    np.testing.assert_allclose(spots.uv_px[0], [30.3, 60.2], atol=0.05)
    large = [np.hypot(r.u_px - 80, r.v_px - 100) for r in spots.rejected if r.reason == "too_large"]
    assert min(large) < 12


def test_the_best_spots_are_kept_when_there_are_too_many(image: np.ndarray) -> None:
    weak = image + render_rod(SHAPE, (60.0, 20.0), contrast=1500.0)
    spots = find_spots(as_slice(weak), SegmentationOptions(max_spots=3))
    np.testing.assert_allclose(spots.uv_px[np.argsort(spots.uv_px[:, 0])], UV, atol=0.05)
    assert [r.reason for r in spots.rejected] == ["too_many"]


@pytest.mark.parametrize("dtype", [np.int16, np.uint8, np.float64])
def test_noise_alone_has_no_spots(dtype: type) -> None:
    noise = np.random.default_rng(3).normal(100.0, 20.0, (256, 256))
    assert not len(find_spots(as_slice(noise, dtype=dtype)))


@pytest.mark.parametrize("shape", [(1, 1), (2, 3), (1, 60), (5, 5), (17, 33)])
def test_a_picture_too_small_or_empty_has_no_spots_and_no_error(shape: tuple[int, int]) -> None:
    assert not len(find_spots(as_slice(np.zeros(shape))))
    assert not len(find_spots(as_slice(np.full(shape, -2000), padding=(-2000, -2000))))
    assert not len(find_spots(as_slice(np.full(shape, np.nan), dtype=np.float64)))
    assert not len(measure_spots(as_slice(np.zeros(shape)), np.zeros((1, 2)), 3.0))


# ------------------------------------------------------------------------------------------------------ tracking path


def test_measuring_about_predictions_gives_what_searching_the_slice_gives(image: np.ndarray) -> None:
    slice_ = as_slice(image)
    found = find_spots(slice_)
    rng = np.random.default_rng(4)
    for _ in range(10):
        measured = measure_spots(slice_, found.uv_px + rng.uniform(-3, 3, (3, 2)), np.array([5.0, 6.0, 7.0]))
        nearest = np.linalg.norm(measured.uv_px[:, None] - found.uv_px, axis=2).argmin(axis=0)
        np.testing.assert_allclose(measured.uv_px[nearest], found.uv_px, atol=1e-3)
        np.testing.assert_allclose(measured.covariance_px[nearest], found.covariance_px, rtol=0.05)


def test_tracking_the_simulated_ct_gives_spots_and_covariances_of_the_whole_slice() -> None:
    rng = np.random.default_rng(5)
    for slice_, _ in islice(cube_slices(), 5):
        found = find_spots(slice_)
        measured = measure_spots(slice_, found.uv_px + rng.uniform(-2, 2, found.uv_px.shape), 4.0)
        nearest = np.linalg.norm(measured.uv_px[:, None] - found.uv_px, axis=2).argmin(axis=0)
        np.testing.assert_allclose(measured.uv_px[nearest], found.uv_px, atol=1e-6)
        np.testing.assert_allclose(measured.covariance_px[nearest], found.covariance_px, rtol=0.05, atol=1e-9)


@pytest.mark.parametrize(
    "neighbour", [{"uv": (84.5, 62.0), "contrast": 4000.0}, {"uv": (80.7, 67.0), "contrast": 2500.0}]
)
def test_a_neighbour_in_the_window_is_measured_as_in_the_whole_slice(
    image: np.ndarray, neighbour: dict[str, object]
) -> None:
    slice_ = as_slice(np.clip(image + render_rod(SHAPE, **neighbour), -1024, 3071))  # type: ignore[arg-type]
    found = find_spots(slice_)
    measured = measure_spots(slice_, UV, 9.0)
    assert len(measured) == len(found) == 4
    nearest = np.linalg.norm(measured.uv_px[:, None] - found.uv_px, axis=2).argmin(axis=0)
    np.testing.assert_allclose(measured.uv_px[nearest], found.uv_px, atol=1e-6)
    np.testing.assert_allclose(measured.covariance_px[nearest], found.covariance_px, rtol=0.05, atol=1e-9)


def test_a_spot_near_two_predictions_is_measured_once_and_nothing_where_nothing_is(image: np.ndarray) -> None:
    slice_ = as_slice(image)
    assert len(measure_spots(slice_, np.array([[30.0, 40.0], [32.0, 41.0]]), 5.0)) == 1
    nowhere = np.array([[60.0, 20.0], [-40.0, 900.0], [np.nan, 3.0], [159.0, 127.0]])
    assert not len(measure_spots(slice_, nowhere, 5.0))
    assert not len(measure_spots(slice_, np.empty((0, 2)), np.empty(0)))


def test_only_spots_within_the_radius_are_returned(image: np.ndarray) -> None:
    slice_ = as_slice(image)
    assert len(measure_spots(slice_, UV[:1] + np.array([4.0, 0.0]), 5.0)) == 1
    assert not len(measure_spots(slice_, UV[:1] + np.array([4.0, 0.0]), 3.0))


def test_the_rods_of_the_model_say_how_thick_a_spot_may_be() -> None:
    def model(*diameters_mm: float | None) -> RodModel:
        rods = [
            Rod(id=f"r{i}", start=np.array([10.0 * i, i * i, 0]), end=np.array([9.0 * i, 0, 50]), diameter_mm=d)
            for i, d in enumerate(diameters_mm)
        ]
        return RodModel(name="three", rods=tuple(rods))

    assert expecting(model(1.0, 2.0, 1.5), None).rod_diameter_mm == (1.0, 2.0)
    assert expecting(model(1.0, None, 1.5), None).rod_diameter_mm is None
    given = SegmentationOptions(rod_diameter_mm=(3.0, 4.0))
    assert expecting(model(1.0, 2.0, 1.5), given) is given


@pytest.mark.parametrize("radius_px", [2.0, 3.0, 4.0, 6.0])
def test_of_a_mask_all_spots_are_found_and_their_covariance_is_that_of_its_rim(radius_px: float) -> None:
    """Pixels that only say in or out: centres are known to 1 / (12 π r) px², and nothing is taken for noise."""
    rng = np.random.default_rng([41, int(radius_px)])
    row, column = np.mgrid[:160, :160]
    squares = []
    for _ in range(12):
        uv = np.array([(30.0 + 45 * i, 30.0 + 45 * j) for i in range(3) for j in range(3)]) + rng.uniform(-3, 3, (9, 2))
        inside = (np.hypot(column - uv[:, :1, None], row - uv[:, 1:, None]) < radius_px).any(axis=0)
        spots = find_spots(Slice(info=SliceInfo(source="mask.png"), stored=np.where(inside, 255, 0).astype(np.uint8)))
        assert len(spots) == len(uv)
        nearest = np.linalg.norm(spots.uv_px[:, None] - uv, axis=2).argmin(axis=0)
        error = spots.uv_px[nearest] - uv
        squares.append(np.einsum("ki,kij,kj->k", error, np.linalg.inv(spots.covariance_px[nearest]), error) / 2)
    assert 0.7 < np.mean(squares) < 1.35
