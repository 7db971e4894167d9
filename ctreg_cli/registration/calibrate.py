"""Pixel scales from slices of a known frame."""

from __future__ import annotations

from dataclasses import dataclass

from ctreg_cli.scale import Scale


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """Estimated mm per pixel along u and v, with standard deviations, and what they rest on."""

    scale: Scale
    #: standard deviations of s_x and s_y, mm/px
    sd_s_x: float
    sd_s_y: float
    n_slices: int
    n_spots: int
    #: root mean square residual over both coordinates of every matched spot, px
    rms_px: float
    #: DICOM PixelSpacing, the same in every slice used, or None
    nominal: Scale | None
    model_name: str
    model_sha256: str
