"""``ctreg model refine``: a frame's rods where a scan of many slices shows them to be."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ctreg_cli.cli import options as opt

if TYPE_CHECKING:
    from ctreg_cli.cli.console import Talk
    from ctreg_cli.registration.bundle import RodRefinement
    from ctreg_cli.rods import RodModel

SUFFIXES = (".yaml", ".yml")
STANDARD_OUTPUT = "-"
#: decimals of a refined coordinate: a tenth of a micrometre
DECIMALS = 4
#: of the closing table where standard error is no terminal
TABLE_WIDTH = 110

Tolerance = Annotated[
    float | None,
    typer.Option(
        "--tolerance",
        metavar="MM",
        min=1e-3,
        max=100,
        show_default=False,
        help="How far rods may lie off their written places (sd).  [default: as the frame file says]",
    ),
]
Scales = Annotated[bool, typer.Option("--scales", help="Also estimate the pixel scale, and say it.")]
AsJson = Annotated[bool, typer.Option("--json", help="The rods' shifts as JSON on standard output.")]
FrameOutput = Annotated[
    str, typer.Option("--output", "-o", metavar="FILE", help="Frame file to write (.yaml), - for standard output.")
]


def refine(
    inputs: opt.Inputs,
    model: opt.ModelName,
    output: FrameOutput = STANDARD_OUTPUT,
    calibration: opt.CalibrationFile = None,
    scale: opt.ScalePair = None,
    scales: Scales = False,
    tolerance: Tolerance = None,
    as_json: AsJson = False,
    use_mount: opt.UseMount = opt.REGISTRATION.use_mount,
    polarity: opt.PolarityChoice = opt.Polarity.bright,
    series: opt.SeriesNumber = None,
    spot_sd: opt.SpotSd = None,
    quiet: opt.Quiet = False,
    verbose: opt.Verbose = False,
) -> None:
    """Find where a frame's rods truly are, from a scan of many slices, and write them as a new frame file.

    Rods of a real frame lie some tenths of a millimetre off their drawing. The frame must be at rest during the scan
    where the slices' places are known from DICOM; without them each slice gets a pose of its own. Exit code 1 when the
    slices do not determine the rods.

    \b
    Example:
      ctreg model refine scan/ -m leksell-g-3-panel -o my-leksell.yaml
    """
    from dataclasses import replace

    from ctreg_cli.cli.console import Talk
    from ctreg_cli.cli.model_tables import as_json as to_json
    from ctreg_cli.cli.run import choose_scale, open_inputs, warned
    from ctreg_cli.imaging.segmentation import SegmentationOptions
    from ctreg_cli.io.rod_file import load_rod_model, rod_model_to_yaml, save_rod_model
    from ctreg_cli.pipeline import expecting, segment
    from ctreg_cli.registration.bundle import refine_rods
    from ctreg_cli.registration.options import RegistrationOptions

    _check_output(output, model)
    talk = Talk(quiet=quiet, verbose=verbose)
    frame = load_rod_model(model)
    source = open_inputs(inputs, talk, series=series, spot_sd_px=spot_sd)
    choice = choose_scale(scale, calibration, source, frame, talk)
    found = segment(warned(source, talk), expecting(frame, SegmentationOptions(polarity=polarity.value)))
    slices = list(talk.progress(found, total=len(source) or None, what="segment"))
    refinement = refine_rods(
        slices,
        frame,
        scale=choice.scale,
        tolerance_mm=tolerance,
        free_scales=scales,
        options=RegistrationOptions(use_mount=use_mount),
    )
    refined = replace(
        refinement.model,
        name=f"{frame.name}-refined",
        description=_description(frame, refinement),
        rods=tuple(
            replace(
                rod,
                start=rod.start.round(DECIMALS) + 0.0,  # no minus zero
                end=rod.end.round(DECIMALS) + 0.0,
                tolerance_mm=round(rod.tolerance_mm, DECIMALS),
            )
            for rod in refinement.model.rods
        ),
    )
    if output != STANDARD_OUTPUT:
        save_rod_model(refined, output)
    elif not as_json:
        typer.echo(rod_model_to_yaml(refined), nl=False)
    if as_json:
        typer.echo(to_json(_report(frame, refinement)))
    _tell(talk, frame, refinement, len(slices))


def _check_output(output: str, model: str) -> None:
    if output == STANDARD_OUTPUT:
        return
    if not output.lower().endswith(SUFFIXES):
        raise typer.BadParameter(f"{output}: a frame file is YAML; the suffix must be {' or '.join(SUFFIXES)}")
    if Path(output).resolve() == Path(model).resolve():
        raise typer.BadParameter(f"{output} is the frame to refine; write to another file, and keep the drawing")


def _description(frame: RodModel, refinement: RodRefinement) -> str:
    """What the file rests on; nothing of where the slices lay or whose they are."""
    poses = "one pose" if refinement.one_pose else "a pose each"
    before, after = refinement.rms_before_px, refinement.rms_after_px
    return (
        f"{frame.name} (sha256 {frame.sha256[:12]}), its rods where {refinement.n_slices} slices with {poses} show "
        f"them: {refinement.n_spots} spots, residual {before:.3f} px before, {after:.3f} px after. "
        "Tolerances are what remains unsure of each rod."
    )


def _report(frame: RodModel, refinement: RodRefinement) -> dict[str, Any]:
    """The refinement for programs: mm, model frame."""
    factor, factor_sd = refinement.scale_factor, refinement.scale_factor_sd
    return {
        "model": {"name": frame.name, "sha256": frame.sha256},
        "n_slices": refinement.n_slices,
        "n_spots": refinement.n_spots,
        "one_pose": refinement.one_pose,
        "rms_before_px": refinement.rms_before_px,
        "rms_after_px": refinement.rms_after_px,
        "inflation": refinement.inflation,
        "scale_factor": factor,
        "scale_factor_sd": factor_sd,
        "rods": [
            {
                "id": rod.id,
                "n_slices": refinement.n_seen[i],
                "determined": bool(refinement.determined[i]),
                "shift_start_mm": refinement.shift_mm[i, 0],
                "shift_end_mm": refinement.shift_mm[i, 1],
                "sd_start_mm": float(refinement.sd_mm[i, 0]),
                "sd_end_mm": float(refinement.sd_mm[i, 1]),
                "tolerance_mm": rod.tolerance_mm,
            }
            for i, rod in enumerate(refinement.model.rods)
        ],
    }


def _tell(talk: Talk, frame: RodModel, refinement: RodRefinement, n_slices: int) -> None:
    """The closing table on standard error."""
    if talk.quiet:
        return
    from numpy.linalg import norm
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(box=SIMPLE_HEAD, show_edge=False, pad_edge=False)
    for heading in ("rod", "slices", "shift at start mm", "sd", "shift at end mm", "sd", "tolerance mm"):
        table.add_column(heading, justify="left" if heading == "rod" else "right", no_wrap=True)
    for i, rod in enumerate(refinement.model.rods):
        cells = [text for end in (0, 1) for text in _shift(refinement, i, end)]
        left = f"{frame.rods[i].tolerance_mm:g} → {rod.tolerance_mm:.2g}"
        table.add_row(rod.id, str(refinement.n_seen[i]), *cells, left if refinement.determined[i] else f"{left} unsure")
    if not talk.console.is_terminal:
        talk.console.width = TABLE_WIDTH
    talk.console.print(table)
    largest = float(norm(refinement.shift_mm, axis=-1).max())
    rows = [
        ("slices", f"{refinement.n_slices} of {n_slices} used, {refinement.n_spots} spots"),
        ("rods", f"up to {largest:.2f} mm off"),
        ("residual", f"{refinement.rms_before_px:.3g} px rms before, {refinement.rms_after_px:.3g} px after"),
    ]
    if refinement.scale_factor is not None and refinement.scale_factor_sd is not None:
        words = (
            f"{name} {100 * (f - 1):+.3f} ± {100 * sd:.2g} %"
            for name, f, sd in zip(("s_x", "s_y"), refinement.scale_factor, refinement.scale_factor_sd, strict=True)
        )
        rows.append(("scale", ", ".join(words) + " of the one given"))
    talk.table(rows)


def _shift(refinement: RodRefinement, rod: int, end: int) -> tuple[str, str]:
    x, y, z = refinement.shift_mm[rod, end]
    return f"{x:+.2f} {y:+.2f} {z:+.2f}", f"{refinement.sd_mm[rod, end]:.2g}"
