"""``ctreg pose``: the pose of the frame in every slice, each on its own."""

from __future__ import annotations

from ctreg_cli.cli import options as opt


def pose(
    inputs: opt.Inputs,
    model: opt.ModelName,
    calibration: opt.CalibrationFile = None,
    scale: opt.ScalePair = None,
    output: opt.Outputs = None,
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

    \b
    Examples:
      ctreg pose slices/ -m leksell-g-3-panel -o poses.csv -o poses.json
      ctreg pose spots.csv -m frame.yaml --scale 0.488 0.488
    """
    from dataclasses import asdict

    from ctreg_cli import pipeline
    from ctreg_cli.cli.poses import PoseArguments, run_poses
    from ctreg_cli.registration.options import RegistrationOptions

    registration = RegistrationOptions(use_mount=use_mount, integrity_risk=integrity_risk, alert_limit_mm=alert_limit)
    run_poses(
        "pose",
        lambda slices, frame, mm_per_px, segmentation: pipeline.pose(
            slices, frame, scale=mm_per_px, options=registration, segmentation=segmentation
        ),
        {"registration": asdict(registration)},
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
