"""Where else the frame may be if one of the spots is faulty: all minima of every leave-one-out cost.

A match of six or seven spots has one minimum as a rule; with one of them taken out it often has two, tens of degrees
apart and as deep (method §8). The solution that is found by starting at the full one then says nothing of the other,
and if the spot left out is the faulty one, the truth is as likely there. So every leave-one-out cost is minimised from
the poses that three of the spots allow, and each minimum is weighed like any match: by its odds, the spot in question
left out of them.

Refining all starts without each of the spots in turn would take longer than the search. One Gauss–Newton step without
a spot costs next to nothing, though, once the pose is linearised: ``H − J_kᵀ W_k J_k`` and ``g − J_kᵀ W_k r_k``. It
tells which starts lead to the solution that is known, and which to none.
"""

from __future__ import annotations

import itertools
import math

import numpy as np

from ctreg_cli.arrays import BoolArray, FloatArray, IntArray
from ctreg_cli.geometry import pose as poses
from ctreg_cli.registration.matching import Matches, Scene, distinct_poses, observations, roots_of_triples, weigh
from ctreg_cli.registration.refine import Linearisation, gauss_newton_step, linearise, refine
from ctreg_cli.rods import RodModel

#: rod triples whose roots are the starts: each minimum is reached from a third of them
_TRIPLES = 12
#: ... and fewer do for so many matches: what is left without one of them is rarely ambiguous
_FEWER_TRIPLES, _MANY_MATCHES = 8, 8
#: a start is followed when the step promises a χ² no more than this above that of the known solution, beyond what the
#: risk alone would forgive: three noisy spots put it where the cost is not yet a parabola
_SLACK = 30.0
#: ... and does not lead to within this squared distance (in sd) of the known solution
_SAME_D2 = 9.0
#: steps of the starts that are followed, each time one of each pose, before they are weighed
_STEPS = (1, 6)
#: no step turns by more than this, rad
_MOST_TURN_RAD = 0.4


def solutions_without_a_spot(
    model: RodModel, scene: Scene, T: FloatArray, spot_of_rod: IntArray, *, neglected_p: float, inflation: float = 1.0
) -> tuple[FloatArray, IntArray]:
    """Minima of a match's cost without one of its spots, for each of them.

    Args:
        model: the rods.
        scene: the spots, and what bears on the pose.
        T: (4, 4) the pose of the match.
        spot_of_rod: (n,) its spots, −1 for none; at least five.
        neglected_p: minima of a smaller probability are left out; the spot in question is faulty for certain.
        inflation: factor by which the spots lie farther off than their sd allows.

    Returns:
        Poses (b, 4, 4) and the spots of the rods (b, n), which say what each does without: first the minima next to
        ``T``, one for each spot, then all others.
    """
    matched = np.nonzero(spot_of_rod >= 0)[0]
    n = len(matched)
    without = np.repeat(spot_of_rod[None], n, axis=0)
    without[np.arange(n), matched] = -1
    T_known, known, _ = refine(
        model, np.repeat(T[None], n, axis=0), observations(scene, without), iterations=6, step_tolerance=1e-6
    )
    H_known, _ = known.normal_equations()
    enough = known.chi2 + _SLACK - 2 * math.log(neglected_p) * inflation**2

    def elsewhere(T: FloatArray, left_out: IntArray, chi2: FloatArray) -> IntArray:
        """Which poses (b, 4, 4) are worth following: of each spot left out one of each that is not the known one."""
        near = T_known[left_out]
        turn = poses.log_rotation(T[:, :3, :3] @ np.swapaxes(near[:, :3, :3], 1, 2))
        off = np.concatenate([T[:, :3, 3] - near[:, :3, 3], turn], axis=1)
        unlike = ((off[:, None] @ H_known[left_out])[:, 0] * off).sum(axis=1) > _SAME_D2
        worth = np.flatnonzero(unlike & (chi2 < enough[left_out]))
        worth = worth[np.argsort(chi2[worth], kind="stable")]
        return worth[distinct_poses(model, T[worth], left_out[worth])]

    starts = _roots(model, scene, spot_of_rod, matched)
    if len(starts) == 0:
        return T_known, without
    same = observations(scene, np.repeat(spot_of_rod[None], len(starts), axis=0))
    step, promised = _steps_without(model, linearise(model, starts, same), matched)
    start, left_out = np.nonzero(promised < enough)
    T_on = poses.update(starts[start], step[start, left_out])
    kept = elsewhere(T_on, left_out, promised[start, left_out])
    T_on, left_out = T_on[kept], left_out[kept]
    for iterations in _STEPS:
        T_on, fit, _ = refine(
            model, T_on, observations(scene, without[left_out]), iterations=iterations, step_tolerance=1e-3
        )
        kept = elsewhere(T_on, left_out, fit.chi2)
        T_on, left_out = T_on[kept], left_out[kept]
        if len(T_on) == 0:
            return T_known, without
    # the known ones too: what the others' odds are measured by
    found = weigh(
        model, scene, np.concatenate([T_known, T_on]), np.concatenate([without, without[left_out]]), least_matches=3
    )
    if found is None:
        return T_known, without
    found = found.subset(_probable(found, matched, neglected_p, inflation))
    return np.concatenate([T_known, found.T]), np.concatenate([without, found.spot_of_rod])


