"""Results made in code: poses that are known, slices that failed between them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ctreg_cli.arrays import FloatArray
from ctreg_cli.geometry.pose import make_pose, quaternion
from ctreg_cli.io.results import COLUMNS
from ctreg_cli.io.rod_file import load_rod_model
from ctreg_cli.rods import RodModel

FRAME = "rod-cube-30x30x40"
STATUSES = ("ok", "ambiguous", "ok", "no_pose", "ok")
SCALE_MM = (0.5, 0.4)
CANARY = "CANARY"


def frame() -> RodModel:
    return load_rod_model(FRAME)


def random_pose(rng: np.random.Generator) -> FloatArray:
    return make_pose(Rotation.random(rng=rng).as_matrix(), rng.uniform(-200, 200, 3))


def patient_from_slice() -> FloatArray:
    """An oblique slice somewhere in the patient."""
    return make_pose(Rotation.from_rotvec([0.3, -0.2, 0.1]).as_matrix(), np.array([-120.0, -110.0, 45.0]))


def document_text(seed: int = 0, *, with_uids: bool = True, patient: bool = True, times: bool = True) -> str:
    """A pose document as ``ctreg track -o x.json --with-uids`` writes it, with two slices that are not ok."""
    rng = np.random.default_rng(seed)
    model = frame()
    results = []
    for index, status in enumerate(STATUSES):
        T = random_pose(rng)
        has_pose = status != "no_pose"
        in_patient = patient_from_slice() @ T
        sd = [0.01, 0.02, 0.03, 1e-3, 2e-3, 3e-3]
        row: dict[str, object] = dict.fromkeys(COLUMNS)
        row |= {
            "slice": index,
            "source": f"{index}.dcm",
            "time_s": 36000 + 0.25 * index if times else None,
            "status": status,
            "reason": "" if status == "ok" else "too_few_spots",
            "method": "updated" if has_pose else "",
            "n_spots": 3,
            "n_matched": 3 if has_pose else 0,
            "s_x_mm": SCALE_MM[0],
            "s_y_mm": SCALE_MM[1],
        }
        if has_pose:
            row |= dict(zip(("tx_mm", "ty_mm", "tz_mm"), T[:3, 3].tolist(), strict=True))
            row |= dict(zip(("qx", "qy", "qz", "qw"), quaternion(T).tolist(), strict=True))
            row |= dict(zip(("sd_tx_mm", "sd_ty_mm", "sd_tz_mm"), sd[:3], strict=True))
            row |= dict(zip(("sd_rx_deg", "sd_ry_deg", "sd_rz_deg"), np.degrees(sd[3:]).tolist(), strict=True))
            row["rms_px"] = 0.1
        uids = {
            "sop_class": "1.2.840.10008.5.1.4.1.1.2",
            "sop_instance": f"2.25.{1000 + index}",
            "series_instance": "2.25.10",
            "study_instance": "2.25.11",
            "frame_of_reference": "2.25.12",
        }
        row |= {"uids": uids} if with_uids else {}
        row |= {
            "T_slice_model": T.tolist() if has_pose else None,
            "T_patient_model": in_patient.tolist() if has_pose and patient else None,
            "covariance": np.diag(np.square(sd)).tolist() if has_pose else None,
            "matches": [
                {
                    "rod": model.ids[rod],
                    "spot": rod,
                    "u_px": 100.0 + 10 * rod,
                    "v_px": 120.0 - 7 * rod,
                    "residual_u_px": 0.05 * (rod - 1),
                    "residual_v_px": -0.03 * rod,
                    "lambda_mm": 12.0,
                }
                for rod in range(3)
                if has_pose
            ],
            "unmatched_px": [[110.0, 100.0], [104.0, 112.0]],
            "missing_rods": [model.ids[3]] if has_pose else [],
            "targets": [
                {
                    "id": "tip",
                    "position_slice": [1.0, 2.0, 3.0],
                    "position_patient": (patient_from_slice() @ [1.0, 2.0, 3.0, 1.0])[:3].tolist() if patient else None,
                    "tre_mm": 0.3,
                }
            ]
            if has_pose
            else [],
            "warnings": [{"code": "weak_geometry", "text": "tilt about x is known to 9° only"}] if index == 2 else [],
        }
        results.append(row)
    head = {
        "schema": "ctreg/poses/1",
        "ctreg": "0.1.0",
        "model": {"name": FRAME, "sha256": model.sha256},
        "scale": {"s_x_mm": SCALE_MM[0], "s_y_mm": SCALE_MM[1], "from": "dicom"},
        "options": {"command": "track", "tracking": {"gain": 1.0}},
    }
    return json.dumps(head | {"results": results})


def written(folder: Path, **options: bool) -> Path:
    path = folder / "results.json"
    path.write_text(document_text(**options), encoding="utf-8")
    return path
