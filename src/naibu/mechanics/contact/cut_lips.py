"""Contact of the two sides of a cut with each other: pairs of nodes that were one before the cut.

Each pair resists approach along the normal of the cut, as it is in the deformed body, by a penalty :cite:p:`wriggers2006`; it exerts
nothing while it is open. Where the blade's normal is known, it is carried with the cells of both sides by Nanson's formula, and a pair
stands for the area that its facets have along it: facets that follow the blade in steps then neither interlock nor carry shear, and a
normal stress passes unchanged. Elsewhere the normal is the mean one of the facets. Pairs are those of the cut: sides that slide past
each other further than `FURTHEST` edges, or that no longer face each other, do not touch.

With Coulomb friction a closed pair also resists slip: the elastic predictor ``e = k_t P (d - a)`` is returned to ``|e| <= mu N``; d is
the position of the second node relative to the first, P the projection along the sides, N the force across them, and the anchor a is the
history variable of the pair, as of a point of an indenter (`naibu.mechanics.contact.penalty_contact`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.mechanics.contact._cut_lip_kernels import RAMP, TANGENTIAL, add_carried, add_facets, add_friction, add_pressure, gaps_and_normals

STIFFNESS = 40.0  # Young's moduli (of an incompressible solid) over the edge
YIELDING = 1.5  # ratio of the penalties wanted and had, from which pressures go on from step to step
CONFINED = 20.0  # constrained moduli over the edge, at least: between walls a body yields by its thickness over this modulus
LEAST_ALONG = 1e-3  # of the facets' area around a pair, that it stands for where they overhang

Carriers = tuple[IntArray, IntArray, FloatArray]


@dataclass(frozen=True, slots=True, eq=False)
class CutLips:
    """Pairs of nodes on the two sides of cuts.

    Attributes
    ----------
    points : ndarray, shape (n, 3)
        Nodes at rest, mm.
    faces : ndarray, shape (2 f, 3), int64
        Triangles of one side of every pair of them, then in the same order those of the other.
    pairs : ndarray, shape (p, 2), int64
        Nodes on the first and on the second side; no two pairs have the same nodes.
    corner_pair : ndarray, shape (2 f, 3), int64
        Pair to whose normal every corner of the triangles contributes; -1 at the front of a cut, where both sides have one node, and where
        the blade's normal is known.
    area : ndarray, shape (p,)
        Tributary areas at rest, mm2, along the normal.
    edge : ndarray, shape (p,)
        Edge of the triangles: the root of their mean area times two, mm.
    carriers : tuple of ndarray
        Cells that carry the blade's normal: their nodes (c, 4), twice the pair, and one more on its second side (c,), and what the vector
        areas of their faces contribute to the outward normal there (c, 3).
    stiffness : ndarray, shape (p,)
        Penalties, kPa/mm.
    stiffest : ndarray, shape (p,)
        Those with which the sides yield little also to the pressures in a nearly incompressible body between walls, kPa/mm. Iterations
        with tangents of earlier states take three times as long with them.
    normals : ndarray, shape (p, 3), optional
        Of which the gaps are taken: those of an earlier position; zero for pairs that did not face each other there.
    friction : float
        Coulomb's coefficient; 0 for frictionless sides.
    anchors : ndarray, shape (p, 3), optional
        Positions of the second nodes relative to the first, mm, at which friction would vanish; those at rest by default.
    overlaps : ndarray, shape (p,), optional
        Gaps, mm, at which pressure would vanish: those of an augmented Lagrangian :cite:p:`wriggers2006`, over the penalty; 0 by default.
    """

    points: FloatArray
    faces: IntArray
    pairs: IntArray
    corner_pair: IntArray
    area: FloatArray
    edge: FloatArray
    stiffness: FloatArray
    stiffest: FloatArray
    carriers: Carriers
    normals: FloatArray | None = None
    friction: float = 0.0
    anchors: FloatArray | None = None
    overlaps: FloatArray | None = None

    def with_friction(self, coefficient: float) -> CutLips:
        """Return the same pairs with a coefficient of friction.

        Raises
        ------
        InputError
            A negative coefficient, or NaN.
        """
        if not (np.isfinite(coefficient) and coefficient >= 0.0):
            raise InputError(f"lips_friction must be a finite number that is not negative, not {coefficient:g}; 0 is frictionless")
        return replace(self, friction=coefficient)

    def unyielding(self) -> CutLips:
        """Return the same pairs with the largest penalties."""
        return replace(self, stiffness=self.stiffest)

    def with_anchors(self, anchors: FloatArray | None) -> CutLips:
        """Return the same pairs with other anchors (p, 3), mm; None for those at rest."""
        return replace(self, anchors=anchors)

    def with_overlaps(self, overlaps: FloatArray | None) -> CutLips:
        """Return the same pairs whose pressure vanishes at other gaps (p,), mm; None for 0."""
        return replace(self, overlaps=overlaps)

    @property
    def yields(self) -> bool:
        """Whether the penalty alone would let the sides yield to the pressures in a nearly incompressible body between walls."""
        return bool((self.stiffest > YIELDING * self.stiffness).any())

    def overlaps_behind(self, displacement: FloatArray) -> FloatArray:
        """Return the overlaps (p,), mm, of the next step: they exert without a gap what is exerted at a displacement (n, 3)."""
        return np.asarray(np.maximum(-self.gaps(displacement), 0.0))

    def anchors_behind(self, displacement: FloatArray) -> FloatArray:
        """Return the anchors (p, 3), mm, from which the next step goes on: elastic slip is that of the friction at a displacement (n, 3).

        Pairs that are open forget where they were.
        """
        gap, normal = self.gaps_and_normals(displacement)
        d = self._relative(displacement)
        traction = np.zeros_like(d)
        blocks, force = np.zeros((len(d), 3, 3)), np.zeros_like(displacement)
        self._rubbed(gap, normal, d, force, blocks, traction)
        return np.asarray(d - traction / (TANGENTIAL * self.stiffness * self.area)[:, None])

    def slip_forces(self, displacement: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the forces across (p,) and the friction along the sides (p, 3) that every pair exerts on its first node, mN."""
        gap, normal = self.gaps_and_normals(displacement)
        traction, blocks = np.zeros_like(normal), np.zeros((len(gap), 3, 3))
        self._rubbed(gap, normal, self._relative(displacement), np.zeros_like(displacement), blocks, traction)
        return across(gap, self.area, self.edge, self.stiffness), traction

    def rubbing(self, displacement: FloatArray) -> float:
        """Return the sum of the components of friction on both sides, mN, at a displacement (n, 3), mm."""
        return 2.0 * float(np.abs(self.slip_forces(displacement)[1]).sum()) if self.friction > 0.0 else 0.0

    def with_normals_of(self, displacement: FloatArray) -> CutLips:
        """Return the same pairs with the normals, and the choice of pairs that touch, of a displacement (n, 3), mm.

        In a time step whose normals are those of its beginning, the energy of the pairs is convex, their forces are its gradient, and no
        pair comes in or drops out.
        """
        gap, normal = self._gaps_and_normals_at(displacement)
        return replace(self, normals=np.where(np.isfinite(gap)[:, None], normal, 0.0))

    def only(self, which: IntArray) -> CutLips:
        """Return some of the pairs (k,), which keep the normals that they have been given."""
        assert self.normals is not None
        return replace(
            self, pairs=self.pairs[which], area=self.area[which], edge=self.edge[which], stiffness=self.stiffness[which],
            stiffest=self.stiffest[which], normals=self.normals[which], anchors=None if self.anchors is None else self.anchors[which],
            overlaps=None if self.overlaps is None else self.overlaps[which],
        )  # fmt: skip

    def gaps(self, displacement: FloatArray) -> FloatArray:
        """Return the distances (p,), mm, along the normals, less the overlaps that they have been given.

        They are negative where the sides press, infinite where they face away.
        """
        return self.gaps_and_normals(displacement)[0]

    def add(self, displacement: FloatArray, force: FloatArray, *, secant: bool = False) -> tuple[float, FloatArray]:
        """Add to internal forces (n, 3), mN; return the energy, mN mm, and the stiffness of every pair (p, 3, 3), mN/mm.

        With the `secant` of friction, its force over the elastic slip, instead of the derivative, the stiffness is symmetric and positive.
        """
        gap, normal = self.gaps_and_normals(displacement)
        blocks = np.zeros((len(self.pairs), 3, 3))
        energy = add_pressure(gap, normal, self.pairs, self.area, self.edge, self.stiffness, force, blocks)
        if self.friction > 0.0:
            energy += self._rubbed(gap, normal, self._relative(displacement), force, blocks, np.zeros_like(normal), secant=secant)
        return float(energy), blocks

    def _rubbed(
        self,
        gap: FloatArray,
        normal: FloatArray,
        relative: FloatArray,
        force: FloatArray,
        blocks: FloatArray,
        traction: FloatArray,
        *,
        secant: bool = False,
    ) -> float:
        """Add friction to internal forces and stiffnesses, put that of the pairs in place, and return what is stored in elastic slip."""
        anchors = self._relative(np.zeros_like(self.points)) if self.anchors is None else self.anchors
        pressing = across(gap, self.area, self.edge, self.stiffness)
        slope = np.where(gap > -RAMP * self.edge, -gap / (RAMP * self.edge), 1.0) * self.stiffness * self.area
        tangential = TANGENTIAL * self.stiffness * self.area
        shift = relative - anchors
        return float(
            add_friction(
                pressing, slope, normal, self.pairs, shift, tangential, self.friction, secant, not secant, force, blocks, traction
            )
        )  # fmt: skip

    def _relative(self, displacement: FloatArray) -> FloatArray:
        first, second = self.pairs.T
        return np.asarray((self.points[second] - self.points[first]) + (displacement[second] - displacement[first]))

    def gaps_and_normals(self, displacement: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the gaps (p,), see `gaps`, and the unit normals (p, 3), from the first side to the second."""
        overlaps = 0.0 if self.overlaps is None else self.overlaps
        if self.normals is None:
            gap, normal = self._gaps_and_normals_at(displacement)
            return gap - overlaps, normal
        gap = (self.normals * self._relative(displacement)).sum(axis=1) - overlaps
        return np.where(self.normals.any(axis=1), gap, np.inf), self.normals

    def _gaps_and_normals_at(self, displacement: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return gaps (p,) and unit normals (p, 3), from the first side to the second, of all pairs at a displacement."""
        sides = np.zeros((2, len(self.pairs), 3))
        at = self.points + displacement
        add_facets(at, self.faces, self.pairs, self.corner_pair, sides)
        add_carried(at, *self.carriers, sides)
        gap, normal = gaps_and_normals(at, self.pairs, self.edge, sides)
        return gap, normal


def cut_lips(
    points: FloatArray, faces: IntArray, moduli: tuple[FloatArray, FloatArray], cells: IntArray | None = None,
    outward: FloatArray | None = None,
) -> CutLips | None:  # fmt: skip
    """Return the sides of cuts among the boundary faces of a mesh; None where no two faces lie on each other at rest.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        Nodes in the reference configuration, mm, of which cuts have doubled some.
    faces : ndarray, shape (f, 3), int64
        Boundary triangles, counterclockwise seen from outside.
    moduli : tuple of ndarray, shape (n,)
        Shear and bulk moduli of the solid around the nodes, kPa; the penalty follows from them.
    cells : ndarray, shape (m, 4), int64, optional
        Tetrahedra, which carry the normals of blades.
    outward : ndarray, shape (n, 3), optional
        Of nodes on a side of a cut, the normal of the blade in the reference configuration, outwards; zero where it is not known. Without
        it, or where the two sides do not agree, as where cuts cross, normals are those of the facets.
    """
    found = _pairs_of_triangles(points, faces)
    if found is None:
        return None
    sides, pairs, corner = found
    vectors = 0.5 * np.cross(points[sides[:, 1]] - points[sides[:, 0]], points[sides[:, 2]] - points[sides[:, 0]])
    areas, k = np.linalg.norm(vectors, axis=1), np.flatnonzero(corner[: len(corner) // 2].ravel() >= 0)
    own, of = corner.ravel()[k], np.repeat(np.arange(len(sides)), 3)[k]  # of one side of every pair of triangles
    area = np.asarray(np.bincount(own, areas[of] / 3.0, minlength=len(pairs)), dtype=np.float64)
    edge = np.full(len(pairs), np.sqrt(2.0 * areas.mean()))  # a uniform gap is to make a uniform pressure
    carriers = (np.zeros((0, 4), np.int64), np.zeros(0, np.int64), np.zeros((0, 3)))
    if cells is not None and outward is not None:
        normal = _agreed(outward[pairs])
        known = np.asarray(normal.any(axis=1))
        first = np.where(sides.ravel()[k] == pairs[own, 0], 1.0, -1.0)
        along = np.bincount(own, first * (vectors[of] * normal[own]).sum(axis=1) / 3.0, minlength=len(pairs))
        area = np.where(known, np.maximum(along, LEAST_ALONG * area), area)
        corner = np.where((corner >= 0) & known[corner], -1, corner)
        carriers = _carriers(points, cells, pairs, normal)
    shear, bulk = (modulus[pairs].max(axis=1) for modulus in moduli)
    stiffness = STIFFNESS * 3.0 * shear / edge
    stiffest = np.maximum(stiffness, CONFINED * (bulk + 4.0 / 3.0 * shear) / edge)
    return CutLips(points, np.ascontiguousarray(sides), pairs, np.ascontiguousarray(corner), area, edge, stiffness, stiffest, carriers)


def _pairs_of_triangles(points: FloatArray, faces: IntArray) -> tuple[IntArray, IntArray, IntArray] | None:
    """Return the triangles of one side and of the other (2 f, 3), pairs (p, 2), and the pair of every corner (2 f, 3), -1 at fronts."""
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
    pairs, number = np.unique(np.sort(both[apart], axis=1), axis=0, return_inverse=True)  # which triangle comes first depends on its number
    corner = np.full(len(both), -1, dtype=np.int64)
    corner[apart] = number.ravel()
    oriented = [np.take_along_axis(corner.reshape(-1, 3), np.argsort(order[f], axis=1), axis=1) for f in (first, second)]
    return np.concatenate([faces[first], faces[second]]), pairs, np.concatenate(oriented)


def _agreed(outward: FloatArray) -> FloatArray:
    """Return the normals (p, 3), from the first side to the second, of what both sides (p, 2, 3) say is outwards; zero in discord."""
    normal = outward[:, 0] - outward[:, 1]
    agree = (outward[:, 0] * outward[:, 1]).sum(axis=1) < -0.5 * np.linalg.norm(outward, axis=2).prod(axis=1)
    size = np.linalg.norm(normal, axis=1)
    return np.where(agree[:, None], normal / np.where(size > 0.0, size, 1.0)[:, None], 0.0)


def _carriers(points: FloatArray, cells: IntArray, pairs: IntArray, normal: FloatArray) -> Carriers:
    """Return the cells around the nodes of pairs with a normal, and what carries it: cof(F) N is ``cof(D) m``, with m = D0^T N over det D0.

    D and D0 have the edges of a cell from its first node in their columns; cells count by their volumes.
    """
    corners = cells.ravel()
    order, count = np.argsort(corners, kind="stable"), np.bincount(corners, minlength=len(points))
    begin, known = np.cumsum(count) - count, np.flatnonzero(normal.any(axis=1))
    found: list[tuple[IntArray, IntArray, FloatArray]] = []
    for side, sign in ((0, 1.0), (1, -1.0)):
        node = pairs[known, side]
        many = count[node]
        within = np.arange(many.sum()) - np.repeat(np.cumsum(many) - many, many)
        own, pair = cells[order[np.repeat(begin[node], many) + within] // 4], np.repeat(known, many)
        edges = points[own[:, 1:]] - points[own[:, :1]]
        found.append((own, 2 * pair + side, sign * np.einsum("cki,ci->ck", edges, normal[pair]) / 6.0))
    nodes, pair, carried = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return np.ascontiguousarray(nodes, dtype=np.int64), pair, np.ascontiguousarray(carried)


def across(gap: FloatArray, area: FloatArray, edge: FloatArray, stiffness: FloatArray) -> FloatArray:
    """Return the forces across the sides (p,), mN, of pairs with these gaps: those of `add_pressure`."""
    k, ramp = stiffness * area, RAMP * edge
    closed = np.minimum(gap, 0.0)
    return np.where(closed > -ramp, 0.5 * k * closed * closed / ramp, -k * (closed + 0.5 * ramp))
