"""``ctreg pose``: the pose of the frame in every slice, each on its own."""

from __future__ import annotations

from typing import Annotated

import typer

from ctreg_cli.cli import options as opt

Joint = Annotated[
    bool,
    typer.Option(
        "--joint", help="One pose for all slices of a scan: the frame at rest, the slices' places known from DICOM."
    ),
]


def pose(
    inputs: opt.Inputs,
    model: opt.ModelName,
    calibration: opt.CalibrationFile = None,
    scale: opt.ScalePair = None,
    output: opt.Outputs = None,
    joint: Joint = False,
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
    """Find the pose of the frame in every slice, each on its own.

    Every slice is a row: status ok (one pose explains the spots), ambiguous (another one does too) or no_pose, with
    the reason in a word. Only ok may move a robot.

    With --joint all slices of a series share one pose, carried into each by its place in the patient. That is far
    more accurate where the frame is at rest; a slice that denies the pose is no_pose (inconsistent).

    \b
    Examples:
      ctreg pose slices/ -m leksell-g-3-panel -o poses.csv -o poses.json
      ctreg pose spots.csv -m frame.yaml --scale 0.488 0.488
      ctreg pose scan/ -m leksell-g-3-panel --joint -o poses.json
    """
    from dataclasses import asdict

    from ctreg_cli import pipeline
    from ctreg_cli.cli.poses import PoseArguments, run_poses
    from ctreg_cli.registration.options import RegistrationOptions

    if joint and alert_limit is not None:
        raise typer.BadParameter("--alert-limit bounds the error of each slice alone; leave out --joint")
    method = pipeline.pose_joint if joint else pipeline.pose
    registration = RegistrationOptions(use_mount=use_mount, integrity_risk=integrity_risk, alert_limit_mm=alert_limit)
    run_poses(
        "pose",
        lambda slices, frame, mm_per_px, segmentation: method(
            slices, frame, scale=mm_per_px, options=registration, segmentation=segmentation
        ),
        {"joint": joint, "registration": asdict(registration)},
        PoseArguments(
            inputs=inputs,
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
    )
