"""Decoding compressed pixels, in a process of its own.

The native decoders (GDCM, OpenJPEG, CharLS) may abort, hang or fill the memory over a damaged codestream, and would
take the run and all its results with them. Here they only lose one slice: the process is started once, when the first
compressed slice is read, and started anew if a codestream has killed it.
"""

from __future__ import annotations

import atexit
import json
import os
import subprocess
import sys
import threading
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctreg_cli.errors import UnreadableSliceError

#: a slice of 512 × 512 takes 5 to 50 ms; some decoders spin for half a minute over a damaged one of any size. The first
#: answer also waits for the process to start
TIMEOUT_S, TIMEOUT_S_PER_MEGAPIXEL, START_S = 2.0, 4.0, 30.0
_UNDECODABLE = "cannot be decoded: damaged, or of a kind unknown to the decoders"


@lru_cache(maxsize=32)
def codec_available(transfer_syntax: str) -> bool:
    """Whether a decoder for this compression is installed."""
    from pydicom.pixels.decoders.base import get_decoder

    return bool(get_decoder(transfer_syntax).is_available)


def decode(codestream: bytes, *, transfer_syntax: str, dtype: np.dtype[Any], **layout: int) -> NDArray[Any]:
    """The (rows, columns) stored values of one grey frame.

    Args:
        codestream: one frame, as it stands between the item headers.
        transfer_syntax: how it is compressed.
        dtype: of the stored values.
        layout: ``rows``, ``columns``, ``bits_allocated``, ``bits_stored``, ``pixel_representation``.

    Raises:
        UnreadableSliceError: it cannot be decoded; the text is the bare problem.
    """
    options: dict[str, object] = {
        "transfer_syntax": transfer_syntax,
        "number_of_frames": 1,
        "samples_per_pixel": 1,
        "photometric_interpretation": "MONOCHROME2",
        "pixel_keyword": "PixelData",
        **layout,
    }
    timeout_s = TIMEOUT_S + TIMEOUT_S_PER_MEGAPIXEL * 1e-6 * layout["rows"] * layout["columns"]
    values = _process_of(os.getpid()).ask(options, codestream, timeout_s)
    if len(values) != layout["rows"] * layout["columns"] * dtype.itemsize:
        raise UnreadableSliceError(_UNDECODABLE)
    return np.frombuffer(values, dtype).reshape(layout["rows"], layout["columns"])


class _DecoderProcess:
    """The other process, from this side; one question at a time."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        atexit.register(self.stop)

    def ask(self, options: dict[str, object], codestream: bytes, timeout_s: float) -> bytes:
        """The decoded bytes; none if the process failed, died or took too long."""
        with self._lock:
            try:
                process = self._process or self._start()
            except OSError as error:
                raise UnreadableSliceError(f"the decoder cannot be started ({error.strerror})") from None
            watchdog = threading.Timer(timeout_s, process.kill)
            watchdog.start()
            try:
                values = _exchange(process, json.dumps({**options, "n_bytes": len(codestream)}).encode(), codestream)
            except (OSError, ValueError, EOFError):  # it died: this codestream is lost, the next one gets a new process
                values = b""
                self.stop()
            except BaseException:  # Ctrl-C in the middle of an answer: nobody will read the rest
                self.stop()
                raise
            finally:
                watchdog.cancel()
            return values

    def _start(self) -> subprocess.Popen[bytes]:
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "ctreg_cli.io.dicom_decoder_process"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
        )
        watchdog = threading.Timer(START_S, self._process.kill)
        watchdog.start()
        try:
            assert self._process.stdout is not None
            self._process.stdout.readline()  # it is ready; of a dead one the first question finds out
        finally:
            watchdog.cancel()
        return self._process

    def stop(self) -> None:
        """End the process, if there is one."""
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.communicate()


def _exchange(process: subprocess.Popen[bytes], request: bytes, codestream: bytes) -> bytes:
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write(request + b"\n" + codestream)
    process.stdin.flush()
    n_bytes = int(process.stdout.readline())
    values = process.stdout.read(n_bytes)
    if len(values) != n_bytes:
        raise EOFError
    return values


@lru_cache(maxsize=1)
def _process_of(pid: int) -> _DecoderProcess:
    """A forked worker must not share its parent's pipes: every process has a decoder of its own."""
    return _DecoderProcess()
