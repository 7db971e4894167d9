"""Whole slices: what is in them is what the truth says, and what was asked for."""

from __future__ import annotations

import numpy as np
import pytest

from ctreg_cli.arrays import FloatArray
from ctreg_cli.errors import InputError
from ctreg_cli.geometry.projection import project, to_pixels, within_bounds
from ctreg_cli.scale import Scale
from ctreg_cli.simulation.crossings import rod_crossings
from ctreg_cli.simulation.phantom import MAX_HU, PADDING_STORED, render_slice, simulate_slice
from ctreg_cli.simulation.scene import add_noise
from tests.simulation.scenes import bare, pose_near_middle, small_frame

WINDOW_PX = 9


def window_centroid(image: FloatArray, uv: FloatArray, radius: int = WINDOW_PX) -> FloatArray:
    u, v = np.rint(uv).astype(int)
    part = image[v - radius : v + radius + 1, u - radius : u + radius + 1]
    rows, columns = np.mgrid[v - radius : v + radius + 1, u - radius : u + radius + 1]
    return np.array([(columns * part).sum(), (rows * part).sum()]) / part.sum()


def test_rendered_spots_lie_where_the_truth_says() -> None:
    model, settings = small_frame(), bare()
    rng = np.random.default_rng(11)
    checked = 0
    for _ in range(12):
        simulated = simulate_slice(model, pose_near_middle(settings, rng, 0.35), settings, rng)
        metal = simulated.slice.values() + 1000.0
        gaps = np.linalg.norm(simulated.uv_px[:, None] - simulated.uv_px, axis=2) + 1e9 * np.eye(len(simulated.uv_px))
        for uv, through, gap in zip(simulated.uv_px, simulated.through, gaps.min(axis=1), strict=True):
            # a neighbour in the window would pull the centroid
            if through and gap > 2.9 * WINDOW_PX:
                assert np.abs(window_centroid(metal, uv) - uv).max() < 0.02
                checked += 1
    assert checked > 30


def test_truth_agrees_with_the_estimators_forward_model() -> None:
    model, settings = small_frame(), bare()
    rng = np.random.default_rng(5)
    for _ in range(50):
        T = pose_near_middle(settings, rng, 1.0)
        ours = rod_crossings(model, T, settings)
        theirs = project(T, model.starts, model.directions)
        assert np.allclose(ours.uv_px, to_pixels(theirs.xy_mm, settings.scale.mm_per_px), atol=1e-9)
        assert np.allclose(ours.lambda_mm, theirs.lambda_mm, atol=1e-9)
        bounded = within_bounds(theirs.lambda_mm, model.lengths)
        assert (ours.visible <= bounded).all()


