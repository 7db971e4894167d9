"""The renderer against solid geometry: volume and centre of mass of a cut cylinder."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ctreg_cli.arrays import FloatArray
from ctreg_cli.simulation.cylinders import Cylinder, Patch, cylinder_patch
from ctreg_cli.simulation.settings import ScannerSettings
from tests.simulation.scenes import bare


def needle(direction: FloatArray, middle: FloatArray, length: float = 60.0, diameter: float = 1.2) -> Cylinder:
    d = np.asarray(direction, float) / np.linalg.norm(direction)
    return Cylinder(start=middle - length / 2 * d, end=middle + length / 2 * d, diameter_mm=diameter, hu=1000.0)


def full(patch: Patch | None, settings: ScannerSettings) -> FloatArray:
    image = np.zeros(settings.shape)
    if patch is not None:
        image[patch.rows, patch.columns] = patch.share
    return image


def centroid_px(image: FloatArray) -> FloatArray:
    rows, columns = np.indices(image.shape)
    return np.array([(columns * image).sum(), (rows * image).sum()]) / image.sum()


@pytest.mark.parametrize("thickness_mm", [0.6, 2.5, 8.0])
@pytest.mark.parametrize("psf_fwhm_mm", [0.0, 1.0])
def test_area_and_centre_of_a_cylinder_that_crosses_the_slab(thickness_mm: float, psf_fwhm_mm: float) -> None:
    settings = bare(thickness_mm=thickness_mm, psf_fwhm_mm=psf_fwhm_mm)
    rng = np.random.default_rng(7)
    for _ in range(12):
        tilt, turn = rng.uniform(0, 0.9), rng.uniform(0, 2 * math.pi)
        direction = np.array([math.sin(tilt) * math.cos(turn), math.sin(tilt) * math.sin(turn), math.cos(tilt)])
        middle = np.append(settings.centre_mm + rng.uniform(-3, 3, 2), 0.0)
        image = full(cylinder_patch(needle(direction, middle), settings), settings)
        # the plane cuts an ellipse of area π r² / cos(tilt), the same at every height of the slab
        area = math.pi * 0.6**2 / math.cos(tilt)
        assert image.sum() * settings.scale.s_x * settings.scale.s_y == pytest.approx(area, rel=0.01)
        expected = middle[:2] / [settings.scale.s_x, settings.scale.s_y]
        assert np.abs(centroid_px(image) - expected).max() < 0.02


def test_share_is_one_inside_a_thick_cylinder_and_none_is_outside() -> None:
    settings = bare(psf_fwhm_mm=0.0)
    middle = np.array([*settings.centre_mm, 0.0])
    image = full(cylinder_patch(needle(np.array([0.0, 0.0, 1.0]), middle, diameter=6.0), settings), settings)
    rows, columns = np.indices(image.shape)
    radius = np.hypot(columns * settings.scale.s_x - middle[0], rows * settings.scale.s_y - middle[1])
    assert np.allclose(image[radius < 2.5], 1.0)
    assert not image[radius > 3.5].any()


def test_an_end_inside_the_slab_leaves_the_part_that_is_there() -> None:
    settings = bare(thickness_mm=4.0)
    middle = np.array([*settings.centre_mm, 0.0])
    whole = full(cylinder_patch(needle(np.array([0.0, 0.0, 1.0]), middle), settings), settings)
    for reach, part in ((-2.5, 0.0), (-1.0, 0.25), (0.0, 0.5), (1.0, 0.75), (3.0, 1.0)):
        low, high = (np.array([middle[0], middle[1], z]) for z in (-30.0, reach))
        stump = Cylinder(start=low, end=high, diameter_mm=1.2, hu=1000.0)
        image = full(cylinder_patch(stump, settings), settings)
        assert image.sum() == pytest.approx(part * whole.sum(), rel=0.02, abs=1e-9)


def test_the_blur_has_the_width_asked_for() -> None:
    settings = bare(psf_fwhm_mm=2.0)
    middle = np.array([*settings.centre_mm, 0.0])
    thin = needle(np.array([0.0, 0.0, 1.0]), middle, diameter=0.3)
    image = full(cylinder_patch(thin, settings), settings)
    columns = np.arange(settings.shape[1])
    offset = columns * settings.scale.s_x - middle[0]
    variance = (offset**2 * image).sum() / image.sum()
    # Gaussian, the disc itself (r²/4) and the pixel (s²/12) add up
    assert variance == pytest.approx((2.0 / 2.3548) ** 2 + 0.15**2 / 4 + settings.scale.s_x**2 / 12, rel=0.01)


@pytest.mark.parametrize("where", [(0.0, 0.0, 40.0), (500.0, 0.0, 0.0), (0.0, -500.0, 0.0)])
def test_nothing_is_drawn_of_what_is_not_in_the_slice(where: tuple[float, float, float]) -> None:
    settings = bare()
    middle = np.array([*settings.centre_mm, 0.0]) + where
    assert cylinder_patch(needle(np.array([0.0, 0.0, 1.0]), middle, length=20.0), settings) is None


def test_a_cylinder_at_the_edge_of_the_image_is_cut_there_and_not_moved() -> None:
    settings, wide = bare(), bare(shape=(120, 200))
    middle = np.array([(settings.shape[1] - 1) * settings.scale.s_x, 30.0, 0.0])
    cylinder = needle(np.array([0.3, 0.1, 1.0]), middle)
    cut, whole = (full(cylinder_patch(cylinder, s), s) for s in (settings, wide))
    assert np.allclose(cut, whole[:, : settings.shape[1]])


def test_a_needle_in_the_plane_of_the_slice_is_drawn_along_its_length() -> None:
    settings = bare(psf_fwhm_mm=0.0, thickness_mm=3.0)
    middle = np.array([*settings.centre_mm, 0.0])
    image = full(cylinder_patch(needle(np.array([1.0, 0.0, 0.0]), middle, length=20.0), settings), settings)
    volume = math.pi * 0.6**2 * 20.0
    assert image.sum() * settings.scale.s_x * settings.scale.s_y * 3.0 == pytest.approx(volume, rel=0.01)
