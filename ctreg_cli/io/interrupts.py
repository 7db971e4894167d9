"""Ctrl-C held back while a record is written, so that what is written is whole, and what is said of it true.

To change what a signal does costs more than to write a record. So a handler is put in place once for as long as records
come (:func:`records`), and :class:`uninterrupted` only tells it when to wait.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType

_MAIN_THREAD = threading.main_thread().ident


class _Hold:
    """What the handler goes by; of the main thread alone, as signals are."""

    is_in_place = False
    depth = 0
    is_pending = False


def _handle(number: int, frame: FrameType | None) -> None:
    if not _Hold.depth:
        signal.default_int_handler(number, frame)
    _Hold.is_pending = True


@contextmanager
def records() -> Iterator[None]:
    """While records come; where Ctrl-C is ignored, or somebody else's, it stays so."""
    ours = not _Hold.is_in_place and threading.get_ident() == _MAIN_THREAD
    if not ours or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    signal.signal(signal.SIGINT, _handle)
    _Hold.is_in_place = True
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        _Hold.is_in_place = False


class uninterrupted:
    """A block in which Ctrl-C waits until its end; outside of :func:`records` it is as it was."""

    def __enter__(self) -> None:
        self._holds = _Hold.is_in_place and threading.get_ident() == _MAIN_THREAD
        if self._holds:
            _Hold.depth += 1

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self._holds:
            return
        _Hold.depth -= 1
        if _Hold.depth or not _Hold.is_pending:
            return
        _Hold.is_pending = False
        if kind is None:  # what went wrong meanwhile says more
            raise KeyboardInterrupt
