"""Cutting of mass-spring-dashpot lattices by the swept surface of a blade: cubes are separated along the faces nearest to it.

Two cubes that share a face are separated where the segment between their centres crosses the surface. Where cubes of an octree of two sizes
meet, the face of the larger one is separated as a whole if any of these segments does. Around every node of these faces, cubes that other
faces join keep one node, each other group of cubes gets a copy, and so around nodes elsewhere whose cubes a cut parts in more pieces; so no
piece hangs on another by a mere edge or node, cuts may end inside the lattice, and they may cross.

An element belongs to the cubes that have both its nodes. Where the groups part them, it is divided in as many elements, and stiffness and
dampings in proportion to the numbers of cubes; the mass of a node is divided by their volumes. So mass, momentum and energy are
conserved to rounding, and so is the force of every element at the moment of the cut. No cube is refined: the nodes of the new surface lie
within half a space diagonal of a cube from the blade, 0.87 of its edge, and within 1.1 of the larger edge where two sizes meet.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from naibu.core.arrays import AnyArray, BoolArray, FloatArray, IntArray, require_shape
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.cpu.session import LatticeSession
from naibu.mechanics.lattices.model.contact_state import ContactState
from naibu.mechanics.lattices.model.cube_faces import FACES, CubeFaces, corner_volumes, cube_faces, require_cubes
from naibu.mechanics.lattices.model.hexahedra import lattice_mesh
from naibu.mechanics.lattices.model.lattice import Lattice, LatticeParameters
from naibu.mechanics.lattices.model.state import ConstrainedNodes, LatticeState
from naibu.mechanics.lattices.model.surface import surface_faces
from naibu.meshing.cutting._crossing_kernels import crossed_segments, distances
from naibu.meshing.cutting.pieces import of_more_pieces
from naibu.meshing.cutting.swept_blade import SweptBlade

SPLINTER = 8  # finest cubes, less than which do not come loose merely because the face of a larger cube is cut as a whole
_FIRST, _SECOND = np.triu_indices(8, 1)


@dataclass(frozen=True, slots=True, eq=False)
class LatticeCut:
    """A cut lattice, and how it comes from the lattice before.

    Attributes
    ----------
    lattice : Lattice
        Nodes keep their numbers, copies follow; where nothing is cut, the lattice as it was.
    parameters : LatticeParameters
        Of its elements.
    source : ndarray, shape (n,), int64
        Node of the lattice before that each node is or is a copy of.
    share : ndarray, shape (n,)
        Part of its mass.
    element_source : ndarray, shape (m,), int64
        Element of the lattice before that each element is or is a part of.
    faces : ndarray, shape (f, 3), int64
        New surface, counterclockwise seen from outside: triangles of both sides.
    piece : ndarray, shape (c,), int64
        Piece that each cube belongs to, the one of the largest volume first.
    deviation_mm : float
        Largest distance of a node of the new surface from the blade.
    """

    lattice: Lattice
    parameters: LatticeParameters
    source: IntArray
    share: FloatArray
    element_source: IntArray
    faces: IntArray
    piece: IntArray
    deviation_mm: float

    @property
    def n_pieces(self) -> int:
        """Number of pieces."""
        return int(self.piece.max()) + 1

    def nodal(self, values: AnyArray) -> AnyArray:
        """Return nodal values (n, ...) from those of the nodes before the cut, the same on both sides."""
        return np.asarray(values[self.source])

    def divided(self, values: FloatArray) -> FloatArray:
        """Return nodal values (n, ...) that are sums, such as weights, from those before the cut: copies share them as they do the mass."""
        return np.asarray(values[self.source] * self.share.reshape(-1, *[1] * (values.ndim - 1)))

    @property
    def mesh(self) -> Mesh:
        """The cubes as hexahedra in the scanner's frame."""
        return lattice_mesh(self.lattice)

    @property
    def parents(self) -> IntArray:
        """Cube of the lattice before that each cube is; the same."""
        return np.arange(len(self.piece))

    def state(self, before: LatticeState) -> LatticeState:
        """Return a state of the cut lattice from one of the lattice before; nodes of the new surface begin in no contact."""
        length = None if before.length is None else before.length[self.element_source]
        contact = None if before.contact is None else self._contact(before.contact)
        return LatticeState(
            before.position[self.source], before.velocity[self.source], before.extension[self.element_source], length, contact
        )

    def constrained(self, before: ConstrainedNodes) -> ConstrainedNodes:
        """Return the constraints of nodes and their copies from those before the cut."""
        order = np.argsort(self.source, kind="stable")
        first, last = (np.searchsorted(self.source, before.node, side, sorter=order) for side in ("left", "right"))
        row = np.repeat(np.arange(len(before.node)), last - first)
        place = np.arange(len(row)) - np.repeat(np.cumsum(last - first) - (last - first), last - first)
        return ConstrainedNodes(order[first[row] + place], before.direction[row], before.weight[row], before.body[row])

    def _contact(self, before: ContactState) -> ContactState:
        """Contact of the faces that were in it, behind whose order that of the new surface comes in between, in no contact."""
        added = {tuple(triangle) for triangle in self.faces.tolist()}
        known = np.array([tuple(face) not in added for face in surface_faces(self.lattice)[:, :3].tolist()])
        each = np.diff(before.first) // int(known.sum())  # points of a face, for every indenter

        def carried(values: AnyArray) -> AnyArray:
            parts = []
            for count, low, high in zip(each, before.first[:-1], before.first[1:], strict=True):
                part = np.zeros((len(known), count, *values.shape[1:]), values.dtype)
                part[known] = values[low:high].reshape(-1, count, *values.shape[1:])
                parts.append(part.reshape(-1, *values.shape[1:]))
            return np.concatenate(parts)

        # faces of the new surface begin with the thinnest foundation of their indenter, as no covered area has made it thicker
        thickness = np.repeat(before.thickness.min(axis=1)[:, None], len(known), axis=1)
        thickness[:, known] = before.thickness
        return replace(
            before, thickness=thickness,
            first=np.concatenate([[0], np.cumsum(each * len(known))]).astype(np.int64), mode=carried(before.mode),
            touched=carried(before.touched), compression=carried(before.compression), extension=carried(before.extension),
            friction=carried(before.friction), begun=carried(before.begun),
            multiplier=np.ascontiguousarray(before.multiplier[:, self.source]),
            covered=np.ascontiguousarray(before.covered[:, self.source]),
            acceleration=np.ascontiguousarray(before.acceleration[:, self.source]),
        )  # fmt: skip


