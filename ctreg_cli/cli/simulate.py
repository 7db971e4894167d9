"""``ctreg simulate``: a DICOM series of a frame with known poses."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

if TYPE_CHECKING:
    from ctreg_cli.simulation.motion import MotionKind

DEFAULT_FRAMES = 20
CENTRED = "centred"
#: with fewer spots no pose can be found
MIN_RODS_FOR_POSE = 3


class BodyName(StrEnum):
    """What lies beside the frame; ``auto``: a head in a large frame, an abdomen under a small one."""

    AUTO = "auto"
    ABDOMEN = "abdomen"
    HEAD = "head"
    NONE = "none"


class Texture(StrEnum):
    """How noise is correlated."""

    FBP = "fbp"
    WHITE = "white"


SCANNER, SCENE, MOTION = "Scanner", "Scene", "Motion"


def simulate(
    model: Annotated[str, typer.Option("--model", "-m", help="Frame file, or name of a shipped frame.")],
    folder: Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="New folder for the series.")],
    frames: Annotated[
        int | None, typer.Option(min=1, help=f"Slices. Default {DEFAULT_FRAMES}, or as many as the motion file has.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="The same seed and options give the same bytes.")] = 0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an earlier simulated series.")] = False,
    size: Annotated[
        tuple[int, int], typer.Option(metavar="ROWS COLS", help="Image size, px.", rich_help_panel=SCANNER)
    ] = (512, 512),
    scale: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="SX SY", help="mm per pixel. Default: the frame fits.", rich_help_panel=SCANNER),
    ] = None,
    thickness_mm: Annotated[float, typer.Option(help="Slice thickness.", rich_help_panel=SCANNER)] = 2.5,
    psf_mm: Annotated[float, typer.Option(help="In-plane blur, FWHM.", rich_help_panel=SCANNER)] = 1.0,
    noise_hu: Annotated[float, typer.Option(help="Noise, standard deviation.", rich_help_panel=SCANNER)] = 15.0,
    noise_texture: Annotated[
        Texture, typer.Option(help="Correlated as in back-projection, or white.", rich_help_panel=SCANNER)
    ] = Texture.FBP,
    orientation: Annotated[
        str,
        typer.Option(
            help="axial, coronal, sagittal, RX,RY,RZ (degrees from axial) or the six numbers of "
            "ImageOrientationPatient.",
            rich_help_panel=SCANNER,
        ),
    ] = "axial",
    padding: Annotated[bool, typer.Option(help="Mark pixels outside the round view.", rich_help_panel=SCANNER)] = True,
    metal_hu: Annotated[float, typer.Option(help="Metal before clipping.", rich_help_panel=SCENE)] = 16000.0,
    streak_hu: Annotated[float, typer.Option(help="Depth of metal streaks.", rich_help_panel=SCENE)] = 0.0,
    rod_mm: Annotated[float, typer.Option(help="Diameter of rods that have none.", rich_help_panel=SCENE)] = 1.0,
    missing: Annotated[
        list[str] | None, typer.Option(metavar="ID", help="Rod left out (repeatable).", rich_help_panel=SCENE)
    ] = None,
    missing_count: Annotated[
        int, typer.Option(min=0, help="Rods left out of each slice at random.", rich_help_panel=SCENE)
    ] = 0,
    false_count: Annotated[
        int, typer.Option("--false", min=0, help="False bright spots in each slice.", rich_help_panel=SCENE)
    ] = 0,
    body: Annotated[BodyName, typer.Option(help="What lies beside the frame.", rich_help_panel=SCENE)] = BodyName.AUTO,
    block: Annotated[bool, typer.Option(help="Acrylic about the rods.", rich_help_panel=SCENE)] = True,
    start: Annotated[
        str,
        typer.Option(help="centred, random, or a pose TX,TY,TZ,QX,QY,QZ,QW (model to slice).", rich_help_panel=MOTION),
    ] = CENTRED,
    tilt_deg: Annotated[
        tuple[float, float, float],
        typer.Option(metavar="RX RY RZ", help="Turn of the start pose, rotation vector.", rich_help_panel=MOTION),
    ] = (0.0, 0.0, 0.0),
    motion: Annotated[
        str,
        typer.Option(help="still, breathing, drift, jump, or a pose CSV to follow.", rich_help_panel=MOTION),
    ] = "breathing",
    amplitude_mm: Annotated[float, typer.Option(help="Greatest displacement.", rich_help_panel=MOTION)] = 6.0,
    amplitude_deg: Annotated[float, typer.Option(help="Greatest turn.", rich_help_panel=MOTION)] = 3.0,
    period_s: Annotated[float, typer.Option(help="One breath.", rich_help_panel=MOTION)] = 4.0,
    interval_s: Annotated[float, typer.Option(help="Time between slices.", rich_help_panel=MOTION)] = 0.5,
    step_mm: Annotated[
        float, typer.Option(help="Table feed between slices, along their normal.", rich_help_panel=MOTION)
    ] = 0.0,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No summary.")] = False,
) -> None:
    """Make a DICOM CT series of a frame, with truth.csv, truth.json and truth_spots.csv.

    Example: ctreg simulate -m rod-cube-30x30x40 -o series --start random --false 5 --missing-count 1
    """
    from dataclasses import asdict

    import numpy as np
    from rich.console import Console
    from rich.progress import Progress

    from ctreg_cli.cli.simulated_series import entropy_of, write_series
    from ctreg_cli.errors import InputError
    from ctreg_cli.io.results import ResultsHeader
    from ctreg_cli.io.rod_file import load_rod_model
    from ctreg_cli.scale import Scale
    from ctreg_cli.simulation.defaults import suitable_settings
    from ctreg_cli.simulation.motion import MOTION_KINDS, MotionSettings, advance, displaced, move, slice_times
    from ctreg_cli.simulation.motion_file import read_motion
    from ctreg_cli.simulation.series import simulate_series
    from ctreg_cli.simulation.start import parse_orientation, start_pose

    rod_model = load_rod_model(model)
    fitting: dict[str, Any] = {}
    if scale is not None:
        fitting["scale"] = Scale(s_x=scale[0], s_y=scale[1])
    if body is not BodyName.AUTO:
        fitting["body"] = body.value
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
        false_count=false_count,
        **fitting,
    )
    R_patient_slice = parse_orientation(orientation)
    rng = np.random.default_rng(seed)
    if motion in MOTION_KINDS:
        T_start = start_pose(start, rod_model, settings, R_patient_slice, rng)
        T_start = displaced(T_start, rod_model.centre, np.zeros(3), np.radians(tilt_deg))
        how = MotionSettings(
            kind=cast("MotionKind", motion), amplitude_mm=amplitude_mm, amplitude_deg=amplitude_deg, period_s=period_s
        )
        trajectory = move(T_start, rod_model.centre, slice_times(frames or DEFAULT_FRAMES, interval_s), how, rng)
    elif start != CENTRED or any(tilt_deg):
        raise InputError(
            "--start and --tilt-deg go with a motion by name; the poses of a motion file are used as they are"
        )
    else:
        trajectory = read_motion(motion, interval_s, frames)
    trajectory = advance(trajectory, step_mm)
    slices = simulate_series(rod_model, trajectory, settings, R_patient_slice, rng)

    console = Console(stderr=True, quiet=quiet)
    header = ResultsHeader(
        model=rod_model, scale=settings.scale, scale_from="simulated", options={"seed": seed, **asdict(settings)}
    )
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("slices", total=len(trajectory))
        rods_seen = write_series(
            slices,
            folder,
            header,
            entropy=entropy_of(header, trajectory),
            overwrite=overwrite,
            on_slice=lambda _: progress.advance(task),
        )
    console.print(
        f"{len(trajectory)} slices of {rod_model.name} in {folder}: {settings.shape[0]} × {settings.shape[1]} px, "
        f"{settings.scale.s_x:g} × {settings.scale.s_y:g} mm; {min(rods_seen)} to {max(rods_seen)} rods in a slice",
        highlight=False,
        soft_wrap=True,
    )
    if min(rods_seen) < MIN_RODS_FOR_POSE:
        console.print(
            f"ctreg: warning: a pose needs {MIN_RODS_FOR_POSE} rods, and some slices show fewer; "
            "change --start, --amplitude-mm or --step-mm",
            style="yellow",
            highlight=False,
            soft_wrap=True,
        )
