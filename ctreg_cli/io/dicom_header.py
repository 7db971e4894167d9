"""The header of one DICOM file: found, bounded, and read field by field with every fault named by its tag.

pydicom walks the elements, or :mod:`.dicom_plain` where a file is plain; the few values needed are decoded here from
their raw bytes, so that a wrong number is an error that names its tag (never a warning, never a quotation of the file),
and the other hundred elements cost nothing.
"""

from __future__ import annotations

import math
import re
import struct
import warnings
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache, wraps
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, Concatenate, ParamSpec, TypeVar

from pydicom.datadict import dictionary_description, tag_for_keyword
from pydicom.filereader import data_element_generator
from pydicom.uid import UID, DeflatedExplicitVRLittleEndian, ExplicitVRBigEndian, ImplicitVRLittleEndian
from pydicom.valuerep import VR
from pydicom.values import convert_SQ

from ctreg_cli.io.dicom_plain import HEAD_BYTES, PlainReader

#: what is read of a header, top level; all else is stepped over
_TOP_LEVEL = (
    *("ImageType", "SOPClassUID", "SOPInstanceUID", "StudyInstanceUID", "SeriesInstanceUID", "FrameOfReferenceUID"),
    *("Modality", "InstanceNumber", "NumberOfFrames"),
    *("AcquisitionDateTime", "AcquisitionDate", "AcquisitionTime", "ContentDate", "ContentTime"),
    *("TriggerTime", "FrameTime", "FrameTimeVector", "GridFrameOffsetVector"),
    *("PixelSpacing", "SliceThickness", "ImagePositionPatient", "ImageOrientationPatient"),
    *("SamplesPerPixel", "PhotometricInterpretation", "Rows", "Columns"),
    *("BitsAllocated", "BitsStored", "HighBit", "PixelRepresentation"),
    *("PixelPaddingValue", "PixelPaddingRangeLimit"),
    *("RescaleSlope", "RescaleIntercept", "ModalityLUTSequence", "LossyImageCompression"),
    *("SharedFunctionalGroupsSequence", "PerFrameFunctionalGroupsSequence"),
    *("ExtendedOffsetTable", "ExtendedOffsetTableLengths"),
)
#: inside functional groups and the file meta group
_NESTED = (
    *("PixelMeasuresSequence", "PlanePositionSequence", "PlaneOrientationSequence"),
    *("PixelValueTransformationSequence", "FrameContentSequence"),
    *("FrameAcquisitionDateTime", "FrameReferenceDateTime"),
    *("TransferSyntaxUID", "MediaStorageSOPClassUID"),
    *("PixelData", "FloatPixelData", "DoubleFloatPixelData"),
)
_TAG: dict[str, int] = {keyword: int(tag_for_keyword(keyword) or 0) for keyword in (*_TOP_LEVEL, *_NESTED)}
_TOP_LEVEL_TAGS = dict.fromkeys(_TAG[keyword] for keyword in _TOP_LEVEL)
_PIXEL_TAGS = {_TAG[keyword]: keyword for keyword in ("PixelData", "FloatPixelData", "DoubleFloatPixelData")}
_read_plain = PlainReader(_TOP_LEVEL_TAGS, _PIXEL_TAGS)

PREAMBLE_BYTES = 128
MAGIC = b"DICM"
#: a deflated data set is inflated this far to find its header: no small file may fill the memory
MAX_INFLATED_HEADER_BYTES = 16 * 2**20
#: the longest headers have some thousand elements at the top level; a file of nothing else is not walked through
MAX_ELEMENTS = 2**17

