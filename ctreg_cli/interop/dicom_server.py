"""pynetdicom's association server, made to last among peers that are broken, silent or hostile.

Import it only where pynetdicom is installed. What is added: no message unit larger than agreed is waited for, none may
take for ever, no association may send more for one image than an image has, TLS peers shake hands in a thread of their
own, and peers that connect and then say nothing keep nobody out: of too many such the oldest is cut off.
"""

from __future__ import annotations

import contextlib
import socket
import ssl
import threading
import time
from typing import Any
from weakref import WeakSet

from pynetdicom.ae import ApplicationEntity
from pynetdicom.transport import (
    AssociationServer,
    AssociationSocket,
    RequestHandler,
    ThreadedAssociationServer,
)

#: of requests for associations; longer ones name more than anyone needs
MAX_CONTROL_PDU_BYTES = 1 << 20
#: connections that may stand without having asked for an association yet
MAX_UNASSOCIATED = 16
_CHUNK_BYTES = 1 << 16
_PDU_HEADER_BYTES = 6


class GuardedSocket(AssociationSocket):
    """Reads with limits; an excess is an OSError, on which pynetdicom closes the connection."""

    max_pdu_bytes = MAX_CONTROL_PDU_BYTES
    max_message_bytes = 1 << 30
    pdu_timeout_s = 10.0
    #: bytes that came since the last whole message
    _since_message = 0

    def message_done(self) -> None:
        """A message was received whole: the next may have as many bytes again."""
        self._since_message = 0

    def recv(self, nr_bytes: int) -> bytearray:
        """``nr_bytes``, or fewer where the peer has gone.

        Raises:
            OSError: too much, or too slow.
        """
        if nr_bytes > self.max_pdu_bytes:
            raise OSError("a message unit is longer than allowed")
        self._since_message += nr_bytes
        if self._since_message > self.max_message_bytes:
            raise OSError("a message is longer than allowed")
        connection = self.socket
        if connection is None:
            return bytearray()
        data = bytearray(nr_bytes)
        view, end_s, place = memoryview(data), time.monotonic() + self.pdu_timeout_s, 0
        while place < nr_bytes:
            left_s = end_s - time.monotonic()
            if left_s <= 0:
                raise TimeoutError("a message unit takes too long")
            connection.settimeout(left_s)
            n = connection.recv_into(view[place:], min(nr_bytes - place, _CHUNK_BYTES))
            if not n:
                break
            place += n
        connection.settimeout(self.pdu_timeout_s)
        return data[:place]

    def _shutdown_socket(self) -> None:
        """Close; whoever still waits for the peer to ask for an association need not do so until time is over."""
        connection = self.socket
        super()._shutdown_socket()
        if connection is not None:
            connection.close()
        if not self.assoc.is_established:
            self.assoc.dul.to_user_queue.put(None)


class _Handler(RequestHandler):
    """Gives every association a guarded socket."""

    def _create_association(self) -> Any:
        association = super()._create_association()
        # "connected" was said by the socket that goes; the one that takes its place says it again
        association.dul.event_queue.get_nowait()
        association.dul.socket = None
        limited: type[GuardedSocket] = self.server.socket_class  # type: ignore[attr-defined]
        association.set_socket(limited(association, client_socket=self.request))
        return association


class ListeningEntity(ApplicationEntity):
    """Counts as associations only those that are, so that the limit on them is one on senders."""

    @property
    def active_associations(self) -> list[Any]:
        """Those established, and the one that is asking for the list."""
        asking = threading.current_thread()
        return [one for one in super().active_associations if one.is_established or one is asking]


def _cut_off(association: Any) -> None:
    """End a connection from this side; its own threads then see that it has ended, and go."""
    connection = getattr(association.dul.socket, "socket", None)
    if connection is not None:
        with contextlib.suppress(OSError):  # it has gone by itself
            connection.shutdown(socket.SHUT_RDWR)


class GuardedServer(ThreadedAssociationServer):
    """One thread accepts; every association has its own.

    Args:
        max_pdu_bytes: of a message unit, as announced to peers.
        max_message_bytes: of an image.
        pdu_timeout_s: for one message unit, from its first byte.
    """

    daemon_threads = True
    request_queue_size = 64

    def __init__(
        self, *args: Any, max_pdu_bytes: int, max_message_bytes: int, pdu_timeout_s: float, **kwargs: Any
    ) -> None:
        limits = {
            "max_pdu_bytes": max(max_pdu_bytes, MAX_CONTROL_PDU_BYTES),
            "max_message_bytes": max_message_bytes,
            "pdu_timeout_s": pdu_timeout_s,
        }
        self.socket_class = type("LimitedSocket", (GuardedSocket,), limits)
        self._pdu_timeout_s = pdu_timeout_s
        self._cut_off: WeakSet[Any] = WeakSet()
        kwargs["request_handler"] = _Handler
        super().__init__(*args, **kwargs)

    def get_request(self) -> tuple[socket.socket, Any]:
        """Accept; a TLS handshake is left to the association's own thread, so that a silent peer holds up none."""
        assert self.socket is not None
        connection, address = self.socket.accept()
        connection.settimeout(self._pdu_timeout_s)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        context: ssl.SSLContext | None = self.ssl_context
        if context is not None:
            connection = context.wrap_socket(connection, server_side=True, do_handshake_on_connect=False)
        return connection, address

    def verify_request(self, request: Any, client_address: Any) -> bool:
        """Make room for another thread; whether there is any."""
        unassociated = [association for association in self.active_associations if not association.is_established]
        waiting = [association for association in unassociated if association not in self._cut_off]
        for oldest in waiting[: max(0, len(waiting) + 1 - MAX_UNASSOCIATED)]:
            self._cut_off.add(oldest)
            _cut_off(oldest)
        # those cut off need a moment to go: a flood of connections meets a wall
        return len(unassociated) < 2 * MAX_UNASSOCIATED

    def service_actions(self) -> None:
        """Nothing: the full garbage collection that would be here takes longer than a slice may."""

    def shutdown(self) -> None:
        """Stop accepting, and end every connection."""
        super(AssociationServer, self).shutdown()
        self.server_close()
        for association in self.active_associations:
            if association.is_established:
                association.abort()
            else:
                _cut_off(association)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A connection that fails at once is closed, and that is all."""
