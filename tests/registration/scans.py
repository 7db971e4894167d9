"""Scans of a frame at rest, made with the oracle: oblique slices at known places, rods beside their drawing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ctreg_cli.imaging.slice import SliceInfo
from ctreg_cli.imaging.spot_slice import SpotSlice
from ctreg_cli.imaging.spots import Spots
from ctreg_cli.scale import Scale
from tests.oracle import OracleFrame, cross_line, cross_rod, twist_error

MM_PER_PX = (0.5, 0.6)
SHAPE = (600, 600)


@dataclass
class Scan:
    """Slices of one scan and the truth about them."""

    slices: list[SpotSlice]
    #: model → patient
    R: np.ndarray
    t: np.ndarray
    #: the rods where they truly are, and shifts (n, 2, 3) of their ends from the drawing
    frame: OracleFrame
    shift: np.ndarray

    @property
    def T_patient_model(self) -> np.ndarray:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self.R, self.t
        return T

    def error(self, T: np.ndarray) -> np.ndarray:
        """Twist from the true pose to ``T``."""
        return twist_error(T[:3, :3], T[:3, 3], self.R, self.t)


def shifts_across(rng: np.random.Generator, frame: OracleFrame, tolerance_mm: float) -> np.ndarray:
    """(n, 2, 3) shifts of the rods' ends, across, independent, sd √2 · tolerance a direction."""
    d = frame.ends - frame.starts
    d = d / np.linalg.norm(d, axis=1, keepdims=True)
    raw = rng.normal(size=(len(frame), 2, 3)) * np.sqrt(2) * tolerance_mm
    return raw - np.einsum("nej,nj->ne", raw, d)[..., None] * d[:, None]


def make_scan(
    rng: np.random.Generator,
    frame: OracleFrame,
    *,
    n_slices: int = 6,
    sd_px: float = 0.1,
    tolerance_mm: float = 0.0,
    height: tuple[float, float] = (-0.35, 0.35),
    places: bool = True,
    scale_error: float = 1.0,
    false: int = 0,
) -> Scan:
    """A scan through the middle of a frame; ``scale_error`` is true over stated scale."""
    shift = shifts_across(rng, frame, tolerance_mm)
    true = OracleFrame(frame.starts + shift[:, 0], frame.ends + shift[:, 1])
    tall = np.ptp(np.concatenate([frame.starts, frame.ends])[:, 2])
    middle = (frame.starts + frame.ends).mean(axis=0) / 2
    gantry = Rotation.from_rotvec(rng.normal(size=3) * 0.3).as_matrix()  # slice axes in the patient
    tilt = Rotation.from_rotvec([*rng.normal(size=2) * 0.15, rng.uniform(-1, 1)]).as_matrix()
    R = gantry @ tilt
    isocentre = rng.uniform(-50, 50, 3)
    t = isocentre - R @ middle
    s = np.array(MM_PER_PX) * scale_error
    slices = []
    for number, z in enumerate(np.linspace(*height, n_slices) * tall):
        T_patient_slice = np.eye(4)
        T_patient_slice[:3, :3] = gantry
        T_patient_slice[:3, 3] = isocentre + gantry @ np.array([-150.0, -160.0, z])
        R_slice, t_slice = gantry.T @ R, gantry.T @ (t - T_patient_slice[:3, 3])
        spots = [
            cross_line(a, b, R_slice, t_slice) / s
            for a, b in zip(true.starts, true.ends, strict=True)
            if cross_rod(a, b, R_slice, t_slice) is not None
        ]
        uv = np.array(spots).reshape(-1, 2)
        uv = uv + rng.normal(size=uv.shape) * sd_px
        uv = np.concatenate([uv, rng.uniform(200, 400, (false, 2))])
        info = SliceInfo(
            source=f"s{number}",
            scale=Scale(s_x=MM_PER_PX[0], s_y=MM_PER_PX[1]),
            T_patient_slice=T_patient_slice if places else None,
            shape=SHAPE,
        )
        covariance = np.tile(np.eye(2) * sd_px**2, (len(uv), 1, 1))
        order = rng.permutation(len(uv))
        slices.append(SpotSlice(info=info, spots=Spots(uv_px=uv[order], covariance_px=covariance)))
    return Scan(slices=slices, R=R, t=t, frame=true, shift=shift)
