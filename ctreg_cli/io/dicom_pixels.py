"""The pixels of a DICOM image: checked against the file before anything is allocated, read one frame at a time.

Uncompressed frames are read straight from their place in the file. Compressed ones go to pydicom's decoders (see
:mod:`ctreg_cli.io.dicom_decoding`) after the size written in the codestream itself was compared with Rows and Columns:
no decoder is let loose on an image whose size nobody agreed to.
"""

from __future__ import annotations

import os
import struct
import warnings
from dataclasses import dataclass
from io import FileIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydicom.encaps import get_frame
from pydicom.uid import (
    JPEG2000,
    UID,
    DeflatedExplicitVRLittleEndian,
    ExplicitVRBigEndian,
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
    JPEG2000TransferSyntaxes,
    JPEGBaseline8Bit,
    JPEGExtended12Bit,
    JPEGLSNearLossless,
    JPEGLSTransferSyntaxes,
    JPEGTransferSyntaxes,
    RLELossless,
)

from ctreg_cli.errors import UnreadableSliceError
from ctreg_cli.io.dicom_decoding import codec_available, decode
from ctreg_cli.io.dicom_header import (
    Header,
    HeaderProblem,
    PixelElement,
    inflate,
    open_binary,
    problem,
    tag_name,
)
from ctreg_cli.io.dicom_layout import Layout
from ctreg_cli.io.image_record import Pixels

#: an encapsulated frame has an item header of its own, so a file holds no more frames than this allows
MIN_ENCAPSULATED_FRAME_BYTES = 8

CODECS_REMEDY = "pip install 'ctreg-cli[codecs]'"
_NATIVE = (ImplicitVRLittleEndian, ExplicitVRLittleEndian, ExplicitVRBigEndian, DeflatedExplicitVRLittleEndian)
_CODEC_NAMES: dict[str, str] = {
    **dict.fromkeys(JPEGTransferSyntaxes, "JPEG Lossless"),
    JPEGBaseline8Bit: "JPEG",
    JPEGExtended12Bit: "JPEG Extended",
    **dict.fromkeys(JPEGLSTransferSyntaxes, "JPEG-LS"),
    **dict.fromkeys([uid for uid in JPEG2000TransferSyntaxes if "2000" in uid.name], "JPEG 2000"),
    RLELossless: "RLE",
}
_ALWAYS_LOSSY = (JPEGBaseline8Bit, JPEGExtended12Bit)
_MAYBE_LOSSY = (JPEGLSNearLossless, JPEG2000)


def locate(path: Path, header: Header, layout: Layout) -> list[Pixels]:
    """A reader a frame; nothing is read yet, but all that can be known from sizes is checked.

    Raises:
        HeaderProblem: no pixels, a kind that cannot be decoded, or a length that does not fit Rows × Columns.
    """
    element = pixel_element(header)
    if element.keyword != "PixelData":
        raise problem(element.keyword, "holds floating-point pixels, which no CT scanner stores")
    if header.transfer_syntax in _NATIVE:
        return _locate_native(path, header, element, layout)
    return _locate_encapsulated(path, header, element, layout)


def pixel_element(header: Header) -> PixelElement:
    """Where the pixels are.

    Raises:
        HeaderProblem: nowhere.
    """
    if header.pixels is None:
        raise problem("PixelData", "is missing: the file may be cut short")
    return header.pixels


def is_lossy(header: Header) -> bool:
    """Whether the image may have gone through lossy compression at some time."""
    said, syntax = header.elements.text("LossyImageCompression"), header.transfer_syntax
    return said == "01" or syntax in _ALWAYS_LOSSY or (syntax in _MAYBE_LOSSY and said != "00")


def excess_bytes(header: Header, layout: Layout) -> int:
    """Bytes of uncompressed Pixel Data beyond the frames (and the one that makes the length even)."""
    if header.pixels is None or header.pixels.length is None:
        return 0
    expected = layout.frame_bytes * layout.n_frames
    return max(0, header.pixels.length - expected - expected % 2)


