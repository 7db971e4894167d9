"""Figures for papers (extra ``report``): pose curves and residuals as PNG and SVG bytes; nothing is shown."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import Any

import numpy as np

from ctreg_cli.errors import InputError
from ctreg_cli.io.optional import optional
from ctreg_cli.io.results_document import ResultsDocument
from ctreg_cli.report.series import COMPONENTS, pose_series, residuals

#: width of a page's text in most journals, inches
WIDTH_IN, CURVES_HEIGHT_IN, RESIDUALS_HEIGHT_IN = 7.0, 4.2, 3.2
#: Okabe and Ito's blue, orange and reddish purple: told apart by nearly everyone
BLUE, ORANGE, PURPLE = "#0072B2", "#E69F00", "#CC79A7"
PNG_DPI = 300
#: text stays text, and the same results give the same bytes
_STYLE = {"font.size": 8, "svg.fonttype": "none", "svg.hashsalt": "ctreg", "axes.spines.top": False}
_STYLE |= {"axes.spines.right": False}


def plots(document: ResultsDocument, *, png_dpi: int = PNG_DPI) -> Iterator[tuple[str, bytes]]:
    """File names and contents of all figures: ``pose`` and, where the results hold matches, ``residuals``.

    Raises:
        InputError: matplotlib is not installed, or no slice has a pose.
    """
    matplotlib = optional("matplotlib", extra="report", what="--plots")
    backend = optional("matplotlib.figure", extra="report", what="--plots")
    series = pose_series(document.records)
    if not np.isfinite(series.values).any():
        raise InputError(f"{document.name}: no slice has a pose to plot")
    with matplotlib.rc_context(_STYLE):
        yield from _rendered("pose", _pose_figure(backend.Figure, document), png_dpi)
        by_rod = residuals(document.records)
        if by_rod:
            yield from _rendered("residuals", _residual_figure(backend.Figure, document), png_dpi)


def _pose_figure(figure_class: Any, document: ResultsDocument) -> Any:
    series = pose_series(document.records)
    figure = figure_class(figsize=(WIDTH_IN, CURVES_HEIGHT_IN), layout="constrained")
    axes = figure.subplots(2, 3, sharex=True)
    ok = series.usable
    for k, (name, unit) in enumerate(COMPONENTS):
        axis = axes.flat[k]
        y = np.where(ok, series.values[:, k], np.nan)
        axis.fill_between(series.x, y - 2 * series.sd[:, k], y + 2 * series.sd[:, k], color=BLUE, alpha=0.25, lw=0)
        axis.plot(series.x, y, color=BLUE, lw=1, marker=".", ms=2)
        doubtful = ~ok & np.isfinite(series.values[:, k])
        axis.plot(series.x[doubtful], series.values[doubtful, k], ls="", marker="o", mfc="none", color=ORANGE, ms=4)
        axis.set_ylabel(f"{name} ({unit})")
        axis.grid(alpha=0.3, lw=0.5)
    for axis in axes[1]:
        axis.set_xlabel(series.x_name)
    return figure


def _residual_figure(figure_class: Any, document: ResultsDocument) -> Any:
    by_rod = residuals(document.records)
    figure = figure_class(figsize=(WIDTH_IN, RESIDUALS_HEIGHT_IN), layout="constrained")
    axis = figure.subplots()
    for column, (shift, colour, name) in enumerate(((-0.15, BLUE, "columns (u)"), (0.15, PURPLE, "rows (v)"))):
        for k, values in enumerate(by_rod.values()):
            x = np.full(len(values), k + shift)
            axis.plot(x, values[:, column], ls="", marker=".", ms=3, alpha=0.6, color=colour, label=None if k else name)
    axis.axhline(0, color="0.5", lw=0.5)
    axis.set_xticks(range(len(by_rod)), list(by_rod))
    axis.set_ylabel("residual (px)")
    axis.legend(frameon=False, loc="upper right")
    return figure


def _rendered(name: str, figure: Any, png_dpi: int) -> Iterator[tuple[str, bytes]]:
    for suffix, options in (("png", {"dpi": png_dpi}), ("svg", {"metadata": {"Date": None}})):
        stream = io.BytesIO()
        figure.savefig(stream, format=suffix, **options)
        yield f"{name}.{suffix}", stream.getvalue()
