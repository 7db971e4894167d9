"""Ctrl-C at any moment: while a command runs it is a KeyboardInterrupt, before and after it ends the program at once.

Loading a command takes longer than a finger on Ctrl-C. There is nothing to write then, and nothing to say.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager

EXIT_INTERRUPTED = 130


def _leave(_number: int, _frame: object) -> None:
    os._exit(EXIT_INTERRUPTED)


def leave_at_once() -> None:
    """From now on Ctrl-C ends the program without a word; where it was ignored (``nohup``), it still is."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _leave)


@contextmanager
def interruptible() -> Iterator[None]:
    """A block in which Ctrl-C is a KeyboardInterrupt, so that what was finished can be written."""
    quick = signal.getsignal(signal.SIGINT) is _leave
    if quick:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        if quick:
            signal.signal(signal.SIGINT, _leave)
