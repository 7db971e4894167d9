"""Pose of a rod frame from one CT slice: segment, calibrate, register, track.

::

    import ctreg_cli as ct

    model = ct.load_rod_model("frame.yaml")
    for slice_ in ct.read_slices("slices/"):
        spots = ct.find_spots(slice_)
        result = ct.register(spots, model, scale=slice_.info.scale)

Names are loaded when first used: ``import ctreg_cli`` costs nothing.
"""

from __future__ import annotations

from importlib import import_module

from ctreg_cli._version import __version__

#: as in :mod:`typing`, which takes longer to load than all of this
TYPE_CHECKING = False
if TYPE_CHECKING:
    from ctreg_cli.errors import (
        CalibrationError,
        CalibrationFileError,
        CtregError,
        EstimationError,
        InputError,
        MissingScaleError,
        RodModelError,
        SingularGeometryError,
        SpotsFileError,
        UnreadableSliceError,
    )
    from ctreg_cli.imaging.segmentation import SegmentationOptions, find_spots
    from ctreg_cli.imaging.slice import Slice, SliceInfo, UnreadableSlice
    from ctreg_cli.imaging.spot_slice import SpotSlice
    from ctreg_cli.imaging.spots import Spots
    from ctreg_cli.io.calibration_file import load_calibration
    from ctreg_cli.io.images import read_slices
    from ctreg_cli.io.results import PoseRow, ResultsHeader, read_results, write_results
    from ctreg_cli.io.rod_file import load_rod_model
    from ctreg_cli.io.spots_file import read_spots
    from ctreg_cli.pipeline import FrameResult, pose, segment, track
    from ctreg_cli.registration.calibrate import Calibration, calibrate
    from ctreg_cli.registration.options import RegistrationOptions, TrackingOptions
    from ctreg_cli.registration.register import register
    from ctreg_cli.registration.result import Candidate, Registration
    from ctreg_cli.rods import Mount, Rod, RodModel, Target
    from ctreg_cli.scale import Scale
    from ctreg_cli.tracking.tracker import Tracker

#: public name → module it lives in
_HOME = {
    "Calibration": "registration.calibrate",
    "CalibrationError": "errors",
    "CalibrationFileError": "errors",
    "Candidate": "registration.result",
    "CtregError": "errors",
    "EstimationError": "errors",
    "FrameResult": "pipeline",
    "InputError": "errors",
    "MissingScaleError": "errors",
    "Mount": "rods",
    "PoseRow": "io.results",
    "Registration": "registration.result",
    "RegistrationOptions": "registration.options",
    "ResultsHeader": "io.results",
    "Rod": "rods",
    "RodModel": "rods",
    "RodModelError": "errors",
    "Scale": "scale",
    "SegmentationOptions": "imaging.segmentation",
    "SingularGeometryError": "errors",
    "Slice": "imaging.slice",
    "SliceInfo": "imaging.slice",
    "SpotSlice": "imaging.spot_slice",
    "Spots": "imaging.spots",
    "SpotsFileError": "errors",
    "Target": "rods",
    "Tracker": "tracking.tracker",
    "TrackingOptions": "registration.options",
    "UnreadableSlice": "imaging.slice",
    "UnreadableSliceError": "errors",
    "calibrate": "registration.calibrate",
    "find_spots": "imaging.segmentation",
    "load_calibration": "io.calibration_file",
    "load_rod_model": "io.rod_file",
    "pose": "pipeline",
    "read_results": "io.results",
    "read_slices": "io.images",
    "read_spots": "io.spots_file",
    "register": "registration.register",
    "segment": "pipeline",
    "track": "pipeline",
    "write_results": "io.results",
}

__all__ = [
    "Calibration",
    "CalibrationError",
    "CalibrationFileError",
    "Candidate",
    "CtregError",
    "EstimationError",
    "FrameResult",
    "InputError",
    "MissingScaleError",
    "Mount",
    "PoseRow",
    "Registration",
    "RegistrationOptions",
    "ResultsHeader",
    "Rod",
    "RodModel",
    "RodModelError",
    "Scale",
    "SegmentationOptions",
    "SingularGeometryError",
    "Slice",
    "SliceInfo",
    "SpotSlice",
    "Spots",
    "SpotsFileError",
    "Target",
    "Tracker",
    "TrackingOptions",
    "UnreadableSlice",
    "UnreadableSliceError",
    "__version__",
    "calibrate",
    "find_spots",
    "load_calibration",
    "load_rod_model",
    "pose",
    "read_results",
    "read_slices",
    "read_spots",
    "register",
    "segment",
    "track",
    "write_results",
]


def __getattr__(name: str) -> object:
    home = _HOME.get(name)
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value: object = getattr(import_module(f"{__name__}.{home}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
