"""What else a match could be: a twin, another rod at a spot, or a spot that is no rod's.

Registration looks for both over the whole slice; here they are looked for about one match, so that a tracked slice is
doubted at little cost and no rival is overlooked that lies close by.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ctreg_cli.arrays import IntArray, frozen
from ctreg_cli.design.symmetry import Symmetry
from ctreg_cli.geometry import pose as poses
from ctreg_cli.geometry.projection import project
from ctreg_cli.registration.matching import Matches, Scene, join, weigh
from ctreg_cli.registration.refine import covariance_from_information
from ctreg_cli.registration.result import Candidate
from ctreg_cli.rods import RodModel

#: a rod whose crossing lies this near a spot (in frame sizes) could be the spot's
_NEAR_SIZES = 0.15
#: a match that moves the pose by more than this (χ² of six degrees of freedom) must be better supported than
#: 1000 : 1 (ln), or the covariance has to cover the pose without it
_INFLUENTIAL_D2, _WELL_SUPPORTED = 20.0, 7.5


def with_other_rods(model: RodModel, scene: Scene, matches: Matches, least_matches: int) -> Matches:
    """``matches`` and, for the best of them, those in which one spot is given otherwise, where the spots lie near.

    Two rods that cross near a spot exchange what they have (one of them the spot, the other another one, or none); a
    rod takes a spot that is nobody's in place of its own, or of none.
    """
    spot_of_rod = matches.spot_of_rod[0]
    crossing = project(matches.T[0], model.starts, model.directions).xy_mm
    gap = np.linalg.norm(np.nan_to_num(crossing, nan=np.inf)[:, None] - scene.xy_mm, axis=-1)
    rod_of_spot = np.full(len(scene.xy_mm), -1, dtype=np.intp)
    taken = np.nonzero(spot_of_rod >= 0)[0]
    rod_of_spot[spot_of_rod[taken]] = taken
    variants: dict[bytes, IntArray] = {}
    for rod, spot in zip(*np.nonzero(gap < _NEAR_SIZES * model.size_mm), strict=True):
        has_it = rod_of_spot[spot]
        if has_it == rod:
            continue
        other = spot_of_rod.copy()
        if has_it >= 0:
            other[has_it] = spot_of_rod[rod]
        other[rod] = spot
        variants[other.tobytes()] = other
    if not variants:
        return matches
    found = weigh(
        model, scene, np.repeat(matches.T[:1], len(variants), axis=0), np.stack(list(variants.values())), least_matches
    )
    return matches if found is None else join([matches, found])


def with_twins(
    model: RodModel, scene: Scene, matches: Matches, symmetric: tuple[Symmetry, ...], least_matches: int
) -> Matches:
    """``matches`` and, for the best of them, what each symmetry of the frame makes of it.

    A motion S that takes rod i to rod ``image[i]`` makes of the pose T the pose T S; the spot of ``image[i]`` is then
    that of i.
    """
    if not symmetric:
        return matches
    T = matches.T[0] @ np.stack([s.transform for s in symmetric])
    spot_of_rod = np.stack([matches.spot_of_rod[0][s.image] for s in symmetric])
    found = weigh(model, scene, T, spot_of_rod, least_matches)
    return matches if found is None else join([matches, found])


def covering(model: RodModel, matches: Matches, best: Candidate) -> Candidate:
    """``best`` with a covariance that covers the poses without each match that is influential and not well supported.

    Such a match may be a false spot that happens to fit. The odds say how seldom; but where one spot decides so much,
    more is asked than for the rest.
    """
    own = np.full(len(model), -1, dtype=np.intp)
    own[best.rod_index] = best.spot_index
    fewer = (matches.spot_of_rod == own) | (matches.spot_of_rod < 0)
    less = fewer.all(axis=1) & (matches.spot_of_rod != own).any(axis=1)
    less &= matches.log_odds > best.log_odds - _WELL_SUPPORTED
    H, _ = matches.fit.normal_equations()
    C, _ = covariance_from_information(H, model.size_mm)
    information = np.linalg.inv(best.covariance)
    covariance = np.array(best.covariance)
    for row in np.nonzero(less)[0]:
        apart = poses.difference(matches.T[row], best.T_slice_model)
        if apart @ information @ apart > _INFLUENTIAL_D2:
            covariance += 0.5 * (C[row] + np.outer(apart, apart))
    return replace(best, covariance=frozen(covariance, (6, 6)))
