"""A DICOM Storage SCP (extra ``live``): slices from a scanner or PACS, as they are sent, for the tracker to take.

Each image is written to a file under a name of our own, read by the same reader as every other file, and put in the
queue; only then does the sender get its answer. Nothing a peer says is shown or logged.
"""

from __future__ import annotations

import itertools
import os
import re
import ssl
import tempfile
import threading
import time
from collections import Counter, OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from ctreg_cli.errors import InputError
from ctreg_cli.imaging.slice import Slice, UnreadableSlice
from ctreg_cli.interop.slice_queue import Policy, SliceQueue
from ctreg_cli.io.dicom_decoding import codec_available
from ctreg_cli.io.image_record import Kind
from ctreg_cli.io.images import read_image_file
from ctreg_cli.io.live_order import LiveOrder, arrival_order
from ctreg_cli.io.optional import optional

DEFAULT_PORT, DEFAULT_AE_TITLE = 11112, "CTREG"

CT_IMAGE, ENHANCED_CT_IMAGE = "1.2.840.10008.5.1.4.1.1.2", "1.2.840.10008.5.1.4.1.1.2.1"
MR_IMAGE, ENHANCED_MR_IMAGE = "1.2.840.10008.5.1.4.1.1.4", "1.2.840.10008.5.1.4.1.1.4.1"
STORAGE_CLASSES = (CT_IMAGE, ENHANCED_CT_IMAGE, MR_IMAGE, ENHANCED_MR_IMAGE)
VERIFICATION_CLASS = "1.2.840.10008.1.1"
_UNCOMPRESSED = (
    "1.2.840.10008.1.2.1",  # Explicit VR Little Endian
    "1.2.840.10008.1.2",  # Implicit VR Little Endian
    "1.2.840.10008.1.2.2",  # Explicit VR Big Endian
    "1.2.840.10008.1.2.1.99",  # Deflated Explicit VR Little Endian
)
_COMPRESSED = (
    "1.2.840.10008.1.2.5",  # RLE Lossless
    "1.2.840.10008.1.2.4.70",  # JPEG Lossless, first-order prediction
    "1.2.840.10008.1.2.4.57",  # JPEG Lossless
    "1.2.840.10008.1.2.4.80",  # JPEG-LS Lossless
    "1.2.840.10008.1.2.4.90",  # JPEG 2000 Lossless
)

# PS3.4 B.2.3: what the sender is told
SUCCESS, OUT_OF_RESOURCES, CANNOT_UNDERSTAND, PROCESSING_FAILURE = 0x0000, 0xA700, 0xC000, 0x0110

_MEMORY_FOLDER = Path("/dev/shm")
SENDER_REFUSED = "sender refused: its title, the title it calls, or too many at once"
#: SOP instances remembered, to know again what is sent a second time
_REMEMBERED = 10_000
_FILE_NAME = re.compile(r"slice_(\d{6,})\.dcm")
#: offered to senders: a CT slice in two units
_PDU_BYTES = 1 << 18
_AE_TITLE = re.compile(r"[\x21-\x5b\x5d-\x7e][\x20-\x5b\x5d-\x7e]{0,15}")


@dataclass(frozen=True, slots=True, kw_only=True)
class ListenOptions:
    """How to listen, to whom, and how much to take."""

    host: str = "127.0.0.1"
    #: 0: a free one
    port: int = DEFAULT_PORT
    ae_title: str = DEFAULT_AE_TITLE
    #: titles that may call; none: any
    allowed: tuple[str, ...] = ()
    tls_certificate: Path | None = None
    tls_key: Path | None = None
    #: clients must show a certificate signed by one of these
    tls_authority: Path | None = None
    policy: Policy = "latest"
    queue_size: int = 8
    #: with the policy ``all``: how long a sender waits for room
    wait_s: float = 20.0
    idle_s: float | None = None
    count: int | None = None
    #: where files are kept; None: nowhere
    keep: Path | None = None
    max_associations: int = 10
    max_image_bytes: int = 1 << 28
    #: images a second, over all senders
    max_rate_hz: float = 100.0
    #: for one message unit, and for a peer that says nothing
    pdu_timeout_s: float = 10.0
    network_timeout_s: float = 60.0


