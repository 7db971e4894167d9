"""The listener takes slices from DCMTK, refuses what it must with the right status, and outlives every bad peer."""

from __future__ import annotations

import shutil
import socket
import struct
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pynetdicom")

from ctreg_cli.errors import InputError
from ctreg_cli.imaging.slice import Slice, UnreadableSlice
from ctreg_cli.interop import dicom_listener
from ctreg_cli.interop.dicom_listener import SENDER_REFUSED, DicomListener, ListenOptions
from ctreg_cli.interop.dicom_server import MAX_UNASSOCIATED
from ctreg_cli.io.images import read_slices

from .senders import LIMIT_S, SLICES, listening, needs_storescu, storescu

pytestmark = needs_storescu


def still_works(listener: DicomListener, slice_: Path = SLICES[-1]) -> bool:
    done = storescu(listener.port, slice_)
    return done.returncode == 0 and "Received Store Response (Success)" in done.stderr + done.stdout


def test_slices_are_those_of_the_files() -> None:
    expected = read_slices(*SLICES[:4])
    with listening() as (listener, received):
        assert storescu(listener.port, *SLICES[:4]).returncode == 0
    assert len(received.slices) == len(expected)
    for got, want in zip(received.slices, expected, strict=True):
        assert isinstance(got, Slice)
        np.testing.assert_array_equal(got.values(), want.values())
        assert got.info.scale == want.info.scale
        assert got.info.time_s == pytest.approx(want.info.time_s)
        assert got.info.T_patient_slice is not None
        assert want.info.T_patient_slice is not None
        np.testing.assert_array_equal(got.info.T_patient_slice, want.info.T_patient_slice)
    assert len({item.info.series for item in received.slices}) == 1


@pytest.mark.parametrize("syntax", ["-xi", "-xb", "-xe"])
def test_transfer_syntaxes(syntax: str) -> None:
    with listening() as (listener, received):
        assert storescu(listener.port, SLICES[0], options=(syntax,)).returncode == 0
    (want,) = read_slices(SLICES[0])
    (got,) = received.slices
    assert isinstance(got, Slice)
    np.testing.assert_array_equal(got.values(), want.values())


def test_echo() -> None:
    with listening() as (listener, _):
        done = subprocess.run(["echoscu", "-aec", "CTREG", "127.0.0.1", str(listener.port)], timeout=LIMIT_S)
    assert done.returncode == 0


def test_titles() -> None:
    with listening(allowed=("SCANNER",)) as (listener, received):
        wrong = storescu(listener.port, SLICES[0], called="OTHER")
        assert wrong.returncode != 0
        assert "Called AE Title Not Recognized" in wrong.stderr + wrong.stdout
        stranger = storescu(listener.port, SLICES[0], calling="STRANGER")
        assert stranger.returncode != 0
        assert "Calling AE Title Not Recognized" in stranger.stderr + stranger.stdout
        assert still_works(listener)
        assert listener.left_out == {SENDER_REFUSED: 2}
    assert len(received.slices) == 1


def test_sent_twice_counts_once() -> None:
    with listening() as (listener, received):
        assert storescu(listener.port, SLICES[0], SLICES[0], SLICES[1]).returncode == 0
        assert listener.left_out == {"sent twice": 1}
    assert len(received.slices) == 2


def test_files_are_kept_under_names_of_our_own(tmp_path: Path) -> None:
    """Numbering goes on from a session before; no name holds anything the sender said."""
    folder = tmp_path / "kept"
    for number in range(2):
        with listening(keep=folder) as (listener, _):
            assert storescu(listener.port, SLICES[2 * number], SLICES[2 * number + 1]).returncode == 0
    assert sorted(path.name for path in folder.iterdir()) == [f"slice_{number:06d}.dcm" for number in range(4)]
    kept = read_slices(*sorted(folder.iterdir()))
    for got, want in zip(kept, read_slices(*SLICES[:4]), strict=True):
        np.testing.assert_array_equal(got.stored, want.stored)


def test_nothing_is_left_without_keep() -> None:
    with listening() as (listener, _):
        scratch = listener._folder
        assert storescu(listener.port, SLICES[0]).returncode == 0
        assert list(scratch.iterdir()) == []
    assert not scratch.exists()


def test_latest_drops_the_oldest_and_counts() -> None:
    with DicomListener(ListenOptions(port=0, policy="latest", queue_size=2)) as listener:
        assert storescu(listener.port, *SLICES[:6]).returncode == 0
        assert listener.slices.dropped == 4
        listener.slices.close()
        times = [item.info.time_s for item in listener.slices]
    assert times == [slice_.info.time_s for slice_ in read_slices(*SLICES[:6])][4:]


