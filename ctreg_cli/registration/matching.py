"""Which spot is which rod, without labels: hypothesise, predict, bound λ, verify.

1. *Hypothesise.* Rod triples, ordered so that a short prefix contains a triple of any large set of rods, against
   ordered spot triples whose distances the bounded rods can show;
   :func:`~ctreg_cli.registration.minimal.scan_three` gives poses.
2. *Predict.* Each pose says where every other rod crosses the slice, and how well it knows (the covariance of the three
   spots, propagated); the nearest spot votes if it lies within that gate.
3. *Verify.* The best-voted poses are refined on all their spots, vote again with the smaller covariance, and are ranked
   by their odds against chance (:mod:`~ctreg_cli.registration.evidence`).

What else explains the spots is then asked in :mod:`~ctreg_cli.registration.doubt`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.special import chdtrc

from ctreg_cli.arrays import BoolArray, FloatArray, IntArray
from ctreg_cli.geometry import pose as poses
from ctreg_cli.geometry.motion_field import motion_field
from ctreg_cli.geometry.plucker import segment_distance_range
from ctreg_cli.geometry.projection import Projection, project
from ctreg_cli.registration.evidence import P_SEEN, PosePrior, log_odds, widest_information
from ctreg_cli.registration.minimal import RodTriples, scan_three, solve_three
from ctreg_cli.registration.refine import (
    Linearisation,
    Observations,
    covariance_from_information,
    invert_2x2,
    refine,
)
from ctreg_cli.rods import RodModel, common_direction

#: a vote must lie within this Mahalanobis distance² of the prediction (two degrees of freedom: 1 in 30,000 lost)
_GATE2 = 20.0
#: gates never grow beyond this share of the frame's size: a pose that predicts nothing is no hypothesis
WIDEST_GATE = 0.2
#: and no noise carries a spot farther beyond the end of its rod than this share of the rod's length
MOST_BEYOND_END = 0.5
#: matches up to which nothing checks the fit but the odds
LEAST_CHECKED = 4
#: how many triples of any five rods or more are tried
_COVER = 2
#: ln odds beyond which a match is no chance (10⁹ : 1, Lang et al. 2010): only its own spots can tell another story
BEYOND_CHANCE = math.log(1e9)
#: ... and beyond which a match of all rods is none among so many spots that each rod triple takes a second: chance
#: matches there are of a few rods
_BEYOND_CHANCE_OF_ALL = math.log(1e7)
#: ln odds below which no match is believed; up to so many spots, all rod triples are then tried
_BELIEVABLE, _FEW_SPOTS = math.log(100), 12
#: ... and, whatever was found, where so few spot triples are left to try (of five spots): another story may be as good
_AFFORDED = 6_000
#: hypotheses a stage hands on to refinement
_KEEP_PER_STAGE = 40
#: ... and one that only asks whether a match beyond chance has a rival
_KEEP_TO_CONFIRM = 10
#: votes are a rough measure of the odds: hypotheses this many nats under the best of a rod triple are not refined
_VOTES_WITHIN = 25.0
#: rivals within this many nats of the best are kept for the verdict (a good deal more than the verdict's own 100 : 1)
_KEEP_WITHIN = 12.0
#: fewer matches are looked for while they could come this near the best: what the verdict asks of a rival, and a nat
_RIVALS_WITHIN = 6.0
#: a second frame is looked for that leaves at most so many spots fewer than the first
_SECOND_FRAME_LACKS = 2
#: voted hypotheses looked at for a vote that spoils them, the score they need (ln odds, roughly), and the χ²
#: probability under which one does
_REPAIRED, _WORTH_REPAIR, _SPOILT_P = 12, 4.0, 1e-4
#: steps of the refinements before the spots vote again; three noisy spots can start a pose 30° off
_VERIFY_STEPS = (12, 6)
#: share of a determinant that rounding can feign
_ROUNDING = 1e-12
#: spot triples examined at once: as many as stay in the processor's cache
_CHUNK = 12_000
#: so many spot triples of one rod triple are worth a call of their own
_ALONE = 3_000
#: above this many spots a tree finds the nearest, and it pays to think about the order of the rod triples
_MANY_SPOTS = 32
#: ... of which there are no more than this (of twelve rods): else finding an order that covers takes as long
_MOST_REORDERED = 220


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scene:
    """Spots of one slice in slice millimetres, and what is known before looking at them."""

    #: (m, 2) mm, and (m, 2, 2) mm²
    xy_mm: FloatArray
    covariance_mm: FloatArray
    prior: PosePrior
    #: (m,) contrast, where the spots have one
    brightness: FloatArray | None = None
    #: how far beyond its ends a rod may still leave a spot, mm per unit of slope: half the slab
    half_slab_mm: float = 0.0
    #: (2, 2) lower and upper corner of the image, mm; None: unbounded
    field_mm: FloatArray | None = None
    #: how near two rods' crossings may come and leave two spots, mm
    resolved_mm: float = 0.0

    def restricted(self, spots: IntArray) -> Scene:
        """The scene with only these spots."""
        return Scene(
            xy_mm=self.xy_mm[spots],
            covariance_mm=self.covariance_mm[spots],
            prior=self.prior,
            brightness=None if self.brightness is None else self.brightness[spots],
            half_slab_mm=self.half_slab_mm,
            field_mm=self.field_mm,
            resolved_mm=self.resolved_mm,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Matches:
    """A stack of ``b`` refined hypotheses."""

    T: FloatArray
    #: (b, n) spot of each rod, −1 for none
    spot_of_rod: IntArray
    #: (b,) ln odds against chance
    log_odds: FloatArray
    fit: Linearisation
    #: (b, n) rods that would have to be seen
    expected: BoolArray

    def __len__(self) -> int:
        return len(self.T)

    def subset(self, rows: IntArray | BoolArray) -> Matches:
        """These hypotheses only, in this order."""
        return Matches(
            T=self.T[rows],
            spot_of_rod=self.spot_of_rod[rows],
            log_odds=self.log_odds[rows],
            fit=self.fit.subset(rows),
            expected=self.expected[rows],
        )


def join(parts: list[Matches]) -> Matches:
    """Stacks joined into one, best first."""
    fit = Linearisation(
        **{name: np.concatenate([getattr(p.fit, name) for p in parts]) for name in Linearisation.__dataclass_fields__}
    )
    joined = Matches(
        T=np.concatenate([p.T for p in parts]),
        spot_of_rod=np.concatenate([p.spot_of_rod for p in parts]),
        log_odds=np.concatenate([p.log_odds for p in parts]),
        fit=fit,
        expected=np.concatenate([p.expected for p in parts]),
    )
    return joined.subset(np.argsort(-joined.log_odds, kind="stable"))


# --- the plan of a frame: worked out once ---------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SearchPlan:
    """What the search needs to know of a frame, whatever the slice."""

    #: (n, n) least and greatest distance of two rods' spots, mm
    least_mm: FloatArray
    greatest_mm: FloatArray
    #: (t, 3) rod triples in the order to try them
    triples: IntArray
    #: ``prefix[k]``: so many triples hold one of any ``k`` rods
    prefix: dict[int, int]
    #: (t,) how well a triple fixes a pose: geometric mean of the singular values of its motion field
    strength: FloatArray


@lru_cache(maxsize=16)
def plan(model: RodModel) -> SearchPlan:
    """Distances and the order of rod triples; cached, since a model is a value that never changes."""
    least, greatest = segment_distance_range(model.starts, model.ends)
    triples = np.array(list(itertools.combinations(range(len(model)), 3)), dtype=np.intp)
    strength = _triple_strength(model, triples)
    area = (greatest**2 - least**2)[triples[:, [0, 0, 1]], triples[:, [1, 2, 2]]].prod(axis=1)
    cheapness = np.sqrt(area.min() / area) if area.min() > 0 else np.ones(len(area))
    order, prefix = _covering_order(len(model), triples, strength * cheapness)
    return SearchPlan(
        least_mm=least, greatest_mm=greatest, triples=triples[order], prefix=prefix, strength=strength[order]
    )


def plan_among(model: RodModel, scene: Scene) -> SearchPlan:
    """The plan with rod triples first that few triples of these very spots could be.

    Among many spots a rod triple takes a second, and another, nearly as strong, half of that. How many triples of spots
    it leaves to try is reckoned from how many pairs could be two of its rods.
    """
    from scipy.spatial.distance import pdist

    layout = plan(model)
    if len(layout.triples) > _MOST_REORDERED:
        return layout
    gap, slack_mm = pdist(scene.xy_mm), 4 * noise_mm(model, scene)
    first, second = np.triu_indices(len(model), 1)
    fits = (gap >= layout.least_mm[first, second, None] - slack_mm) & (
        gap <= layout.greatest_mm[first, second, None] + slack_mm
    )
    share = np.ones((len(model), len(model)))
    share[first, second] = share[second, first] = np.maximum(np.count_nonzero(fits, axis=1), 1) / len(gap)
    a, b, c = layout.triples.T
    worth = layout.strength / np.sqrt(share[a, b] * share[a, c] * share[b, c])
    order, prefix = _covering_order(len(model), layout.triples, worth)
    return replace(layout, triples=layout.triples[order], prefix=prefix, strength=layout.strength[order])


def _triple_strength(model: RodModel, triples: IntArray) -> FloatArray:
    """|det J|^(1/6) of each triple's motion field, median over tilts about the frame's own axis and all heights."""
    rng = np.random.default_rng(20081)  # a fixed design of poses, not an experiment
    normal = poses.nearest_rotation(_basis_along(common_direction(model)))
    tilt = poses.exp_rotation(rng.normal(size=(48, 3)) * 0.25)
    R = tilt @ normal
    middle = np.concatenate([model.starts, model.ends])
    height = np.einsum("bj,kj->bk", R[:, 2], middle - model.centre)
    z = rng.uniform(0.2, 0.8, len(R)) * np.ptp(height, axis=1) + height.min(axis=1)
    t = -np.einsum("bij,j->bi", R, model.centre)
    t[:, 2] -= z
    T = poses.make_pose(R, t)
    J = motion_field(T, project(T, model.starts, model.directions))
    J = np.nan_to_num(J)
    J[..., 3:] /= model.size_mm
    stacked = J[:, triples].reshape(len(T), len(triples), 6, 6)
    _, logdet = np.linalg.slogdet(stacked)
    strength: FloatArray = np.exp(np.median(np.clip(logdet, -60, 60), axis=0) / 6)
    return strength


def _basis_along(axis: FloatArray) -> FloatArray:
    """A rotation whose third row is ``axis``."""
    helper = np.eye(3)[np.abs(axis).argmin()]
    first = np.cross(axis, helper)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(axis, first), axis])


def _covering_order(n: int, triples: IntArray, worth: FloatArray) -> tuple[IntArray, dict[int, int]]:
    """Triples ordered so that, for each k from n down to 3, a prefix holds triples of *any* k rods (greedy cover).

    Of five rods or more it holds :data:`_COVER` triples: noise can take every root from a weak one.
    """
    chosen: list[int] = []
    prefix: dict[int, int] = {}
    free = np.ones(len(triples), dtype=bool)
    for k in range(n, 2, -1):
        times = _COVER if k > LEAST_CHECKED else 1
        if math.comb(n, k) > 20_000:  # many rods: spread the triples by worth alone
            prefix[k] = min(len(triples), 2 * times * (n - k + 1))
            for t in np.argsort(-worth, kind="stable"):
                if len(chosen) >= prefix[k]:
                    break
                if free[t]:
                    free[t] = False
                    chosen.append(int(t))
            continue
        sets = np.zeros((math.comb(n, k), n), dtype=bool)
        for row, members in enumerate(itertools.combinations(range(n), k)):
            sets[row, list(members)] = True
        holds: BoolArray = np.logical_and.reduce(sets[:, triples], axis=2)  # (sets, triples)
        lacking = times - holds[:, np.array(chosen, dtype=np.intp)].sum(axis=1)
        while (lacking > 0).any():
            gain = holds[lacking > 0].sum(axis=0) * (1e-3 + worth / worth.max()) * free
            best = int(gain.argmax())
            free[best] = False
            chosen.append(best)
            lacking -= holds[:, best]
        prefix[k] = len(chosen)
    return np.array(chosen, dtype=np.intp), prefix


# --- search ---------------------------------------------------------------------------------------------------------


def search(model: RodModel, scene: Scene, *, least_matches: int = 4) -> Matches | None:
    """All matches worth a verdict, best first; None when no pose gathers ``least_matches`` spots.

    Once a match beats chance by :data:`BEYOND_CHANCE`, no rival is left to chance either: it would have to share spots
    with it, so that only triples of its own spots are tried further, and the spots left over for a second frame.
    """
    m = len(scene.xy_mm)
    if m < least_matches:
        return None
    layout = plan(model) if m <= _MANY_SPOTS else plan_among(model, scene)
    found: list[Matches] = []
    seen: set[bytes] = set()
    best: Matches | None = None
    start_from = np.arange(m)
    done = 0
    for k in range(min(len(model), m), least_matches - 1, -1):
        if best is not None and not _could_rival(scene, best, k):
            break
        while done < layout.prefix[k]:
            # few hypotheses cost less together, many are worth stopping after each triple
            end = done + 1 if len(start_from) > _MANY_SPOTS else layout.prefix[k]
            most = _KEEP_PER_STAGE if len(start_from) == m else _KEEP_TO_CONFIRM
            part = _search_triples(model, scene, layout.triples[done:end], start_from, least_matches, seen, most=most)
            done = end
            if part is None:
                continue
            found.append(part)
            best = _better(best, part)
            if _is_beyond_chance(best, m):
                start_from = best.spot_of_rod[0][best.spot_of_rod[0] >= 0]
    if done < len(layout.triples) and _all_triples_are_worth_it(best, len(layout.triples) - done, m):
        # noise can take every root from each of the few triples that hold the rods seen: here all can be afforded
        part = _search_triples(model, scene, layout.triples[done:], start_from, least_matches, seen)
        if part is not None:
            found.append(part)
            best = _better(best, part)
    if best is not None and best.log_odds[0] > BEYOND_CHANCE:
        second = _second_frame(model, scene, best, least_matches)
        if second is not None:
            found.append(second)
    if not found:
        return None
    return distinct(model, join(found))


def _better(best: Matches | None, part: Matches) -> Matches:
    """The better of the best so far and the first of ``part``."""
    return part.subset(np.array([0])) if best is None or part.log_odds[0] > best.log_odds[0] else best


def _all_triples_are_worth_it(best: Matches | None, n_triples: int, n_spots: int) -> bool:
    """Whether to try the rest of the rod triples: where nothing believable was found, or few spots make it cheap."""
    if best is None or best.log_odds[0] < _BELIEVABLE:
        return n_spots <= _FEW_SPOTS
    cheap = n_triples * n_spots * (n_spots - 1) * (n_spots - 2) <= _AFFORDED
    return bool(best.log_odds[0] < BEYOND_CHANCE) and cheap


def _is_beyond_chance(best: Matches, n_spots: int) -> bool:
    """Whether the match found need not be looked for a rival of other spots."""
    all_seen = n_spots > _MANY_SPOTS and bool((best.spot_of_rod[0] >= 0).all())
    return bool(best.log_odds[0] > (_BEYOND_CHANCE_OF_ALL if all_seen else BEYOND_CHANCE))


def _second_frame(model: RodModel, scene: Scene, best: Matches, least_matches: int) -> Matches | None:
    """A match nearly as good as ``best`` among the spots it leaves over; not looked for in a field of clutter."""
    free = np.setdiff1d(np.arange(len(scene.xy_mm)), best.spot_of_rod[0])
    if len(free) > _MANY_SPOTS:
        return None
    enough = max(least_matches, int((best.spot_of_rod[0] >= 0).sum()) - _SECOND_FRAME_LACKS)
    if enough > min(len(model), len(free)):
        return None
    layout = plan(model)
    triples = layout.triples[: layout.prefix[enough]]
    return _search_triples(model, scene, triples, free, enough, set(), most=_KEEP_TO_CONFIRM)


def _could_rival(scene: Scene, best: Matches, k: int) -> bool:
    """Whether a match of only ``k`` spots can come near the odds of the best one found.

    Against the best it lacks the worth of n − k matches, and owes for as many missed rods; it may gain all of the
    best's residual, and some volume of poses for knowing them less well.
    """
    matched = best.spot_of_rod[0] >= 0
    n, m = int(matched.sum()), len(scene.xy_mm)
    if k >= n:
        return True
    weight = best.fit.weight[0, matched]
    precision = np.sort(weight[:, 0, 0] * weight[:, 1, 1] - weight[:, 0, 1] * weight[:, 1, 0])[: n - k]
    spread = np.ptp(scene.xy_mm[best.spot_of_rod[0, matched]], axis=0)
    worth = math.log(P_SEEN / (1 - P_SEEN)) - math.log(2 * math.pi) + 0.5 * np.log(precision)
    worth += math.log(max(float(spread[0] * spread[1]), 1e-9)) - math.log(max(m - k, 1))
    return float(worth.sum() - 0.5 * best.fit.chi2[0]) < _RIVALS_WITHIN


def _search_triples(
    model: RodModel,
    scene: Scene,
    rods: IntArray,
    start_from: IntArray,
    least_matches: int,
    seen: set[bytes],
    *,
    most: int = _KEEP_PER_STAGE,
) -> Matches | None:
    """Poses from rod triples (g, 3) against all triples of the spots ``start_from``, voted by all spots and weighed.

    ``seen`` collects the match sets already weighed; the ``most`` promising ones are.
    """
    layout = plan(model)
    noise = noise_mm(model, scene)
    kept: list[tuple[FloatArray, FloatArray, IntArray]] = []
    for triple, spots in _spot_triples(scene.xy_mm[start_from], layout, rods, 4 * noise):
        spots = start_from[spots]
        T, which = scan_three(
            RodTriples.of(model, rods[triple]),
            scene.xy_mm[spots],
            slack_mm=3 * noise + 2 * scene.half_slab_mm,
            noise_mm=noise,
        )
        allowed = scene.prior.allows(T[:, :3, :3])
        T, which = T[allowed], which[allowed]
        if len(T):
            of_pose = triple[which] if len(triple) > 1 else np.repeat(triple, len(which))
            kept.append(_vote(model, scene, T, rods[of_pose], spots[which], least_matches))
    if not kept:
        return None
    score, T, spot_of_rod = (np.concatenate(column) for column in zip(*kept, strict=True))
    top: list[int] = []
    for i in np.argsort(-score, kind="stable"):
        if len(top) >= most or score[i] < score[top[0] if top else i] - _VOTES_WITHIN:
            break
        key = spot_of_rod[i].tobytes()
        if key not in seen:
            seen.add(key)
            top.append(int(i))
    if not top:
        return None
    verified = verify(model, scene, T[top], spot_of_rod[top], least_matches)
    if verified is not None and verified.log_odds[0] > BEYOND_CHANCE:
        return verified
    hopeful = [i for i in top[:_REPAIRED] if score[i] > _WORTH_REPAIR]
    repaired = _repair(model, scene, T[hopeful], spot_of_rod[hopeful], least_matches) if hopeful else None
    parts = [part for part in (verified, repaired) if part is not None]
    return join(parts) if parts else None


def _repair(model: RodModel, scene: Scene, T: FloatArray, spot_of_rod: IntArray, least_matches: int) -> Matches | None:
    """Voted hypotheses that do not fit, each without the one vote that spoils it.

    Among clutter a false spot votes now and then, and one is enough to pull the pose away from all the true ones.
    """
    _, fit, _ = refine(model, T, observations(scene, spot_of_rod), iterations=_VERIFY_STEPS[0], step_tolerance=1e-3)
    n = (spot_of_rod >= 0).sum(axis=1)
    spoilt = np.nonzero((chdtrc(np.maximum(2 * n - 6, 1), fit.chi2) < _SPOILT_P) & (n > least_matches))[0]
    if len(spoilt) == 0:
        return None
    row, rod = np.nonzero(spot_of_rod[spoilt] >= 0)
    without = spot_of_rod[spoilt][row]
    without[np.arange(len(row)), rod] = -1
    T_without, fit, _ = refine(
        model, T[spoilt][row], observations(scene, without), iterations=_VERIFY_STEPS[0], step_tolerance=1e-3
    )
    order = np.lexsort((fit.chi2, row))
    best = order[np.unique(row[order], return_index=True)[1]]
    return verify(model, scene, T_without[best], without[best], least_matches)


def noise_mm(model: RodModel, scene: Scene) -> float:
    """A generous standard deviation of a spot about its rod, mm."""
    variance = np.sort(scene.covariance_mm[:, 0, 0] + scene.covariance_mm[:, 1, 1]) / 2
    spot = math.sqrt(variance[int(0.8 * (len(variance) - 1))])
    return float(math.hypot(spot, 1.3 * float(model.tolerances.max())))


def _spot_triples(
    xy_mm: FloatArray, layout: SearchPlan, rods: IntArray, slack_mm: float
) -> Iterator[tuple[IntArray, IntArray]]:
    """Ordered spot triples (·, 3) whose distances the rod triples (g, 3) can show, in chunks.

    With each chunk comes the row of ``rods`` each belongs to: (·,), or (1,) where all belong to one.
    """
    gap = np.linalg.norm(xy_mm[:, None] - xy_mm[None], axis=-1)
    np.fill_diagonal(gap, np.nan)
    waiting: list[tuple[IntArray, IntArray]] = []
    for row, triple in enumerate(rods):
        first, second = triple[[0, 0, 1]], triple[[1, 2, 2]]
        ok12, ok13, ok23 = (gap >= layout.least_mm[first, second, None, None] - slack_mm) & (
            gap <= layout.greatest_mm[first, second, None, None] + slack_mm
        )
        count = ((ok12.astype(np.float64) @ ok23) * ok13).sum(axis=1)
        chunk = np.floor(np.cumsum(count) / _CHUNK).astype(np.intp)
        for part in np.split(np.arange(len(xy_mm)), np.nonzero(np.diff(chunk))[0] + 1):
            a, b, c = np.nonzero(ok12[part, :, None] & ok13[part, None, :] & ok23[None])
            if len(a) > _ALONE:
                yield np.array([row]), np.stack([part[a], b, c], axis=1)
            elif len(a):
                waiting.append((np.full(len(a), row), np.stack([part[a], b, c], axis=1)))
    if waiting:
        belongs, spots = (np.concatenate(column) for column in zip(*waiting, strict=True))
        for begin in range(0, len(spots), _CHUNK):
            yield belongs[begin : begin + _CHUNK], spots[begin : begin + _CHUNK]


def _vote(
    model: RodModel, scene: Scene, T: FloatArray, rods: IntArray, spots: IntArray, least_matches: int
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Let the spots vote on poses (b, 4, 4) made from three of them; returns score, pose and spots of rods of the best.

    One vote fewer than ``least_matches`` is enough here: three noisy spots predict the others badly, and
    :func:`verify` asks again with a better pose.
    """
    n, size = len(model), model.size_mm
    projection = project(T, model.starts, model.directions)
    seen, expected = visibility(model, scene, projection.lambda_mm, projection.slope, projection.xy_mm)
    could = (seen | expected).sum(axis=1) >= least_matches
    mine = np.zeros((len(T), n), dtype=bool)
    np.put_along_axis(mine, rods, True, axis=1)
    others = np.nonzero(~mine)[1].reshape(len(T), n - 3)
    row = np.arange(len(T))[:, None]
    nearest, distance = _nearest_spots(scene.xy_mm, projection.xy_mm[row, others], spots)
    hopeful = seen[row, others] & (distance < math.sqrt(_GATE2) * WIDEST_GATE * size)
    could &= hopeful.sum(axis=1) + 3 >= least_matches - 1
    T, spots, nearest, hopeful, rods, others = (x[could] for x in (T, spots, nearest, hopeful, rods, others))
    b, row = len(T), np.arange(len(T))[:, None]
    if b == 0:
        return np.empty(0), np.empty((0, 4, 4)), np.empty((0, n), dtype=np.intp)
    projection = Projection(
        xy_mm=projection.xy_mm[could], lambda_mm=projection.lambda_mm[could], slope=projection.slope[could]
    )
    J = np.nan_to_num(motion_field(T, projection))
    k = np.nan_to_num(projection.slope)
    tolerance = (model.tolerances**2)[:, None, None] * (np.eye(2) + k[..., :, None] * k[..., None, :])
    own = tolerance[row, rods] + scene.covariance_mm[spots]
    J_own, J = J[row, rods], J[row, others]
    WJ = (invert_2x2(own) @ J_own).reshape(b, 6, 6)
    unit = np.array([size] * 3 + [1.0] * 3)
    prior = np.diag(unit**-2.0)
    information = np.swapaxes(J_own.reshape(b, 6, 6), 1, 2) @ WJ + prior
    # of spots known to a millionth of a pixel one direction may be all that rounding leaves
    information += (_ROUNDING * np.einsum("bii,i->b", information, unit * unit))[:, None, None] * prior
    JC = (J.reshape(b, -1, 6) @ np.linalg.inv(information)).reshape(J.shape)
    gate = JC @ np.swapaxes(J, -1, -2) + tolerance[row, others] + np.median(scene.covariance_mm, axis=0)
    r = np.where(hopeful[..., None], scene.xy_mm[nearest] - projection.xy_mm[row, others], 0)
    product = gate[..., 0, 0] * gate[..., 1, 1]
    det = product - gate[..., 0, 1] ** 2
    # of a rod that all but lies in the slice nothing is predicted, and rounding may make its determinant negative
    known = det > _ROUNDING * product
    det = np.where(known, det, 1.0)
    distance2 = (
        gate[..., 1, 1] * r[..., 0] ** 2
        - 2 * gate[..., 0, 1] * r[..., 0] * r[..., 1]
        + gate[..., 0, 0] * r[..., 1] ** 2
    ) / det
    spread = np.sqrt(det)
    votes = hopeful & known & (distance2 < _GATE2) & (spread < (WIDEST_GATE * size) ** 2)
    density = len(scene.xy_mm) / max(float(np.prod(np.ptp(scene.xy_mm, axis=0))), 1e-9)
    gain = math.log(P_SEEN) - np.log(2 * math.pi * spread * density) - 0.5 * distance2
    missed = math.log(1 - P_SEEN) * expected[could][row, others]
    score = np.where(votes, gain, missed).sum(axis=1)
    enough = votes.sum(axis=1) + 3 >= least_matches - 1
    top = np.nonzero(enough)[0]
    top = top[np.argsort(-score[top], kind="stable")[: 4 * _KEEP_PER_STAGE]]
    spot_of_rod = np.full((len(top), n), -1, dtype=np.intp)
    one_each = np.where(votes[top], _keep_nearest(nearest[top], np.where(votes[top], distance2[top], np.inf)), -1)
    np.put_along_axis(spot_of_rod, others[top], one_each, axis=1)
    np.put_along_axis(spot_of_rod, rods[top], spots[top], axis=1)
    return score[top], T[top], spot_of_rod


