"""Local DICOM programs and free ports for tests of the listener."""

from __future__ import annotations

import shutil
import socket
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from ctreg_cli.imaging.slice import Slice, UnreadableSlice
from ctreg_cli.interop.dicom_listener import DicomListener, ListenOptions

SAMPLES = Path(__file__).parents[2] / "sample_data" / "track"
SLICES = sorted(SAMPLES.glob("*.dcm"))
LIMIT_S = 30

needs_storescu = pytest.mark.skipif(shutil.which("storescu") is None, reason="Debian package dcmtk is not installed")


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def storescu(
    port: int, *files: Path, called: str = "CTREG", calling: str = "SCANNER", options: tuple[str, ...] = ()
) -> Any:
    """Run DCMTK's sender; what it says is in ``stderr`` and ``stdout``."""
    command = ["storescu", "-v", *options, "-aet", calling, "-aec", called, "127.0.0.1", str(port), *map(str, files)]
    return subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S)


class Received:
    """Takes slices from a listener in a thread of its own."""

    def __init__(self, listener: DicomListener) -> None:
        self.slices: list[Slice | UnreadableSlice] = []
        self._thread = threading.Thread(target=self._work, args=(listener,), daemon=True)
        self._thread.start()

    def _work(self, listener: DicomListener) -> None:
        self.slices.extend(listener.slices)

    def finish(self) -> list[Slice | UnreadableSlice]:
        self._thread.join(LIMIT_S)
        assert not self._thread.is_alive()
        return self.slices


@contextmanager
def listening(**options: Any) -> Iterator[tuple[DicomListener, Received]]:
    chosen: dict[str, Any] = {"port": 0, "policy": "all", "queue_size": 64}
    with DicomListener(ListenOptions(**(chosen | options))) as listener:
        received = Received(listener)
        yield listener, received
        listener.slices.close()
        received.finish()
