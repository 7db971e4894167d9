"""``ctreg track``: the frame followed through slices taken one after the other."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

import typer

from ctreg_cli.cli import options as opt
from ctreg_cli.cli import watch_options as live


class Prediction(StrEnum):
    """Where the frame is expected in the next slice."""

    velocity = "velocity"
    identity = "identity"


PredictionChoice = Annotated[
    Prediction, typer.Option("--prediction", help="Expect the frame carried on by its velocity, or where it was.")
]
SmoothFile = Annotated[
    str | None,
    typer.Option(
        "--smooth",
        metavar="FILE",
        help="Also write the motion as all slices together show it (.csv, .json, .jsonl or .tum).",
        show_default=False,
    ),
]


def track(
    model: opt.ModelName,
    inputs: live.OptionalInputs = None,
    calibration: opt.CalibrationFile = None,
    scale: opt.ScalePair = None,
    output: opt.Outputs = None,
    jacobian: opt.JacobianChoice = opt.Jacobian.updated,
    gain: opt.Gain = opt.TRACKING.gain,
    prediction: PredictionChoice = Prediction.velocity,
    smooth: SmoothFile = None,
    watch: live.WatchFolder = None,
    idle: live.Idle = None,
    count: live.Count = None,
    igtl: live.Igtl = None,
    use_mount: opt.UseMount = opt.REGISTRATION.use_mount,
    integrity_risk: opt.IntegrityRisk = opt.REGISTRATION.integrity_risk,
    alert_limit: opt.AlertLimit = opt.REGISTRATION.alert_limit_mm,
    polarity: opt.PolarityChoice = opt.Polarity.bright,
    series: opt.SeriesNumber = None,
    spot_sd: opt.SpotSd = None,
    overlay: opt.OverlayFolder = None,
    with_uids: opt.WithUids = False,
    strict: opt.Strict = False,
    quiet: opt.Quiet = False,
    verbose: opt.Verbose = False,
) -> None:
    """Follow the frame through the slices as one sequence in time.

    The pose of one slice predicts the next; a frame that is lost is said to be lost and looked for anew, never filled
    in with the last pose.

    \b
    Examples:
      ctreg track slices/ -m frame.yaml -o track.csv
      ctreg track slices/ -m frame.yaml --jacobian constant -o track.jsonl
      ctreg track slices/ -m frame.yaml -o track.tum --smooth smooth.csv
      ctreg track --watch incoming/ -m frame.yaml --igtl 18944 -o track.jsonl
    """
    from dataclasses import asdict

    from ctreg_cli import pipeline
    from ctreg_cli.cli.poses import PoseArguments, run_poses
    from ctreg_cli.cli.watch_session import open_session, track_live
    from ctreg_cli.registration.options import RegistrationOptions, TrackingOptions

    registration = RegistrationOptions(use_mount=use_mount, integrity_risk=integrity_risk, alert_limit_mm=alert_limit)
    tracking = TrackingOptions(
        registration=registration, jacobian=jacobian.value, gain=gain, prediction=prediction.value
    )
    session = open_session(inputs or [], model=model, watch=watch, idle=idle, count=count, igtl=igtl, quiet=quiet)
    run_poses(
        "track",
        lambda slices, frame, mm_per_px, segmentation: (track_live if watch else pipeline.track)(
            slices, frame, scale=mm_per_px, options=tracking, segmentation=segmentation
        ),
        {"tracking": asdict(tracking)},
        PoseArguments(
            inputs=inputs or [],
            model=model,
            calibration=calibration,
            scale=scale,
            output=output,
            polarity=polarity,
            series=series,
            spot_sd=spot_sd,
            overlay=overlay,
            with_uids=with_uids,
            strict=strict,
            quiet=quiet,
            verbose=verbose,
        ),
        smooth=smooth,
        session=session,
    )