def _keep_nearest(spot: IntArray, distance2: FloatArray) -> IntArray:
    """Spots (b, k) chosen by each rod, −1 where another rod that chose the same one lies nearer."""
    rival = (spot[:, :, None] == spot[:, None]) & (distance2[:, None] < distance2[:, :, None])
    return np.where(rival.any(axis=2), -1, spot)


def _nearest_spots(spots_mm: FloatArray, crossings_mm: FloatArray, taken: IntArray) -> tuple[IntArray, FloatArray]:
    """Nearest spot of each crossing (b, k, 2) and its distance, mm; a spot ``taken`` (b, 3) is infinitely far."""
    crossings = np.nan_to_num(crossings_mm, nan=1e9)
    if len(spots_mm) > _MANY_SPOTS:
        from scipy.spatial import cKDTree

        distance, nearest = cKDTree(spots_mm).query(crossings)
        distance[(nearest[..., None] == taken[:, None]).any(axis=-1)] = np.inf
        return nearest, distance
    gap2 = (crossings[..., 0, None] - spots_mm[:, 0]) ** 2 + (crossings[..., 1, None] - spots_mm[:, 1]) ** 2
    for column in taken.T:
        gap2[np.arange(len(gap2)), :, column] = np.inf
    nearest = gap2.argmin(axis=2)
    return nearest, np.sqrt(np.take_along_axis(gap2, nearest[..., None], axis=2)[..., 0])


