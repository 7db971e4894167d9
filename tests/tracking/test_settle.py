"""What the past says of matches: the same as a Kalman filter where all is linear, and what it may settle."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from ctreg_cli.geometry import pose as poses
from ctreg_cli.imaging.spots import Spots
from ctreg_cli.registration.matching import Matches, Scene, join, observations, weigh
from ctreg_cli.registration.options import RegistrationOptions
from ctreg_cli.registration.register import make_scene, refined_candidates
from ctreg_cli.registration.twins import Twin
from ctreg_cli.rods import RodModel
from ctreg_cli.scale import Scale
from ctreg_cli.tracking import settle
from ctreg_cli.tracking.prior import PastPrior, Weighed, most_probable
from tests.oracle import OracleFrame, cross_line, random_frame
from tests.tracking.sequences import model_of

SCALE = Scale(s_x=0.5, s_y=0.5)


@dataclass
class Expected:
    """A prediction: all that a prior asks of it."""

    T: np.ndarray
    covariance: np.ndarray
    dt_s: float = 0.4
    n_slices: int = 1


def pose_of(frame: OracleFrame, rng: np.random.Generator) -> np.ndarray:
    T = poses.update(np.eye(4), np.concatenate([np.zeros(3), rng.normal(size=3) * np.array([0.1, 0.1, 1.0])]))
    middle = (frame.starts + frame.ends).mean(axis=0) / 2
    T[:3, 3] = np.array([120.0, 120.0, 1.0]) - T[:3, :3] @ middle
    return T


def seen(frame: OracleFrame, T: np.ndarray, rng: np.random.Generator, sd_px: float) -> tuple[RodModel, Spots, Scene]:
    uv = np.array([cross_line(a, b, T[:3, :3], T[:3, 3]) for a, b in zip(frame.starts, frame.ends, strict=True)]) / 0.5
    model, spots = model_of(frame), Spots.from_points(uv + sd_px * rng.normal(size=uv.shape), sd_px)
    return model, spots, make_scene(spots, model, SCALE, options=RegistrationOptions())


def match(model: RodModel, scene: Scene, T: np.ndarray, spot_of_rod: np.ndarray) -> Matches:
    found = weigh(model, scene, T[None], spot_of_rod[None], 3)
    assert found is not None
    return found


def covariance(mm: float, deg: float) -> np.ndarray:
    return np.diag(np.repeat([mm, np.radians(deg)], 3) ** 2)


@pytest.mark.parametrize("seed", range(4))
def test_the_most_probable_pose_is_that_of_a_kalman_filter_where_all_is_linear(seed: int) -> None:
    rng = np.random.default_rng(seed)
    frame = random_frame(rng, 8)
    T = pose_of(frame, rng)
    model, _, scene = seen(frame, T, rng, 0.01)
    matches = match(model, scene, T, np.arange(8))
    C = np.linalg.inv(matches.fit.normal_equations()[0][0])
    P = covariance(0.01, 0.03)
    T_predicted = poses.update(T, rng.normal(size=6) * np.sqrt(np.diag(P)))
    found = most_probable(model, observations(scene, matches.spot_of_rod), T_predicted, P)
    step = P @ np.linalg.solve(P + C, poses.difference(matches.T[0], T_predicted))
    assert found.found[0]
    apart = poses.difference(found.T[0], poses.update(T_predicted, step))
    np.testing.assert_allclose(apart / np.sqrt(np.diag(C)), 0, atol=0.02)
    both = np.linalg.inv(np.linalg.inv(P) + np.linalg.inv(C))
    unit = np.sqrt(np.diag(both))
    np.testing.assert_allclose(found.covariance[0] / np.outer(unit, unit), both / np.outer(unit, unit), atol=0.05)


@pytest.mark.parametrize("seed", range(4))
def test_odds_are_the_same_whichever_pose_the_ellipsoid_is_drawn_about(seed: int) -> None:
    """Linear: averaging the past over what the spots leave open, or both about the most probable pose, is one."""
    rng = np.random.default_rng(seed)
    frame = random_frame(rng, 8)
    T = pose_of(frame, rng)
    model, _, scene = seen(frame, T, rng, 0.01)
    matches = match(model, scene, T, np.arange(8))
    expected = Expected(poses.update(T, rng.normal(size=6) * 1e-4), covariance(0.02, 0.05))
    prior = PastPrior.of(model, scene, expected)
    nearby = most_probable(model, observations(scene, matches.spot_of_rod), prior.T, prior.covariance)
    C = np.linalg.inv(matches.fit.normal_equations()[0][0])
    alone = prior.log_density(matches.T[0], C) - 0.5 * float(matches.fit.chi2[0])
    there = float(prior._log_density_nearby(nearby)[0]) - 0.5 * float(nearby.fit.chi2[0])
    assert alone == pytest.approx(there, abs=0.05)


@pytest.mark.parametrize(("deg", "settled"), [(0.3, True), (20.0, False)], ids=["certain", "vague"])
def test_a_rival_counts_by_where_it_puts_the_frame_with_the_past_taken_in(deg: float, settled: bool) -> None:
    """Two spots exchanged move the spots' own pose; a past that leaves no room for that reconciles the two."""
    rng = np.random.default_rng(3)
    frame = random_frame(rng, 6)
    T = pose_of(frame, rng)
    model, _, scene = seen(frame, T, rng, 0.3)
    order = np.arange(6)
    swapped = order.copy()
    gap = np.linalg.norm(scene.xy_mm[:, None] - scene.xy_mm[None], axis=2) + 99 * np.eye(6)
    i, j = np.unravel_index(int(gap.argmin()), gap.shape)
    swapped[[i, j]] = j, i
    both = join([match(model, scene, T, order), match(model, scene, T, swapped)])
    weighed = PastPrior.of(model, scene, Expected(T, covariance(deg / 3, deg))).applied(model, scene, both)
    assert (weighed.matches.spot_of_rod[0] == order).all()
    rows = (weighed.matches.spot_of_rod == swapped).all(axis=1)
    assert settle.reconciled(weighed)[rows].all() == settled


