"""The rod model: its stacked arrays belong to its rods, its size to its shape, and nonsense is refused."""

from __future__ import annotations

import numpy as np
import pytest

from ctreg_cli.arrays import frozen
from ctreg_cli.errors import RodModelError
from ctreg_cli.rods import Rod, RodModel
from tests.geometry.sampling import random_pose


def model_of(starts: np.ndarray, ends: np.ndarray) -> RodModel:
    rods = (
        Rod(id=f"r{i}", start=frozen(start, (3,)), end=frozen(end, (3,)), tolerance_mm=0.1 * i)
        for i, (start, end) in enumerate(zip(starts, ends, strict=True))
    )
    return RodModel(name="test", rods=tuple(rods))


@pytest.fixture
def ends() -> tuple[np.ndarray, np.ndarray]:
    start, end = np.random.default_rng(5).normal(scale=40, size=(2, 6, 3))
    return start, end


def test_arrays_describe_the_rods_in_order(ends: tuple[np.ndarray, np.ndarray]) -> None:
    model = model_of(*ends)
    assert len(model) == 6
    assert model.ids == ("r0", "r1", "r2", "r3", "r4", "r5")
    np.testing.assert_allclose(model.ends, ends[1], atol=1e-12)
    np.testing.assert_allclose(model.starts + model.lengths[:, None] * model.directions, ends[1], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(model.directions, axis=1), 1)
    np.testing.assert_allclose(np.cross(ends[1], model.directions), model.moments, atol=1e-11)
    np.testing.assert_allclose(model.tolerances, [0, 0.1, 0.2, 0.3, 0.4, 0.5])


def test_size_and_centre_move_with_the_frame(ends: tuple[np.ndarray, np.ndarray]) -> None:
    T = random_pose(np.random.default_rng(6), spread_mm=500)
    model = model_of(*ends)
    moved = model_of(*(points @ T[:3, :3].T + T[:3, 3] for points in ends))
    assert moved.size_mm == pytest.approx(model.size_mm, rel=1e-12)
    np.testing.assert_allclose(moved.centre, T[:3, :3] @ model.centre + T[:3, 3], atol=1e-10)
    assert model_of(3 * ends[0], 3 * ends[1]).size_mm == pytest.approx(3 * model.size_mm)


def test_size_of_a_known_shape() -> None:
    """Four uprights on a square of side 2, height 2: every end is √3 from the centre."""
    corners = np.array([[1, 1, -1], [1, -1, -1], [-1, -1, -1], [-1, 1, -1]], dtype=float)
    model = model_of(corners, corners + np.array([0, 0, 2]))
    assert model.size_mm == pytest.approx(np.sqrt(3))
    np.testing.assert_allclose(model.centre, 0, atol=1e-15)


def test_a_subset_keeps_its_rods(ends: tuple[np.ndarray, np.ndarray]) -> None:
    model = model_of(*ends)
    part = model.subset([4, 0, 2])
    assert part.ids == ("r4", "r0", "r2")
    np.testing.assert_array_equal(part.starts, model.starts[[4, 0, 2]])
    np.testing.assert_array_equal(part.tolerances, model.tolerances[[4, 0, 2]])
    with pytest.raises(RodModelError, match="at least 3"):
        model.subset([0, 1])


def test_arrays_cannot_be_changed(ends: tuple[np.ndarray, np.ndarray]) -> None:
    model = model_of(*ends)
    for name in ("starts", "directions", "moments", "lengths", "tolerances", "centre"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(model, name)[0] = 0.0


def test_nonsense_is_refused(ends: tuple[np.ndarray, np.ndarray]) -> None:
    start, end = ends
    with pytest.raises(RodModelError, match="2 rods"):
        model_of(start[:2], end[:2])
    same = end.copy()
    same[3] = start[3]
    with pytest.raises(RodModelError, match="r3 has no length"):
        model_of(start, same)
    broken = end.copy()
    broken[1, 2] = np.nan
    with pytest.raises(RodModelError, match="finite"):
        model_of(start, broken)
    rods = model_of(start, end).rods
    with pytest.raises(RodModelError, match="differ"):
        RodModel(name="twice", rods=(*rods, rods[0]))
