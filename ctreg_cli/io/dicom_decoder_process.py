"""The process in which compressed pixels are decoded: ``python -P -m ctreg_cli.io.dicom_decoder_process``.

Reads requests from standard input until it is closed: a line of JSON (see :mod:`ctreg_cli.io.dicom_decoding`), then
``n_bytes`` of codestream. Answers on standard output: an empty line when it is ready; then for each request a line with
the number of bytes, and the stored values in this machine's byte order; 0 bytes where the codestream cannot be decoded.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import warnings
from importlib import import_module
from typing import Any, BinaryIO

#: address space of this process; a decoder that wants more is being fooled
MAX_MEMORY_BYTES = 4 * 2**30


def main() -> None:
    """Serve until standard input ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the one who asks
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # decoders print; their chatter must not get among the answers
    _limit_memory()
    warnings.simplefilter("ignore")
    import_module("pydicom.pixels.decoders")  # the slow part of the first answer

    answers.write(b"\n")
    answers.flush()
    serve(sys.stdin.buffer, answers)


def serve(requests: BinaryIO, answers: BinaryIO) -> None:
    """Answer every request in turn."""
    while line := requests.readline():
        request = json.loads(line)
        codestream = requests.read(request.pop("n_bytes"))
        try:
            values = decode(codestream, request.pop("transfer_syntax"), request)
        # whatever a decoder raises over a damaged codestream, the answer is the same
        except Exception:  # noqa: BLE001
            values = b""
        answers.write(b"%d\n" % len(values) + values)
        answers.flush()


def decode(codestream: bytes, transfer_syntax: str, options: dict[str, Any]) -> bytes:
    """The stored values of one frame, row by row."""
    from pydicom.encaps import encapsulate
    from pydicom.pixels.decoders.base import get_decoder

    stored, _ = get_decoder(transfer_syntax).as_array(
        encapsulate([codestream], has_bot=False), index=0, raw=True, **options
    )
    values: bytes = stored.tobytes()
    return values


def _limit_memory() -> None:
    try:
        import resource
    except ImportError:  # not on Windows
        return
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    limit = MAX_MEMORY_BYTES if hard == resource.RLIM_INFINITY else min(MAX_MEMORY_BYTES, hard)
    resource.setrlimit(resource.RLIMIT_AS, (limit, hard))


if __name__ == "__main__":
    main()
