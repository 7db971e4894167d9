"""What else a match could be: another rod at a spot, or a spot that is no rod's.

Registration looks for both over the whole slice; here they are looked for about one match, so that a tracked slice is
doubted at little cost and no rival is overlooked that lies close by.
"""

from __future__ import annotations

import numpy as np

from ctreg_cli.arrays import IntArray
from ctreg_cli.geometry.projection import project
from ctreg_cli.registration.matching import Matches, Scene, join, weigh
from ctreg_cli.rods import RodModel

#: a rod whose crossing lies this near a spot (in frame sizes) could be the spot's
_NEAR_SIZES = 0.15


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
