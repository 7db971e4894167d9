"""``ctreg``: the commands together, and the one place where errors become messages and exit codes."""

from __future__ import annotations

import io
import os
import sys
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from ctreg_cli._version import __version__
from ctreg_cli.cli import calibrate, console, export, info, listen, model, pose, report, segment, servo, simulate, track
from ctreg_cli.cli.interrupt import EXIT_INTERRUPTED, interruptible
from ctreg_cli.errors import CtregError, EstimationError

EXIT_NOTHING_FOUND, EXIT_BAD_INPUT = 1, 2


class CtregGroup(TyperGroup):
    """Runs a command; what it raises on purpose becomes one message and an exit code, never a traceback."""

    def invoke(self, ctx: typer.Context) -> Any:  # type: ignore[override]
        if isinstance(sys.stdout, io.TextIOWrapper):
            # data is UTF-8 wherever it goes, also where the console is not
            sys.stdout.reconfigure(encoding="utf-8")
        try:
            with interruptible():
                return super().invoke(ctx)
        except EstimationError as error:
            console.error(str(error))
            raise typer.Exit(EXIT_NOTHING_FOUND) from error
        except CtregError as error:
            console.error(str(error))
            raise typer.Exit(EXIT_BAD_INPUT) from error
        except KeyboardInterrupt as error:
            raise typer.Exit(EXIT_INTERRUPTED) from error
        except BrokenPipeError:
            return None
        except OSError as error:
            place = f"{error.filename}: " if error.filename else ""
            console.error(f"{place}{error.strerror or error}")
            raise typer.Exit(EXIT_BAD_INPUT) from error
        finally:
            _let_go_of_closed_output()


def _let_go_of_closed_output() -> None:
    """Standard output takes no more (its reader has gone, the disk is full): keep Python from trying again at exit."""
    if not isinstance(sys.stdout, io.TextIOWrapper):
        return
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


app = typer.Typer(
    cls=CtregGroup,
    name="ctreg",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"ctreg {__version__}")
        raise typer.Exit


@app.callback()
def ctreg(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Pose of a rod frame from single CT slices: labels, pixel scale, 3D pose with its uncertainty, and tracking.

    \b
    A first run:
      ctreg simulate -m rod-cube-30x30x40 -o slices
      ctreg pose slices -m rod-cube-30x30x40 -o poses.csv
    """


app.command(short_help="Spots of every slice.")(segment.segment)
app.command(short_help="Pixel scale from slices of a known frame.")(calibrate.calibrate)
app.command(short_help="Pose of the frame in every slice, each on its own.")(pose.pose)
app.command(short_help="Pose of the frame through slices as one sequence in time.")(track.track)
app.command(short_help="DICOM series of a frame with known poses.")(simulate.simulate)
app.command(short_help="The control law alone: from one pose to the spots of another.")(servo.servo)
app.add_typer(model.app, name="model", short_help="Frames: list, show, check, refine.")
app.command(short_help="Series in files and folders.")(info.info)
app.command(short_help="Slices straight from a scanner or PACS.")(listen.listen)
app.command(short_help="Results as files of other programs.")(export.export)
app.command(short_help="Results as a page to look at, and as figures.")(report.report)


def main() -> None:
    """Entry point of the ``ctreg`` command."""
    for name in ("stdout", "stderr"):
        # closed by the caller (``>&-``, a service): Python gives None, and what is said to nobody is no error
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), "w", encoding="utf-8"))
    try:
        app()
    except OSError as error:  # help and version are said before any command is run
        console.error(f"standard output: {error.strerror or error}")
        _let_go_of_closed_output()
        sys.exit(EXIT_BAD_INPUT)
