"""The public door: spots of one slice and a rod model in, a verdict out."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from statistics import median

import numpy as np
from scipy.special import chdtrc

from ctreg_cli.arrays import FloatArray, IntArray, frozen, frozen_index
from ctreg_cli.geometry import pose as poses
from ctreg_cli.imaging.spots import Spots
from ctreg_cli.registration.doubt import doubt
from ctreg_cli.registration.elsewhere import solutions_without_a_spot
from ctreg_cli.registration.evidence import P_SEEN, PosePrior
from ctreg_cli.registration.integrity import LEAST_MATCHES as LEAST_PROTECTED
from ctreg_cli.registration.integrity import largest_sd, protection_levels, risk_of_each
from ctreg_cli.registration.linearity import MOST_WRONG_P, Valley, covariance_along_the_valley, positive_part
from ctreg_cli.registration.matching import Matches, Scene, is_second_frame, observations, search
from ctreg_cli.registration.misfit import covariance_with_misfit
from ctreg_cli.registration.options import RegistrationOptions
from ctreg_cli.registration.other_scale import LOOSE_SHARE, log_odds_of_other_scale, loose_matches
from ctreg_cli.registration.refine import (
    Linearisation,
    Observations,
    covariance_from_information,
    principal_axes,
    refine,
)
from ctreg_cli.registration.result import Candidate, Registration
from ctreg_cli.registration.twins import Twin, twins, with_twins
from ctreg_cli.rods import RodModel
from ctreg_cli.scale import Scale, check_scale

#: a match is believed when its odds against chance, and against all other matches that contradict it together, exceed
#: this (ln): chance is a rival like any other ...
ACCEPT_LOG_ODDS = math.log(100)
#: ... and more for each spot left over beyond a few: in dense clutter chance matches crowd up to what Markov's
#: inequality allows them, among few spots they stay far below (measured by benchmarks/accuracy.py, table ``clutter``)
ACCEPT_LOG_ODDS_PER_FREE_SPOT, FEW_FREE_SPOTS = 0.12, 6
#: four matches leave two equations to disagree: what the odds say of them rests on little, and more is asked
ACCEPT_LOG_ODDS_OF_FOUR = math.log(1e5)
#: rivals that together come within these ln odds of the best make the slice ambiguous (contract §5, where it is said of
#: one)
RIVAL_LOG_ODDS = math.log(100)
#: ... when their poses are farther off than this many standard deviations (contract §5)
RIVAL_SD = 6.0
#: translation and rotation in a twist
_PARTS = (slice(3), slice(3, 6))
#: rivals farther behind (ln odds) than this do not count
_NO_RIVAL_LOG_ODDS = 8.0
#: a fit with a smaller χ² probability is refused
BAD_FIT_P = 1e-4
#: spots beside the places of missing rods: refused when chance would put them so near less often than this
NEAR_MISS_P = 1e-3
#: a fit with a smaller χ² probability has its standard deviations widened
INFLATE_P = 1e-2
#: beyond this condition number (rotation in frame sizes) the weak direction is named in a warning
WEAK_CONDITION = 60.0
#: probability of a false match beyond which it is mentioned
_WORTH_SAYING = 1e-3
#: a rotation known no better than this (rad), or a place of the frame's centre no better than this many frame sizes, is
#: not known at all: the spots (parallel or coplanar rods) do not determine the pose, and no linear sd describes it
_UNKNOWN_ROTATION, _UNKNOWN_PLACE = 0.6, 0.25
#: ln odds that a frame is not its drawing, or the spots are worse than they say
_LOG_PRIOR_LOOSE = math.log(0.1)
#: ln odds that a frame is not on its mount
_LOG_PRIOR_OFF_MOUNT = math.log(0.01)
#: two crossings nearer than this share of the frame's size may leave one spot, where nothing tells how large spots are
_UNRESOLVED = 0.04
#: matches below which nothing can be checked: three spots always fit
LEAST_MATCHES = 4
#: spots or rods up to which a match of four is looked for
_FEW = 6


def pose_prior(model: RodModel, T_patient_slice: FloatArray | None, options: RegistrationOptions) -> PosePrior:
    """The mount of the frame file as a cone of rotations model → slice."""
    if model.mount is None or not options.use_mount:
        return _prior_of_rods(model)
    R = np.asarray(model.mount.patient_from_model, dtype=np.float64)
    if T_patient_slice is not None:
        R = T_patient_slice[:3, :3].T @ R
    return PosePrior(rotation=R, max_angle_rad=math.radians(model.mount.max_angle_deg))


@lru_cache(maxsize=16)
def _prior_of_rods(model: RodModel) -> PosePrior:
    """Cached, since a model is a value that never changes."""
    return PosePrior.of_rods(model.directions)


def make_scene(
    spots: Spots,
    model: RodModel,
    scale: Scale,
    *,
    T_patient_slice: FloatArray | None = None,
    thickness_mm: float | None = None,
    shape: tuple[int, int] | None = None,
    options: RegistrationOptions,
) -> Scene:
    """Spots in millimetres with all that bears on the pose."""
    s = scale.mm_per_px
    contrasts = spots.contrast.tolist()
    field = None
    if shape is not None:
        field = np.array(
            [[-0.5 * scale.s_x, -0.5 * scale.s_y], [(shape[1] - 0.5) * scale.s_x, (shape[0] - 0.5) * scale.s_y]]
        )
    return Scene(
        xy_mm=spots.uv_px * s,
        covariance_mm=spots.covariance_px * (s[:, None] * s),
        prior=pose_prior(model, T_patient_slice, options),
        brightness=spots.contrast if contrasts and all(map(math.isfinite, contrasts)) else None,
        half_slab_mm=0.5 * thickness_mm if thickness_mm is not None else 0.0,
        field_mm=field,
        resolved_mm=_resolved_mm(spots, model, scale),
    )


def _resolved_mm(spots: Spots, model: RodModel, scale: Scale) -> float:
    """Twice the width of a spot, as it is seen, or else as the rods are drawn, or a small part of the frame."""
    widths_px = spots.minor_px.tolist()
    if widths_px and all(map(math.isfinite, widths_px)):
        return float(median(widths_px)) * (scale.s_x + scale.s_y)
    diameters = [rod.diameter_mm for rod in model.rods if rod.diameter_mm]
    return 2 * max(diameters) if diameters else _UNRESOLVED * model.size_mm


def register(
    spots: Spots,
    model: RodModel,
    *,
    scale: Scale,
    T_patient_slice: FloatArray | None = None,
    thickness_mm: float | None = None,
    shape: tuple[int, int] | None = None,
    options: RegistrationOptions | None = None,
) -> Registration:
    """Pose of the frame from the unlabelled spots of one slice (Doignon et al. 2008, §2; and past it).

    Args:
        spots: spots of the slice, px.
        model: the rods, mm.
        scale: mm per pixel.
        T_patient_slice: (4, 4) slice → patient, where known: the frame's ``mount`` is then taken in patient axes.
        thickness_mm: slab thickness; a rod may leave a spot when the slab only touches it.
        shape: (rows, columns) of the image: a rod that crosses outside it is not missed.
        options: see :class:`RegistrationOptions`.

    Returns:
        The verdict. ``ok`` is said only when the match beats chance by more than :data:`ACCEPT_LOG_ODDS`, fits (χ²),
        leaves no more rods unexplained than it explains, no other pose comes within :data:`RIVAL_LOG_ODDS`, and a
        covariance describes what the spots leave open.

    Raises:
        MissingScaleError: the scale is None.
        InputError: the scale is no :class:`Scale`.
    """
    check_scale(scale)
    options = options or RegistrationOptions()
    scene = make_scene(
        spots, model, scale, T_patient_slice=T_patient_slice, thickness_mm=thickness_mm, shape=shape, options=options
    )
    if len(spots) < LEAST_MATCHES:
        return Registration(status="no_pose", reason="too_few_spots", n_spots=len(spots))
    least = least_matches(len(spots), len(model))
    matches = search(model, scene, least_matches=least)
    if matches is None:
        return Registration(status="no_pose", reason="no_consistent_match", n_spots=len(spots))
    matches = with_twins(model, scene, doubt(model, scene, matches, least_matches=least), least)
    return decide(model, scene, spots, scale, matches, options)


def least_matches(n_spots: int, n_rods: int) -> int:
    """How many matches to look for: one of four among many spots could never be believed."""
    return LEAST_MATCHES if min(n_spots, n_rods) <= _FEW else LEAST_MATCHES + 1


def protected(
    model: RodModel, scene: Scene, best: Candidate, options: RegistrationOptions, matches: Matches | None = None
) -> Candidate:
    """The candidate with its protection levels.

    ``matches``, where they are given, are what else was found; those whose odds the risk does not allow to be
    neglected lie within the levels.
    """
    risk, n = options.integrity_risk, len(best.rod_index)
    solutions: list[tuple[FloatArray, IntArray]] = []
    if n >= LEAST_PROTECTED:
        spot_of_rod = best.spot_of_rod(len(model))
        neglected_p = risk_of_each(risk, n)
        solutions.append(
            solutions_without_a_spot(
                model, scene, best.T_slice_model, spot_of_rod, neglected_p=neglected_p, inflation=best.inflation
            )
        )
        if matches is not None:
            rival = matches.log_odds > best.log_odds + math.log(risk)
            solutions.append((matches.T[rival], matches.spot_of_rod[rival]))
    level = protection_levels(
        model,
        best.T_slice_model,
        best.covariance,
        _seen_by(model, scene, best),
        [(T, observations(scene, spots)) for T, spots in solutions],
        risk,
        inflation=best.inflation,
        prior=scene.prior,
    )
    return replace(best, protection_mm=frozen(level, (None,)))


def _seen_by(model: RodModel, scene: Scene, candidate: Candidate) -> Observations:
    """The one hypothesis of a candidate's matches."""
    return observations(scene, candidate.spot_of_rod(len(model))[None])


