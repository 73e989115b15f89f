"""Bodies that a person pushes and pulls: lattices and finite elements behind one interface, and frames that show them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray, IntArray, as_vector, require_positive
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.mechanics.contact.indenter_motion import IndenterMotion
from naibu.mechanics.contact.rigid_indenters import RigidIndenter
from naibu.mechanics.contact.session_protocol import Session, StepForces
from naibu.mechanics.finite_elements.assembly import Assembler, body_force
from naibu.mechanics.finite_elements.elements import elements
from naibu.mechanics.finite_elements.hyperelasticity import material
from naibu.mechanics.finite_strain.sessions.dynamic_session import DynamicEngine, DynamicState
from naibu.mechanics.finite_strain.sessions.real_time_session import RealTimeEngine, RealTimeSession
from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.model.contact_surface import unresolved
from naibu.mechanics.lattices.model.state import ConstrainedNodes, LatticeState
from naibu.mechanics.lattices.model.surface import surface_triangles
from naibu.meshing.cutting.swept_blade import SweptBlade
from naibu.meshing.cutting.volume import VolumeCut, cut_volume
from naibu.meshing.element_conversion import to_tetra
from naibu.meshing.quality import mean_edge_length
from naibu.meshing.refinement.forest import BisectionForest
from naibu.meshing.surface import boundary_faces, triangles_of_faces
from naibu.simulation.cuts.cut_sides import caution_of_cuts, outward_normals, with_sides_of_cuts
from naibu.simulation.cuts.lattice_cut import LatticeCut, cut_engine, cut_lattice
from naibu.simulation.tool_places import surface_samples

NO_NODES: IntArray = np.zeros(0, dtype=np.int64)
AnySession = Session[Any, Any]


class InteractiveBody(Protocol):
    """A deformable body on its supports, and what is shown of it."""

    @property
    def points(self) -> FloatArray:
        """Nodes in the reference configuration (n, 3), mm."""

    @property
    def faces(self) -> IntArray:
        """Triangles of the surface (f, 3), counterclockwise seen from outside."""

    @property
    def cells(self) -> IntArray:
        """Tetrahedra (m, 4) of which sections are drawn."""

    @property
    def step_s(self) -> float:
        """Length of a step, s."""

    @property
    def fixtures(self) -> tuple[RigidIndenter, ...]:
        """Rigid bodies in contact that never move, such as a table."""

    @property
    def unmoved_by_failures(self) -> bool:
        """Whether a step that fails leaves the state as it was: then none is kept in every frame to be restored."""

    def session(self) -> AnySession:
        """Begin at rest on the supports, with the fixtures in contact."""

    def grip(self, session: AnySession, nodes: IntArray) -> None:
        """Tie these nodes to a body that the loop moves, besides those of the supports; none releases them."""

    def grip_velocity(self, velocity: FloatArray) -> FloatArray:
        """Return the velocities of all bodies of constrained nodes (b, 3) if the gripped nodes move at a velocity (3,), mm/s."""

    def without_contact(self, state: Any) -> Any:
        """Return a copy of a state that no indenter touches."""

    def at_rest(self, state: Any) -> Any:
        """Return a copy of a state that does not move."""

    def cut(self, state: Any, blade: SweptBlade, distance_mm: float | None = None) -> tuple[InteractiveBody, Any, VolumeCut | LatticeCut]:
        """Return the body and its state behind a cut; by default as near to the blade as the body's cells suggest."""

    def step(
        self, session: AnySession, velocity: FloatArray, motions: Sequence[IndenterMotion], steps: int, budget_s: float
    ) -> StepForces | None:
        """Take steps; None where one takes longer than a time of the processor: call again, with the same motions, to go on with it."""

    def unbalanced(self, session: AnySession) -> float:
        """Return the out-of-balance force that the last step left to the next ones, as a fraction of all forces."""

    def caution(self, name: str, tool: RigidIndenter | None) -> str:
        """Return what is to be said of the forces of a tool of this name, or of a grip (None); empty where nothing is."""

    def strain(self, positions: FloatArray) -> FloatArray:
        """Return a scalar strain at the nodes (n,), %, at positions (n, 3), mm."""

    def kept_clear(self, positions: FloatArray) -> FloatArray:
        """Return points of the body (k, 3), mm, that a tool which waits is clear of, at positions of its nodes (n, 3), mm."""


