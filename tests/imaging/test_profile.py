"""The profile's derivatives, and spots seen along their own axes."""

from __future__ import annotations

import numpy as np
import pytest

from ctreg_cli.imaging.plateau import LongSpots
from ctreg_cli.imaging.profile import FLATNESS, LOG_HEIGHT, N_PARAMETERS, Areas, Rows, moved
from ctreg_cli.imaging.segmentation import find_spots
from tests.imaging.rendering import as_slice, render_rod

#: centre; ln height; background; gradient; shape; flatness, of two spots
PARAMETERS = np.array(
    [[0.3, -0.2, 5.0, 12.0, 0.4, -0.7, -0.6, 0.1, -0.4, 0.2], [-0.4, 0.1, 6.0, -3.0, 0.1, 0.2, -1.2, -0.05, -0.3, 0.6]]
).T


@pytest.mark.parametrize(
    ("long", "of_areas", "flat"),
    [
        (None, False, False),
        ((False, True), False, False),
        ((True, True), False, False),
        (None, True, False),
        ((False, True), True, False),
        (None, False, True),
        (None, True, True),
    ],
)
def test_the_derivatives_are_those_of_the_profile(long: tuple[bool, bool] | None, of_areas: bool, flat: bool) -> None:
    v, u = (axis.ravel().astype(float) for axis in np.mgrid[-6:7, -6:7])
    weights = np.random.default_rng(0).uniform(0.5, 1.5, (2, u.size))
    values, mask, areas = np.zeros((2, u.size)), None, None
    if of_areas:
        areas, u, v = Areas.within(u, v, 4.0)
    if long is not None:
        mask, u, v = np.array(long), np.tile(u, (2, 1)), np.tile(v, (2, 1))
    rows = Rows(u, v, values, None, weights, mask, areas, flat=flat)

    def profile(parameters: np.ndarray) -> np.ndarray:
        rows.evaluate(parameters)
        return -rows.by_spot[:, -1]

    e = 1e-5
    for i in range(N_PARAMETERS):
        step = np.zeros_like(PARAMETERS)
        step[i] = e
        # rows 6 to 8 stretch ξ and η themselves: to first order in the step
        numeric = (profile(moved(PARAMETERS, step)) - profile(moved(PARAMETERS, -step))) / (2 * e)
        rows.evaluate(PARAMETERS)
        np.testing.assert_allclose(rows.by_spot[:, i], numeric, atol=2e-6 * np.abs(numeric).max() + 1e-6)


def test_pixels_are_means_over_their_areas() -> None:
    """Against 41 × 41 points a pixel; the sharpest edge here falls from 80 to 20 % within half a pixel."""
    v, u = (axis.ravel().astype(float) for axis in np.mgrid[-3:4, -3:4])
    areas, points_u, points_v = Areas.within(u, v, 10.0)
    sharp = np.array([[0.3, -0.2, 5.0, 12.0, 0.4, -0.7, 0.1, 0.1, 0.2, 0.4]]).T
    step = (np.arange(41) - 20.0) / 41.0
    fine_v, fine_u = (axis.ravel() for axis in np.meshgrid(step, step, indexing="ij"))
    everywhere = [(x[:, None] + fine).ravel() for x, fine in ((u, fine_u), (v, fine_v))]

    def image(at_u: np.ndarray, at_v: np.ndarray, areas: Areas | None) -> np.ndarray:
        rows = Rows(at_u, at_v, np.zeros((1, 49 if areas else len(at_u))), None, np.ones((1, 1)), None, areas)
        rows.evaluate(sharp)
        return -rows.by_spot[0, -1]

    expected = image(*everywhere, None).reshape(49, -1).mean(axis=1)
    height = np.exp(5.0)
    assert np.abs(image(points_u, points_v, areas) - expected).max() < 0.003 * height
    assert np.abs(image(u, v, None) - expected).max() > 0.05 * height  # as points they are something else


