"""Files of 3D Slicer: markups (``.mrk.json``) and a transform that changes with time (``.seq.mha``)."""

from __future__ import annotations

import json
from collections.abc import Iterable

import numpy as np

from ctreg_cli.arrays import FloatArray
from ctreg_cli.errors import InputError
from ctreg_cli.interop.selection import Content
from ctreg_cli.io.results_document import SliceRecord

MARKUPS_SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/"
    "markups-schema-v1.0.3.json#"
)
#: LPS (DICOM, ITK) ↔ RAS (3D Slicer's scene), its own inverse
RAS_FROM_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])
#: 3D Slicer reads header lines of this length and cuts the rest
_MAX_LINE = 1000

Point = tuple[str, str, FloatArray]


def markups(content: Content, record: SliceRecord) -> bytes:
    """Spots, rods and targets of one slice, in patient coordinates (LPS, mm) or those of the slice.

    Spots are those matched to a rod, named after it. Every rod is a line from its start to its end.

    Raises:
        InputError: nobody gave the frame, or the results hold no scale.
    """
    document, model = content.document, content.model
    if model is None:
        raise InputError(f"{document.name}: the rods' places are needed; give the frame: -m FRAME")
    T = content.pose(record)
    nodes = [_node("Fiducial", f"spots of slice {record.index}", _spots(content, record))]
    for rod in model.rods:
        ends = [(f"{rod.id} {end}", "", _moved(T, point)) for end, point in (("start", rod.start), ("end", rod.end))]
        nodes.append(_node("Line", rod.id, ends))
    targets = [
        (target.id, f"predicted rms error {target.tre_mm:.3g} mm", place)
        for target in record.targets
        for place in [target.position_slice if content.space == "slice" else target.position_patient]
        if place is not None
    ]
    if targets:
        nodes.append(_node("Fiducial", f"targets of slice {record.index}", targets))
    text = json.dumps({"@schema": MARKUPS_SCHEMA, "markups": nodes}, indent=1, ensure_ascii=False, allow_nan=False)
    return (text + "\n").encode()


def _spots(content: Content, record: SliceRecord) -> list[Point]:
    s_x, s_y = record.columns.get("s_x_mm"), record.columns.get("s_y_mm")
    if not isinstance(s_x, int | float) or not isinstance(s_y, int | float):
        raise InputError(f"{content.document.name}: slice {record.index} has no scale to place its spots with")
    to_space = np.eye(4) if content.space == "slice" else record.T_patient_slice
    if to_space is None:
        return []
    return [
        (match.rod, f"spot {match.spot}", _moved(to_space, np.array([match.u_px * s_x, match.v_px * s_y, 0.0])))
        for match in record.matches
    ]


def _node(kind: str, name: str, points: Iterable[Point]) -> dict[str, object]:
    return {
        "type": kind,
        "name": name,
        "coordinateSystem": "LPS",
        "coordinateUnits": "mm",
        "locked": True,
        "controlPoints": [
            {
                "id": str(number),
                "label": label,
                "description": description,
                "position": place.tolist(),
                "positionStatus": "defined",
                "locked": True,
            }
            for number, (label, description, place) in enumerate(points, start=1)
        ],
    }


def _moved(T: FloatArray, point: FloatArray) -> FloatArray:
    moved: FloatArray = T[:3, :3] @ point + T[:3, 3]
    return moved


def transform_sequence(content: Content) -> bytes:
    """The pose of every slice as a sequence of linear transforms, model → slice or patient (RAS, mm).

    A slice without an ``ok`` pose is a frame whose status is ``INVALID`` and which has no matrix: 3D Slicer then shows
    none, where an identity would be a pose. One of which nobody knows when it was taken, where of the others it is
    known, has no place in the sequence.
    """
    name = f"ModelTo{'Patient' if content.space == 'patient' else 'Slice'}Transform"
    records = list(content.timed(content.document.records))
    usable = set(map(id, content.usable))
    lines = [
        "ObjectType = Image",
        "NDims = 3",
        "AnatomicalOrientation = RAI",
        "BinaryData = True",
        "CompressedData = False",
        f"DimSize = 0 0 {len(records)}",
        "ElementSpacing = 1 1 1",
        "Offset = 0 0 0",
        "TransformMatrix = 1 0 0 0 1 0 0 0 1",
        "ElementType = MET_UCHAR",
        "Kinds = domain domain list",
    ]
    for number, (record, time_s) in enumerate(records):
        field = f"Seq_Frame{number:04d}"
        if id(record) in usable:
            M = RAS_FROM_LPS @ content.pose(record) @ RAS_FROM_LPS
            line = f"{field}_{name} = {' '.join(f'{value:.15g}' for value in M.ravel().tolist())}"
            assert len(line) < _MAX_LINE
            lines += [line, f"{field}_{name}Status = OK"]
        else:
            lines.append(f"{field}_{name}Status = INVALID")
        lines.append(f"{field}_Timestamp = {time_s:.6f}")
    lines.append("ElementDataFile = LOCAL")
    return ("\n".join(lines) + "\n").encode()
