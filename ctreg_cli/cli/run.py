"""What the commands do alike: open slices, agree on the scale, let results pass, close with an exit code."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import TypeVar

import typer

from ctreg_cli.cli.console import Talk, counted
from ctreg_cli.errors import MissingScaleError
from ctreg_cli.imaging.slice import Slice, SliceInfo
from ctreg_cli.imaging.spots import DEFAULT_SPOT_SD_PX
from ctreg_cli.io.interrupts import uninterrupted
from ctreg_cli.io.sinks import Sinks
from ctreg_cli.io.sources import Source, open_sources
from ctreg_cli.pipeline import SliceLike, missing_scale
from ctreg_cli.rods import RodModel
from ctreg_cli.scale import Scale

Result = TypeVar("Result")

#: finished, but without what was asked for
EXIT_NOTHING_FOUND = 1
#: broken slices named one by one; the rest are counted
MAX_NAMED = 10
#: PixelSpacing is the same in every slice of a field of view; a scale typed in may correct it by a few percent
NOMINAL_TOLERANCE, TYPED_TOLERANCE = 1e-3, 0.05


def open_inputs(inputs: list[str], talk: Talk, *, series: int | None, spot_sd_px: float | None) -> Source:
    """The slices, with what was noticed on the way told.

    Raises:
        InputError: see :func:`ctreg_cli.io.sources.open_sources`.
    """
    source = open_sources(inputs, series=series, spot_sd_px=spot_sd_px or DEFAULT_SPOT_SD_PX)
    for warning in source.warnings:
        talk.warn(warning)
    if source.skipped:
        talk.say(f"skipped: {counted(source.skipped)}")
    return source


@dataclass(frozen=True, slots=True, kw_only=True)
class ScaleChoice:
    """The scale for every slice (None: each slice's own), and where it is from."""

    scale: Scale | None
    origin: str
    #: the scale slices should state of themselves for this one to fit them, and by how much (relative) they may differ
    stated: Scale | None = None
    tolerance: float = 0.0

    def doubt(self, info: SliceInfo) -> str:
        """Why the scale does not look like this slice's; empty when it does, or nothing is known."""
        own, stated = info.scale, self.stated
        if own is None or stated is None:
            return ""
        away = max(abs(own.s_x / stated.s_x - 1), abs(own.s_y / stated.s_y - 1))
        if away <= self.tolerance:
            return ""
        return (
            f"{info.source} states {own.s_x:.6g} × {own.s_y:.6g} mm/px, but the {self.origin} used instead belongs to "
            f"{stated.s_x:.6g} × {stated.s_y:.6g}: another field of view?"
        )


def choose_scale(
    pair: tuple[float, float] | None, calibration: str | None, source: Source, model: RodModel, talk: Talk
) -> ScaleChoice:
    """``--scale`` before ``-c`` before what the slices say.

    Raises:
        InputError: a scale that is none.
        CalibrationFileError: the calibration file is wrong.
        MissingScaleError: no slice has a scale, and none was given.
    """
    if pair is not None:
        if calibration is not None:
            talk.warn(f"--scale overrides -c {calibration}")
        given = Scale(s_x=pair[0], s_y=pair[1])
        return ScaleChoice(scale=given, origin="option", stated=given, tolerance=TYPED_TOLERANCE)
    if calibration is not None:
        from ctreg_cli.io.calibration_file import load_calibration

        found = load_calibration(calibration)
        if found.model_sha256 and found.model_sha256 != model.sha256:
            talk.warn(f"{calibration} was made with another frame file ({found.model_name}) than {model.name} here")
        return ScaleChoice(scale=found.scale, origin="calibration", stated=found.nominal, tolerance=NOMINAL_TOLERANCE)
    if source.without_scale:  # known from headers: nobody waits for the pixels of a thousand slices to hear it
        raise MissingScaleError(missing_scale(source.without_scale))
    return ScaleChoice(scale=None, origin="dicom" if source.kind == "images" else "spots")


def warned(source: Source, talk: Talk) -> Iterator[SliceLike]:
    """The slices, with broken ones named as they pass, but for those that :func:`open_inputs` has named."""
    n_broken = 0
    named = "\n".join(source.warnings)
    for item in source:
        if not isinstance(item, Slice) and item.problem:
            n_broken += 1
            broken = f"{item.info.source}: {item.problem}"
            if n_broken <= MAX_NAMED and broken not in named:
                talk.warn(broken)
        yield item
    if n_broken > MAX_NAMED:
        talk.warn(f"... and {n_broken - MAX_NAMED} more slices that could not be read")


@dataclass(slots=True)
class Watched:
    """Slices on their way into the pipeline, of which those not yet answered can still be looked at."""

    source: Source
    talk: Talk
    waiting: deque[SliceLike] = field(default_factory=deque)

    def __iter__(self) -> Iterator[SliceLike]:
        for item in warned(self.source, self.talk):
            self.waiting.append(item)
            yield item

    def answered(self) -> Slice | None:
        """The slice whose result has just come, if it has pixels."""
        item = self.waiting.popleft()
        return item if isinstance(item, Slice) else None


def consume(
    results: Iterable[Result],
    sinks: Sinks[Result],
    on_result: Callable[[Result], None],
    talk: Talk,
    *,
    total: int | None,
    what: str,
) -> None:
    """Pass every result on; stop early only when nobody reads any more (``| head``).

    An interrupt (Ctrl-C) goes through after what was finished has been written.
    """
    done = 0
    try:
        with sinks:
            for result in talk.progress(results, total=total, what=what):
                with uninterrupted():
                    sinks.write(result)
                    on_result(result)
                    done += 1
                if not sinks.alive:
                    return
    except KeyboardInterrupt:
        of_total = f" of {total}" if total else ""
        talk.say(f"interrupted: {done}{of_total} slices are written")
        raise


def close(*, n_good: int, n_failed: int, strict: bool) -> None:
    """End with the exit code of the contract.

    Raises:
        typer.Exit: code 1 when no slice was good, or with ``strict`` when any failed.
    """
    if not n_good or (strict and n_failed):
        raise typer.Exit(EXIT_NOTHING_FOUND)
