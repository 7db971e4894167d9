"""The header of a plain DICOM file in one pass: what nearly every CT slice is, at a quarter of the time.

Plain is: with preamble and file meta, implicit or explicit VR little endian as the meta says, every element down to
the pixels of a known VR and a definite length, and all of it within the first bytes of the file. Of anything else
:func:`read_plain` says nothing, and pydicom walks through it (:mod:`.dicom_header`); what both read is the same,
element by element, which the tests hold.
"""

from __future__ import annotations

import struct
from collections.abc import Container, Iterator
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
_element = tuple.__new__


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


def read_plain(head: bytes, wanted: Container[int], pixel_tags: Container[int]) -> PlainHeader | None:
    """The header at the ``head`` of a file, or None where it is not plain.

    Args:
        head: the first bytes of the file, :data:`HEAD_BYTES` or all there are.
        wanted: tags of the elements to keep beside the file meta.
        pixel_tags: tags at which to stop.
    """
    if head[_PREAMBLE : _PREAMBLE + 4] != _MAGIC:
        return None
    try:
        return _read(head, wanted, pixel_tags)
    except struct.error:  # it goes on beyond the head, or the file ends
        return None


def _read(head: bytes, wanted: Container[int], pixel_tags: Container[int]) -> PlainHeader | None:
    meta: dict[int, RawDataElement] = {}
    begin = _PREAMBLE + len(_MAGIC)
    for tag, vr, length, at in _elements(head, begin, implicit=False):
        if tag >> 16 != _META_GROUP:
            break
        begin = at + length
        value = head[at:begin]
        if len(value) < length:
            return None
        meta[tag] = _element(RawDataElement, (tag, vr, length, value, at, False, True, True, False))
    named = meta.get(_TRANSFER_SYNTAX)
    syntax = named and _SYNTAXES.get((named.value or b"").strip(b" \0"))
    group, _, code, _ = _explicit(head, begin)
    if not syntax or group == _META_GROUP:
        return None
    implicit = syntax == ImplicitVRLittleEndian
    if implicit == (code in _SHORT or code in _LONG) or (implicit and code.isalpha() and code.isupper()):
        return None  # the first element contradicts the meta
    elements: dict[int, RawDataElement] = {}
    for tag, vr, length, at in _elements(head, begin, implicit=implicit):
        if tag in pixel_tags:
            return PlainHeader(meta, elements, syntax, tag, vr, length, at)
        if tag in wanted or tag == _CHARACTER_SET:
            value = head[at : at + length]
            if len(value) < length or (tag == _CHARACTER_SET and value.strip(b" \0") not in _CHARACTER_SETS):
                return None
            elements[tag] = _element(RawDataElement, (tag, vr, length, value, at, implicit, True, True, False))
    return None


def _elements(head: bytes, at: int, *, implicit: bool) -> Iterator[tuple[int, str | None, int, int]]:
    """Tag, VR, length, and place of the value, of element after element; ends at one that is not plain.

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
        yield group << 16 | element, vr, length, at
        at += length
