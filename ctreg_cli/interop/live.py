"""The method beside a scanner: a slice that cannot be worked on is a row, never the end of the session."""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from importlib import import_module

import numpy as np

from ctreg_cli.imaging.follow import Follower
from ctreg_cli.imaging.segmentation import SegmentationOptions
from ctreg_cli.imaging.slice import SliceInfo, UnreadableSlice
from ctreg_cli.imaging.spot_slice import SpotSlice
from ctreg_cli.pipeline import FrameResult, SliceLike, expecting, failure, missing_scale, no_spots, track_slice
from ctreg_cli.registration.options import TrackingOptions
from ctreg_cli.rods import RodModel
from ctreg_cli.scale import Scale
from ctreg_cli.simulation.defaults import suitable_settings
from ctreg_cli.simulation.phantom import simulate_slice
from ctreg_cli.simulation.start import centred_pose
from ctreg_cli.tracking.tracker import Tracker

#: slices tracked before the first real one: one to find the frame, two to follow it
_REHEARSALS = 3
#: Python's own is 5 ms, a third of what a slice may take
_SWITCH_S = 0.001


def track_live(
    slices: Iterable[SliceLike],
    model: RodModel,
    *,
    scale: Scale | None = None,
    options: TrackingOptions | None = None,
    segmentation: SegmentationOptions | None = None,
    on_fault: Callable[[str], None] = lambda text: None,
) -> Iterator[FrameResult]:
    """As :func:`ctreg_cli.pipeline.track`, but nothing that one slice brings about ends it.

    A slice without a scale is ``no_pose``/``no_scale``. One on which the method itself breaks is
    ``no_pose``/``internal_error``; the frame is then looked for anew in the next.

    Args:
        slices: as they come.
        model: the rods.
        scale: mm per pixel for all slices; None: each slice's own.
        options: see :class:`TrackingOptions`.
        segmentation: see :class:`SegmentationOptions`.
        on_fault: told, in a sentence, what went wrong inside.
    """
    segmentation = expecting(model, segmentation)
    tracker, follower = Tracker(model, options), Follower(segmentation)
    for place, slice_ in enumerate(slices):
        try:
            result = track_slice(place, slice_, tracker, follower, scale=scale)
        # the scanner does not wait: whatever breaks here is told, and the next slice starts afresh
        except Exception as error:  # noqa: BLE001
            on_fault(f"{slice_.info.source}: {type(error).__name__} inside ctreg; the frame is looked for anew")
            tracker, follower = Tracker(model, options), Follower(segmentation)
            result = failure(place, _without_spots(slice_), "internal_error")
        if result.reason == "no_scale":
            on_fault(missing_scale(slice_.info.name))
        yield result


def warm_up(model: RodModel) -> None:
    """Ready this process for slices of ``model`` in real time.

    Loaded is what the first slice would otherwise wait for: the readers, and whatever the method needs, which a few
    simulated slices of this very frame bring out, the last without it.
    """
    import_module("ctreg_cli.io.dicom")
    settings = suitable_settings(model)
    pose = centred_pose(model, settings, np.eye(3))
    rng = np.random.default_rng(0)
    info = SliceInfo(source="")
    seen: list[SliceLike] = [simulate_slice(model, pose, settings, rng, info).slice for _ in range(_REHEARSALS)]
    seen.append(SpotSlice(info=replace(info, scale=settings.scale), spots=no_spots()))
    for _ in track_live(seen, model):
        pass
    # a full garbage collection over everything loaded takes longer than a slice may: leave that out of every later one
    gc.collect()
    gc.freeze()
    # threads that talk to peers hand over to the tracker sooner
    sys.setswitchinterval(_SWITCH_S)


def _without_spots(slice_: SliceLike) -> SpotSlice:
    problem = slice_.problem if isinstance(slice_, UnreadableSlice) else ""
    return SpotSlice(info=slice_.info, spots=no_spots(), problem=problem)
