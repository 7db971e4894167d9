"""``ctreg report``: results as a page to look at, and as figures for a paper."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from ctreg_cli.cli import options as opt

if TYPE_CHECKING:
    from ctreg_cli.cli.console import Talk
    from ctreg_cli.io.results_document import ResultsDocument

#: of all pictures in a page together; with the page itself it stays under 6 MB for 200 slices
PICTURES_BYTES, PICTURE_BYTES, MAX_PICTURES = 3_600_000, 40_000, 200


def report(
    results: Annotated[
        str,
        typer.Argument(metavar="RESULTS", help="What pose or track wrote: .json, .jsonl or .csv.", show_default=False),
    ],
    output: Annotated[
        str | None,
        typer.Option("--output", "-o", metavar="FILE", help="The page to write, .html.", show_default=False),
    ] = None,
    slices: Annotated[
        list[str] | None,
        typer.Option(
            "--slices", metavar="INPUT", help="The images the results were made from, to show.", show_default=False
        ),
    ] = None,
    series: opt.SeriesNumber = None,
    model: Annotated[
        str | None,
        typer.Option(
            "--model",
            "-m",
            metavar="FRAME",
            help="The frame, to show its rods; a shipped one is found by itself.",
            show_default=False,
        ),
    ] = None,
    plots: Annotated[
        str | None,
        typer.Option(
            "--plots", metavar="DIR", help="Also write figures as PNG and SVG (extra report).", show_default=False
        ),
    ] = None,
    quiet: opt.Quiet = False,
) -> None:
    """Show results on one page that needs nothing else: no network, no other file.

    The verdict on every slice, the pose over the sequence with its uncertainty, residuals by rod, a 3D scene, and the
    accuracy at the targets.

    \b
    Examples:
      ctreg report track.json -o report.html --slices slices/
      ctreg report track.json -m frame.yaml --plots figures/
    """
    from pathlib import Path

    from ctreg_cli.cli.console import Talk
    from ctreg_cli.errors import InputError
    from ctreg_cli.io.atomic import check_folder, write_bytes, write_text
    from ctreg_cli.io.frame_of_results import frame_of_results
    from ctreg_cli.io.results_document import read_document
    from ctreg_cli.report.html import report_html

    if output is None and plots is None:
        raise InputError("name what to write: -o report.html, --plots DIR, or both")
    if output is not None:
        if Path(output).suffix.lower() not in (".html", ".htm"):
            raise InputError(f"-o {output}: a report is a page; name it .html")
        check_folder(Path(output))
    talk = Talk(quiet=quiet)
    document = read_document(results)
    frame = frame_of_results(document, model)
    if plots is not None:
        from ctreg_cli.report.plots import plots as render_plots

        figures = list(render_plots(document))
        folder = Path(plots)
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"--plots {plots}: cannot be made ({error.strerror})") from error
        for name, content in figures:
            write_bytes(folder / name, content)
        talk.say(f"{plots}: {', '.join(name for name, _ in figures)}")
    if output is not None:
        if frame is None:
            talk.warn(f"{results}: the frame is not known, so the 3D scene has no rods; give it: -m FRAME")
        pictures = _pictures(document, slices, series, talk) if slices else {}
        page = report_html(document, model=frame, pictures=pictures)
        write_text(output, page)
        talk.say(f"{output}: {len(document.records)} slices, {len(page.encode()) / 1e6:.1f} MB")


def _pictures(document: ResultsDocument, inputs: list[str], series: int | None, talk: Talk) -> dict[int, str]:
    """Pictures of the slices by index.

    Raises:
        InputError: the images are other ones than the results were made from.
    """
    from ctreg_cli.cli.run import open_inputs
    from ctreg_cli.errors import InputError
    from ctreg_cli.imaging.slice import Slice
    from ctreg_cli.report.html import shown_records, shown_view
    from ctreg_cli.report.pictures import picture

    source = open_inputs(inputs, talk, series=series, spot_sd_px=None)
    if source.kind != "images":
        raise InputError(f"--slices {inputs[0]}: a spots file has no pixels; give the images")
    records, view = shown_records(document), shown_view(document)
    if view is None:
        return {}
    names = {record.index: record.source for record in records}
    wanted = [record.index for record in records][:: -(-len(records) // MAX_PICTURES)]
    if len(wanted) < len(records):
        talk.warn(f"{len(records)} slices: every {-(-len(records) // MAX_PICTURES)}th is shown with its picture")
    budget = min(PICTURE_BYTES, PICTURES_BYTES // max(len(wanted), 1))
    pictures = {}
    for index, item in enumerate(talk.progress(source, total=len(source), what="report")):
        if index not in names:
            continue
        if names[index] and names[index] != item.info.source:
            raise InputError(
                f"--slices {inputs[0]}: slice {index} is {item.info.source} there, but {names[index]} in the results; "
                "give the input the results were made from"
            )
        if index in wanted and isinstance(item, Slice):
            pictures[index] = picture(item, view, budget)
    return pictures
