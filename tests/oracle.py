"""An oracle written apart from the package: plain loops, its own projection, its own bound. Imports nothing of ctreg.

Tests and benchmarks make scenes with it, so that simulator and estimator share no code.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation


@dataclass
class OracleFrame:
    """Rods as plain pairs of points, mm."""

    starts: np.ndarray
    ends: np.ndarray

    def __len__(self) -> int:
        return len(self.starts)


@dataclass
class OracleScene:
    """Spots of one slice with all that is true of them."""

    R: np.ndarray
    t: np.ndarray
    #: (m, 2) px
    uv_px: np.ndarray
    sd_px: float
    #: (m,) rod of each spot, −1 for a false one
    rod_of_spot: np.ndarray
    mm_per_px: np.ndarray
    #: (6, 6) Cramér–Rao bound of the pose with true labels, twist order [V; Ω], mm and rad
    bound: np.ndarray
    visible: list[int] = field(default_factory=list)

    @property
    def T(self) -> np.ndarray:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self.R, self.t
        return T


def cross_rod(start: np.ndarray, end: np.ndarray, R: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Where the segment from start to end crosses z = 0 (mm), and the share of its length there; or None."""
    a, b = R @ start + t, R @ end + t
    if (a[2] > 0) == (b[2] > 0) or a[2] == b[2]:
        return None
    share = a[2] / (a[2] - b[2])
    return (a + share * (b - a))[:2], float(share)


def cross_rods(starts: np.ndarray, ends: np.ndarray, R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """The same (k, 2), mm, of those of many rods that are cut, and not next to an end."""
    hits = [cross_rod(start, end, R, t) for start, end in zip(starts, ends, strict=True)]
    return np.array([hit[0] for hit in hits if hit is not None and 0.02 < hit[1] < 0.98])


def cross_line(start: np.ndarray, end: np.ndarray, R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """The same for the unbounded line."""
    crossing: np.ndarray = cross_lines(start[None], end[None], R, t)[0]
    return crossing


def cross_lines(starts: np.ndarray, ends: np.ndarray, R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """The same for the unbounded lines of many rods (k, 3): (k, 2)."""
    a, b = starts @ R.T + t, ends @ R.T + t
    crossing: np.ndarray = (a + (a[:, 2] / (a[:, 2] - b[:, 2]))[:, None] * (b - a))[:, :2]
    return crossing


def twist_error(R: np.ndarray, t: np.ndarray, R_true: np.ndarray, t_true: np.ndarray) -> np.ndarray:
    """[V; Ω] that takes the true pose to the estimate."""
    return np.concatenate([t - t_true, Rotation.from_matrix(R @ R_true.T).as_rotvec()])


def numeric_jacobian(frame: OracleFrame, rods: list[int], R: np.ndarray, t: np.ndarray, s: np.ndarray) -> np.ndarray:
    """(2k, 6) derivative of the spots in px by central differences."""
    J = np.zeros((2 * len(rods), 6))
    starts, ends = frame.starts[rods], frame.ends[rods]
    for column in range(6):
        h = 1e-5
        for sign in (1, -1):
            twist = np.zeros(6)
            twist[column] = sign * h
            R1, t1 = Rotation.from_rotvec(twist[3:]).as_matrix() @ R, t + twist[:3]
            spots = (cross_lines(starts, ends, R1, t1) / s).ravel()
            J[:, column] += sign * spots / (2 * h)
    return J


def bound(frame: OracleFrame, rods: list[int], R: np.ndarray, t: np.ndarray, s: np.ndarray, sd_px: float) -> np.ndarray:
    """Cramér–Rao bound (6, 6) with these rods seen."""
    J = numeric_jacobian(frame, rods, R, t, s)
    return np.linalg.pinv(J.T @ J, rcond=1e-14, hermitian=True) * sd_px**2


def random_frame(rng: np.random.Generator, n: int, size: float = 30.0, height: float = 40.0) -> OracleFrame:
    """Rods from the rim of the bottom to the rim of the top of a box: half upright, half slanted along a side."""

    def rim(u: float) -> np.ndarray:
        side, along = int(4 * u) % 4, (4 * u) % 1 - 0.5
        x, y = [(along, -0.5), (0.5, along), (-along, 0.5), (-0.5, -along)][side]
        return size * np.array([x, y])

    while True:
        starts, ends = [], []
        places = np.sort(rng.uniform(0, 1, n))
        for k, u in enumerate(places):
            slant = 0.0 if k % 2 else rng.choice([-1, 1]) * rng.uniform(0.06, 0.2)
            starts.append([*rim(u), -height / 2])
            ends.append([*rim(u + slant), height / 2])
        frame = OracleFrame(np.array(starts), np.array(ends))
        middle = (frame.starts + frame.ends) / 2
        gaps = np.linalg.norm(middle[:, None] - middle[None], axis=-1) + np.eye(n) * 99
        if gaps.min() > 0.08 * size:
            return frame


def scene(
    rng: np.random.Generator,
    frame: OracleFrame,
    *,
    sd_px: float = 0.3,
    mm_per_px: tuple[float, float] = (0.5, 0.5),
    missing: int = 0,
    false: int = 0,
    tilt_rad: float = 0.25,
    least: int = 5,
    spin: bool = True,
    height: tuple[float, float] = (0.2, 0.8),
) -> OracleScene | None:
    """Spots of a frame at a random pose: some rods unseen, some spots false; None when too few rods are cut."""
    s = np.array(mm_per_px)
    R = Rotation.from_rotvec(rng.normal(size=3) * tilt_rad * np.array([1, 1, 0])).as_matrix()
    if spin:
        R = R @ Rotation.from_rotvec([0, 0, rng.uniform(-np.pi, np.pi)]).as_matrix()
    along = rng.uniform(*height)
    inside = (1 - along) * frame.starts.mean(axis=0) + along * frame.ends.mean(axis=0)
    t = np.append(s * rng.uniform(150, 350, 2), 0.0) - R @ inside
    visible, spots = [], []
    for i in range(len(frame)):
        hit = cross_rod(frame.starts[i], frame.ends[i], R, t)
        if hit is not None and 0.02 < hit[1] < 0.98:
            visible.append(i)
            spots.append(hit[0] / s)
    if len(visible) - missing < least:
        return None
    kept = sorted(rng.choice(len(visible), len(visible) - missing, replace=False))
    rods = [visible[k] for k in kept]
    true = np.array([spots[k] for k in kept])
    uv = true + rng.normal(size=true.shape) * sd_px
    centre, reach = true.mean(axis=0), 1.3 * np.abs(true - true.mean(axis=0)).max()
    clutter = centre + rng.uniform(-reach, reach, (false, 2))
    uv = np.concatenate([uv, clutter])
    labels = np.array(rods + [-1] * false)
    order = rng.permutation(len(uv))
    return OracleScene(
        R=R,
        t=t,
        uv_px=uv[order],
        sd_px=sd_px,
        rod_of_spot=labels[order],
        mm_per_px=s,
        bound=bound(frame, rods, R, t, s, sd_px),
        visible=visible,
    )
