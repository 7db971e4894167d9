"""Frames of which a part is its own image: a slice that shows that part alone has another pose."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ctreg_cli.design.symmetry import partial_symmetries
from ctreg_cli.geometry import pose as poses
from ctreg_cli.io.rod_file import load_rod_model
from ctreg_cli.registration.matching import weigh
from ctreg_cli.registration.twins import partial_twins, twins, with_twins
from ctreg_cli.rods import RodModel
from tests.oracle import OracleFrame, OracleScene, random_frame
from tests.registration.frames import model_of, scene_of, some_scene, true_match


def of_two_panels(seed: int, *, mirrored: bool = False) -> tuple[OracleScene, RodModel, np.ndarray]:
    """A frame of five rods and the same five elsewhere, and two odd ones; a slice of the first; the motion."""
    rng = np.random.default_rng([945, seed])
    panel = random_frame(rng, 5)
    world = some_scene(rng, panel, sd_px=0.1, least=5, false=2)
    S = np.eye(4)
    S[:3, :3] = Rotation.from_rotvec(0.8 * rng.normal(size=3)).as_matrix() @ np.diag([-1.0 if mirrored else 1.0, 1, 1])
    S[:3, 3] = 20.0 * rng.normal(size=3) + [0, 0, 200]
    other = random_frame(rng, 5)
    starts = [panel.starts, panel.starts @ S[:3, :3].T + S[:3, 3], other.starts[:2] - [0, 0, 250]]
    ends = [panel.ends, panel.ends @ S[:3, :3].T + S[:3, 3], other.ends[:2] - [0, 0, 250]]
    return world, model_of(OracleFrame(np.concatenate(starts), np.concatenate(ends))), S


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_the_motion_between_two_panels_is_found_both_ways(seed: int, mirrored: bool) -> None:
    _, model, S = of_two_panels(seed, mirrored=mirrored)
    found = partial_symmetries(model, within_mm=0.01 * model.size_mm, least=5, mirrored=mirrored)
    images = {tuple(image.tolist()): T for T, image in found}
    # all ten rods may be mapped at once only if the motion is its own inverse
    there = (*range(5, 10), *7 * [-1])
    back = (*5 * [-1], *range(5), -1, -1)
    np.testing.assert_allclose(images[there], S, atol=1e-9 * model.size_mm)
    np.testing.assert_allclose(images[back], np.linalg.inv(S), atol=1e-9 * model.size_mm)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_spots_of_one_panel_are_seen_as_the_other_s_too(seed: int, mirrored: bool) -> None:
    world, model, _ = of_two_panels(seed, mirrored=mirrored)
    scene, true = scene_of(world, model), true_match(world, model)
    one = weigh(model, scene, poses.make_pose(world.R, world.t)[None], true[None], 5)
    assert one is not None
    both = with_twins(model, scene, one, 5)
    other = np.concatenate([np.full(5, -1), true[:5], [-1, -1]])
    rows = np.flatnonzero((both.spot_of_rod == other).all(axis=1))
    assert len(rows)
    assert both.log_odds[rows].max() > one.log_odds[0] - 2


def test_panels_of_shipped_boxes_are_known_to_be_alike() -> None:
    micromar = load_rod_model("micromar-tm-03b")
    images = [twin.image.tolist() for twin in partial_twins(micromar)]
    assert [-1, -1, -1, 8, 7, 6, 5, 4, 3] in images
    for twin in partial_twins(micromar):
        mapped = twin.image >= 0
        assert mapped.sum() >= 5
        ends = np.stack([micromar.starts, micromar.ends], axis=1)
        moved = ends[mapped] @ twin.transform[:3, :3].T + twin.transform[:3, 3]
        there = ends[twin.image[mapped]]
        off = np.minimum(np.abs(moved - there).max(axis=(1, 2)), np.abs(moved - there[:, ::-1]).max(axis=(1, 2)))
        assert off.max() < 0.02 * micromar.size_mm + 1e-6
    assert not {twin.image.tobytes() for twin in twins(micromar)} & {t.image.tobytes() for t in partial_twins(micromar)}
