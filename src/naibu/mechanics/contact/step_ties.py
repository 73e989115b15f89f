"""Ties between the steps of the two sides of a cut, which hand over what presses along the blade.

Facets follow an oblique blade in steps, and the contact of the two sides presses along the normal of the blade (`cut_lips`). The stress
along the blade, which in a nearly incompressible solid between walls is as large as that across it, acts on the fronts of the steps: as
they are not faces of the body that the blade makes, but a matter of its mesh, they hold together as long as the sides touch. Each pair of
nodes has a spring along the vector area of its facets in the plane of the blade, which resists that its slip differs from the mean of
those of its neighbours: sides slide past each other freely, and a level cut has no ties. Where one of these pairs is open, nothing holds
the step together, and there is no tie. In time steps, springs are as stiff as the penalty only from where the pressure is the shear
modulus, as iterations with tangents of earlier states take longer where stiffness comes and goes; their forces go on from step to step,
and what they hand over is that of stiff ones a few steps later.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from naibu._numba.compilation import njit
from naibu.core.arrays import FloatArray, Int32Array, IntArray
from naibu.mechanics.contact._cut_lip_kernels import RAMP, add_facets
from naibu.mechanics.contact.cut_lips import STIFFNESS, CutLips

YIELDING = 1.0 / (3.0 * STIFFNESS)  # of the edge: penetration of pairs whose penalty exerts the shear modulus
LEAST_STEP = 1e-2  # of the area of a pair along the normal: what its facets have along the blade, from which it is tied


@dataclass(frozen=True, slots=True, eq=False)
class StepTies:
    """Springs between the two sides of a cut.

    Attributes
    ----------
    own : ndarray, shape (m,), int64
        Pair that every tie belongs to.
    nodes : ndarray, shape (m, k), int64
        Nodes that it concerns, of which the last may be repeated.
    shares : ndarray, shape (m, k)
        What the positions of these nodes contribute to how the slip of the pair differs from that around it; 0 for repeated nodes.
    around : ndarray, shape (m, j), int64
        These pairs, of which the first may be repeated.
    corners : ndarray, shape (2 f, 3), int64
        Tied pair at every corner of the triangles of the sides, or -1.
    ramp : float
        Penetration of the pairs, over the edge, over which the springs become as stiff as the penalty.
    along : ndarray, shape (m, 3), optional
        Unit vectors of the springs at the beginning of a time step, times the root of their stiffness, mN/mm; by default they are those
        of the displacement.
    tensions : ndarray, shape (m,), optional
        Forces of the springs, mN, where the slip is that around them: the multipliers of an augmented Lagrangian
        :cite:p:`wriggers2006`; 0 by default.
    """

    own: IntArray
    nodes: IntArray
    shares: FloatArray
    around: IntArray
    corners: IntArray
    ramp: float = YIELDING
    along: FloatArray | None = None
    tensions: FloatArray | None = None

    def springs(self, lips: CutLips, displacement: FloatArray) -> FloatArray:
        """Return the springs (m, 3) at a displacement (n, 3), mm: zero where one of the pairs does not touch."""
        gap, normal = lips.gaps_and_normals(displacement)
        sides = np.zeros((2, len(lips.pairs), 3))
        add_facets(lips.points + displacement, lips.faces, lips.pairs, self.corners, sides)
        area = (sides[0] - sides[1])[self.own] / 12.0  # a third of half of the cross products, the mean of both sides
        normal = normal[self.own]
        area -= (area * normal).sum(axis=1, keepdims=True) * normal
        size = np.linalg.norm(area, axis=1)
        touching = np.clip(-gap[self.around].max(axis=1) / (self.ramp * lips.edge[self.own]), 0.0, 1.0)
        stiffness = touching * lips.stiffness[self.own] / np.where(size > 0.0, size, 1.0)
        return np.asarray(area * np.sqrt(stiffness)[:, None])

    def unyielding(self) -> StepTies:
        """Return the same ties, as stiff as the penalty wherever pairs touch."""
        return replace(self, ramp=RAMP)

    def in_step(self, lips: CutLips, displacement: FloatArray) -> StepTies:
        """Return the ties of a time step that begins at a displacement (n, 3), mm: those of pairs that touch there."""
        return replace(self, along=self.springs(lips, displacement))

    def with_tensions(self, tensions: FloatArray | None) -> StepTies:
        """Return the same ties whose springs exert these forces (m,), mN, where the slip is that around them; None for none."""
        return replace(self, tensions=tensions)

    def tensions_behind(self, lips: CutLips, displacement: FloatArray) -> FloatArray:
        """Return the forces (m,), mN, of the springs at a displacement (n, 3), mm, with which the next step goes on."""
        along = self.springs(lips, displacement) if self.along is None else self.along
        slip = np.einsum("mk,mi,mki->m", self.shares, along, (lips.points + displacement)[self.nodes])
        return np.asarray(np.linalg.norm(along, axis=1) * (slip + self._begun(along)))

    def _begun(self, along: FloatArray) -> FloatArray:
        """Return the tensions (m,) over the root of the stiffness of the springs."""
        root = np.linalg.norm(along, axis=1)
        return np.zeros(len(along)) if self.tensions is None else self.tensions / np.where(root > 0.0, root, np.inf)

    def add(self, lips: CutLips, displacement: FloatArray, force: FloatArray, positions: Int32Array, blocks: FloatArray) -> float:
        """Add to internal forces (n, 3), mN, and to `blocks`, where there are any, at `positions` (m, k, k); return the energy, mN mm."""
        along = self.springs(lips, displacement) if self.along is None else self.along
        return float(_pulled(self.nodes, self.shares, along, self._begun(along), lips.points + displacement, force, positions, blocks))


def step_ties(lips: CutLips) -> StepTies | None:
    """Return the ties of the sides of a cut; None where its facets lie along the blade, or where its normal is not known.

    Pairs of which a node belongs to another one too, as where cuts cross, have none.
    """
    normal = lips.with_normals_of(np.zeros_like(lips.points)).normals
    assert normal is not None
    times = np.bincount(lips.pairs.ravel(), minlength=len(lips.points))
    known = (times[lips.pairs] == 1).all(axis=1) & normal.any(axis=1)
    known[lips.corner_pair[lips.corner_pair >= 0]] = False  # with normals of their facets
    pair_of = np.full(len(lips.points), -1, dtype=np.int64)
    pair_of[lips.pairs[known]] = np.flatnonzero(known)[:, None]
    corners = np.ascontiguousarray(pair_of[lips.faces])
    sides = np.zeros((2, len(lips.pairs), 3))
    add_facets(lips.points, lips.faces, lips.pairs, corners, sides)
    area = (sides[0] - sides[1]) / 12.0
    across = (area * normal).sum(axis=1)
    steps = np.linalg.norm(area - across[:, None] * normal, axis=1)
    around = _neighbours(corners, len(lips.pairs))
    many = np.bincount(around[:, 0], minlength=len(lips.pairs))
    own = np.flatnonzero(known & (steps > LEAST_STEP * lips.area) & (many > 0))
    if not len(own):
        return None
    first = np.concatenate([[0], np.cumsum(many)])
    nodes = np.repeat(lips.pairs[own][:, :1], 2 * (1 + int(many[own].max())), axis=1)
    shares, members = np.zeros(nodes.shape), np.repeat(own[:, None], nodes.shape[1] // 2, axis=1)
    for row, p in enumerate(own):
        others = around[first[p] : first[p + 1], 1]
        pairs = np.concatenate([[p], others])
        weight = lips.area[pairs] / lips.area[pairs].sum()
        share = np.where(pairs == p, 1.0 - weight, -weight) * np.sign(normal[pairs] @ normal[p])  # which of two sides is the first differs
        members[row, : len(pairs)] = pairs
        nodes[row, : 2 * len(pairs)] = lips.pairs[pairs].ravel()
        shares[row, : 2 * len(pairs)] = np.stack([-share, share], axis=1).ravel()
    return StepTies(own.astype(np.int64), nodes, shares, members, corners)


def _neighbours(corners: IntArray, count: int) -> IntArray:
    """Return the pairs of pairs (e, 2) that share a triangle, in the order of the first."""
    ends = np.concatenate([corners[:, [i, j]] for i in range(3) for j in range(3) if i != j])
    ends = ends[(ends >= 0).all(axis=1)]
    return np.stack(np.divmod(np.unique(ends[:, 0] * count + ends[:, 1]), count), axis=1)


@njit(cache=True, nogil=True)
def _pulled(nodes, shares, along, begun, at, force, positions, blocks):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the internal forces of ties, and their stiffness; returns the energy."""
    energy, k = 0.0, nodes.shape[1]
    for t in range(len(nodes)):
        if along[t, 0] == 0.0 and along[t, 1] == 0.0 and along[t, 2] == 0.0:
            continue
        s = begun[t]
        for a in range(k):
            for i in range(3):
                s += shares[t, a] * along[t, i] * at[nodes[t, a], i]
        energy += 0.5 * s * s
        for a in range(k):
            if shares[t, a] == 0.0:
                continue
            for i in range(3):
                force[nodes[t, a], i] += s * shares[t, a] * along[t, i]
            if len(blocks) == 0:
                continue
            for b in range(k):
                if shares[t, b] == 0.0:
                    continue
                for i in range(3):
                    for j in range(3):
                        blocks[positions[t, a, b], i, j] += shares[t, a] * shares[t, b] * along[t, i] * along[t, j]
    return energy
