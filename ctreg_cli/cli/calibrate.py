"""``ctreg calibrate``: the pixel scale from slices of a known frame."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Annotated

import typer

from ctreg_cli.cli import options as opt
from ctreg_cli.cli.console import Talk, counted

if TYPE_CHECKING:
    from ctreg_cli.registration.calibrate import CalibrationRun

SUFFIXES = (".yaml", ".yml")
STANDARD_OUTPUT = "-"


def calibrate(
    inputs: opt.Inputs,
    model: opt.ModelName,
    output: Annotated[
        str, typer.Option("--output", "-o", metavar="FILE", help="YAML file to write, - for standard output.")
    ] = STANDARD_OUTPUT,
    use_mount: opt.UseMount = opt.REGISTRATION.use_mount,
    polarity: opt.PolarityChoice = opt.Polarity.bright,
    series: opt.SeriesNumber = None,
    spot_sd: opt.SpotSd = None,
    quiet: opt.Quiet = False,
    verbose: opt.Verbose = False,
) -> None:
    """Find millimetres per pixel along columns and rows from one slice of a known frame, or better from many.

    No scale is needed to start with. Where the slices have a DICOM PixelSpacing it is compared with.

    \b
    Examples:
      ctreg calibrate slices/ -m frame.yaml -o calibration.yaml
      ctreg pose other/ -m frame.yaml -c calibration.yaml
    """
    from ctreg_cli.cli.run import open_inputs, warned
    from ctreg_cli.imaging.segmentation import SegmentationOptions
    from ctreg_cli.io.atomic import AtomicFile
    from ctreg_cli.io.calibration_file import calibration_to_yaml
    from ctreg_cli.io.rod_file import load_rod_model
    from ctreg_cli.pipeline import expecting
    from ctreg_cli.pipeline import segment as segment_slices
    from ctreg_cli.registration.calibrate import calibrate as calibrate_slices
    from ctreg_cli.registration.options import RegistrationOptions

    if output != STANDARD_OUTPUT and not output.lower().endswith(SUFFIXES):
        raise typer.BadParameter(f"{output}: a calibration is YAML; the suffix must be {' or '.join(SUFFIXES)}")
    talk = Talk(quiet=quiet, verbose=verbose)
    rod_model = load_rod_model(model)
    source = open_inputs(inputs, talk, series=series, spot_sd_px=spot_sd)
    file = None if output == STANDARD_OUTPUT else AtomicFile(output)
    try:
        segmentation = expecting(rod_model, SegmentationOptions(polarity=polarity.value))
        found = segment_slices(warned(source, talk), segmentation)
        slices = list(talk.progress(found, total=len(source), what="segment"))
        run = calibrate_slices(slices, rod_model, options=RegistrationOptions(use_mount=use_mount))
        text = calibration_to_yaml(run.calibration)
        if file:
            file.stream.write(text)
            file.commit()
        else:
            typer.echo(text, nl=False)
    finally:
        if file:
            file.abandon()
    talk.table(_rows(run, len(source)))
    for place, reason in run.left_out.items():
        talk.explain(f"slice {place} ({slices[place].info.source}): left out, {reason}")


def _rows(run: CalibrationRun, n_slices: int) -> list[tuple[str, str]]:
    """What was found, and how it compares with DICOM's PixelSpacing."""
    calibration = run.calibration
    nominal, scale = calibration.nominal, calibration.scale
    rows = [("slices", f"{calibration.n_slices} of {n_slices} used, {calibration.n_spots} spots")]
    if run.left_out:
        rows.append(("left out", counted(Counter(run.left_out.values()))))
    for name, value, sd, stated in (
        ("s_x", scale.s_x, calibration.sd_s_x, nominal and nominal.s_x),
        ("s_y", scale.s_y, calibration.sd_s_y, nominal and nominal.s_y),
    ):
        words = f"{value:.6f} ± {sd:.2g} mm/px"
        if stated:
            away = f"{100 * (value / stated - 1):+.3f} %"
            in_sd = f", {abs(value - stated) / sd:.1f} sd" if sd > 0 else ""
            words += f"; PixelSpacing {stated:.6f} ({away}{in_sd})"
        rows.append((name, words))
    if nominal is None:
        rows.append(("DICOM", "no PixelSpacing to compare with"))
    return [*rows, ("residual", f"{calibration.rms_px:.3g} px rms")]
