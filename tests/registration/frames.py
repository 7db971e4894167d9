"""Frames and slices for these tests, from the oracle's world into the package's."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from ctreg_cli.imaging.slice import SliceInfo
from ctreg_cli.imaging.spot_slice import SpotSlice
from ctreg_cli.imaging.spots import Spots
from ctreg_cli.registration.matching import Scene
from ctreg_cli.registration.options import RegistrationOptions
from ctreg_cli.registration.register import make_scene, register
from ctreg_cli.registration.result import Registration
from ctreg_cli.rods import Mount, Rod, RodModel
from ctreg_cli.scale import Scale
from tests.oracle import OracleFrame, OracleScene, cross_lines, scene


def model_of(frame: OracleFrame, *, tolerance_mm: float = 0.0, mount: Mount | None = None) -> RodModel:
    """The oracle's frame as a rod model."""
    rods = tuple(
        Rod(id=f"r{i}", start=a, end=b, tolerance_mm=tolerance_mm)
        for i, (a, b) in enumerate(zip(frame.starts, frame.ends, strict=True))
    )
    return RodModel(name="oracle", rods=rods, mount=mount)


def frame_of(model: RodModel) -> OracleFrame:
    """A rod model as the oracle's frame."""
    return OracleFrame(np.array(model.starts), np.array(model.ends))


def some_scene(rng: np.random.Generator, frame: OracleFrame, **options: object) -> OracleScene:
    """A scene in which enough rods are cut."""
    while True:
        result = scene(rng, frame, **options)  # type: ignore[arg-type]
        if result is not None:
            return result


def on_its_mount(model: RodModel, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Rotation of a frame that lies as its file says (or as drawn) but for a few degrees; its crossings (k, 2), mm."""
    R = Rotation.from_rotvec(rng.normal(0.0, np.radians([6.0, 6.0, 10.0]))).as_matrix()
    if model.mount is not None:
        R = R @ np.array(model.mount.patient_from_model, dtype=np.float64)
    t = np.array([128.0, 128.0, 0.0]) - R @ (model.centre + rng.uniform(-40.0, 40.0) * np.array([0.0, 0.0, 1.0]))
    is_cut = (model.starts @ R.T + t)[:, 2] * (model.ends @ R.T + t)[:, 2] < 0
    return R, cross_lines(model.starts, model.ends, R, t)[is_cut]


def spots_of(world: OracleScene) -> Spots:
    """Its spots, with their true sd."""
    return Spots.from_points(world.uv_px, world.sd_px)


def scale_of(world: OracleScene) -> Scale:
    """Its scale."""
    return Scale(s_x=float(world.mm_per_px[0]), s_y=float(world.mm_per_px[1]))


def scene_of(world: OracleScene, model: RodModel) -> Scene:
    """The package's view of it."""
    return make_scene(spots_of(world), model, scale_of(world), options=RegistrationOptions())


def true_match(world: OracleScene, model: RodModel) -> np.ndarray:
    """(n,) the true spot of each rod, −1 for none."""
    spot_of_rod = np.full(len(model), -1)
    is_true = world.rod_of_spot >= 0
    spot_of_rod[world.rod_of_spot[is_true]] = np.nonzero(is_true)[0]
    return spot_of_rod


def registered(world: OracleScene, model: RodModel) -> Registration:
    """The package's verdict on it."""
    return register(spots_of(world), model, scale=scale_of(world))


def slice_of(world: OracleScene, *, scale: Scale | None) -> SpotSlice:
    """Its spots as a slice that says this scale, or none."""
    return SpotSlice(info=SliceInfo(source="oracle", scale=scale), spots=spots_of(world))
