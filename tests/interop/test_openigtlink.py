"""OpenIGTLink clients of other makers receive the poses; no client can hold the sender up."""

from __future__ import annotations

import json
import socket
import struct
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ctreg_cli.errors import InputError
from ctreg_cli.interop.igtl_server import MAX_CLIENTS, MAX_WAITING, IgtlServer, parse_address
from ctreg_cli.interop.openigtlink import HEADER, crc64, encode_result

from .frames import frame_results


def wait_for(condition: Callable[[], bool], seconds: float = 10.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.005)


def messages(data: bytes) -> list[tuple[str, str, float, bytes]]:
    """Type, device, time and body of messages, read by the letter of the specification."""
    found, place = [], 0
    while place < len(data):
        version, kind, device, ticks, size, crc = HEADER.unpack_from(data, place)
        body = data[place + HEADER.size : place + HEADER.size + size]
        assert version == 1
        assert crc == crc64(body)
        found.append((kind.rstrip(b"\0").decode(), device.rstrip(b"\0").decode(), ticks / 2**32, body))
        place += HEADER.size + size
    return found


def test_checksum_is_the_standards() -> None:
    """CRC-64/ECMA-182 of the digits 1 to 9, from the catalogue of parametrised CRC algorithms."""
    assert crc64(b"123456789") == 0x6C40DF5F0B497347


def test_only_ok_sends_a_transform() -> None:
    for result in frame_results():
        found = messages(encode_result(result))
        kinds = [(kind, device) for kind, device, _, _ in found]
        assert kinds.count(("STATUS", "Status")) == 1
        assert (("TRANSFORM", "SliceFromModel") in kinds) == (result.status == "ok")
        assert (("TRANSFORM", "PatientFromModel") in kinds) == (result.status == "ok")
        assert all(time_s == pytest.approx(result.info.time_s) for _, _, time_s, _ in found)
        (body,) = (body for kind, _, _, body in found if kind == "STATUS")
        assert struct.unpack(">H", body[:2])[0] == (1 if result.status == "ok" else 0)
        (text,) = (body[4:] for kind, _, _, body in found if kind == "STRING")
        said = json.loads(text)
        assert (said["slice"], said["status"], said["reason"]) == (result.index, result.status, result.reason)
        assert (said["translation_mm"] is None) == (result.status != "ok")


def test_cpp_client_receives_every_pose(cpp_client: Path) -> None:
    results = list(frame_results(100))
    with IgtlServer(port=0) as server:
        client = subprocess.Popen(
            [str(cpp_client), str(server.port), str(len(results))], stdout=subprocess.PIPE, text=True
        )
        assert client.stdout is not None
        assert client.stdout.readline() == "CONNECTED\n"
        wait_for(lambda: server.n_clients == 1)
        for result in results:
            server.write(result)
            time.sleep(0.002)
        out, _ = client.communicate(timeout=20)
    assert client.returncode == 0
    lines = [line.split(" ", 3) for line in out.splitlines()]
    statuses = [rest for kind, _, _, rest in lines if kind == "STATUS"]
    assert [text.split()[1] for text in statuses] == [result.status for result in results]
    good = [result for result in results if result.status == "ok"]
    for device in ("SliceFromModel", "PatientFromModel"):
        received = [rest for _, name, _, rest in lines if name == device]
        for result, text in zip(good, received, strict=True):
            assert result.best is not None
            T = result.best.T_slice_model
            if device == "PatientFromModel":
                assert result.info.T_patient_slice is not None
                T = result.info.T_patient_slice @ T
            numbers = np.array(text.split(), dtype=float).reshape(3, 4)
            np.testing.assert_allclose(numbers, T[:3], rtol=1e-6, atol=1e-6)
    qualities = [json.loads(rest) for _, name, _, rest in lines if name == "Quality"]
    sent = [quality["translation_mm"] for quality in qualities if quality["translation_mm"]]
    np.testing.assert_array_equal(sent, [result.best.T_slice_model[:3, 3] for result in good if result.best])