def _seen_or_nearly(model: RodModel, scene: Scene, scale: Scale, best: Candidate) -> Observations:
    """A candidate's matches, and free spots beside the places of rods it misses."""
    spot_of_rod = best.spot_of_rod(len(model))[None]
    free = np.setdiff1d(np.arange(len(scene.xy_mm)), best.spot_index)
    for rod, place_mm in zip(best.missing_rods, best.missing_px * scale.mm_per_px, strict=True):
        gap = np.linalg.norm(scene.xy_mm[free] - place_mm, axis=1)
        if len(free) and gap.min() < 2 * LOOSE_SHARE * model.size_mm:
            spot_of_rod[0, rod] = free[gap.argmin()]
            free = np.delete(free, gap.argmin())
    return observations(scene, spot_of_rod)


def _log_others(matches: Matches) -> float:
    """ln of the odds of chance (1) and of all matches that share less than half with the best, together.

    In dense clutter one chance match stands among many that are nearly as good.
    """
    best = matches.spot_of_rod[0]
    shared = ((matches.spot_of_rod == best) & (best >= 0)).sum(axis=1)
    others = matches.log_odds[2 * shared < (best >= 0).sum()]
    return float(np.log1p(np.exp(np.minimum(others, 50)).sum()))


def accepted_log_odds(n_matches: int, n_spots: int) -> float:
    """The ln odds that a match of so many of the slice's spots must exceed."""
    least = ACCEPT_LOG_ODDS if n_matches > LEAST_MATCHES else ACCEPT_LOG_ODDS_OF_FOUR
    return least + ACCEPT_LOG_ODDS_PER_FREE_SPOT * max(0, n_spots - n_matches - FEW_FREE_SPOTS)


