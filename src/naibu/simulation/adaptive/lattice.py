"""Adaptive mass-spring-dashpot lattices :cite:p:`hirai2008` (chapter 4.2) on the edges of bisected tetrahedra."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray, IntArray, require_positive
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.mechanics.contact.indenter_motion import IndenterMotion, IndenterVelocity, indenter_velocities
from naibu.mechanics.contact.rigid_indenters import RigidIndenter
from naibu.mechanics.contact.session_protocol import StepForces
from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.cpu.session import LatticeSession
from naibu.mechanics.lattices.model.lattice import Lattice, LatticeParameters
from naibu.mechanics.lattices.model.state import STEP_S, ConstrainedNodes, LatticeState, Method
from naibu.mechanics.lattices.model.tetrahedral_springs import DampingRule, edge_damping, mesh_edges
from naibu.meshing.cutting.forest_cut import ForestCut
from naibu.meshing.cutting.swept_blade import SweptBlade
from naibu.meshing.refinement.marking import Criterion
from naibu.meshing.surface import boundary_faces
from naibu.simulation.adaptive.adaptive_mesh import AdaptiveMesh, MeshState
from naibu.simulation.adaptive.conditions import Conditions
from naibu.simulation.adaptive.contact_transfer import transferred_contact

_FIRST, _SECOND = np.triu_indices(4, 1)


@dataclass(frozen=True, slots=True)
class SpringMaterial:
    """Material of a volumetric mass-spring-dashpot lattice; see `naibu.mechanics.volumetric_lattice`.

    Attributes
    ----------
    young_modulus : float
        E, kPa: the springs are ``K = E V / L^2``, with the volume V of the tetrahedra around an edge of length L.
    density : float
        kg/mm^3.
    damping : str
        ``"ratio"``: C1 is `damping_ratio` times the critical damping of the edge; ``"printed"``: the report's formula.
    damping_ratio : float
        Of ``"ratio"``.
    series_damping : float
        C2 of all edges, mN s/mm; infinite for none.

    Raises
    ------
    InputError
        Values that are not positive, or a ratio that is negative.
    """

    young_modulus: float
    density: float
    damping: DampingRule = "ratio"
    damping_ratio: float = 1.0
    series_damping: float = np.inf

    def __post_init__(self) -> None:
        require_positive("young_modulus", self.young_modulus, "kPa")
        require_positive("density", self.density, "kg/mm^3")
        if not (np.isfinite(self.damping_ratio) and self.damping_ratio >= 0.0 and self.series_damping > 0.0):
            raise InputError(
                f"damping_ratio must not be negative and series_damping must be positive, not {self.damping_ratio:g} and "
                f"{self.series_damping:g} mN s/mm"
            )


@dataclass(frozen=True, slots=True, eq=False)
class MeshSprings:
    """The lattice on the edges of one mesh.

    Attributes
    ----------
    lattice : Lattice
        Nodes and springs.
    parameters : LatticeParameters
        Of the springs.
    of_cell : ndarray, shape (m, 6), int64
        Springs on the edges of every cell.
    cell_mass : ndarray, shape (m,)
        Masses of the cells, kg.
    """

    lattice: Lattice
    parameters: LatticeParameters
    of_cell: IntArray
    cell_mass: FloatArray

    @classmethod
    def of(cls, mesh: AdaptiveMesh, material: SpringMaterial) -> MeshSprings:
        """Return the springs of the present mesh."""
        points, cells = mesh.leaf.mesh.points, mesh.leaf.mesh.cells
        volumes = mesh.forest.volumes(mesh.leaf.cells)
        edges, number = mesh_edges(cells)
        mass = material.density / 4.0 * np.bincount(cells.ravel(), np.repeat(volumes, 4), minlength=len(points)).astype(np.float64)
        around = np.bincount(number.ravel(), np.repeat(volumes, 6), minlength=len(edges))
        lengths = _lengths(points, edges)
        stiffness = material.young_modulus * around / lengths**2
        voigt = edge_damping(stiffness, mass[edges].sum(axis=1), lengths, material.damping, material.damping_ratio)
        zero, surface = np.zeros(len(edges), dtype=np.int8), np.zeros(len(points), dtype=bool)
        faces = boundary_faces(mesh.leaf.mesh).faces
        lattice = Lattice(points, edges, mass, zero, zero, zero, surface, float(lengths.mean()), np.ones(len(edges)), faces=faces)
        series = np.full(len(edges), float(material.series_damping))
        return cls(lattice, LatticeParameters(stiffness, voigt, series, np.full(len(edges), 0.5)), number, material.density * volumes)


@dataclass(slots=True, eq=False)
class AdaptiveLattice:
    """A lattice in motion whose mesh is refined and coarsened as it deforms; a session like those of `LatticeEngine.session`.

    Springs, masses and dampings of every mesh follow from the volumes of its tetrahedra at rest, as the report has them, so that the
    stationary state depends on the mesh but not on how it came about. New nodes lie in the middle of their edge and move with its mean
    velocity; momentum is conserved. The creep of series dashpots is carried as a strain of the cells. Rigid indenters touch the faces of
    the present mesh; what their contact has come to, pressure and friction, goes on on the next one.

    Attributes
    ----------
    mesh : AdaptiveMesh
        Forest, criterion and present mesh.
    material : SpringMaterial
        Of all cells.
    conditions : Conditions
        Supports and loads; body 0 are the fixed nodes, bodies 1, 2, ... those of `Conditions.moved`.
    time_step : float
        s.
    method : str
        See `LatticeEngine`.
    interval : int
        Steps between two adaptations.
    tolerance : float
        See `LatticeEngine`.
    springs : MeshSprings
        Lattice on the present mesh.
    session : LatticeSession
        Of this lattice.
    adaptations : int
        How many times the mesh changed.
    """

    mesh: AdaptiveMesh
    material: SpringMaterial
    conditions: Conditions
    time_step: float
    method: Method
    interval: int
    tolerance: float
    springs: MeshSprings
    session: LatticeSession
    adaptations: int = 0
    _since: int = 0

    @classmethod
    def of(
        cls,
        mesh: Mesh,
        material: SpringMaterial,
        conditions: Conditions,
        criterion: Criterion | None,
        *,
        indenters: Sequence[RigidIndenter] = (),
        max_level: int = 3,
        bisections: int = 3,
        interval: int = 20,
        step: float = STEP_S,
        method: Method = "implicit",
        tolerance: float = 1e-2,
    ) -> AdaptiveLattice:
        """Begin at rest, on the coarsest mesh.

        Parameters
        ----------
        mesh : Mesh
            Linear tetrahedra.
        material, conditions : SpringMaterial, Conditions
            What moves.
        criterion : Criterion or None
            Where the mesh is refined and coarsened; None: nowhere.
        indenters : sequence of RigidIndenter
            See `press`.
        max_level, bisections : int
            See `naibu.simulation.adaptive.adaptive_mesh.AdaptiveMesh`.
        interval : int
            Steps between two adaptations.
        step, method, tolerance : float, str, float
            As of `LatticeEngine.of`.

        Raises
        ------
        InputError
            Cells other than tetrahedra, conditions that select nothing they should, settings out of range, or what `press` refuses.
        """
        if mesh.cell_type != "tetra":
            raise InputError(f"volumetric springs lie on the edges of tetrahedra, not of {mesh.cell_type!r} cells; split the cells first")
        if interval < 1:
            raise InputError(f"interval must be at least 1 step, not {interval}")
        adaptive = AdaptiveMesh.of(mesh, criterion, max_level=max_level, bisections=bisections)
        springs = MeshSprings.of(adaptive, material)
        engine = LatticeEngine.of(springs.lattice, springs.parameters, step=step, method=method, tolerance=tolerance)
        session = _session(engine, conditions, adaptive, None, indenters)
        return cls(adaptive, material, conditions, step, method, interval, tolerance, springs, session)

    @property
    def lattice(self) -> Lattice:
        """The present lattice."""
        return self.springs.lattice

    @property
    def indenters(self) -> tuple[RigidIndenter, ...]:
        """Rigid indenters in contact, as they were made."""
        return self.session.indenters

    def press(self, indenters: Sequence[RigidIndenter]) -> None:
        """Bring these indenters, and no others, into play from the next step on, where they were made.

        Raises
        ------
        InputError
            An explicit method, or an indenter inside the object.
        """
        self.session.press(indenters)

    def indenter_distance(self, positions: FloatArray) -> FloatArray:
        """Return the signed distance (k,), mm, of positions (k, 3), mm, from the nearest indenter where it is now.

        With `naibu.meshing.NearContact` it is a criterion that follows the indenters.
        """
        centres, axes = self.session.poses()
        gaps = [replace(i.geometry, axes=a).distance(positions - c) for i, c, a in zip(self.indenters, centres, axes, strict=True)]
        return np.asarray(np.min([np.full(len(positions), np.inf), *gaps], axis=0))

    def step(self, velocity: ArrayLike = 0.0, motions: Sequence[IndenterMotion] = (), *, steps: int = 1) -> StepForces:
        """Take steps, and adapt the mesh after every `interval` of them.

        Parameters
        ----------
        velocity : array_like
            Velocities of the bodies that move nodes, mm/s, broadcast to (bodies, 3); the fixed nodes are body 0.
        motions : sequence of IndenterMotion
            One for each indenter, or none, and they stand still; see `LatticeSession.step`.
        steps : int
            How many.

        Returns
        -------
        StepForces
            Of the bodies and the indenters on the lattice in every step, mN.

        Raises
        ------
        InputError
            Velocities or motions of another number of bodies, or no step.
        ConvergenceError
            The explicit method diverged.
        """
        if steps < 1:
            raise InputError(f"steps must be at least 1, not {steps}")
        parts, left = self._towards(motions, steps), steps
        forces = []
        while left:
            chunk = min(left, self.interval - self._since)
            forces.append(self.session.step(velocity, motions if chunk == steps else parts, steps=chunk))
            left, self._since = left - chunk, self._since + chunk
            if self._since == self.interval:
                self.adapt()
                self._since = 0
        return StepForces(np.concatenate([f.bodies for f in forces]), np.concatenate([f.indenters for f in forces]))

    def _towards(self, motions: Sequence[IndenterMotion], steps: int) -> list[IndenterMotion]:
        """Return motions that hold in each of the steps: poses as the velocities that reach them at the end."""
        velocity, spin, poses = indenter_velocities(self.indenters, motions, *self.session.poses(), steps * self.time_step)
        return [IndenterVelocity(velocity[k], spin[k]) if k in poses else motion for k, motion in enumerate(motions)]

    def adapt(self) -> bool:
        """Refine and coarsen the mesh by the criterion; return whether it changed."""
        if self.mesh.criterion is None:
            return False
        return self._follow(self.mesh.adapted(self._mesh_state()))

    def change(self, refine: ArrayLike = (), coarsen: ArrayLike = ()) -> bool:
        """Refine and coarsen cells of given numbers in the forest, whatever the criterion; return whether the mesh changed."""
        wanted = (np.asarray(cells, dtype=np.int64) for cells in (refine, coarsen))
        return self._follow(self.mesh.changed(self._mesh_state(), *wanted))

    def cut(self, blade: SweptBlade, distance_mm: float, *, earlier: SweptBlade | None = None) -> ForestCut:
        """Cut the lattice, as it is deformed now, along the surface that a blade has swept; the next step is that of the cut lattice.

        Springs, masses and dampings of each side follow from its tetrahedra, so that mass and momentum are conserved; pieces that come
        loose move on as bodies of their own, and the mesh is refined and coarsened further.

        Parameters
        ----------
        blade : SweptBlade
            The surface; it may end inside the lattice.
        distance_mm : float
            See `naibu.meshing.cut_forest`.
        earlier : SweptBlade, optional
            Of a blade that goes on step by step; see `naibu.meshing.cut_forest`.

        Raises
        ------
        InputError
            What `naibu.meshing.cut_forest` refuses; the lattice is then as it was.
        """
        state, found = self.mesh.cut(self._mesh_state(), blade, distance_mm, earlier)
        self._follow(state)
        return found

    def constrain(self, conditions: Conditions) -> None:
        """Replace supports and loads from the next step on.

        Raises
        ------
        InputError
            Nodes that are held by two bodies.
        """
        state = self.session.state()
        self.session = _session(self._engine(), conditions, self.mesh, state, self.indenters, self.session.speed)
        self.conditions = conditions

    def positions(self, nodes: ArrayLike | None = None) -> FloatArray:
        """Return positions of nodes (k, 3), mm, by default of all; numbers are those of the present mesh."""
        return self.session.positions(nodes)

    def state(self) -> LatticeState:
        """Return a copy of the state on the present mesh.

        Raises
        ------
        ConvergenceError
            The explicit method diverged.
        """
        return self.session.state()

    def restore(self, state: LatticeState) -> None:
        """Go on from a state on the present mesh.

        Raises
        ------
        InputError
            A state of another mesh.
        """
        self.session.restore(state)

    def close(self) -> None:
        """Release threads; the lattice is not stepped any more."""
        self.session.close()

    def _mesh_state(self) -> MeshState:
        state, springs = self.session.state(), self.springs
        history = np.zeros((len(springs.cell_mass), 0))
        if np.isfinite(self.material.series_damping):
            creep = _lengths(state.position, springs.lattice.elements) - springs.lattice.lengths - state.extension
            history = _tensors(springs, self.mesh.leaf.mesh.cells, creep)
        pressure = None if state.contact is None else state.contact.multiplier.T
        motion = (state.position - springs.lattice.points, state.velocity)
        return MeshState(*motion, springs.lattice.node_mass, springs.cell_mass, history, pressure)

    def _follow(self, state: MeshState | None) -> bool:
        """Go on, on the mesh that a state belongs to."""
        if state is None:
            return False
        before, indenters, contact = self.session.engine.surface, self.indenters, self.session.state().contact
        self.springs = MeshSprings.of(self.mesh, self.material)
        lattice = self.springs.lattice
        position = lattice.points + state.displacement
        extension = _lengths(position, lattice.elements) - lattice.lengths
        if state.history.shape[1]:
            extension -= _creep(self.springs, state.history)
        engine = self._engine()
        if contact is not None and state.nodal is not None:
            contact = transferred_contact(contact, before(), engine.surface(), indenters, state.nodal.T)
        self.session.close()
        followed = LatticeState(position, state.velocity, extension, contact=contact)
        self.session = _session(engine, self.conditions, self.mesh, followed, indenters, self.session.speed)
        self.adaptations += 1
        return True

    def _engine(self) -> LatticeEngine:
        springs = self.springs
        return LatticeEngine.of(springs.lattice, springs.parameters, step=self.time_step, method=self.method, tolerance=self.tolerance)


def _session(
    engine: LatticeEngine, conditions: Conditions, mesh: AdaptiveMesh, state: LatticeState | None, indenters: Sequence[RigidIndenter],
    speed: FloatArray | None = None,
) -> LatticeSession:  # fmt: skip
    lattice, held = engine.lattice, ConstrainedNodes.none()
    for axis, fixed in enumerate(conditions.constrained(lattice.points).T):
        held = held + ConstrainedNodes.of(np.flatnonzero(fixed), axes=(axis,))
    for body, selected in enumerate(conditions.moved, start=1):
        held = held + ConstrainedNodes.of(np.flatnonzero(selected(lattice.points)), body)
    session = engine.session(state, held, conditions.force(mesh.leaf.mesh, lattice.node_mass), indenters)
    if speed is not None:
        session.speed[:] = speed
    return session


def _lengths(points: FloatArray, edges: IntArray) -> FloatArray:
    return np.asarray(np.linalg.norm(points[edges[:, 1]] - points[edges[:, 0]], axis=1))


def _directions(points: FloatArray, ends: IntArray) -> FloatArray:
    """Return the rows (..., 6) that take a symmetric tensor (xx, yy, zz, yz, zx, xy) to the strain along edges (..., 2)."""
    along = points[ends[..., 1]] - points[ends[..., 0]]
    x, y, z = np.moveaxis(along / np.linalg.norm(along, axis=-1, keepdims=True), -1, 0)
    return np.stack([x * x, y * y, z * z, 2.0 * y * z, 2.0 * z * x, 2.0 * x * y], axis=-1)


def _tensors(springs: MeshSprings, cells: IntArray, creep: FloatArray) -> FloatArray:
    """Return the strains (m, 6) that give the six edges of every cell their creep, mm."""
    rows = _directions(springs.lattice.points, np.stack([cells[:, _FIRST], cells[:, _SECOND]], axis=-1))
    return np.asarray(np.linalg.solve(rows, (creep / springs.lattice.lengths)[springs.of_cell][..., None])[..., 0])


def _creep(springs: MeshSprings, strains: FloatArray) -> FloatArray:
    """Return the creep (e,), mm, of edges in cells of strains (m, 6): the mean over the cells around an edge."""
    lattice, numbers = springs.lattice, springs.of_cell
    along = np.einsum("cek,ck->ce", _directions(lattice.points, lattice.elements)[numbers], strains)
    weights = np.repeat(springs.cell_mass, 6)
    sums, total = (np.bincount(numbers.ravel(), w, minlength=lattice.n_elements) for w in (weights * along.ravel(), weights))
    return np.asarray(lattice.lengths * sums / total)