_DECIMAL = re.compile(rb"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_INTEGER = re.compile(rb"[+-]?\d{1,12}")
_UID = re.compile(r"[0-9.]{1,64}")
_BINARY = {"US": "H", "SS": "h", "UL": "I", "SL": "i", "FL": "f", "FD": "d"}
_INTEGER_BYTES = {code: struct.calcsize(code) for code in "HhIi"}
_KNOWN_VR = {str(vr).encode() for vr in VR}


_More = ParamSpec("_More")
_Result = TypeVar("_Result")


class HeaderProblem(Exception):
    """Why a file holds no usable slice; its text names the tag and quotes nothing of the file."""


def tag_name(keyword: str) -> str:
    """``Pixel Spacing (0028,0030)``: how a tag is named to the user."""
    tag = _TAG[keyword]
    return f"{dictionary_description(tag)} ({tag >> 16:04X},{tag & 0xFFFF:04X})"


def problem(keyword: str, what: str) -> HeaderProblem:
    """The problem ``what`` of one tag, ready to be raised."""
    return HeaderProblem(f"{tag_name(keyword)} {what}")


@dataclass(frozen=True, slots=True)
class Elements:
    """The raw elements of a data set or of one sequence item, by tag; absent and empty are the same (None)."""

    raw: dict[int, Any]
    little_endian: bool

    def __contains__(self, keyword: str) -> bool:
        return _TAG[keyword] in self.raw

    def value(self, keyword: str) -> bytes | None:
        """The stored value without padding; None where absent or empty."""
        element = self.raw.get(_TAG[keyword])
        if element is None or not element.value:
            return None
        value = element.value
        if not isinstance(value, bytes):
            raise problem(keyword, "is a sequence, where a value is expected")
        return value

    def text(self, keyword: str) -> str:
        """An ASCII code string; empty where absent. For comparing with known codes, never for showing."""
        value = self.value(keyword)
        return value.decode("ascii", "replace").strip(" \0") if value else ""

    def codes(self, keyword: str) -> tuple[str, ...]:
        """A multi-valued code string."""
        text = self.text(keyword)
        return tuple(part.strip().upper() for part in text.split("\\")) if text else ()

    def uid(self, keyword: str) -> str:
        """A well-formed UID, or nothing: other text in its place is no UID and may be anything."""
        text = self.text(keyword)
        return text if _UID.fullmatch(text) else ""

    def decimals(self, keyword: str, count: int | None = None) -> tuple[float, ...] | None:
        """Finite decimal numbers (VR DS, also FD and FL); exactly ``count`` of them, if given.

        Raises:
            HeaderProblem: text that is no decimal number (a decimal comma, say), not finite, or another count.
        """
        value = self.value(keyword)
        if value is None:
            return None
        vr = self.raw[_TAG[keyword]].VR
        if vr in _BINARY:
            numbers: tuple[float, ...] = self._unpack(keyword, value, _BINARY[vr])
        else:
            decimals = (_repeated_decimals if len(value) <= MAX_REPEATED_BYTES else _text_decimals)(value)
            if decimals is None:
                raise problem(keyword, "is not a decimal number")
            if not decimals:
                return None
            numbers = decimals
        if not all(map(math.isfinite, numbers)):
            raise problem(keyword, "is not finite")
        if count is not None and len(numbers) != count:
            raise problem(keyword, f"holds {len(numbers)} values, not {count}")
        return numbers

    def decimal(self, keyword: str) -> float | None:
        """One decimal number."""
        numbers = self.decimals(keyword, 1)
        return numbers[0] if numbers else None

    def integer(self, keyword: str, *, signed: bool = False) -> int | None:
        """One integer, binary (US, SS, UL, SL) or text (IS).

        Args:
            keyword: which.
            signed: how to take a 16-bit value whose VR the file leaves open (US or SS).

        Raises:
            HeaderProblem: not one integer.
        """
        value = self.value(keyword)
        if value is None:
            return None
        vr = self.raw[_TAG[keyword]].VR
        if vr in ("UL", "SL"):
            return self._one(keyword, value, _BINARY[vr])
        if vr == "IS" or (vr not in ("US", "SS") and _IS_TEXT[keyword]):
            text = value.strip(b" \0")
            if not text:
                return None
            if not _INTEGER.fullmatch(text):
                raise problem(keyword, "is not an integer")
            return int(text)
        return self._one(keyword, value, "h" if signed else "H")

    def items(self, keyword: str) -> list[Elements]:
        """The items of a sequence; empty where absent."""
        element = self.raw.get(_TAG[keyword])
        if element is None or not element.value:
            return []
        value = element.value
        if isinstance(value, bytes):
            unknown = (
                element.VR == "UN"
            )  # whoever passed it on did not know it, and left it in implicit VR (PS3.5 6.2.2)
            with _no_remarks():
                value = convert_SQ(value, element.is_implicit_VR or unknown, element.is_little_endian or unknown)
        return [Elements(_whole(item.elements()), self.little_endian) for item in value]

    def _one(self, keyword: str, value: bytes, code: str) -> int:
        if len(value) == _INTEGER_BYTES[code]:  # nearly always
            return int.from_bytes(value, "little" if self.little_endian else "big", signed=code.islower())
        numbers = self._unpack(keyword, value, code)
        raise problem(keyword, f"holds {len(numbers)} values, not 1")

    def _unpack(self, keyword: str, value: bytes, code: str) -> tuple[Any, ...]:
        size = struct.calcsize(code)
        if len(value) % size:
            raise problem(keyword, f"holds {len(value)} bytes, which is no whole number of values")
        return struct.unpack(f"{'<' if self.little_endian else '>'}{len(value) // size}{code}", value)


@contextmanager
def _no_remarks() -> Iterator[None]:
    """What pydicom finds odd on its way is either checked here or harmless."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def _text_decimals(value: bytes) -> tuple[float, ...] | None:
    """Decimal numbers as text, none where all are blank; None where something else is among them."""
    parts = [part.strip(b" \0") for part in value.split(b"\\")]
    if not any(parts):
        return ()
    return tuple(map(float, parts)) if all(map(_DECIMAL.fullmatch, parts)) else None


#: a series repeats most of its numbers in every slice; what is remembered is no longer than this, and of so many
MAX_REPEATED_BYTES, MAX_REPEATED = 128, 64
_repeated_decimals = lru_cache(maxsize=256)(_text_decimals)


def once_a_series(
    *keywords: str,
) -> Callable[[Callable[Concatenate[Elements, _More], _Result]], Callable[Concatenate[Elements, _More], _Result]]:
    """Of a function of elements that depends on ``keywords`` alone: what it made of the same values the last times.

    The slices of a series differ in their place, time and number; all else is the same bytes in each, and need not be
    read and checked again. Further arguments are values that can be hashed. What raises is not remembered.
    """
    tags = [_TAG[keyword] for keyword in keywords]

    def decorate(
        read: Callable[Concatenate[Elements, _More], _Result],
    ) -> Callable[Concatenate[Elements, _More], _Result]:
        known: dict[tuple[object, ...], _Result] = {}

        @wraps(read)
        def remembering(elements: Elements, /, *more: _More.args, **named: _More.kwargs) -> _Result:
            values = [e and (e.VR, e.value) for e in map(elements.raw.get, tags)]
            key = (elements.little_endian, *more, *values)
            try:
                if key in known:
                    return known[key]
            except TypeError:  # a sequence where a value is expected
                return read(elements, *more, **named)
            result = read(elements, *more, **named)
            if sum(len(value[1] or b"") for value in values if value) <= MAX_REPEATED_BYTES * len(tags):
                if len(known) >= MAX_REPEATED:
                    known.clear()
                known[key] = result
            return result

        return remembering

    return decorate


#: integers that implicit VR stores as text
_IS_TEXT = {keyword: keyword in ("InstanceNumber", "NumberOfFrames") for keyword in _TAG}


@dataclass(frozen=True, slots=True, kw_only=True)
class PixelElement:
    """Where the pixels of a file begin."""

    keyword: str
    vr: str | None
    #: bytes; None where it is undefined (encapsulated)
    length: int | None
    #: of the value, in the file, or in the inflated data set where that is deflated
    offset: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Header:
    """What stands before the pixels of one file."""

    elements: Elements
    meta: Elements
    transfer_syntax: UID
    implicit_vr: bool
    pixels: PixelElement | None
    #: where the deflated data set begins, if it is deflated
    deflated_from: int | None
    #: bytes there are: of the file, or of what was inflated (then a lower bound while ``more`` is set)
    size: int
    more: bool
    #: what is odd about the file, one short phrase each
    notes: tuple[str, ...]


def looks_like_dicom(head: bytes) -> bool:
    """Whether the first bytes (132 or more) are those of a DICOM file or of a bare data set."""
    return head[PREAMBLE_BYTES : PREAMBLE_BYTES + 4] == MAGIC or _is_bare(head)


def _is_bare(head: bytes) -> bool:
    """A file without preamble begins with an element of group 0002 or 0008, with a known VR or a short length."""
    if len(head) < 8 or head[:2] not in (b"\x02\0", b"\x08\0", b"\0\x08"):
        return False
    length = int.from_bytes(head[4:8], "little")
    return head[4:6] in _KNOWN_VR or (head[0] != 0 and head[3] == 0 and length < len(head))


def read_header(file: BinaryIO, size: int, *, tried_plain: bool = False) -> Header:
    """Read the header of a file opened at its start, ``size`` bytes long.

    Where :func:`plain_header` has been tried on its head already (``tried_plain``), that is not tried again.

    Raises:
        HeaderProblem: not a DICOM file, or one that cannot be walked through.
    """
    notes: list[str] = []
    if not tried_plain:
        plain = plain_header(file.read(HEAD_BYTES), size)
        if plain is not None:
            return plain
        file.seek(0)
    head = file.read(PREAMBLE_BYTES + 4)
    if head[PREAMBLE_BYTES:] != MAGIC:
        if not _is_bare(head):
            raise HeaderProblem("the file is not DICOM (no DICM mark at byte 128)")
        notes.append("no preamble")
        file.seek(0)
    with _no_remarks():
        meta = _file_meta(file)
    implicit, little = _guess_encoding(file)
    named = meta.uid("TransferSyntaxUID")
    if named:
        syntax = UID(named)
        little = syntax != ExplicitVRBigEndian
        # the syntax is obeyed unless the first element plainly contradicts it
        if implicit != (syntax == ImplicitVRLittleEndian) and syntax != DeflatedExplicitVRLittleEndian:
            notes.append(f"{tag_name('TransferSyntaxUID')} contradicts the data")
    elif implicit:
        syntax = ImplicitVRLittleEndian
        notes.append("no transfer syntax, read as implicit VR little endian")
    else:
        syntax = UID("1.2.840.10008.1.2.1") if little else ExplicitVRBigEndian
        notes.append(f"no transfer syntax, read as explicit VR {'little' if little else 'big'} endian")

    source, more, deflated_from = file, False, None
    if syntax == DeflatedExplicitVRLittleEndian:
        deflated_from = file.tell()
        inflated, more = inflate(file, MAX_INFLATED_HEADER_BYTES)
        source, size, implicit = BytesIO(inflated), len(inflated), False
    with _no_remarks():
        elements, pixels = _walk(source, implicit, little)
    return Header(
        elements=Elements(elements, little),
        meta=meta,
        transfer_syntax=syntax,
        implicit_vr=implicit,
        pixels=pixels,
        deflated_from=deflated_from,
        size=size,
        more=more,
        notes=tuple(notes),
    )


def plain_header(head: bytes, size: int) -> Header | None:
    """The header of a file of ``size`` bytes from its first :data:`HEAD_BYTES`; None where it is not plain."""
    plain = _read_plain(head)
    if plain is None:
        return None
    return Header(
        elements=Elements(plain.elements, True),
        meta=Elements(plain.meta, True),
        transfer_syntax=plain.transfer_syntax,
        implicit_vr=plain.transfer_syntax == ImplicitVRLittleEndian,
        pixels=PixelElement(
            keyword=_PIXEL_TAGS[plain.pixel_tag],
            vr=plain.pixel_vr,
            length=plain.pixel_length,
            offset=plain.pixel_offset,
        ),
        deflated_from=None,
        size=size,
        more=False,
        notes=(),
    )


def inflate(file: BinaryIO, limit: int) -> tuple[bytes, bool]:
    """Inflate at most ``limit`` bytes from here; also whether there is more.

    Raises:
        HeaderProblem: damaged or unfinished deflated data.
    """
    inflater = zlib.decompressobj(-zlib.MAX_WBITS)
    try:
        inflated = inflater.decompress(file.read(), limit)
    except zlib.error:
        raise HeaderProblem("the deflated data set is damaged") from None
    if not inflater.eof and len(inflated) < limit:
        raise HeaderProblem("the deflated data set is cut short")
    return inflated, not inflater.eof


def _file_meta(file: BinaryIO) -> Elements:
    """Group 0002, always explicit VR little endian; leaves the file at the first element after it."""
    walk = data_element_generator(file, False, True, stop_when=lambda tag, vr, length: tag >> 16 != 2)
    return Elements(_whole(walk), True)


def _guess_encoding(file: BinaryIO) -> tuple[bool, bool]:
    """(implicit VR, little endian) as the first element of the data set shows it."""
    start = file.tell()
    first = file.read(6)
    file.seek(start)
    return not (first[4:6].isalpha() and first[4:6].isupper()), first[:1] != b"\0"


def _walk(file: BinaryIO, implicit: bool, little: bool) -> tuple[dict[int, Any], PixelElement | None]:
    """The wanted elements up to the pixels, and where the pixels are."""
    found: list[PixelElement] = []
    n_elements = 0

    def at_pixels(tag: int, vr: str | None, length: int) -> bool:
        nonlocal n_elements
        n_elements += 1
        if n_elements > MAX_ELEMENTS:
            raise problem("PixelData", f"does not come within the first {MAX_ELEMENTS} elements")
        if tag not in _PIXEL_TAGS:
            return False
        length_or_none = None if length == 0xFFFFFFFF else length
        found.append(PixelElement(keyword=_PIXEL_TAGS[tag], vr=vr, length=length_or_none, offset=file.tell()))
        return True

    walk = data_element_generator(file, implicit, little, stop_when=at_pixels, specific_tags=[*_TOP_LEVEL_TAGS])
    return _whole(walk), found[0] if found else None


def _whole(elements: Iterable[Any]) -> dict[int, Any]:
    """By tag, without values cut off by the end of the file or sequence: half a number is another number."""
    return {e.tag: e for e in elements if not isinstance(e.value, bytes) or len(e.value) == e.length}


@contextmanager
def open_binary(path: Path) -> Iterator[BinaryIO]:
    """Open a file for reading.

    Raises:
        HeaderProblem: it cannot be opened or read.
    """
    try:
        with path.open("rb") as file:
            yield file
    except OSError as error:
        if error.errno is None:  # pydicom's own, about the contents
            raise
        raise HeaderProblem(f"the file cannot be read ({error.strerror})") from None