def cut_session(session: LatticeSession, blade: SweptBlade) -> tuple[LatticeSession, LatticeCut]:
    """Cut a lattice that a session steps, as it is deformed now; return the session that goes on with it.

    Constraints, external forces and indenters in contact are carried over; the session that is given is closed.

    Parameters
    ----------
    session : LatticeSession
        Of `naibu.mechanics.LatticeEngine`.
    blade : SweptBlade
        The surface, in the frame of the lattice; it may end inside.

    Raises
    ------
    InputError
        A session of another engine, or what `cut_lattice` refuses; the session is then as it was.
    """
    engine = session.engine
    if not isinstance(engine, LatticeEngine):
        raise InputError("sessions on the processor are cut; take the state of this one to one of naibu.mechanics.LatticeEngine")
    state = session.state()
    cut = cut_lattice(engine.lattice, engine.parameters, blade, positions=state.position)
    force = session.external_force
    if force is not None:
        force = cut.divided(np.broadcast_to(np.asarray(force, dtype=float), state.position.shape))
    made = cut_engine(engine, cut).session(cut.state(state), cut.constrained(session.constrained), force, session.indenters)
    made.constrain(made.constrained, session.bodies)
    session.close()
    return made, cut


def cut_engine(engine: LatticeEngine, cut: LatticeCut) -> LatticeEngine:
    """Return the engine of a cut lattice with the settings of the one before."""
    precision: Literal["double", "single"] = "single" if engine.mass.dtype == np.float32 else "double"
    return LatticeEngine.of(
        cut.lattice, cut.parameters, step=engine.step, method=engine.method, precision=precision, tolerance=engine.tolerance,
        threads=engine.threads,
    )  # fmt: skip