def _roots(model: RodModel, scene: Scene, spot_of_rod: IntArray, matched: IntArray) -> FloatArray:
    """(s, 4, 4) poses that three of a match's spots allow, for some of its triples."""
    triples = np.array(list(itertools.combinations(matched, 3)), dtype=np.intp)
    most = _TRIPLES if len(matched) < _MANY_MATCHES else _FEWER_TRIPLES
    triples = triples[:: -(-len(triples) // most)]
    return roots_of_triples(model, scene, spot_of_rod, triples)


def _steps_without(model: RodModel, fit: Linearisation, matched: IntArray) -> tuple[FloatArray, FloatArray]:
    """Gauss–Newton steps (b, k, 6) without each of the ``matched`` spots (k,), and the χ² (b, k) they promise."""
    unit = np.array([1, 1, 1, *(3 * [1 / model.size_mm])])
    J, W, r = fit.jacobian[:, matched] * unit, fit.weight[:, matched], fit.residual_px[:, matched]
    JW = np.swapaxes(J, -1, -2) @ W  # (b, k, 6, 2)
    H, g, chi2 = JW @ J, (JW @ r[..., None])[..., 0], ((W @ r[..., None])[..., 0] * r).sum(axis=-1)
    b, k = chi2.shape
    others = 1 - np.eye(k)  # not the sum of all less its own: rods nearly in the slice have Jacobians beyond all bounds
    H, g, chi2 = (others @ H.reshape(b, k, 36)).reshape(H.shape), others @ g, chi2 @ others
    step = gauss_newton_step(H, g)
    promised = chi2 - (step * g).sum(axis=-1)
    step *= unit
    turn = np.linalg.norm(step[..., 3:], axis=-1, keepdims=True)
    step *= np.minimum(1, _MOST_TURN_RAD / np.maximum(turn, 1e-300))
    return step, np.where(np.isfinite(fit.chi2)[:, None], promised, np.inf)


def _probable(found: Matches, matched: IntArray, neglected_p: float, inflation: float) -> BoolArray:
    """Which minima are not too improbable among those that do without the same spot."""
    # farther off than their sd allows: χ² says less than it would
    odds = found.log_odds + 0.5 * found.fit.chi2 * (1 - inflation**-2)
    probable = np.zeros(len(odds), dtype=bool)
    missing = (found.spot_of_rod[:, matched] < 0).argmax(axis=1)
    for k in range(len(matched)):
        own = missing == k
        if own.any():
            p = np.exp(odds[own] - odds[own].max())
            probable[own] = p > neglected_p * p.sum()
    return probable
