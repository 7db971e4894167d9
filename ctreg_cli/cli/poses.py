"""The body that ``pose`` and ``track`` share: slices to results, files, pictures and a closing table."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass

from ctreg_cli.cli.console import Talk
from ctreg_cli.cli.options import Polarity
from ctreg_cli.cli.overlays import OverlayWriter
from ctreg_cli.cli.run import Watched, choose_scale, close, consume, open_inputs
from ctreg_cli.cli.summary import PoseTally
from ctreg_cli.cli.watch_session import Session
from ctreg_cli.errors import InputError
from ctreg_cli.imaging.segmentation import SegmentationOptions
from ctreg_cli.interop.exports import ExportSink, split_outputs
from ctreg_cli.io.results import ResultsHeader, accepted, results_encoding, write_results
from ctreg_cli.io.rod_file import load_rod_model
from ctreg_cli.io.sinks import STANDARD_OUTPUT, Sinks, check_outputs, open_sinks
from ctreg_cli.pipeline import FrameResult, smoothed
from ctreg_cli.rods import RodModel
from ctreg_cli.scale import Scale

#: the part in which the two commands differ: slices, frame, scale and segmentation in, results out
Estimate = Callable[[Watched, RodModel, Scale | None, SegmentationOptions], Iterator[FrameResult]]


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseArguments:
    """What both commands are told on the command line."""

    inputs: list[str]
    model: str
    calibration: str | None
    scale: tuple[float, float] | None
    output: list[str] | None
    polarity: Polarity
    series: int | None
    spot_sd: float | None
    overlay: str | None
    with_uids: bool
    strict: bool
    quiet: bool
    verbose: bool


def run_poses(
    command: str,
    estimate: Estimate,
    options: Mapping[str, object],
    arguments: PoseArguments,
    *,
    smooth: str | None = None,
    session: Session | None = None,
) -> None:
    """Write a result for every slice, then tell how it went.

    Args:
        command: its name, for the record and the progress bar.
        estimate: the method.
        options: its options as resolved, for the record.
        arguments: the rest of the command line.
        smooth: where the trajectory smoothed in hindsight goes, if anywhere; all results are then kept until the end.
        session: where slices come from and results go beside files, if anywhere.

    Raises:
        CtregError: the model, the input, the scale or an output cannot be used; live, a failed output is the last
            word, after the slices have been worked on all the same.
        typer.Exit: code 1 when not one slice gave a pose, or with ``strict`` when any slice is not ``ok``.
    """
    session = session or Session()
    tables, exports = split_outputs(arguments.output)
    outputs = [] if exports and not tables else check_outputs(tables, arguments.inputs)
    if smooth == STANDARD_OUTPUT:
        raise InputError("--smooth -: name a file; standard output is for -o")
    if smooth is not None:
        check_outputs([*outputs, smooth], arguments.inputs)
    talk = Talk(quiet=arguments.quiet, verbose=arguments.verbose, outputs=outputs)
    model = load_rod_model(arguments.model)
    source = session.source
    if source is None:
        source = open_inputs(arguments.inputs, talk, series=arguments.series, spot_sd_px=arguments.spot_sd)
    scale = choose_scale(arguments.scale, arguments.calibration, source, model, talk)
    segmentation = SegmentationOptions(polarity=arguments.polarity.value)
    overlays = None
    if arguments.overlay:
        overlays = OverlayWriter(arguments.overlay, source, arguments.inputs, model=model, scale=scale.scale)
    header = ResultsHeader(
        model=model,
        scale=scale.scale,
        scale_from=scale.origin,
        options={"command": command, **options, "segmentation": asdict(segmentation)},
    )
    more = [ExportSink(output, header, one_slice=len(source) == 1, tell=talk.warn) for output in exports]
    encoding = results_encoding(header, with_uids=arguments.with_uids)
    sinks = open_sinks(outputs, encoding, sys.stdout) if outputs else Sinks[FrameResult]()
    for output, export in zip(exports, more, strict=True):
        sinks.add(output, export)
    for live in session.sinks:
        sinks.add("OpenIGTLink", live, first=True)
    if session.is_live:
        sinks.outlive_failures(talk.warn)
    kept: list[FrameResult] = []
    watched, tally = Watched(source, talk), PoseTally(scale=scale.scale, scale_from=scale.origin)

    def on_result(result: FrameResult) -> None:
        nonlocal overlays
        doubt = scale.doubt(result.info)
        if doubt and not tally.n_doubtful:
            talk.warn(doubt)
        tally.n_doubtful += bool(doubt)
        tally.add(result)
        if smooth is not None:
            kept.append(result)
        slice_ = watched.answered()
        if overlays and slice_:
            try:
                overlays.draw_result(slice_, result)
            except InputError as error:
                sinks.lose(str(error), error)
                overlays = None
        if talk.verbose:
            _explain(result, talk)

    results = estimate(watched, model, scale.scale, segmentation)
    try:
        consume(results, sinks, on_result, talk, total=len(source) or None, what=command)
    except KeyboardInterrupt:
        talk.table([*tally.rows(), *session.rows()])
        raise
    if smooth is not None:
        write_results(smoothed(kept, model, scale=scale.scale), smooth, header, with_uids=arguments.with_uids)
    talk.table([*tally.rows(), *session.rows()])
    if sinks.lost:
        raise InputError(f"{sinks.lost[0]}; slices from there on are not in it")
    close(n_good=tally.n_poses, n_failed=tally.total - tally.n_ok, strict=arguments.strict)


def _explain(result: FrameResult, talk: Talk) -> None:
    """One slice in a line, and its warnings in one each."""
    words = f"slice {result.index} ({result.info.source}): {result.status} {result.reason}".rstrip()
    for best in accepted(result)[:1]:
        words += f", {len(best.rod_index)} of {len(result.spots)} spots matched"
        if len(best.rod_index):
            words += f", {best.rms_px:.3g} px rms"
    talk.explain(words)
    for code, text in result.warnings:
        talk.explain(f"  {code}: {text}")