def test_a_match_that_hangs_on_one_spot_is_opposed_by_the_one_without_it_until_it_is_well_supported() -> None:
    rng = np.random.default_rng(5)
    frame = random_frame(rng, 7)
    T = pose_of(frame, rng)
    model, spots, _ = seen(frame, T, rng, 0.05)
    off = spots.uv_px.copy()
    off[0] += 3.0  # a spot that is no rod's, and moves the pose
    spots = Spots.from_points(off, 0.05)
    scene = make_scene(spots, model, SCALE, options=RegistrationOptions())
    less = np.array([-1, 1, 2, 3, 4, 5, 6])
    both = join([match(model, scene, T, np.arange(7)), match(model, scene, T, less)])
    best = (both.spot_of_rod >= 0).all(axis=1)
    for behind, opposed in ((3.0, True), (8.0, True), (9.5, False), (11.0, False)):
        odds = np.where(best, 30.0, 30.0 - behind)
        as_if = Matches(T=both.T, spot_of_rod=both.spot_of_rod, log_odds=odds, fit=both.fit, expected=both.expected)
        weighed = Weighed.alone(model, as_if.subset(np.argsort(-odds)))
        candidate = refined_candidates(model, scene, spots, SCALE, weighed.matches)[0]
        candidate = replace(candidate, covariance=weighed.covariance[0])  # not widened for its bad fit
        assert settle.opposing(model, weighed, candidate).tolist() == [False, opposed]
        # the pose without the spot is covered, unless that is out of the question
        apart = poses.difference(weighed.matches.T[1], candidate.T_slice_model)
        wide = settle.covering(model, weighed, candidate).covariance
        assert apart @ np.linalg.solve(candidate.covariance, apart) > 36
        assert (apart @ np.linalg.solve(wide, apart) < 3) == (behind < 10)


def test_the_other_way_round_is_more_probable_than_anywhere_else() -> None:
    rng = np.random.default_rng(6)
    frame = random_frame(rng, 6)
    T = pose_of(frame, rng)
    model, _, scene = seen(frame, T, rng, 0.1)
    turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    twin = Twin(transform=turn, image=np.arange(6))
    C = covariance(0.05, 0.1)
    with_it, without = (PastPrior.of(model, scene, Expected(T, C), twins) for twins in ((twin,), ()))
    assert with_it.log_density(T @ turn, C) > without.log_density(T @ turn, C) + 5
    assert with_it.log_density(T, C) == pytest.approx(without.log_density(T, C), abs=1e-6)
    elsewhere = poses.update(T, np.array([9.0, 9.0, 0, 0, 0, 2.0]))
    assert with_it.log_density(elsewhere, C) == pytest.approx(without.log_density(elsewhere, C), abs=0.1)