def visibility(
    model: RodModel,
    scene: Scene,
    lambda_mm: FloatArray,
    slope: FloatArray,
    xy_mm: FloatArray,
    sd_mm: FloatArray | float = 0.0,
) -> tuple[BoolArray, BoolArray]:
    """Which rods *may* leave a spot, and which *must* (..., n).

    Between the two lie rods cut near an end, where only part of the slab holds metal, or as near to it as the pose is
    known (``sd_mm`` along the rod); and rods outside the image. A rod that lies nearly in the slice would be cut
    anywhere with a little noise: it leaves a line, not a spot that says where, and half its length is the most.
    """
    noise = noise_mm(model, scene)
    with np.errstate(invalid="ignore"):
        per_mm = np.sqrt(1 + (slope**2).sum(axis=-1))  # mm of rod per mm of slab
        near_end = np.minimum(scene.half_slab_mm * per_mm + 4 * noise * per_mm, MOST_BEYOND_END * model.lengths)
        slack = near_end + 0.01 * model.size_mm
        may = (lambda_mm >= -slack) & (lambda_mm <= model.lengths + slack)
        inner = slack + sd_mm
        must = (lambda_mm >= inner) & (lambda_mm <= model.lengths - inner)
        if scene.field_mm is not None:
            inside = ((xy_mm >= scene.field_mm[0]) & (xy_mm <= scene.field_mm[1])).all(axis=-1)
            may &= inside
            must &= inside
    return may, must