@dataclass(frozen=True, slots=True, eq=False)
class LatticeBody:
    """A mass-spring-dashpot lattice that is touched.

    Attributes
    ----------
    engine : LatticeEngine
        Lattice, parameters and step; contact needs the implicit method.
    faces : ndarray, shape (f, 3), int64
        Triangles of the surface.
    cells : ndarray, shape (m, 4), int64
        Tetrahedra for sections.
    supported : ndarray, shape (s,), int64
        Nodes that never move.
    fixtures : tuple of RigidIndenter
        Rigid bodies in contact that never move.
    external_force : ndarray, shape (n, 3), optional
        Such as weight, mN.
    """

    engine: LatticeEngine
    faces: IntArray
    cells: IntArray
    supported: IntArray = field(default_factory=lambda: NO_NODES)
    fixtures: tuple[RigidIndenter, ...] = ()
    external_force: FloatArray | None = None

    @property
    def points(self) -> FloatArray:
        """Nodes in the reference configuration (n, 3), mm."""
        return self.engine.lattice.points

    @property
    def step_s(self) -> float:
        """Length of a step, s."""
        return self.engine.step

    @property
    def unmoved_by_failures(self) -> bool:
        """Whether a step that fails leaves the state as it was: implicit ones do not diverge."""
        return self.engine.method == "implicit"

    def session(self) -> AnySession:
        """Begin at rest on the supports."""
        session = self.engine.session(external_force=self.external_force, indenters=self.fixtures)
        self.grip(session, NO_NODES)
        return session

    def grip(self, session: AnySession, nodes: IntArray) -> None:
        """Tie nodes to a body that the loop moves; those of the supports stay where they are."""
        free = np.setdiff1d(nodes, self.supported)
        session.constrain(ConstrainedNodes.of(self.supported, body=0) + ConstrainedNodes.of(free, body=1), 2)

    def grip_velocity(self, velocity: FloatArray) -> FloatArray:
        """Return the velocities of the support and of the gripped nodes (2, 3), mm/s."""
        return np.array([(0.0, 0.0, 0.0), velocity])

    def step(
        self, session: AnySession, velocity: FloatArray, motions: Sequence[IndenterMotion], steps: int, budget_s: float
    ) -> StepForces | None:
        """Take steps, whose time hardly varies, whole."""
        return session.step(velocity, motions, steps=steps)

    def without_contact(self, state: LatticeState) -> LatticeState:
        """Return a copy of a state that no indenter touches."""
        return replace(state, contact=None)

    def at_rest(self, state: LatticeState) -> LatticeState:
        """Return a copy of a state that does not move."""
        return replace(state, velocity=np.zeros_like(state.velocity))

    def cut(self, state: LatticeState, blade: SweptBlade, distance_mm: float | None = None) -> tuple[LatticeBody, LatticeState, LatticeCut]:
        """Return the lattice and its state behind a cut along the faces of its cubes; see `naibu.simulation.cut_lattice`.

        Parameters
        ----------
        state : LatticeState
            Of the lattice as the blade passes.
        blade : SweptBlade
            The surface that it sweeps, in the frame of the lattice.
        distance_mm : float, optional
            Twice the largest distance that the new surface may have from the blade; by default, as its cubes have it.

        Raises
        ------
        InputError
            What `naibu.simulation.cut_lattice` refuses, or a cut farther from the blade than it may be: lattices are not refined.
        """
        if distance_mm is not None:
            require_positive("distance_mm", distance_mm, "mm")
        found = cut_lattice(self.engine.lattice, self.engine.parameters, blade, positions=state.position)
        if distance_mm is not None and found.deviation_mm > 0.5 * distance_mm:
            raise InputError(
                f"distance_mm is {distance_mm:g} mm, and faces of the lattice's cubes lie up to {found.deviation_mm:.3g} mm from the "
                f"blade; choose {2.0 * found.deviation_mm:.3g} mm or more, or a lattice of a smaller spacing. It is as it was"
            )
        force = None if self.external_force is None else found.divided(np.broadcast_to(self.external_force, state.position.shape))
        supported = np.flatnonzero(np.isin(found.source, self.supported)).astype(np.int64)
        cells = to_tetra(found.mesh).cells
        body = LatticeBody(
            cut_engine(self.engine, found), surface_triangles(found.lattice), cells, supported, self.fixtures, external_force=force
        )
        return body, found.state(state), found

    def unbalanced(self, session: AnySession) -> float:
        """Return 0: a step of a lattice leaves nothing out of balance."""
        return 0.0

    def caution(self, name: str, tool: RigidIndenter | None) -> str:
        """Return that the faces of the lattice do not resolve what a tool touches, and by how much its force may be wrong; else nothing."""
        return "" if tool is None else unresolved(self.engine.lattice, tool.geometry, name)

    def strain(self, positions: FloatArray) -> FloatArray:
        """Return the mean elongation of the elements at every node (n,), % of their length at rest."""
        lattice = self.engine.lattice
        i, j = lattice.elements.T
        stretch = np.linalg.norm(positions[j] - positions[i], axis=1) / lattice.lengths - 1.0
        ends = np.concatenate([i, j])
        sums = np.bincount(ends, np.concatenate([stretch, stretch]), minlength=lattice.n_nodes)
        return np.asarray(100.0 * sums / np.maximum(np.bincount(ends, minlength=lattice.n_nodes), 1))

    def kept_clear(self, positions: FloatArray) -> FloatArray:
        """Return the nodes and the middles of the elements (k, 3), mm: a session refuses indenters that begin about one of them."""
        return np.concatenate([positions, positions[self.engine.lattice.elements].mean(axis=1)])


