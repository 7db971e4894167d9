"""What a spots file may hold: one set of rules for table and document, and the one place that makes spots of it."""

from __future__ import annotations

import math
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

from ctreg_cli.arrays import FloatArray
from ctreg_cli.checks import SCALES_MM, SPOT_SDS_PX
from ctreg_cli.geometry.patient import patient_from_slice, slice_axes
from ctreg_cli.geometry.pose import is_pose
from ctreg_cli.imaging.slice import SliceInfo
from ctreg_cli.imaging.spot_slice import SpotSlice
from ctreg_cli.imaging.spots import ROUNDING, RejectedSpot, Spots
from ctreg_cli.scale import Scale

#: a place beyond this (px) is no place in an image
MAX_COORDINATE_PX = 1e6

Coordinate = Annotated[float, Field(ge=-MAX_COORDINATE_PX, le=MAX_COORDINATE_PX)]
Sd = Annotated[float, Field(ge=SPOT_SDS_PX[0], le=SPOT_SDS_PX[1])]
Positive = Annotated[float, Field(gt=0)]
MmPerPx = Annotated[float, Field(ge=SCALES_MM[0], le=SCALES_MM[1])]
Matrix2 = tuple[tuple[float, float], tuple[float, float]]
Row4 = tuple[float, float, float, float]


def _split(value: object) -> object:
    """The numbers of a cell, separated as DICOM separates values; what is wrong with them is said of the whole."""
    return value.split("\\") if isinstance(value, str) else value


Position = Annotated[tuple[float, float, float], BeforeValidator(_split)]
Cosines = Annotated[tuple[float, float, float, float, float, float], BeforeValidator(_split)]


def _mistake(text: str) -> PydanticCustomError:
    # the text goes in as a value: braces in it are no placeholders
    return PydanticCustomError("spots_file", "{text}", {"text": text})


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


class SpotRecord(_Record):
    """A spot; only its centre must be known."""

    spot: int | None = None
    u_px: Coordinate
    v_px: Coordinate
    sd_u_px: Sd | None = None
    sd_v_px: Sd | None = None
    cov_uv_px2: float | None = None
    #: [[uu, uv], [uv, vv]]; where given it is used, and the three above only inform
    covariance_px2: Matrix2 | None = None
    sd_assumed: bool = False
    area_px: float | None = None
    contrast: float | None = None
    major_px: float | None = None
    minor_px: float | None = None
    angle_rad: float | None = None

    @model_validator(mode="after")
    def _is_a_covariance(self) -> Self:
        if (self.sd_u_px is None) != (self.sd_v_px is None):
            raise _mistake("sd_u_px, sd_v_px: give both or neither")
        covariance = self.covariance()
        if covariance is None:
            return self
        (uu, uv), (vu, vv) = covariance
        # a computed matrix may miss symmetry by its last bits
        is_symmetric = abs(uv - vu) <= ROUNDING * (uu + vv)
        least_variance = (uu + vv - math.hypot(uu - vv, 2 * uv)) / 2
        if not is_symmetric or least_variance < SPOT_SDS_PX[0] ** 2 / 2:
            raise _mistake("covariance: must be symmetric and positive definite")
        return self

    def covariance(self) -> Matrix2 | None:
        """Of the centre, px²; None where nothing is said."""
        if self.covariance_px2 is not None or self.sd_u_px is None or self.sd_v_px is None:
            return self.covariance_px2
        uv = self.cov_uv_px2 or 0.0
        return (self.sd_u_px**2, uv), (uv, self.sd_v_px**2)


class RejectedRecord(_Record):
    """A bright thing the segmentation left out."""

    u_px: Coordinate
    v_px: Coordinate
    reason: str