def _locate_native(path: Path, header: Header, element: PixelElement, layout: Layout) -> list[Pixels]:
    needed = layout.frame_bytes * layout.n_frames
    if element.length is None:
        raise problem("PixelData", "has no length, though its transfer syntax is uncompressed")
    if element.offset + needed > header.size and not header.more:
        raise problem("PixelData", f"ends after {max(0, header.size - element.offset)} of {needed} bytes: cut short")
    if element.length < needed:
        raise problem("PixelData", f"holds {element.length} bytes, where Rows × Columns asks for {needed}")
    # a row or a column more would mean that Rows or Columns is wrong, and the image sheared
    if excess_bytes(header, layout) >= min(layout.rows, layout.columns) * layout.bits_allocated // 8:
        raise problem("PixelData", f"holds {element.length} bytes, where Rows × Columns asks for {needed}")
    little = header.elements.little_endian
    if header.deflated_from is not None:
        return [
            DeflatedPixels(
                path=str(path),
                start=header.deflated_from,
                offset=element.offset + frame * layout.frame_bytes,
                layout=layout,
            )
            for frame in range(layout.n_frames)
        ]
    return [
        NativePixels(
            path=str(path),
            offset=element.offset + frame * layout.frame_bytes,
            layout=layout,
            little_endian=little,
            swapped_words=not little and layout.bits_allocated == 8 and element.vr == "OW",
        )
        for frame in range(layout.n_frames)
    ]


def _locate_encapsulated(path: Path, header: Header, element: PixelElement, layout: Layout) -> list[Pixels]:
    name = _CODEC_NAMES.get(header.transfer_syntax)
    if name is None:
        raise problem("TransferSyntaxUID", "names a compression that is not supported")
    if not codec_available(header.transfer_syntax):
        raise HeaderProblem(f"the image is compressed by {name}; to read it: {CODECS_REMEDY}")
    if element.length is not None:
        raise problem("PixelData", "has a length, though its transfer syntax is compressed")
    if layout.n_frames > (header.size - element.offset) // MIN_ENCAPSULATED_FRAME_BYTES:
        raise problem("NumberOfFrames", f"is {layout.n_frames}, more than the file can hold")
    offsets = header.elements.value("ExtendedOffsetTable")
    lengths = header.elements.value("ExtendedOffsetTableLengths")
    return [
        EncapsulatedPixels(
            path=str(path),
            offset=element.offset,
            frame=frame,
            layout=layout,
            transfer_syntax=header.transfer_syntax,
            extended_offsets=(offsets, lengths) if offsets and lengths else None,
        )
        for frame in range(layout.n_frames)
    ]


