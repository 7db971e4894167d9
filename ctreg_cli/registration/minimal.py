"""Three rods, three spots: every real pose (Doignon et al. 2008, §2; the generalised P3P with rods as rays).

Three spots have three known distances, and the pose is known once the points ``P_i = p_i + λ_i y_i`` of the rods
that lie in the slice are: ``|P_i − P_j| = d_ij``. Given λ₁, both λ₂ and λ₃ follow from quadratics,

    λ_j = q_j ± √D_j,   q_j = −y_j·w_j,   D_j = q_j² − |w_j|² + d_1j²,   w_j = p_j − p_1 − λ₁ y_1,

and what is left, ``F = |P₂ − P₃|² − d₂₃² = A + B σ₂√D₂ + C σ₃√D₃ + E σ₂σ₃√D₂√D₃``, is one equation in λ₁ on the
bounded rod. The product of F over the four signs is free of roots, a polynomial of degree 8 in λ₁,

    G = P² − D₂ Q²,   P = A² + B² D₂ − C² D₃ − E² D₂ D₃,   Q = 2 (A B − C E D₃).

Nothing here divides by anything that vanishes for parallel rods: they only lower the degree of D.
G is *evaluated*, not expanded. Per rod triple only three numbers (the squared distances) change from one spot
triple to the next, so that one table over λ₁ serves all of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev

from ctreg_cli.arrays import BoolArray, FloatArray, IntArray
from ctreg_cli.geometry.pose import make_pose
from ctreg_cli.rods import RodModel

#: degree of the polynomial G in λ₁
DEGREE = 8
_BRANCH_2 = np.array([1.0, 1.0, -1.0, -1.0])
_BRANCH_3 = np.array([1.0, -1.0, 1.0, -1.0])
_POLISH_STEPS = 12
#: the eight-degree Chebyshev interpolation: where G is evaluated on [-1, 1], and how values become coefficients
_NODES = np.cos(np.pi * (np.arange(DEGREE + 1) + 0.5) / (DEGREE + 1))
_TO_COEFFICIENTS = np.linalg.inv(chebyshev.chebvander(_NODES, DEGREE)).T
#: a double root comes out of the eigenvalues as a pair this far apart at most, in half intervals
_DOUBLE_ROOT = 1e-3
#: sine² of the angle below which two rods count as parallel: each point of one is then equally far from the other
_PARALLEL = 1e-6
#: the interval of λ₁ reaches this share of the rod beyond what the distances allow
_MARGIN = 1e-4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RodTriples:
    """Three rods for all hypotheses (g = 1), or three rods for each (g = h); λ₁ runs along the first."""

    #: (g, 3, 3) starts, (g, 3, 3) unit directions, mm; (g, 3) lengths, mm
    starts: FloatArray
    directions: FloatArray
    lengths: FloatArray

    @classmethod
    def of(cls, model: RodModel, rods: IntArray) -> RodTriples:
        """The triples ``rods`` (g, 3) of a model."""
        rods = np.atleast_2d(rods)
        return cls(starts=model.starts[rods], directions=model.directions[rods], lengths=model.lengths[rods])

    def of_hypotheses(self, hypothesis: IntArray) -> RodTriples:
        """The triple of each of these hypotheses (itself where all share one)."""
        if len(self.starts) == 1:
            return self
        return RodTriples(
            starts=self.starts[hypothesis], directions=self.directions[hypothesis], lengths=self.lengths[hypothesis]
        )

    def quadratics(self, lambda_1: FloatArray) -> Quadratics:
        """All that depends on λ₁ (g or h, k) but not on the distances."""
        p, y = self.starts, self.directions

        def dot(a: FloatArray, b: FloatArray) -> FloatArray:
            result: FloatArray = np.einsum("gi,gi->g", a, b)[:, None]
            return result

        def quadratic(gap: FloatArray, direction: FloatArray) -> tuple[FloatArray, FloatArray]:
            """q = −y·w and D = q² − |w|² of ``w = gap − λ₁ y₁``, as polynomials in λ₁."""
            cosine = dot(y[:, 0], direction)
            q = cosine * lambda_1 - dot(gap, direction)
            return q, q**2 - (dot(gap, gap) - 2 * dot(gap, y[:, 0]) * lambda_1 + lambda_1**2)

        q2, D2 = quadratic(p[:, 1] - p[:, 0], y[:, 1])
        q3, D3 = quadratic(p[:, 2] - p[:, 0], y[:, 2])
        gap, cosine = p[:, 1] - p[:, 2], dot(y[:, 1], y[:, 2])  # P₂ − P₃ = gap + q₂ y₂ − q₃ y₃ without the roots
        along_2, along_3 = dot(gap, y[:, 1]), dot(gap, y[:, 2])
        distance2 = dot(gap, gap) + q2**2 + q3**2 + 2 * (q2 * along_2 - q3 * along_3) - 2 * cosine * q2 * q3
        return Quadratics(
            q2=q2,
            q3=q3,
            D2=D2,
            D3=D3,
            A=distance2 + D2 + D3,
            B=2 * (along_2 + q2 - cosine * q3),
            C=-2 * (along_3 + cosine * q2 - q3),
            E=-2 * cosine,
        )


class Quadratics(NamedTuple):
    """The terms of F at given λ₁; add ``d₁₂²`` to D2, ``d₁₃²`` to D3 and ``d₁₂² + d₁₃² − d₂₃²`` to A."""

    q2: FloatArray
    q3: FloatArray
    D2: FloatArray
    D3: FloatArray
    A: FloatArray
    B: FloatArray
    C: FloatArray
    E: FloatArray

    def with_distances(self, d2: FloatArray) -> Quadratics:
        """For squared distances (h, 3)."""
        return self._replace(
            D2=self.D2 + d2[:, 0, None],
            D3=self.D3 + d2[:, 1, None],
            A=self.A + (d2[:, 0] + d2[:, 1] - d2[:, 2])[:, None],
        )


def squared_distances(xy_mm: FloatArray) -> FloatArray:
    """(h, 3) squared distances ``d₁₂², d₁₃², d₂₃²`` of spot triples (h, 3, 2)."""
    gaps = xy_mm[:, [0, 0, 1]] - xy_mm[:, [1, 2, 2]]
    result: FloatArray = (gaps**2).sum(axis=-1)
    return result


def solve_three(
    triples: RodTriples, xy_mm: FloatArray, *, slack_mm: float = 0.0, noise_mm: float = 0.0
) -> tuple[FloatArray, IntArray]:
    """All real poses for three rods and each of ``h`` spot triples, to machine precision.

    Args:
        triples: the rods, shared by all spot triples or one row each.
        xy_mm: (h, 3, 2) spots in slice coordinates, mm, in the order of the rods.
        slack_mm: how far beyond a rod's ends a solution may lie.
        noise_mm: spot noise; a pair of solutions that noise has just made complex is still returned (as one
        near-solution).

    Returns:
        ``T_slice_model`` (r, 4, 4) of all solutions and (r,) the spot triple each belongs to. Three parallel rods
        give none.
    """
    d2 = squared_distances(xy_mm)
    low, high = _reachable(triples, d2, slack_mm, noise_mm)  # (h, 1)
    half = (high - low) / 2
    values = _evaluate_G(triples.quadratics(low + half * (1 + _NODES)).with_distances(d2))
    values = values / np.maximum(np.abs(values).max(axis=1, keepdims=True), np.finfo(float).tiny)
    roots = _chebyshev_roots(values @ _TO_COEFFICIENTS)  # (h, 8) complex, on [-1, 1]
    imaginary_limit = np.maximum(_DOUBLE_ROOT * half, np.sqrt(8 * noise_mm * half))
    keep = (np.abs(roots.real) <= 1 + _DOUBLE_ROOT) & (np.abs(roots.imag) * half <= imaginary_limit)
    hypothesis, _ = np.nonzero(keep)
    # of two roots that rounding has made a complex pair, each starts on a side of its own
    lambda_1 = low[hypothesis, 0] + half[hypothesis, 0] * (1 + (roots.real + roots.imag)[keep])
    lambdas, hypothesis = _branches(triples, d2, hypothesis, lambda_1)
    residual_mm = max(4 * noise_mm, 1e-7 * float(triples.lengths.max()) / 2)
    return _finish(triples, xy_mm, d2, hypothesis, lambdas, slack_mm, residual_mm, _POLISH_STEPS)


def _reachable(triples: RodTriples, d2: FloatArray, slack_mm: float, noise_mm: float) -> tuple[FloatArray, FloatArray]:
    """The part (low, high), each (h, 1), of the first rod with both others within reach: D₂ ≥ 0 and D₃ ≥ 0.

    ``D_j = d_1j² − (distance from P₁ to line j)²`` is concave in λ₁, so that each bounds an interval. Where rods
    meet at a corner and the triangle is small, that interval is a thousandth of the rod, and only on it do the
    roots of G stand apart.
    """
    p, y = triples.starts, triples.directions
    gap, cosine = p[:, 1:] - p[:, :1], np.einsum("gjk,gk->gj", y[:, 1:], y[:, 0])
    # D_j − d_1j² = −(a λ² − 2 b λ + c), with the parts across line j of what separates the rods
    across = gap - np.einsum("gjk,gjk->gj", gap, y[:, 1:])[..., None] * y[:, 1:]
    a = 1 - cosine**2
    b = np.einsum("gjk,gk->gj", across, y[:, 0])
    c = (across**2).sum(axis=-1)
    nearly_parallel = a < _PARALLEL
    middle = b / np.where(nearly_parallel, 1.0, a)
    within2 = (np.sqrt(d2[:, :2]) + 4 * noise_mm) ** 2 - (c - np.where(nearly_parallel, 0.0, b * middle))
    reach = np.sqrt(np.maximum(within2, 0) / np.where(nearly_parallel, 1.0, a))
    least, most = -slack_mm, triples.lengths[:, :1] + slack_mm
    length = most - least
    margin = _MARGIN * length
    start = np.where(nearly_parallel, least, middle - reach - 0.05 * reach).max(axis=1, keepdims=True) - margin
    end = np.where(nearly_parallel, most, middle + reach + 0.05 * reach).min(axis=1, keepdims=True) + margin
    low = np.clip(np.broadcast_to(start, (len(d2), 1)), least, most - margin)
    high = np.clip(np.broadcast_to(end, (len(d2), 1)), low + margin, most)
    return low, np.maximum(high, low + margin)


def scan_three(
    triples: RodTriples, xy_mm: FloatArray, *, slack_mm: float, noise_mm: float, samples: int = 16
) -> tuple[FloatArray, IntArray]:
    """Like :func:`solve_three` for tens of thousands of spot triples: sign changes and near misses of F on a grid.

    Each of the four sign choices is scanned by itself, where its roots lie far apart (those of G crowd together
    for parallel rods at a small tilt). Beyond a fold (D < 0) F goes on with √D = 0, so that a root beside the
    fold still shows as a sign change, and one that noise has pushed over it as a small value.
    """
    d2 = squared_distances(xy_mm)
    low, high = -slack_mm, triples.lengths[:, :1] + slack_mm
    at = low + (high - low) * np.linspace(0, 1, samples)  # (g, k)
    terms = triples.quadratics(at).with_distances(d2)
    at = np.broadcast_to(at, (len(xy_mm), samples))
    blur = 8 * noise_mm * np.sqrt(d2)  # what noise does to a squared distance, generously
    real = (-blur[:, 0, None] <= terms.D2) & (-blur[:, 1, None] <= terms.D3)
    r2, r3 = np.sqrt(np.maximum(terms.D2, 0)), np.sqrt(np.maximum(terms.D3, 0))
    limit = blur.sum(axis=1)[:, None]
    Br2, Cr3, Er2r3 = terms.B * r2, terms.C * r3, terms.E * r2 * r3
    same, opposite = terms.A + Er2r3, terms.A - Er2r3
    plus, minus = Br2 + Cr3, Br2 - Cr3
    real_between = real[:, 1:] | real[:, :-1]
    found = []
    for s2, s3 in zip(_BRANCH_2, _BRANCH_3, strict=True):
        F = (same if s2 == s3 else opposite) + s2 * (plus if s2 == s3 else minus)
        positive = F > 0
        crossing = (positive[:, 1:] != positive[:, :-1]) & real_between
        h, k = np.nonzero(crossing)
        f0, f1 = F[h, k], F[h, k + 1]
        share = f0 / (f0 - f1)
        found.append((h, at[h, k] + share * (at[h, k + 1] - at[h, k]), s2, s3))
        # the least of |F| among its neighbours, where no sign change says more
        h, k = np.nonzero((limit >= F) & (-limit <= F) & real)
        before, after = np.maximum(k - 1, 0), np.minimum(k + 1, samples - 1)
        size = np.abs(F[h, k])
        dip = (size <= np.abs(F[h, before])) & (size <= np.abs(F[h, after]))
        dip &= ~(crossing[h, np.minimum(k, samples - 2)] & (k < samples - 1)) & ~(crossing[h, before] & (k > 0))
        h, k = h[dip], k[dip]
        found.append((h, at[h, k], s2, s3))
    hypothesis = np.concatenate([f[0] for f in found])
    lambda_1 = np.concatenate([f[1] for f in found])
    s2 = np.concatenate([np.full(len(f[0]), f[2]) for f in found])
    s3 = np.concatenate([np.full(len(f[0]), f[3]) for f in found])
    own = triples.of_hypotheses(hypothesis)
    terms = own.quadratics(lambda_1[:, None]).with_distances(d2[hypothesis])
    lambda_2 = terms.q2[:, 0] + s2 * np.sqrt(np.maximum(terms.D2[:, 0], 0))
    lambda_3 = terms.q3[:, 0] + s3 * np.sqrt(np.maximum(terms.D3[:, 0], 0))
    lambdas = np.stack([lambda_1, lambda_2, lambda_3], axis=1)
    # far outside on the grid is outside after polishing too
    margin = slack_mm + (high - low) / (samples - 1)
    margin = margin if len(margin) == 1 else margin[hypothesis]
    near = _within(lambdas, own.lengths, margin)
    return _finish(triples, xy_mm, d2, hypothesis[near], lambdas[near], slack_mm, max(4 * noise_mm, 1e-6), 4)


def _evaluate_G(terms: Quadratics) -> FloatArray:
    """G (h, k): the product of F over the four sign choices."""
    _, _, D2, D3, A, B, C, E = terms
    P = A * A + B**2 * D2 - (C**2 + E**2 * D2) * D3
    Q = 2 * (A * B - (C * E) * D3)
    G: FloatArray = P * P - D2 * (Q * Q)
    return G


def _chebyshev_roots(coefficients: FloatArray) -> NDArrayComplex:
    """Eigenvalues (h, 8) of the colleague matrices of Chebyshev series (h, 9); a vanishing lead is nudged."""
    h, n = coefficients.shape[0], DEGREE
    lead = coefficients[:, n]
    tiny = 1e-14
    lead = np.where(np.abs(lead) < tiny, np.where(lead < 0, -tiny, tiny), lead)
    matrix = np.zeros((h, n, n))
    i = np.arange(n - 1)
    matrix[:, i, i + 1] = 0.5
    matrix[:, i + 1, i] = 0.5
    matrix[:, 0, 1] = 1.0
    matrix[:, n - 1, :] -= 0.5 * coefficients[:, :n] / lead[:, None]
    return np.linalg.eigvals(matrix).astype(complex)


NDArrayComplex = np.ndarray[tuple[int, ...], np.dtype[np.complex128]]


def _finish(
    triples: RodTriples,
    xy_mm: FloatArray,
    d2: FloatArray,
    hypothesis: IntArray,
    lambdas: FloatArray,
    slack_mm: float,
    residual_mm: float,
    steps: int,
) -> tuple[FloatArray, IntArray]:
    """From (r, 3) starts for the three λ to poses: polish, check the rods' ends, lay triangle on triangle."""
    if len(hypothesis) == 0:
        return np.empty((0, 4, 4)), np.empty(0, dtype=np.intp)
    distance = np.sqrt(d2[hypothesis])
    own = triples.of_hypotheses(hypothesis)
    lambdas, error = _polish(own, lambdas, distance, steps)
    good = (error <= residual_mm) & _within(lambdas, own.lengths, slack_mm)
    lambdas, hypothesis = lambdas[good], hypothesis[good]
    first = _first_of_each(lambdas, hypothesis, 1e-6 * float(triples.lengths.max()))
    lambdas, hypothesis = lambdas[first], hypothesis[first]
    own = triples.of_hypotheses(hypothesis)
    P = own.starts + lambdas[..., None] * own.directions
    Q = np.concatenate([xy_mm[hypothesis], np.zeros((len(hypothesis), 3, 1))], axis=2)
    T, valid = _lay_triangles(P, Q)
    return T[valid], hypothesis[valid]


