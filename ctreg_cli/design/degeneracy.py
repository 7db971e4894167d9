"""Sets of rods that leave a pose undetermined: parallel ones, and those in one plane (method §4)."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from ctreg_cli.arrays import FloatArray, IntArray
from ctreg_cli.geometry.plucker import point_line_distance
from ctreg_cli.rods import RodModel

#: rods within this angle of each other are parallel
PARALLEL_RAD = 1e-3
#: rods whose ends are within this share of the frame's size of one plane are coplanar
COPLANAR_SHARE = 1e-3


def parallel_triples(model: RodModel) -> IntArray:
    """(k, 3) indices of all triples of mutually parallel rods."""
    sine = np.linalg.norm(np.cross(model.directions[:, None], model.directions[None, :]), axis=-1)
    parallel = sine < PARALLEL_RAD
    triples = _triples(len(model))
    i, j, k = triples.T
    found: IntArray = triples[parallel[i, j] & parallel[j, k] & parallel[i, k]]
    return found


def coplanar_triples(model: RodModel) -> IntArray:
    """(k, 3) indices of all triples of rods in one plane; every N panel is one."""
    triples = _triples(len(model))
    ends = np.concatenate([model.starts[triples], model.ends[triples]], axis=1)  # (k, 6, 3)
    return triples[_distance_from_plane(ends) < COPLANAR_SHARE * model.size_mm]


def coincident_pairs(model: RodModel) -> list[tuple[int, int]]:
    """Pairs of rods that lie on one line and overlap there: most likely one rod written twice."""
    found = []
    for i, j in combinations(range(len(model)), 2):
        ends = np.stack([model.starts[j], model.ends[j]])
        off_line = point_line_distance(ends, model.starts[i], model.directions[i])
        along = (ends - model.starts[i]) @ model.directions[i]
        overlap = min(along.max(), model.lengths[i]) - max(along.min(), 0.0)
        if off_line.max() < COPLANAR_SHARE * model.size_mm and overlap > 0:
            found.append((i, j))
    return found


def groups(triples: IntArray) -> tuple[tuple[int, ...], ...]:
    """The fewest sets of which ``triples`` are the parts: rods joined wherever two triples share two rods.

    Right for parallel rods, and for coplanar ones as long as two of them are not on one line.
    """
    found: list[set[int]] = []
    for triple in map(set, triples.tolist()):
        joined = [group for group in found if len(group & triple) >= 2]
        found = [group for group in found if group not in joined] + [triple.union(*joined)]
    return tuple(sorted(tuple(sorted(group)) for group in found))


def _triples(n: int) -> IntArray:
    return np.array(list(combinations(range(n), 3)), dtype=np.intp).reshape(-1, 3)


def _distance_from_plane(points: FloatArray) -> FloatArray:
    """Greatest distance (k,) of points (k, m, 3) from the plane that fits each set best."""
    centred = points - points.mean(axis=1, keepdims=True)
    normal = np.linalg.svd(centred, full_matrices=False)[2][:, 2]
    distance: FloatArray = np.abs(np.einsum("kmi,ki->km", centred, normal)).max(axis=1)
    return distance