def test_a_rod_that_lies_in_the_plane_has_no_crossing() -> None:
    model, settings = small_frame(), bare()
    T = np.eye(4)
    # rod a along the slice's x axis, exactly in its plane
    d = model.directions[0]
    across = np.cross(d, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    T[:3, :3] = np.stack([d, np.cross(across, d), across])
    T[:3, 3] = [30.0, 30.0, 0.0] - T[:3, :3] @ (model.starts[0] + model.ends[0]) / 2
    crossings = rod_crossings(model, T, settings)
    assert not crossings.visible[0]
    assert not crossings.through[0]


def test_same_seed_same_pixels_other_seed_others() -> None:
    model, settings = small_frame(), bare(noise_hu=20.0, false_count=2, missing_count=1, streak_hu=100.0)
    T = pose_near_middle(settings, np.random.default_rng(1))
    first, again, other = (render_slice(model, T, settings, np.random.default_rng(seed)) for seed in (3, 3, 4))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_metal_is_clipped_and_outside_the_round_view_is_padding() -> None:
    settings = bare(metal_hu=16000.0, padding=True, noise_hu=10.0, body="abdomen", block=True)
    simulated = simulate_slice(
        small_frame(), pose_near_middle(settings, np.random.default_rng(2)), settings, np.random.default_rng(0)
    )
    slice_ = simulated.slice
    rows, columns = np.indices(settings.shape)
    x, y = columns * settings.scale.s_x, rows * settings.scale.s_y
    outside = np.hypot(x - x.mean(), y - y.mean()) > 150 * 0.41 / 2
    assert np.array_equal(slice_.stored == PADDING_STORED, outside)
    assert np.array_equal(np.isnan(slice_.values()), outside)
    assert np.nanmax(slice_.values()) == MAX_HU
    for u, v in np.rint(simulated.uv_px).astype(int):
        assert slice_.values()[v, u] == MAX_HU
    assert np.nanmin(slice_.values()) >= -1024


@pytest.mark.parametrize("texture", ["white", "fbp"])
def test_noise_has_the_deviation_and_the_power_spectrum_asked_for(texture: str) -> None:
    settings = bare(shape=(256, 320), scale=Scale(s_x=0.5, s_y=0.4), noise_hu=25.0, noise_texture=texture)
    noise = np.zeros(settings.shape)
    add_noise(noise, settings, np.random.default_rng(8))
    assert noise.std() == pytest.approx(25.0, rel=0.03)
    power = np.abs(np.fft.fft2(noise)) ** 2
    f = np.hypot(np.fft.fftfreq(256, 0.4)[:, None], np.fft.fftfreq(320, 0.5))
    low, high = (power[np.abs(f - f0) < 0.03].mean() for f0 in (0.1, 0.3))
    # ramp-filtered: |f| times the squared transfer function of a 1 mm blur (cycles per mm)
    sd = 1.0 / 2.3548
    ramp = 3 * np.exp(-4 * (np.pi * sd) ** 2 * (0.3**2 - 0.1**2))
    assert high / low == pytest.approx(1.0 if texture == "white" else ramp, rel=0.12)


def test_missing_rods_leave_nothing_and_are_named() -> None:
    model = small_frame()
    settings, complete = bare(missing=("b",), missing_count=2), bare()
    T = pose_near_middle(settings, np.random.default_rng(6), 0.1)
    there = simulate_slice(model, T, complete, np.random.default_rng(0))
    gone = simulate_slice(model, T, settings, np.random.default_rng(0))
    assert len(there.missing_rods) == 0
    assert len(gone.missing_rods) == 3
    assert model.ids.index("b") in gone.missing_rods
    assert sorted([*gone.rod_index, *gone.missing_rods]) == sorted(there.rod_index)
    for rod, (u, v) in zip(there.rod_index, np.rint(there.uv_px).astype(int), strict=True):
        assert (gone.slice.values()[v, u] > 0) == (rod not in gone.missing_rods)


def test_false_spots_are_bright_clear_of_rods_and_counted() -> None:
    model, settings = small_frame(), bare(shape=(200, 240), false_count=6, padding=True)
    T = pose_near_middle(settings, np.random.default_rng(6), 0.2)
    simulated = simulate_slice(model, T, settings, np.random.default_rng(9))
    assert len(simulated.false_px) == 6
    scale = settings.scale.mm_per_px
    for uv in simulated.false_px:
        assert np.linalg.norm((simulated.uv_px - uv) * scale, axis=1).min() > 3.0
        u, v = np.rint(uv).astype(int)
        assert simulated.slice.values()[v - 1 : v + 2, u - 1 : u + 2].max() > 0
    # what is false in one slice is not in the next
    other = simulate_slice(model, T, settings, np.random.default_rng(10))
    assert not np.allclose(other.false_px, simulated.false_px)


def test_acrylic_lies_between_the_rods_of_a_small_frame_only() -> None:
    settings = bare(block=True)
    T = np.eye(4)
    T[:3, 3] = [*settings.centre_mm, 0.0]
    values = simulate_slice(small_frame(), T, settings, np.random.default_rng(0)).slice.values()
    u, v = (int(c / s) for c, s in zip(settings.centre_mm, (0.41, 0.53), strict=True))
    assert values[v, u] == 120
    assert values[2, 2] == -1000


def test_streaks_darken_the_line_between_two_rods() -> None:
    plain, streaky = bare(block=True), bare(block=True, streak_hu=200.0)
    T = pose_near_middle(plain, np.random.default_rng(3), 0.1)
    rng = np.random.default_rng(0)
    before, after = (simulate_slice(small_frame(), T, s, rng) for s in (plain, streaky))
    change = after.slice.values() - before.slice.values()
    u, v = np.rint((before.uv_px[0] + before.uv_px[1]) / 2).astype(int)
    assert change[v - 1 : v + 2, u - 1 : u + 2].mean() < -20


def test_wrong_wishes_are_refused_in_one_sentence() -> None:
    settings = bare()
    T = pose_near_middle(settings, np.random.default_rng(0))
    with pytest.raises(InputError, match=r"has no rod nobody; its rods are a, b, c, d, e, f"):
        simulate_slice(small_frame(), T, bare(missing=("nobody",)), np.random.default_rng(0))
    tiny = bare(shape=(16, 16), scale=Scale(s_x=0.2, s_y=0.2), false_count=1)
    onto_rod = np.eye(4)
    onto_rod[:3, 3] = [*tiny.centre_mm, 0.0] - (small_frame().starts[0] + small_frame().ends[0]) / 2
    with pytest.raises(InputError, match="no room for 1 false spots"):
        simulate_slice(small_frame(), onto_rod, tiny, np.random.default_rng(0))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("thickness_mm", 0.0),
        ("thickness_mm", float("nan")),
        ("psf_fwhm_mm", -1.0),
        ("noise_hu", -1.0),
        ("metal_hu", float("inf")),
        ("missing_count", -1),
        ("shape", (0, 512)),
        ("shape", (512, 100_000)),
    ],
)
def test_settings_no_scanner_has_are_refused(field: str, value: object) -> None:
    with pytest.raises(InputError, match=field):
        bare(**{field: value})