def test_all_refuses_when_nobody_takes_them() -> None:
    with DicomListener(ListenOptions(port=0, policy="all", queue_size=2, wait_s=0.2)) as listener:
        done = storescu(listener.port, *SLICES[:3])
        assert "OutOfResources" in done.stderr + done.stdout
        assert listener.left_out["no room in the queue"] == 1
        listener.slices.close()
        assert len(list(listener.slices)) == 2


def test_rate_is_limited() -> None:
    with listening(max_rate_hz=2.0) as (listener, received):
        done = storescu(listener.port, *SLICES[:6])
        assert "OutOfResources" in done.stderr + done.stdout
        assert listener.left_out["too many a second"] > 0
        time.sleep(0.6)
        assert still_works(listener)
    assert 2 <= len(received.slices) <= 5


def test_a_full_disk_is_told_to_the_sender_and_survived(tmp_path: Path) -> None:
    """The system itself refuses to let files grow: half a slice fits."""
    resource = pytest.importorskip("resource")
    size = SLICES[0].stat().st_size
    kept = tmp_path / "kept"
    _, most = limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    with listening(keep=kept) as (listener, received):
        resource.setrlimit(resource.RLIMIT_FSIZE, (size // 2, most))
        try:
            done = storescu(listener.port, SLICES[0])
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert "OutOfResources" in done.stderr + done.stdout
        assert listener.left_out == {"cannot be written to disk": 1}
        assert list(kept.iterdir()) == []
        assert still_works(listener)
    assert len(received.slices) == 1


def test_an_image_on_which_the_reader_breaks_ends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    real = dicom_listener.read_image_file
    breaks = [True]

    def read(path: Path, source: str) -> Any:
        if breaks.pop():
            breaks.append(False)
            raise ZeroDivisionError
        breaks.append(False)
        return real(path, source)

    monkeypatch.setattr(dicom_listener, "read_image_file", read)
    with listening() as (listener, received):
        done = storescu(listener.port, SLICES[0], SLICES[1])
        assert "0x110" in done.stderr + done.stdout
        assert listener.left_out == {"internal error": 1}
        assert still_works(listener)
    assert len(received.slices) >= 1


def test_what_cannot_be_read_is_told_and_becomes_a_row(tmp_path: Path) -> None:
    import pydicom

    ds = pydicom.dcmread(SLICES[0])
    ds.PixelData = ds.PixelData[:1000]
    ds.save_as(tmp_path / "short.dcm")
    with listening() as (listener, received):
        done = storescu(listener.port, tmp_path / "short.dcm")
        assert "CannotUnderstand" in done.stderr + done.stdout
        assert still_works(listener)
    assert [type(item) for item in received.slices] == [UnreadableSlice, Slice]


def raw(listener: DicomListener) -> socket.socket:
    return socket.create_connection(("127.0.0.1", listener.port), timeout=LIMIT_S)


def settles(condition: Callable[[], bool]) -> bool:
    """Whether it comes true in time."""
    end = time.monotonic() + 10
    while not condition() and time.monotonic() < end:
        time.sleep(0.01)
    return condition()


def is_closed(connection: socket.socket) -> bool:
    """Whether the other side ends the connection in time; what it says before does not matter."""
    try:
        while connection.recv(4096):
            pass
    except ConnectionError:
        return True
    except TimeoutError:
        return False
    return True


#: starts of what peers send that mean no good; the rest never comes
CLAIMS = {
    "4 GB for a request": struct.pack(">BBL", 1, 0, 2**32 - 1) + bytes(1000),
    "4 GB of data": struct.pack(">BBL", 4, 0, 2**32 - 1) + bytes(1000),
}
BROKEN_OFF = {
    "nothing": b"",
    "half a header": b"\x01\x00\x00",
    "a quarter of a request": struct.pack(">BBL", 1, 0, 200) + bytes(50),
}


@pytest.mark.parametrize("said", CLAIMS.values(), ids=list(CLAIMS))
def test_what_no_peer_may_say_ends_the_connection_at_once(said: bytes) -> None:
    """Not when the patience for a message unit is over: that is a minute here."""
    with listening(pdu_timeout_s=60.0) as (listener, received):
        peer = raw(listener)
        peer.sendall(said)
        peer.settimeout(5)
        assert is_closed(peer)
        peer.close()
        assert still_works(listener)
    assert len(received.slices) == 1


def test_ten_thousand_random_bytes() -> None:
    with listening(pdu_timeout_s=1.0) as (listener, received):
        for first in (0, 1, 2, 4, 5, 7, 255):
            peer = raw(listener)
            peer.sendall(bytes([first]) + np.random.default_rng(first).bytes(9999))
            peer.settimeout(10)
            assert is_closed(peer)
            peer.close()
        assert still_works(listener)
    assert len(received.slices) == 1


def test_half_open_peers_are_closed_in_time_and_hold_up_nobody() -> None:
    with listening(pdu_timeout_s=1.0) as (listener, received):
        peers = []
        for said in BROKEN_OFF.values():
            peers.append(raw(listener))
            peers[-1].sendall(said)
        truncated = raw(listener)
        truncated.sendall(BROKEN_OFF["a quarter of a request"])
        truncated.shutdown(socket.SHUT_WR)
        gone = raw(listener)
        gone.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        gone.close()
        assert still_works(listener)
        for connection in (*peers, truncated):
            connection.settimeout(10)
            assert is_closed(connection)
            connection.close()
        assert still_works(listener, SLICES[0])
    assert len(received.slices) == 2


def test_a_peer_that_drips_is_not_waited_for() -> None:
    """A byte now and then keeps no message unit open for longer than one may take."""
    with listening(pdu_timeout_s=1.0) as (listener, _):
        peer = raw(listener)
        peer.sendall(struct.pack(">BBL", 1, 0, 10_000))
        start = time.monotonic()
        try:
            while time.monotonic() < start + 10:
                peer.sendall(b"\0")
                time.sleep(0.05)
        except ConnectionError:
            pass
        assert time.monotonic() < start + 5
        peer.close()


def test_fifty_connections_at_once() -> None:
    """They say nothing for a minute; senders are served meanwhile, as many at a time as are allowed."""
    with listening(max_associations=4, pdu_timeout_s=60.0) as (listener, received):
        crowd = [raw(listener) for _ in range(50)]
        assert still_works(listener)
        assert settles(lambda: len(listener._server.active_associations) <= 2 * MAX_UNASSOCIATED)
        senders = [threading.Thread(target=storescu, args=(listener.port, path)) for path in SLICES[:4]]
        for sender in senders:
            sender.start()
        for sender in senders:
            sender.join(LIMIT_S)
        for connection in crowd:
            connection.close()
    assert len(received.slices) == 5


def test_more_senders_than_allowed_are_told() -> None:
    from pynetdicom.ae import ApplicationEntity

    entity = ApplicationEntity(ae_title="SCANNER")
    entity.add_requested_context("1.2.840.10008.1.1")
    with listening(max_associations=2) as (listener, _):
        held = [entity.associate("127.0.0.1", listener.port, ae_title="CTREG") for _ in range(2)]
        assert all(association.is_established for association in held)
        assert entity.associate("127.0.0.1", listener.port, ae_title="CTREG").is_rejected
        held[0].release()
        assert settles(lambda: sum(one.is_established for one in listener._server.active_associations) <= 1)
        again = entity.associate("127.0.0.1", listener.port, ae_title="CTREG")
        assert again.is_established
        again.release()
        held[1].release()


def test_an_image_that_is_too_large_is_cut_off() -> None:
    with listening(max_image_bytes=100_000) as (listener, received):
        assert storescu(listener.port, SLICES[0]).returncode != 0
    assert received.slices == []


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if shutil.which("openssl") is None:
        pytest.skip("Debian package openssl is not installed")
    folder = tmp_path_factory.mktemp("tls")
    for name in ("server", "client", "stranger"):
        subject = ["-subj", f"/CN={name}", "-days", "2", "-keyout", f"{name}.key", "-out", f"{name}.pem"]
        command = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", *subject]
        subprocess.run(command, cwd=folder, check=True, capture_output=True, timeout=LIMIT_S)
    return folder


def test_tls_asks_for_the_clients_certificate(certificates: Path) -> None:
    def options(name: str) -> tuple[str, ...]:
        trust = ("+cf", str(certificates / "server.pem"))
        return ("+tls", str(certificates / f"{name}.key"), str(certificates / f"{name}.pem"), *trust)

    with listening(
        tls_certificate=certificates / "server.pem",
        tls_key=certificates / "server.key",
        tls_authority=certificates / "client.pem",
    ) as (listener, received):
        mute = raw(listener)  # a peer that never shakes hands holds up nobody
        assert storescu(listener.port, SLICES[0], options=options("client")).returncode == 0
        assert storescu(listener.port, SLICES[1], options=options("stranger")).returncode != 0
        assert storescu(listener.port, SLICES[1]).returncode != 0
        assert storescu(listener.port, SLICES[2], options=options("client")).returncode == 0
        mute.close()
    assert len(received.slices) == 2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"ae_title": "a title far too long for it"}, "AE title"),
        ({"allowed": ("BACK\\SLASH",)}, "AE title"),
        ({"port": 70000}, "cannot be listened on"),
        ({"host": "198.51.100.1"}, "cannot be listened on"),
        ({"tls_key": Path("x.key")}, "--tls-cert"),
        ({"tls_certificate": Path("nowhere.pem")}, "nowhere.pem"),
        ({"keep": SLICES[0]}, "--keep"),
    ],
)
def test_mistakes_are_one_message(options: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        DicomListener(ListenOptions(**({"port": 0} | options)))  # type: ignore[arg-type]
