"""Following a spot by one step is as good as fitting it in full, and is given up for that where anything is odd."""

from __future__ import annotations

import pickle
from collections.abc import Iterator

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from ctreg_cli.imaging import follow
from ctreg_cli.imaging.blob import axes_of, ellipse, inverse_elements, moments_of, monomials
from ctreg_cli.imaging.follow import LAW_EVERY, MAX_AGE, Follower
from ctreg_cli.imaging.segmentation import DEFAULT_OPTIONS, SegmentationOptions, measure_spots
from ctreg_cli.imaging.slice import Slice
from ctreg_cli.imaging.spots import Spots
from tests.imaging.rendering import as_slice, cramer_rao, render_grid, render_rod

SIDE, PITCH, N_SLICES = 6, 34, 14
RODS = np.arange(SIDE * SIDE)
RADIUS_PX = np.full(len(RODS), 4.0)

#: rod; noise sd; value at which the scanner clips; blur of the noise, px
CASES: dict[str, tuple[dict[str, object], float, float, float]] = {
    "thin rod": ({"contrast": 3000.0}, 40.0, np.inf, 0.0),
    "thick rod": ({"diameter_mm": 2.0, "mm_per_px": 0.4, "contrast": 2500.0}, 100.0, np.inf, 0.0),
    "clipped": ({"contrast": 11000.0, "slope": (0.3, 0.1)}, 150.0, 3071.0, 0.0),
    "smooth kernel": ({"contrast": 3000.0}, 40.0, np.inf, 0.8),
}


def moving(case: str, rng: np.random.Generator, n: int = N_SLICES) -> Iterator[tuple[Slice, np.ndarray, np.ndarray]]:
    """Slices in which all rods have moved within their pixels; true centres, and where they are expected, roughly."""
    rod, noise, ceiling, blur_px = CASES[case]
    for _ in range(n):
        image, uv = render_grid(rng, SIDE, PITCH, **rod)
        field = rng.normal(0.0, 1.0, image.shape)
        field = gaussian_filter(field, blur_px, mode="wrap") if blur_px else field
        slice_ = as_slice(
            np.minimum(image + 40.0 + noise * field / field.std(), ceiling),
            mm_per_px=rod.get("mm_per_px", 0.5),  # type: ignore[arg-type]
        )
        yield slice_, uv, uv + rng.normal(0.0, 0.7, uv.shape)