class DicomListener:
    """Listens while it is a context; :attr:`slices` are the slices as they arrive.

    Args:
        options: how to listen.
        on_left_out: told, in a network thread, why an image or a sender was left out, the first time for each reason.

    Raises:
        InputError: pynetdicom is not installed, or the address, a title, a certificate or the folder cannot be used.
    """

    def __init__(self, options: ListenOptions, on_left_out: Callable[[str], None] = lambda reason: None) -> None:
        optional("pynetdicom", extra="live", what="ctreg listen")
        self.options = options
        self.slices = SliceQueue(options.policy, size=options.queue_size, idle_s=options.idle_s, count=options.count)
        #: why images and senders were refused or left out → how many
        self.left_out: Counter[str] = Counter()
        self._on_left_out = on_left_out
        self._lock = threading.Lock()
        self._order = LiveOrder()
        self._seen: OrderedDict[str, None] = OrderedDict()
        self._tokens, self._filled_s = options.max_rate_hz, time.monotonic()
        self._scratch = tempfile.TemporaryDirectory(prefix="ctreg-", dir=_memory_folder())
        self._folder = Path(self._scratch.name) if options.keep is None else options.keep
        try:
            self._numbers = itertools.count(_next_number(self._folder) if options.keep else 0)
            self._server = self._start()
        except BaseException:
            self._scratch.cleanup()
            raise
        self.port: int = self._server.server_address[1]
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.1,), name="dicom", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Stop listening; whoever is connected is cut off."""
        self.slices.close()
        self._server.shutdown()
        self._thread.join(5)
        self._scratch.cleanup()

    def _start(self) -> Any:
        from pynetdicom import _config, evt

        from ctreg_cli.interop.dicom_server import GuardedServer, ListeningEntity

        _config.LOG_HANDLER_LEVEL = "none"  # pynetdicom's own log would quote the peers
        options = self.options
        for title in (options.ae_title, *options.allowed):
            if not _AE_TITLE.fullmatch(title):
                raise InputError(f"{title!r} is no AE title: up to 16 printable ASCII characters, no backslash")
        entity = ListeningEntity(ae_title=options.ae_title)
        entity.require_called_aet = True
        entity.require_calling_aet = list(options.allowed)
        entity.maximum_associations = options.max_associations
        entity.maximum_pdu_size = _PDU_BYTES
        entity.network_timeout = options.network_timeout_s
        entity.acse_timeout = entity.dimse_timeout = options.pdu_timeout_s
        syntaxes = [*_UNCOMPRESSED, *(syntax for syntax in _COMPRESSED if codec_available(syntax))]
        for storage_class in STORAGE_CLASSES:
            entity.add_supported_context(storage_class, syntaxes)
        entity.add_supported_context(VERIFICATION_CLASS)
        handlers: list[Any] = [
            (evt.EVT_C_STORE, self._store),
            (evt.EVT_C_ECHO, _echo),
            (evt.EVT_REJECTED, self._rejected),
        ]
        try:
            return entity.make_server(
                (options.host, options.port),
                evt_handlers=handlers,
                ssl_context=_tls(options),
                server_class=GuardedServer,
                max_pdu_bytes=_PDU_BYTES,
                max_message_bytes=options.max_image_bytes,
                pdu_timeout_s=options.pdu_timeout_s,
            )
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise InputError(
                f"--bind {options.host} --port {options.port}: cannot be listened on ({reason}); name another"
            ) from error

    def _store(self, event: Any) -> int:
        """Take one image; the status its sender is told."""
        _message_done(event)
        if not self._may_come_now():
            return self._leave_out("too many a second", OUT_OF_RESOURCES)
        instance = str(event.request.AffectedSOPInstanceUID)
        with self._lock:
            again = instance in self._seen
            number = 0 if again else next(self._numbers)
        if again:  # because our answer was lost: it has been taken
            return self._leave_out("sent twice", SUCCESS)
        path = self._folder / f"slice_{number:06d}.dcm"
        try:
            with path.open("xb") as file:
                file.write(event.encoded_dataset())
        except OSError:
            path.unlink(missing_ok=True)
            return self._leave_out("cannot be written to disk", OUT_OF_RESOURCES)
        taken = False
        try:
            status = self._take(path)
            taken = status == SUCCESS
        # one image on which the reader breaks shall not end the session; its sender is told
        except Exception:  # noqa: BLE001
            status = self._leave_out("internal error", PROCESSING_FAILURE)
        finally:
            if self.options.keep is None or not taken:
                path.unlink(missing_ok=True)
        if taken:
            with self._lock:
                self._seen[instance] = None
                if len(self._seen) > _REMEMBERED:
                    self._seen.popitem(last=False)
        return status

    def _take(self, path: Path) -> int:
        records = read_image_file(path, path.name)
        if isinstance(records, str):
            return self._leave_out("not an image", CANNOT_UNDERSTAND)
        slices = [record for record in records if record.series.kind is Kind.SLICE]
        if not slices:
            return self._leave_out("localizer or screen capture", SUCCESS)
        with self._lock:
            placed = arrival_order([self._order.place(record) for record in slices])
        items: list[Slice | UnreadableSlice] = [record.load() for record in placed]
        if not self.slices.put(items, self.options.wait_s):
            return self._leave_out("no room in the queue", OUT_OF_RESOURCES)
        if all(isinstance(item, UnreadableSlice) for item in items):
            return self._leave_out("unreadable", CANNOT_UNDERSTAND)
        return SUCCESS

    def _leave_out(self, reason: str, status: int) -> int:
        with self._lock:
            self.left_out[reason] += 1
            is_first = self.left_out[reason] == 1
        if is_first:
            self._on_left_out(reason)
        return status

    def _rejected(self, _event: Any) -> None:
        self._leave_out(SENDER_REFUSED, SUCCESS)

    def _may_come_now(self) -> bool:
        """A bucket that holds a second's images and fills at the allowed rate."""
        rate = self.options.max_rate_hz
        with self._lock:
            now_s = time.monotonic()
            self._tokens = min(max(rate, 1.0), self._tokens + rate * (now_s - self._filled_s))
            self._filled_s = now_s
            if self._tokens < 1:
                return False
            self._tokens -= 1
            return True