def verify(model: RodModel, scene: Scene, T: FloatArray, spot_of_rod: IntArray, least_matches: int) -> Matches | None:
    """Refine hypotheses on their spots, let all spots vote again with the smaller covariance, refine, weigh."""
    for iterations in _VERIFY_STEPS:
        T, fit, _ = refine(model, T, observations(scene, spot_of_rod), iterations=iterations, step_tolerance=1e-3)
        spot_of_rod = assign(model, scene, T, fit)
        enough = ((spot_of_rod >= 0).sum(axis=1) >= least_matches) & np.isfinite(fit.chi2)
        T, spot_of_rod = T[enough], spot_of_rod[enough]
        if len(T) == 0:
            return None
        _, first = np.unique(
            np.concatenate([spot_of_rod, np.round(T[:, :3, :].reshape(len(T), -1) / 0.05).astype(np.intp)], axis=1),
            axis=0,
            return_index=True,
        )
        T, spot_of_rod = T[np.sort(first)], spot_of_rod[np.sort(first)]
    return weigh(model, scene, T, spot_of_rod, least_matches)


def weigh(model: RodModel, scene: Scene, T: FloatArray, spot_of_rod: IntArray, least_matches: int) -> Matches | None:
    """Refine hypotheses with the matches they have, and give each its odds."""
    if len(T) == 0:
        return None
    T, fit, _ = refine(model, T, observations(scene, spot_of_rod), iterations=25, step_tolerance=1e-5)
    projection = project(T, model.starts, model.directions)
    may, must = visibility(
        model,
        scene,
        projection.lambda_mm,
        projection.slope,
        projection.xy_mm,
        _sd_along_rods(model, T, fit, projection),
    )
    matched = spot_of_rod >= 0
    merged = _merged(model, scene, fit.predicted_px, matched, must)
    must &= ~merged
    odds = log_odds(
        model,
        scene.prior,
        scene.xy_mm,
        T,
        fit,
        matched,
        must,
        brightness=scene.brightness,
        spot_of_rod=spot_of_rod,
        merged=merged,
    )
    good = (
        np.isfinite(odds)
        & scene.prior.allows(T[:, :3, :3])
        & (may | ~matched).all(axis=1)
        & (matched.sum(axis=1) >= least_matches)
    )
    if not good.any():
        return None
    matches = Matches(T=T, spot_of_rod=spot_of_rod, log_odds=odds, fit=fit, expected=must)
    return matches.subset(good).subset(np.argsort(-odds[good], kind="stable"))


