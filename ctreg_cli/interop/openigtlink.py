"""OpenIGTLink messages (header version 1) of one result: transforms, status and quality.

A message is a header of 58 bytes (version, type, device, time, length, CRC-64) and a body, big endian; see the protocol
specification, http://openigtlink.org/developers/spec. Transforms are 32-bit floats there (7 digits, 1e-5 mm at 100 mm);
the quality message repeats the pose with all its digits.
"""

from __future__ import annotations

import json
import math
import struct

import numpy as np

from ctreg_cli.arrays import FloatArray
from ctreg_cli.geometry.pose import quaternion
from ctreg_cli.io.results import accepted
from ctreg_cli.io.sinks import plain
from ctreg_cli.pipeline import FrameResult

HEADER = struct.Struct(">H12s20sQQQ")
HEADER_VERSION = 1
#: IANA number of UTF-8, and the longest text a STRING message holds
_UTF8, _MAX_TEXT = 106, 65_535
STATUS_INVALID, STATUS_OK = 0, 1
SLICE_DEVICE, PATIENT_DEVICE = "SliceFromModel", "PatientFromModel"
STATUS_DEVICE, QUALITY_DEVICE = "Status", "Quality"

#: CRC-64 of ECMA-182, not reflected, starting from 0, as OpenIGTLink takes it
_POLYNOMIAL, _ALL_ONES = 0x42F0E1EBA9EA3693, 0xFFFFFFFFFFFFFFFF


def _crc_table() -> list[int]:
    table = []
    for byte in range(256):
        crc = byte << 56
        for _ in range(8):
            crc = ((crc << 1) & _ALL_ONES) ^ (_POLYNOMIAL if crc >> 63 else 0)
        table.append(crc)
    return table


_CRC_TABLE = _crc_table()


def crc64(data: bytes) -> int:
    """The checksum of a message's body."""
    crc = 0
    for byte in data:
        crc = _CRC_TABLE[(crc >> 56) ^ byte] ^ ((crc << 8) & _ALL_ONES)
    return crc


def message(kind: str, device: str, body: bytes, time_s: float | None) -> bytes:
    """A whole message; the time is the slice's (seconds), 0 where it has none."""
    ticks = 0
    if time_s is not None and math.isfinite(time_s) and 0 <= time_s < 2**32:
        ticks = min(round(time_s * 2**32), 2**64 - 1)
    return HEADER.pack(HEADER_VERSION, kind.encode(), device.encode(), ticks, len(body), crc64(body)) + body


def transform(device: str, T: FloatArray, time_s: float | None) -> bytes:
    """TRANSFORM: the rotation's columns, then the translation, mm."""
    return message("TRANSFORM", device, struct.pack(">12f", *T[:3].T.ravel().tolist()), time_s)


def status(code: int, name: str, text: str, time_s: float | None) -> bytes:
    """STATUS: a code, its name (at most 19 characters) and a text."""
    body = struct.pack(">Hq20s", code, 0, name.encode()[:19]) + text.encode() + b"\0"
    return message("STATUS", STATUS_DEVICE, body, time_s)


def string(device: str, text: str, time_s: float | None) -> bytes:
    """STRING: UTF-8."""
    data = text.encode()[:_MAX_TEXT]
    return message("STRING", device, struct.pack(">HH", _UTF8, len(data)) + data, time_s)


def encode_result(result: FrameResult) -> bytes:
    """All messages of one slice, one after the other.

    The quality (STRING, JSON) and the STATUS go out for every slice; transforms only for one whose status is ``ok``: a
    lost frame is never filled in, and an ambiguous one must not move a robot.
    """
    time_s = result.info.time_s
    parts = []
    if result.status == "ok" and result.best is not None:
        T = result.best.T_slice_model
        parts.append(transform(SLICE_DEVICE, T, time_s))
        if result.info.T_patient_slice is not None:
            parts.append(transform(PATIENT_DEVICE, result.info.T_patient_slice @ T, time_s))
        parts.append(status(STATUS_OK, "ok", "", time_s))
    else:
        parts.append(status(STATUS_INVALID, result.status, result.reason, time_s))
    parts.append(string(QUALITY_DEVICE, json.dumps(plain(quality(result)), allow_nan=False), time_s))
    return b"".join(parts)


def quality(result: FrameResult) -> dict[str, object]:
    """What the quality message says: ``sd`` of tx ty tz (mm) and rx ry rz (degrees); null without a pose."""
    said: dict[str, object] = {
        "slice": result.index,
        "status": result.status,
        "reason": result.reason,
        "n_spots": len(result.spots),
        "n_matched": 0,
        "rms_px": None,
        "sd_mm": None,
        "sd_deg": None,
        "translation_mm": None,
        "quaternion_xyzw": None,
    }
    for best in accepted(result)[:1]:
        sd = np.sqrt(np.diagonal(best.covariance))
        said |= {"n_matched": len(best.rod_index), "rms_px": float(best.rms_px)}
        said |= {"sd_mm": sd[:3], "sd_deg": np.degrees(sd[3:])}
        if result.status == "ok":
            said["translation_mm"] = best.T_slice_model[:3, 3]
            said["quaternion_xyzw"] = quaternion(best.T_slice_model)
    return said
