"""The header of a plain DICOM file in one pass: what nearly every CT slice is, at a quarter of the time.

Plain is: with preamble and file meta, implicit or explicit VR little endian as the meta says, every element down to
the pixels of a known VR and a definite length, and all of it within the first bytes of the file. Of anything else
:class:`PlainReader` says nothing, and pydicom walks through it (:mod:`.dicom_header`); what both read is the same,
element by element, which the tests hold. From slice to slice most elements stand where they stood: then only the values
are read.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Container, Iterator
from dataclasses import dataclass
from operator import itemgetter
from typing import NamedTuple

from pydicom.dataelem import RawDataElement
from pydicom.uid import UID, ExplicitVRLittleEndian, ImplicitVRLittleEndian
from pydicom.valuerep import EXPLICIT_VR_LENGTH_16, EXPLICIT_VR_LENGTH_32

#: so much of a file is looked at
HEAD_BYTES = 16384

_PREAMBLE, _MAGIC = 128, b"DICM"
_META_GROUP, _DELIMITERS = 0x0002, 0xFFFE
_TRANSFER_SYNTAX, _CHARACTER_SET = 0x00020010, 0x00080005
_UNDEFINED = 0xFFFFFFFF
_SHORT = {str(vr).encode(): str(vr) for vr in EXPLICIT_VR_LENGTH_16}
_LONG = {str(vr).encode(): str(vr) for vr in EXPLICIT_VR_LENGTH_32}
_SYNTAXES: dict[bytes, UID] = {str(uid).encode(): uid for uid in (ImplicitVRLittleEndian, ExplicitVRLittleEndian)}
#: of text; no text is read here, but pydicom refuses a file that names one it does not know
_CHARACTER_SETS = frozenset({b"", b"ISO_IR 6", b"ISO_IR 100", b"ISO_IR 192"})

_explicit, _implicit = struct.Struct("<HH2sH").unpack_from, struct.Struct("<HHL").unpack_from
_long_length = struct.Struct("<L").unpack_from
#: ``RawDataElement._make`` without counting the fields
_raw = tuple.__new__
_NOTHING = slice(0, 0)
#: so many layouts are remembered: from slice to slice lengths of numbers change
_MOST_LAYOUTS = 8


class PlainHeader(NamedTuple):
    """Elements by tag, as pydicom's generator gives them."""

    meta: dict[int, RawDataElement]
    elements: dict[int, RawDataElement]
    transfer_syntax: UID
    pixel_tag: int
    pixel_vr: str | None
    pixel_length: int
    #: of the pixels, in the file
    pixel_offset: int


class PlainReader:
    """Reads the headers of plain files; one for all files, since those of a series are laid out alike."""

    def __init__(self, wanted: Container[int], pixel_tags: Container[int]) -> None:
        """Keep elements of the tags ``wanted`` beside the file meta, and stop at one of ``pixel_tags``."""
        self._wanted, self._pixel_tags = wanted, pixel_tags
        self._recent: tuple[_Layout, ...] = ()

    def __call__(self, head: bytes) -> PlainHeader | None:
        """The header at the ``head`` of a file, :data:`HEAD_BYTES` or all there are; None where it is not plain."""
        if head[_PREAMBLE : _PREAMBLE + 4] != _MAGIC:
            return None
        for layout in self._recent:
            if layout.marks(head) == layout.marked:
                return layout.header(head)
        try:
            found = _layout(head, self._wanted, self._pixel_tags)
        except struct.error:  # it goes on beyond the head, or the file ends
            return None
        if found is None:
            return None
        self._recent = (found, *self._recent[: _MOST_LAYOUTS - 1])
        return found.header(head)


class _Element(NamedTuple):
    """Where an element's value is."""

    tag: int
    vr: str | None
    length: int
    at: int


