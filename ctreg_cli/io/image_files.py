"""Finding files: each with the name it has in results, in natural order; nothing is opened here."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from ctreg_cli.errors import InputError

CLOSED_FOLDER = "folder that cannot be opened"

NaturalKey = tuple[tuple[int, int, str], ...]


def natural_key(name: str) -> NaturalKey:
    """A key that sorts ``s2.png`` before ``s10.png``."""
    parts = re.split(r"(\d+)", name)
    return tuple((0, int(part), "") if part.isdecimal() else (1, 0, part.casefold()) for part in parts if part)


def files_in(path: Path, skipped: Counter[str]) -> Iterator[tuple[Path, str]]:
    """The file, or the files of the folder in natural order, each with its source name.

    Args:
        path: what the user named.
        skipped: reason → how many; folders that cannot be opened are added.

    Raises:
        InputError: there is nothing of that name, or the folder itself cannot be opened.
    """

    def cannot_open(error: OSError) -> None:
        if error.filename == str(path):
            raise InputError(f"{shown(path)}: the folder cannot be opened ({error.strerror})")
        skipped[CLOSED_FOLDER] += 1

    if not path.exists():
        raise InputError(f"{shown(path)}: no such file or folder")
    if not path.is_dir():
        yield path, printable(path.name)
        return
    by_name = []
    for folder, _, names in os.walk(path, onerror=cannot_open):
        place = Path(folder)
        within = "" if place == path else f"{place.relative_to(path).as_posix()}/"
        for name in names:
            relative = printable(within + name)
            by_name.append((natural_key(relative), relative, place / name))
    for _, relative, file in sorted(by_name):
        yield file, relative


def printable(name: str) -> str:
    """A file name that can be written as UTF-8 on one line, whatever bytes it is made of."""
    text = os.fsencode(name).decode("utf-8", "replace")
    return "".join(character if character.isprintable() else "�" for character in text)


def shown(path: Path) -> str:
    """A path in a message."""
    return printable(str(path))


def named(paths: Sequence[Path]) -> str:
    """The user's paths in a message, the first few of them."""
    more = f" and {len(paths) - 3} more" if len(paths) > 3 else ""
    return ", ".join(shown(path) for path in paths[:3]) + more