def _sd_along_rods(model: RodModel, T: FloatArray, fit: Linearisation, projection: Projection) -> FloatArray:
    """Sd (b, n) of where poses cut the rods, mm along the rod: a pose of few spots hardly knows which rods it cuts."""
    H, _ = fit.normal_equations()
    C, _ = covariance_from_information(H + widest_information(model.size_mm), model.size_mm)
    x, y = np.moveaxis(np.nan_to_num(projection.xy_mm - T[:, None, :2, 3]), -1, 0)
    zero = np.zeros_like(x)
    height = np.stack([zero, zero, zero + 1, y, -x, zero], axis=-1)  # z part of V + Ω × (Q − t)
    variance = np.einsum("bni,bij,bnj->bn", height, C, height)
    per_mm = np.sqrt(1 + (np.nan_to_num(projection.slope) ** 2).sum(axis=-1))
    result: FloatArray = np.sqrt(np.maximum(variance, 0)) * per_mm
    return result


def _merged(model: RodModel, scene: Scene, crossing_mm: FloatArray, matched: BoolArray, must: BoolArray) -> BoolArray:
    """Rods whose crossing falls on a matched rod's: their two spots may be one, and it has been given away."""
    gap = np.linalg.norm(crossing_mm[:, :, None] - crossing_mm[:, None, :], axis=-1)
    close = (gap < scene.resolved_mm) & matched[:, None, :] & ~np.eye(len(model), dtype=bool)
    merged: BoolArray = close.any(axis=2) & must & ~matched
    return merged


