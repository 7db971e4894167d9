"""What else a match could be: a twin, another rod at a spot, or a spot that is no rod's.

Registration looks for both over the whole slice; here they are looked for about one match, so that a tracked slice is
doubted at little cost and no rival is overlooked that lies close by.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ctreg_cli.arrays import FloatArray, IntArray
from ctreg_cli.design.symmetry import symmetries
from ctreg_cli.geometry.projection import project
from ctreg_cli.registration.matching import Matches, Scene, join, verify, weigh
from ctreg_cli.rods import RodModel

#: motions that take the rods onto each other as nearly as this (in frame sizes) make a twin worth looking at
_SYMMETRIC_WITHIN = 0.05
#: so many rods that map onto each other are a symmetry and no chance; so many spots determine a pose
_LEAST_SYMMETRIC, _LEAST_DETERMINED = 5, 3
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Twin:
    """A motion that maps the frame onto itself, nearly, and but for one rod perhaps."""

    #: (4, 4) model → model, mm
    transform: FloatArray
    #: (n,) rod ``i`` comes to lie on rod ``image[i]``; −1 for the odd one
    image: IntArray


@lru_cache(maxsize=16)
def twins(model: RodModel) -> tuple[Twin, ...]:
    """All of a model; cached, since it is a value that never changes.

    A frame of a few rods is made unlike its own image by one of them. In a slice where that one leaves no spot, or a
    false one, the frame has two poses all the same.
    """
    within_mm = _SYMMETRIC_WITHIN * model.size_mm
    found = [Twin(transform=s.transform, image=s.image) for s in symmetries(model, within_mm=within_mm)]
    everyone = np.arange(len(model))
    for odd in range(len(model)) if len(model) > _LEAST_SYMMETRIC else ():
        rest = np.delete(everyone, odd)
        for s in symmetries(model.subset(rest.tolist()), within_mm=within_mm):
            image = np.full(len(model), -1, dtype=np.intp)
            image[rest] = rest[s.image]
            if not any((twin.image[rest] == image[rest]).all() for twin in found):
                found.append(Twin(transform=s.transform, image=image))
    return tuple(found)


def with_twins(
    model: RodModel, scene: Scene, matches: Matches, symmetric: tuple[Twin, ...], least_matches: int
) -> Matches:
    """``matches`` and, for the best of them, what each twin of the frame makes of it.

    A motion S that takes rod i to rod ``image[i]`` makes of the pose T the pose T S; the spot of ``image[i]`` is then
    that of i. The odd rod, if any, then asks for a spot where the pose puts it.
    """
    if not symmetric:
        return matches
    T = matches.T[0] @ np.stack([twin.transform for twin in symmetric])
    own = np.append(matches.spot_of_rod[0], -1)
    spot_of_rod = np.stack([own[twin.image] for twin in symmetric])
    enough = (spot_of_rod >= 0).sum(axis=1) >= max(least_matches, _LEAST_DETERMINED)
    parts = [
        weigh(model, scene, T[enough], spot_of_rod[enough], least_matches),
        verify(model, scene, T[enough], spot_of_rod[enough], least_matches) if enough.any() else None,
    ]
    return join([matches, *(part for part in parts if part is not None)])