def decide(
    model: RodModel,
    scene: Scene,
    spots: Spots,
    scale: Scale,
    matches: Matches,
    options: RegistrationOptions | None = None,
    *,
    frame_is_known: bool = False,
) -> Registration:
    """The verdict on a slice's matches, best first.

    Args:
        model: the rods.
        scene: the spots in millimetres, and what bears on the pose.
        spots: the spots, px.
        scale: mm per pixel.
        matches: all that could be said, best first.
        options: integrity risk and alert limit.
        frame_is_known: the slices before have shown that frame and scale are right, and the best match is where they
            expect it: what a wrong frame would make of the spots need not be looked for.
    """
    options = options or RegistrationOptions()
    first = matches.spot_of_rod[0]
    near = [
        odds > matches.log_odds[0] - _NO_RIVAL_LOG_ODDS or is_second_frame(first, other, odds)
        for other, odds in zip(matches.spot_of_rod, matches.log_odds, strict=True)
    ]
    candidates = refined_candidates(model, scene, spots, scale, matches.subset(np.array(near)))
    best = candidates[0]

    def refused(reason: str) -> Registration:
        return Registration(status="no_pose", reason=reason, n_spots=len(spots))

    if len(best.rod_index) < len(best.missing_rods):
        return refused("no_consistent_match")
    if best.log_odds < accepted_log_odds(len(best.rod_index), len(spots)):
        return refused("no_consistent_match")
    if chdtrc(best.degrees_of_freedom, best.chi2) < BAD_FIT_P:
        return refused("bad_fit")
    if near_misses_p(scene, scale, best) < NEAR_MISS_P:
        return refused("bad_fit")
    if undetermined(model, best.T_slice_model, best.covariance):
        return refused("singular_geometry")
    if not frame_is_known and _fits_better_loosely(model, scene, best):
        return refused("bad_fit")
    doubts, rivals = doubts_and_rivals(candidates, twins(model))
    if not frame_is_known:
        rivals += _rivals_off_the_mount(model, scene, spots, scale, best)
    if not rivals and best.log_odds - _log_others(matches) < accepted_log_odds(len(best.rod_index), len(spots)):
        return refused("no_consistent_match")
    warnings: list[tuple[str, str]] = []
    valley, *others = (_valley(model, scene, c) for c in (best, *doubts))
    if valley.covariance is None or untold_p(best, doubts, others) > MOST_WRONG_P:
        return Registration(
            status="ambiguous", reason="not_linear", candidates=(best, *rivals), n_spots=len(spots), warnings=()
        )
    if valley.covariance is not best.covariance:
        best = _told(best, valley)
        warnings.append(
            (
                "curved_cost",
                f"the cost is no ellipsoid along its weakest direction; sd widened {valley.factor:.2f} times",
            )
        )
    doubts = [_told(c, other) for c, other in zip(doubts, others, strict=True)]
    covariance, suspicion = covariance_with_misfit(
        model, best.T_slice_model, best.covariance, _seen_or_nearly(model, scene, scale, best)
    )
    if covariance is None or (suspicion and not frame_is_known and _fits_better_turned(model, scene, best)):
        return refused("bad_fit")
    if suspicion:
        best = replace(best, covariance=frozen(covariance, (6, 6)))
        warnings.append(("misfit", suspicion))
    best, share = averaged(best, doubts)
    if share > _WORTH_SAYING:
        warnings.append(
            ("averaged", f"a match may be false (probability {share:.2g}); sd widened to cover the pose without it")
        )
    if undetermined(model, best.T_slice_model, best.covariance):  # as it is widened by now
        return refused("singular_geometry")
    best = protected(model, scene, best, options, matches)
    if options.alert_limit_mm is not None and not rivals and best.protection_mm.max() > options.alert_limit_mm:
        return refused("unprotected")
    warnings.extend(fit_warnings(model, spots, best))
    if rivals:
        # all of them, also what the widened covariance would hold by now: they are why the slice is refused
        return Registration(
            status="ambiguous",
            reason="rival_pose",
            candidates=(best, *rivals),
            n_spots=len(spots),
            warnings=tuple(warnings),
        )
    return Registration(status="ok", reason="", candidates=(best,), n_spots=len(spots), warnings=tuple(warnings))


