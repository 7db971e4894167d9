"""Broken and hostile files: one unreadable slice each, the tag named, nothing large allocated, nothing quoted."""

from __future__ import annotations

import struct
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pytest
from pydicom.data import get_testdata_file
from pydicom.uid import DeflatedExplicitVRLittleEndian, ExplicitVRLittleEndian, ImplicitVRLittleEndian, RLELossless

from ctreg_cli.errors import InputError, UnreadableSliceError
from ctreg_cli.imaging.slice import UnreadableSlice
from ctreg_cli.io import dicom_pixels
from ctreg_cli.io.dicom_pixels import codestream_shape
from ctreg_cli.io.images import open_images, read_slices
from tests.io.dicom_samples import (
    CANARY,
    CODESTREAMS,
    compressed_slice,
    ct_slice,
    dicom_bytes,
    pixels,
    replace_value,
    write_dicom,
)

GOOD = dicom_bytes(ct_slice())
#: more than any of these tests should ever need
MAX_ALLOCATED_BYTES = 40 * 2**20


def problem_of(folder: Path, raw: bytes, name: str = "odd.dcm") -> str:
    """Why these bytes are unreadable, alone (an error) and among slices (a value): both say the same."""
    write_dicom(folder / "in" / "good.dcm")
    path = folder / "in" / name
    path.write_bytes(raw)
    with pytest.raises(UnreadableSliceError) as caught:
        open_images([path])
    tracemalloc.start()
    try:
        slices = list(open_images([folder / "in"]))
        allocated = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert allocated < MAX_ALLOCATED_BYTES
    (bad,) = [item for item in slices if isinstance(item, UnreadableSlice)]
    assert len(slices) == 2
    assert str(caught.value) == f"{name}: {bad.problem}"
    assert CANARY not in bad.problem
    assert len(bad.problem.splitlines()) == 1
    return bad.problem


@pytest.mark.parametrize(
    ("keyword", "old", "new", "tag"),
    [
        ("PixelSpacing", b"0.75\\0.5", b"0,75\\0,5", "Pixel Spacing (0028,0030)"),
        ("PixelSpacing", b"0.75\\0.5", b"NaN \\0.5", "Pixel Spacing (0028,0030)"),
        ("PixelSpacing", b"0.75\\0.5", b"1e999\\.5", "Pixel Spacing (0028,0030)"),
        ("PixelSpacing", b"0.75\\0.5", b"0_75\\0.5", "Pixel Spacing (0028,0030)"),
        ("PixelSpacing", b"0.75\\0.5", b"CANARY!!", "Pixel Spacing (0028,0030)"),
        ("RescaleIntercept", b"-24 ", b"-2,4", "Rescale Intercept (0028,1052)"),
        ("RescaleSlope", b"2 ", b"x ", "Rescale Slope (0028,1053)"),
        ("SliceThickness", b"2.5 ", b"2,5 ", "Slice Thickness (0018,0050)"),
        ("ImagePositionPatient", b"-20.5", b"-20,5", "Image Position (Patient) (0020,0032)"),
    ],
)
def test_numbers_that_are_none(tmp_path: Path, keyword: str, old: bytes, new: bytes, tag: str) -> None:
    assert problem_of(tmp_path, replace_value(GOOD, keyword, old, new)).startswith(tag)


def test_every_truncation_is_an_unreadable_slice(tmp_path: Path) -> None:
    """Wherever a file is cut, it is a row with a reason; an empty .dcm too."""
    for length in [*range(0, len(GOOD), 97), len(GOOD) - 1]:
        (tmp_path / "a.dcm").write_bytes(GOOD[:length])
        with pytest.raises(UnreadableSliceError, match=r"^a\.dcm: "):
            open_images([tmp_path / "a.dcm"])
    assert "cut short" in problem_of(tmp_path, GOOD[:-1])
    assert problem_of(tmp_path, b"") == "the file is empty"
    assert "cut short" in problem_of(tmp_path, GOOD[:600])


def test_text_called_dcm(tmp_path: Path) -> None:
    assert "not DICOM" in problem_of(tmp_path, b"Patient CANARY was here\n" * 50)


def test_a_small_file_that_claims_gigabytes(tmp_path: Path) -> None:
    claims = ct_slice()
    claims.Rows, claims.Columns = 8000, 4000
    assert problem_of(tmp_path, dicom_bytes(claims)).startswith("Pixel Data (7FE0,0010)")
    claims.Rows, claims.Columns = 65000, 65000
    assert problem_of(tmp_path, dicom_bytes(claims)).startswith("Rows (0028,0010)")


