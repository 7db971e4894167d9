"""The closing words of a run: how many slices, with what outcome, how well, and on what scale."""

from __future__ import annotations

import math
import statistics
from array import array
from collections import Counter
from dataclasses import dataclass, field

from ctreg_cli.cli.console import counted
from ctreg_cli.imaging.spot_slice import SpotSlice
from ctreg_cli.io.results import accepted
from ctreg_cli.pipeline import FrameResult
from ctreg_cli.registration.result import Candidate
from ctreg_cli.scale import Scale

SCALE_SOURCES = {
    "dicom": "DICOM PixelSpacing",
    "spots": "the spots file",
    "calibration": "the calibration file",
    "option": "--scale",
}


def _numbers() -> array[float]:
    """Eight bytes a number: a session may last for days."""
    return array("d")


@dataclass(slots=True)
class PoseTally:
    """Outcomes of a run; a few numbers a slice, whatever its pixels."""

    #: the scale given for all slices, if one was, and where scales are from
    scale: Scale | None
    scale_from: str
    scales: set[Scale] = field(default_factory=set)
    outcomes: Counter[str] = field(default_factory=Counter)
    warnings: Counter[str] = field(default_factory=Counter)
    rms_px: array[float] = field(default_factory=_numbers)
    sd_mm: array[float] = field(default_factory=_numbers)
    sd_deg: array[float] = field(default_factory=_numbers)
    total: int = 0
    n_ok: int = 0
    n_poses: int = 0
    #: slices that state another scale than the one used would fit
    n_doubtful: int = 0

    def add(self, result: FrameResult) -> None:
        self.total += 1
        scale = self.scale or result.info.scale
        if scale:
            self.scales.add(scale)
        self.n_ok += result.status == "ok"
        reason = f" ({result.reason})" if result.reason else ""
        self.outcomes[f"{result.status}{reason}"] += 1
        self.warnings.update({code for code, _ in result.warnings})
        for best in accepted(result)[:1]:
            self.n_poses += 1
            translation, rotation = _sd(best)
            if len(best.rod_index):  # a pose carried here from other slices has no residual
                self.rms_px.append(best.rms_px)
            self.sd_mm.append(translation)
            self.sd_deg.append(rotation)

    def rows(self) -> list[tuple[str, str]]:
        """Names and values for the table."""
        rows = [("slices", str(self.total))]
        if self.outcomes:
            rows.append(("status", counted(self.outcomes)))
        if self.rms_px:
            rows.append(("residual", f"{statistics.median(self.rms_px):.3g} px rms"))
        if self.n_poses:
            sds = f"{statistics.median(self.sd_mm):.2g} mm, {statistics.median(self.sd_deg):.2g}°"
            rows.append(("sd", f"{sds} (largest axis)"))
        if len(self.scales) == 1:
            (scale,) = self.scales
            rows.append(("scale", f"{scale.s_x:.6g} × {scale.s_y:.6g} mm/px, from {SCALE_SOURCES[self.scale_from]}"))
        elif self.scales:
            rows.append(("scale", f"{len(self.scales)} different ones, from {SCALE_SOURCES[self.scale_from]}"))
        if self.n_doubtful:
            rows.append(("", f"{self.n_doubtful} slices state a scale that does not go with it"))
        if self.warnings:
            rows.append(("warnings", counted(self.warnings)))
        return rows


def _sd(candidate: Candidate) -> tuple[float, float]:
    """Largest standard deviation over the axes: translation in mm, rotation in degrees."""
    variance = candidate.covariance.diagonal()
    return math.sqrt(float(variance[:3].max())), math.degrees(math.sqrt(float(variance[3:].max())))


@dataclass(slots=True)
class SpotTally:
    """What a segmentation found."""

    counts: list[int] = field(default_factory=list)
    rejected: Counter[str] = field(default_factory=Counter)
    n_unreadable: int = 0

    def add(self, spot_slice: SpotSlice) -> None:
        self.counts.append(len(spot_slice.spots))
        self.n_unreadable += bool(spot_slice.problem)
        self.rejected.update(spot_slice.spots.n_rejected)

    def rows(self) -> list[tuple[str, str]]:
        """Names and values for the table."""
        rows = [("slices", str(len(self.counts)))]
        if self.counts:
            median = statistics.median(self.counts)
            rows.append(("spots", f"{sum(self.counts)} ({min(self.counts)} to {max(self.counts)}, median {median:g})"))
        if self.n_unreadable:
            rows.append(("unreadable", str(self.n_unreadable)))
        if self.rejected:
            rows.append(("left out", counted(self.rejected)))
        return rows
