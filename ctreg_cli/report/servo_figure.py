"""The article's figures 4 and 5 from runs of the servo experiment: spot paths, angular errors, position errors.

Needs matplotlib (extra ``report``); nothing of it is imported before a figure is asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ctreg_cli.errors import InputError
from ctreg_cli.io.atomic import check_folder
from ctreg_cli.tracking.experiment import ServoRun

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SUFFIXES = (".png", ".svg")
REMEDY = "pip install 'ctreg-cli[report]'"
#: distinguishable also without colour vision, and in print (Okabe & Ito)
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")
_TITLES = {"updated": "Jacobian updated", "constant": "Jacobian constant"}
#: two figures of the same runs are the same bytes
_STEADY_SVG: Any = {"svg.hashsalt": "ctreg", "svg.fonttype": "path"}


def servo_figure(runs: Sequence[ServoRun]) -> Figure:
    """One column a run: spot paths (top), angular errors (middle), position errors (bottom).

    Raises:
        InputError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise InputError(f"a figure needs matplotlib: {REMEDY}") from error
    figure = Figure(figsize=(1.0 + 4.4 * len(runs), 10.0), layout="constrained")
    grid = figure.subplots(3, len(runs), squeeze=False, sharey="row")
    for (paths, angles, positions), run in zip(grid.T, runs, strict=True):
        _draw_paths(paths, run)
        _draw_errors(angles, np.degrees(run.error[:, 3:]), run.angle_sum_deg, ("x", "y", "z", "|x| + |y| + |z|"))
        _draw_errors(positions, run.error[:, :3], run.position_mm, ("x", "y", "z", "distance"))
        positions.set_xlabel("iteration")
        paths.set_title(_TITLES[run.strategy])
    for axes in grid[0]:
        axes.set_aspect("equal", adjustable="datalim")
    grid[0, 0].set_ylabel("v (px)")
    grid[0, 0].invert_yaxis()  # shared: v points down, as in the image
    grid[1, 0].set_ylabel("angular error (°)")
    grid[2, 0].set_ylabel("position error (mm)")
    return figure


def _draw_paths(axes: Axes, run: ServoRun) -> None:
    for k in range(len(run.rods)):
        axes.plot(*run.spots_px[:, k].T, color=COLOURS[0], linewidth=1.0, label="path" if k == 0 else None)
    axes.plot(*run.spots_px[0].T, "o", color=COLOURS[2], markersize=5, label="start")
    axes.plot(*run.desired_px.T, "x", color=COLOURS[1], markersize=6, label="desired")
    axes.set_xlabel("u (px)")
    axes.legend(loc="best", fontsize="small")


def _draw_errors(axes: Axes, errors: np.ndarray, total: np.ndarray, names: tuple[str, ...]) -> None:
    axes.axhline(0.0, color="0.7", linewidth=0.8)
    for values, colour, name in zip(errors.T, COLOURS, names, strict=False):
        axes.plot(values, color=colour, linewidth=1.2, label=name)
    axes.plot(total, color="black", linewidth=1.2, linestyle="--", label=names[-1])
    axes.legend(loc="best", fontsize="small")


def check_figure_path(path: str) -> None:
    """To be called before any work is done.

    Raises:
        InputError: another suffix than .png or .svg, or no such folder.
    """
    if Path(path).suffix.lower() not in SUFFIXES:
        raise InputError(f"--figure {path}: the suffix chooses the format, and must be one of {', '.join(SUFFIXES)}")
    check_folder(Path(path))


def write_figure(figure: Figure, path: str) -> None:
    """Write a figure as PNG or SVG, by suffix; the same figure gives the same bytes.

    Raises:
        InputError: as :func:`check_figure_path`, or a place that cannot be written.
    """
    import matplotlib as mpl

    check_figure_path(path)
    metadata = {"Date": None} if path.lower().endswith(".svg") else {"Software": None}
    try:
        with mpl.rc_context(_STEADY_SVG):
            figure.savefig(path, dpi=150, metadata=metadata)
    except OSError as error:
        raise InputError(f"--figure {path}: cannot be written ({error.strerror})") from error
