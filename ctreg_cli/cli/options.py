"""Options that mean the same in several commands, written down once."""

from __future__ import annotations

import math
from enum import StrEnum
from typing import Annotated

import typer

from ctreg_cli.checks import SCALES_MM, SPOT_SDS_PX
from ctreg_cli.errors import InputError
from ctreg_cli.registration.options import RegistrationOptions, TrackingOptions


class Polarity(StrEnum):
    """What a rod looks like in the image."""

    bright = "bright"
    dark = "dark"
    auto = "auto"


class Jacobian(StrEnum):
    """When the tracker renews its motion field."""

    updated = "updated"
    constant = "constant"


def _positive(value: float | None) -> float | None:
    if value is not None and not (math.isfinite(value) and value > 0):
        raise typer.BadParameter(f"{value:g} is not a positive number")
    return value


def _spot_sd(value: float | None) -> float | None:
    if value is not None and not SPOT_SDS_PX[0] <= value <= SPOT_SDS_PX[1]:
        raise typer.BadParameter(f"{value:g} is not between {SPOT_SDS_PX[0]:g} and {SPOT_SDS_PX[1]:g} px")
    return value


def scale_pair(value: tuple[float, float] | None) -> tuple[float, float] | None:
    """Refuse a ``--scale`` that is none."""
    for name, number in zip(("s_x", "s_y"), value or (), strict=False):
        if value and not SCALES_MM[0] <= number <= SCALES_MM[1]:
            raise InputError(
                f"--scale {value[0]:g} {value[1]:g}: {name}: {number:g} is no scale; "
                f"give mm per pixel between {SCALES_MM[0]:g} and {SCALES_MM[1]:g}"
            )
    return value


def _gain(value: float) -> float:
    if not 0 < value <= 1:
        raise typer.BadParameter(f"{value:g} is not in 0 < G <= 1")
    return value


def _probability(value: float) -> float:
    if not 0 < value < 1:
        raise typer.BadParameter(f"{value:g} is not a probability between 0 and 1")
    return value


Inputs = Annotated[
    list[str],
    typer.Argument(
        metavar="INPUT",
        help="DICOM or PNG files, folders of them, or one spots file (.csv, .json, .jsonl; - is standard input).",
        show_default=False,
    ),
]
ModelName = Annotated[
    str,
    typer.Option(
        "--model",
        "-m",
        metavar="FRAME",
        help="Frame file, or name of a shipped frame (ctreg model list).",
        show_default=False,
    ),
]
ModelForSpots = Annotated[
    str | None,
    typer.Option(
        "--model",
        "-m",
        metavar="FRAME",
        help="Frame whose rods' diameters set the expected size of spots.  [default: none; round ones up to 10 mm]",
        show_default=False,
    ),
]
Outputs = Annotated[
    list[str] | None,
    typer.Option(
        "--output",
        "-o",
        metavar="FILE",
        help="Where to write: .csv, .json, .jsonl (poses also .tum) by suffix, - for CSV on standard output; may be "
        "given several times.  [default: -]",
        show_default=False,
    ),
]
CalibrationFile = Annotated[
    str | None,
    typer.Option(
        "--calibration",
        "-c",
        metavar="FILE",
        help="Pixel scale from ctreg calibrate; overrides DICOM PixelSpacing.",
        show_default=False,
    ),
]
ScalePair = Annotated[
    tuple[float, float] | None,
    typer.Option(
        "--scale",
        metavar="SX SY",
        callback=scale_pair,
        help="Millimetres per pixel along columns and rows; overrides all others.",
        show_default=False,
    ),
]
SeriesNumber = Annotated[
    int | None,
    typer.Option("--series", metavar="N", help="Which DICOM series, by its number in ctreg info.", show_default=False),
]
SpotSd = Annotated[
    float | None,
    typer.Option(
        "--spot-sd",
        metavar="PX",
        callback=_spot_sd,
        show_default=False,
        help="Standard deviation of spots that come without one.  [default: 0.25]",
    ),
]
PolarityChoice = Annotated[
    Polarity, typer.Option("--polarity", help="Rods brighter (CT) or darker than what is around them; auto tries both.")
]
OverlayFolder = Annotated[
    str | None,
    typer.Option("--overlay", metavar="DIR", help="Also draw what was found, one PNG a slice.", show_default=False),
]
WithUids = Annotated[bool, typer.Option("--with-uids", help="Put the DICOM UIDs into JSON outputs.")]
Strict = Annotated[bool, typer.Option("--strict", help="Exit code 1 when any slice is unreadable, or its pose not ok.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing but errors.")]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Explain every slice.")]
UseMount = Annotated[
    bool, typer.Option("--mount/--no-mount", help="Obey what the frame file says about how the frame sits.")
]
IntegrityRisk = Annotated[
    float,
    typer.Option(
        "--integrity-risk",
        metavar="P",
        callback=_probability,
        help="Accepted chance, a slice, that the true error exceeds the protection level.",
    ),
]
AlertLimit = Annotated[
    float | None,
    typer.Option(
        "--alert-limit",
        metavar="MM",
        callback=_positive,
        show_default=False,
        help="Refuse a pose whose protection level at any target exceeds this.",
    ),
]
JacobianChoice = Annotated[
    Jacobian, typer.Option("--jacobian", help="Motion field renewed at every step, or kept from the last registration.")
]
Gain = Annotated[
    float,
    typer.Option("--gain", metavar="G", callback=_gain, help="Share of the spot error taken back a step, 0 < G <= 1."),
]

REGISTRATION = RegistrationOptions()
TRACKING = TrackingOptions()
