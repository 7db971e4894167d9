"""Rigid motions that map a frame onto itself: each gives every slice a second, equally good pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctreg_cli.arrays import FloatArray, IntArray
from ctreg_cli.geometry.pose import make_pose, rotation_angle
from ctreg_cli.rods import RodModel

#: a motion that turns the frame by less than this is no other pose
MIN_ANGLE_RAD = np.radians(5.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Symmetry:
    """A proper rigid motion of the model frame that takes every bounded rod to a rod, either way round."""

    #: (4, 4) model → model, mm; improper for a mirror image
    transform: FloatArray
    angle_deg: float
    #: (3,) unit axis of the turn, model axes
    axis: FloatArray
    #: (n,) rod ``i`` comes to lie on rod ``image[i]``
    image: IntArray
    #: greatest distance between an end of a moved rod and the end it comes to, mm; 0 for an exact symmetry
    deviation_mm: float


def symmetries(model: RodModel, *, within_mm: float, mirrored: bool = False) -> tuple[Symmetry, ...]:
    """All motions, but for the identity, that map the rods onto rods to ``within_mm``, the closest first.

    With ``mirrored`` those that do so to the frame's mirror image: ``transform`` then holds the mirror too.

    A pair of rods on different lines fixes a motion once its image is chosen, so every ordered pair is tried as its
    image, each rod both ways round; what maps the pair is then checked on all rods.
    """
    n = len(model)
    ends = np.stack([model.starts, model.ends], axis=1)  # (n, 2, 3)
    mirror = np.diag([-1.0 if mirrored else 1.0, 1.0, 1.0, 1.0])
    source = _move(mirror, ends.reshape(-1, 3)).reshape(n, 2, 3)
    a, b = _reference_pair(model)
    pairs = _ordered_pairs(ends)
    reference = np.concatenate([source[a], source[b]])
    # two rods fix the rest loosely where they are short or close: allow for it here, and measure properly below
    slack_mm = 2 * within_mm
    fitted = _fit(reference, pairs)
    close = np.linalg.norm(_move(fitted, reference) - pairs, axis=-1).max(axis=-1) < slack_mm

    found: dict[tuple[int, ...], Symmetry] = {}
    for T in fitted[close]:
        image, flipped = _images(_move(T, source.reshape(-1, 3)).reshape(n, 2, 3), ends)
        key = (*image.tolist(), *flipped.tolist())
        if key in found or len(set(image.tolist())) < n:
            continue
        target = np.where(flipped[:, None, None], ends[image][:, ::-1], ends[image])
        best = _fit(source.reshape(-1, 3), target.reshape(1, -1, 3))[0]
        deviation = float(_deviations(best, source, target).max())
        angle = float(rotation_angle(best[:3, :3]))
        if deviation <= within_mm and (mirrored or angle > MIN_ANGLE_RAD):
            found[key] = Symmetry(
                transform=best @ mirror,
                angle_deg=float(np.degrees(angle)),
                axis=_axis(best[:3, :3]),
                image=image,
                deviation_mm=deviation,
            )
    return tuple(sorted(found.values(), key=lambda symmetry: (round(symmetry.deviation_mm, 9), symmetry.angle_deg)))


def partial_symmetries(
    model: RodModel, *, within_mm: float, least: int, mirrored: bool = False
) -> tuple[tuple[FloatArray, IntArray], ...]:
    """Motions, but for the identity, that map ``least`` rods or more onto rods to ``within_mm``, the closest first.

    A box has panels that are alike: where a slice shows rods of two of them only, it has two poses. Every pair of rods
    is tried on every ordered pair, where the distances of their ends allow it.

    Args:
        model: the rods.
        within_mm: greatest distance between an end of a moved rod and the end it comes to.
        least: how many rods.
        mirrored: whether to map them onto the mirror image, as in :func:`symmetries`.

    Returns:
        Transforms (4, 4), and (n,) the rod that each comes to lie on, −1 for none.
    """
    n = len(model)
    ends = np.stack([model.starts, model.ends], axis=1)
    mirror = np.diag([-1.0 if mirrored else 1.0, 1.0, 1.0, 1.0])
    source = _move(mirror, ends.reshape(-1, 3)).reshape(n, 2, 3)
    pairs = _ordered_pairs(ends)
    between = _distances(pairs)
    found: dict[bytes, tuple[float, FloatArray, IntArray]] = {}
    for a, b in zip(*np.triu_indices(n, 1), strict=True):
        reference = np.concatenate([source[a], source[b]])
        alike = np.abs(between - _distances(reference[None])).max(axis=1) < 4 * within_mm
        for T in _fit(reference, pairs[alike]):
            for _ in range(2):  # on all that it takes along
                image, flipped = _images(_move(T, source.reshape(-1, 3)).reshape(n, 2, 3), ends)
                target = np.where(flipped[:, None, None], ends[image][:, ::-1], ends[image])
                taken = np.flatnonzero(_deviations(T, source, target) < 2 * within_mm)
                if len(taken) < least:
                    break
                T = _fit(source[taken].reshape(-1, 3), target[taken].reshape(1, -1, 3))[0]
            off = _deviations(T, source, target)
            mapped = off <= within_mm
            if mapped.sum() < least or len(set(image[mapped].tolist())) < mapped.sum():
                continue
            if not mirrored and rotation_angle(T[:3, :3]) <= MIN_ANGLE_RAD and np.linalg.norm(T[:3, 3]) <= within_mm:
                continue
            image = np.where(mapped, image, -1)
            key = image.tobytes() + flipped[mapped].tobytes()
            found.setdefault(key, (round(float(off[mapped].max()), 9), T @ mirror, image))
    return tuple((T, image) for _, T, image in sorted(found.values(), key=lambda each: each[0]))


def _ordered_pairs(ends: FloatArray) -> FloatArray:
    """(4 n (n − 1), 4, 3) the ends of each two rods (n, 2, 3), in either order, each either way round."""
    i, j = (index.ravel() for index in np.nonzero(~np.eye(len(ends), dtype=bool)))
    return np.concatenate(
        [
            np.concatenate([ends[i][:, ::flip_i], ends[j][:, ::flip_j]], axis=1)
            for flip_i in (1, -1)
            for flip_j in (1, -1)
        ]
    )


def _distances(points: FloatArray) -> FloatArray:
    """(k, 6) between each two of four points (k, 4, 3)."""
    i, j = np.triu_indices(4, 1)
    return np.asarray(np.linalg.norm(points[:, i] - points[:, j], axis=-1))


def _reference_pair(model: RodModel) -> tuple[int, int]:
    """The two rods whose four ends spread widest about their common line: they fix a motion best."""
    n = len(model)
    ends = np.stack([model.starts, model.ends], axis=1)
    i, j = np.triu_indices(n, 1)
    four = np.concatenate([ends[i], ends[j]], axis=1)
    spread = np.linalg.svd(four - four.mean(axis=1, keepdims=True), compute_uv=False)[:, 1]
    best = int(spread.argmax())
    return int(i[best]), int(j[best])


def _fit(points: FloatArray, targets: FloatArray) -> FloatArray:
    """Rigid motions (k, 4, 4), never mirrors, that take points (m, 3) closest to targets (k, m, 3) (Kabsch)."""
    p, q = points.mean(axis=0), targets.mean(axis=1)
    H = np.einsum("kmi,mj->kij", targets - q[:, None], points - p)
    U, _, Vt = np.linalg.svd(H)
    U[..., :, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
    R = U @ Vt
    return make_pose(R, q - np.einsum("kij,j->ki", R, p))


def _move(T: FloatArray, points: FloatArray) -> FloatArray:
    return points @ np.swapaxes(T[..., :3, :3], -1, -2) + T[..., None, :3, 3]


def _deviations(T: FloatArray, source: FloatArray, target: FloatArray) -> FloatArray:
    """(n,) greatest distance of the ends of moved rods (n, 2, 3) from those they come to."""
    moved = _move(T, source.reshape(-1, 3)).reshape(source.shape)
    return np.asarray(np.linalg.norm(moved - target, axis=-1).max(axis=-1))


def _images(moved: FloatArray, ends: FloatArray) -> tuple[IntArray, IntArray]:
    """For each moved rod the rod nearest to it, and whether it lies there the other way round."""
    straight = np.linalg.norm(moved[:, None] - ends[None], axis=-1).max(axis=-1)
    turned = np.linalg.norm(moved[:, None] - ends[None, :, ::-1], axis=-1).max(axis=-1)
    image = np.minimum(straight, turned).argmin(axis=1)
    rows = np.arange(len(image))
    return image, (turned[rows, image] < straight[rows, image]).astype(np.intp)


def _axis(R: FloatArray) -> FloatArray:
    """Unit axis of a rotation; for half a turn, whose sense does not matter, with its greatest component positive."""
    values, vectors = np.linalg.eigh((R + R.T) / 2)
    axis: FloatArray = vectors[:, int(values.argmax())]
    sense = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) @ axis
    half_turn = abs(sense) < 1e-6
    sign = axis[np.abs(axis).argmax()] if half_turn else sense
    return axis * np.sign(sign)
