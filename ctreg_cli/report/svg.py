"""Small charts as SVG text: sharp in print, readable without a script, coloured by the page's style sheet."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from ctreg_cli.arrays import FloatArray

#: of a chart, in its own units; the page scales it
WIDTH, HEIGHT = 360.0, 170.0
LEFT, RIGHT, TOP, BOTTOM = 46.0, 8.0, 20.0, 30.0
#: height of a rod's residuals, screen pixels, and the least range they are drawn over
ROW_PX, LEAST_REACH_PX = 26.0, 1e-3
_TICKS = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class Axis:
    """Values low to high drawn from ``start`` to ``stop``."""

    low: float
    high: float
    start: float
    stop: float

    def __call__(self, value: float) -> float:
        return self.start + (value - self.low) / (self.high - self.low) * (self.stop - self.start)

    @classmethod
    def around(
        cls, values: FloatArray, start: float, stop: float, *, least: float = 1e-6, border: float = 0.05
    ) -> Axis:
        """An axis on which all finite values lie, with some border."""
        known = values[np.isfinite(values)]
        low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
        half = max((high - low) / 2, least) * (1 + 2 * border)
        middle = (low + high) / 2
        return cls(low=middle - half, high=middle + half, start=start, stop=stop)

    def ticks(self) -> list[float]:
        """Round values along the axis."""
        step = _round_step((self.high - self.low) / _TICKS)
        first = math.ceil(self.low / step - 1e-9)
        return [k * step for k in range(first, math.floor(self.high / step + 1e-9) + 1)]

    def labels(self) -> Iterator[tuple[float, str]]:
        """Ticks with as many digits as tell them apart."""
        ticks = self.ticks()
        step = ticks[1] - ticks[0] if len(ticks) > 1 else 1.0
        digits = max(0, -math.floor(math.log10(step) + 1e-9))
        for tick in ticks:
            yield tick, f"{tick + 0.0:.{digits}f}".replace("-", "−")


def _round_step(step: float) -> float:
    power = 10.0 ** math.floor(math.log10(step))
    return power * next(factor for factor in (1, 2, 5, 10) if factor * power >= step * (1 - 1e-9))


def number(value: float) -> str:
    """A coordinate, short."""
    return f"{value:.1f}".removesuffix(".0")


def points(pairs: Sequence[tuple[float, float]]) -> str:
    """Coordinates of a polyline."""
    return " ".join(f"{number(x)},{number(y)}" for x, y in pairs)


def curve(
    title: str, unit: str, x: FloatArray, y: FloatArray, sd: FloatArray, usable: Sequence[bool], x_name: str
) -> str:
    """A value over the slices with a band of ± 2 sd; broken wherever a slice has no usable value.

    Args:
        title: what it is.
        unit: of ``y``.
        x: (n,) times or numbers of the slices.
        y: (n,) values, NaN where there is none.
        sd: (n,) standard deviations.
        usable: n flags; a value that is not is an open ring and takes no part in the line.
        x_name: what ``x`` is.
    """
    band = np.concatenate([y - 2 * sd, y + 2 * sd, y])
    across = Axis.around(x, LEFT, WIDTH - RIGHT, border=0.02)
    up = Axis.around(band, HEIGHT - BOTTOM, TOP)
    parts = [_frame(across, up, x_name, f"{title} ({unit})")]
    for first, last in _runs(usable):
        run = range(first, last)
        upper = [(across(x[k]), up(y[k] + 2 * sd[k])) for k in run]
        lower = [(across(x[k]), up(y[k] - 2 * sd[k])) for k in reversed(run)]
        if last - first > 1:
            parts.append(f'<polygon class="band" points="{points(upper + lower)}"/>')
            parts.append(f'<polyline class="line" points="{points([(across(x[k]), up(y[k])) for k in run])}"/>')
        else:
            parts.append(f'<polyline class="bar" points="{points(upper + lower)}"/>')
            parts.append(f'<circle class="dot" cx="{number(across(x[first]))}" cy="{number(up(y[first]))}" r="2"/>')
    parts += [
        f'<circle class="doubt" cx="{number(across(x[k]))}" cy="{number(up(y[k]))}" r="3"/>'
        for k in range(len(y))
        if not usable[k] and np.isfinite(y[k])
    ]
    ends = " ".join(f'data-{name}="{getattr(across, name):g}"' for name in ("low", "high", "start", "stop"))
    parts.append(f'<line class="now" {ends} y1="{TOP}" y2="{HEIGHT - BOTTOM}"/>')
    return _svg("chart", WIDTH, HEIGHT, f"{title} over the slices", parts)


def residuals_by_rod(rods: Sequence[str], residuals: Sequence[FloatArray]) -> str:
    """Residuals along u (above) and v (below) of every rod: a table, so that words keep their size on a phone.

    Args:
        rods: names.
        residuals: for each rod (k, 2), px.
    """
    everything = np.concatenate([np.zeros((1, 2)), *residuals]).ravel()
    reach = max(float(np.abs(everything).max()), LEAST_REACH_PX) * 1.05
    percent = Axis(low=-reach, high=reach, start=0.0, stop=100.0)
    grid = "".join(
        f'<line class="grid" x1="{number(percent(tick))}%" x2="{number(percent(tick))}%" y1="0" y2="{ROW_PX:g}"/>'
        for tick in percent.ticks()
    )
    rows = []
    for rod, values in zip(rods, residuals, strict=True):
        dots = "".join(
            f'<circle class="{kind}" cx="{percent(value):.2f}%" cy="{y:g}" r="2.4"/>'
            for kind, y, column in (("u", 0.3 * ROW_PX, 0), ("v", 0.7 * ROW_PX, 1))
            for value in values[:, column].tolist()
        )
        rms = f"{math.sqrt(float((values**2).mean())):.3f}" if values.size else ""
        rows.append(
            f'<tr><th scope="row">{escape(rod)}</th><td class="dots"><svg class="row" role="img" '
            f'aria-label="residuals of {escape(rod)}">{grid}{dots}</svg></td><td>{rms}</td></tr>'
        )
    ticks = "".join(
        f'<text class="tick" x="{number(percent(tick))}%" y="12" text-anchor="middle">{text}</text>'
        for tick, text in percent.labels()
    )
    rows.append(f'<tr><td></td><td class="dots"><svg class="row" aria-hidden="true">{ticks}</svg></td><td></td></tr>')
    head = '<tr><th>rod</th><th class="dots">residual (px)</th><th>rms (px)</th></tr>'
    return f'<table class="residuals"><thead>{head}</thead><tbody>{"".join(rows)}</tbody></table>'


def _runs(usable: Sequence[bool]) -> Iterator[tuple[int, int]]:
    """First and behind-last of every run of usable values."""
    start = None
    for k, good in enumerate([*usable, False]):
        if good and start is None:
            start = k
        elif not good and start is not None:
            yield start, k
            start = None


def _frame(across: Axis, up: Axis, x_name: str, title: str) -> str:
    parts = [f'<text class="title" x="{LEFT}" y="13">{escape(title)}</text>']
    for tick, text in up.labels():
        y = number(up(tick))
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y}" y2="{y}"/>')
        parts.append(f'<text class="tick" x="{LEFT - 4}" y="{y}" dy="3.5" text-anchor="end">{text}</text>')
    for tick, text in across.labels():
        x = number(across(tick))
        parts.append(f'<text class="tick" x="{x}" y="{HEIGHT - BOTTOM + 13}" text-anchor="middle">{text}</text>')
    parts.append(f'<text class="tick" x="{WIDTH - RIGHT}" y="{HEIGHT - 3}" text-anchor="end">{escape(x_name)}</text>')
    return "".join(parts)


def _svg(kind: str, width: float, height: float, name: str, parts: Sequence[str]) -> str:
    return (
        f'<svg class="{kind}" viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{escape(name)}">'
        f"{''.join(parts)}</svg>"
    )
