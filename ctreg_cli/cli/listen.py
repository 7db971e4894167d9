"""``ctreg listen``: slices straight from a scanner or PACS."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from ctreg_cli.cli import options as opt
from ctreg_cli.cli import watch_options as live


class Queue(StrEnum):
    """What happens to slices that come faster than they are tracked."""

    latest = "latest"
    all = "all"


def listen(
    model: opt.ModelName,
    bind: Annotated[str, typer.Option(metavar="HOST", help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port to listen on.")] = 11112,
    aet: Annotated[str, typer.Option("--aet", metavar="TITLE", help="AE title that is called.")] = "CTREG",
    allow: Annotated[
        list[str] | None,
        typer.Option(
            metavar="TITLE",
            help="AE title that may call; repeatable.  [default: any]",
            show_default=False,
        ),
    ] = None,
    queue: Annotated[
        Queue, typer.Option(help="When slices come too fast: keep the latest, or let senders wait for all.")
    ] = Queue.latest,
    queue_size: Annotated[int, typer.Option(min=1, max=10_000, help="Slices that wait at most.")] = 8,
    keep: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Keep the slices as files.", show_default=False)
    ] = None,
    tls_cert: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Listen with TLS; own certificate, PEM.", show_default=False)
    ] = None,
    tls_key: Annotated[Path | None, typer.Option(metavar="FILE", help="Its key.", show_default=False)] = None,
    tls_ca: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Ask senders for a certificate signed by one of these.", show_default=False),
    ] = None,
    max_associations: Annotated[int, typer.Option(min=1, max=1000, help="Senders at a time.")] = 10,
    max_size_mb: Annotated[float, typer.Option(min=0.1, help="Largest image.")] = 256.0,
    max_rate: Annotated[float, typer.Option(min=0.1, help="Images a second.")] = 100.0,
    idle: live.Idle = None,
    count: live.Count = None,
    igtl: live.Igtl = None,
    calibration: opt.CalibrationFile = None,
    scale: opt.ScalePair = None,
    output: opt.Outputs = None,
    jacobian: opt.JacobianChoice = opt.Jacobian.updated,
    gain: opt.Gain = opt.TRACKING.gain,
    use_mount: opt.UseMount = opt.REGISTRATION.use_mount,
    integrity_risk: opt.IntegrityRisk = opt.REGISTRATION.integrity_risk,
    alert_limit: opt.AlertLimit = opt.REGISTRATION.alert_limit_mm,
    polarity: opt.PolarityChoice = opt.Polarity.bright,
    overlay: opt.OverlayFolder = None,
    with_uids: opt.WithUids = False,
    strict: opt.Strict = False,
    quiet: opt.Quiet = False,
    verbose: opt.Verbose = False,
) -> None:
    """Receive slices over the DICOM network and follow the frame through them.

    A Storage SCP for CT, Enhanced CT and MR images (extra live). Each slice is
    tracked as it arrives; results go out slice by slice to standard output,
    .jsonl and OpenIGTLink.

    \b
    Examples:
      ctreg listen -m frame.yaml --igtl 18944 -o session.jsonl
      ctreg listen -m frame.yaml --bind 10.0.0.5 --allow SCANNER --keep slices/
      storescu 127.0.0.1 11112 -aec CTREG slice.dcm    # from DCMTK, to try it
    """
    from dataclasses import asdict

    from ctreg_cli.cli.poses import PoseArguments, run_poses
    from ctreg_cli.cli.watch_session import listening, track_live
    from ctreg_cli.interop.dicom_listener import ListenOptions
    from ctreg_cli.registration.options import RegistrationOptions, TrackingOptions

    registration = RegistrationOptions(use_mount=use_mount, integrity_risk=integrity_risk, alert_limit_mm=alert_limit)
    tracking = TrackingOptions(registration=registration, jacobian=jacobian.value, gain=gain)
    options = ListenOptions(
        host=bind,
        port=port,
        ae_title=aet,
        allowed=tuple(allow or ()),
        tls_certificate=tls_cert,
        tls_key=tls_key,
        tls_authority=tls_ca,
        policy=queue.value,
        queue_size=queue_size,
        idle_s=idle,
        count=count,
        keep=keep,
        max_associations=max_associations,
        max_image_bytes=round(max_size_mb * 1e6),
        max_rate_hz=max_rate,
    )
    arguments = PoseArguments(
        inputs=[],
        model=model,
        calibration=calibration,
        scale=scale,
        output=output,
        polarity=polarity,
        series=None,
        spot_sd=None,
        overlay=overlay,
        with_uids=with_uids,
        strict=strict,
        quiet=quiet,
        verbose=verbose,
    )
    with listening(options, model=model, igtl=igtl, quiet=quiet) as session:
        run_poses(
            "listen",
            lambda slices, frame, mm_per_px, segmentation: track_live(
                slices, frame, scale=mm_per_px, options=tracking, segmentation=segmentation
            ),
            {"tracking": asdict(tracking)},
            arguments,
            session=session,
        )
