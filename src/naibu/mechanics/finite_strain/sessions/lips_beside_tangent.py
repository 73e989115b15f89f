"""Pairs of the two sides of cuts that open, close, stick or slip in a step, beside their stiffness in the tangent of an earlier state.

A tangent of then holds closed what was closed then. Pairs whose state has changed since, or may change, are taken out of it, and their
contact is solved as it is, condensed to their nodes like that of indenters (`naibu.mechanics.finite_strain.sessions.condensed_contact`).
Friction has the stiffness of its secant in both; in the tangent, which is symmetric, without its growth with pressure. Where it acts, all
pairs that press or are near to it are taken out: what the others leave out of balance where the motion turns round takes iterations of the
whole body, and at last Newton's method.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field

import numpy as np

from naibu.core.arrays import FloatArray, Int32Array, IntArray
from naibu.mechanics.contact._cut_lip_kernels import pair_forces
from naibu.mechanics.contact.cut_lips import CutLips
from naibu.mechanics.finite_strain.sessions.earlier_tangent import EarlierTangent
from naibu.mechanics.linear_algebra.block_matrix import BlockPattern

MOST = 80  # pairs in a step, without friction
AHEAD = 40  # pairs for which the inverse is prepared, likewise
NEAR = 0.1  # of the edge: gaps, and penetrations, from which pairs are not expected to change


@dataclass(slots=True, eq=False)
class LipsBesideTangent:
    """Change of the forces of pairs, less what an earlier tangent contains of it; used as `NearbyContact` is.

    Attributes
    ----------
    lips : CutLips
        These pairs, with normals.
    points : ndarray, shape (k,), int64
        Their numbers among all pairs.
    displacement : ndarray, shape (n, 3)
        From which the body moves, mm.
    earlier : ndarray, shape (k, 3, 3)
        Stiffness of the pairs in the tangent, mN/mm.
    exerted : float
        Sum of the components of the forces on both sides at the last evaluation, mN.
    """

    lips: CutLips
    points: IntArray
    displacement: FloatArray
    earlier: FloatArray
    exerted: float = field(init=False, default=0.0)
    _now: FloatArray = field(init=False)
    _before: FloatArray = field(init=False)  # internal forces on the first nodes (k, 3), mN
    _pairs: IntArray = field(init=False)  # their nodes as displacements number them
    _start: FloatArray = field(init=False)  # displacements of the second nodes less those of the first (k, 3), mm
    _begun: FloatArray = field(init=False)  # positions of the second nodes relative to the first (k, 3), mm
    _anchors: FloatArray = field(init=False)
    _overlaps: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        self._before, self._now = np.zeros((len(self.points), 3)), np.zeros((len(self.points), 3, 3))
        first, second = self.lips.pairs.T
        at_rest = self.lips.points[second] - self.lips.points[first]
        self._anchors = at_rest if self.lips.anchors is None else self.lips.anchors
        self._overlaps = np.zeros(len(self.points)) if self.lips.overlaps is None else self.lips.overlaps
        self._pairs, self._start = self.lips.pairs, self.displacement[second] - self.displacement[first]
        self._begun = at_rest + self._start
        self._evaluate(self._begun, self._before)

    def numbered(self, place: IntArray) -> LipsBesideTangent:
        """Return these pairs of nodes that are numbered anew: `place` (n,) has the new number of each."""
        anew = copy(self)
        anew._pairs = place[self.lips.pairs]
        return anew

    def _evaluate(self, relative: FloatArray, force: FloatArray) -> None:
        own = self.lips
        assert own.normals is not None
        pair_forces(relative, self._anchors, own.normals, self._overlaps, own.area, own.edge, own.stiffness, own.friction, force, self._now)

    def add_force(self, displacement: FloatArray, force: FloatArray) -> None:
        """Add the change of the forces up to a displacement (n, 3), mm, to `force` (n, 3), mN."""
        first, second = self._pairs.T
        moved = displacement[second] - displacement[first] - self._start
        change = np.empty_like(self._before)
        self._evaluate(self._begun + moved, change)
        self.exerted = 2.0 * float(np.abs(change).sum())
        change += np.einsum("pij,pj->pi", self.earlier, moved) - self._before
        np.subtract.at(force, first, change)
        np.add.at(force, second, change)

    def touching(self) -> LipsBesideTangent:
        """Return the pairs whose stiffness may differ: all of them."""
        return self

    def add_stiffness(self, pattern: BlockPattern, positions: Int32Array, blocks: FloatArray) -> None:
        """Add the difference of the stiffness at the last evaluation; `positions` (p, 2, 2) are those of all pairs in the pattern."""
        places = positions[self.points]
        for a in range(2):
            for b in range(2):
                np.add.at(blocks, places[:, a, b], (1.0 if a == b else -1.0) * (self._now - self.earlier))

    def add_secant_stiffness(self, pattern: BlockPattern, positions: Int32Array, blocks: FloatArray) -> None:
        """Add what `add_stiffness` adds: that of friction is its secant."""
        self.add_stiffness(pattern, positions, blocks)


def changing_lips(lips: CutLips, tangent: EarlierTangent, displacement: FloatArray, free: FloatArray) -> LipsBesideTangent:
    """Return the pairs that are, or may come to be, in another state than in a tangent.

    Parameters
    ----------
    lips : CutLips
        All pairs, with the normals of the step.
    tangent : EarlierTangent
        Which holds together what was closed then.
    displacement : ndarray, shape (n, 3)
        From which the body moves, mm.
    free : ndarray, shape (n, 3)
        How it would move by the tangent, mm.
    """
    before, after = lips.gaps(displacement), lips.gaps(displacement + free)
    then = tangent.lips.any(axis=(1, 2))
    known = tangent.factors.covered(lips.pairs).all(axis=1)
    changed = (then != (before < 0.0)) | (known & (then != (after < 0.0)))
    close = np.minimum(np.abs(before), np.abs(after)) / lips.edge
    if lips.friction > 0.0:
        chosen = np.flatnonzero(changed | then | (close < NEAR)).astype(np.int64)
        return LipsBesideTangent(lips.only(chosen), chosen, displacement, tangent.lips[chosen])
    chosen = np.flatnonzero(changed | (known & (close < NEAR)))
    chosen = np.sort(chosen[np.lexsort((close[chosen], ~changed[chosen]))][:MOST]).astype(np.int64)
    return LipsBesideTangent(lips.only(chosen), chosen, displacement, tangent.lips[chosen])


def lips_about_to_change(lips: CutLips, displacement: FloatArray) -> IntArray:
    """Return the nodes (k,) of the pairs whose sides are nearest to opening or closing at a displacement (n, 3), mm, the nearest first."""
    near = np.abs(lips.gaps(displacement)) / lips.edge
    order = np.argsort(near, kind="stable")[: AHEAD if lips.friction == 0.0 else None]
    return np.asarray(lips.pairs[order[near[order] < NEAR]].ravel(), dtype=np.int64)