def test_pyigtl_receives_poses() -> None:
    pyigtl = pytest.importorskip("pyigtl")
    first, *_ = frame_results()
    assert first.best is not None
    with IgtlServer(port=0) as server:
        client = pyigtl.OpenIGTLinkClient("127.0.0.1", server.port)
        try:
            wait_for(lambda: server.n_clients == 1)
            server.write(first)
            received = client.wait_for_message("SliceFromModel", timeout=5)
            quality = client.wait_for_message("Quality", timeout=5)
        finally:
            client.stop()
    np.testing.assert_allclose(received.matrix, first.best.T_slice_model, rtol=1e-6, atol=1e-6)
    assert received.timestamp == pytest.approx(first.info.time_s)
    assert json.loads(quality.string)["status"] == "ok"


def connect(server: IgtlServer) -> socket.socket:
    return socket.create_connection(("127.0.0.1", server.port), timeout=5)


def read_all(connection: socket.socket) -> bytes:
    data = b""
    while chunk := connection.recv(65536):
        data += chunk
    return data


def test_a_client_that_never_reads_loses_whole_slices_and_others_none() -> None:
    """40 MB for a client that takes nothing: the sender does not wait, and the other client gets all of it."""
    big = [encode_result(result) * 50 for result in frame_results(4)]
    n = 40_000_000 // len(big[0])
    with IgtlServer(port=0) as server:
        lazy, eager = connect(server), connect(server)
        wait_for(lambda: server.n_clients == 2)
        expected, received = 0, 0
        eager.settimeout(10)
        for k in range(n):
            server.send(big[k % 4])
            expected += len(big[k % 4])
            while received < expected:
                received += len(eager.recv(1 << 20))
        assert server.dropped > n // 2
        # what the lazy one finds in the end is whole messages, however many slices were left out between them
        lazy.settimeout(10)
        server.close()
        data = read_all(lazy)
        assert len(data) < 40_000_000
        starts = _starts(data)
        assert len(starts) > 10
        assert {data[start + 2 : start + 14].rstrip(b"\0") for start in starts} <= {b"TRANSFORM", b"STATUS", b"STRING"}
        for connection in (lazy, eager):
            connection.close()


def _starts(data: bytes) -> list[int]:
    """Where messages begin; the last may be cut off by the end."""
    starts, place = [], 0
    while place + HEADER.size <= len(data):
        starts.append(place)
        place += HEADER.size + int(HEADER.unpack_from(data, place)[4])
    return starts


def test_dead_many_and_chattering_clients() -> None:
    data = encode_result(next(frame_results()))
    with IgtlServer(port=0) as server:
        crowd = [connect(server) for _ in range(MAX_CLIENTS + 5)]
        wait_for(lambda: server.refused == 5)
        for connection in crowd[:10]:  # reset, not closed politely
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            connection.close()
        crowd[10].sendall(b"\xff" * 1_000_000)  # says what no client should
        server.send(data)
        wait_for(lambda: not server._outbox and server.n_clients == MAX_CLIENTS - 10)
        back = connect(server)  # one comes again
        wait_for(lambda: server.n_clients == MAX_CLIENTS - 9)
        server.send(data)
        server.close()
        assert messages(read_all(back)) == messages(data)
        assert messages(read_all(crowd[11])) == messages(data) * 2
        for connection in [*crowd, back]:
            connection.close()


def test_server_without_clients_keeps_nothing() -> None:
    with IgtlServer(port=0) as server:
        for result in frame_results(20 * MAX_WAITING):
            server.write(result)
        wait_for(lambda: not server._outbox)


def test_a_taken_port_is_one_message() -> None:
    with IgtlServer(port=0) as server, pytest.raises(InputError, match="name another port"):
        IgtlServer(port=server.port)


@pytest.mark.parametrize(
    ("text", "expected"),
    [("18944", ("127.0.0.1", 18944)), ("0.0.0.0:1", ("0.0.0.0", 1)), ("[::1]:7", ("::1", 7)), (":5", ("127.0.0.1", 5))],
)
def test_addresses(text: str, expected: tuple[str, int]) -> None:
    assert parse_address(text) == expected


@pytest.mark.parametrize("text", ["", "x", "host:", "host:70000", "1:2:x", "-1"])
def test_no_addresses(text: str) -> None:
    with pytest.raises(InputError, match="HOST"):
        parse_address(text)
