"""A frame that is nearly its own image has a second pose in every slice: what its symmetries make of a match.

The search finds most twins by itself, but noise can take every root of the triples it starts from. These are worked out
from the frame. So are those of a frame that is its own mirror image: a slice has no handedness, and a mirrored frame
seen from the other side leaves the same spots.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ctreg_cli.arrays import FloatArray, IntArray
from ctreg_cli.design.symmetry import partial_symmetries, symmetries
from ctreg_cli.registration.matching import Matches, Scene, join, verify, weigh
from ctreg_cli.rods import RodModel

#: motions that take the rods onto each other as nearly as this (in frame sizes) make a twin worth looking at
_SYMMETRIC_WITHIN = 0.05
#: ... of a part of them; panels of a box are alike as they were drawn
_ALIKE_WITHIN = 0.02
#: so many rods that map onto each other are a symmetry and no chance; so many spots determine a pose
_LEAST_SYMMETRIC, _LEAST_DETERMINED = 5, 3
#: rods up to which twins are looked for: symmetries are sought in all pairs
_MOST_RODS = 24
#: ... and twins of a part of the frame: these are sought from all pairs; so many are looked at
_MOST_PARTIAL, _MOST_PARTIAL_TWINS = 12, 32


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Twin:
    """A motion that maps the frame onto itself (or its mirror image), nearly, and but for one rod perhaps."""

    #: (4, 4) model → model, mm; improper for a mirror image
    transform: FloatArray
    #: (n,) rod ``i`` comes to lie on rod ``image[i]``; −1 for the odd one
    image: IntArray


@lru_cache(maxsize=32)
def twins(model: RodModel, *, mirrored: bool = False) -> tuple[Twin, ...]:
    """All of a model, or all of its mirror image; cached, since it is a value that never changes.

    A frame of a few rods is made unlike its own image by one of them. In a slice where that one leaves no spot, or a
    false one, the frame has two poses all the same.
    """
    if len(model) > _MOST_RODS:
        return ()
    within_mm = _SYMMETRIC_WITHIN * model.size_mm
    alike = symmetries(model, within_mm=within_mm, mirrored=mirrored)
    found = [Twin(transform=s.transform, image=s.image) for s in alike]
    everyone = np.arange(len(model))
    for odd in range(len(model)) if len(model) > _LEAST_SYMMETRIC else ():
        rest = np.delete(everyone, odd)
        for s in symmetries(model.subset(rest.tolist()), within_mm=within_mm, mirrored=mirrored):
            image = np.full(len(model), -1, dtype=np.intp)
            image[rest] = rest[s.image]
            if not any((twin.image[rest] == image[rest]).all() for twin in found):
                found.append(Twin(transform=s.transform, image=image))
    return tuple(found)


@lru_cache(maxsize=32)
def partial_twins(model: RodModel, *, mirrored: bool = False) -> tuple[Twin, ...]:
    """Motions that map five rods or more onto rods, beside those of :func:`twins`; cached likewise.

    Two panels of a box are alike: a slice that shows their rods alone has two poses.
    """
    if len(model) > _MOST_PARTIAL:
        return ()
    known = {twin.image.tobytes() for twin in twins(model, mirrored=mirrored)}
    alike = partial_symmetries(
        model, within_mm=_ALIKE_WITHIN * model.size_mm, least=_LEAST_SYMMETRIC, mirrored=mirrored
    )
    others = [Twin(transform=T, image=image) for T, image in alike if image.tobytes() not in known]
    return tuple(others[:_MOST_PARTIAL_TWINS])


def with_twins(model: RodModel, scene: Scene, matches: Matches, least_matches: int) -> Matches:
    """``matches`` and, for the best of them, what each twin of the frame makes of it.

    A motion S that takes rod i to rod ``image[i]`` makes of the pose T the pose T S; the spot of ``image[i]`` is then
    that of i. The odd rod, if any, then asks for a spot where the pose puts it. Of a mirror image M it makes Z T M, Z
    the mirror in the slice, which leaves the spots where they are.
    """
    proper = (*twins(model), *partial_twins(model))
    mirrored = (*twins(model, mirrored=True), *partial_twins(model, mirrored=True))
    symmetric = (*proper, *mirrored)
    if not symmetric:
        return matches
    T = matches.T[0] @ np.stack([twin.transform for twin in symmetric])
    T[len(proper) :] = np.diag([1.0, 1.0, -1.0, 1.0]) @ T[len(proper) :]
    own = np.append(matches.spot_of_rod[0], -1)
    spot_of_rod = np.stack([own[twin.image] for twin in symmetric])
    enough = (spot_of_rod >= 0).sum(axis=1) >= max(least_matches, _LEAST_DETERMINED)
    parts = [
        weigh(model, scene, T[enough], spot_of_rod[enough], least_matches),
        verify(model, scene, T[enough], spot_of_rod[enough], least_matches) if enough.any() else None,
    ]
    return join([matches, *(part for part in parts if part is not None)])