def test_an_element_that_claims_gigabytes(tmp_path: Path) -> None:
    at = GOOD.index(b"\x08\x00\x60\x00CS")
    huge = b"\x09\x00\x10\x10UN\0\0" + struct.pack("<I", 0xFFFFFFF0) + b"x" * 16
    assert "Pixel Data (7FE0,0010)" in problem_of(tmp_path, GOOD[:at] + huge + GOOD[at:])


@pytest.mark.parametrize("deflated", [False, True])
def test_millions_of_empty_elements_are_not_walked_through(tmp_path: Path, deflated: bool) -> None:
    """Eight bytes each: a file of a few hundred megabytes, or a deflated one of a few kilobytes, would take minutes."""
    empty = b"\x09\x00\x10\x10LO\0\0" * 1_500_000
    if deflated:
        raw = dicom_bytes(ct_slice(), DeflatedExplicitVRLittleEndian)
        deflater = zlib.compressobj(9, wbits=-15)
        start = 132 + 12 + struct.unpack("<I", raw[140:144])[0]
        bomb = raw[:start] + deflater.compress(empty) + deflater.flush()
    else:
        at = GOOD.index(b"\x18\x00\x50\x00")
        bomb = GOOD[:at] + empty + GOOD[at:]
    assert "does not come within the first" in problem_of(tmp_path, bomb)


def test_a_deflated_bomb(tmp_path: Path) -> None:
    raw = dicom_bytes(ct_slice(), DeflatedExplicitVRLittleEndian)
    meta = raw[: 132 + 12 + struct.unpack("<I", raw[140:144])[0]]
    element = b"\x09\x00\x10\x10UN\0\0" + struct.pack("<I", 64 * 2**20)
    deflater = zlib.compressobj(9, wbits=-15)
    bomb = deflater.compress(element)
    for _ in range(64):
        bomb += deflater.compress(bytes(2**20))
    bomb += deflater.flush()
    assert "Pixel Data (7FE0,0010)" in problem_of(tmp_path, meta + bomb)
    assert "damaged" in problem_of(tmp_path, meta + b"\xff" * 500)
    assert "cut short" in problem_of(tmp_path, raw[:-100])


@pytest.mark.parametrize("implicit", [False, True])
def test_sequences_nested_without_end(tmp_path: Path, implicit: bool) -> None:
    raw = dicom_bytes(ct_slice(), ImplicitVRLittleEndian if implicit else ExplicitVRLittleEndian)
    at = raw.index(b"\x18\x00\x50\x00")
    sequence = b"\x08\x00\x40\x11" + (b"" if implicit else b"SQ\0\0") + b"\xff" * 4
    level = sequence + b"\xfe\xff\x00\xe0" + b"\xff" * 4
    assert "nested too deeply" in problem_of(tmp_path, raw[:at] + level * 50_000 + raw[at:])


def test_deeply_nested_functional_groups_of_known_length(tmp_path: Path) -> None:
    inner = b""
    for _ in range(3000):
        item = b"\xfe\xff\x00\xe0" + struct.pack("<I", len(inner)) + inner
        inner = b"\x00\x52\x29\x92SQ\0\0" + struct.pack("<I", len(item)) + item
    at = GOOD.index(b"\xe0\x7f\x10\x00")
    path = tmp_path / "a.dcm"
    path.write_bytes(GOOD[:at] + inner + GOOD[at:])
    np.testing.assert_array_equal(read_slices(path)[0].stored, pixels())  # what nobody opens does no harm


@pytest.mark.parametrize("keyword", ["FloatPixelData", "DoubleFloatPixelData"])
def test_float_pixels(tmp_path: Path, keyword: str) -> None:
    ds = ct_slice()
    del ds.PixelData
    setattr(ds, keyword, np.zeros((24, 32), "<f4" if keyword == "FloatPixelData" else "<f8").tobytes())
    assert "floating-point" in problem_of(tmp_path, dicom_bytes(ds))


def test_no_pixel_data(tmp_path: Path) -> None:
    ds = ct_slice()
    del ds.PixelData
    assert problem_of(tmp_path, dicom_bytes(ds)).startswith("Pixel Data (7FE0,0010) is missing")


