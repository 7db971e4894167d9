"""Outputs appear complete or not at all: written beside their name, renamed when done."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import TextIO

from ctreg_cli.errors import InputError


class AtomicFile:
    """A UTF-8 text file that takes its name only with :meth:`commit`; until then the old one, if any, stays.

    The folder and the right to write there are checked at once, before any work is done. A link keeps pointing where
    it did; a device or a named pipe cannot be replaced by a rename and is written directly.

    Raises:
        InputError: no such folder, no right to write there, or the name is a folder.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        check_folder(self.path)
        target = self.path.resolve()
        self._target = target
        self._direct = target.exists() and not target.is_file()
        #: what was written can be taken back, as nothing can be of a device or a pipe
        self.can_rewind = not self._direct
        self._partial = target if self._direct else target.with_name(f".{target.name}.{os.getpid()}.part")
        try:
            # open(), not tempfile: the file shall have the rights the user's umask gives
            self.stream: TextIO = self._partial.open("w", encoding="utf-8", newline="")
        except OSError as error:
            raise InputError(f"{path}: cannot be written ({error.strerror})") from error

    def commit(self) -> None:
        """The file is complete: give it its name.

        Raises:
            InputError: the disk is full, or the folder has gone.
        """
        try:
            self.stream.close()
            if not self._direct:
                self._partial.replace(self._target)
        except OSError as error:
            self.abandon()
            raise InputError(f"{self.path}: cannot be written ({error.strerror})") from error

    def abandon(self) -> None:
        """Leave no trace. Does nothing after :meth:`commit`."""
        with contextlib.suppress(OSError):  # what the disk had no room for is not wanted any more
            self.stream.close()
        if not self._direct:
            self._partial.unlink(missing_ok=True)


def check_folder(path: Path) -> None:
    """A file of this name could be made, as far as folders are concerned.

    Raises:
        InputError: no such folder, or the name is a folder.
    """
    if path.is_dir():
        raise InputError(f"{path}: is a folder; name a file")
    if not path.resolve().parent.is_dir():
        raise InputError(f"{path}: folder {path.parent} does not exist; make it first")


def write_text(path: str | Path, text: str) -> None:
    """Write a small text file atomically.

    Raises:
        InputError: the file cannot be written there.
    """
    write_bytes(path, text.encode())


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write a binary file atomically.

    Raises:
        InputError: the file cannot be written there.
    """
    file = AtomicFile(path)
    try:
        # what is below the text stream takes bytes; nothing has been written as text
        file.stream.buffer.write(data)
    except OSError as error:  # the disk is full
        file.abandon()
        raise InputError(f"{path}: cannot be written ({error.strerror})") from error
    except BaseException:
        file.abandon()
        raise
    file.commit()
