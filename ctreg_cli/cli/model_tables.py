"""What ``ctreg model`` prints: tables for people, JSON for programs. Loaded with the command, not with ``--help``."""

from __future__ import annotations

import dataclasses
import json
import math
import sys
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console, RenderableType
from rich.table import Table

from ctreg_cli.design.check import DesignReport
from ctreg_cli.design.prediction import Accuracy
from ctreg_cli.rods import RodModel

#: of a table where standard output is no terminal: nothing is cut off
_PIPED_WIDTH = 200


def show(*parts: RenderableType) -> None:
    """Print on standard output: here the tables are the data."""
    width = None if sys.stdout.isatty() else _PIPED_WIDTH
    console = Console(highlight=False, markup=False, width=width)
    for part in parts:
        console.print(part)


def as_json(value: object) -> str:
    """Strict JSON, readable; what is not finite is null."""
    return json.dumps(plain(value), indent=2, ensure_ascii=False, allow_nan=False)


def plain(value: Any) -> Any:
    """Dataclasses, arrays and tuples as what JSON knows."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def summary(model: RodModel) -> dict[str, Any]:
    """A frame in one line."""
    return {
        "name": model.name,
        "rods": len(model),
        "size_mm": round(model.size_mm, 3),
        "tolerance_mm": float(model.tolerances.max()),
        "mount": model.mount is not None,
        "targets": [target.id for target in model.targets],
        "description": model.description,
        "sha256": model.sha256,
    }


def details(model: RodModel) -> dict[str, Any]:
    """A frame in full, mm."""
    rods = [{**plain(rod), "length_mm": float(length)} for rod, length in zip(model.rods, model.lengths, strict=True)]
    return {
        **summary(model),
        "centre": plain(model.centre),
        "rods": rods,
        "mount": plain(model.mount),
        "targets": plain(model.targets),
    }


def frame_list(models: Iterable[RodModel]) -> Table:
    """One row a frame."""
    table = _table("frame", "rods", "size mm", "tolerance mm", "mount", "what it is")
    for model in models:
        first_sentence = model.description.split(". ")[0].removesuffix(".")
        mount = "yes" if model.mount else "-"
        tolerance = f"{model.tolerances.max():g}"
        table.add_row(model.name, str(len(model)), f"{model.size_mm:.0f}", tolerance, mount, first_sentence)
    return table


def frame_page(model: RodModel) -> list[RenderableType]:
    """Everything a frame file says."""
    rods = _table("rod", "start mm", "end mm", "length mm", "diameter mm", "tolerance mm")
    for rod, length in zip(model.rods, model.lengths, strict=True):
        diameter = "-" if rod.diameter_mm is None else f"{rod.diameter_mm:g}"
        rods.add_row(rod.id, _vector(rod.start), _vector(rod.end), f"{length:.2f}", diameter, f"{rod.tolerance_mm:g}")
    parts: list[RenderableType] = [f"{model.name}: {len(model)} rods, size {model.size_mm:.1f} mm"]
    if model.description:
        parts.append(model.description)
    parts += ["", rods, ""]
    if model.mount:
        rows = "; ".join(_vector(row) for row in model.mount.patient_from_model)
        parts.append(f"mount: patient_from_model = {rows}, to {model.mount.max_angle_deg:g} deg")
    parts += [f"target {target.id}: {_vector(target.point)}" for target in model.targets]
    parts.append(f"sha256: {model.sha256}")
    return parts


def design_page(report: DesignReport) -> list[RenderableType]:
    """A design report: verdict, remarks, and what slices promise by the number of rods they cut."""
    options = report.options
    verdict = "can give poses" if report.usable else "can never give a pose"
    parts: list[RenderableType] = [f"{report.name}: {report.n_rods} rods, size {report.size_mm:.1f} mm: {verdict}"]
    parts += [f"  problem: {problem}" for problem in report.problems]
    parts += [f"  mind: {remark}" for remark in report.remarks]
    parts += [f"  parallel: {', '.join(group)}" for group in report.parallel_groups]
    parts += [f"  in one plane: {', '.join(group)}" for group in report.coplanar_groups]
    parts.append(f"  rank: motion field {report.pose_rank} of 6, linear system {report.linear_rank} of 9")

    table = _table("rods seen", "of slices", "fix a pose", "linear too", "condition", "rotation deg")
    for target in report.targets:
        table.add_column(f"{target} mm", justify="right")
    for row in report.slices:
        exact, real = row.spot_noise, row.with_tolerance
        table.add_row(
            str(row.rods_seen),
            f"{row.share:.0%}",
            f"{row.pose_share:.0%}",
            f"{row.linear_share:.0%}",
            f"{row.condition:.0f}" if math.isfinite(row.condition) else "-",
            _pair(_rotation(exact), _rotation(real)),
            *(_pair(_tre(exact, i), _tre(real, i)) for i in range(len(report.targets))),
        )
    noise = f"{options.noise_px:g} px of spot noise at {options.mm_per_px:g} mm/px"
    parts += ["", f"Predicted error (median): {noise} alone / with the rods' tolerance.", table]
    return parts


def _rotation(accuracy: Accuracy | None) -> float | None:
    return accuracy.rotation_deg if accuracy else None


def _tre(accuracy: Accuracy | None, index: int) -> float | None:
    return accuracy.tre_mm[index] if accuracy else None


def _pair(first: float | None, second: float | None) -> str:
    return "-" if first is None or second is None else f"{_short(first)} / {_short(second)}"


def _short(value: float) -> str:
    return f"{value:.2g}" if value < 10 else f"{value:.0f}"


def _vector(values: Iterable[float]) -> str:
    return "[" + ", ".join(f"{value:g}" for value in values) + "]"


def _table(*headings: str) -> Table:
    table = Table(box=SIMPLE_HEAD, show_edge=False, pad_edge=False)
    for heading in headings:
        table.add_column(heading, no_wrap=heading != "what it is")
    return table