def observations(scene: Scene, spot_of_rod: IntArray) -> Observations:
    """The assigned spots as the refinement wants them, in millimetres."""
    return Observations(
        uv_px=scene.xy_mm[spot_of_rod],
        covariance_px=scene.covariance_mm[spot_of_rod],
        matched=spot_of_rod >= 0,
        mm_per_px=np.ones(2),
        half_slab_mm=scene.half_slab_mm,
        resolved_mm=scene.resolved_mm,
    )


def assign(model: RodModel, scene: Scene, T: FloatArray, fit: Linearisation) -> IntArray:
    """Spot of each rod (b, n) about refined poses: :func:`nearest_assignment` within their own covariances."""
    H, _ = fit.normal_equations()
    C, _ = covariance_from_information(H + np.diag([1e-6] * 6), model.size_mm)
    return nearest_assignment(model, scene, T, C)


def nearest_assignment(model: RodModel, scene: Scene, T: FloatArray, covariance: FloatArray) -> IntArray:
    """Spot of each rod (b, n), −1 for none, one to one: of those within the gate the nearest in all (Hungarian).

    Args:
        model: the rods.
        scene: the spots.
        T: (b, 4, 4) poses.
        covariance: (b, 6, 6) or (6, 6) how well they are known: the gates.
    """
    C = np.broadcast_to(covariance, (len(T), 6, 6))
    projection = project(T, model.starts, model.directions)
    may, _ = visibility(model, scene, projection.lambda_mm, projection.slope, projection.xy_mm)
    J = np.nan_to_num(motion_field(T, projection))
    k = np.nan_to_num(projection.slope)
    tolerance = (model.tolerances**2)[:, None, None] * (np.eye(2) + k[..., :, None] * k[..., None, :])
    gate = J @ C[:, None] @ np.swapaxes(J, -1, -2) + tolerance
    xy = np.nan_to_num(projection.xy_mm, nan=1e9)
    r = scene.xy_mm[None, None] - xy[:, :, None]  # (b, n, m, 2)
    near = (np.abs(r) < 2 * WIDEST_GATE * model.size_mm).all(axis=-1) & may[..., None]
    b, rod, spot = np.nonzero(near)
    inverse = invert_2x2(gate[b, rod] + scene.covariance_mm[spot])
    d = r[b, rod, spot]
    distance2 = np.einsum("ki,kij,kj->k", d, inverse, d)
    inside = distance2 < _GATE2
    b, rod, spot, distance2 = b[inside], rod[inside], spot[inside], distance2[inside]
    result = np.full((len(T), len(model)), -1, dtype=np.intp)
    result[b, rod] = spot
    by_rod = np.zeros((len(T), len(model)), dtype=np.intp)
    np.add.at(by_rod, (b, rod), 1)
    by_spot = np.zeros((len(T), len(scene.xy_mm)), dtype=np.intp)
    np.add.at(by_spot, (b, spot), 1)
    contested = np.nonzero((by_rod > 1).any(axis=1) | (by_spot > 1).any(axis=1))[0]
    for row in contested:
        mine = b == row
        cost = np.full((len(model), len(scene.xy_mm)), _GATE2 * 1e3)
        cost[rod[mine], spot[mine]] = distance2[mine]
        i, j = linear_sum_assignment(cost)
        take = cost[i, j] < _GATE2
        result[row] = -1
        result[row, i[take]] = j[take]
    return result