@dataclass(frozen=True, slots=True, eq=False)
class FiniteElementBody:
    """A finite element model at finite strain that is touched; made by `FiniteElementBody.of`.

    Attributes
    ----------
    engine : DynamicEngine
        Elements, materials, masses and step.
    mesh : Mesh
        Linear tetrahedra or hexahedra.
    density : float
        kg/mm3.
    gravity : ndarray, shape (3,)
        Acceleration, mm/s2.
    faces : ndarray, shape (f, 3), int64
        Triangles of the surface.
    cells : ndarray, shape (m, 4), int64
        Tetrahedra for sections, and for the strain.
    supported : ndarray, shape (s,), int64
        Nodes that never move.
    fixtures : tuple of RigidIndenter
        Rigid bodies in contact that never move.
    forest : BisectionForest, optional
        Of the cut that the mesh comes from, for the next one.
    lips_friction : float
        Coulomb's coefficient between the sides of the cuts to come.
    outward : ndarray, shape (n, 3), optional
        Normals of the blades at the nodes on the sides of their cuts; see `naibu.simulation.cuts.cut_sides.outward_normals`.
    """

    engine: DynamicEngine
    mesh: Mesh
    density: float
    gravity: FloatArray
    faces: IntArray
    cells: IntArray
    supported: IntArray
    fixtures: tuple[RigidIndenter, ...]
    forest: BisectionForest | None = None
    lips_friction: float = 0.0
    outward: FloatArray | None = None

    @classmethod
    def of(
        cls,
        mesh: Mesh,
        assembler: Assembler,
        *,
        supported: IntArray = NO_NODES,
        fixtures: Sequence[RigidIndenter] = (),
        density: float = 1e-6,
        gravity: ArrayLike = (0.0, 0.0, 0.0),
        step_s: float = 1.0 / 60.0,
        normal_stiffness: float = 1000.0,
        tangential_stiffness: float = 200.0,
        background: bool = True,
    ) -> FiniteElementBody:
        """Return the body of a mesh.

        Parameters
        ----------
        mesh : Mesh
            Linear tetrahedra or hexahedra.
        assembler : Assembler
            Its elements and materials.
        supported : ndarray, shape (s,), int64
            Nodes that never move.
        fixtures : sequence of RigidIndenter
            Rigid bodies in contact that never move.
        density : float
            kg/mm3; that of water by default.
        gravity : array_like, shape (3,)
            Acceleration, mm/s2.
        step_s : float
            Length of a step, s.
        normal_stiffness, tangential_stiffness : float
            Penalties of the contact, kPa/mm.
        background : bool
            Whether a thread renews the tangents; otherwise runs are repeatable. See `naibu.mechanics.RealTimeEngine`.

        Raises
        ------
        InputError
            Quadratic cells, or a density, step or penalty that is not positive.
        """
        if mesh.cell_type not in ("tetra", "hexahedron"):
            raise InputError(f"mesh has {mesh.cell_type!r} cells; contact needs linear tetrahedra or hexahedra")
        require_positive("density", density, "kg/mm3")
        faces = boundary_faces(mesh).faces
        mass = body_force(assembler.elements, np.full(mesh.n_cells, density), np.array([1.0, 0.0, 0.0]))[:, 0]
        engine = RealTimeEngine(mesh.points, assembler, mass, faces, step_s, normal_stiffness, tangential_stiffness, background=background)
        triangles, cells = triangles_of_faces(faces), to_tetra(mesh).cells
        return cls(engine, mesh, density, as_vector("gravity", gravity), triangles, cells, supported, tuple(fixtures))

    @property
    def points(self) -> FloatArray:
        """Nodes in the reference configuration (n, 3), mm."""
        return self.engine.points

    @property
    def step_s(self) -> float:
        """Length of a step, s."""
        return self.engine.step

    @property
    def unmoved_by_failures(self) -> bool:
        """Return False: a step at finite strain that finds no balance has moved the body."""
        return False

    def session(self) -> AnySession:
        """Begin at rest on the supports."""
        weight = self.engine.mass[:, None] * self.gravity
        session = self.engine.session(external_force=weight, indenters=self.fixtures)
        self.grip(session, NO_NODES)
        return session

    def grip(self, session: AnySession, nodes: IntArray) -> None:
        """Tie nodes to a body that the loop moves; those of the supports stay where they are."""
        session.constrain([self.supported, np.setdiff1d(nodes, self.supported)])

    def grip_velocity(self, velocity: FloatArray) -> FloatArray:
        """Return the velocities of the support and of the gripped nodes (2, 3), mm/s."""
        return np.array([(0.0, 0.0, 0.0), velocity])

    def step(
        self, session: AnySession, velocity: FloatArray, motions: Sequence[IndenterMotion], steps: int, budget_s: float
    ) -> StepForces | None:
        """Take steps; a single one is left to the next call after about a time of the processor, and then None is returned."""
        if steps == 1 and np.isfinite(budget_s) and isinstance(session, RealTimeSession):
            return session.step_within(budget_s, velocity, motions)
        return session.step(velocity, motions, steps=steps)

    def without_contact(self, state: DynamicState) -> DynamicState:
        """Return a copy of a state that no indenter touches."""
        return DynamicState(state.displacement, state.velocity)

    def at_rest(self, state: DynamicState) -> DynamicState:
        """Return a copy of a state that does not move."""
        return replace(state, velocity=np.zeros_like(state.velocity))

    def cut(
        self, state: DynamicState, blade: SweptBlade, distance_mm: float | None = None
    ) -> tuple[FiniteElementBody, DynamicState, VolumeCut]:
        """Return the body and its state behind a cut; hexahedra are split into tetrahedra first.

        Displacements, velocities, materials and supports are kept, and with them momentum and energy.

        Parameters
        ----------
        state : DynamicState
            Of the body as the blade passes.
        blade : SweptBlade
            The surface that it sweeps.
        distance_mm : float, optional
            See `naibu.meshing.cut_volume`; the mean edge of the mesh by default.

        Raises
        ------
        InputError
            What `naibu.meshing.cut_volume` refuses.
        """
        mesh, assembler = to_tetra(self.mesh), self.engine.assembler
        fine = mean_edge_length(self.mesh) if distance_mm is None else distance_mm
        split = np.repeat(np.arange(self.mesh.n_cells), mesh.n_cells // self.mesh.n_cells)
        found = cut_volume(mesh, blade, fine, positions=mesh.points + state.displacement, forest=self.forest)
        before = split[found.parents]
        placeholder = [material(young_modulus=1.0, poisson_ratio=0.3)] * len(mesh.region_names)
        made = Assembler.from_materials(elements(found.mesh, "mean_dilatation"), found.mesh.regions, placeholder)
        made = replace(made, law_codes=assembler.law_codes[before], parameters=assembler.parameters[before])
        outward = outward_normals(found, blade, self.outward)
        made = with_sides_of_cuts(made, found.mesh, self.lips_friction, outward)
        held = np.isin(np.arange(mesh.n_points), self.supported).astype(float)
        body = FiniteElementBody.of(
            found.mesh, made, supported=np.flatnonzero(found.nodal(held) > 1.0 - 1e-9).astype(np.int64), fixtures=self.fixtures,
            density=self.density, gravity=self.gravity, step_s=self.engine.step, normal_stiffness=self.engine.normal_stiffness,
            tangential_stiffness=self.engine.tangential_stiffness,
            background=not isinstance(self.engine, RealTimeEngine) or self.engine.background,
        )  # fmt: skip
        body = replace(body, forest=found.forest, lips_friction=self.lips_friction, outward=outward)
        return body, DynamicState(found.nodal(state.displacement), found.nodal(state.velocity)), found

    def unbalanced(self, session: AnySession) -> float:
        """Return the out-of-balance force that the last step left to the next ones, as a fraction of all forces."""
        return session.unbalanced if isinstance(session, RealTimeSession) else 0.0

    def caution(self, name: str, tool: RigidIndenter | None) -> str:
        """Return that behind cuts the force of a tool, or of a grip, may be too low, and by how much; else nothing.

        How wrong forces of tools smaller than elements are was not measured.
        """
        return caution_of_cuts(self.engine.assembler, f"the force of {name}")

    def strain(self, positions: FloatArray) -> FloatArray:
        """Return the von Mises equivalent of the Green-Lagrange strain at the nodes (n,), %, averaged over the tetrahedra around them."""
        rest, moved = (p[self.cells[:, 1:]] - p[self.cells[:, :1]] for p in (self.points, positions))
        gradient = np.linalg.solve(rest, moved)  # transposed
        green = 0.5 * (gradient @ gradient.transpose(0, 2, 1) - np.eye(3))
        deviator = green - np.trace(green, axis1=1, axis2=2)[:, None, None] / 3.0 * np.eye(3)
        equivalent = np.sqrt(2.0 / 3.0 * (deviator**2).sum(axis=(1, 2)))
        sums = np.bincount(self.cells.ravel(), np.repeat(equivalent, 4), minlength=len(self.points))
        return np.asarray(100.0 * sums / np.maximum(np.bincount(self.cells.ravel(), minlength=len(self.points)), 1))

    def kept_clear(self, positions: FloatArray) -> FloatArray:
        """Return nodes, middles of edges and centroids of the triangles of the surface (k, 3), mm."""
        return surface_samples(positions, self.faces)


def nodes_touching(points: FloatArray, indenters: Sequence[RigidIndenter], tolerance_mm: float = 1e-6) -> IntArray:
    """Return the nodes (k,) of points (n, 3), mm, that lie on or in any of the indenters where they were made.

    Raises
    ------
    InputError
        A tolerance that is negative.
    """
    if tolerance_mm < 0.0:
        raise InputError(f"tolerance_mm must not be negative, not {tolerance_mm:g} mm")
    near = np.zeros(len(points), dtype=bool)
    for indenter in indenters:
        near |= indenter.gap(points) < tolerance_mm
    return np.flatnonzero(near).astype(np.int64)
