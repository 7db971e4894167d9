"""Every way of writing the same slice gives the same slice."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pydicom
import pytest
from pydicom.data import get_testdata_file
from pydicom.uid import (
    DeflatedExplicitVRLittleEndian,
    ExplicitVRBigEndian,
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
    RLELossless,
)

from ctreg_cli.errors import UnreadableSliceError
from ctreg_cli.io import dicom_pixels
from ctreg_cli.io.images import open_images, read_slices
from tests.io.dicom_samples import (
    CODESTREAM_SHAPE,
    CODESTREAMS,
    compressed_slice,
    ct_slice,
    pixels,
    swap_to_big_endian,
    write_dicom,
)

SAMPLE_DATA = Path(__file__).parents[2] / "sample_data"


@pytest.mark.parametrize("preamble", [True, False])
@pytest.mark.parametrize("syntax", [ImplicitVRLittleEndian, ExplicitVRLittleEndian, ExplicitVRBigEndian])
@pytest.mark.parametrize("dtype", ["<i2", "<u2", "<i4", "<u1"])
def test_uncompressed(tmp_path: Path, syntax: str, dtype: str, preamble: bool) -> None:
    stored = pixels(11, 13, dtype, low=0)  # odd sizes: 8-bit data get a padding byte
    ds = ct_slice(stored)
    if syntax == ExplicitVRBigEndian and dtype != "<u1":
        swap_to_big_endian(ds)
    path = write_dicom(tmp_path / "a", ds, syntax, preamble=preamble)
    images = open_images([path])
    (slice_,) = images
    some = slice_.rows(2, 7)  # before the rest is read
    np.testing.assert_array_equal(some, stored[2:7])
    np.testing.assert_array_equal(slice_.stored, stored)
    assert some.dtype == slice_.stored.dtype
    assert slice_.stored.dtype.isnative
    assert slice_.info.scale is not None
    assert (slice_.info.scale.s_x, slice_.info.scale.s_y) == (0.5, 0.75)
    assert any("no preamble" in warning for warning in images.warnings) is not preamble


def test_big_endian_bytes_in_words_change_places(tmp_path: Path) -> None:
    stored = pixels(11, 13, "<u1", low=0)
    ds = ct_slice(stored)
    ds.PixelData = np.frombuffer(ds.PixelData, "<u2").byteswap().tobytes()
    ds["PixelData"].VR = "OW"
    path = write_dicom(tmp_path / "a.dcm", ds, ExplicitVRBigEndian)
    np.testing.assert_array_equal(read_slices(path)[0].stored, pydicom.dcmread(path).pixel_array)
    np.testing.assert_array_equal(read_slices(path)[0].stored, stored)
    np.testing.assert_array_equal(next(iter(open_images([path]))).rows(3, 6), stored[3:6])


def test_bits_beyond_bits_stored_are_no_part_of_a_pixel(tmp_path: Path) -> None:
    for dtype, low in (("<u2", 0), ("<i2", -60)):
        stored = pixels(11, 13, dtype, low)
        ds = ct_slice((stored & 0x0FFF | 0x7000).astype(dtype), BitsStored=12, HighBit=11)
        path = write_dicom(tmp_path / "overlay.dcm", ds)
        np.testing.assert_array_equal(read_slices(path)[0].stored, stored)
        np.testing.assert_array_equal(next(iter(open_images([path]))).rows(4, 9), stored[4:9])


def test_bare_data_set_is_read_as_implicit_little_endian_with_a_warning(tmp_path: Path) -> None:
    images = open_images([write_dicom(tmp_path / "a", ct_slice(), ImplicitVRLittleEndian, preamble=False)])
    assert any("read as implicit VR little endian" in warning for warning in images.warnings)


def test_transfer_syntax_that_contradicts_the_data_is_mentioned(tmp_path: Path) -> None:
    raw = write_dicom(tmp_path / "a.dcm", ct_slice(), ImplicitVRLittleEndian).read_bytes()
    old = b"\x02\x00\x10\x00UI" + (18).to_bytes(2, "little") + b"1.2.840.10008.1.2\0"
    new = b"\x02\x00\x10\x00UI" + (20).to_bytes(2, "little") + b"1.2.840.10008.1.2.1\0"
    (tmp_path / "b.dcm").write_bytes(raw.replace(old, new, 1))
    images = open_images([tmp_path / "b.dcm"])
    np.testing.assert_array_equal(next(iter(images)).stored, pixels())
    assert any("Transfer Syntax UID (0002,0010)" in warning for warning in images.warnings)


def test_deflated(tmp_path: Path) -> None:
    path = write_dicom(tmp_path / "a.dcm", ct_slice(), DeflatedExplicitVRLittleEndian)
    np.testing.assert_array_equal(read_slices(path)[0].stored, pixels())


def test_rle(tmp_path: Path) -> None:
    ds = ct_slice()
    write_dicom(tmp_path / "plain.dcm", ds)
    ds.compress(RLELossless)
    path = write_dicom(tmp_path / "a.dcm", ds, RLELossless)
    np.testing.assert_array_equal(read_slices(path)[0].stored, pixels())


@pytest.mark.parametrize("syntax", CODESTREAMS)
def test_lossless_codecs_give_identical_pixels_or_name_the_extra(tmp_path: Path, syntax: str) -> None:
    path = write_dicom(tmp_path / "a.dcm", compressed_slice(syntax), syntax)
    if not dicom_pixels.codec_available(syntax):
        with pytest.raises(UnreadableSliceError, match=r"pip install 'ctreg-cli\[codecs\]'"):
            open_images([path])
        return
    images = open_images([path])
    (slice_,) = images
    np.testing.assert_array_equal(slice_.stored, pixels(*CODESTREAM_SHAPE))
    assert not any("with loss" in warning for warning in images.warnings)


def test_without_the_codec_the_one_line_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for k in range(3):
        write_dicom(tmp_path / f"{k}.dcm", compressed_slice("1.2.840.10008.1.2.4.70"), "1.2.840.10008.1.2.4.70")
    monkeypatch.setattr(dicom_pixels, "codec_available", lambda syntax: False)
    with pytest.raises(UnreadableSliceError) as caught:
        open_images([tmp_path])
    text = str(caught.value)
    assert text.endswith("compressed by JPEG Lossless; to read it: pip install 'ctreg-cli[codecs]'")
    assert len(text.splitlines()) == 1


@pytest.mark.parametrize(
    "name",
    [
        "693_J2KI.dcm",
        "J2K_pixelrep_mismatch.dcm",
        "JPEG2000.dcm",
        "JPEGLSNearLossless_08.dcm",
        "JPEGLSNearLossless_16.dcm",
        "MR_small_RLE.dcm",
        "MR_small_jp2klossless.dcm",
        "MR_small_jpeg_ls_lossless.dcm",
        "MR_small_bigendian.dcm",
        "MR_small_implicit.dcm",
        "CT_small.dcm",
        "examples_overlay.dcm",
        "image_dfl.dcm",
        "rtdose_expb.dcm",
        "rtdose_rle.dcm",
    ],
)
def test_files_of_others_agree_with_pydicom(name: str) -> None:
    path = Path(str(get_testdata_file(name, download=False)))
    ds = pydicom.dcmread(path)
    if not dicom_pixels.codec_available(ds.file_meta.TransferSyntaxUID):
        with pytest.raises(UnreadableSliceError, match="codecs"):
            read_slices(path)
        return
    expected = ds.pixel_array.reshape(-1, ds.Rows, ds.Columns)
    for slice_, frame in zip(read_slices(path), expected, strict=True):
        np.testing.assert_array_equal(slice_.stored, frame)


@pytest.mark.parametrize("name", ["693_J2KI.dcm", "JPEGLSNearLossless_16.dcm"])
def test_lossy_images_are_read_with_a_warning(name: str) -> None:
    path = Path(str(get_testdata_file(name, download=False)))
    if dicom_pixels.codec_available(pydicom.dcmread(path).file_meta.TransferSyntaxUID):
        assert any("with loss" in warning for warning in open_images([path]).warnings)


@pytest.mark.parametrize("folder", ["calib", "track"])
def test_sample_series_agree_with_pydicom(folder: str) -> None:
    images = open_images([SAMPLE_DATA / folder])
    assert [record.info.source for record in images.records] == sorted(
        path.name for path in (SAMPLE_DATA / folder).glob("*.dcm")
    )
    for slice_ in images:
        ds = pydicom.dcmread(SAMPLE_DATA / folder / slice_.info.source)
        np.testing.assert_array_equal(slice_.stored, ds.pixel_array)
        assert (slice_.slope, slice_.intercept) == (ds.RescaleSlope, ds.RescaleIntercept)
