"""Linear solutions: exact for exact spots, whatever closes the system; singular designs refused."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ctreg_cli.arrays import FloatArray
from ctreg_cli.errors import SingularGeometryError
from ctreg_cli.io.rod_file import load_rod_model
from ctreg_cli.registration.linear import solve_labelled
from ctreg_cli.rods import RodModel
from tests import oracle
from tests.registration.frames import frame_of, model_of, some_scene

ANISOTROPIC = (0.45, 0.62)


def distance(T: FloatArray, world: oracle.OracleScene) -> float:
    """Least distance of any of the poses from the true one, mm and rad × 30."""
    errors = [oracle.twist_error(t[:3, :3], t[:3, 3], world.R, world.t) * [1, 1, 1, 30, 30, 30] for t in T]
    return min((float(np.abs(error).max()) for error in errors), default=np.inf)


def labelled(rng: np.random.Generator, n: int) -> tuple[RodModel, oracle.OracleScene]:
    """n rods, all seen, without noise; the model's rods in the order of the spots."""
    world = None
    while world is None:
        frame = oracle.random_frame(rng, n)
        world = oracle.scene(rng, frame, sd_px=0, mm_per_px=ANISOTROPIC, least=n)
    return model_of(frame).subset(world.rod_of_spot.tolist()), world


def over_a_shipped_frame(rng: np.random.Generator, name: str) -> tuple[RodModel, oracle.OracleScene]:
    """A shipped frame cut about across its rods, all of them seen, without noise."""
    model = load_rod_model(name)
    frame = frame_of(model)
    upright = Rotation.align_vectors([[0, 0, 1]], [np.linalg.svd(model.directions)[2][0]])[0]
    s = np.array(ANISOTROPIC)
    while True:
        R = (Rotation.from_rotvec(rng.normal(size=3) * [0.15, 0.15, 1]) * upright).as_matrix()
        t = np.array([90.0, 120.0, rng.normal() * 0.15 * model.size_mm]) - R @ model.centre
        hits = [oracle.cross_rod(a, b, R, t) for a, b in zip(frame.starts, frame.ends, strict=True)]
        spots = np.array([hit[0] / s for hit in hits if hit is not None])
        if len(spots) == len(model):
            break
    rods = np.arange(len(model))
    world = oracle.OracleScene(
        R=R, t=t, uv_px=spots, sd_px=0.0, rod_of_spot=rods, mm_per_px=s, bound=np.eye(6), visible=rods.tolist()
    )
    return model, world


@pytest.mark.parametrize("known", [True, False], ids=["scale-known", "scale-free"])
@pytest.mark.parametrize("n", [4, 5, 6, 9, 12])
def test_exact_spots_give_the_exact_pose(n: int, known: bool) -> None:
    rng = np.random.default_rng(n)
    refused = 0
    for _ in range(15):
        model, world = labelled(rng, n)
        try:
            found = solve_labelled(model, world.uv_px, mm_per_px=world.mm_per_px if known else None)
        except SingularGeometryError:
            refused += 1  # four rods in one plane, or no way to tell two scales from four of them
            continue
        assert distance(found.T, world) < 1e-6
        nearest = np.abs(found.T - world.T).max(axis=(1, 2)).argmin()
        np.testing.assert_allclose(found.mm_per_px[nearest], ANISOTROPIC, rtol=1e-7)
    assert refused <= (6 if n == 4 else 0)


@pytest.mark.parametrize(
    ("name", "rank"),
    [("leksell-g-2-panel", 8), ("leksell-g-3-panel", 9), ("z-frame-z001", 9), ("plus-fcal-2.0", 9)],
)
@pytest.mark.parametrize("known", [True, False], ids=["scale-known", "scale-free"])
def test_rank_is_that_of_the_design_not_of_the_number_of_rods(name: str, rank: int, known: bool) -> None:
    rng = np.random.default_rng(8)
    for _ in range(8):
        model, world = over_a_shipped_frame(rng, name)
        found = solve_labelled(model, world.uv_px, mm_per_px=world.mm_per_px if known else None)
        assert found.rank == rank
        assert distance(found.T, world) < 1e-7


def test_noise_does_not_hide_a_rank_of_eight() -> None:
    rng = np.random.default_rng(9)
    for _ in range(8):
        model, world = over_a_shipped_frame(rng, "leksell-g-2-panel")
        noisy = world.uv_px + rng.normal(size=world.uv_px.shape) * 0.3
        found = solve_labelled(model, noisy, mm_per_px=world.mm_per_px, noise_px=0.3)
        assert found.rank == 8
        assert distance(found.T, world) < 8.0  # a start; a plain least squares is hundreds of mm off


