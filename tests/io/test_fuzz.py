"""Thousands of damaged files: no exception but our own, no hang, no flood of memory, and never a wrong geometry.

The oracle for geometry is a parser of its own, for explicit VR little endian: whatever the reader says of a damaged
file must be absent, or stand in the file for that parser too.
"""

from __future__ import annotations

import base64
import random
import resource
import signal
import struct
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

import numpy as np
import pytest
from pydicom.uid import DeflatedExplicitVRLittleEndian, ExplicitVRBigEndian, ImplicitVRLittleEndian, RLELossless

from ctreg_cli.imaging.slice import Slice, UnreadableSlice
from ctreg_cli.io import dicom_decoding
from ctreg_cli.io.dicom import NotAnImage, read_dicom
from ctreg_cli.io.dicom_decoding import codec_available
from ctreg_cli.io.png import read_png
from tests.io.dicom_samples import (
    CODESTREAMS,
    compressed_slice,
    ct_slice,
    dicom_bytes,
    enhanced_ct,
    item,
    pixels,
    swap_to_big_endian,
    write_dicom,
)

N_EXPLICIT, N_OTHERS, N_PNG, N_CODESTREAMS = 2400, 300, 300, 30
HANG_S = 2.0
MAX_GROWTH_BYTES = 100 * 2**20

_LONG_VRS = {b"OB", b"OW", b"OF", b"OD", b"OL", b"OV", b"SQ", b"UC", b"UN", b"UR", b"UT", b"SV", b"UV"}


class Hang(BaseException):
    """Past every ``except Exception`` of the code under test."""


@contextmanager
def no_hang() -> Iterator[None]:
    """Break off what uses the processor for too long (not what merely waits on a busy machine)."""

    def give_up(number: int, frame: FrameType | None) -> None:
        raise Hang

    previous = signal.signal(signal.SIGVTALRM, give_up)
    signal.setitimer(signal.ITIMER_VIRTUAL, HANG_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, previous)


def mutate(raw: bytes, rng: random.Random) -> bytes:
    """One to four injuries: bytes, bits, lengths, tags and VRs, cuts, doublings, fillings."""
    data = bytearray(raw)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        if len(data) < 16:
            break
        at = rng.randrange(len(data) if rng.random() < 0.2 else min(len(data), 1200))
        kind = rng.randrange(8)
        if kind == 0:
            data[at] = rng.randrange(256)
        elif kind == 1:
            data[at] ^= 1 << rng.randrange(8)
        elif kind == 2:
            del data[at:]
        elif kind == 3:
            del data[at : at + rng.randint(1, 40)]
        elif kind == 4:
            data[at:at] = rng.randbytes(rng.randint(1, 12))
        elif kind == 5:
            data[at : at + 4] = rng.choice(
                (b"\xff" * 4, b"\0" * 4, b"\xfe\xff\x00\xe0", b"\xfe\xff\xdd\xe0", b"SQ\0\0")
            )
        elif kind == 6:
            data[at : at + 2] = rng.choice((b"SQ", b"UN", b"OW", b"DS", b"US", b"UL", b"FD", b"\0\0", b"ZZ"))
        else:
            start = rng.randrange(len(data))
            data[at:at] = data[start : start + rng.randint(8, 200)]
    return bytes(data)


def read(path: Path, raw: bytes) -> list[Slice | UnreadableSlice]:
    """All that a file gives; whatever it raises fails the test."""
    path.write_bytes(raw)
    with no_hang():
        records = read_dicom(path, "file")
        items = [] if isinstance(records, NotAnImage) else [record.load() for record in records]
    for one in items:
        if isinstance(one, UnreadableSlice):
            assert one.problem
            assert len(one.problem.splitlines()) == 1
            assert "CANARY" not in one.problem
        else:
            assert one.stored.shape == one.info.shape
            assert one.stored.nbytes < MAX_GROWTH_BYTES
    return items


@contextmanager
def bounded_memory() -> Iterator[None]:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024 < MAX_GROWTH_BYTES


def elements(raw: bytes) -> dict[int, list[bytes]]:
    """Independent of pydicom: every value that stands behind a tag, at the top level of a well-formed stretch."""
    found: dict[int, list[bytes]] = {}
    for tag in (0x00280030, 0x00200032, 0x00200037):
        mark = struct.pack("<HH", tag >> 16, tag & 0xFFFF)
        at = raw.find(mark)
        while at >= 0:
            vr = raw[at + 4 : at + 6]
            if vr in _LONG_VRS:
                length, start = int.from_bytes(raw[at + 8 : at + 12], "little"), at + 12
            else:
                length, start = int.from_bytes(raw[at + 6 : at + 8], "little"), at + 8
            implicit = int.from_bytes(raw[at + 4 : at + 8], "little")
            found.setdefault(tag, []).extend([raw[start : start + length], raw[at + 8 : at + 8 + min(implicit, 4096)]])
            at = raw.find(mark, at + 1)
    return found


def numbers(value: bytes) -> list[float] | None:
    try:
        return [float(part) for part in value.decode("ascii").replace("\0", " ").split("\\")]
    except ValueError:
        return None


def stands_in_the_file(raw: bytes, tag: int, expected: list[float], tolerance: float = 1e-9) -> bool:
    """Whether some element of this tag holds these numbers."""
    candidates = [numbers(value) for value in elements(raw).get(tag, [])]
    return any(
        one is not None and len(one) == len(expected) and np.allclose(one, expected, rtol=0, atol=tolerance)
        for one in candidates
    )


