"""How long from "the slice is stored" to "the pose is on the wire": `ctreg listen` fed by DCMTK's storescu.

    python benchmarks/latency.py                    # 12 slices/s for 30 s, one storescu a slice
    python benchmarks/latency.py --soak 43200       # an hour's worth of slices, as fast as they go; memory and losses

The time starts when storescu says that its C-STORE was answered, and ends when the TRANSFORM's bytes have reached a
client. Both are read from this process's clock.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import signal
import socket
import statistics
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from ctreg_cli.interop.openigtlink import HEADER

FRAME = "rod-cube-30x30x40"
SERIES = 60
MEDIAN_LIMIT_MS, P99_LIMIT_MS = 15.0, 40.0
UID_DIGITS = 20
INTERVAL_S = 1 / 12
MEMORY = Path("/dev/shm")


class Client:
    """An OpenIGTLink client that notes when each slice's messages came."""

    def __init__(self, port: int) -> None:
        end = time.monotonic() + 20
        while True:
            try:
                self._socket = socket.create_connection(("127.0.0.1", port))
                break
            except ConnectionRefusedError:
                if time.monotonic() > end:
                    raise
                time.sleep(0.05)
        #: (seconds of perf_counter at the first message, at the TRANSFORM or None) of every slice, in order
        self.slices: list[tuple[float, float | None]] = []
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        stream = self._socket.makefile("rb")
        transform = None
        while head := stream.read(HEADER.size):
            kind, size = HEADER.unpack(head)[1].rstrip(b"\0"), HEADER.unpack(head)[4]
            body, now = stream.read(size), time.perf_counter()
            if kind == b"TRANSFORM" and transform is None:
                transform = now
            elif kind == b"STATUS":
                good = struct.unpack(">H", body[:2])[0] == 1
                self.slices.append((now, transform if good else None))
                transform = None

    def wait(self, n: int, seconds: float) -> bool:
        """Whether so many slices have come in time."""
        end = time.monotonic() + seconds
        while len(self.slices) < n and time.monotonic() < end:
            time.sleep(0.002)
        return len(self.slices) >= n


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def templates(folder: Path) -> list[bytes]:
    """Slices of a frame that breathes, the last followed by the first; UIDs and times have places of known length."""
    import pydicom

    motion = ["--interval-s", str(INTERVAL_S), "--period-s", str(SERIES * INTERVAL_S)]
    command = ["simulate", "-m", FRAME, "--frames", str(SERIES), *motion, "-o", str(folder / "series")]
    subprocess.run([sys.executable, "-m", "ctreg_cli", *command, "-q"], check=True)
    found = []
    for path in sorted((folder / "series").glob("*.dcm")):
        ds = pydicom.dcmread(path)
        ds.SOPInstanceUID = ds.file_meta.MediaStorageSOPInstanceUID = _uid(0)
        for keyword in ("AcquisitionTime", "ContentTime"):
            setattr(ds, keyword, _time(0))
        ds.save_as(path)
        found.append(path.read_bytes())
    return found


def _uid(number: int) -> str:
    return f"2.25.1{number:0{UID_DIGITS}d}"


def _time(number: int) -> str:
    seconds = 8 * 3600 + number * INTERVAL_S
    return f"{int(seconds // 3600):02d}{int(seconds // 60 % 60):02d}{seconds % 60:09.6f}"


def renamed(data: bytes, number: int) -> bytes:
    """The same slice as an instance and at a time of its own."""
    return data.replace(_uid(0).encode(), _uid(number + 1).encode()).replace(_time(0).encode(), _time(number).encode())


