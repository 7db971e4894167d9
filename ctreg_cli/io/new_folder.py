"""A folder of outputs that appears complete or not at all."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ctreg_cli.errors import InputError


@contextmanager
def new_folder(path: Path, *, overwrite: bool = False, own: re.Pattern[str]) -> Iterator[Path]:
    """Yield an unfinished folder to fill; it takes the name ``path`` when the block ends without an exception.

    Args:
        overwrite: replace a folder that holds nothing but files whose names ``own`` matches in full. Any other file
            stops it, so that a slip of the hand costs nobody a folder of something else.

    Raises:
        InputError: there is something at ``path`` already, or the place cannot be written.
    """
    target = path.resolve()
    _refuse_or_accept(path, target, overwrite, own)
    unfinished, replaced = (target.with_name(f".{target.name}.{os.getpid()}.{word}") for word in ("part", "old"))
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        # mkdir, not tempfile: the folder shall have the rights the user's umask gives
        unfinished.mkdir()
    except OSError as error:
        raise InputError(f"{path}: cannot be made ({error.strerror}); name another folder") from error
    try:
        yield unfinished
        _refuse_or_accept(path, target, overwrite, own)
        if target.exists():
            target.rename(replaced)
        unfinished.rename(target)
        shutil.rmtree(replaced, ignore_errors=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from error
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def _refuse_or_accept(path: Path, target: Path, overwrite: bool, own: re.Pattern[str]) -> None:
    if not target.exists():
        return
    if not target.is_dir():
        raise InputError(f"{path}: is a file; name a folder that does not exist yet")
    try:
        names = sorted(child.name for child in target.iterdir())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    if names and not overwrite:
        raise InputError(f"{path}: is not empty; name another folder, or replace it with --overwrite")
    foreign = [name for name in names if not own.fullmatch(name)]
    if foreign:
        raise InputError(
            f"{path}: holds {len(foreign)} entries that ctreg simulate did not write, such as {foreign[0]}; "
            "move them away or name another folder"
        )