@dataclass(slots=True, kw_only=True, eq=False)
class _Layout:
    """Where the elements of a head are. They are in the same places wherever the ``marks`` are the same bytes.

    Marks are all tags, VRs and lengths, and the values that say how to go on.
    """

    marks: Callable[[bytes], tuple[bytes, ...]]
    marked: tuple[bytes, ...]
    #: of the values to keep: all of the file meta, those wanted of the data set, and nothing at last
    values: Callable[[bytes], tuple[bytes, ...]]
    meta: list[_Element]
    elements: list[_Element]
    transfer_syntax: UID
    pixels: _Element
    #: the last head, from slice to slice few values are others; its values and what was made of them are set at once,
    #: since files are read in several threads
    last: tuple[tuple[bytes, ...], PlainHeader] | None = None

    def header(self, head: bytes) -> PlainHeader:
        """The header of a head that is laid out like this."""
        values, n, last = self.values(head), len(self.meta), self.last
        if last is None:
            meta, elements, changed = {}, {}, list(range(len(values) - 1))
        else:
            old_values, old = last
            meta, elements = old.meta.copy(), old.elements.copy()
            changed = [i for i, (now, before) in enumerate(zip(values, old_values, strict=True)) if now != before]
        is_implicit = self.transfer_syntax == ImplicitVRLittleEndian
        for i in changed:
            tag, vr, length, at = self.meta[i] if i < n else self.elements[i - n]
            by_tag, implicit = (meta, False) if i < n else (elements, is_implicit)
            by_tag[tag] = _raw(RawDataElement, (tag, vr, length, values[i], at, implicit, True, True, False))
        header = PlainHeader(meta, elements, self.transfer_syntax, *self.pixels)
        self.last = values, header
        return header


def _layout(head: bytes, wanted: Container[int], pixel_tags: Container[int]) -> _Layout | None:
    """Where the elements of a head are; None where it is not plain.

    Raises:
        struct.error: the head ends before the pixels.
    """
    meta: list[_Element] = []
    marks: list[slice] = []
    end = _PREAMBLE + len(_MAGIC)
    syntax = None
    for element in _elements(head, end, implicit=False):
        tag, _, length, at = element
        if tag >> 16 != _META_GROUP:
            break
        marks.append(slice(end, at))
        end = at + length
        if end > len(head):
            return None
        meta.append(element)
        if tag == _TRANSFER_SYNTAX:
            marks.append(slice(at, end))
            syntax = _SYNTAXES.get(head[at:end].strip(b" \0"))
    group, _, code, _ = _explicit(head, end)
    if syntax is None or group == _META_GROUP:
        return None
    implicit = syntax == ImplicitVRLittleEndian
    if implicit == (code in _SHORT or code in _LONG) or (implicit and code.isalpha() and code.isupper()):
        return None  # the first element contradicts the meta
    kept: list[_Element] = []
    for element in _elements(head, end, implicit=implicit):
        tag, _, length, at = element
        marks.append(slice(end, at))
        end = at + length
        if tag in pixel_tags:
            if any(len({e.tag for e in part}) < len(part) for part in (meta, kept)):
                return None  # one is there twice
            marks_of = itemgetter(*marks)
            return _Layout(
                marks=marks_of,
                marked=marks_of(head),
                values=itemgetter(*(slice(e.at, e.at + e.length) for e in (*meta, *kept)), _NOTHING),
                meta=meta,
                elements=kept,
                transfer_syntax=syntax,
                pixels=element,
            )
        if tag in wanted or tag == _CHARACTER_SET:
            value = head[at:end]
            if end > len(head) or (tag == _CHARACTER_SET and value.strip(b" \0") not in _CHARACTER_SETS):
                return None
            kept.append(element)
        if tag == _CHARACTER_SET:
            marks.append(slice(at, end))
    return None


def _elements(head: bytes, at: int, *, implicit: bool) -> Iterator[_Element]:
    """Element after element; ends at one that is not plain.

    Raises:
        struct.error: the head ends.
    """
    short, long, explicit_element, implicit_element = _SHORT.get, _LONG.get, _explicit, _implicit
    while True:
        if implicit:
            group, element, length = implicit_element(head, at)
            vr, at = None, at + 8
            if length == _UNDEFINED or group == _DELIMITERS:
                return
        else:
            group, element, code, length = explicit_element(head, at)
            vr, at = short(code), at + 8
            if vr is None:  # a delimiter has none at all
                vr = long(code)
                if vr is None:
                    return
                (length,) = _long_length(head, at)
                at += 4
                if length == _UNDEFINED:
                    return
        yield _Element(group << 16 | element, vr, length, at)
        at += length