def cut_lattice(lattice: Lattice, parameters: LatticeParameters, blade: SweptBlade, *, positions: FloatArray | None = None) -> LatticeCut:
    """Cut a lattice of cubes along the surface that a blade has swept.

    Parameters
    ----------
    lattice : Lattice
        Of voxels, classic or octree, cut before or not.
    parameters : LatticeParameters
        Of its elements.
    blade : SweptBlade
        The surface, in the frame of the lattice; it may end inside.
    positions : ndarray, shape (n, 3), optional
        Where the nodes are while the blade passes, mm; by default in the reference configuration.

    Raises
    ------
    InputError
        A lattice without cubes, parameters of another one, or positions of another shape or that are not finite.

    Notes
    -----
    Elements at the new surface keep their zone, core or surface: their parameters are shares of those before the cut.
    """
    where = lattice.points if positions is None else positions
    cells = require_cubes(lattice)
    require_shape("positions", where, lattice.points.shape)
    require_shape("parameters", parameters.stiffness, (lattice.n_elements,))
    if not np.isfinite(where).all():
        raise InputError(f"positions of {int((~np.isfinite(where)).any(axis=1).sum())} of {len(where)} nodes are not finite")
    known = cube_faces(lattice)
    volumes = corner_volumes(lattice)
    cut = _crossed(where[cells].mean(axis=1), known, blade, volumes)
    parted = replace(known, joined=known.joined & ~cut)
    piece = _pieces(8.0 * volumes, parted)
    apart = of_more_pieces(cells, _pieces(8.0 * volumes, known), piece, lattice.n_nodes)
    new_cells, source = _separated(cells, known, parted, cut, apart)
    faces = known.triangles(new_cells, known.sides(parted.opened(new_cells) & ~known.opened(cells)))
    of_copies = np.bincount(new_cells.ravel(), np.repeat(volumes, 8), minlength=len(source)).astype(np.float64)
    share = of_copies / np.bincount(cells.ravel(), np.repeat(volumes, 8), minlength=lattice.n_nodes)[source]
    surface = lattice.surface_node[source]
    surface[faces.ravel()] = True
    elements, element_source, part = _divided_elements(lattice, cells, new_cells, len(source))
    made = replace(
        lattice, points=lattice.points[source], elements=elements, node_mass=lattice.node_mass[source] * share, surface_node=surface,
        element_class=lattice.element_class[element_source], element_zone=lattice.element_zone[element_source],
        element_level=lattice.element_level[element_source], scale=lattice.scale[element_source] * part, cells=new_cells,
        parted=np.unique(known.unit[~parted.joined]),
    )  # fmt: skip
    gap = np.zeros(len(nodes := np.unique(faces)))
    distances(np.ascontiguousarray(where[source[nodes]]), *blade.arrays, gap)
    return LatticeCut(
        made, _parts(parameters, element_source, part), source, share, element_source, faces, piece, float(gap.max(initial=0.0))
    )


def _crossed(centres: FloatArray, known: CubeFaces, blade: SweptBlade, volumes: FloatArray) -> BoolArray:
    """Which pairs (p,), joined so far, the blade separates."""
    shifted = centres + 1e-9 * np.ptp(centres, axis=0).max() * np.sqrt(np.arange(1.0, 4.0))  # off surfaces that pass right through centres
    side = np.zeros(len(known.pairs), dtype=np.int64)
    starts, ends = (np.ascontiguousarray(shifted[known.pairs[:, k]]) for k in (0, 1))
    crossed_segments(starts, ends, *blade.arrays, side)
    cut = known.joined & np.isin(known.unit, known.unit[(side != 0) & known.joined])
    passed = cut & (side == 0)
    return _without_splinters(known, cut, passed, volumes) if passed.any() else cut


def _without_splinters(known: CubeFaces, cut: BoolArray, passed: BoolArray, volumes: FloatArray) -> BoolArray:
    """Cut pairs (p,) without those around few cubes that come loose only because the face of a larger cube is cut as a whole.

    They stay on the side that they share the largest faces with; `passed` are cut pairs that the blade does not cross.
    """
    piece = _pieces(volumes, replace(known, joined=known.joined & ~cut))
    size = np.bincount(piece, known.edge.astype(np.float64) ** 3) / float(known.edge.min()) ** 3
    sides = piece[known.pairs]
    cut = cut.copy()
    for k in np.unique(sides[passed]):
        if size[k] >= SPLINTER:
            continue
        other = np.where(sides[:, 0] == k, sides[:, 1], sides[:, 0])
        own = cut & (sides == k).any(axis=1) & (other != k)
        whole = own & ~np.isin(known.unit, known.unit[cut & ~own])  # not faces that other pieces share
        if whole.any():
            area = np.bincount(other[whole], known.edge[known.pairs[whole, 0]].astype(np.float64) ** 2)
            cut &= ~(whole & (other == int(area.argmax())))
    return cut