def test_the_order_of_the_rods_does_not_matter() -> None:
    rng = np.random.default_rng(10)
    model, world = labelled(rng, 6)
    order = rng.permutation(6)
    first = solve_labelled(model, world.uv_px, mm_per_px=world.mm_per_px).T
    again = solve_labelled(model.subset(order.tolist()), world.uv_px[order], mm_per_px=world.mm_per_px).T
    np.testing.assert_allclose(again, first, atol=1e-9)


def test_poses_scale_with_the_units() -> None:
    model, world = labelled(np.random.default_rng(11), 6)
    frame = frame_of(model)
    larger = model_of(oracle.OracleFrame(frame.starts * 1000, frame.ends * 1000))
    T = solve_labelled(model, world.uv_px, mm_per_px=world.mm_per_px).T[0]
    T_larger = solve_labelled(larger, world.uv_px, mm_per_px=world.mm_per_px * 1000).T[0]
    np.testing.assert_allclose(T_larger[:3, :3], T[:3, :3], atol=1e-9)
    np.testing.assert_allclose(T_larger[:3, 3], T[:3, 3] * 1000, rtol=1e-9)


@pytest.mark.parametrize("n", [3, 4, 6])
def test_a_mirrored_slice_is_the_frame_turned_over_never_a_mirrored_frame(n: int) -> None:
    rng = np.random.default_rng(12)
    for _ in range(20):
        model, world = labelled(rng, n)
        mirrored = world.uv_px * [-1, 1]
        turned = np.diag([-1.0, 1.0, -1.0, 1.0]) @ world.T
        try:
            found = solve_labelled(model, mirrored, mm_per_px=world.mm_per_px)
        except SingularGeometryError:
            continue
        np.testing.assert_allclose(np.linalg.det(found.T[:, :3, :3]), 1, atol=1e-9)
        assert np.abs(found.T - turned).max(axis=(1, 2)).min() < 1e-4


def rods(starts: list[list[float]], ends: list[list[float]]) -> RodModel:
    return model_of(oracle.OracleFrame(np.array(starts, dtype=float), np.array(ends, dtype=float)))


SQUARE = [[0.0, 0.0, 0.0], [30.0, 0.0, 0.0], [30.0, 30.0, 0.0], [0.0, 30.0, 0.0], [10.0, 20.0, 0.0]]
PARALLEL = rods(SQUARE, [[x, y, 40.0] for x, y, _ in SQUARE])
PANEL = rods([[0, 0, 0], [10, 0, 0], [20, 0, 0], [30, 0, 0]], [[5, 0, 40], [10, 0, 40], [25, 0, 40], [20, 0, 40]])


@pytest.mark.parametrize(
    ("model", "words"), [(PARALLEL, "parallel"), (PANEL, "one plane"), (PARALLEL.subset([0, 1, 2]), "parallel")]
)
def test_singular_rods_are_refused_in_words(model: RodModel, words: str) -> None:
    uv = np.random.default_rng(13).uniform(0, 100, (len(model), 2))
    with pytest.raises(SingularGeometryError, match=words):
        solve_labelled(model, uv, mm_per_px=np.ones(2))


def test_too_little_is_refused_in_words() -> None:
    model, world = labelled(np.random.default_rng(14), 5)
    with pytest.raises(SingularGeometryError, match="3 labelled spots, but at least 4"):
        solve_labelled(model.subset([0, 1, 2]), world.uv_px[:3], mm_per_px=None)
    with pytest.raises(SingularGeometryError, match="one point"):
        solve_labelled(model, np.full((5, 2), 7.0), mm_per_px=world.mm_per_px)


def test_scene_and_solver_disagree_about_a_wrong_label() -> None:
    """The laws above could fail: exchanged labels give another pose."""
    world = some_scene(np.random.default_rng(15), frame := oracle.random_frame(np.random.default_rng(16), 6), sd_px=0)
    order = [int(i) for i in world.rod_of_spot]
    order[0], order[1] = order[1], order[0]
    found = solve_labelled(model_of(frame).subset(order), world.uv_px, mm_per_px=world.mm_per_px)
    assert distance(found.T, world) > 1.0
