"""Frame files: a rod model as YAML (``ctreg/frame/1``), read strictly and written so that reading gives it back."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import AfterValidator, Field, model_validator

from ctreg_cli.arrays import frozen
from ctreg_cli.errors import RodModelError
from ctreg_cli.geometry.pose import nearest_rotation
from ctreg_cli.io.atomic import write_text
from ctreg_cli.io.yaml_document import (
    AsNumber,
    EmptyIsNone,
    Mistake,
    Name,
    NotNegative,
    Positive,
    StrictSchema,
    Text,
    describe,
    read_document,
)
from ctreg_cli.rods import Mount, Rod, RodModel, Target

SCHEMA = "ctreg/frame/1"
MM_PER_UNIT = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
MIN_RODS = 3
#: in the file's units; nothing real is farther from its frame's origin, and squares stay finite
MAX_COORDINATE = 1e5
MIN_LENGTH = 1e-6
#: how far a written rotation may be from a true one, element by element: three decimals are enough to write
ROTATION_TOLERANCE = 2e-3

Coordinate = Annotated[float, Field(ge=-MAX_COORDINATE, le=MAX_COORDINATE), AsNumber]
Tilt = Annotated[float, Field(gt=0, le=180), AsNumber]
Vector = Annotated[list[Coordinate], Field(min_length=3, max_length=3)]


def _rotation(rows: list[list[float]]) -> list[list[float]]:
    M = np.array(rows)
    distance = float(np.abs(M - nearest_rotation(M)).max())
    if np.linalg.det(M) < 0:
        raise ValueError(
            f"is a mirror, not a rotation (determinant {np.linalg.det(M):.3g}); change the sign of one axis"
        )
    if distance > ROTATION_TOLERANCE:
        raise ValueError(
            f"is not a rotation: {distance:.2g} away from the nearest one; rows must be unit vectors at right angles"
        )
    return rows


class RodEntry(StrictSchema):
    id: Name = Field(description="name of the rod, e.g. r1")
    start: Vector = Field(description="[x, y, z], where lambda = 0")
    end: Vector = Field(description="[x, y, z], the other end")
    diameter: Annotated[Positive | None, EmptyIsNone] = Field(default=None, description="of the rod")
    tolerance: Annotated[NotNegative | None, EmptyIsNone] = Field(
        default=None, description="sd of this rod's true place about the written one, across the rod"
    )

    @model_validator(mode="after")
    def _has_length(self) -> RodEntry:
        if np.linalg.norm(np.subtract(self.end, self.start)) <= MIN_LENGTH:
            raise ValueError(f"rod {self.id} has no length: start and end are the same point")
        return self


class MountEntry(StrictSchema):
    patient_from_model: Annotated[list[Vector], Field(min_length=3, max_length=3), AfterValidator(_rotation)] = Field(
        description="rotation, three rows: model axes -> patient axes (LPS), or slice axes where there is no patient"
    )
    max_angle_deg: Tilt = Field(default=45.0, description="largest tilt from it that can occur")


class TargetEntry(StrictSchema):
    id: Name = Field(description="name of the target")
    point: Vector = Field(description="[x, y, z]")


class FrameFile(StrictSchema):
    """Rods of a frame: what stands where. Lengths in ``units``."""

    schema_: Literal["ctreg/frame/1"] = Field(alias="schema", description=f"'{SCHEMA}'")
    name: Name = Field(description="name of the frame")
    description: Annotated[Text | None, EmptyIsNone] = Field(default=None, description="free text")
    units: Literal["mm", "cm", "m"] = Field(default="mm", description="of every length in this file")
    rods: list[RodEntry] = Field(description="at least 3", json_schema_extra={"minItems": MIN_RODS})
    tolerance: NotNegative = Field(default=0.0, description="sd of a rod's true place about the written one, across it")
    mount: Annotated[MountEntry | None, EmptyIsNone] = Field(default=None, description="how the frame normally sits")
    targets: list[TargetEntry] = Field(default=[], description="points at which accuracy is reported")


def load_rod_model(name_or_path: str | Path) -> RodModel:
    """The rod model of a frame file, or of a shipped frame by its name (see :func:`shipped_frames`).

    Lengths come back in mm whatever the file's units; ``sha256`` is that of the file's bytes.

    Raises:
        RodModelError: no such file or frame; or one line for every mistake, ``file:line:col: key: what is wrong``.
    """
    path = _resolve(name_or_path)
    document = read_document(path, RodModelError)
    file = document.validate(FrameFile, _file_checks)
    mm = MM_PER_UNIT[file.units]
    return RodModel(
        name=file.name,
        description=file.description or "",
        rods=tuple(
            Rod(
                id=rod.id,
                start=frozen(np.multiply(rod.start, mm), (3,)),
                end=frozen(np.multiply(rod.end, mm), (3,)),
                diameter_mm=None if rod.diameter is None else rod.diameter * mm,
                tolerance_mm=(file.tolerance if rod.tolerance is None else rod.tolerance) * mm,
            )
            for rod in file.rods
        ),
        mount=_mount(file.mount) if file.mount else None,
        targets=tuple(
            Target(id=target.id, point=frozen(np.multiply(target.point, mm), (3,))) for target in file.targets
        ),
        sha256=document.sha256,
    )


def save_rod_model(model: RodModel, path: str | Path) -> None:
    """Write ``model`` as a frame file in mm; :func:`load_rod_model` gives the same model back (but for ``sha256``).

    Raises:
        InputError: the file cannot be written there.
    """
    write_text(path, rod_model_to_yaml(model))


def rod_model_to_yaml(model: RodModel) -> str:
    """The text of a frame file: one line a rod, lengths in mm."""
    common = model.rods[0].tolerance_mm if len({rod.tolerance_mm for rod in model.rods}) == 1 else None
    head: dict[str, Any] = {"schema": SCHEMA, "name": model.name}
    if model.description:
        head["description"] = model.description
    head["units"] = "mm"
    if common:
        head["tolerance"] = common
    text = _dump(head) + "rods:\n"
    for rod in model.rods:
        entry: dict[str, Any] = {"id": rod.id, "start": rod.start.tolist(), "end": rod.end.tolist()}
        if rod.diameter_mm is not None:
            entry["diameter"] = rod.diameter_mm
        if common is None:
            entry["tolerance"] = rod.tolerance_mm
        text += f"  - {_dump_line(entry)}\n"
    if model.mount:
        text += f"mount:\n  patient_from_model: {_dump_line(model.mount.patient_from_model.tolist())}\n"
        text += f"  max_angle_deg: {_dump_line(model.mount.max_angle_deg)}\n"
    if model.targets:
        text += "targets:\n"
        text += "".join(f"  - {_dump_line({'id': t.id, 'point': t.point.tolist()})}\n" for t in model.targets)
    return text


def frame_schema() -> dict[str, Any]:
    """JSON Schema of a frame file, for editors that check while one types."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **FrameFile.model_json_schema(),
        "title": f"ctreg frame file ({SCHEMA})",
    }


