"""Results of slices as the pipeline gives them, made in code."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from ctreg_cli.geometry.pose import make_pose
from ctreg_cli.imaging.slice import SliceInfo
from ctreg_cli.imaging.spots import Spots
from ctreg_cli.pipeline import FrameResult
from ctreg_cli.registration.result import Candidate, Status

STATUSES: tuple[Status, ...] = ("ok", "ambiguous", "ok", "no_pose")


def candidate(rng: np.random.Generator) -> Candidate:
    T = make_pose(Rotation.random(rng=rng).as_matrix(), rng.uniform(-200, 200, 3))
    return Candidate(
        T_slice_model=T,
        covariance=np.diag([1e-4, 4e-4, 9e-4, 1e-6, 4e-6, 9e-6]),
        rod_index=np.arange(5),
        spot_index=np.arange(5),
        residual_px=np.zeros((5, 2)),
        lambda_mm=np.ones(5),
        missing_rods=np.empty(0, dtype=int),
        rms_px=0.05,
        chi2=1.0,
        degrees_of_freedom=4,
        log_odds=20.0,
    )


def frame_results(n: int = 8, seed: int = 0) -> Iterator[FrameResult]:
    """``ok``, ``ambiguous``, ``ok``, ``no_pose``, and over again."""
    rng = np.random.default_rng(seed)
    T_patient_slice = make_pose(Rotation.random(rng=rng).as_matrix(), rng.uniform(-200, 200, 3))
    for index in range(n):
        status = STATUSES[index % len(STATUSES)]
        info = SliceInfo(source=f"{index}.dcm", time_s=36000 + 0.25 * index, T_patient_slice=T_patient_slice)
        yield FrameResult(
            index=index,
            info=info,
            spots=Spots.from_points(rng.uniform(0, 500, (6, 2))),
            status=status,
            reason="" if status == "ok" else "too_few_spots",
            method="updated",
            candidates=() if status == "no_pose" else (candidate(rng),),
        )