def _valley(model: RodModel, scene: Scene, c: Candidate) -> Valley:
    """Whether a candidate's covariance is true."""
    return covariance_along_the_valley(
        model, c.T_slice_model, c.covariance, _seen_by(model, scene, c), inflation=c.inflation, prior=scene.prior
    )


def _told(c: Candidate, valley: Valley) -> Candidate:
    """A candidate with the covariance that is true, where there is one."""
    if valley.covariance is None or valley.covariance is c.covariance:
        return c
    return replace(c, covariance=frozen(valley.covariance, (6, 6)))


def untold_p(best: Candidate, doubts: list[Candidate], valleys: list[Valley]) -> float:
    """The probability that one of the doubts is true, and lies where no covariance of its own tells of it."""
    weights = np.exp([c.log_odds - best.log_odds for c in doubts])
    untold = [valley.wrong_p if valley.covariance is None else 0.0 for valley in valleys]
    return float(weights @ untold / (1 + weights.sum())) if doubts else 0.0


def doubts_and_rivals(
    candidates: list[Candidate], symmetric: tuple[Twin, ...] = ()
) -> tuple[list[Candidate], list[Candidate]]:
    """What else explains the spots: variants of the best match that do not contradict it, and poses that do.

    The rivals are one of each pose, and none where all of them together are too improbable to count. A twin that
    explains all spots but one always counts: one false spot is all it takes to turn the frame round, and clutter comes
    in lines and grids, not as evenly as the odds have it.
    """
    best, others = candidates[0], candidates[1:]
    agrees = [_knows_less(c, best) or (pose_distance_sd(best, c) <= RIVAL_SD and not _refutes(c, best)) for c in others]
    near = best.log_odds - RIVAL_LOG_ODDS
    doubts = [c for c, agreed in zip(others, agrees, strict=True) if agreed and c.log_odds > near]
    rivals = _distinct_poses([c for c, agreed in zip(others, agrees, strict=True) if not agreed])
    weight = sum(math.exp(c.log_odds - best.log_odds) for c in rivals)
    second = any(is_second_frame(best.spot_index, c.spot_index, c.log_odds) for c in rivals)
    turned = any(_is_twin_but_for_a_spot(best, c, symmetric) for c in rivals)
    hidden = any(_misses_more_rods_only(best, c) for c in rivals)
    return doubts, rivals if second or turned or hidden or weight > math.exp(-RIVAL_LOG_ODDS) else []