def _branches(
    triples: RodTriples, d2: FloatArray, hypothesis: IntArray, lambda_1: FloatArray
) -> tuple[FloatArray, IntArray]:
    """(4 r, 3) λ for all four sign choices at λ₁ (r,); the polish tells which of them were meant."""
    terms = triples.of_hypotheses(hypothesis).quadratics(lambda_1[:, None]).with_distances(d2[hypothesis])
    # clamped: parallel rods at a small tilt sit on the double root, where noise makes D negative
    lambda_2 = terms.q2 + np.sqrt(np.maximum(terms.D2, 0)) * _BRANCH_2
    lambda_3 = terms.q3 + np.sqrt(np.maximum(terms.D3, 0)) * _BRANCH_3
    lambdas = np.stack([np.broadcast_to(lambda_1[:, None], lambda_2.shape), lambda_2, lambda_3], axis=2)
    return lambdas.reshape(-1, 3), np.repeat(hypothesis, len(_BRANCH_2))


def _polish(
    triples: RodTriples, lambdas: FloatArray, distance: FloatArray, steps: int
) -> tuple[FloatArray, FloatArray]:
    """Damped Newton on the three distances; returns λ (r, 3) and the largest remaining distance error (r,), mm."""
    # rods and axes first, hypotheses last: whole lines of memory are worked on
    p, y = (np.ascontiguousarray(part.transpose(1, 2, 0)) for part in (triples.starts, triples.directions))
    i, j = [0, 0, 1], [1, 2, 2]
    y_i, y_j = y[i], y[j]
    size2 = float(triples.lengths.max()) ** 2
    lam, wanted = np.array(lambdas.T, order="C"), np.ascontiguousarray(distance.T)
    f = np.full(lam.shape, np.inf)
    for _ in range(steps):
        P = p + lam[:, None] * y
        gap = P[i] - P[j]  # (3 sides, 3 axes, r)
        length = np.maximum(np.sqrt(_along(gap, gap)), 1e-12)
        f = length - wanted
        a = _along(gap, y_i) / length  # ∂f/∂λ_i
        b = -_along(gap, y_j) / length  # ∂f/∂λ_j
        # rows: (a0, b0, 0), (a1, 0, b1), (0, a2, b2); normal equations with a little damping, solved in closed form
        (a0, a1, a2), (b0, b1, b2), (f0, f1, f2) = a, b, f
        damping = 1e-9 + (f0 * f0 + f1 * f1 + f2 * f2) / size2
        n00, n11, n22 = a0**2 + a1**2 + damping, b0**2 + a2**2 + damping, b1**2 + b2**2 + damping
        n01, n02, n12 = a0 * b0, a1 * b1, a2 * b2
        g0, g1, g2 = a0 * f0 + a1 * f1, b0 * f0 + a2 * f2, b1 * f1 + b2 * f2
        c00, c01, c02 = n11 * n22 - n12**2, n02 * n12 - n01 * n22, n01 * n12 - n02 * n11
        c11, c12, c22 = n00 * n22 - n02**2, n01 * n02 - n00 * n12, n00 * n11 - n01**2
        det = np.maximum(n00 * c00 + n01 * c01 + n02 * c02, 1e-30)
        lam[0] -= (c00 * g0 + c01 * g1 + c02 * g2) / det
        lam[1] -= (c01 * g0 + c11 * g1 + c12 * g2) / det
        lam[2] -= (c02 * g0 + c12 * g1 + c22 * g2) / det
    P = p + lam[:, None] * y
    gap = P[i] - P[j]
    error = np.minimum(np.abs(f).max(axis=0), np.abs(np.sqrt(_along(gap, gap)) - wanted).max(axis=0))
    return np.ascontiguousarray(lam.T), error


