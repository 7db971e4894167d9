"""Slices between those who bring them and the one tracker that takes them: bounded, every drop counted."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator
from typing import Literal

from ctreg_cli.imaging.slice import Slice, UnreadableSlice

#: ``latest``: an old slice makes room for a new one; ``all``: a new one waits for room, and is refused if none comes
Policy = Literal["latest", "all"]

#: how often a consumer that waits for ever looks up (so that Ctrl-C is heard)
_LOOK_UP_S = 0.5


class SliceQueue:
    """Iterate over it in one thread while others put slices in.

    Args:
        policy: what happens when it is full.
        size: slices it holds at most.
        idle_s: the iteration ends when nothing has come for so long; None: never.
        count: the iteration ends after so many slices; None: never.
    """

    def __init__(self, policy: Policy, *, size: int, idle_s: float | None = None, count: int | None = None) -> None:
        self._policy, self._size, self._idle_s, self._count = policy, size, idle_s, count
        self._items: deque[Slice | UnreadableSlice] = deque()
        self._changed = threading.Condition()
        self._closed = False
        #: slices that made room for newer ones (``latest``), or found none (``all``)
        self.dropped = 0

    def put(self, items: list[Slice | UnreadableSlice], wait_s: float) -> bool:
        """Add slices in order, all or none.

        Args:
            items: the slices.
            wait_s: how long to wait for room, with the policy ``all``.

        Returns:
            Whether they were taken.
        """
        with self._changed:
            if self._policy == "all":
                end_s = time.monotonic() + wait_s
                # more than the queue ever holds at once goes in when it is empty
                while not self._closed and self._items and len(self._items) + len(items) > self._size:
                    left_s = end_s - time.monotonic()
                    if left_s <= 0:
                        self.dropped += len(items)
                        return False
                    self._changed.wait(left_s)
            if self._closed:
                return False
            self._items.extend(items)
            while self._policy == "latest" and len(self._items) > self._size:
                self._items.popleft()
                self.dropped += 1
            self._changed.notify_all()
            return True

    def close(self) -> None:
        """No more slices: the iteration ends with those that are in."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def __iter__(self) -> Iterator[Slice | UnreadableSlice]:
        done = 0
        while done != self._count:
            item = self._take()
            if item is None:
                return
            yield item
            done += 1

    def _take(self) -> Slice | UnreadableSlice | None:
        end_s = None if self._idle_s is None else time.monotonic() + self._idle_s
        with self._changed:
            while not self._items:
                left_s = _LOOK_UP_S if end_s is None else end_s - time.monotonic()
                if self._closed or left_s <= 0:
                    return None
                self._changed.wait(min(left_s, _LOOK_UP_S))
            item = self._items.popleft()
            self._changed.notify_all()
            return item