def _misses_more_rods_only(best: Candidate, c: Candidate) -> bool:
    """Whether of the four or five spots that ``best`` rests on ``c`` makes as much, and only misses more rods.

    Rods are hidden together (behind an edge of the image, in a streak), not one by one as the odds have it; and of so
    few spots a pose has little left to be checked by.
    """
    if len(best.rod_index) > LEAST_PROTECTED or len(np.setdiff1d(best.spot_index, c.spot_index)) > 0:
        return False
    more = len(c.missing_rods) - len(best.missing_rods)
    return c.log_odds - more * math.log(1 - P_SEEN) > best.log_odds - RIVAL_LOG_ODDS


def _is_twin_but_for_a_spot(best: Candidate, c: Candidate, symmetric: tuple[Twin, ...]) -> bool:
    """Whether ``c`` is ``best`` seen in the frame's mirror, and only one spot tells the two apart."""
    if len(np.setdiff1d(best.spot_index, c.spot_index)) != 1:
        return False
    own = dict(zip(best.rod_index.tolist(), best.spot_index.tolist(), strict=True))
    other = zip(c.rod_index.tolist(), c.spot_index.tolist(), strict=True)
    same = [[own.get(int(twin.image[rod])) == spot for twin in symmetric] for rod, spot in other]
    return bool(symmetric) and max(map(sum, zip(*same, strict=True))) >= len(same) - 1


