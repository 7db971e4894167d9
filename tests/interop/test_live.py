"""Beside the scanner: the whole chain from a DICOM sender to an OpenIGTLink client, and slices that break things."""

from __future__ import annotations

import csv
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ctreg_cli.imaging.slice import Slice, SliceInfo
from ctreg_cli.imaging.spot_slice import SpotSlice
from ctreg_cli.interop import live
from ctreg_cli.interop.slice_queue import SliceQueue
from ctreg_cli.io.images import read_slices
from ctreg_cli.io.rod_file import load_rod_model
from ctreg_cli.pipeline import SliceLike, no_spots, track

from .senders import LIMIT_S, SAMPLES, SLICES, free_port, needs_storescu, storescu

FRAME = SAMPLES.parent / "frame.yaml"
N = 5


@needs_storescu
def test_from_sender_to_client(cpp_client: Path, tmp_path: Path) -> None:
    """What the C++ client receives is what the table holds, to 1e-6 of 32-bit floats and bit for bit in the quality.

    Peers that mean no good come before and between; every good slice is tracked all the same.
    """
    pytest.importorskip("pynetdicom")
    port, igtl, table = free_port(), free_port(), tmp_path / "poses.csv"
    options = ["--port", port, "--igtl", igtl, "--queue", "all", "--count", N, "--idle", LIMIT_S, "-o", table]
    command = [sys.executable, "-m", "ctreg_cli", "listen", "-m", FRAME, *options]
    listener = subprocess.Popen([*map(str, command)], stderr=subprocess.PIPE, text=True, cwd=tmp_path)
    try:
        assert listener.stderr is not None
        assert listener.stderr.readline().startswith("listening as CTREG")
        client = subprocess.Popen([str(cpp_client), str(igtl), str(N)], stdout=subprocess.PIPE, text=True)
        assert client.stdout is not None
        assert client.stdout.readline() == "CONNECTED\n"
        time.sleep(0.2)  # it is connected, and now also let in
        crowd = [socket.create_connection(("127.0.0.1", port)) for _ in range(50)]
        for number, peer in enumerate(crowd[::5]):
            peer.sendall([b"\x01\0\xff\xff\xff\xff", np.random.default_rng(number).bytes(10_000)][number % 2])
        assert storescu(port, SLICES[0]).returncode == 0
        assert storescu(port, SLICES[1], called="OTHER").returncode != 0
        assert storescu(port, *SLICES[1:N]).returncode == 0
        for peer in crowd:
            peer.close()
        out, _ = client.communicate(timeout=LIMIT_S)
        _, said = listener.communicate(timeout=LIMIT_S)
    finally:
        listener.kill()
    assert listener.returncode == 0, said
    with table.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    lines = [line.split(" ", 3) for line in out.splitlines()]
    received = [text for _, device, _, text in lines if device == "SliceFromModel"]
    assert len(received) == len(rows) == N
    for row, text in zip(rows, received, strict=True):
        T = np.array(text.split(), dtype=float).reshape(3, 4)
        np.testing.assert_allclose(T[:, 3], [float(row[f"t{axis}_mm"]) for axis in "xyz"], rtol=1e-6, atol=1e-6)
        R = Rotation.from_quat([float(row[f"q{axis}"]) for axis in "xyzw"]).as_matrix()
        np.testing.assert_allclose(T[:, :3], R, atol=1e-6)


def samples() -> list[Slice]:
    return read_slices(*SLICES[:N])


def test_a_slice_on_which_the_method_breaks_is_a_row(monkeypatch: pytest.MonkeyPatch) -> None:
    slices, told = samples(), list[str]()
    real = live.track_slice

    def breaks(place: int, slice_: SliceLike, *arguments: object, **options: object) -> object:
        if place == 2:
            raise np.linalg.LinAlgError("Singular matrix")
        return real(place, slice_, *arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(live, "track_slice", breaks)
    results = list(live.track_live(slices, load_rod_model(FRAME), on_fault=told.append))
    assert [result.status for result in results] == ["ok", "ok", "no_pose", "ok", "ok"]
    assert results[2].reason == "internal_error"
    assert results[2].best is None
    assert [result.index for result in results] == list(range(N))
    assert len(told) == 1
    assert "LinAlgError" in told[0]


def test_a_slice_without_scale_is_a_row() -> None:
    slices: list[SliceLike] = [*samples()]
    slices[1] = SpotSlice(info=SliceInfo(source="odd.png"), spots=no_spots())
    results = list(live.track_live(slices, load_rod_model(FRAME)))
    assert (results[1].status, results[1].reason) == ("no_pose", "no_scale")
    assert [result.status for result in results].count("ok") == N - 1


def test_live_is_track_where_nothing_breaks() -> None:
    model = load_rod_model(FRAME)
    for one, other in zip(live.track_live(samples(), model), track(samples(), model), strict=True):
        assert (one.index, one.status, one.method) == (other.index, other.status, other.method)
        assert one.best is not None
        assert other.best is not None
        np.testing.assert_array_equal(one.best.T_slice_model, other.best.T_slice_model)


def item(number: int) -> Slice:
    return Slice(info=SliceInfo(source=str(number)), stored=np.zeros((2, 2)))


def numbers(queue: SliceQueue) -> list[int]:
    return [int(slice_.info.source) for slice_ in queue]


def test_queue_latest_keeps_the_newest() -> None:
    queue = SliceQueue("latest", size=3)
    assert all(queue.put([item(number)], 0) for number in range(10))
    queue.close()
    assert numbers(queue) == [7, 8, 9]
    assert queue.dropped == 7


def test_queue_all_makes_senders_wait_and_loses_nothing() -> None:
    queue = SliceQueue("all", size=2, count=100)

    def send() -> None:
        for number in range(100):
            assert queue.put([item(number)], 10)

    sender = threading.Thread(target=send)
    sender.start()

    def slow() -> Iterator[int]:
        for slice_ in queue:
            time.sleep(0.001)
            yield int(slice_.info.source)

    assert list(slow()) == list(range(100))
    sender.join(10)
    assert queue.dropped == 0


def test_queue_ends_when_idle() -> None:
    queue = SliceQueue("latest", size=3, idle_s=0.05)
    queue.put([item(1)], 0)
    assert numbers(queue) == [1]


def test_queue_takes_more_frames_at_once_than_it_holds() -> None:
    """A multi-frame file goes in whole, once the queue is empty."""
    queue = SliceQueue("all", size=2)
    assert queue.put([item(number) for number in range(5)], 0)
    assert not queue.put([item(9)], 0)
    assert queue.dropped == 1
    queue.close()
    assert numbers(queue) == [0, 1, 2, 3, 4]
