"""PNG slices: grey values as they are; everything else refused with the remedy."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ctreg_cli.errors import InputError, UnreadableSliceError
from ctreg_cli.imaging.slice import UnreadableSlice
from ctreg_cli.io.images import open_images, read_slices


def save(path: Path, mode: str, array: np.ndarray | None = None, **options: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = Image.fromarray(array) if array is not None else Image.new(mode, (6, 4))
    image.save(path, format="PNG", **options)
    return path


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_grey_values(tmp_path: Path, dtype: type) -> None:
    values = np.random.default_rng(1).integers(0, np.iinfo(dtype).max, (5, 7), dtype, endpoint=True)
    (slice_,) = read_slices(save(tmp_path / "a.png", "", values))
    np.testing.assert_array_equal(slice_.stored, values)
    assert slice_.stored.dtype == dtype
    assert (slice_.slope, slice_.intercept, slice_.padding) == (1, 0, None)
    info = slice_.info
    assert (info.source, info.shape, info.scale, info.T_patient_slice, info.time_s) == (
        "a.png",
        (5, 7),
        None,
        None,
        None,
    )


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "P", "LA", "1"])
def test_what_is_not_plain_grey_is_refused_with_the_remedy(tmp_path: Path, mode: str) -> None:
    with pytest.raises(UnreadableSliceError, match=r"^a\.png: .*save it as 8- or 16-bit grey without alpha$"):
        open_images([save(tmp_path / "a.png", mode)])


def test_a_transparent_grey_value_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UnreadableSliceError, match="without alpha"):
        open_images([save(tmp_path / "a.png", "L", transparency=0)])


def test_natural_order_across_folders(tmp_path: Path) -> None:
    names = ["s10.png", "s2.png", "s1.PNG", "s02.png", "sub/s1.png"]
    for name in names:
        save(tmp_path / name, "L")
    (tmp_path / "notes.txt").write_text("s3.png")
    images = open_images([tmp_path])
    assert [item.info.source for item in images] == ["s1.PNG", "s02.png", "s2.png", "s10.png", "sub/s1.png"]
    assert images.skipped == {"not an image": 1}
    assert images.warnings == ()


def test_a_png_by_content_needs_no_name(tmp_path: Path) -> None:
    assert len(open_images([save(tmp_path / "slice", "L")])) == 1


@pytest.mark.parametrize("keep", [0, 4, 20, 60, -5])
def test_cut_short(tmp_path: Path, keep: int) -> None:
    values = np.random.default_rng(1).integers(0, 255, (30, 30), np.uint8)
    raw = save(tmp_path / "good.png", "", values).read_bytes()
    (tmp_path / "bad.png").write_bytes(raw[: len(raw) + keep if keep < 0 else keep])
    if keep >= 0 and keep < 40:
        with pytest.raises(UnreadableSliceError, match="damaged or cut short"):
            open_images([tmp_path / "bad.png"])
    items = {item.info.source: item for item in open_images([tmp_path])}
    assert set(items) == {"good.png", "bad.png"}
    if keep >= 0:
        assert isinstance(items["bad.png"], UnreadableSlice)


def test_a_decompression_bomb(tmp_path: Path) -> None:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 0, 0, 0, 0)
    raw = (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(bytes(10**6)))
        + chunk(b"IEND", b"")
    )
    (tmp_path / "bomb.png").write_bytes(raw)
    with pytest.raises(UnreadableSliceError, match="more pixels than a slice can have"):
        open_images([tmp_path / "bomb.png"])


def test_jpeg_is_no_input(tmp_path: Path) -> None:
    Image.new("L", (8, 8)).save(tmp_path / "a.jpg")
    with pytest.raises(InputError, match="1 × not an image"):
        open_images([tmp_path / "a.jpg"])
