"""Packages that not everyone needs: imported when asked for, and missed with one line that says how to get them."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from ctreg_cli.errors import InputError


def optional(module: str, *, extra: str, what: str) -> Any:
    """The module, imported now.

    Args:
        module: its name, dotted.
        extra: the extra of ctreg-cli that brings it.
        what: what it is needed for, as the beginning of a sentence.

    Raises:
        InputError: it is not installed.
    """
    package = module.partition(".")[0]
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != package:
            raise
        raise InputError(f"{what} needs {package}, which is not installed: pip install 'ctreg-cli[{extra}]'") from error
