"""Frames and scanners the simulation tests share."""

from __future__ import annotations

import numpy as np

from ctreg_cli.arrays import FloatArray
from ctreg_cli.rods import Rod, RodModel
from ctreg_cli.scale import Scale
from ctreg_cli.simulation.settings import ScannerSettings


def small_frame() -> RodModel:
    """Six rods of different tilt and diameter, 40 mm high, none parallel to another."""
    ends = {
        "a": ((-15, -14, -20), (-11, -15, 20)),
        "b": ((-8, -15, -20), (8, -13, 20)),
        "c": ((14, -15, -20), (15, -10, 20)),
        "d": ((15, 14, -20), (13, -2, 20)),
        "e": ((9, 15, -20), (-9, 14, 20)),
        "f": ((-15, 15, -20), (-14, 0, 20)),
    }
    rods = [
        Rod(id=name, start=np.array(start, float), end=np.array(end, float), diameter_mm=1.0 + 0.2 * i if i else None)
        for i, (name, (start, end)) in enumerate(ends.items())
    ]
    return RodModel(name="small", rods=tuple(rods))


def bare(**changes: object) -> ScannerSettings:
    """A small anisotropic scanner and nothing but rods: no noise, body, block or padding, metal below clipping."""
    choices: dict[str, object] = {
        "shape": (120, 150),
        "scale": Scale(s_x=0.41, s_y=0.53),
        "metal_hu": 1500.0,
        "noise_hu": 0.0,
        "body": "none",
        "block": False,
        "padding": False,
    }
    return ScannerSettings(**(choices | changes))  # type: ignore[arg-type]


def turned(rng: np.random.Generator, most_rad: float) -> FloatArray:
    """(3, 3) a rotation by up to ``most_rad``, written out from Rodrigues' formula."""
    axis = rng.standard_normal(3)
    axis /= np.linalg.norm(axis)
    angle = rng.uniform(0, most_rad)
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    rotation: FloatArray = np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * (K @ K)
    return rotation


def pose_near_middle(settings: ScannerSettings, rng: np.random.Generator, most_rad: float = 0.5) -> FloatArray:
    """(4, 4) the frame's origin within a few mm of the image's middle, tilted."""
    T = np.eye(4)
    T[:3, :3] = turned(rng, most_rad)
    T[:3, 3] = np.array([*settings.centre_mm, 0.0]) + rng.uniform(-4, 4, 3)
    return T
