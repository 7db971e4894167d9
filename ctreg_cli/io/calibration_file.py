"""Calibration files (``ctreg/calibration/1``): pixel scales with what they rest on, as YAML."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import yaml
from pydantic import Field

from ctreg_cli.errors import CalibrationFileError
from ctreg_cli.io.atomic import write_text
from ctreg_cli.io.yaml_document import (
    Count,
    EmptyIsNone,
    Name,
    NotNegative,
    Positive,
    StrictSchema,
    Text,
    read_document,
)
from ctreg_cli.registration.calibrate import Calibration
from ctreg_cli.scale import Scale

SCHEMA = "ctreg/calibration/1"


class _Nominal(StrictSchema):
    s_x_mm: Positive = Field(description="DICOM's mm per pixel along u")
    s_y_mm: Positive = Field(description="DICOM's mm per pixel along v")


class _Model(StrictSchema):
    name: Name = Field(description="name of the frame")
    sha256: Annotated[Text | None, EmptyIsNone] = Field(default=None, description="of the frame file")


class _CalibrationFile(StrictSchema):
    schema_: Literal["ctreg/calibration/1"] = Field(alias="schema", description=f"'{SCHEMA}'")
    s_x_mm: Positive = Field(description="mm per pixel along u (columns)")
    s_y_mm: Positive = Field(description="mm per pixel along v (rows)")
    sd_s_x_mm: NotNegative = Field(description="standard deviation of s_x_mm")
    sd_s_y_mm: NotNegative = Field(description="standard deviation of s_y_mm")
    n_slices: Count = Field(description="slices used")
    n_spots: Count = Field(description="matched spots used")
    rms_px: NotNegative = Field(description="rms residual, px")
    nominal: Annotated[_Nominal | None, EmptyIsNone] = Field(
        default=None, description="s_x_mm, s_y_mm from DICOM, or null"
    )
    model: _Model = Field(description="name and sha256 of the frame")


def load_calibration(path: str | Path) -> Calibration:
    """The calibration in a file that :func:`save_calibration` wrote, or a person.

    Raises:
        CalibrationFileError: the file cannot be read; or one line for every mistake, ``file:line:col: key: ...``.
    """
    file = read_document(path, CalibrationFileError).validate(_CalibrationFile)
    return Calibration(
        scale=Scale(s_x=file.s_x_mm, s_y=file.s_y_mm),
        sd_s_x=file.sd_s_x_mm,
        sd_s_y=file.sd_s_y_mm,
        n_slices=file.n_slices,
        n_spots=file.n_spots,
        rms_px=file.rms_px,
        nominal=Scale(s_x=file.nominal.s_x_mm, s_y=file.nominal.s_y_mm) if file.nominal else None,
        model_name=file.model.name,
        model_sha256=file.model.sha256 or "",
    )


def save_calibration(calibration: Calibration, path: str | Path) -> None:
    """Write a calibration file, complete or not at all.

    Raises:
        InputError: the file cannot be written there.
    """
    write_text(path, calibration_to_yaml(calibration))


def calibration_to_yaml(calibration: Calibration) -> str:
    """The text of a calibration file; :func:`load_calibration` gives the same calibration back, to the last bit."""
    nominal = calibration.nominal
    content = {
        "schema": SCHEMA,
        "s_x_mm": float(calibration.scale.s_x),
        "s_y_mm": float(calibration.scale.s_y),
        "sd_s_x_mm": float(calibration.sd_s_x),
        "sd_s_y_mm": float(calibration.sd_s_y),
        "n_slices": int(calibration.n_slices),
        "n_spots": int(calibration.n_spots),
        "rms_px": float(calibration.rms_px),
        "nominal": {"s_x_mm": float(nominal.s_x), "s_y_mm": float(nominal.s_y)} if nominal else None,
        "model": {"name": calibration.model_name, "sha256": calibration.model_sha256 or None},
    }
    return yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
