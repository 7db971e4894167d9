"""What curves show: pose components, their standard deviations and residuals, as arrays over the slices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctreg_cli.arrays import BoolArray, FloatArray
from ctreg_cli.geometry.pose import difference
from ctreg_cli.io.image_files import natural_key
from ctreg_cli.io.results_document import SliceRecord

#: names and units of the six components
COMPONENTS = (
    ("x", "mm"),
    ("y", "mm"),
    ("z", "mm"),
    ("turn about x", "°"),
    ("turn about y", "°"),
    ("turn about z", "°"),
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseSeries:
    """Poses of n slices; NaN where a slice has none."""

    #: (n,) seconds from the first slice, or numbers of the slices
    x: FloatArray
    x_name: str
    #: (n, 6) place of the model's origin in slice coordinates, mm, and turn since the first usable pose about the
    #: slice's axes (rotation vector), degrees
    values: FloatArray
    #: (n, 6) standard deviations, mm and degrees
    sd: FloatArray
    #: (n,) status ``ok``
    usable: BoolArray


def pose_series(records: tuple[SliceRecord, ...]) -> PoseSeries:
    """The poses of all slices in the order of the results."""
    n = len(records)
    values, sd = np.full((n, 6), np.nan), np.full((n, 6), np.nan)
    usable = np.array([record.status == "ok" and record.T_slice_model is not None for record in records], dtype=bool)
    posed = [record.T_slice_model for record in records if record.T_slice_model is not None]
    first = next((record.T_slice_model for record, good in zip(records, usable, strict=True) if good), None)
    reference = first if first is not None else (posed[0] if posed else np.eye(4))
    for k, record in enumerate(records):
        if record.T_slice_model is not None:
            values[k, :3] = record.T_slice_model[:3, 3]
            values[k, 3:] = np.degrees(difference(record.T_slice_model, reference)[3:])
            sd[k] = np.zeros(6) if record.sd is None else record.sd
    times = [record.time_s for record in records]
    known = [time for time in times if time is not None]
    timed = n > 0 and len(known) == n and max(known) > min(known)
    return PoseSeries(
        x=np.array(known) - min(known) if timed else np.array([float(record.index) for record in records]),
        x_name="time (s)" if timed else "slice",
        values=values,
        sd=sd,
        usable=usable,
    )


def residuals(records: tuple[SliceRecord, ...]) -> dict[str, FloatArray]:
    """Residuals (k, 2) in u and v, px, of every rod matched in a usable slice; r2 before r10."""
    found: dict[str, list[tuple[float, float]]] = {}
    for record in records:
        if record.status == "ok":
            for match in record.matches:
                found.setdefault(match.rod, []).append((match.residual_u_px, match.residual_v_px))
    return {rod: np.array(found[rod]) for rod in sorted(found, key=natural_key)}