@dataclass(frozen=True, slots=True, kw_only=True)
class NativePixels:
    """An uncompressed frame at a known place of a file."""

    path: str
    offset: int
    layout: Layout
    little_endian: bool = True
    #: 8-bit pixels written as big-endian words: every pair changed places (PS3.5 8.1.2)
    swapped_words: bool = False

    def load(self) -> NativePixels:
        """Itself, since it reads when it is asked to; but for the file's size, of which it is sure now."""
        try:
            size = os.stat(self.path).st_size  # noqa: PTH116  # a Path costs twice what the call does
        except OSError as error:
            raise UnreadableSliceError(f"the file cannot be read ({error.strerror})") from None
        if size < self.offset + self.layout.frame_bytes:
            raise UnreadableSliceError(f"{tag_name('PixelData')} is cut short")
        return self

    def whole(self) -> NDArray[Any]:
        """Read the frame; the array is read-only."""
        layout, count = self.layout, self.layout.rows * self.layout.columns
        if not self.swapped_words:
            return self.rows(0, layout.rows)
        start = self.offset - self.offset % 2  # words begin at even places, in the file as in DICOM's values
        words = self._read(np.dtype("u2"), (self.offset - start + count + 1) // 2, start)
        return _finished(words.byteswap().view(layout.dtype)[self.offset - start :][:count], layout)

    def rows(self, first: int, end: int) -> NDArray[Any]:
        """Read some rows, from ``first`` to before ``end``; the array is read-only."""
        if self.swapped_words:
            return self.whole()[first:end]
        layout = self.layout
        dtype = layout.dtype.newbyteorder("<" if self.little_endian else ">")
        place = self.offset + first * layout.columns * dtype.itemsize
        return _finished(self._read(dtype, (end - first) * layout.columns, place), layout)

    def _read(self, dtype: np.dtype[Any], count: int, offset: int) -> NDArray[Any]:
        stored = np.empty(count, dtype=dtype)
        try:
            with FileIO(self.path) as file:
                file.seek(offset)
                n_bytes = file.readinto(stored.data)
        except OSError as error:
            raise UnreadableSliceError(f"the file cannot be read ({error.strerror})") from None
        if n_bytes != stored.nbytes:
            raise UnreadableSliceError(f"{tag_name('PixelData')} is cut short")
        return stored


@dataclass(frozen=True, slots=True, kw_only=True)
class DeflatedPixels:
    """An uncompressed frame inside a deflated data set."""

    path: str
    #: where the deflated data set begins in the file
    start: int
    #: of the frame in the inflated data set
    offset: int
    layout: Layout

    def load(self) -> NDArray[Any]:
        """Inflate up to the end of the frame."""
        try:
            with open_binary(Path(self.path)) as file:
                file.seek(self.start)
                inflated, _ = inflate(file, self.offset + self.layout.frame_bytes)
        except HeaderProblem as error:
            raise UnreadableSliceError(str(error)) from None
        frame = inflated[self.offset :]
        if len(frame) < self.layout.frame_bytes:
            raise UnreadableSliceError(f"{tag_name('PixelData')} is cut short")
        dtype = self.layout.dtype.newbyteorder("<")
        return _finished(np.frombuffer(frame, dtype=dtype, count=self.layout.rows * self.layout.columns), self.layout)


@dataclass(frozen=True, slots=True, kw_only=True)
class EncapsulatedPixels:
    """A compressed frame."""

    path: str
    #: of the basic offset table's item
    offset: int
    frame: int
    layout: Layout
    transfer_syntax: UID
    extended_offsets: tuple[bytes, bytes] | None

    def load(self) -> NDArray[Any]:
        """Decode the frame; the array is read-only."""
        layout = self.layout
        codestream = self._codestream()
        shape = codestream_shape(codestream)
        if self.transfer_syntax != RLELossless and shape != (layout.rows, layout.columns):
            what = "holds a codestream of another size than Rows × Columns, or a damaged one"
            raise UnreadableSliceError(f"{tag_name('PixelData')} {what}")
        try:
            return decode(
                codestream,
                transfer_syntax=self.transfer_syntax,
                dtype=layout.dtype,
                rows=layout.rows,
                columns=layout.columns,
                bits_allocated=layout.bits_allocated,
                bits_stored=layout.bits_stored,
                pixel_representation=int(layout.signed),
            )
        except UnreadableSliceError as error:
            raise UnreadableSliceError(f"{tag_name('PixelData')} {error}") from None

    def _codestream(self) -> bytes:
        try:
            with open_binary(Path(self.path)) as file, warnings.catch_warnings():
                warnings.simplefilter("ignore")
                file.seek(self.offset)
                codestream: bytes = get_frame(
                    file, self.frame, number_of_frames=self.layout.n_frames, extended_offsets=self.extended_offsets
                )
        except HeaderProblem as error:
            raise UnreadableSliceError(str(error)) from None
        # damaged item headers and offset tables; pydicom raises ValueError, struct.error, EOFError, StopIteration, ...
        except Exception:  # noqa: BLE001
            raise UnreadableSliceError(f"{tag_name('PixelData')} has a damaged encapsulation") from None
        return codestream


def codestream_shape(codestream: bytes) -> tuple[int, int] | None:
    """(rows, columns) as a JPEG, JPEG-LS or JPEG 2000 codestream states them; None if it is none of these."""
    if (start := codestream[:512].find(b"\xff\x4f\xff\x51")) >= 0:  # SOC, SIZ; a JP2 box may stand before
        size = codestream[start + 8 : start + 24]
        if len(size) < 16:
            return None
        width, height, left, top = struct.unpack(">4I", size)
        return height - top, width - left
    if codestream[:2] != b"\xff\xd8":
        return None
    place = 2
    while place + 9 <= len(codestream) and codestream[place] == 0xFF:
        marker, length = codestream[place + 1], int.from_bytes(codestream[place + 2 : place + 4], "big")
        if marker == 0xFF:  # fill byte
            place += 1
        elif marker == 0xF7 or (0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC)):  # a start of frame
            rows, columns = struct.unpack(">2H", codestream[place + 5 : place + 9])
            return rows, columns
        else:
            place += 2 + length
    return None


def _finished(stored: NDArray[Any], layout: Layout) -> NDArray[Any]:
    """Rows, whole ones: native byte order, two dimensions, nothing in the bits beyond Bits Stored (old overlays)."""
    stored = stored.astype(layout.dtype, copy=False).reshape(-1, layout.columns)
    if layout.bits_stored < layout.bits_allocated:
        low, high = layout.stored_range
        # looking is ten times cheaper than shifting, and nearly always all there is to do
        if stored.max() > high or (layout.signed and stored.min() < low):
            unused = layout.bits_allocated - layout.bits_stored
            stored = np.right_shift(np.left_shift(stored, unused), unused)
    stored.flags.writeable = False
    return stored