def near_misses_p(scene: Scene, scale: Scale, best: Candidate) -> float:
    """Probability that chance puts unmatched spots as near the places of missing rods as they are; 1 if none are
    missing.

    When spots are worse than they say, or the frame is not its drawing, a few of the rods can always be made to fit,
    and the others lie just beside their places. One such spot is forgiven (a streak, a neighbour moved it), two are a
    pattern: Fisher's method over the distances to the nearest free spot, the smallest left out.
    """
    if len(best.missing_rods) < 2:
        return 1.0
    free = np.setdiff1d(np.arange(len(scene.xy_mm)), best.spot_index)
    if len(free) == 0:
        return 1.0
    missing_mm = best.missing_px * scale.mm_per_px
    seen_mm = scene.xy_mm[best.spot_index]
    centre = np.concatenate([missing_mm, seen_mm]).mean(axis=0)
    reach = float(np.linalg.norm(np.concatenate([missing_mm, seen_mm]) - centre, axis=1).max())
    around = np.linalg.norm(scene.xy_mm[free] - centre, axis=1) <= 1.25 * reach
    density = max(int(around.sum()), 1) / (math.pi * (1.25 * reach) ** 2)
    gap = np.linalg.norm(scene.xy_mm[free][None] - missing_mm[:, None], axis=-1)
    # one spot answers for one rod only
    nearest: list[float] = []
    while min(gap.shape) and np.isfinite(gap.min()):
        rod, spot = np.unravel_index(int(gap.argmin()), gap.shape)
        nearest.append(float(gap[rod, spot]))
        gap[rod], gap[:, spot] = np.inf, np.inf
    p = -np.expm1(-density * math.pi * np.square(np.sort(nearest)[1:]))
    if len(p) == 0:
        return 1.0
    return float(chdtrc(2 * len(p), -2 * np.log(np.maximum(p, 1e-300)).sum()))


def _fits_better_loosely(model: RodModel, scene: Scene, best: Candidate) -> bool:
    """Whether more spots become rods once the spots (or the frame) may be a few percent off, or the scales.

    With a wrong scale or a frame that is not its drawing the true match does not fit, and a chance match of a few of
    its spots is what remains, or one that bends to fit most; it must not pass for the pose.
    """
    n = len(best.rod_index)
    n_free, n_missing = len(scene.xy_mm) - n, len(model) - n
    if min(n_free, n_missing) < 1:
        return False
    matches = loose_matches(model, scene, n + 1)
    if matches is None:
        return False
    many = min(n_free, len(best.missing_rods)) >= 2
    if many and float(matches.log_odds[0]) + _LOG_PRIOR_LOOSE > best.log_odds:
        return True
    spot_of_rod = best.spot_of_rod(len(model))
    return log_odds_of_other_scale(model, scene, best.T_slice_model, spot_of_rod, matches) > -RIVAL_LOG_ODDS


def _rivals_off_the_mount(
    model: RodModel, scene: Scene, spots: Spots, scale: Scale, best: Candidate
) -> list[Candidate]:
    """Poses that the mount rules out, and that explain more spots than the one it allows.

    A frame put on another way, or slices whose axes are not what the mount was given in, leave the cone without the
    true pose; a chance match of some of its spots is what remains there.
    """
    n = len(best.rod_index)
    if scene.prior.rotation is None or min(len(scene.xy_mm) - n, len(best.missing_rods)) < 1:
        return []
    anywhere = replace(scene, prior=_prior_of_rods(model))
    matches = search(model, anywhere, least_matches=n + 1)
    if matches is None:
        return []
    near = matches.log_odds + _LOG_PRIOR_OFF_MOUNT > best.log_odds - RIVAL_LOG_ODDS
    near &= ~scene.prior.allows(matches.T[:, :3, :3])
    if not near.any():
        return []
    found = refined_candidates(model, anywhere, spots, scale, matches.subset(near))
    return _distinct_poses([c for c in found if chdtrc(c.degrees_of_freedom, c.chi2) >= BAD_FIT_P])


