"""What else explains the spots: the winners of the search, taken apart.

One match is dropped, added or exchanged at a time, and a match is refined anew from every root of the triples of its
own spots: the same matches can have a second minimum far away. One false spot among right ones can hold a match in the
wrong one of two minima; so those of the match without each of its spots are found as well, and all spots vote there.
"""

from __future__ import annotations

import itertools

import numpy as np

from ctreg_cli.arrays import FloatArray
from ctreg_cli.geometry import pose as poses
from ctreg_cli.registration.elsewhere import solutions_without_a_spot
from ctreg_cli.registration.matching import (
    WIDEST_GATE,
    Matches,
    Scene,
    assign,
    distinct,
    distinct_poses,
    join,
    observations,
    roots_of_triples,
    weigh,
)
from ctreg_cli.registration.refine import (
    Linearisation,
    covariance_from_information,
    linearise,
    principal_axes,
    refine,
)
from ctreg_cli.rods import RodModel

#: matches within this many nats of the best are taken apart
_DOUBT_WITHIN = 7.0
#: how often doubt may find a better match and take that apart in turn
_BETTER_FOUND = 2
#: a match of fewer spots has too many minima without one of them, and the search finds what they could lead to
_LEAST_WITHOUT = 6
#: minima without a spot that are less probable than this beside the known one are not voted on: a spot gained there is
#: worth some ten nats
_NEGLECTED_P = 1e-6
#: variants that promise a χ² so much above the best are not refined: hundreds of nats, and they take the most steps
_HOPELESS_CHI2 = 1e3
#: rod triples of a match whose roots it is refined from anew, to find its second minima
_RESTARTS = 20
#: ... and half of them do for so many matches
_MANY_MATCHES = 8
#: a match of so few spots is refined anew from places along its weakest direction as well, so far off, in frame sizes
#: (or rad)
_FEW_MATCHES, _AWAY = 6, np.array([-0.35, -0.17, -0.08, -0.035, 0.035, 0.08, 0.17, 0.35])
#: starts that are refined, and minima that are weighed
_MOST_STARTS, _MOST_MINIMA = 48, 8


def doubt(model: RodModel, scene: Scene, matches: Matches, *, least_matches: int = 4, most: int = 4) -> Matches:
    """Look for what else explains the spots.

    Other minima of the same matches, matches that differ in one spot, and what all spots make of the other minima of
    the matches without each of their spots. A better match found that way is taken apart in turn.

    Args:
        model: the rods.
        scene: the spots, and what bears on the pose.
        matches: what the search found, best first.
        least_matches: as for the search.
        most: how many of them to take apart.

    Returns:
        These and what was found beside them, best first, one of each pose and match.
    """
    pool = [matches]
    taken: set[bytes] = set()

    def take_apart(found: Matches, row: int) -> None:
        taken.add(found.spot_of_rod[row].tobytes())
        for look in (_restart, _vary, _without_each):
            part = look(model, scene, found, row, least_matches)
            if part is not None:
                pool.append(part)

    for row in range(len(matches)):
        if matches.spot_of_rod[row].tobytes() in taken:
            continue
        if len(taken) >= most or matches.log_odds[row] < matches.log_odds[0] - _DOUBT_WITHIN:
            break
        take_apart(matches, row)
    all_found = distinct(model, join(pool))
    for _ in range(_BETTER_FOUND):
        if all_found.spot_of_rod[0].tobytes() in taken:
            break
        # a better match than the search's own has had no doubt cast on it yet
        take_apart(all_found, 0)
        all_found = distinct(model, join(pool))
    return all_found