@pytest.mark.parametrize(
    ("name", "tag"),
    [
        ("examples_palette.dcm", "Photometric Interpretation (0028,0004)"),
        ("examples_rgb_color.dcm", "Photometric Interpretation (0028,0004)"),
        ("liver_1frame.dcm", "Bits Allocated (0028,0100)"),
        ("badVR.dcm", "Number of Frames (0028,0008)"),
        ("MR_truncated.dcm", "Pixel Data (7FE0,0010)"),
        ("MR_small_padded.dcm", "Pixel Data (7FE0,0010)"),
        ("JPEG2000-embedded-sequence-delimiter.dcm", "Pixel Data (7FE0,0010)"),
    ],
)
def test_files_of_others(name: str, tag: str) -> None:
    path = Path(str(get_testdata_file(name, download=False)))
    with pytest.raises(UnreadableSliceError) as caught:
        open_images([path])
    assert str(caught.value).startswith(f"{name}: {tag}")


def test_a_few_bytes_too_many_are_left_aside_with_a_warning(tmp_path: Path) -> None:
    ds = ct_slice()
    ds.PixelData += bytes(20)
    images = open_images([write_dicom(tmp_path / "a.dcm", ds)])
    np.testing.assert_array_equal(next(iter(images)).stored, pixels())
    assert any("Pixel Data (7FE0,0010)" in warning for warning in images.warnings)


def test_unknown_compression(tmp_path: Path) -> None:
    syntax = "1.2.840.10008.1.2.4.100"  # MPEG-2
    raw = dicom_bytes(compressed_slice("1.2.840.10008.1.2.4.90"), syntax)
    assert problem_of(tmp_path, raw).startswith("Transfer Syntax UID (0002,0010)")


@pytest.mark.parametrize("syntax", CODESTREAMS)
def test_damaged_codestreams(tmp_path: Path, syntax: str) -> None:
    if not dicom_pixels.codec_available(syntax):
        pytest.skip("the codecs extra is not installed")
    good = dicom_pixels.get_frame(compressed_slice(syntax).PixelData, 0, number_of_frames=1)
    for broken in (b"\xff\xd8", good[:20], bytes(len(good)), good[len(good) // 2 :]):
        raw = dicom_bytes(compressed_slice(syntax, broken), syntax)
        assert problem_of(tmp_path, raw).startswith("Pixel Data (7FE0,0010)")


@pytest.mark.parametrize("syntax", CODESTREAMS)
def test_a_codestream_of_another_size_never_reaches_the_decoder(tmp_path: Path, syntax: str) -> None:
    if not dicom_pixels.codec_available(syntax):
        pytest.skip("the codecs extra is not installed")
    ds = compressed_slice(syntax)
    ds.Rows, ds.Columns = 10, 12
    assert "another size" in problem_of(tmp_path, dicom_bytes(ds, syntax))


def test_rle_that_expands_to_another_size(tmp_path: Path) -> None:
    header = struct.pack("<16I", 2, 64, 66, *[0] * 13)
    raw = dicom_bytes(compressed_slice("1.2.840.10008.1.2.4.90", header + b"\xff\x00" * 2), RLELossless)
    assert problem_of(tmp_path, raw).startswith("Pixel Data (7FE0,0010)")


def test_codestream_shapes() -> None:
    assert codestream_shape(b"\xff\xd8\xff\xff\xc3\x00\x0b\x0c\x01\x02\x03\x04\x01\x00") == (0x0102, 0x0304)
    assert codestream_shape(b"\xff\xd8\xff\xfe\x00\x04ab\xff\xc4\x00\x02\xff\xf7\x00\x0b\x08\x00\x02\x00\x03") == (2, 3)
    jpeg2000 = b"\xff\x4f\xff\x51\x00\x29\x00\x00" + struct.pack(">4I", 15, 26, 5, 6)
    assert codestream_shape(b"jP box" + jpeg2000) == (20, 10)
    for nothing in (b"", b"\xff\xd8", b"\xff\xd8\xff\xd9", b"\xff\x4f\xff\x51", b"\x89PNG"):
        assert codestream_shape(nothing) is None


def test_a_file_that_vanishes_is_an_unreadable_slice(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_dicom(tmp_path / f"{name}.dcm")
    images = open_images([tmp_path])
    (tmp_path / "b.dcm").unlink()
    _, second = images
    assert isinstance(second, UnreadableSlice)
    assert "cannot be read" in second.problem


def test_a_file_cut_after_the_scan_is_an_unreadable_slice(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_dicom(tmp_path / f"{name}.dcm")
    images = open_images([tmp_path])
    (tmp_path / "b.dcm").write_bytes(GOOD[:-8])
    assert isinstance(list(images)[1], UnreadableSlice)


def test_reports_and_plans_alone_are_no_slices() -> None:
    for name in ("rtstruct.dcm", "test-SR.dcm", "DICOMDIR"):
        with pytest.raises(InputError, match="DICOM without an image"):
            open_images([Path(str(get_testdata_file(name, download=False)))])