@contextlib.contextmanager
def listener(folder: Path, port: int, igtl: int, *options: object) -> Iterator[subprocess.Popen[str]]:
    command = ["listen", "-m", FRAME, "--port", port, "--igtl", igtl, "--queue", "all", *options]
    process = subprocess.Popen(
        [sys.executable, "-m", "ctreg_cli", *map(str, command), "-o", str(folder / "poses.jsonl")],
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    process.stderr.readline()
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        try:
            print(process.communicate(timeout=20)[1].strip())
        except subprocess.TimeoutExpired:
            process.kill()
            print("the listener did not end")


def latency(n: int, rate_hz: float) -> bool:
    """Print the distribution; whether it is within the limits."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        slices = templates(folder)
        port, igtl = free_port(), free_port()
        done: list[float] = []
        with listener(folder, port, igtl):
            client = Client(igtl)
            time.sleep(0.3)
            start = time.perf_counter()
            for number in range(n):
                path = folder / "slice.dcm"
                path.write_bytes(renamed(slices[number % len(slices)], number))
                time.sleep(max(0.0, start + number / rate_hz - time.perf_counter()))
                done.append(send(port, path))
            achieved = n / (time.perf_counter() - start)
            if not client.wait(n, 10):
                print(f"lost: {n - len(client.slices)} of {n} slices")
                return False
        methods = Counter(json.loads(line)["method"] for line in (folder / "poses.jsonl").open() if '"method"' in line)
    ms = sorted(1000 * (came - sent) for sent, (_, came) in zip(done, client.slices, strict=True) if came is not None)
    n_lost = n - len(ms)
    p99 = ms[min(len(ms) - 1, round(0.99 * len(ms)))]
    median = statistics.median(ms)
    print(f"{n} slices of 512 × 512 at {achieved:.1f}/s, {n_lost} without a pose, {os.cpu_count()} cores")
    print(f"C-STORE answered → TRANSFORM received: median {median:.1f} ms, 99 % {p99:.1f} ms, greatest {ms[-1]:.1f} ms")
    print("poses by method:", ", ".join(f"{count} {method or 'none'}" for method, count in methods.most_common()))
    print("(negative: the pose was there before storescu had read its answer)")
    good = median <= MEDIAN_LIMIT_MS and p99 <= P99_LIMIT_MS
    print("within" if good else "NOT within", f"median {MEDIAN_LIMIT_MS:g} ms, 99 % {P99_LIMIT_MS:g} ms")
    return good


def send(port: int, path: Path) -> float:
    """Store one slice with storescu; when it said that the store was answered."""
    command = ["storescu", "-v", "-aec", "CTREG", "127.0.0.1", str(port), str(path)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert process.stdout is not None
    answered = None
    for line in process.stdout:
        if "Received Store Response (Success)" in line:
            answered = time.perf_counter()
    if process.wait() != 0 or answered is None:
        raise SystemExit("storescu could not store a slice")
    return answered


def soak(n: int) -> bool:
    """Send n slices with storescu, an association for every batch; print losses and the listener's memory."""
    with tempfile.TemporaryDirectory(dir=MEMORY if MEMORY.is_dir() else None) as name:
        folder = Path(name)
        slices = templates(folder)
        port, igtl = free_port(), free_port()
        with listener(folder, port, igtl, "--max-rate", 10_000) as process:
            client = Client(igtl)
            time.sleep(0.3)
            memory: list[float] = []
            start = time.perf_counter()
            for first in range(0, n, SERIES):
                batch = folder / "batch"
                batch.mkdir()
                for number in range(first, min(first + SERIES, n)):
                    (batch / f"{number:08d}.dcm").write_bytes(renamed(slices[number % SERIES], number))
                command = ["storescu", "-aec", "CTREG", "127.0.0.1", str(port), *map(str, sorted(batch.iterdir()))]
                done = subprocess.run(command, capture_output=True, text=True, check=False)
                if done.returncode:
                    print(f"slices from {first} on were refused: {done.stderr.strip()}")
                    return False
                shutil.rmtree(batch)
                if first // SERIES % max(n // SERIES // 12, 1) == 0:
                    memory.append(resident_mb(process.pid))
                    sent = min(first + SERIES, n)
                    print(f"{sent:6d} sent, {len(client.slices):6d} received, listener {memory[-1]:.0f} MB", flush=True)
            whole = client.wait(n, 60)
            memory.append(resident_mb(process.pid))
            seconds = time.perf_counter() - start
    n_ok = sum(came is not None for _, came in client.slices)
    print(f"{n} slices in {seconds:.0f} s ({n / seconds:.0f}/s): {n - len(client.slices)} lost, {n_ok} with a pose")
    print(f"memory after a twelfth {memory[1]:.0f} MB, in the end {memory[-1]:.0f} MB")
    return whole


def resident_mb(pid: int) -> float:
    """Resident memory of a process (Linux)."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) / 1024
    raise ProcessLookupError(pid)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--slices", type=int, default=360)
    parser.add_argument("--rate", type=float, default=12.0, help="slices a second")
    parser.add_argument("--soak", type=int, metavar="N", help="N slices as fast as they go, instead")
    arguments = parser.parse_args()
    good = soak(arguments.soak) if arguments.soak else latency(arguments.slices, arguments.rate)
    raise SystemExit(0 if good else 1)


if __name__ == "__main__":
    main()