def shipped_frames() -> dict[str, Path]:
    """Names and files of the frames that come with ctreg, in order of name."""
    return {path.stem: path for path in sorted(_frames_folder().glob("*.yaml"))}


def _frames_folder() -> Path:
    package = Path(__file__).resolve().parent.parent
    installed = package / "configs" / "frames"
    return installed if installed.is_dir() else package.parent / "configs" / "frames"  # a source checkout


def _resolve(name_or_path: str | Path) -> Path:
    shipped = shipped_frames()
    name = str(name_or_path)
    if isinstance(name_or_path, str) and name in shipped:
        return shipped[name]
    path = Path(name_or_path)
    if path.exists() or path.suffix in {".yaml", ".yml", ".json"} or path.parent != Path():
        return path  # what is wrong with a path, reading it will say
    near = difflib.get_close_matches(name, shipped, n=1, cutoff=0.4)
    hint = f"did you mean {near[0]}?" if near else "give a path to a frame file"
    raise RodModelError(f"{name}: neither a file nor a shipped frame; {hint} (shipped: {', '.join(shipped)})")


def _mount(mount: MountEntry) -> Mount:
    written = np.array(mount.patient_from_model)
    nearest = nearest_rotation(written)
    exact = written if np.allclose(written, nearest, rtol=0, atol=1e-12) else nearest
    return Mount(patient_from_model=frozen(exact, (3, 3)), max_angle_deg=mount.max_angle_deg)


def _file_checks(data: dict[str, Any]) -> Iterator[Mistake]:
    """What no field shows alone: too few rods, ids used twice."""
    rods = data.get("rods")
    if isinstance(rods, list) and len(rods) < MIN_RODS:
        yield ("rods",), f"has {len(rods)} rods, but at least {MIN_RODS} are needed"
    for group in ("rods", "targets"):
        seen: dict[str, int] = {}
        entries = data.get(group)
        for i, entry in enumerate(entries if isinstance(entries, list) else []):
            name = entry.get("id") if isinstance(entry, dict) else None
            if not isinstance(name, str):
                continue
            if name in seen:
                yield (group, i, "id"), f"{describe(name)} is already the id of {group}.{seen[name]}; ids must differ"
            seen.setdefault(name, i)


def _dump(value: object) -> str:
    return yaml.safe_dump(value, sort_keys=False, allow_unicode=True, width=100)


def _dump_line(value: object) -> str:
    text = yaml.safe_dump(value, sort_keys=False, allow_unicode=True, width=math.inf, default_flow_style=True)
    return text.removesuffix("\n").removesuffix("\n...")
