"""A finite element model whose steps use the tangents of earlier ones, such a tangent, and the nodes that it is prepared for."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from naibu.core.arrays import FloatArray, Int32Array, IntArray
from naibu.mechanics.contact.penalty_contact import Contact
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_elements.pressure_elements import PressureElements
from naibu.mechanics.finite_strain.lip_assembly import LipMultipliers, lips_of, with_multipliers, with_secant
from naibu.mechanics.finite_strain.nearby_contact import NearbyContact
from naibu.mechanics.finite_strain.sessions.dynamic_session import DynamicEngine
from naibu.mechanics.finite_strain.sessions.tangents.earlier_tangent import EarlierTangent, SolverPool
from naibu.mechanics.finite_strain.sessions.tangents.lips_beside_tangent import in_threes, lips_about_to_change, pairs_along_normals
from naibu.mechanics.linear_algebra.block_matrix import BlockPattern, block_pattern, with_dirichlet_rows
from naibu.mechanics.linear_algebra.paired_motion import PairedMotion
from naibu.mechanics.linear_algebra.updated_factors import UpdatedFactors

FAINT = 1e-5  # strain of the body under contact forces too small to be told from none
AHEAD = 160  # nodes about to be in contact, at most
REACH = 0.2  # extents of the body around an indenter in which they are sought

Contacts = tuple[Sequence[NearbyContact], Sequence[Int32Array], Sequence[Int32Array]]


@dataclass(frozen=True, slots=True, eq=False)
class RealTimeModel(DynamicEngine):
    """A finite element model prepared for tangents that outlive their step; see `DynamicEngine` for the other attributes.

    Attributes
    ----------
    background : bool
        Whether a thread renews the factors, and iterations end when the time of a step is over; otherwise factors are renewed before every
        tenth step, and runs are repeatable.
    """

    background: bool = True
    _elements: PressureElements = field(init=False)
    _surface: BlockPattern = field(init=False)
    _pairs: Int32Array = field(init=False)  # of the sides of cuts, in this pattern
    _local_stiffness: FloatArray = field(init=False)  # of the elements at the nodes of the surface, mN/mm; 0 elsewhere
    _solvers: SolverPool = field(init=False)
    _rest: list[EarlierTangent] = field(init=False, default_factory=list)

    def __post_init__(self) -> None:
        DynamicEngine.__post_init__(self)
        object.__setattr__(self, "_elements", PressureElements.of(self.assembler))
        pairs = np.concatenate([np.zeros((0, 2), np.int64), *(lips.pairs for lips in lips_of(self.assembler))])
        object.__setattr__(self, "_surface", block_pattern(len(self.points), self.faces, pairs))
        object.__setattr__(self, "_pairs", self._surface.positions(pairs))
        object.__setattr__(self, "_solvers", SolverPool(self.assembler.pattern))
        object.__setattr__(self, "_local_stiffness", 3.0 * self._shear * _mean_edges(self.points, self.faces))

    @property
    def faint_mn(self) -> float:
        """Force of contact too small to be told from none, mN."""
        return FAINT * self._modulus * self._extent**2

    def stiffness_at(self, nodes: IntArray, pairs: PairedMotion) -> FloatArray:
        """Return the stiffness of the elements at nodes (k,) and, in rows of three, at pairs of the sides of cuts, mN/mm."""
        local = self._local_stiffness
        return np.concatenate([local[nodes], in_threes(local[pairs.nodes].mean(axis=1)).max(axis=1)])


def _mean_edges(points: FloatArray, faces: IntArray) -> FloatArray:
    """Return the mean length (n,), mm, of the edges of the faces at every node; 0 where there is none."""
    a, b = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    length = np.linalg.norm(points[a] - points[b], axis=1)
    ends, both = np.concatenate([a, b]), np.concatenate([length, length])
    count = np.bincount(ends, minlength=len(points))
    return np.asarray(np.bincount(ends, both, minlength=len(points)) / np.maximum(count, 1))


def tangent_at(
    engine: RealTimeModel, u: FloatArray, contacts: Contacts, held: IntArray, ahead: IntArray, slipped: FloatArray | None,
    begun: LipMultipliers | None, duration: float = 0.0,
) -> EarlierTangent:  # fmt: skip
    """Return the tangent at a displacement, and columns of its inverse for the nodes that come into contact.

    Parameters
    ----------
    engine : RealTimeModel
        The body, and solvers for its matrices.
    u : ndarray, shape (n, 3)
        Of the nodes, mm.
    contacts : tuple
        Contacts at this displacement, and the places of all their points in the pattern of the surface and in that of the body.
    held : ndarray, shape (h,), int64
        Nodes that do not move.
    ahead : ndarray, shape (a,), int64
        Nodes in contact or about to be.
    slipped : ndarray, shape (p, 3), optional
        Frictional anchors of the sides of cuts, mm; by default those at rest.
    begun : LipMultipliers, optional
        What the sides of cuts exerted when the step began; nothing by default.
    """
    began = time.thread_time()
    assembler = with_secant(with_multipliers(engine.assembler, begun), slipped)
    pattern, blocks = assembler.pattern, assembler.evaluate(u)[2]
    contact = np.zeros((engine._surface.n_blocks, 3, 3))
    for some, place, all_places in zip(*contacts, strict=False):
        some.add_symmetric_stiffness(pattern, all_places, blocks)
        some.add_symmetric_stiffness(engine._surface, place, contact)
    blocks[pattern.diagonal()] += (engine.mass / (duration or engine.step) ** 2)[:, None, None] * np.eye(3)
    fixed = np.zeros(engine.points.shape, dtype=bool)
    fixed[held] = True
    solver = engine._solvers.get(np.unique(ahead))
    factors = UpdatedFactors(solver.factorize(with_dirichlet_rows(pattern.matrix(blocks), fixed)), len(u))
    factors.prepare(ahead)
    touched = np.unique(engine._surface.indices[(contact != 0.0).any(axis=(1, 2))]).astype(np.int64)
    lips = np.concatenate([np.zeros((0, 3, 3)), *(some.add(u, np.zeros_like(u), secant=True)[1] for some in lips_of(assembler))])
    dilatation = engine._elements.dilatation(u)[1]
    sides = [pairs_along_normals(some, factors, u, held) for some in lips_of(assembler) if some.friction == 0.0]
    pairs = sides[0] if sides else PairedMotion.none()
    return EarlierTangent(factors, dilatation, contact, held, touched, lips, solver, u, time.thread_time() - began, pairs)


def nodes_ahead(
    contacts: Sequence[Contact], gaps: Sequence[FloatArray], corners: int, extent_mm: float, assembler: Assembler, displacement: FloatArray
) -> IntArray:
    """Return the nodes in contact, those about to be, the nearest first, and those of lips that are about to open or close.

    Parameters
    ----------
    contacts : sequence of Contact
        Of faces with this number of `corners`.
    gaps : sequence of ndarray, shape (p,)
        Distances of their points from the indenters, mm.
    corners : int
        Nodes of a face.
    extent_mm : float
        Of the body.
    assembler : Assembler
        Its elements, with the lips of cuts.
    displacement : ndarray, shape (n, 3)
        Of its nodes, mm.
    """
    nodes, order = [np.zeros((0, corners), np.int64)], [np.zeros(0)]
    for contact, gap in zip(contacts, gaps, strict=True):
        near = np.flatnonzero(gap < REACH * extent_mm)
        nodes.append(contact.nodes[near])
        order.append(np.maximum(gap[near], 0.0))
    depths = np.concatenate(order)
    ranked = np.concatenate(nodes)[np.argsort(depths, kind="stable")]
    touching = len(np.unique(ranked[: np.count_nonzero(depths == 0.0)]))
    first = ranked.ravel()[np.sort(np.unique(ranked, return_index=True)[1])][: touching + AHEAD]
    lips = [lips_about_to_change(some, displacement) for some in lips_of(assembler)]
    return np.concatenate([first, *lips]).astype(np.int64)