def _fits_better_turned(model: RodModel, scene: Scene, best: Candidate) -> bool:
    """Whether other matches of as many spots fit as well with other scales: what a misfit of these may come from.

    A frame that is nearly its own image has such matches: with a wrong scale the wrong one can fit better.
    """
    spot_of_rod = best.spot_of_rod(len(model))
    loose = loose_matches(model, scene, len(best.rod_index))
    if loose is not None:
        loose = loose.subset((loose.spot_of_rod != spot_of_rod).any(axis=1))
    return log_odds_of_other_scale(model, scene, best.T_slice_model, spot_of_rod, loose) > -RIVAL_LOG_ODDS


def undetermined(model: RodModel, T: FloatArray, covariance: FloatArray) -> bool:
    """Whether some direction of the pose is not known at all, in the place of the frame's centre or in its rotation."""
    rotation = math.sqrt(max(float(np.linalg.eigvalsh(covariance[3:, 3:])[-1]), 0.0))
    arm = T[:3, :3] @ model.centre
    return rotation > _UNKNOWN_ROTATION or float(largest_sd(covariance, arm)) > _UNKNOWN_PLACE * model.size_mm


def fit_warnings(model: RodModel, spots: Spots, best: Candidate) -> tuple[tuple[str, str], ...]:
    """What a user should know of an accepted pose."""
    warnings: list[tuple[str, str]] = []
    if best.inflation > 1:
        warnings.append(
            ("inflated", f"spots lie farther off than their sd allows; sd widened {best.inflation:.2f} times")
        )
    weak = weakness(model, best.covariance)
    if weak:
        warnings.append(("weak_geometry", weak))
    if spots.sd_assumed:
        warnings.append(("assumed_sd", "the spots came without sd; the covariance rests on an assumed one"))
    return tuple(warnings)


def _distinct_poses(candidates: list[Candidate]) -> list[Candidate]:
    """One of each pose, best first."""
    kept: list[Candidate] = []
    for c in candidates:
        if all(pose_distance_sd(k, c) > RIVAL_SD for k in kept):
            kept.append(c)
    return kept


def refined_candidates(model: RodModel, scene: Scene, spots: Spots, scale: Scale, matches: Matches) -> list[Candidate]:
    """Matches refined to the last digit, with their covariances, in the contract's units."""
    T, fit, steps = refine(
        model, matches.T, observations(scene, matches.spot_of_rod), iterations=30, step_tolerance=1e-8
    )
    H, _ = fit.normal_equations()
    C, _ = covariance_from_information(H, model.size_mm)
    return [
        assemble_candidate(
            model,
            spots,
            scale,
            T[row],
            fit.subset(np.array([row])),
            matches.spot_of_rod[row],
            matches.expected[row],
            C[row],
            float(matches.log_odds[row]),
            steps,
        )
        for row in range(len(matches))
    ]


def assemble_candidate(
    model: RodModel,
    spots: Spots,
    scale: Scale,
    T: FloatArray,
    fit: Linearisation,
    spot_of_rod: IntArray,
    expected: np.ndarray[tuple[int, ...], np.dtype[np.bool_]],
    covariance: FloatArray,
    odds: float,
    steps: int,
) -> Candidate:
    """Put a one-hypothesis fit (in millimetres) into a :class:`Candidate` (in pixels)."""
    rods = np.nonzero(spot_of_rod >= 0)[0]
    missing = np.nonzero(expected & (spot_of_rod < 0))[0]
    residual = fit.residual_px[0, rods] / scale.mm_per_px
    dof = 2 * len(rods) - 6
    chi2 = float(fit.chi2[0])
    inflation = 1.0
    if dof > 0 and chdtrc(dof, chi2) < INFLATE_P:
        inflation = math.sqrt(chi2 / dof)
    return Candidate(
        T_slice_model=frozen(T, (4, 4)),
        covariance=frozen(covariance * inflation**2, (6, 6)),
        rod_index=frozen_index(rods),
        spot_index=frozen_index(spot_of_rod[rods]),
        residual_px=frozen(residual, (None, 2)),
        lambda_mm=frozen(fit.lambda_mm[0, rods], (None,)),
        missing_rods=frozen_index(missing),
        missing_px=frozen(fit.predicted_px[0, missing] / scale.mm_per_px, (None, 2)),
        rms_px=float(np.sqrt((residual**2).mean())) if len(rods) else 0.0,
        chi2=chi2,
        degrees_of_freedom=dof,
        log_odds=odds,
        inflation=inflation,
        iterations=steps,
    )


