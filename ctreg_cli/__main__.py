"""``ctreg`` and ``python -m ctreg_cli``."""

from ctreg_cli.cli.interrupt import leave_at_once


def main() -> None:
    """Entry point: ready for Ctrl-C first, since all the rest takes a moment to load."""
    leave_at_once()
    from ctreg_cli.cli.app import main as run

    run()


def _leave_working_directory() -> None:
    """Take the working directory off the path, where ``python -m`` puts it first.

    A folder of the user's called ``dl`` there would be imported by a codec in place of the real module; only a source
    checkout needs that entry.
    """
    import sys
    from pathlib import Path

    if not Path("ctreg_cli").is_dir():
        sys.path[:] = [entry for entry in sys.path if entry and Path(entry) != Path.cwd()]


if __name__ == "__main__":
    leave_at_once()
    _leave_working_directory()
    main()
