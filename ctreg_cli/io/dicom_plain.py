"""The header of a plain DICOM file in one pass: what nearly every CT slice is, at a quarter of the time.

Plain is: with preamble and file meta, implicit or explicit VR little endian as the meta says, every element down to
the pixels of a known VR and a definite length, and all of it within the first bytes of the file. Of anything else
:func:`read_plain` says nothing, and pydicom walks through it (:mod:`.dicom_header`); what both read is the same,
element by element, which the tests hold.
"""

from __future__ import annotations

import struct
from collections.abc import Container
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
    at, implicit, syntax = _PREAMBLE + 4, False, None
    meta: dict[int, RawDataElement] = {}
    elements: dict[int, RawDataElement] = {}
    make = RawDataElement._make
    while True:
        group, element, code, length = _explicit(head, at)
        if syntax is None and group != _META_GROUP:  # the data set begins
            named = meta.get(_TRANSFER_SYNTAX)
            syntax = named and _SYNTAXES.get((named.value or b"").strip(b" \0"))
            if syntax is None:
                return None
            implicit = syntax == ImplicitVRLittleEndian
            if implicit == (code in _SHORT or code in _LONG) or (implicit and code.isalpha() and code.isupper()):
                return None  # the first element contradicts the meta
        at += 8
        vr = None
        if implicit:
            (length,) = _long_length(head, at - 4)
        elif (vr := _SHORT.get(code)) is None:
            if (vr := _LONG.get(code)) is None:
                return None
            (length,) = _long_length(head, at)
            at += 4
        tag = group << 16 | element
        if length == _UNDEFINED or group == _DELIMITERS:
            return None
        if syntax is not None and tag in pixel_tags:
            return PlainHeader(meta, elements, syntax, tag, vr, length, at)
        after = at + length
        if syntax is None or tag in wanted or tag == _CHARACTER_SET:
            value = head[at:after]
            if len(value) < length or (tag == _CHARACTER_SET and value.strip(b" \0") not in _CHARACTER_SETS):
                return None
            kept = elements if syntax is not None else meta
            kept[tag] = make((tag, vr, length, value, at, implicit, True, True, False))
        at = after