def _restart(model: RodModel, scene: Scene, matches: Matches, row: int, least_matches: int) -> Matches | None:
    """The same matches, refined from every root of their triples; and what all spots say of the minima found."""
    spot_of_rod = matches.spot_of_rod[row]
    matched = np.nonzero(spot_of_rod >= 0)[0]
    triples = np.array(list(itertools.combinations(matched, 3)), dtype=np.intp)
    most = _RESTARTS if len(matched) < _MANY_MATCHES else _RESTARTS // 2
    if len(triples) > most:  # many matches: twins are rare, and each of them shows in most triples
        triples = triples[:: len(triples) // most + 1]
    T = roots_of_triples(model, scene, spot_of_rod, triples)
    if len(matched) <= _FEW_MATCHES:  # noise can take a root from each of the few triples
        along = _along_the_weakest(model, matches.T[row], matches.fit.subset(np.array([row])))
        T = np.concatenate([T, along[scene.prior.allows(along[:, :3, :3])]])
    if len(T) == 0:
        return None
    same = np.broadcast_to(spot_of_rod, (len(T), len(spot_of_rod)))
    # far starts say so at once; the others go on until those of one minimum lie together: on the way down a valley,
    # a start that will end in a minimum of its own can still be the worse one
    for kept, iterations in ((_MOST_STARTS, 2), (_MOST_STARTS, 6), (_MOST_MINIMA, 16)):
        T, fit, _ = refine(model, T, observations(scene, same[: len(T)]), iterations=iterations, step_tolerance=1e-3)
        order = np.argsort(fit.chi2, kind="stable")
        order = order[distinct_poses(model, T[order])[:kept]]
        T, fit = T[order], fit.subset(order)
    hopeful = fit.chi2 < fit.chi2[0] + _HOPELESS_CHI2
    # what speaks for another minimum is often a spot that the first one could not use: all vote again
    same, again = same[: len(T)], assign(model, scene, T, fit)
    other = (again != same).any(axis=1)
    T, spot_of_rod = np.concatenate([T[hopeful], T[other]]), np.concatenate([same[hopeful], again[other]])
    return weigh(model, scene, T, spot_of_rod, least_matches)


def _along_the_weakest(model: RodModel, T: FloatArray, fit: Linearisation) -> FloatArray:
    """(s, 4, 4) poses away from ``T`` (4, 4) to both sides, along the direction that its spots say least about."""
    C, _ = covariance_from_information(fit.normal_equations()[0][0], model.size_mm)
    weakest = principal_axes(C, model.size_mm)[1][:, -1]
    return poses.update(np.repeat(T[None], len(_AWAY), axis=0), _AWAY[:, None] * model.size_mm * weakest)


def _vary(model: RodModel, scene: Scene, matches: Matches, row: int, least_matches: int) -> Matches | None:
    """One match dropped, one free spot added, or one match exchanged, each refined anew."""
    T, spot_of_rod = matches.T[row], matches.spot_of_rod[row]
    matched = np.nonzero(spot_of_rod >= 0)[0]
    starts, variants = [], []
    without = np.repeat(spot_of_rod[None], len(matched), axis=0)
    without[np.arange(len(matched)), matched] = -1
    if len(matched) - 1 >= 3:
        T_without, fit, _ = refine(
            model,
            np.repeat(T[None], len(matched), axis=0),
            observations(scene, without),
            iterations=5,
            step_tolerance=1e-4,
        )
        variants.append(without)
        starts.append(T_without)
        again = assign(model, scene, T_without, fit)
        variants.append(again)
        starts.append(T_without)
        # the spot just dropped, exchanged for the next nearest free one
        used = np.zeros((len(matched), len(scene.xy_mm)), dtype=bool)
        for i in range(len(matched)):
            used[i, without[i][without[i] >= 0]] = True
            used[i, spot_of_rod[matched[i]]] = True
        xy = fit.predicted_px[np.arange(len(matched)), matched]
        gap = np.linalg.norm(scene.xy_mm[None] - xy[:, None], axis=-1)
        gap[used] = np.inf
        swap = without.copy()
        near = gap.min(axis=1, initial=np.inf) < WIDEST_GATE * model.size_mm
        swap[np.arange(len(matched)), matched] = gap.argmin(axis=1)
        variants.append(swap[near])
        starts.append(T_without[near])
        # the spot just dropped, given to another rod that crosses beside it (an upright and a diagonal where they meet)
        crossing = np.nan_to_num(fit.predicted_px, nan=np.inf)
        beside = np.linalg.norm(crossing - scene.xy_mm[spot_of_rod[matched]][:, None], axis=-1)
        beside = np.where(without < 0, beside, np.inf)
        beside[np.arange(len(matched)), matched] = np.inf
        which, other = np.nonzero(beside < WIDEST_GATE * model.size_mm)
        if len(which):
            relabelled = without[which]
            relabelled[np.arange(len(which)), other] = spot_of_rod[matched[which]]
            variants.append(relabelled)
            starts.append(T_without[which])
    variants_all = np.concatenate(variants) if variants else np.empty((0, len(model)), dtype=np.intp)
    starts_all = np.concatenate(starts) if starts else np.empty((0, 4, 4))
    _, first = np.unique(np.concatenate([spot_of_rod[None], variants_all]), axis=0, return_index=True)
    new = np.sort(first[first > 0]) - 1
    starts_all, variants_all = starts_all[new], variants_all[new]
    promised = linearise(model, starts_all, observations(scene, variants_all)).promised_chi2(model.size_mm)
    hopeful = promised < matches.fit.chi2[row] + _HOPELESS_CHI2
    return weigh(model, scene, starts_all[hopeful], variants_all[hopeful], least_matches)


def _without_each(model: RodModel, scene: Scene, matches: Matches, row: int, least_matches: int) -> Matches | None:
    """What all spots say of the other minima of a match without each of its spots.

    Only where a rod is missed and a spot left over: without these nothing can be gained for the spot given up.
    """
    spot_of_rod = matches.spot_of_rod[row]
    matched = spot_of_rod >= 0
    n = int(matched.sum())
    if n < _LEAST_WITHOUT or n == len(scene.xy_mm) or not (matches.expected[row] & ~matched).any():
        return None
    T, without = solutions_without_a_spot(model, scene, matches.T[row], spot_of_rod, neglected_p=_NEGLECTED_P)
    T, without = T[n:], without[n:]  # the first n are next to the pose that is known
    if len(T) == 0:
        return None
    again = assign(model, scene, T, linearise(model, T, observations(scene, without)))
    return weigh(model, scene, T, again, least_matches)
