"""An OpenIGTLink server: whoever connects gets every result from then on; nobody can hold the tracker up.

``send`` gives each client at once what it takes without waiting; one thread with a selector lets clients in and hears
when a slow one takes more. A client that reads too slowly loses whole slices, the oldest first, counted; one that is
dead is closed; what clients say is read and thrown away.
"""

from __future__ import annotations

import contextlib
import selectors
import socket
import threading
import time
from collections import deque
from dataclasses import dataclass, field
from types import TracebackType
from typing import Self

from ctreg_cli.errors import InputError
from ctreg_cli.interop.openigtlink import encode_result
from ctreg_cli.pipeline import FrameResult

DEFAULT_PORT = 18944
#: more than these at once are turned away
MAX_CLIENTS = 32
#: slices kept for a slow client; then the oldest goes
MAX_WAITING = 32
#: a client that has taken nothing for so long is gone
DEAD_AFTER_S = 10.0
_READ_BYTES = 65_536
_TICK_S = 0.5
#: how long the end waits for clients to take the last slices
_FAREWELL_S = 1.0


@dataclass(slots=True)
class _Client:
    """A connection, and what it has not taken yet."""

    connection: socket.socket
    waiting: deque[bytes] = field(default_factory=deque)
    #: the rest of a slice of which a part is on its way already
    current: memoryview = field(default_factory=lambda: memoryview(b""))
    last_taken_s: float = field(default_factory=time.monotonic)

    @property
    def is_behind(self) -> bool:
        return bool(self.waiting) or bool(len(self.current))


class IgtlServer:
    """Sends results to all who are connected; a context that closes every connection at its end.

    Args:
        host: address to listen on.
        port: 0 takes a free one, see :attr:`port`.

    Raises:
        InputError: the address cannot be listened on.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = DEFAULT_PORT) -> None:
        try:
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            self._listener = socket.create_server((host, port), family=family)
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise InputError(f"--igtl {host}:{port}: cannot be listened on ({reason}); name another port") from error
        self._listener.setblocking(False)
        self.port: int = self._listener.getsockname()[1]
        #: slices that slow clients did not get, clients turned away
        self.dropped = self.refused = 0
        self._outbox: deque[bytes] = deque()
        #: held by whoever serves clients; nobody waits for a client while holding it
        self._serving = threading.Lock()
        self._clients: dict[socket.socket, _Client] = {}
        self._selector = selectors.DefaultSelector()
        self._bell, self._bell_rope = socket.socketpair()
        for end in (self._bell, self._bell_rope):
            end.setblocking(False)
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._selector.register(self._bell, selectors.EVENT_READ)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="igtl", daemon=True)
        self._thread.start()

    @property
    def n_clients(self) -> int:
        """How many are connected."""
        return len(self._clients)

    def send(self, data: bytes) -> None:
        """Give the messages of one slice to every client; returns at once.

        They leave from here, not from the server's thread, which would have to be woken first; unless that is just
        serving clients: then it finds them when it has done so.
        """
        self._outbox.append(data)
        if self._serving.acquire(blocking=False):
            try:
                self._hand_out()
            finally:
                self._serving.release()
        else:
            self._ring()

    def close(self) -> None:
        """Let clients take what is waiting, for a moment, and close."""
        self._stopping.set()
        self._ring()
        self._thread.join(_FAREWELL_S + 4 * _TICK_S)

    # As an output of results (see ctreg_cli.io.sinks.Sink):

    def write(self, result: FrameResult) -> None:
        """Send a result."""
        self.send(encode_result(result))

    def finish(self) -> None:
        """The last result has been sent."""
        self.close()

    def abandon(self) -> None:
        """The run has failed."""
        self.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # What follows runs in the server's own thread, or under the lock.

    def _ring(self) -> None:
        with contextlib.suppress(OSError):  # full: it rings already; closed: nobody is there to hear
            self._bell_rope.send(b"\0")

    def _serve(self) -> None:
        end_s: float | None = None
        while True:
            ready = self._selector.select(_TICK_S)
            with self._serving:
                for key, events in ready:
                    self._serve_one(key, events)
                self._hand_out()
                self._bury()
            if self._stopping.is_set():
                end_s = end_s or time.monotonic() + _FAREWELL_S
                if time.monotonic() >= end_s or not any(client.is_behind for client in self._clients.values()):
                    break
        for client in list(self._clients.values()):
            self._drop(client)
        self._selector.close()
        for end in (self._listener, self._bell, self._bell_rope):
            end.close()

    def _serve_one(self, key: selectors.SelectorKey, events: int) -> None:
        if key.fileobj is self._listener:
            self._accept()
        elif key.fileobj is self._bell:
            with contextlib.suppress(OSError):
                self._bell.recv(_READ_BYTES)
        elif key.fileobj in self._clients:  # and not dropped since it was heard of
            client = key.data
            if events & selectors.EVENT_READ and not self._read(client):
                return
            if events & selectors.EVENT_WRITE:
                self._write(client)

    def _accept(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except OSError:  # it left before it was let in, or there are no file handles left: then there is no client
            return
        if len(self._clients) >= MAX_CLIENTS:
            self.refused += 1
            connection.close()
            return
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client = _Client(connection=connection)
        self._clients[connection] = client
        self._selector.register(connection, selectors.EVENT_READ, client)

    def _read(self, client: _Client) -> bool:
        """Throw away what a client says; whether it is still there."""
        try:
            said = client.connection.recv(_READ_BYTES)
        except BlockingIOError:
            return True
        except OSError:
            said = b""
        if not said:
            self._drop(client)
        return bool(said)

    def _hand_out(self) -> None:
        while self._outbox:
            data = self._outbox.popleft()
            for client in list(self._clients.values()):
                if len(client.waiting) >= MAX_WAITING:
                    client.waiting.popleft()
                    self.dropped += 1
                if not client.is_behind:
                    client.last_taken_s = time.monotonic()
                client.waiting.append(data)
        for client in list(self._clients.values()):
            if client.is_behind:
                self._write(client)

    def _write(self, client: _Client) -> None:
        """Send as much as the client takes now."""
        try:
            while client.is_behind:
                if not len(client.current):
                    client.current = memoryview(client.waiting.popleft())
                sent = client.connection.send(client.current)
                client.current = client.current[sent:]
                client.last_taken_s = time.monotonic()
        except BlockingIOError:
            pass  # the selector tells when there is room again
        except OSError:
            self._drop(client)
            return
        events = selectors.EVENT_READ | (selectors.EVENT_WRITE if client.is_behind else 0)
        self._selector.modify(client.connection, events, client)

    def _bury(self) -> None:
        now_s = time.monotonic()
        for client in list(self._clients.values()):
            if client.is_behind and now_s - client.last_taken_s > DEAD_AFTER_S:
                self._drop(client)

    def _drop(self, client: _Client) -> None:
        if self._clients.pop(client.connection, None) is not None:
            self._selector.unregister(client.connection)
            client.connection.close()


def parse_address(text: str) -> tuple[str, int]:
    """``[HOST:]PORT`` of ``--igtl``; the host is 127.0.0.1 when left out.

    Raises:
        InputError: it is no such address.
    """
    host, _, port = text.rpartition(":")
    if not port.isdecimal() or not int(port) < 65_536:
        raise InputError(f"--igtl {text}: is no address; give [HOST:]PORT, such as {DEFAULT_PORT}")
    return host.strip("[]") or "127.0.0.1", int(port)
