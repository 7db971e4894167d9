"""A series of slices of a moving frame, one after the other, each with its truth."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ctreg_cli.arrays import FloatArray, frozen, frozen_index
from ctreg_cli.imaging.slice import SliceInfo
from ctreg_cli.imaging.spots import Spots
from ctreg_cli.pipeline import FrameResult
from ctreg_cli.registration.result import Candidate
from ctreg_cli.rods import RodModel
from ctreg_cli.simulation.motion import Trajectory
from ctreg_cli.simulation.phantom import SimulatedSlice, simulate_slice
from ctreg_cli.simulation.settings import ScannerSettings

#: ``FrameResult.method`` of a pose that is not estimated but known
METHOD = "simulated"
#: sources are ``NAME_0000.dcm`` and so on
NAME = "slice"


def simulate_series(
    model: RodModel,
    trajectory: Trajectory,
    settings: ScannerSettings,
    R_patient_slice: FloatArray,
    rng: np.random.Generator,
) -> Iterator[SimulatedSlice]:
    """The slices of a trajectory, each rendered when it is asked for.

    The middle of the image lies at the patient origin where the plane has not advanced.

    Args:
        R_patient_slice: (3, 3) columns are the slice's axes x, y and normal in patient coordinates (LPS).
    """
    digits = max(4, len(str(len(trajectory) - 1)))
    middle = np.array([*settings.centre_mm, 0.0])
    for i in range(len(trajectory)):
        T_patient_slice = np.eye(4)
        T_patient_slice[:3, :3] = R_patient_slice
        T_patient_slice[:3, 3] = R_patient_slice @ (np.array([0.0, 0.0, trajectory.plane_mm[i]]) - middle)
        info = SliceInfo(
            source=f"{NAME}_{i:0{digits}}.dcm",
            time_s=float(trajectory.times_s[i]),
            T_patient_slice=frozen(T_patient_slice, (4, 4)),
            series=NAME,
        )
        yield simulate_slice(model, trajectory.T_slice_model[i], settings, rng, info)


def truth(index: int, simulated: SimulatedSlice) -> FrameResult:
    """The truth about a slice in the form of a result: spots are the rods' crossings, the pose has no error."""
    k = len(simulated.rod_index)
    pose = Candidate(
        T_slice_model=simulated.T_slice_model,
        covariance=frozen(np.zeros((6, 6)), (6, 6)),
        rod_index=simulated.rod_index,
        spot_index=frozen_index(np.arange(k)),
        residual_px=frozen(np.zeros((k, 2)), (k, 2)),
        lambda_mm=simulated.lambda_mm,
        missing_rods=simulated.missing_rods,
        rms_px=0.0,
        chi2=0.0,
        degrees_of_freedom=max(2 * k - 6, 0),
        log_odds=0.0,
    )
    return FrameResult(
        index=index,
        info=simulated.slice.info,
        spots=Spots.without_error(simulated.uv_px),
        status="ok",
        reason="",
        method=METHOD,
        candidates=(pose,),
    )