def test_an_edge_is_as_steep_as_the_other_profile_of_the_same_flatness() -> None:
    e, places = 1e-4, np.array([1.0 - 1e-4, 1.0, 1.0 + 1e-4])
    parameters = np.array([[0.0, 0.0, 3.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.3]]).T
    heights = []
    for flat in (False, True):
        rows = Rows(places, np.zeros(3), np.zeros((1, 3)), None, np.ones((1, 3)), flat=flat)
        rows.evaluate(parameters)
        heights.append(-rows.by_spot[0, -1])
    np.testing.assert_allclose(heights[1], heights[0], rtol=1e-5)
    np.testing.assert_allclose(heights[0][1], 0.5 * np.exp(3.0))
    np.testing.assert_allclose(np.diff(heights[1]) / e, np.diff(heights[0]) / e, rtol=1e-3)


def test_pixels_that_are_left_out_take_part_again() -> None:
    """A clipped pixel takes no part where the profile is brighter, and does in the next evaluation where it is not."""
    v, u = (axis.ravel().astype(float) for axis in np.mgrid[-6:7, -6:7])
    values, dark = np.full((2, u.size), 40.0), PARAMETERS.copy()
    dark[LOG_HEIGHT] -= 6.0
    rows = Rows(u, v, values, values > 0, np.ones_like(values))
    expected = rows.evaluate(dark)
    bright = rows.evaluate(PARAMETERS)
    left_out = (rows.by_spot == 0.0).all(axis=1)
    assert left_out.any(axis=1).all()
    assert not left_out.all()
    unclipped = Rows(u, v, values, None, np.ones_like(values))
    unclipped.evaluate(PARAMETERS)
    by_spot = np.where(left_out[:, None], 0.0, unclipped.by_spot)
    np.testing.assert_allclose(bright, by_spot @ by_spot[:, :-1].transpose(0, 2, 1))
    np.testing.assert_array_equal(rows.evaluate(dark), expected)


def test_a_part_of_the_spots_has_their_rows() -> None:
    v, u = (np.tile(axis.ravel().astype(float), (2, 1)) for axis in np.mgrid[-6:7, -6:7])
    u[1] += 0.3
    rows = Rows(u, v, np.zeros((2, u.shape[1])), None, np.ones((2, u.shape[1])), np.array([False, True]))
    both = rows.evaluate(PARAMETERS)
    one = rows.take(np.array([1])).evaluate(PARAMETERS[:, [1]])
    np.testing.assert_allclose(one[0], both[1])


def test_only_long_spots_are_turned_and_turned_back() -> None:
    angle = 0.4
    turn = np.array([[[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]])
    long = LongSpots(mask=np.array([False, True]), index=np.array([1]), rotation=np.stack([np.eye(2), turn[0]]))
    vectors = np.array([[1.0, np.cos(angle)], [2.0, np.sin(angle)]])
    turned = long.turned(vectors)
    np.testing.assert_allclose(turned, [[1.0, 1.0], [2.0, 0.0]], atol=1e-12)
    np.testing.assert_allclose(long.turned_back(turned), vectors)
    moments = np.stack([np.diag([2.0, 1.0]), turn[0].T @ np.diag([5.0, 1.0]) @ turn[0]])
    np.testing.assert_allclose(long.turned_moments(moments), [np.diag([2.0, 1.0]), np.diag([5.0, 1.0])], atol=1e-12)


def test_turning_the_picture_turns_a_long_spot_and_its_covariance() -> None:
    rod = {"thickness_mm": 5.0, "slope": (1.0, 0.4), "contrast": 9000.0}
    image = render_rod((71, 71), (35.2, 34.9), **rod) + np.random.default_rng(1).normal(0.0, 20.0, (71, 71))
    spot, turned = (find_spots(as_slice(values, thickness_mm=5.0)) for values in (image, image.T))
    assert spot.major_px[0] > 2 * spot.minor_px[0]
    assert FLATNESS == N_PARAMETERS - 1
    np.testing.assert_allclose(turned.uv_px[0, ::-1], spot.uv_px[0], atol=1e-3)
    np.testing.assert_allclose(turned.covariance_px[0][::-1, ::-1], spot.covariance_px[0], rtol=0.02, atol=1e-7)
