"""Labelled spots to poses by linear algebra (Doignon et al. 2008, §2, eq. 4–6).

The spot ``(u, v)`` in model coordinates is ``X = l1 u + l2 v + c`` with ``l1 = s_x r1``, ``l2 = s_y r2`` and
``c = −Rᵀ t``, where r1 and r2 are the first two rows of R. It lies on its rod, ``X × y = w``: of these three equations
a rod two are independent, the components of ``X − p`` across the rod, and those are the rows used. What closes
the system depends on its rank:

==========  =====================================  ==========================================================
rank of 9   scales known                           scales unknown
==========  =====================================  ==========================================================
9           linear                                 linear: ``s_x = |l1|``, ``s_y = |l2|`` (eq. 6)
8           ``|l1| = s_x, |l2| = s_y, l1·l2 = 0``  ``l1·l2 = 0``: one quadratic on the family x + a n
less        three rods at a time (``minimal``)     undetermined
==========  =====================================  ==========================================================

Four generic rods give rank 8, but so do six rods of a two-panel Leksell box at every pose: the rank is judged on
the singular values, never on the number of rods. Noise lifts a singular value that is truly zero, so that it
counts as zero up to what noise alone would make of it; between certainly zero and certainly not, the answers of
both branches are returned.

A slice seen from behind (mirrored pixels) is a proper pose too, turned over; a mirrored *frame* is never
returned, for ``r3 = r1 × r2``. The answers are exact for exact spots and only starting points for noisy ones
(method §3).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from ctreg_cli.arrays import FloatArray
from ctreg_cli.errors import SingularGeometryError
from ctreg_cli.geometry.pose import make_pose, nearest_rotation
from ctreg_cli.registration.minimal import RodTriples, solve_three
from ctreg_cli.registration.refine import across
from ctreg_cli.rods import RodModel

#: a singular value below this share of the greatest is rounding
RANK_TOLERANCE = 1e-9
#: noise of relative size ε lifts a vanishing singular value to about ε times the greatest; up to so many times: maybe
_NOISE_FACTOR = 4.0
#: rods whose directions spread less than this (sine), or whose ends leave their plane by less than this share of
#: the frame's size, count as parallel or coplanar
_DEGENERATE = 1e-6
#: rod triples tried where the linear system has rank below 8
_MOST_TRIPLES = 24
_REAL = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _System:
    """``A x = b`` in nine unknowns of one size: x = (ρ_u l1, ρ_v l2, c), mm."""

    A: FloatArray
    b: FloatArray
    #: (2,) spread ρ of the spots, and (2,) their mean, px
    spread_px: FloatArray
    centre_px: FloatArray
    #: (3,) origin of c, model frame, mm
    origin: FloatArray

    @classmethod
    def of(cls, points: FloatArray, directions: FloatArray, uv_px: FloatArray) -> _System:
        centre = uv_px.mean(axis=0)
        centred = uv_px - centre
        spread = np.sqrt((centred**2).mean(axis=0))
        spread = np.where(spread > 0, spread, 1.0)
        E = np.swapaxes(across(directions), 1, 2)  # (n, 2, 3) rows across each rod
        middle = _middle(points, directions)
        x = centred / spread
        A = np.concatenate([x[:, 0, None, None] * E, x[:, 1, None, None] * E, E], axis=2).reshape(-1, 9)
        b = np.einsum("nij,nj->ni", E, points - middle).reshape(-1)
        return cls(A=A, b=b, spread_px=spread, centre_px=centre, origin=middle)

    def columns(self, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """l1 and l2 (mm per px) and the model coordinates of pixel (0, 0), each (..., 3)."""
        l1, l2 = x[..., 0:3] / self.spread_px[0], x[..., 3:6] / self.spread_px[1]
        corner = x[..., 6:9] + self.origin - l1 * self.centre_px[0] - l2 * self.centre_px[1]
        return l1, l2, corner


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LinearSolutions:
    """All real answers; ``r`` may be 0."""

    #: (r, 4, 4) ``T_slice_model``, mm
    T: FloatArray
    #: (r, 2) ``[s_x, s_y]``: given, or found
    mm_per_px: FloatArray
    #: rank of the linear system in its nine unknowns, as far as noise lets it be told
    rank: int


def solve_labelled(
    model: RodModel, uv_px: FloatArray, *, mm_per_px: FloatArray | None, noise_px: float = 0.0
) -> LinearSolutions:
    """All poses (and scales) that labelled spots allow, exact for exact spots.

    Args:
        model: the n rods that left the spots, in their order.
        uv_px: (n, 2) one spot a rod, px.
        mm_per_px: (2,) ``[s_x, s_y]``; None: unknown.
        noise_px: standard deviation of the spots; only judges the rank and lets nearly real roots pass.

    Raises:
        SingularGeometryError: fewer than three rods (four with unknown scales), parallel or coplanar rods,
            spots in one point, or unknown scales and a system of rank below 8.
    """
    uv_px = np.asarray(uv_px, dtype=np.float64)
    check_geometry(model, 3 if mm_per_px is not None else 4)
    if not np.ptp(uv_px, axis=0).any():
        raise SingularGeometryError("all spots are in one point: a pose needs spots apart from each other")
    if len(model) == 3 and mm_per_px is not None:
        return _from_triples(model, uv_px, mm_per_px, noise_px, rank=6)
    system = _System.of(model.starts, model.directions, uv_px)
    U, sv, Vt = np.linalg.svd(system.A)
    sv = np.concatenate([sv, np.zeros(9 - len(sv))])
    noise = _NOISE_FACTOR * noise_px / float(system.spread_px.min())
    surely = int((sv > max(RANK_TOLERANCE, noise) * sv[0]).sum())
    perhaps = int((sv > RANK_TOLERANCE * sv[0]).sum())
    if mm_per_px is not None and surely < 8:
        return _from_triples(model, uv_px, mm_per_px, noise_px, rank=surely)
    if sv[7] <= max(RANK_TOLERANCE, noise / _NOISE_FACTOR) * sv[0]:
        raise SingularGeometryError(
            f"{len(model)} spots of these rods do not fix the 8 unknowns of a pose and two scales: "
            "more rods, or rods in more directions, or a known scale are needed"
        )
    projected = U.T[:8] @ system.b
    found: list[FloatArray] = []
    base = Vt[:8].T @ (projected / sv[:8])
    if perhaps == 9:
        found.append((base + Vt[8] * (U[:, 8] @ system.b) / sv[8])[None])
    if surely < 9:
        found.append(_close(system, base, Vt[8], mm_per_px))
    l1, l2, corner = system.columns(np.concatenate(found))
    length = np.stack([np.linalg.norm(l1, axis=1), np.linalg.norm(l2, axis=1)], axis=1)
    sound = (length > 0).all(axis=1)
    scale = length if mm_per_px is None else np.broadcast_to(mm_per_px, length.shape)
    return LinearSolutions(T=_poses(l1[sound], l2[sound], corner[sound]), mm_per_px=np.array(scale[sound]), rank=surely)


def check_geometry(model: RodModel, least: int) -> None:
    """Refuse rods that cannot fix a pose, whatever the spots.

    Raises:
        SingularGeometryError: too few rods, or parallel, or coplanar ones.
    """
    if len(model) < least:
        raise SingularGeometryError(f"{len(model)} labelled spots, but at least {least} are needed")
    # signs of directions mean nothing: the spread about their common axis does
    if np.linalg.svd(model.directions, compute_uv=False)[1] < _DEGENERATE:
        raise SingularGeometryError("the rods are parallel: the slice can slide along them without moving a spot")
    ends = np.concatenate([model.starts, model.ends]) - model.centre
    if np.linalg.svd(ends, compute_uv=False)[2] < _DEGENERATE * model.size_mm:
        raise SingularGeometryError("the rods lie in one plane: the slice can turn about its line in it")


def _close(system: _System, base: FloatArray, null: FloatArray, mm_per_px: FloatArray | None) -> FloatArray:
    """The members (r, 9) of the family ``base + a null`` that are poses: eq. |l1| = s_x, |l2| = s_y, l1·l2 = 0.

    With known scales these are three quadratics in one unknown, which noise keeps from agreeing: every local
    minimum of the sum of their squares (a quartic) is taken. With unknown scales only the last remains, and both
    its roots are.
    """
    k1, k2, _ = system.columns(base)
    g1, g2, _ = system.columns(null)
    right_angle = np.array([g1 @ g2, k1 @ g2 + k2 @ g1, k1 @ k2])
    if mm_per_px is None:
        roots = _roots_or_vertex(right_angle)
    else:
        s_x, s_y = mm_per_px
        length_1 = np.array([g1 @ g1, 2 * (k1 @ g1), k1 @ k1 - s_x**2]) / s_x**2
        length_2 = np.array([g2 @ g2, 2 * (k2 @ g2), k2 @ k2 - s_y**2]) / s_y**2
        right_angle = right_angle / (s_x * s_y)
        # 2 (l1·l2)² so that the sum is the squared Frobenius distance of the Gram matrix from the identity
        cost = (
            np.polymul(length_1, length_1) + np.polymul(length_2, length_2) + 2 * np.polymul(right_angle, right_angle)
        )
        stationary = np.roots(np.polyder(cost))
        real = stationary.real[np.abs(stationary.imag) <= _REAL * (1 + np.abs(stationary))]
        roots = real[np.polyval(np.polyder(cost, 2), real) >= 0]
    family: FloatArray = base + roots[:, None] * null
    return family


def _roots_or_vertex(quadratic: FloatArray) -> FloatArray:
    """Real roots of a quadratic, highest power first; its vertex where noise has made them complex."""
    a, b, c = quadratic
    if abs(a) <= RANK_TOLERANCE * max(abs(b), abs(c)):
        return np.array([-c / b]) if b else np.empty(0)
    root = np.sqrt(max(b * b - 4 * a * c, 0.0))
    roots: FloatArray = np.array([-b - root, -b + root]) / (2 * a)
    return roots


def _poses(l1: FloatArray, l2: FloatArray, corner: FloatArray) -> FloatArray:
    """Poses (r, 4, 4) of the images' axes (r, 3) in model coordinates, and of pixel (0, 0)."""
    r1 = l1 / np.linalg.norm(l1, axis=1, keepdims=True)
    r2 = l2 / np.linalg.norm(l2, axis=1, keepdims=True)
    R = nearest_rotation(np.stack([r1, r2, np.cross(r1, r2)], axis=1))
    return make_pose(R, -np.einsum("rij,rj->ri", R, corner))