class SliceRecord(_Record):
    """A slice and its spots."""

    slice: int = Field(ge=0)
    source: str = ""
    time_s: float | None = None
    s_x_mm: MmPerPx | None = None
    s_y_mm: MmPerPx | None = None
    thickness_mm: Positive | None = None
    rows: Annotated[int, Field(gt=0)] | None = None
    columns: Annotated[int, Field(gt=0)] | None = None
    T_patient_slice: tuple[Row4, Row4, Row4, Row4] | None = None
    #: the same as the table has it: Image Position and Image Orientation (Patient)
    image_position_mm: Position | None = None
    image_orientation: Cosines | None = None
    series: Annotated[str, BeforeValidator(str)] = ""
    problem: str = ""
    sd_assumed: bool = False
    spots: tuple[SpotRecord, ...] = ()
    rejected: tuple[RejectedRecord, ...] = ()
    uids: dict[str, str] = {}

    @model_validator(mode="after")
    def _is_one_slice(self) -> Self:
        if (self.s_x_mm is None) != (self.s_y_mm is None):
            raise _mistake("s_x_mm, s_y_mm: give both or neither")
        if (self.rows is None) != (self.columns is None):
            raise _mistake("rows, columns: give both or neither")
        if self.T_patient_slice is not None and not is_pose(np.array(self.T_patient_slice)):
            raise _mistake("T_patient_slice: must be a rigid transform (4 × 4, right-handed, last row 0 0 0 1)")
        if (self.image_position_mm is None) != (self.image_orientation is None):
            raise _mistake("image_position_mm, image_orientation: give both or neither")
        if self.image_orientation is not None and slice_axes(self.image_orientation) is None:
            raise _mistake("image_orientation: must be two orthogonal unit vectors, six numbers separated by \\")
        if self.problem and self.spots:
            raise _mistake("problem: a slice that could not be read has no spots")
        numbers = [spot.spot for spot in self.spots if spot.spot is not None]
        if len(set(numbers)) < len(numbers):
            raise _mistake("spot: the same number twice in one slice")
        return self

    @property
    def is_renumbered(self) -> bool:
        """Whether some spot's place differs from the number it has in the file."""
        numbers = [spot.spot for spot in self._ordered()]
        return any(number is not None and number != place for place, number in enumerate(numbers))

    @property
    def _patient_from_slice(self) -> FloatArray | None:
        if self.T_patient_slice is not None:
            return np.array(self.T_patient_slice)
        axes = None if self.image_orientation is None else slice_axes(self.image_orientation)
        if axes is None or self.image_position_mm is None:
            return None
        return patient_from_slice(axes, self.image_position_mm)

    def _ordered(self) -> tuple[SpotRecord, ...]:
        if any(spot.spot is None for spot in self.spots):
            return self.spots
        return tuple(sorted(self.spots, key=lambda spot: spot.spot or 0))

    def spot_slice(self, spot_sd_px: float) -> SpotSlice:
        """The slice; a spot without standard deviation is given ``spot_sd_px``."""
        spots = self._ordered()
        known = [spot.covariance() for spot in spots]
        assumed = ((spot_sd_px**2, 0.0), (0.0, spot_sd_px**2))

        def column(name: str) -> list[float]:
            return [np.nan if (value := getattr(spot, name)) is None else value for spot in spots]

        return SpotSlice(
            index=self.slice,
            problem=self.problem,
            info=SliceInfo(
                source=self.source,
                time_s=self.time_s,
                scale=Scale(s_x=self.s_x_mm, s_y=self.s_y_mm) if self.s_x_mm and self.s_y_mm else None,
                T_patient_slice=self._patient_from_slice,
                thickness_mm=self.thickness_mm,
                shape=(self.rows, self.columns) if self.rows and self.columns else None,
                series=self.series,
                uids=self.uids,
            ),
            spots=Spots(
                uv_px=np.array([(spot.u_px, spot.v_px) for spot in spots]).reshape(-1, 2),
                covariance_px=np.array([assumed if c is None else c for c in known]).reshape(-1, 2, 2),
                area_px=np.array(column("area_px")),
                contrast=np.array(column("contrast")),
                major_px=np.array(column("major_px")),
                minor_px=np.array(column("minor_px")),
                angle_rad=np.array(column("angle_rad")),
                sd_assumed=self.sd_assumed or any(c is None or s.sd_assumed for s, c in zip(spots, known, strict=True)),
                rejected=tuple(RejectedSpot(u_px=r.u_px, v_px=r.v_px, reason=r.reason) for r in self.rejected),
            ),
        )


class SpotsDocument(_Record):
    """The JSON form."""

    schema_: Literal["ctreg/spots/1"] = Field(alias="schema")
    slices: tuple[SliceRecord, ...]
