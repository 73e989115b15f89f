"""Contact of the two sides of a cut with each other: pairs of nodes that were one before the cut.

Each pair resists approach along the mean normal of its two sides, as they are in the deformed body, by a penalty :cite:p:`wriggers2006`; it
exerts nothing while it is open, and no friction. Pairs are those of the cut: sides that slide past each other further than `FURTHEST`
edges, or that no longer face each other, do not touch.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from naibu._numba.compilation import njit
from naibu.core.arrays import FloatArray, IntArray

RAMP = 2e-4  # of the edge: penetration over which the pressure rises smoothly
FURTHEST = 2.0  # edges between the nodes of a pair across the normal
STIFFNESS = 40.0  # Young's moduli (of an incompressible solid) over the edge


@dataclass(frozen=True, slots=True, eq=False)
class CutLips:
    """Pairs of nodes on the two sides of cuts.

    Attributes
    ----------
    points : ndarray, shape (n, 3)
        Nodes at rest, mm.
    faces : ndarray, shape (2 f, 3), int64
        Triangles of the first sides, then in the same order those of the second.
    pairs : ndarray, shape (p, 2), int64
        Nodes on the first and on the second side.
    corner_pair : ndarray, shape (2 f, 3), int64
        Pair that every corner of the triangles belongs to; -1 at the front of a cut, where both sides have one node.
    area : ndarray, shape (p,)
        Tributary areas at rest, mm2.
    edge : ndarray, shape (p,)
        Edge of the triangles around a pair: the root of their mean area times two, mm.
    stiffness : ndarray, shape (p,)
        Penalties, kPa/mm.
    normals : ndarray, shape (p, 3), optional
        Of which the gaps are taken: those of an earlier position; zero for pairs that did not face each other there.
    """

    points: FloatArray
    faces: IntArray
    pairs: IntArray
    corner_pair: IntArray
    area: FloatArray
    edge: FloatArray
    stiffness: FloatArray
    normals: FloatArray | None = None

    def with_normals_of(self, displacement: FloatArray) -> CutLips:
        """Return the same pairs with the normals, and the choice of pairs that touch, of a displacement (n, 3), mm.

        In a time step whose normals are those of its beginning, the energy of the pairs is convex, their forces are its gradient, and no
        pair comes in or drops out.
        """
        gap, normal = _state(self.points, self.faces, self.pairs, self.corner_pair, self.edge, np.ascontiguousarray(displacement))
        return replace(self, normals=np.where(np.isfinite(gap)[:, None], normal, 0.0))

    def only(self, which: IntArray) -> CutLips:
        """Return some of the pairs (k,), which keep the normals that they have been given."""
        assert self.normals is not None
        return replace(
            self, pairs=self.pairs[which], area=self.area[which], edge=self.edge[which], stiffness=self.stiffness[which],
            normals=self.normals[which],
        )  # fmt: skip

    def gaps(self, displacement: FloatArray) -> FloatArray:
        """Return the distances (p,), mm, along the normals: negative where the sides overlap, infinite where they face away."""
        return self._gaps_and_normals(displacement)[0]

    def add(self, displacement: FloatArray, force: FloatArray) -> tuple[float, FloatArray]:
        """Add to internal forces (n, 3), mN; return the energy, mN mm, and the stiffness of every pair (p, 3, 3), mN/mm."""
        gap, normal = self._gaps_and_normals(displacement)
        blocks = np.zeros((len(self.pairs), 3, 3))
        energy = _pressed(gap, normal, self.pairs, self.area, self.edge, self.stiffness, force, blocks)
        return float(energy), blocks

    def _gaps_and_normals(self, displacement: FloatArray) -> tuple[FloatArray, FloatArray]:
        if self.normals is None:
            gap, normals = _state(self.points, self.faces, self.pairs, self.corner_pair, self.edge, np.ascontiguousarray(displacement))
            return gap, normals
        first, second = self.pairs.T
        apart = (self.points[second] - self.points[first]) + (displacement[second] - displacement[first])
        gap = (self.normals * apart).sum(axis=1)
        return np.where(self.normals.any(axis=1), gap, np.inf), self.normals


def cut_lips(points: FloatArray, faces: IntArray, shear_modulus: FloatArray) -> CutLips | None:
    """Return the sides of cuts among the boundary faces of a mesh; None where no two faces lie on each other at rest.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        Nodes in the reference configuration, mm, of which cuts have doubled some.
    faces : ndarray, shape (f, 3), int64
        Boundary triangles, counterclockwise seen from outside.
    shear_modulus : ndarray, shape (n,)
        Of the solid around the nodes, kPa; the penalty follows from it.
    """
    place = np.unique(points, axis=0, return_inverse=True)[1].ravel()
    at = place[faces]
    order = np.argsort(at, axis=1)
    at, sorted_faces = np.take_along_axis(at, order, axis=1), np.take_along_axis(faces, order, axis=1)
    by_place = np.lexsort(at.T)
    same = (np.diff(at[by_place], axis=0) == 0).all(axis=1)
    first, second = by_place[:-1][same], by_place[1:][same]
    if not len(first):
        return None
    both = np.stack([sorted_faces[first], sorted_faces[second]], axis=2).reshape(-1, 2)  # corners of each triangle and of its twin
    apart = both[:, 0] != both[:, 1]
    pairs, number = np.unique(both[apart], axis=0, return_inverse=True)
    corner = np.full(len(both), -1, dtype=np.int64)
    corner[apart] = number.ravel()
    corners = points[sorted_faces[first]]
    areas = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    share = np.repeat(areas / 3.0, 3)[apart]
    area = np.asarray(np.bincount(corner[apart], share, minlength=len(pairs)), dtype=np.float64)
    edge = np.sqrt(2.0 * 3.0 * area / np.bincount(corner[apart], minlength=len(pairs)))
    stiffness = STIFFNESS * 3.0 * shear_modulus[pairs].max(axis=1) / edge
    oriented = [np.take_along_axis(corner.reshape(-1, 3), np.argsort(order[f], axis=1), axis=1) for f in (first, second)]
    sides = np.concatenate([faces[first], faces[second]])
    return CutLips(points, np.ascontiguousarray(sides), pairs, np.ascontiguousarray(np.concatenate(oriented)), area, edge, stiffness)


@njit(cache=True, nogil=True)
def _state(points, faces, pairs, corner_pair, edge, u):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Gaps (p,) and unit normals (p, 3), from the first side to the second, of all pairs."""
    sides = np.zeros((2, len(pairs), 3))
    half = len(faces) // 2
    e, f = np.empty(3), np.empty(3)
    for t in range(len(faces)):
        side = 0 if t < half else 1
        a, b, c = faces[t, 0], faces[t, 1], faces[t, 2]
        for i in range(3):
            e[i] = points[b, i] + u[b, i] - points[a, i] - u[a, i]
            f[i] = points[c, i] + u[c, i] - points[a, i] - u[a, i]
        for k in range(3):
            p = corner_pair[t, k]
            if p >= 0:
                for i in range(3):
                    j, m = (i + 1) % 3, (i + 2) % 3
                    sides[side, p, i] += e[j] * f[m] - e[m] * f[j]
    gap, normal = np.full(len(pairs), np.inf), np.zeros((len(pairs), 3))
    for p in range(len(pairs)):
        facing, size = 0.0, 0.0
        for i in range(3):
            facing += sides[0, p, i] * sides[1, p, i]
            normal[p, i] = sides[0, p, i] - sides[1, p, i]
            size += normal[p, i] ** 2
        if facing >= 0.0 or size == 0.0:
            continue
        size = np.sqrt(size)
        along, whole = 0.0, 0.0
        for i in range(3):
            normal[p, i] /= size
            d = points[pairs[p, 1], i] + u[pairs[p, 1], i] - points[pairs[p, 0], i] - u[pairs[p, 0], i]
            along += normal[p, i] * d
            whole += d * d
        if whole - along * along <= (FURTHEST * edge[p]) ** 2:
            gap[p] = along
    return gap, normal


@njit(cache=True, nogil=True)
def _pressed(gap, normal, pairs, area, edge, stiffness, force, blocks):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the internal forces of pairs that overlap, and their stiffness; returns the energy."""
    energy = 0.0
    for p in range(len(pairs)):
        g = gap[p]
        if g >= 0.0:
            continue
        k, ramp = stiffness[p] * area[p], RAMP * edge[p]
        if g > -ramp:
            pressing, slope = 0.5 * k * g * g / ramp, -k * g / ramp
            energy -= k * g * g * g / (6.0 * ramp)
        else:
            pressing, slope = -k * (g + 0.5 * ramp), k
            energy += 0.5 * k * (g * g + g * ramp) + k * ramp * ramp / 6.0
        for i in range(3):
            force[pairs[p, 0], i] += pressing * normal[p, i]
            force[pairs[p, 1], i] -= pressing * normal[p, i]
            for j in range(3):
                blocks[p, i, j] += slope * normal[p, i] * normal[p, j]
    return energy
