"""What is said of several poses that explain the spots: the odds of all rivals together decide."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ctreg_cli.arrays import frozen, frozen_index
from ctreg_cli.geometry import pose as poses
from ctreg_cli.imaging.spots import Spots
from ctreg_cli.io.rod_file import load_rod_model
from ctreg_cli.registration.linearity import MOST_WRONG_P, Valley
from ctreg_cli.registration.refine import model_without_tolerance
from ctreg_cli.registration.register import RIVAL_LOG_ODDS, accepted_log_odds, doubts_and_rivals, register, untold_p
from ctreg_cli.registration.result import Candidate
from ctreg_cli.registration.twins import Twin
from ctreg_cli.scale import Scale
from tests.oracle import cross_rods, twist_error


def candidate(
    log_odds: float, *, turn_deg: float = 0.0, sd_deg: float = 0.1, spots: tuple[int, ...] = (0, 1, 2, 3, 4, 5)
) -> Candidate:
    """A pose turned about x, with as many matches as spots."""
    T = poses.make_pose(poses.exp_rotation(np.array([math.radians(turn_deg), 0, 0])), np.zeros(3))
    variance = np.array([0.01, 0.01, 0.01, *(3 * [math.radians(sd_deg) ** 2])])
    return Candidate(
        T_slice_model=frozen(T, (4, 4)),
        covariance=frozen(np.diag(variance), (6, 6)),
        rod_index=frozen_index(np.arange(len(spots))),
        spot_index=frozen_index(np.array(spots)),
        residual_px=frozen(np.zeros((len(spots), 2)), (None, 2)),
        lambda_mm=frozen(np.ones(len(spots)), (None,)),
        missing_rods=frozen_index([]),
        rms_px=0.0,
        chi2=1.0,
        degrees_of_freedom=2 * len(spots) - 6,
        log_odds=log_odds,
    )


def test_a_rival_counts_by_its_odds() -> None:
    best = candidate(20.0)
    near = candidate(20.0 - RIVAL_LOG_ODDS + 0.1, turn_deg=30)
    far = candidate(20.0 - RIVAL_LOG_ODDS - 0.1, turn_deg=30)
    assert doubts_and_rivals([best, near]) == ([], [near])
    assert doubts_and_rivals([best, far]) == ([], [])


def test_rivals_too_improbable_alone_count_together_if_they_are_several_poses() -> None:
    best = candidate(20.0)
    half = 20.0 - RIVAL_LOG_ODDS - 0.5 * math.log(2)
    one, other, again = candidate(half, turn_deg=30), candidate(half, turn_deg=-30), candidate(half, turn_deg=30.1)
    assert doubts_and_rivals([best, one, other]) == ([], [one, other])
    assert doubts_and_rivals([best, one, again]) == ([], [])


def test_a_vague_pose_cannot_swallow_a_sharp_one() -> None:
    """Within six sd of the best, but the best is beyond six of *its* sd: were it the truth, ``ok`` would be wrong."""
    best = candidate(20.0, sd_deg=5.0)
    sharp = candidate(18.0, turn_deg=10, sd_deg=0.5)
    vague = candidate(18.0, turn_deg=10, sd_deg=5.0)
    assert doubts_and_rivals([best, sharp]) == ([], [sharp])
    assert doubts_and_rivals([best, vague]) == ([vague], [])


def test_another_frame_of_other_spots_is_a_rival_whatever_its_odds() -> None:
    best = candidate(60.0)
    second = candidate(30.0, turn_deg=30, spots=(6, 7, 8, 9, 10, 11))
    of_the_same = candidate(30.0, turn_deg=30, spots=(5, 7, 8, 9, 10, 11))
    chance = candidate(10.0, turn_deg=30, spots=(6, 7, 8, 9, 10, 11))
    assert doubts_and_rivals([best, second]) == ([], [second])
    assert doubts_and_rivals([best, of_the_same]) == ([], [])
    assert doubts_and_rivals([best, chance]) == ([], [])


def test_what_a_doubt_leaves_untold_counts_by_its_probability() -> None:
    """A variant of the match for which no covariance is true: with what probability is it so, and matters?"""
    best, told = candidate(20.0), Valley(np.eye(6), 1.0, 0.0)
    flat, bent = Valley(None, math.inf, 1.0), Valley(None, math.inf, 0.03)
    for behind, valley in ((1.0, flat), (4.5, flat), (0.0, bent), (1.0, told)):
        p = math.exp(-behind) / (1 + math.exp(-behind))
        expected = 0.0 if valley is told else p * valley.wrong_p
        assert untold_p(best, [candidate(20.0 - behind)], [valley]) == pytest.approx(expected)
    assert untold_p(best, [], []) == 0.0
    assert untold_p(best, [candidate(19.0), candidate(19.0)], [flat, flat]) > MOST_WRONG_P
    assert untold_p(best, [candidate(15.5), candidate(15.5)], [flat, told]) < MOST_WRONG_P


def test_a_single_spot_does_not_turn_a_symmetric_frame_round() -> None:
    """Whatever its odds: the twin's matches are the image of the best's, but for one spot that it leaves over."""
    half_turn = Twin(transform=np.diag([-1.0, -1.0, 1.0, 1.0]), image=np.arange(6)[::-1].copy())
    best = candidate(20.0, spots=(0, 1, 2, 3, 4, 5))
    behind = 20.0 - RIVAL_LOG_ODDS - 1
    twin = candidate(behind, turn_deg=180, spots=(5, 4, 3, 2, 1))
    unlike = candidate(behind, turn_deg=180, spots=(1, 4, 2, 3, 5))
    needs_two = candidate(behind, turn_deg=180, spots=(5, 4, 3, 2))
    assert doubts_and_rivals([best, twin], (half_turn,)) == ([], [twin])
    for rival in (unlike, needs_two):
        assert doubts_and_rivals([best, rival], (half_turn,)) == ([], [])
    assert doubts_and_rivals([best, twin]) == ([], [])


@pytest.mark.parametrize("matches", [4, 5, 9])
def test_more_is_asked_among_more_clutter_and_of_four_matches(matches: int) -> None:
    asked = [accepted_log_odds(matches, matches + free) for free in range(40)]
    assert all(b >= a for a, b in itertools.pairwise(asked))
    assert asked[-1] > asked[0] >= math.log(100)
    assert accepted_log_odds(4, 4) > accepted_log_odds(5, 5)


@pytest.mark.parametrize("seed", [107, 337, 606, 1248])
def test_rods_hidden_together_do_not_decide_between_two_poses_of_four_spots(seed: int) -> None:
    """Two panels, two rods hidden: one of the poses has these beyond their ends, and seems to miss none."""
    rng = np.random.default_rng(seed)
    model = model_without_tolerance(load_rod_model("leksell-g-2-panel"))
    assert model.mount is not None
    R = Rotation.from_rotvec(rng.normal(size=3) * 0.15).as_matrix() @ np.asarray(model.mount.patient_from_model)
    t = np.array([200, 200, rng.uniform(-40, 40)]) - R @ model.centre
    uv = cross_rods(model.starts, model.ends, R, t) / 0.8
    uv = uv[np.sort(rng.choice(len(uv), 4, replace=False))]
    uv += rng.normal(size=uv.shape) * 0.02
    result = register(Spots.from_points(uv, 0.02), model, scale=Scale(s_x=0.8, s_y=0.8))
    assert result.status == "ambiguous"
    turned = [twist_error(c.T_slice_model[:3, :3], c.T_slice_model[:3, 3], R, t)[3:] for c in result.candidates]
    assert min(np.linalg.norm(turned, axis=1)) < math.radians(2.0)