def _from_triples(
    model: RodModel, uv_px: FloatArray, mm_per_px: FloatArray, noise_px: float, *, rank: int
) -> LinearSolutions:
    """All poses of the rods' triples (each exact for its own three spots)."""
    xy = uv_px * mm_per_px
    triples = np.array(list(combinations(range(len(model)), 3)), dtype=np.intp)
    spanned = np.linalg.svd(model.directions[triples], compute_uv=False)[:, 1]
    a, b = np.moveaxis(xy[triples[:, 1:]] - xy[triples[:, :1]], 1, 0)
    area = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    triples = triples[np.argsort(-spanned * area, kind="stable")[:_MOST_TRIPLES]]
    noise_mm = noise_px * float(np.max(mm_per_px))
    T, _ = solve_three(RodTriples.of(model, triples), xy[triples], slack_mm=3 * noise_mm, noise_mm=noise_mm)
    return LinearSolutions(T=T, mm_per_px=np.broadcast_to(mm_per_px, (len(T), 2)), rank=rank)


def _middle(points: FloatArray, directions: FloatArray) -> FloatArray:
    """The point nearest all lines in the least-squares sense: beside it c stays small."""
    across_projector = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    rhs = np.einsum("nij,nj->i", across_projector, points)
    middle: FloatArray = np.linalg.pinv(across_projector.sum(axis=0), rcond=1e-6, hermitian=True) @ rhs
    return middle
