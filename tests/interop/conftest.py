"""What several of these tests use."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

LIBRARY = Path("/usr/lib/libOpenIGTLink.so")
CLIENT_SOURCE = Path(__file__).with_name("igtl_client.cpp")


@pytest.fixture(scope="session")
def cpp_client(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if not LIBRARY.exists() or shutil.which("g++") is None:
        pytest.skip("Debian packages libopenigtlink-dev and g++ are not installed")
    program = tmp_path_factory.mktemp("igtl") / "client"
    command = ["g++", "-O0", "-w", str(CLIENT_SOURCE), "-I/usr/include/openigtlink", "-I/usr/include/igtl"]
    subprocess.run([*command, str(LIBRARY), "-lpthread", "-o", str(program)], check=True, timeout=120)
    return program