def distinct(model: RodModel, matches: Matches, *, within: float = _KEEP_WITHIN, most: int = 24) -> Matches:
    """The best of each pose: hypotheses within ``within`` nats of the best that differ in pose or in matches.

    A second frame, beyond chance and of other spots than the best, stays however far behind.
    """
    keep: list[int] = []
    for i in range(len(matches)):
        if len(keep) >= most:
            break
        far_behind = matches.log_odds[i] < matches.log_odds[0] - within
        if far_behind and not is_second_frame(matches.spot_of_rod[0], matches.spot_of_rod[i], matches.log_odds[i]):
            continue
        if not any(
            (matches.spot_of_rod[i] == matches.spot_of_rod[j]).all() and _same(model, matches.T[i], matches.T[j])
            for j in keep
        ):
            keep.append(i)
    return matches.subset(np.array(keep, dtype=np.intp))


def is_second_frame(best: IntArray, other: IntArray, log_odds: float) -> bool:
    """Whether a match is no chance and has no spot in common with the best: another frame of the same make.

    Args:
        best: spots of the best match, −1 for none.
        other: spots of the match in question.
        log_odds: its ln odds.
    """
    return log_odds > BEYOND_CHANCE and not np.isin(other[other >= 0], best).any()


def _same(model: RodModel, T_a: FloatArray, T_b: FloatArray) -> bool:
    """Equal to the last digit that matters: a thousandth of the frame's size."""
    turn = float(poses.rotation_angle(T_a[:3, :3] @ T_b[:3, :3].T))
    shift = float(np.linalg.norm((T_a - T_b)[:3, :3] @ model.centre + (T_a - T_b)[:3, 3]))
    return turn < 1e-3 and shift < 1e-3 * model.size_mm


