"""Sequences of spots of a moving frame, made by the oracle: breathing, drift, jumps; rods missing, spots false."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from ctreg_cli.imaging.slice import SliceInfo
from ctreg_cli.imaging.spot_slice import SpotSlice
from ctreg_cli.imaging.spots import Spots
from ctreg_cli.rods import Rod, RodModel
from ctreg_cli.scale import Scale
from tests.oracle import OracleFrame, bound, cross_rod, random_frame, twist_error

MOTIONS = ("breathing", "drift", "jumps", "mixed")


@dataclass
class TrueSlice:
    """What is true of one slice."""

    R: np.ndarray
    t: np.ndarray
    #: rods that left a spot, and the bound with them; None with fewer than three
    rods: list[int]
    bound: np.ndarray | None
    has_jumped: bool
    #: the spot that each of them left
    spots: list[int] = field(default_factory=list)


@dataclass
class Sequence:
    frame: OracleFrame
    model: RodModel
    slices: list[SpotSlice]
    truth: list[TrueSlice]


def model_of(frame: OracleFrame) -> RodModel:
    """The oracle's rods as the package's."""
    return RodModel(
        name="random",
        rods=tuple(
            Rod(id=f"r{i}", start=start, end=end)
            for i, (start, end) in enumerate(zip(frame.starts, frame.ends, strict=True))
        ),
    )


def frame_of(model: RodModel) -> OracleFrame:
    """The package's rods as the oracle's."""
    return OracleFrame(np.array(model.starts), np.array(model.ends))


def trajectory(
    rng: np.random.Generator,
    kind: str,
    times_s: np.ndarray,
    middle: np.ndarray,
    place_mm: np.ndarray,
    period_s: float | None = None,
) -> tuple[list[tuple[np.ndarray, np.ndarray]], set[int]]:
    """(R, t) of every slice, and the slices before which the frame jumped. Motion is about the frame's middle."""
    n = len(times_s)
    tilt = rng.normal(size=3) * np.array([0.12, 0.12, 0.0])
    R0 = Rotation.from_rotvec(tilt).as_matrix() @ Rotation.from_rotvec([0, 0, rng.uniform(-3.1, 3.1)]).as_matrix()
    shift, turn = np.zeros((n, 3)), np.zeros((n, 3))
    jumps: set[int] = set()
    if kind in ("breathing", "mixed"):
        drawn = rng.uniform(3, 6)
        period = period_s or drawn
        breath = np.sin(np.pi * (times_s / period + rng.uniform())) ** 4
        direction = np.array([0.1, -0.35, 0.93]) + 0.2 * rng.normal(size=3)
        shift += breath[:, None] * rng.uniform(3, 8) * direction / np.linalg.norm(direction)
        turn += breath[:, None] * np.radians(rng.uniform(1, 4)) * np.array([1, 0.2, 0.1])
    if kind in ("drift", "mixed"):
        progress = (times_s - times_s[0]) / max(times_s[-1] - times_s[0], 1e-9)
        direction, axis = rng.normal(size=3), rng.normal(size=3)
        shift += progress[:, None] * rng.uniform(3, 8) * direction / np.linalg.norm(direction)
        turn += progress[:, None] * np.radians(rng.uniform(2, 8)) * axis / np.linalg.norm(axis)
    if kind in ("jumps", "mixed"):
        for i in rng.choice(np.arange(5, n), 4, replace=False):
            jumps.add(int(i))
            shift[i:] = shift[i:] - shift[i] + rng.normal(size=3) * np.array([6.0, 6.0, 3.0])
            turn[i:] = turn[i:] - turn[i] + rng.normal(size=3) * np.radians([8.0, 8.0, 25.0])
    poses = []
    for d, w in zip(shift, turn, strict=True):
        R = Rotation.from_rotvec(w).as_matrix() @ R0
        poses.append((R, place_mm + d - R @ middle))
    return poses, jumps


def sequence(
    seed: int,
    *,
    kind: str | None = None,
    n: int = 150,
    frame: OracleFrame | None = None,
    model: RodModel | None = None,
    sd_px: float = 0.3,
    mm_per_px: float = 0.5,
    p_missing: float = 0.2,
    most_false: int = 3,
    interval_s: float = 0.4,
    period_s: float | None = None,
    with_times: bool = True,
) -> Sequence:
    """A sequence of spots with its truth."""
    rng = np.random.default_rng(seed)
    kind = kind or MOTIONS[seed % len(MOTIONS)]
    if frame is None:
        frame = random_frame(rng, int(rng.integers(8, 11))) if model is None else frame_of(model)
    s = np.array([mm_per_px, mm_per_px])
    times_s = interval_s * np.arange(n)
    middle = (frame.starts.mean(axis=0) + frame.ends.mean(axis=0)) / 2
    poses, jumps = trajectory(rng, kind, times_s, middle, np.array([*(256 * s), 0.0]), period_s)
    slices, truth = [], []
    for i, (R, t) in enumerate(poses):
        rods, spots = [], []
        for rod in range(len(frame)):
            hit = cross_rod(frame.starts[rod], frame.ends[rod], R, t)
            if hit is not None and 0.02 < hit[1] < 0.98 and rng.uniform() >= p_missing:
                rods.append(rod)
                spots.append(hit[0] / s)
        true = np.array(spots).reshape(-1, 2)
        uv = true + rng.normal(size=true.shape) * sd_px
        if len(true):
            reach = 1.3 * np.ptp(true, axis=0).max() / 2 + 5
            clutter = true.mean(axis=0) + rng.uniform(-reach, reach, (int(rng.integers(0, most_false + 1)), 2))
            uv = np.concatenate([uv, clutter])
        order = rng.permutation(len(uv))
        uv = uv[order]
        spot_of = np.argsort(order)[: len(rods)].tolist()
        info = SliceInfo(
            source=f"s{i}", time_s=float(times_s[i]) if with_times else None, scale=Scale(s_x=s[0], s_y=s[1])
        )
        covariance = np.tile(np.eye(2) * sd_px**2, (len(uv), 1, 1))
        slices.append(SpotSlice(info=info, spots=Spots(uv_px=uv, covariance_px=covariance)))
        C = bound(frame, rods, R, t, s, sd_px) if len(rods) >= 3 else None
        truth.append(TrueSlice(R=R, t=t, rods=rods, bound=C, has_jumped=i in jumps, spots=spot_of))
    return Sequence(frame=frame, model=model or model_of(frame), slices=slices, truth=truth)


def error_of(T: np.ndarray, true: TrueSlice) -> np.ndarray:
    """[V; Ω] from the true pose to ``T``, mm and rad."""
    return twist_error(T[:3, :3], T[:3, 3], true.R, true.t)


def is_wrong(T: np.ndarray, covariance: np.ndarray, true: TrueSlice) -> bool:
    """Whether the error is beyond anything the covariance allows (7 sd in six degrees of freedom)."""
    error = error_of(T, true)
    return bool(error @ np.linalg.pinv(covariance, hermitian=True) @ error > 60.0)
