"""The one-pass reader of plain headers reads what pydicom's generator reads, or says nothing."""

from __future__ import annotations

import io
import random
import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydicom.uid import ExplicitVRBigEndian, ExplicitVRLittleEndian, ImplicitVRLittleEndian

from ctreg_cli.io import dicom_header
from ctreg_cli.io.dicom_header import Header, HeaderProblem, read_header
from ctreg_cli.io.dicom_plain import HEAD_BYTES
from tests.io.dicom_samples import ct_slice, dicom_bytes, enhanced_ct, item, pixels, swap_to_big_endian
from tests.io.test_fuzz import mutate

SAMPLES = sorted((Path(__file__).parents[2] / "sample_data").rglob("*.dcm"))
N_MUTATED = 3000
NOT_PLAIN = {"long header", "big endian", "bare", "undefined length", "charset ISO_IR 144"}


def is_plain(raw: bytes) -> bool:
    return dicom_header._read_plain(raw[:HEAD_BYTES]) is not None


def told(header: Header) -> tuple[Any, ...]:
    """All a header says; absent and empty values are the same to whoever asks for them."""

    def elements(raw: dict[int, Any]) -> dict[int, Any]:
        return {
            int(e.tag): (e.VR, e.length, e.value or None, e.is_implicit_VR, e.is_little_endian) for e in raw.values()
        }

    return (
        elements(header.elements.raw),
        elements(header.meta.raw),
        header.elements.little_endian,
        header.transfer_syntax,
        header.implicit_vr,
        header.pixels,
        header.deflated_from,
        header.size,
        header.more,
        header.notes,
    )


def by_pydicom(raw: bytes, monkeypatch: pytest.MonkeyPatch) -> tuple[Any, ...] | None:
    """What the general reader says; None where it refuses."""
    with monkeypatch.context() as patched, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # as :mod:`ctreg_cli.io.dicom` does
        patched.setattr(dicom_header, "_read_plain", lambda _: None)
        try:
            return told(read_header(io.BytesIO(raw), len(raw)))
        except (HeaderProblem, RecursionError):
            return None
        except Exception:  # noqa: BLE001  what a damaged file may raise, :mod:`ctreg_cli.io.dicom` catches
            return None


def examples() -> dict[str, bytes]:
    charset = {name: ct_slice(SpecificCharacterSet=name) for name in ("ISO_IR 100", "ISO_IR 192", "ISO_IR 144")}
    sequence = ct_slice(RequestAttributesSequence=item(), ModalityLUTSequence=item(LUTExplanation="x"))
    undefined = ct_slice(RequestAttributesSequence=item())
    undefined["RequestAttributesSequence"].is_undefined_length = True
    frames = [{"PlanePositionSequence": item(ImagePositionPatient=[0, 0, k])} for k in range(3)]
    return {
        "explicit": dicom_bytes(ct_slice()),
        "implicit": dicom_bytes(ct_slice(), ImplicitVRLittleEndian),
        "unsigned": dicom_bytes(ct_slice(pixels(16, 20, "<u2", 0), PixelPaddingValue=0)),
        "eight bits": dicom_bytes(ct_slice(pixels(4, 5, "<u1", 0))),
        "empty values": dicom_bytes(ct_slice(InstanceNumber="", SliceThickness="")),
        "long header": dicom_bytes(ct_slice(TextValue="x" * 2 * HEAD_BYTES)),
        "sequences": dicom_bytes(sequence),
        "implicit sequences": dicom_bytes(sequence, ImplicitVRLittleEndian),
        "undefined length": dicom_bytes(undefined),
        "big endian": dicom_bytes(swap_to_big_endian(ct_slice()), ExplicitVRBigEndian),
        "bare": dicom_bytes(ct_slice(), preamble=False),
        "enhanced": dicom_bytes(enhanced_ct(np.stack([pixels()] * 3), frames, PixelMeasuresSequence=item())),
        **{f"charset {name}": dicom_bytes(ds) for name, ds in charset.items()},
    }


@pytest.mark.parametrize("name", examples())
def test_what_both_read_is_the_same(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    raw = examples()[name]
    assert told(read_header(io.BytesIO(raw), len(raw))) == by_pydicom(raw, monkeypatch)
    assert is_plain(raw) == (name not in NOT_PLAIN)


@pytest.mark.parametrize("path", SAMPLES, ids=lambda path: path.name)
def test_the_sample_slices_are_plain(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    raw = path.read_bytes()
    assert is_plain(raw)
    assert told(read_header(io.BytesIO(raw), len(raw))) == by_pydicom(raw, monkeypatch)


@pytest.mark.parametrize("seed", range(4))
def test_of_damaged_files_both_read_the_same_as_well(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Wherever the quick reader says anything; pydicom's refusal counts as another answer."""
    bases, rng, n_plain = list(examples().values()), random.Random(seed), 0
    for k in range(N_MUTATED // 4):
        raw = mutate(bases[k % len(bases)], rng)
        if is_plain(raw):
            n_plain += 1
            assert told(read_header(io.BytesIO(raw), len(raw))) == by_pydicom(raw, monkeypatch), (seed, k)
    assert n_plain > N_MUTATED // 40


@pytest.mark.parametrize(
    ("syntax", "data"),
    [
        (ExplicitVRLittleEndian, struct.pack("<HHL", 0x0008, 0x0016, 2) + b"1\0"),
        (ImplicitVRLittleEndian, struct.pack("<HH2sH", 0x0008, 0x0016, b"UI", 2) + b"1\0"),
    ],
)
def test_a_data_set_that_contradicts_its_meta_is_left_to_pydicom(syntax: str, data: bytes) -> None:
    raw = dicom_bytes(ct_slice(), syntax)
    at = raw.index(struct.pack("<HH", 0x0008, 0x0008))
    assert is_plain(raw)
    assert not is_plain(raw[:at] + data + raw[at:])


def test_an_element_that_is_there_twice_is_left_to_pydicom(monkeypatch: pytest.MonkeyPatch) -> None:
    raw = dicom_bytes(ct_slice())
    at = raw.index(struct.pack("<HH", 0x0018, 0x0050))
    once = raw[at : at + 8 + struct.unpack_from("<H", raw, at + 6)[0]]
    twice = raw[:at] + once + raw[at:]
    assert not is_plain(twice)
    assert told(read_header(io.BytesIO(twice), len(twice))) == by_pydicom(twice, monkeypatch)


def test_of_files_laid_out_alike_each_has_its_own_values(monkeypatch: pytest.MonkeyPatch) -> None:
    raws = [dicom_bytes(ct_slice(InstanceNumber=n, SliceThickness=f"{n % 3 + 1}.5")) for n in range(1, 10)]
    headers = [read_header(io.BytesIO(raw), len(raw)) for raw in raws]
    for raw, header in zip(raws, headers, strict=True):  # the first are what they were when the last were read
        assert told(header) == by_pydicom(raw, monkeypatch)