def _matches(c: Candidate) -> set[tuple[int, int]]:
    return set(zip(c.rod_index.tolist(), c.spot_index.tolist(), strict=True))


def _knows_less(c: Candidate, best: Candidate) -> bool:
    """Whether ``c`` is ``best`` with fewer matches, and does not contradict it: its wider covariance covers both."""
    if not _matches(c) < _matches(best):
        return False
    twist = poses.difference(c.T_slice_model, best.T_slice_model)
    both = np.linalg.pinv(best.covariance + c.covariance, hermitian=True)
    return float(twist @ both @ twist) <= RIVAL_SD**2


def _refutes(c: Candidate, best: Candidate) -> bool:
    """Whether ``best`` would be called wrong if ``c`` were the truth: more than six of its sd off, turned or moved."""
    twist = poses.difference(best.T_slice_model, c.T_slice_model)
    variance = np.diag(c.covariance)
    return any(float(twist[part] @ twist[part]) > RIVAL_SD**2 * float(variance[part].sum()) for part in _PARTS)


def averaged(best: Candidate, doubts: list[Candidate]) -> tuple[Candidate, float]:
    """``best`` with a covariance that covers the variants of its own match: Bayesian model averaging about its pose.

    A variant without the one spot that fixes a direction, or with a spot given to the next rod (``doubts``),
    contradicts nothing, but if it is the truth, the error is larger than the full match believes:
    ``C = Σ w_k (C_k + δ_k δ_kᵀ)``, the weights w from the odds.

    Returns the candidate and the weight of all variants together.
    """
    if not doubts:
        return best, 0.0
    weights = np.exp([c.log_odds - best.log_odds for c in doubts])
    total = 1 + float(weights.sum())
    covariance = np.array(best.covariance)
    for weight, c in zip(weights, doubts, strict=True):
        delta = poses.difference(c.T_slice_model, best.T_slice_model)
        covariance += weight * (c.covariance + np.outer(delta, delta))
    # never narrower than the match itself says
    widened = best.covariance + positive_part(covariance / total - best.covariance)
    return replace(best, covariance=frozen(widened, (6, 6))), float(weights.sum()) / total


def pose_distance_sd(a: Candidate, b: Candidate) -> float:
    """How many standard deviations of ``a`` the pose of ``b`` lies away."""
    twist = poses.difference(b.T_slice_model, a.T_slice_model)
    return float(np.sqrt(twist @ np.linalg.pinv(a.covariance, hermitian=True) @ twist))


def weakness(model: RodModel, covariance: FloatArray) -> str:
    """The worst-known direction of a pose in plain words, or nothing where all are known alike."""
    # about the frame's own centre nothing is blamed on a far-away model origin; slice axes
    values, axes = principal_axes(covariance, model.size_mm)
    if values[-1] <= WEAK_CONDITION**2 * max(float(values[0]), 1e-300):
        return ""
    worst = axes[:, -1]
    sd = math.sqrt(float(values[-1]))
    turn = model.size_mm * np.linalg.norm(worst[3:]) > np.linalg.norm(worst[:3])
    axis = "xyz"[int(np.abs(worst[3:] if turn else worst[:3]).argmax())]
    if turn:
        angle = math.degrees(sd * float(np.linalg.norm(worst[3:])))
        kind = "rotation in the slice plane" if axis == "z" else f"tilt about {axis}"
        return f"{kind} is known to {angle:.2g} deg only"
    return f"position along {axis} is known to {sd:.2g} mm only"