def distinct_poses(model: RodModel, T: FloatArray, group: IntArray | None = None) -> IntArray:
    """Indices of poses (b, 4, 4) that differ by half a degree or a fiftieth of the frame, first come first.

    Where each belongs to a ``group`` (b,), those of one do not stand for those of another.
    """
    R, t = T[:, :3, :3].reshape(-1, 9), T[:, :3, 3]
    differ = R @ R.T < 3 - 0.01**2  # trace(R_i R_jᵀ) = 1 + 2 cos
    differ |= np.linalg.norm(t[:, None] - t[None], axis=-1) > 0.02 * model.size_mm
    if group is not None:
        differ |= group[:, None] != group
    kept: list[int] = []
    for i in range(len(T)):
        if differ[i, kept].all():
            kept.append(i)
    return np.array(kept, dtype=np.intp)


def roots_of_triples(model: RodModel, scene: Scene, spot_of_rod: IntArray, triples: IntArray) -> FloatArray:
    """(s, 4, 4) poses that three of a match's spots allow, for each of its ``triples`` of rods (t, 3)."""
    noise = noise_mm(model, scene)
    T, _ = solve_three(
        RodTriples.of(model, triples),
        scene.xy_mm[spot_of_rod[triples]],
        slack_mm=3 * noise + 2 * scene.half_slab_mm,
        noise_mm=noise,
    )
    return T[scene.prior.allows(T[:, :3, :3])]
