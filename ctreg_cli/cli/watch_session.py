"""What a command does beside files: slices from a folder that fills or from the network, results to OpenIGTLink."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from ctreg_cli.cli.console import Talk, counted
from ctreg_cli.cli.run import Watched
from ctreg_cli.errors import InputError
from ctreg_cli.imaging.segmentation import SegmentationOptions
from ctreg_cli.io.image_files import shown
from ctreg_cli.io.rod_file import load_rod_model
from ctreg_cli.io.sinks import Sink
from ctreg_cli.io.sources import Source
from ctreg_cli.pipeline import FrameResult, SliceLike
from ctreg_cli.registration.options import TrackingOptions
from ctreg_cli.rods import RodModel
from ctreg_cli.scale import Scale

if TYPE_CHECKING:
    from ctreg_cli.interop.dicom_listener import ListenOptions


@dataclass(slots=True)
class Arriving:
    """Slices whose number nobody knows yet."""

    slices: Iterable[SliceLike]

    def __len__(self) -> int:
        """0: not known."""
        return 0

    def __iter__(self) -> Iterator[SliceLike]:
        return iter(self.slices)


def track_live(
    slices: Watched,
    model: RodModel,
    *,
    scale: Scale | None,
    options: TrackingOptions,
    segmentation: SegmentationOptions,
) -> Iterator[FrameResult]:
    """See :func:`ctreg_cli.interop.live.track_live`; what goes wrong inside is told as a warning."""
    from ctreg_cli.interop import live

    return live.track_live(
        slices, model, scale=scale, options=options, segmentation=segmentation, on_fault=slices.talk.warn
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Session:
    """Where slices come from, None: the inputs; and where results go beside files."""

    source: Source | None = None
    sinks: Sequence[Sink[FrameResult]] = ()
    #: lines for the closing table
    remarks: Sequence[Callable[[], list[tuple[str, str]]]] = field(default=())

    @property
    def is_live(self) -> bool:
        """Whether slices come as they are made: then no full disk keeps the poses from a robot."""
        return self.source is not None

    def rows(self) -> list[tuple[str, str]]:
        """Names and values for the closing table."""
        return [row for remark in self.remarks for row in remark()]


def open_session(
    inputs: Sequence[str],
    *,
    model: str,
    watch: str | None,
    idle: float | None,
    count: int | None,
    igtl: str | None,
    quiet: bool,
) -> Session:
    """What ``--watch`` and ``--igtl`` ask for; before slices may come, all is ready for those of ``model``.

    Raises:
        InputError: inputs and a folder to watch, or neither; a folder or an address that cannot be used.
    """
    if watch is None and (idle is not None or count is not None):
        raise InputError("--idle and --count go with --watch DIR")
    if watch is not None and inputs:
        raise InputError(f"--watch {watch}: takes no INPUT ({inputs[0]}); what is in the folder already comes first")
    if watch is None and not inputs:
        raise InputError("name the slices: INPUT..., or --watch DIR")
    source, sinks, remarks = None, [], []
    if watch is not None:
        from ctreg_cli.interop.live import warm_up
        from ctreg_cli.io.watch import WatchedFolder, WatchOptions

        folder = WatchedFolder(Path(watch), WatchOptions(idle_s=idle, count=count))
        warm_up(load_rod_model(model))
        Talk(quiet=quiet).say(f"watching {shown(Path(watch))}")
        source = Source(slices=Arriving(folder), kind="images")
        remarks.append(lambda: [("skipped", counted(folder.skipped))] if folder.skipped else [])
    if igtl is not None:
        sink, remark = open_igtl(igtl)
        sinks.append(sink)
        remarks.append(remark)
    return Session(source=source, sinks=sinks, remarks=remarks)


def open_igtl(address: str) -> tuple[Sink[FrameResult], Callable[[], list[tuple[str, str]]]]:
    """The server of ``--igtl`` as an output, and what the closing table says of it.

    Raises:
        InputError: it is no address, or cannot be listened on.
    """
    from ctreg_cli.interop.igtl_server import IgtlServer, parse_address

    server = IgtlServer(*parse_address(address))

    def remark() -> list[tuple[str, str]]:
        counts = {"slices dropped for slow clients": server.dropped, "clients refused": server.refused}
        lost = {what: count for what, count in counts.items() if count}
        return [("OpenIGTLink", counted(lost))] if lost else []

    return server, remark


@contextmanager
def listening(options: ListenOptions, *, model: str, igtl: str | None, quiet: bool) -> Iterator[Session]:
    """Listen for slices for as long as the block lasts.

    Raises:
        InputError: what is asked for cannot be had.
    """
    from ctreg_cli.interop.dicom_listener import DicomListener
    from ctreg_cli.interop.live import warm_up

    warm_up(load_rod_model(model))
    talk = Talk(quiet=quiet)
    sinks, remarks = [], []
    if igtl is not None:
        sink, remark = open_igtl(igtl)
        sinks.append(sink)
        remarks.append(remark)
    with DicomListener(options, lambda reason: talk.warn(f"left out: {reason}")) as listener:

        def left_out() -> list[tuple[str, str]]:
            counts = dict(listener.left_out)
            if options.policy == "latest" and listener.slices.dropped:
                counts["dropped for newer ones"] = listener.slices.dropped
            return [("not tracked", counted(counts))] if counts else []

        tls = " with TLS" if options.tls_certificate else ""
        talk.say(f"listening as {options.ae_title} on {options.host}, port {listener.port}{tls}")
        if (
            not options.host.startswith("127.")
            and options.host != "::1"
            and not (options.tls_authority or options.allowed)
        ):
            talk.warn("anyone who reaches this address may send; name who may with --allow, or with --tls-ca")
        source = Source(slices=Arriving(listener.slices), kind="images")
        yield Session(source=source, sinks=sinks, remarks=[*remarks, left_out])
