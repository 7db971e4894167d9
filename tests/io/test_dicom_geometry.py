"""Scale, patient geometry and values, against DICOM's own equations."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ctreg_cli.geometry.pose import is_pose
from ctreg_cli.imaging.slice import Slice, UnreadableSlice
from ctreg_cli.io.images import open_images, read_slices
from tests.io.dicom_samples import (
    COLUMN_SPACING_MM,
    POSITION_MM,
    ROW_SPACING_MM,
    ct_slice,
    item,
    pixels,
    write_dicom,
)


def read_one(path: Path, **attributes: Any) -> Slice:
    (slice_,) = read_slices(write_dicom(path / "a.dcm", ct_slice(**attributes)))
    return slice_


def problem_of(path: Path, **attributes: Any) -> str:
    """Why a slice with these attributes cannot be read, beside one that can."""
    write_dicom(path / "good.dcm")
    write_dicom(path / "odd.dcm", ct_slice(**attributes))
    (problem,) = [item.problem for item in open_images([path]) if isinstance(item, UnreadableSlice)]
    return problem


def random_rotation(seed: int) -> np.ndarray:
    Q, R = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    Q = Q * np.sign(np.diag(R))
    return Q * np.sign(np.linalg.det(Q))


TILT = np.radians(22.5)
ORIENTATIONS = {
    "axial": (1, 0, 0, 0, 1, 0),
    "feet first, prone": (-1, 0, 0, 0, -1, 0),
    "coronal": (1, 0, 0, 0, 0, -1),
    "sagittal": (0, 1, 0, 0, 0, -1),
    "gantry tilt": (1, 0, 0, 0, np.cos(TILT), -np.sin(TILT)),
    "oblique": tuple(random_rotation(1)[:, :2].T.ravel()),
    "oblique 2": tuple(random_rotation(2)[:, :2].T.ravel()),
}


@pytest.mark.parametrize("orientation", ORIENTATIONS.values(), ids=ORIENTATIONS.keys())
def test_pixels_go_where_the_standard_says(tmp_path: Path, orientation: tuple[float, ...]) -> None:
    """PS3.3 C.7.6.2.1.1, equation C.7.6.2.1-1: P = S + X Δi i + Y Δj j, i the column index."""
    written = [f"{value:.10g}" for value in orientation]
    info = read_one(tmp_path, ImageOrientationPatient=written).info
    assert info.scale is not None
    assert info.T_patient_slice is not None
    assert is_pose(info.T_patient_slice)
    X, Y, S = np.array(orientation[:3]), np.array(orientation[3:]), np.array(POSITION_MM)
    for column, row in ((0, 0), (31, 0), (0, 23), (7.25, 19.5)):
        expected = S + X * COLUMN_SPACING_MM * column + Y * ROW_SPACING_MM * row
        in_slice = [*(info.scale.mm_per_px * [column, row]), 0, 1]
        np.testing.assert_allclose((info.T_patient_slice @ in_slice)[:3], expected, atol=1e-6)
    assert info.shape == (24, 32)
    assert info.thickness_mm == 2.5


def test_rounded_cosines_become_a_rotation(tmp_path: Path) -> None:
    R = random_rotation(3)
    info = read_one(tmp_path, ImageOrientationPatient=[f"{value:.3f}" for value in R[:, :2].T.ravel()]).info
    assert info.T_patient_slice is not None
    assert is_pose(info.T_patient_slice, 1e-12)
    np.testing.assert_allclose(info.T_patient_slice[:3, :3], R, atol=1e-3)


def test_missing_geometry_is_none_not_a_guess(tmp_path: Path) -> None:
    info = read_one(tmp_path, PixelSpacing=None, ImagePositionPatient=None, SliceThickness="0").info
    assert (info.scale, info.T_patient_slice, info.thickness_mm) == (None, None, None)
    images = open_images([tmp_path])
    assert {"1 of 1 slices have no Pixel Spacing", "1 of 1 slices have no patient geometry"} <= set(images.warnings)


def test_missing_rescale_is_identity(tmp_path: Path) -> None:
    slice_ = read_one(tmp_path, RescaleSlope=None, RescaleIntercept=None)
    np.testing.assert_array_equal(slice_.values(), pixels())


def test_rescale(tmp_path: Path) -> None:
    np.testing.assert_array_equal(read_one(tmp_path).values(), pixels() * 2.0 - 24)


@pytest.mark.parametrize(
    ("dtype", "bits", "attributes"),
    [("<u2", 12, {}), ("<i2", 16, {}), ("<u1", 8, {"RescaleSlope": None, "RescaleIntercept": None})],
)
def test_monochrome1_is_turned_round(tmp_path: Path, dtype: str, bits: int, attributes: dict[str, Any]) -> None:
    bright = pixels(8, 8, dtype, low=0)
    low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if dtype == "<i2" else (0, 2**bits - 1)
    inverted = (low + high - bright.astype(int)).astype(dtype)
    depth = {"BitsStored": bits, "HighBit": bits - 1}
    (expected,) = read_slices(write_dicom(tmp_path / "2.dcm", ct_slice(bright, **depth, **attributes)))
    path = write_dicom(
        tmp_path / "1.dcm", ct_slice(inverted, PhotometricInterpretation="MONOCHROME1", **depth, **attributes)
    )
    (slice_,) = images = open_images([path])
    np.testing.assert_array_equal(slice_.values(), expected.values())
    assert slice_.slope < 0
    assert any("MONOCHROME1" in warning for warning in images.warnings)


def test_monochrome1_with_negative_slope_is_turned_round_already(tmp_path: Path) -> None:
    slice_ = read_one(tmp_path, PhotometricInterpretation="MONOCHROME1", RescaleSlope="-1", RescaleIntercept="5")
    np.testing.assert_array_equal(slice_.values(), 5.0 - pixels())


def test_padding_value_and_range(tmp_path: Path) -> None:
    stored = pixels(low=-2000)
    stored[3, 5] = 3000
    single = read_one(tmp_path, stored=stored, PixelPaddingValue=-2000)
    assert np.argwhere(np.isnan(single.values())).tolist() == [[0, 0]]
    limited = read_one(tmp_path, stored=stored, PixelPaddingValue=-1990, PixelPaddingRangeLimit=-2000)
    assert limited.padding == (-2000, -1990)
    np.testing.assert_array_equal(np.isnan(limited.values()), stored <= -1990)


def test_padding_above_32767_of_unsigned_pixels(tmp_path: Path) -> None:
    stored = pixels(dtype="<u2", low=63000)
    assert read_one(tmp_path, stored=stored, PixelPaddingValue=63001).padding == (63001, 63001)


@pytest.mark.parametrize(("dtype", "bits"), [("<u2", 12), ("<i2", 12), ("<u2", 16)])
def test_unused_bits_hold_no_values(tmp_path: Path, dtype: str, bits: int) -> None:
    """Old scanners keep overlays in the high bits; a spot must not be made of them."""
    clean = pixels(8, 8, dtype, low=-20 if dtype == "<i2" else 0)
    dirty = clean.view("<u2") & (2**bits - 1)
    dirty[2, 3] |= 0xF000 & ~(2**bits - 1)
    slice_ = read_one(tmp_path, stored=dirty.view(dtype), BitsStored=bits, HighBit=bits - 1)
    np.testing.assert_array_equal(slice_.stored, clean)


@pytest.mark.parametrize(
    ("attributes", "tag"),
    [
        ({"PixelSpacing": [0.5, -0.5]}, "Pixel Spacing (0028,0030)"),
        ({"PixelSpacing": [0.0, 0.5]}, "Pixel Spacing (0028,0030)"),
        ({"PixelSpacing": [5000, 5000]}, "Pixel Spacing (0028,0030)"),
        ({"PixelSpacing": [0.5]}, "Pixel Spacing (0028,0030)"),
        ({"SliceThickness": "-1"}, "Slice Thickness (0018,0050)"),
        ({"ImagePositionPatient": [1, 2]}, "Image Position (Patient) (0020,0032)"),
        ({"ImageOrientationPatient": [1, 0, 0, 1, 0, 0]}, "Image Orientation (Patient) (0020,0037)"),
        ({"ImageOrientationPatient": [1, 0, 0, 0, 0.9, 0]}, "Image Orientation (Patient) (0020,0037)"),
        ({"ImageOrientationPatient": [1, 0, 0, 0, 1]}, "Image Orientation (Patient) (0020,0037)"),
        ({"ImageOrientationPatient": [0, 0, 0, 0, 0, 0]}, "Image Orientation (Patient) (0020,0037)"),
        ({"RescaleSlope": "0"}, "Rescale Slope (0028,1053)"),
        ({"RescaleSlope": None, "ModalityLUTSequence": item(LUTExplanation="x")}, "Modality LUT Sequence (0028,3000)"),
        ({"BitsAllocated": 12}, "Bits Allocated (0028,0100)"),
        ({"BitsStored": 17}, "Bits Stored (0028,0101)"),
        ({"HighBit": 11}, "High Bit (0028,0102)"),
        ({"PixelRepresentation": 2}, "Pixel Representation (0028,0103)"),
        ({"PhotometricInterpretation": None}, "Photometric Interpretation (0028,0004)"),
        ({"PhotometricInterpretation": "RGB"}, "Photometric Interpretation (0028,0004)"),
        ({"PhotometricInterpretation": "PALETTE COLOR"}, "Photometric Interpretation (0028,0004)"),
        ({"SamplesPerPixel": 3}, "Photometric Interpretation (0028,0004)"),
        ({"Rows": None}, "Rows (0028,0010)"),
        ({"Rows": 0}, "Rows (0028,0010)"),
        ({"Rows": 65535, "Columns": 65535}, "Rows (0028,0010)"),
        ({"Columns": 4000}, "Pixel Data (7FE0,0010)"),
        ({"Columns": 31}, "Pixel Data (7FE0,0010)"),
        ({"Rows": 23}, "Pixel Data (7FE0,0010)"),
        ({"NumberOfFrames": -1}, "Number of Frames (0028,0008)"),
        ({"NumberOfFrames": 999_999_999}, "Number of Frames (0028,0008)"),
        ({"NumberOfFrames": 60_000}, "Pixel Data (7FE0,0010)"),
    ],
    ids=str,
)
def test_nonsense_is_refused_by_the_name_of_its_tag(tmp_path: Path, attributes: dict[str, Any], tag: str) -> None:
    assert problem_of(tmp_path, **attributes).startswith(tag)