def _memory_folder() -> Path | None:
    """A folder in memory, where there is one: slices need no disk to go through, and leave nothing on it."""
    return _MEMORY_FOLDER if os.access(_MEMORY_FOLDER, os.W_OK | os.X_OK) else None


def _echo(event: Any) -> int:
    _message_done(event)
    return SUCCESS


def _message_done(event: Any) -> None:
    connection = event.assoc.dul.socket
    if connection is not None:
        connection.message_done()


def _next_number(folder: Path) -> int:
    """The number after those in the folder, which is made if need be.

    Raises:
        InputError: it cannot be made, or is a file.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        numbers = [int(match[1]) for path in folder.iterdir() if (match := _FILE_NAME.fullmatch(path.name))]
    except OSError as error:
        raise InputError(f"--keep {folder}: cannot be made or read ({error.strerror})") from error
    return max(numbers, default=-1) + 1


def _tls(options: ListenOptions) -> ssl.SSLContext | None:
    """
    Raises:
        InputError: only a part of what TLS needs is given, or a file cannot be used.
    """
    if options.tls_certificate is None:
        if options.tls_key or options.tls_authority:
            raise InputError("--tls-key and --tls-ca go with --tls-cert FILE")
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    place = options.tls_certificate
    try:
        context.load_cert_chain(options.tls_certificate, options.tls_key)
        if options.tls_authority is not None:
            place = options.tls_authority
            context.load_verify_locations(options.tls_authority)
            context.verify_mode = ssl.CERT_REQUIRED
    except (OSError, ValueError) as error:  # ssl.SSLError is an OSError
        reason = getattr(error, "strerror", None) or "not what it should be"
        raise InputError(f"{place}: cannot be used for TLS ({reason}); give PEM files") from error
    return context
