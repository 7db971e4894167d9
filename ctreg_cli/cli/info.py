"""``ctreg info``: which series there are, and which one the other commands would take."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ctreg_cli.cli.console import Talk
from ctreg_cli.cli.options import Quiet, SeriesNumber

if TYPE_CHECKING:
    from ctreg_cli.io.image_series import SeriesInfo

#: of the table where standard output is no terminal: nothing is cut off
_PIPED_WIDTH = 240

Images = Annotated[
    list[Path],
    typer.Argument(metavar="INPUT", help="DICOM or PNG files, folders of them.", show_default=False),
]


def info(inputs: Images, series: SeriesNumber = None, quiet: Quiet = False) -> None:
    """List the series in files and folders, with size, spacing, orientation and span.

    \b
    The series marked with * is the one other commands take; where none is, they ask for --series N.
    Examples:
      ctreg info study/
      ctreg info study/ --series 3
    """
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    from ctreg_cli.io.images import list_series

    found = list_series(inputs, series=series)
    shown = [entry for entry in found.series if series in (None, entry.index)]
    table = Table(box=SIMPLE_HEAD, show_edge=False, pad_edge=False)
    for heading in ("series", "modality", "kind", "slices", "columns x rows", "s_x x s_y mm", "thickness mm"):
        table.add_column(heading, no_wrap=True)
    for heading in ("orientation", "span mm", "duration s"):
        table.add_column(heading, no_wrap=True)
    for entry in shown:
        table.add_row(*_row(entry))
    terminal = sys.stdout.isatty()
    Console(highlight=False, markup=False, width=None if terminal else _PIPED_WIDTH).print(table)

    talk = Talk(quiet=quiet)
    for warning in found.warnings:
        talk.warn(warning)
    if found.skipped:
        talk.say("skipped: " + ", ".join(f"{count} × {reason}" for reason, count in found.skipped.items()))
    if shown and not any(entry.chosen for entry in shown):
        talk.say("no series fits alone: choose one with --series N")


def _row(entry: SeriesInfo) -> tuple[str, ...]:
    """One line of the table; ``-`` is unknown, or not the same in all slices."""
    unreadable = f" ({entry.n_unreadable} unreadable)" if entry.n_unreadable else ""
    return (
        f"{entry.index}{'*' if entry.chosen else ''}",
        entry.modality or "-",
        entry.kind,
        f"{entry.n_slices}{unreadable}",
        f"{entry.shape[1]} x {entry.shape[0]}" if entry.shape else "-",
        "{:.6g} x {:.6g}".format(*entry.spacing_mm) if entry.spacing_mm else "-",
        _number(entry.thickness_mm),
        entry.orientation or "-",
        _number(entry.span_mm),
        _number(entry.duration_s),
    )


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.6g}"
