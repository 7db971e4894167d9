"""What the Image Pixel attributes say: size and kind of the stored values, and what they mean."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ctreg_cli.io.dicom_header import Elements, once_a_series, problem

#: the largest CT matrices are 2048 × 2048; a small file must not claim gigabytes
MAX_PIXELS = 2**25
#: the same for frames, each of which costs a record
MAX_FRAMES = 2**16

_GREY = {"MONOCHROME1", "MONOCHROME2"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """How one frame is stored."""

    rows: int
    columns: int
    bits_allocated: int
    bits_stored: int
    signed: bool
    #: small stored values are bright
    inverted: bool
    n_frames: int

    @property
    def dtype(self) -> np.dtype[Any]:
        """Of the stored values, in this machine's byte order."""
        return np.dtype(f"{'i' if self.signed else 'u'}{self.bits_allocated // 8}")

    @property
    def frame_bytes(self) -> int:
        """Bytes of one uncompressed frame."""
        return self.rows * self.columns * self.bits_allocated // 8

    @property
    def stored_range(self) -> tuple[int, int]:
        """Least and greatest value that Bits Stored can hold."""
        n = 2**self.bits_stored
        return (-n // 2, n // 2 - 1) if self.signed else (0, n - 1)


@once_a_series(
    *("PhotometricInterpretation", "SamplesPerPixel", "Rows", "Columns", "NumberOfFrames"),
    *("BitsAllocated", "BitsStored", "HighBit", "PixelRepresentation"),
)
def read_layout(elements: Elements) -> Layout:
    """The Image Pixel attributes.

    Raises:
        HeaderProblem: one of them is missing, malformed, or describes no grey image of integers.
    """
    photometric = elements.text("PhotometricInterpretation")
    samples = elements.integer("SamplesPerPixel")
    if samples not in (None, 1) or photometric not in _GREY:
        if not photometric:
            raise problem("PhotometricInterpretation", "is missing")
        raise problem("PhotometricInterpretation", "is not MONOCHROME1 or MONOCHROME2: colour is no CT slice")
    rows, columns = (_required(elements, keyword) for keyword in ("Rows", "Columns"))
    for keyword, value in (("Rows", rows), ("Columns", columns)):
        if value < 1:
            raise problem(keyword, "is 0")
    if rows * columns > MAX_PIXELS:
        raise problem("Rows", f"times Columns is {rows * columns} pixels, more than the {MAX_PIXELS} allowed")
    allocated = _required(elements, "BitsAllocated")
    if allocated not in (8, 16, 32):
        raise problem("BitsAllocated", f"is {allocated}, not 8, 16 or 32")
    stored = elements.integer("BitsStored")
    stored = allocated if stored is None else stored
    if not 1 <= stored <= allocated:
        raise problem("BitsStored", f"is {stored}, where {allocated} are allocated")
    high_bit = elements.integer("HighBit")
    if high_bit is not None and high_bit != stored - 1:
        raise problem("HighBit", f"is {high_bit}, where {stored} bits are stored")
    representation = _required(elements, "PixelRepresentation")
    if representation not in (0, 1):
        raise problem("PixelRepresentation", "is not 0 or 1")
    n_frames = elements.integer("NumberOfFrames")
    if n_frames is not None and not 0 <= n_frames <= MAX_FRAMES:
        raise problem("NumberOfFrames", f"is {n_frames}, not between 1 and {MAX_FRAMES}")
    return Layout(
        rows=rows,
        columns=columns,
        bits_allocated=allocated,
        bits_stored=stored,
        signed=representation == 1,
        inverted=photometric == "MONOCHROME1",
        n_frames=n_frames or 1,
    )


@once_a_series("RescaleSlope", "RescaleIntercept", "ModalityLUTSequence")
def read_rescale(elements: Elements, layout: Layout) -> tuple[float, float]:
    """(slope, intercept) of ``value = slope * stored + intercept``; 1 and 0 where the file has none.

    A MONOCHROME1 image stores bright as small: its scale is turned round within the range of Bits Stored, unless its
    slope is negative and so has done that already.

    Raises:
        HeaderProblem: malformed, a slope of 0, or a look-up table in their place.
    """
    slope, intercept = elements.decimal("RescaleSlope"), elements.decimal("RescaleIntercept")
    if slope is None and "ModalityLUTSequence" in elements:
        raise problem("ModalityLUTSequence", "is not supported")
    slope, intercept = 1.0 if slope is None else slope, intercept or 0.0
    if slope == 0:
        raise problem("RescaleSlope", "is 0")
    if layout.inverted and slope > 0:
        return -slope, intercept + slope * sum(layout.stored_range)
    return slope, intercept


@once_a_series("PixelPaddingValue", "PixelPaddingRangeLimit")
def read_padding(elements: Elements, layout: Layout) -> tuple[float, float] | None:
    """Inclusive range of stored values that are no image (PS3.3 C.7.5.1.1.2), or None."""
    value = elements.integer("PixelPaddingValue", signed=layout.signed)
    if value is None:
        return None
    limit = elements.integer("PixelPaddingRangeLimit", signed=layout.signed)
    other = value if limit is None else limit
    return float(min(value, other)), float(max(value, other))


def _required(elements: Elements, keyword: str) -> int:
    value = elements.integer(keyword)
    if value is None:
        raise problem(keyword, "is missing")
    return value