def _separated(cells: IntArray, known: CubeFaces, parted: CubeFaces, cut: BoolArray, apart: BoolArray) -> tuple[IntArray, IntArray]:
    """Return cubes whose nodes are duplicated along cut faces, or are `apart` (n,), and of every node the old one that it stands for.

    A node on the face of a larger cube, which has it not as a corner, is held by that cube too: cubes around the node that faces of the
    larger one join are joined.
    """
    touched, n_nodes = apart.copy(), len(apart)
    small, large = known.pairs[cut].T
    touched[cells[small[:, None], FACES[known.face[cut]]]] = True
    touched[cells[large[:, None], FACES[known.unit[cut] % 6]]] = True
    cube, corner = np.nonzero(touched[cells])
    nodes = cells[cube, corner]
    links = np.flatnonzero(parted.joined & touched[cells[known.pairs[:, 0]]].any(axis=1))
    shared = cells[known.pairs[links, 0][:, None], FACES[known.face[links]]]
    link, place = np.nonzero(touched[shared])
    at = shared[link, place]
    ends = [known.pairs[links[link], side] * n_nodes + at for side in (0, 1)]
    keys, number = np.unique(np.concatenate([cube * n_nodes + nodes, *ends]), return_inverse=True)
    own, one, two = np.split(number, [len(cube), len(cube) + len(at)])
    graph = sp.coo_matrix((np.ones(len(one), dtype=np.int8), (one, two)), shape=(len(keys), len(keys)))
    group = connected_components(graph, directed=False)[1][own]
    groups, first, of_corner = np.unique(group, return_index=True, return_inverse=True)
    node = nodes[first]
    copies = np.setdiff1d(np.arange(len(groups)), np.unique(node, return_index=True)[1])
    numbers = node.copy()
    numbers[copies] = n_nodes + np.arange(len(copies))
    out = cells.copy()
    out[cube, corner] = numbers[of_corner]
    return out, np.concatenate([np.arange(n_nodes), node[copies]])


def _divided_elements(lattice: Lattice, cells: IntArray, new_cells: IntArray, n_nodes: int) -> tuple[IntArray, IntArray, FloatArray]:
    """Return the elements of the new nodes, the old element of each, and which part of it they are.

    Elements between nodes that no cube has both, which no lattice of voxels has, would be lost; there are none.
    """
    old_keys = lattice.elements[:, 0] * n_nodes + lattice.elements[:, 1]
    order = np.argsort(old_keys)
    old, new = (np.sort(np.stack([c[:, _FIRST].ravel(), c[:, _SECOND].ravel()]), axis=0) for c in (cells, new_cells))
    key = old[0] * n_nodes + old[1]
    spot = np.minimum(np.searchsorted(old_keys, key, sorter=order), len(order) - 1)
    element = order[spot]
    found = old_keys[element] == key  # corners between which another node stands are not joined
    pairs, first, which = np.unique(new[0, found] * n_nodes + new[1, found], return_index=True, return_inverse=True)
    source = element[found][first]
    cubes = np.bincount(which, minlength=len(pairs)).astype(np.float64)
    return np.stack([pairs // n_nodes, pairs % n_nodes], axis=1), source, cubes / np.bincount(source, cubes, len(order))[source]


def _parts(parameters: LatticeParameters, source: IntArray, part: FloatArray) -> LatticeParameters:
    stiffness, voigt, series = (
        values[source] * part for values in (parameters.stiffness, parameters.voigt_damping, parameters.series_damping)
    )
    return LatticeParameters(stiffness, voigt, series, parameters.voigt_fraction[source])


def _pieces(volumes: FloatArray, parted: CubeFaces) -> IntArray:
    """Number of the piece of every cube (c,)."""
    pairs, size = parted.pairs[parted.joined], len(volumes)
    graph = sp.coo_matrix((np.ones(len(pairs), dtype=np.int8), (pairs[:, 0], pairs[:, 1])), shape=(size, size))
    count, label = connected_components(graph, directed=False)
    rank = np.empty(count, dtype=np.int64)
    rank[np.argsort(-np.bincount(label, volumes), kind="stable")] = np.arange(count)
    return rank[label]
