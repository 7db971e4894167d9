"""The listener takes slices from DCMTK, refuses what it must with the right status, and outlives every bad peer."""

from __future__ import annotations

import os
import shutil
import socket
import struct
import subprocess
import threading
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pynetdicom")

from ctreg_cli.errors import InputError
from ctreg_cli.imaging.slice import Slice, UnreadableSlice
from ctreg_cli.interop.dicom_listener import DicomListener, ListenOptions
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


def test_a_full_disk_is_told_to_the_sender_and_survived(monkeypatch: pytest.MonkeyPatch) -> None:
    real = Path.open
    full = True

    def open_(self: Path, mode: str = "r", *arguments: object, **options: object) -> object:
        if full and mode == "xb":
            raise OSError(28, "No space left on device")
        return real(self, mode, *arguments, **options)  # type: ignore[call-overload]

    monkeypatch.setattr(Path, "open", open_)
    with listening() as (listener, received):
        done = storescu(listener.port, SLICES[0])
        assert "OutOfResources" in done.stderr + done.stdout
        full = False
        assert still_works(listener)
    assert len(received.slices) == 1


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


def test_bad_peers_are_closed_and_good_ones_served() -> None:
    with listening() as (listener, received):
        garbage = raw(listener)
        garbage.sendall(os.urandom(10_000))
        huge = raw(listener)
        huge.sendall(struct.pack(">BBL", 1, 0, 2**32 - 1) + bytes(1000))  # claims 4 GB
        huge_data = raw(listener)
        huge_data.sendall(struct.pack(">BBL", 4, 0, 2**32 - 1) + bytes(1000))
        truncated = raw(listener)
        truncated.sendall(struct.pack(">BBL", 1, 0, 200) + bytes(50))
        truncated.shutdown(socket.SHUT_WR)
        half = raw(listener)
        half.sendall(b"\x01\x00\x00")  # and then nothing
        stalled = raw(listener)
        stalled.sendall(struct.pack(">BBL", 1, 0, 200) + bytes(50))  # and then nothing
        silent = raw(listener)
        gone = raw(listener)
        gone.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        gone.close()
        assert still_works(listener)
        for connection in (garbage, huge, huge_data, truncated, half, stalled, silent):
            connection.settimeout(10)
            assert is_closed(connection)
            connection.close()
        assert still_works(listener, SLICES[0])
    assert len(received.slices) == 2


def test_fifty_connections_at_once() -> None:
    """They are closed when they say nothing, and as many senders as are allowed are then served side by side."""
    with listening(max_associations=4, pdu_timeout_s=2.0) as (listener, received):
        crowd = [raw(listener) for _ in range(50)]
        for connection in crowd:
            connection.settimeout(10)
            assert is_closed(connection)
            connection.close()
        end = time.monotonic() + 10
        while listener._server.active_associations and time.monotonic() < end:
            time.sleep(0.01)
        senders = [threading.Thread(target=storescu, args=(listener.port, path)) for path in SLICES[:4]]
        for sender in senders:
            sender.start()
        for sender in senders:
            sender.join(LIMIT_S)
        assert still_works(listener)
    assert len(received.slices) == 5


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