def assert_geometry_stands_in(raw: bytes, one: Slice) -> None:
    """What is said of scale and place is absent, or stands in the file."""
    scale, T = one.info.scale, one.info.T_patient_slice
    if scale is not None:
        assert stands_in_the_file(raw, 0x00280030, [scale.s_y, scale.s_x])
    if T is not None:
        assert stands_in_the_file(raw, 0x00200032, T[:3, 3].tolist())
        assert stands_in_the_file(raw, 0x00200037, T[:3, :2].T.ravel().tolist(), tolerance=5e-3)


def test_damaged_explicit_files_never_give_a_geometry_that_is_not_in_them(tmp_path: Path) -> None:
    bases = [
        dicom_bytes(ct_slice(pixels(16, 20), InstanceNumber=7)),
        dicom_bytes(ct_slice(pixels(64, 64, "<u2", 0), PixelPaddingValue=0, BitsStored=12, HighBit=11)),
        dicom_bytes(
            ct_slice(pixels(16, 16), ImageOrientationPatient=[0, 1, 0, 0, 0, -1], RequestAttributesSequence=item())
        ),
    ]
    rng = random.Random(20240229)
    readable = 0
    with bounded_memory():
        for k in range(N_EXPLICIT):
            raw = mutate(bases[k % len(bases)], rng)
            for one in read(tmp_path / "f.dcm", raw):
                if isinstance(one, UnreadableSlice):
                    continue
                readable += 1
                assert_geometry_stands_in(raw, one)
    assert N_EXPLICIT // 10 < readable < N_EXPLICIT  # the injuries neither all kill nor all miss


@pytest.mark.parametrize("kind", ["implicit", "big endian", "bare", "deflated", "rle", "enhanced"])
def test_damaged_files_of_other_kinds(tmp_path: Path, kind: str) -> None:
    ds = ct_slice(pixels(16, 20))
    if kind == "enhanced":
        frames = np.stack([pixels(16, 20)] * 3)
        places = [{"PlanePositionSequence": item(ImagePositionPatient=[0, 0, k])} for k in range(3)]
        ds = enhanced_ct(frames, places, PixelMeasuresSequence=item(PixelSpacing=[1, 2], SliceThickness=1))
    if kind == "big endian":
        swap_to_big_endian(ds)
    if kind == "rle":
        write_dicom(tmp_path / "plain.dcm", ds)
        ds.compress(RLELossless)
    syntax = {
        "implicit": ImplicitVRLittleEndian,
        "bare": ImplicitVRLittleEndian,
        "big endian": ExplicitVRBigEndian,
        "deflated": DeflatedExplicitVRLittleEndian,
        "rle": RLELossless,
    }
    options = {"preamble": False} if kind == "bare" else {}
    raw = dicom_bytes(ds, *([syntax[kind]] if kind in syntax else []), **options)
    rng = random.Random(kind)
    with bounded_memory():
        for _ in range(N_OTHERS if kind != "rle" else N_OTHERS // 3):
            damaged = mutate(raw, rng)
            for one in read(tmp_path / "f.dcm", damaged):
                if kind in ("implicit", "bare", "rle") and isinstance(one, Slice):
                    assert_geometry_stands_in(damaged, one)


@pytest.mark.parametrize("syntax", CODESTREAMS)
def test_damaged_codestreams(tmp_path: Path, syntax: str) -> None:
    """Decoded in another process, which may die or spin: then it is ended, and the next slice has a new one."""
    if not codec_available(syntax):
        pytest.skip("the codecs extra is not installed")
    rng, good = random.Random(syntax), base64.b85decode(CODESTREAMS[syntax])
    whole = dicom_bytes(compressed_slice(syntax), syntax)
    with bounded_memory():
        for k in range(N_CODESTREAMS):
            raw = mutate(whole, rng) if k % 2 else dicom_bytes(compressed_slice(syntax, mutate(good, rng)), syntax)
            read(tmp_path / "f.dcm", raw)
    (unharmed,) = read(tmp_path / "f.dcm", whole)
    assert isinstance(unharmed, Slice)


def test_a_decoder_that_spins_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    syntax = "1.2.840.10008.1.2.4.70"
    if not codec_available(syntax):
        pytest.skip("the codecs extra is not installed")
    process = dicom_decoding._DecoderProcess()
    spinning = subprocess.Popen(
        [sys.executable, "-c", "import time; time.sleep(600)"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    process._process = spinning
    monkeypatch.setattr(dicom_decoding, "_process_of", lambda pid: process)
    monkeypatch.setattr(dicom_decoding, "TIMEOUT_S", 0.2)
    path = write_dicom(tmp_path / "a.dcm", compressed_slice(syntax), syntax)
    records = read_dicom(path, "a.dcm")
    assert not isinstance(records, NotAnImage)
    (record,) = records
    broken_off = record.load()
    assert isinstance(broken_off, UnreadableSlice)
    assert broken_off.problem.startswith("Pixel Data (7FE0,0010)")
    assert spinning.poll() is not None
    monkeypatch.setattr(dicom_decoding, "TIMEOUT_S", 60.0)
    assert isinstance(record.load(), Slice)
    process.stop()


def test_damaged_png(tmp_path: Path) -> None:
    from PIL import Image

    path = tmp_path / "a.png"
    Image.fromarray(pixels(16, 20, "<u2", 0)).save(path)
    raw, rng = path.read_bytes(), random.Random(5)
    with bounded_memory():
        for _ in range(N_PNG):
            path.write_bytes(mutate(raw, rng))
            with no_hang():
                one = read_png(path, "a.png").load()
            assert isinstance(one, UnreadableSlice) or one.stored.shape == one.info.shape