def _along(a: FloatArray, b: FloatArray) -> FloatArray:
    """Σ a b (3, r) over the axes of (3, 3, r), the middle one."""
    result: FloatArray = a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]
    return result


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Σ a b over a last axis of three, several times faster than ``sum`` over so short an axis."""
    result: FloatArray = a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]
    return result


def _norm(a: FloatArray) -> FloatArray:
    result: FloatArray = np.sqrt(_dot(a, a))
    return result


def _largest(a: FloatArray) -> FloatArray:
    """The greatest magnitude (r,) of each row (r, 3)."""
    result: FloatArray = np.maximum(np.maximum(np.abs(a[:, 0]), np.abs(a[:, 1])), np.abs(a[:, 2]))
    return result


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """a × b of stacks (r, 3)."""
    result: FloatArray = np.empty_like(a)
    result[:, 0] = a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1]
    result[:, 1] = a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]
    result[:, 2] = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return result


def _within(lambdas: FloatArray, lengths: FloatArray, slack_mm: FloatArray | float) -> BoolArray:
    """Which λ (r, 3) lie on all three rods, or no more than the slack beyond (r, 1)."""
    inside = (lambdas >= -slack_mm) & (lambdas <= lengths + slack_mm)
    result: BoolArray = inside[:, 0] & inside[:, 1] & inside[:, 2]
    return result


def _first_of_each(lambdas: FloatArray, hypothesis: IntArray, tolerance_mm: float) -> IntArray:
    """Indices of solutions that differ: one of each (hypothesis, λ) up to the tolerance."""
    order = np.lexsort((lambdas[:, 2], lambdas[:, 1], lambdas[:, 0], hypothesis))
    near = np.zeros(len(order), dtype=bool)
    for back in (1, 2, 3, 4):  # neighbours in λ₁ order; ties in λ₁ are few
        same = (hypothesis[order[back:]] == hypothesis[order[:-back]]) & (
            _largest(lambdas[order[back:]] - lambdas[order[:-back]]) <= tolerance_mm
        )
        near[back:] |= same
    return np.sort(order[~near])


def _lay_triangles(P: FloatArray, Q: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Rigid transforms (r, 4, 4) laying triangles ``P`` on ``Q`` (r, 3, 3), and which triangles are not degenerate."""
    B_P, ok_P = _triangle_basis(P)
    B_Q, ok_Q = _triangle_basis(Q)
    R = B_Q @ np.swapaxes(B_P, 1, 2)
    t = Q.mean(axis=1) - np.einsum("rij,rj->ri", R, P.mean(axis=1))
    return make_pose(R, t), ok_P & ok_Q


def _triangle_basis(P: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Right-handed orthonormal bases (r, 3, 3), columns: along side 1–2, in the plane, normal.

    The mean angle of the three corners seen from the centre would be more even under noise; the side is exact for
    exact triangles, and refinement follows.
    """
    a, b = P[:, 1] - P[:, 0], P[:, 2] - P[:, 0]
    n = _cross(a, b)
    length_a, length_n = _norm(a), _norm(n)
    ok = length_n > 1e-9 * np.maximum(length_a, _norm(b)) ** 2
    e1 = a / np.maximum(length_a, 1e-300)[:, None]
    e3 = n / np.maximum(length_n, 1e-300)[:, None]
    return np.stack([e1, _cross(e3, e1), e3], axis=2), ok