def in_full(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """From now on, how many predictions were measured in full, a number each time."""
    counts: list[int] = []

    def counted(slice_: Slice, uv: np.ndarray, radius: np.ndarray, options: SegmentationOptions) -> Spots:
        counts.append(len(uv))
        return measure_spots(slice_, uv, radius, options)

    monkeypatch.setattr(follow, "measure_spots", counted)
    return counts


def matched(spots: Spots, uv: np.ndarray) -> Spots:
    """The spot nearest to each place."""
    return spots.take(np.linalg.norm(spots.uv_px[:, None] - uv, axis=2).argmin(axis=0))


def in_own_variances(spots: Spots, uv: np.ndarray) -> float:
    """Mean squared error a coordinate of the spots nearest to true places."""
    error = spots.uv_px - uv
    return float(np.einsum("ki,kij,kj->k", error, np.linalg.inv(spots.covariance_px), error).mean() / 2)


@pytest.mark.parametrize("seed", range(4))
def test_one_ellipse_is_that_of_many(seed: int) -> None:
    rng = np.random.default_rng(seed)
    terms, shares = monomials(5), np.array([0.0, 0.01, 0.3, 0.9, 1.0])
    own = rng.random((5, len(terms))) < shares[:, None]
    middle, moments = moments_of(own.reshape(-1, 11, 11), 5)
    expected = np.array([*middle.T, *inverse_elements(4.0 * moments), *axes_of(moments)])
    one_by_one = np.transpose([ellipse(*sums) for sums in (own.astype(float) @ terms).tolist()])
    np.testing.assert_allclose(one_by_one, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("case", CASES)
def test_a_step_from_the_last_slice_is_as_good_as_the_full_fit_and_its_covariance_is_true(
    case: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng, counts = np.random.default_rng(7), in_full(monkeypatch)
    follower, errors, full_errors, own, full_own, apart = Follower(), [], [], [], [], []
    for k, (slice_, uv, expected) in enumerate(moving(case, rng)):
        spots = follower.measure(slice_, RODS, expected, RADIUS_PX)
        if k == 0:
            continue
        assert len(spots) == len(uv)
        followed, full = matched(spots, uv), matched(measure_spots(slice_, expected, RADIUS_PX), uv)
        errors.append(followed.uv_px - uv)
        full_errors.append(full.uv_px - uv)
        own.append(in_own_variances(followed, uv))
        full_own.append(in_own_variances(full, uv))
        apart.append((followed.uv_px - full.uv_px) / full.sd_px)
    assert sum(counts) < len(RODS) + 0.05 * N_SLICES * len(RODS)  # the first slice, and hardly anything after it

    def rms(values: list[np.ndarray]) -> float:
        return float(np.sqrt(np.mean(np.square(values))))

    assert rms(errors) < 1.03 * rms(full_errors)
    assert rms(apart) < 0.15
    assert 0.9 < np.mean(own) / np.mean(full_own) < 1.1
    assert 0.65 < np.mean(own) < 1.2
    rod, noise, ceiling, blur_px = CASES[case]
    if not blur_px:
        assert rms(errors) < 1.15 * np.sqrt(np.trace(cramer_rao(noise, ceiling, **rod)) / 2)


def test_where_in_its_pixel_a_rod_lies_does_not_move_the_centre(monkeypatch: pytest.MonkeyPatch) -> None:
    rng, counts, follower = np.random.default_rng(2), in_full(monkeypatch), Follower()
    monkeypatch.setitem(CASES, "thick rod", (CASES["thick rod"][0], 1.0, np.inf, 0.0))
    for slice_, uv, expected in moving("thick rod", rng, 6):
        spots = follower.measure(slice_, RODS, expected, RADIUS_PX)
        assert np.abs(matched(spots, uv).uv_px - uv).max() < 0.01
    assert len(counts) < 3


# ------------------------------------------------------------------------------------------------- one rod, and trouble

SHAPE, UV = (71, 81), np.array([[38.3, 34.6]])
ONE = np.array([0])
ROD = {"contrast": 9000.0, "slope": (0.3, 0.1)}
NOISE = 20.0


def one(rng: np.random.Generator, uv: np.ndarray = UV[0], more: np.ndarray | float = 0.0, **options: object) -> Slice:
    image = render_rod(SHAPE, tuple(uv), **ROD) + more + rng.normal(0.0, NOISE, SHAPE)  # type: ignore[arg-type]
    return as_slice(np.minimum(image, 3071.0), **options)  # type: ignore[arg-type]


def at(u: float, v: float) -> np.ndarray:
    return np.array([[u, v]])


def knowing(rng: np.random.Generator, options: SegmentationOptions = DEFAULT_OPTIONS) -> Follower:
    """A follower that has seen the rod alone, and follows it."""
    follower = Follower(options)
    for _ in range(3):
        assert len(follower.measure(one(rng), ONE, UV + 0.5, np.array([4.0]))) == 1
    return follower


@pytest.mark.parametrize(
    "trouble",
    [
        pytest.param(lambda: render_rod(SHAPE, (43.0, 36.0), **ROD), id="a rod beside it"),
        pytest.param(lambda: render_rod(SHAPE, (39.9, 36.3), **ROD), id="a rod half upon it"),
        pytest.param(lambda: 0.25 * render_rod(SHAPE, (33.0, 38.0), **ROD), id="something fainter beside it"),
        pytest.param(lambda: 1500.0 * (np.mgrid[: SHAPE[0], : SHAPE[1]][0] > 40), id="the edge of a plate"),
    ],
)
def test_a_disturbed_spot_is_measured_in_full(trouble: object, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    follower = knowing(rng)
    slice_ = one(rng, more=trouble())  # type: ignore[operator]
    counts = in_full(monkeypatch)
    spots = follower.measure(slice_, ONE, UV, np.array([4.0]))
    full = measure_spots(slice_, UV, np.array([4.0]))
    assert counts == [1]
    np.testing.assert_array_equal(spots.uv_px, full.uv_px)
    np.testing.assert_array_equal(spots.covariance_px, full.covariance_px)


def test_a_streak_through_a_followed_spot_widens_it() -> None:
    rng = np.random.default_rng(4)
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]]
    scaled, widened = [], []
    for _ in range(25):
        follower = knowing(rng)
        uv = UV[0] + rng.uniform(-0.5, 0.5, 2)
        angle, offset = rng.uniform(0, np.pi), rng.uniform(-3, 3)
        across = (column - uv[0]) * np.sin(angle) - (row - uv[1]) * np.cos(angle) - offset
        alone = follower.measure(one(rng, uv), ONE, UV, np.array([4.0]))
        streak = follower.measure(one(rng, uv, 400 * np.exp(-0.5 * (across / 1.5) ** 2)), ONE, UV, np.array([4.0]))
        widened.append(np.trace(streak.covariance_px[0]) / np.trace(alone.covariance_px[0]))
        scaled.append((streak.uv_px[0] - uv) / streak.sd_px[0])
    assert np.median(widened) > 4.0  # a streak through the very middle moves nothing
    assert np.sqrt(np.mean(np.square(scaled))) < 2.0


def test_more_noise_is_owned_up_to_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    rng, follower, own = np.random.default_rng(5), Follower(), []
    for noise in [15.0] * 4 + [40.0] * 8:
        monkeypatch.setitem(CASES, "thin rod", (CASES["thin rod"][0], noise, np.inf, 0.0))
        slice_, uv, expected = next(moving("thin rod", rng, 1))
        own.append(in_own_variances(matched(follower.measure(slice_, RODS, expected, RADIUS_PX), uv), uv))
    assert 0.65 < np.mean(own[4:]) < 1.2


def test_followed_spots_are_values_as_others_are() -> None:
    rng = np.random.default_rng(14)
    spots = knowing(rng).measure(one(rng), ONE, UV, np.array([4.0]))
    again = pickle.loads(pickle.dumps(spots))
    for name in ("uv_px", "covariance_px", "area_px", "contrast", "major_px", "minor_px", "angle_rad"):
        values = getattr(spots, name)
        assert not values.flags.writeable
        np.testing.assert_array_equal(getattr(again, name), values)
    assert (again.sd_assumed, again.rejected, again.n_rejected) == (False, (), {})


def test_nothing_is_seen_where_nothing_is_any_more() -> None:
    rng = np.random.default_rng(6)
    follower = knowing(rng)
    assert not len(follower.measure(as_slice(rng.normal(0.0, NOISE, SHAPE)), ONE, UV, np.array([4.0])))
    assert len(follower.measure(one(rng), ONE, UV, np.array([4.0]))) == 1


def test_only_spots_within_the_radius_are_returned_each_once(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(7)
    for off, n in ((3.0, 1), (5.0, 0)):
        assert len(knowing(rng).measure(one(rng), ONE, UV + at(off, 0.0), np.array([4.0]))) == n
    follower, twice = Follower(), np.concatenate([UV - 0.5, UV + 0.5])
    for _ in range(3):
        assert len(follower.measure(one(rng), np.array([0, 1]), twice, np.array([4.0, 4.0]))) == 1


def test_a_spot_beyond_the_window_but_within_the_radius_is_not_overlooked(monkeypatch: pytest.MonkeyPatch) -> None:
    """The pose decides which of two spots is the rod's: both have to be seen."""
    rng, wide = np.random.default_rng(8), np.array([14.0])
    for second, n in (((50.5, 34.0), 2), ((58.5, 34.0), 1)):
        follower = Follower()
        for _ in range(2):
            assert len(follower.measure(one(rng), ONE, UV, wide)) == 1
        counts = in_full(monkeypatch)
        assert len(follower.measure(one(rng, more=render_rod(SHAPE, second, **ROD)), ONE, UV, wide)) == n
        assert len(counts) == n - 1


def test_a_neighbour_that_is_followed_itself_disturbs_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """But a spot between two, beyond the windows of both, is not overlooked because each leaves it to the other."""
    rng, rods, wide = np.random.default_rng(11), np.array([0, 1]), np.array([14.0, 14.0])
    both = UV + np.array([[-9.0, 0.0], [11.0, 2.0]])
    rod, third = (render_rod(SHAPE, place, **ROD) for place in (tuple(both[1]), (39.3, 35.6)))
    follower = Follower()
    for _ in range(2):
        assert len(follower.measure(one(rng, both[0], rod), rods, both + 0.4, wide)) == 2
    counts = in_full(monkeypatch)
    spots = follower.measure(one(rng, both[0], rod), rods, both + 0.4, wide)
    assert not counts
    np.testing.assert_allclose(matched(spots, both).uv_px, both, atol=0.1)
    assert len(follower.measure(one(rng, both[0], rod + third), rods, both + 0.4, wide)) == 3
    assert counts


def test_what_only_rises_towards_something_farther_off_is_no_spot(monkeypatch: pytest.MonkeyPatch) -> None:
    rng, wide = np.random.default_rng(12), np.array([14.0])
    from_rod = np.mgrid[: SHAPE[0], : SHAPE[1]][1] - UV[0, 0]
    follower = Follower()
    for _ in range(2):
        assert len(follower.measure(one(rng), ONE, UV, wide)) == 1
    counts = in_full(monkeypatch)
    for off, is_followed in ((18.0, True), (11.0, False)):
        ridge = 1500.0 * np.exp(-0.5 * ((from_rod - off) / 2.5) ** 2)
        assert len(follower.measure(one(rng, more=ridge), ONE, UV, wide)) == 1
        assert (not counts) == is_followed


@pytest.mark.parametrize(("share", "n_in_full"), [(0.05, 0), (0.5, 1)])
def test_a_peak_on_a_bright_place_counts_only_if_it_could_be_a_spot(
    share: float, n_in_full: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Spots fainter than a tenth of the strongest are left out in the end, so their peaks cost no full fit."""
    rng, wide = np.random.default_rng(13), np.array([16.0])
    from_rod = np.mgrid[: SHAPE[0], : SHAPE[1]][1] - UV[0, 0]
    height = 3071.0  # as the scanner shows it
    plateau = 0.12 * height / (1.0 + np.exp(-(from_rod - 9.0) / 1.5))
    peak = render_rod(SHAPE, (48.5, 34.0), contrast=share * height, slope=(0.3, 0.1))
    follower = Follower()
    for _ in range(2):
        assert len(follower.measure(one(rng, more=plateau), ONE, UV, wide)) == 1
    counts = in_full(monkeypatch)
    assert len(follower.measure(one(rng, more=plateau + peak), ONE, UV, wide)) == 1 + n_in_full
    assert len(counts) == n_in_full


@pytest.mark.parametrize("uv", [at(6.2, 35.0), at(75.9, 66.1), at(38.0, 2.0)])
def test_at_the_border_and_in_padding_spots_are_measured_in_full(uv: np.ndarray) -> None:
    rng = np.random.default_rng(9)
    for padding in (None, (-2000, -1500)):
        follower = knowing(rng)
        outside = -5000.0 * (np.mgrid[: SHAPE[0], : SHAPE[1]][1] < uv[0, 0] - 6) if padding else 0.0
        slice_ = as_slice(
            np.clip(render_rod(SHAPE, tuple(uv[0]), **ROD) + outside + rng.normal(0.0, NOISE, SHAPE), -1800, 3071),
            padding=padding,
        )
        spots = follower.measure(slice_, ONE, uv, np.array([4.0]))
        full = measure_spots(slice_, uv, np.array([4.0]))
        np.testing.assert_array_equal(spots.uv_px, full.uv_px)


def in_other_numbers(kind: str, slice_: Slice) -> Slice:
    stored = slice_.stored.astype(int)
    if kind == "unsigned":
        return as_slice(stored + 1024, dtype=np.uint16, intercept=-1024.0)
    if kind == "long":
        return as_slice(stored, dtype=np.int32)
    if kind == "inverted":
        return as_slice(-stored, slope=-1.0)
    if kind == "dark":
        return as_slice(-stored)
    if kind == "real":
        return as_slice(stored, dtype=np.float64)
    shape = np.asfortranarray(slice_.stored) if kind == "not in one piece" else slice_.stored.astype(">i2")
    return Slice(info=slice_.info, stored=shape)


@pytest.mark.parametrize("kind", ["unsigned", "long", "inverted", "dark", "big endian", "real", "not in one piece"])
def test_whatever_the_numbers_the_centre_is_the_same(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    options = SegmentationOptions(polarity="dark" if kind == "dark" else "bright")
    rng, plain, other = np.random.default_rng(10), Follower(), Follower(options)
    counts = in_full(monkeypatch)
    for _ in range(4):
        slice_ = one(rng, UV[0] + rng.uniform(-0.5, 0.5, 2))
        made = in_other_numbers(kind, slice_)
        expected = plain.measure(slice_, ONE, UV, np.array([4.0]))
        found = other.measure(made, ONE, UV, np.array([4.0]))
        odd = kind in ("real", "not in one piece")
        np.testing.assert_allclose(found.uv_px, expected.uv_px, atol=0.3 * expected.sd_px.min() if odd else 1e-9)
        np.testing.assert_allclose(found.contrast, expected.contrast, rtol=0.05 if odd else 1e-9)
    assert len(counts) == (1 + 4 if odd else 1 + 1)


def test_rods_come_and_go_and_each_keeps_its_own_looks() -> None:
    rng, follower, uv = np.random.default_rng(11), Follower(), np.array([[20.3, 34.6], [40.2, 20.1], [60.4, 50.8]])
    looks = [{**ROD, "slope": (0.1 * k, 0.0), "contrast": 5000.0 + 1500.0 * k} for k in range(3)]
    for rods in ([0, 1, 2], [0, 2], [0, 2], [1, 2], [0, 1, 2], [0, 1, 2], [], [1]):
        image = sum((render_rod(SHAPE, tuple(uv[k]), **looks[k]) for k in rods), rng.normal(0.0, NOISE, SHAPE))
        slice_ = as_slice(np.minimum(image, 3071.0))
        spots = follower.measure(slice_, np.array(rods, dtype=np.intp), uv[rods], np.full(len(rods), 4.0))
        assert len(spots) == len(rods)
        if rods:
            np.testing.assert_allclose(matched(spots, uv[rods]).uv_px, uv[rods], atol=0.06)


SHARP = {"mm_per_px": 1.0, "diameter_mm": 0.6, "blur_mm": 0.15, "contrast": 9000.0, "slope": (0.0, 0.0)}
FLAT = {"mm_per_px": 0.5, "diameter_mm": 6.0, "blur_mm": 0.4, "contrast": 2500.0, "slope": (0.0, 0.0)}


@pytest.mark.parametrize("kinds", [[SHARP, SHARP], [FLAT, FLAT], [ROD, SHARP], [ROD, FLAT]])
@pytest.mark.parametrize("mask", [False, True])
def test_what_no_step_serves_is_measured_in_full_in_every_slice(kinds: list[dict[str, object]], mask: bool) -> None:
    rng, follower, uv = np.random.default_rng(13), Follower(), np.array([[22.3, 34.6], [55.4, 28.1]])
    for _ in range(6):
        uv = uv + rng.uniform(-0.4, 0.4, uv.shape)
        image = sum((render_rod(SHAPE, tuple(uv[k]), **kinds[k]) for k in range(2)), rng.normal(0.0, NOISE, SHAPE))
        slice_ = as_slice(np.where(image > 800, 255, 0) if mask else image)
        spots = follower.measure(slice_, np.arange(2), uv, np.full(2, 4.0))
        full = matched(measure_spots(slice_, uv, np.full(2, 4.0)), uv)
        assert len(spots) == 2
        spots = matched(spots, uv)
        np.testing.assert_allclose(spots.uv_px, full.uv_px, atol=0.2 * full.sd_px.max())


def test_everything_is_measured_in_full_now_and_then_and_when_told_to(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(12)
    counts, follower = in_full(monkeypatch), Follower()
    slice_ = one(rng)
    for _ in range(2 * MAX_AGE):
        follower.measure(slice_, ONE, UV, np.array([4.0]))
    assert len(counts) == 2
    assert MAX_AGE > LAW_EVERY
    follower.forget()
    follower.measure(slice_, ONE, UV, np.array([4.0]))
    assert len(counts) == 3


def test_what_never_can_be_followed_is_not_tried_again_and_again(monkeypatch: pytest.MonkeyPatch) -> None:
    rng, follower, tries = np.random.default_rng(13), Follower(), []
    monkeypatch.setattr(
        follow, "measure_lone_blobs", lambda *a, real=follow.measure_lone_blobs: tries.append(1) or real(*a)
    )
    pair = one(rng, more=render_rod(SHAPE, (43.0, 36.0), **ROD))
    for _ in range(40):
        spots = follower.measure(pair, ONE, UV, np.array([2.0]))
        np.testing.assert_array_equal(spots.uv_px, measure_spots(pair, UV, np.array([2.0])).uv_px)
    assert len(tries) < 8
