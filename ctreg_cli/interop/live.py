"""The method beside a scanner: a slice that cannot be worked on is a row, never the end of the session."""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable, Iterable, Iterator
from importlib import import_module

import numpy as np

from ctreg_cli.errors import MissingScaleError
from ctreg_cli.imaging.segmentation import SegmentationOptions, find_spots
from ctreg_cli.imaging.slice import Slice, SliceInfo, UnreadableSlice
from ctreg_cli.imaging.spot_slice import SpotSlice
from ctreg_cli.pipeline import FrameResult, SliceLike, failure, no_spots, track_slice
from ctreg_cli.registration.options import TrackingOptions
from ctreg_cli.rods import RodModel
from ctreg_cli.scale import Scale
from ctreg_cli.tracking.tracker import Tracker

#: of the slice that is only looked at to load what looking needs, px
_BLANK_SIDE = 64
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
    segmentation = segmentation or SegmentationOptions()
    tracker = Tracker(model, options)
    for place, slice_ in enumerate(slices):
        try:
            result = track_slice(place, slice_, tracker, scale=scale, segmentation=segmentation)
        except MissingScaleError as error:
            on_fault(str(error))
            result = failure(place, _without_spots(slice_), "no_scale")
        # the scanner does not wait: whatever breaks here is told, and the next slice starts afresh
        except Exception as error:  # noqa: BLE001
            on_fault(f"{slice_.info.source}: {type(error).__name__} inside ctreg; the frame is looked for anew")
            tracker = Tracker(model, options)
            result = failure(place, _without_spots(slice_), "internal_error")
        yield result


def warm_up() -> None:
    """Ready this process for slices in real time.

    Loaded is what the first slice would otherwise wait for: the readers, and the libraries behind the segmentation.
    """
    import_module("ctreg_cli.io.dicom")
    blank = np.zeros((_BLANK_SIDE, _BLANK_SIDE), dtype=np.int16)
    blank[_BLANK_SIDE // 2, _BLANK_SIDE // 2] = np.iinfo(np.int16).max
    find_spots(Slice(info=SliceInfo(source=""), stored=blank), SegmentationOptions())
    # a full garbage collection over everything loaded takes longer than a slice may: leave that out of every later one
    gc.collect()
    gc.freeze()
    # threads that talk to peers hand over to the tracker sooner
    sys.setswitchinterval(_SWITCH_S)


def _without_spots(slice_: SliceLike) -> SpotSlice:
    problem = slice_.problem if isinstance(slice_, UnreadableSlice) else ""
    return SpotSlice(info=slice_.info, spots=no_spots(), problem=problem)
