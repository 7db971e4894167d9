"""What is said to the person at the terminal: always on standard error, so that standard output holds data alone."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, TypeVar

import typer

if TYPE_CHECKING:
    from rich.console import Console

Item = TypeVar("Item")


def error(text: str) -> None:
    """The one way an error is shown."""
    typer.echo(f"ctreg: error: {text}", err=True)


def counted(counts: Mapping[str, int]) -> str:
    """``3 too_few_spots, 1 unreadable``: the most frequent first."""
    ranked = sorted(counts.items(), key=lambda pair: (-pair[1], pair[0]))
    return ", ".join(f"{count} {word}" for word, count in ranked)


class Talk:
    """Summary, progress and warnings, as loud as the user wants."""

    def __init__(self, *, quiet: bool = False, verbose: bool = False, outputs: Sequence[str] = ()) -> None:
        self.quiet = quiet
        self.verbose = verbose and not quiet
        #: rows on the same screen as a bar would tear it to pieces
        self._rows_on_screen = "-" in outputs and sys.stdout.isatty()
        self._console: Console | None = None

    @property
    def console(self) -> Console:
        """The console on standard error; made when first needed, since rich takes its time to load."""
        if self._console is None:
            from rich.console import Console

            self._console = Console(stderr=True, highlight=False, markup=False, soft_wrap=True, quiet=self.quiet)
        return self._console

    def say(self, text: str) -> None:
        """A line for everyone but ``-q``."""
        if not self.quiet:
            self.console.print(text)

    def warn(self, text: str) -> None:
        """Something to look at, though the work goes on."""
        self.say(f"ctreg: warning: {text}")

    def explain(self, text: str) -> None:
        """A line for ``-v``."""
        if self.verbose:
            self.console.print(text)

    def progress(self, items: Iterable[Item], *, total: int | None, what: str) -> Iterator[Item]:
        """The items, with a bar while they pass; only where standard error is a terminal."""
        if self.quiet or self._rows_on_screen or not self.console.is_terminal:
            yield from items
            return
        from rich.progress import Progress

        with Progress(console=self.console, transient=True, redirect_stdout=False, redirect_stderr=False) as bar:
            yield from bar.track(items, total=total, description=what)

    def table(self, rows: Sequence[tuple[str, str]]) -> None:
        """Names and values, one pair a line."""
        width = max((len(name) for name, _ in rows), default=0)
        for name, value in rows:
            self.say(f"{name:<{width}}  {value}")
