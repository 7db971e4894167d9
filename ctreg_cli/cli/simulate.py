"""``ctreg simulate``: a DICOM series of a frame with known poses."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from ctreg_cli.cli.options import ModelName, Quiet, scale_pair

if TYPE_CHECKING:
    from ctreg_cli.simulation.motion import MotionKind

DEFAULT_FRAMES, MAX_FRAMES = 20, 100_000
CENTRED = "centred"
#: with fewer spots no pose can be found
MIN_RODS_FOR_POSE = 3


class Body(StrEnum):
    """What lies beside the frame; ``auto``: a head in a large frame, an abdomen under a small one."""

    auto = "auto"
    abdomen = "abdomen"
    head = "head"
    none = "none"


class Texture(StrEnum):
    """Noise correlated as filtered back-projection leaves it, or every pixel on its own."""

    fbp = "fbp"
    white = "white"


def simulate(
    model: ModelName,
    folder: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="Folder to make for the series.", show_default=False)
    ],
    frames: Annotated[
        int | None,
        typer.Option(min=1, max=MAX_FRAMES, help="Slices.  [default: 20, or all of a motion file]", show_default=False),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="The same seed and options give the same bytes.")] = 0,
    motion: Annotated[
        str, typer.Option(help="How the frame moves: still, breathing, drift, jump, or a pose CSV to follow.")
    ] = "breathing",
    amplitude_mm: Annotated[float, typer.Option(help="Greatest displacement of the frame.")] = 6.0,
    amplitude_deg: Annotated[float, typer.Option(help="Greatest turn of the frame.")] = 3.0,
    period_s: Annotated[float, typer.Option(help="Length of one breath.")] = 4.0,
    interval_s: Annotated[float, typer.Option(help="Time from slice to slice.")] = 0.5,
    step_mm: Annotated[float, typer.Option(help="Table feed from slice to slice, along their normal.")] = 0.0,
    start: Annotated[
        str, typer.Option(help="First pose: centred, random, or TX,TY,TZ,QX,QY,QZ,QW (model to slice).")
    ] = CENTRED,
    tilt_deg: Annotated[
        tuple[float, float, float],
        typer.Option(metavar="RX RY RZ", help="Turn of the first pose about the slice's axes (rotation vector)."),
    ] = (0.0, 0.0, 0.0),
    orientation: Annotated[
        str,
        typer.Option(
            help="Slice in the patient: axial, coronal, sagittal, RX,RY,RZ (degrees away from axial), or the six "
            "numbers of ImageOrientationPatient."
        ),
    ] = "axial",
    size: Annotated[tuple[int, int], typer.Option(metavar="ROWS COLS", help="Image size.")] = (512, 512),
    scale: Annotated[
        tuple[float, float] | None,
        typer.Option(
            metavar="SX SY",
            callback=scale_pair,
            help="Millimetres per pixel along columns and rows.  [default: the frame fits]",
            show_default=False,
        ),
    ] = None,
    thickness_mm: Annotated[float, typer.Option(help="Slice thickness.")] = 2.5,
    psf_mm: Annotated[float, typer.Option(help="Blur in the slice, full width at half maximum.")] = 1.0,
    noise_hu: Annotated[float, typer.Option(help="Standard deviation of the noise.")] = 15.0,
    noise_texture: Annotated[
        Texture, typer.Option(help="Noise as filtered back-projection leaves it, or white.")
    ] = Texture.fbp,
    streak_hu: Annotated[float, typer.Option(help="Depth of metal streaks; 0: none.")] = 0.0,
    metal_hu: Annotated[float, typer.Option(help="Value of metal before the scanner clips it at 3071.")] = 16000.0,
    rod_mm: Annotated[float, typer.Option(help="Diameter of rods whose frame file gives none.")] = 1.0,
    missing: Annotated[
        list[str] | None,
        typer.Option(metavar="ROD", help="Leave this rod out; may be given several times.", show_default=False),
    ] = None,
    missing_count: Annotated[int, typer.Option(min=0, help="Leave so many rods out of each slice, at random.")] = 0,
    false: Annotated[int, typer.Option("--false", min=0, help="False bright spots in each slice.")] = 0,
    body: Annotated[Body, typer.Option(help="What lies beside the frame; auto suits its size.")] = Body.auto,
    block: Annotated[bool, typer.Option("--block/--no-block", help="Acrylic about the rods.")] = True,
    padding: Annotated[
        bool, typer.Option("--padding/--no-padding", help="Mark pixels outside the round field of view as padding.")
    ] = True,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an earlier simulated series.")] = False,
    quiet: Quiet = False,
) -> None:
    """Make a DICOM CT series of a frame whose poses are known.

    DIR gets the slices, the true poses (truth.csv, truth.json) and the true spots with their rods (truth_spots.csv,
    which ctreg pose reads too).

    \b
    Examples:
      ctreg simulate -m rod-cube-30x30x40 -o breathing --start random
      ctreg simulate -m leksell-g-3-panel -o scan --motion still --step-mm 2 --false 5 --missing-count 1
      ctreg simulate -m frame.yaml -o again --motion track.csv --noise-hu 30 --streak-hu 150
    """
    from dataclasses import asdict

    import numpy as np

    from ctreg_cli.cli.console import Talk
    from ctreg_cli.cli.simulated_series import entropy_of, write_series
    from ctreg_cli.errors import InputError
    from ctreg_cli.io.results import ResultsHeader
    from ctreg_cli.io.rod_file import load_rod_model
    from ctreg_cli.scale import Scale
    from ctreg_cli.simulation.defaults import suitable_settings
    from ctreg_cli.simulation.motion import MOTION_KINDS, MotionSettings, advance, move, slice_times
    from ctreg_cli.simulation.motion_file import read_motion
    from ctreg_cli.simulation.series import simulate_series
    from ctreg_cli.simulation.start import parse_orientation, start_pose, tilted

    rod_model = load_rod_model(model)
    chosen: dict[str, Any] = {} if body is Body.auto else {"body": body.value}
    if scale is not None:
        chosen["scale"] = Scale(s_x=scale[0], s_y=scale[1])
    settings = suitable_settings(
        rod_model,
        size,
        thickness_mm=thickness_mm,
        psf_fwhm_mm=psf_mm,
        noise_hu=noise_hu,
        noise_texture=noise_texture.value,
        metal_hu=metal_hu,
        rod_diameter_mm=rod_mm,
        streak_hu=streak_hu,
        block=block,
        padding=padding,
        missing=tuple(missing or ()),
        missing_count=missing_count,
        false_count=false,
        **chosen,
    )
    R_patient_slice = parse_orientation(orientation)
    rng = np.random.default_rng(seed)
    if motion in MOTION_KINDS:
        how = MotionSettings(
            kind=cast("MotionKind", motion), amplitude_mm=amplitude_mm, amplitude_deg=amplitude_deg, period_s=period_s
        )
        times_s = slice_times(frames or DEFAULT_FRAMES, interval_s)
        T_start = start_pose(start, rod_model, settings, R_patient_slice, rng, option="--start")
        trajectory = move(tilted(T_start, rod_model, tilt_deg), rod_model.centre, times_s, how, rng)
    elif start != CENTRED or any(tilt_deg):
        raise InputError("--start and --tilt-deg cannot go with a motion file: its poses are used as they are")
    else:
        trajectory = read_motion(motion, interval_s, frames)
    trajectory = advance(trajectory, step_mm)

    talk = Talk(quiet=quiet)
    header = ResultsHeader(
        model=rod_model, scale=settings.scale, scale_from="simulation", options={"seed": seed, **asdict(settings)}
    )
    slices = simulate_series(rod_model, trajectory, settings, R_patient_slice, rng)
    rods_seen = write_series(
        talk.progress(slices, total=len(trajectory), what="slices"),
        folder,
        header,
        entropy=entropy_of(header, R_patient_slice, trajectory),
        overwrite=overwrite,
    )
    talk.say(
        f"{len(trajectory)} slices of {rod_model.name} in {folder}: {size[0]} × {size[1]} px of "
        f"{settings.scale.s_x:g} × {settings.scale.s_y:g} mm, {min(rods_seen)} to {max(rods_seen)} rods in a slice"
    )
    if min(rods_seen) < MIN_RODS_FOR_POSE:
        talk.warn(f"some slices show fewer than {MIN_RODS_FOR_POSE} rods, too few for a pose")
