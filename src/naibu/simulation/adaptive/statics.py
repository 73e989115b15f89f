"""Adaptive statics: solve, estimate the error, mark by Doerfler's rule, refine, and again :cite:p:`doerfler1996`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.mechanics.contact.indenter_contacts import indenter_contacts, moving_contacts
from naibu.mechanics.contact.penalty_contact import Contact
from naibu.mechanics.contact.rigid_indenters import RigidIndenter
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.mechanics.finite_elements.elements import Formulation, elements
from naibu.mechanics.finite_elements.hyperelasticity import Material, lame_parameters
from naibu.mechanics.finite_elements.linear_simplices import lumped_mass, simplices
from naibu.mechanics.finite_strain.problem import Problem, SolverSettings
from naibu.mechanics.finite_strain.statics import Solution, solve
from naibu.mechanics.linear_algebra.block_matrix import block_pattern
from naibu.mechanics.small_strain.linear_elasticity import LinearBody
from naibu.meshing.refinement.forest import BisectionForest, LeafMesh
from naibu.meshing.refinement.marking import doerfler_marks
from naibu.meshing.refinement.transfer import transferred_nodes
from naibu.meshing.surface import boundary_faces
from naibu.simulation.adaptive.conditions import Conditions, Selection
from naibu.simulation.adaptive.error_estimator import recovery_indicators
from naibu.simulation.adaptive.force_error import first_piola, path_force_errors
from naibu.simulation.cuts.cut_sides import with_sides_of_cuts


@dataclass(frozen=True, slots=True, eq=False)
class StaticResult:
    """Equilibrium on one mesh.

    Attributes
    ----------
    displacement : ndarray, shape (n, d)
        mm.
    indicators : ndarray, shape (m,)
        Errors of the cells, ``(mN mm)^(1/2)``.
    energy : float
        Strain energy, mN mm.
    reactions : dict
        Forces (3,), mN, of rigid bodies on the body, by their names.
    force_errors : dict
        Estimated errors (3,), mN, of the forces of moving indenters, by their names; empty where they were not asked for.
    force_error : float, optional
        Sum of the sizes of the errors of all cells as a fraction of the force, of the indenter where that is largest: the estimate of
        `force_errors`, without cells whose errors cancel.
    carried : ndarray, shape (n, k), optional
        Values of the nodes that the next solution begins from, on its mesh, instead of the displacement.
    """

    displacement: FloatArray
    indicators: FloatArray
    energy: float
    reactions: dict[str, FloatArray] = field(default_factory=dict)
    force_errors: dict[str, FloatArray] = field(default_factory=dict)
    force_error: float | None = None
    carried: FloatArray | None = None

    def corrected_force(self, name: str) -> FloatArray:
        """Return the force (3,), mN, of an indenter on the body less its estimated error."""
        return np.asarray(self.reactions[name] - self.force_errors[name])

    @property
    def relative_error(self) -> float:
        """Estimated error of the forces where they are the goal, else that in the energy norm, as a fraction."""
        if self.force_error is not None:
            return self.force_error
        return float(np.linalg.norm(self.indicators) / np.sqrt(max(2.0 * self.energy, 1e-300)))


StaticSolve = Callable[[Mesh, FloatArray | None], StaticResult]
Goal = Literal["energy", "force"]


@dataclass(frozen=True, slots=True, eq=False)
class AdaptiveSolution:
    """Equilibria on a sequence of meshes, each refined where the one before was estimated to be wrong.

    Attributes
    ----------
    forest : BisectionForest
        Its leaves are the last mesh.
    leaf : LeafMesh
        The last mesh.
    rounds : tuple of StaticResult
        On all meshes, the last one last.
    unknowns : tuple of int
        Displacement components on all meshes.
    """

    forest: BisectionForest
    leaf: LeafMesh
    rounds: tuple[StaticResult, ...]
    unknowns: tuple[int, ...]

    @property
    def result(self) -> StaticResult:
        """On the last mesh."""
        return self.rounds[-1]


def solve_adaptively(
    mesh: Mesh,
    solve_on: StaticSolve,
    *,
    tolerance: float = 0.05,
    max_unknowns: int = 100_000,
    fraction: float = 0.5,
    bisections: int = 1,
    max_level: int = 60,
) -> AdaptiveSolution:
    """Refine a mesh until the estimated error of an equilibrium is small.

    Parameters
    ----------
    mesh : Mesh
        The coarsest one: triangles or linear tetrahedra.
    solve_on : callable
        Solves on a mesh, from a displacement (n, d), mm, of the mesh before (or what that solution carried) or None: `linear_static`,
        `hyperelastic_static`, or one's own.
    tolerance : float
        Estimated error as a fraction (`StaticResult.relative_error`).
    max_unknowns : int
        No finer mesh is solved when this number of displacement components is reached.
    fraction : float
        Part of the squared error that lies in the cells that are refined.
    bisections : int
        Bisections of every marked cell: d halve its edges.
    max_level : int
        Cells of this level are not refined.

    Raises
    ------
    InputError
        Cells that cannot be bisected, or settings out of range.
    ConvergenceError
        An equilibrium was not found.
    """
    if not tolerance >= 0.0 or bisections < 1:
        raise InputError(f"tolerance must not be negative and bisections must be at least 1, not {tolerance:g} and {bisections}")
    forest = BisectionForest.of(mesh)
    leaf, start = forest.leaf_mesh(), None
    rounds: list[StaticResult] = []
    unknowns: list[int] = []
    while True:
        found = solve_on(leaf.mesh, start)
        rounds.append(found)
        unknowns.append(found.displacement.size)
        if found.relative_error <= tolerance or unknowns[-1] >= max_unknowns:
            return AdaptiveSolution(forest, leaf, tuple(rounds), tuple(unknowns))
        values = found.displacement if found.carried is None else found.carried
        nodal = np.zeros((forest.node_rows, values.shape[1]))
        nodal[leaf.nodes] = values
        marked = leaf.cells[doerfler_marks(found.indicators, fraction)]
        anything = False
        for _ in range(bisections):
            change = forest.refine(marked, max_level=max_level)
            nodal, anything = transferred_nodes(forest, change, nodal), anything or bool(change)
            first = forest.children[marked]
            marked = np.concatenate([first[first >= 0], first[first >= 0] + 1]).astype(np.int64)
        if not anything:
            return AdaptiveSolution(forest, leaf, tuple(rounds), tuple(unknowns))
        leaf = forest.leaf_mesh()
        start = nodal[leaf.nodes]


def linear_static(
    conditions: Conditions, *, young_modulus: float | Sequence[float], poisson_ratio: float | Sequence[float], density: float = 0.0
) -> StaticSolve:
    """Return what solves small-strain linear elasticity on any mesh of triangles (plane strain) or tetrahedra, for `solve_adaptively`.

    Parameters
    ----------
    conditions : Conditions
        Fixed nodes and loads.
    young_modulus, poisson_ratio : float or sequence of float
        kPa and dimensionless, of all cells or one for each region.
    density : float
        kg/mm^3, for loads that depend on the mass.

    Raises
    ------
    InputError
        Moduli out of range.
    """
    moduli, ratios = np.broadcast_arrays(np.atleast_1d(young_modulus), np.atleast_1d(poisson_ratio))
    lame = np.array([lame_parameters(float(e), float(nu)) for e, nu in zip(moduli, ratios, strict=True)])

    def solve_on(mesh: Mesh, start: FloatArray | None) -> StaticResult:
        lam, mu = lame[np.minimum(mesh.regions, len(lame) - 1)].T
        body = LinearBody.of(mesh)
        force = conditions.force(mesh, lumped_mass(body.simplices, density))
        held = PrescribedDisplacement(conditions.constrained(mesh.points), np.zeros_like(mesh.points))
        u = body.solve(lam, mu, held, force)
        gradient = body.simplices.displacement_gradients(u)
        strain = 0.5 * (gradient + np.swapaxes(gradient, 1, 2))
        trace = np.einsum("mii->m", strain)
        stress = 2.0 * mu[:, None, None] * strain + (lam * trace)[:, None, None] * np.eye(mesh.dimension)
        energy = 0.5 * float((body.simplices.measures * (stress * strain).sum(axis=(1, 2))).sum())
        return StaticResult(u, recovery_indicators(mesh, stress, mu), energy)

    return solve_on


def pressed_by(
    indenters: Sequence[RigidIndenter],
    travel: ArrayLike,
    *,
    faces: Selection | None = None,
    normal_stiffness: float = 1000.0,
    tangential_stiffness: float = 200.0,
) -> Callable[[Mesh], tuple[Contact, ...]]:
    """Return the contacts of any mesh with rigid indenters that move in a straight line, for `hyperelastic_static`.

    Their reactions are called ``"indenter 0"``, ``"indenter 1"``, ...

    Parameters
    ----------
    indenters : sequence of RigidIndenter
        Where they begin; none may have pull-off, or two friction coefficients.
    travel : array_like, shape (k, 3) or (3,)
        How far they move, mm.
    faces : callable, optional
        From positions at rest (n, 3), mm, to the nodes (n,) whose faces may be touched, all of them by default; fewer take less time.
    normal_stiffness, tangential_stiffness : float
        Penalties, kPa/mm.

    Raises
    ------
    InputError
        A travel of another number of indenters, or, on a mesh, what `naibu.mechanics.rigid_contact` refuses.
    """
    bodies = tuple(indenters)
    given = np.asarray(travel, dtype=float)
    if given.shape not in ((3,), (len(bodies), 3)) or not np.isfinite(given).all():
        raise InputError(f"travel must be (3,) or ({len(bodies)}, 3), finite, in mm, not {given.shape}")
    centres = np.array([i.centre for i in bodies], dtype=float).reshape(-1, 3)
    still = np.zeros_like(centres)

    def contacts(mesh: Mesh) -> tuple[Contact, ...]:
        outer = boundary_faces(mesh).faces
        if faces is not None:
            outer = outer[np.asarray(faces(mesh.points))[outer].all(axis=1)]
        made = indenter_contacts(bodies, mesh.points, outer, normal_stiffness=normal_stiffness, tangential_stiffness=tangential_stiffness)
        return moving_contacts(made, centres, np.tile(np.eye(3), (len(bodies), 1, 1)), still + given, still)

    return contacts


def hyperelastic_problem(
    mesh: Mesh,
    conditions: Conditions,
    materials: Sequence[Material],
    *,
    contacts: tuple[Contact, ...] = (),
    density: float = 0.0,
    formulation: Formulation = "standard",
    lips_friction: float = 0.0,
) -> Problem:
    """Return the boundary value problem on one mesh of tetrahedra; see `hyperelastic_static`."""
    parts = elements(mesh, formulation)
    pattern = block_pattern(mesh.n_points, parts.connectivity, *(c.nodes for c in contacts))
    assembler = Assembler.from_materials(parts, mesh.regions, list(materials), pattern)
    assembler = with_sides_of_cuts(assembler, mesh, lips_friction)
    held = PrescribedDisplacement(conditions.constrained(mesh.points), np.zeros_like(mesh.points))
    return Problem(mesh.points, assembler, contacts, held, conditions.force(mesh, lumped_mass(simplices(mesh), density)))


def hyperelastic_static(
    conditions: Conditions,
    materials: Sequence[Material],
    *,
    contacts: Callable[[Mesh], tuple[Contact, ...]] = lambda mesh: (),
    density: float = 0.0,
    settings: SolverSettings | None = None,
    formulation: Formulation = "standard",
    goal: Goal = "energy",
    lips_friction: float = 0.0,
) -> StaticSolve:
    """Return what solves for equilibrium at finite strain, in contact or not, on any mesh of tetrahedra, for `solve_adaptively`.

    Parameters
    ----------
    conditions : Conditions
        Fixed nodes and loads.
    materials : sequence of Material
        One for each region.
    contacts : callable
        From a mesh to its contacts with rigid bodies; such as `pressed_by`.
    density : float
        kg/mm^3, for loads that depend on the mass.
    settings : SolverSettings, optional
        Load steps and tolerances; the equilibrium of the mesh before is the initial guess.
    formulation : {"standard", "mean_dilatation"}
        See `naibu.mechanics.elements`; the latter for Poisson's ratios above 0.4.
    goal : {"energy", "force"}
        Whether cells are marked by their part in the error in the energy norm, or in those of the forces of moving indenters along their
        travel, which `StaticResult.force_errors` then holds :cite:p:`becker2001`.
    lips_friction : float
        Coulomb's coefficient between the two sides of cuts. With friction, every mesh follows the load from its beginning.

    Raises
    ------
    InputError
        A negative coefficient.
    """

    def solve_on(mesh: Mesh, start: FloatArray | None) -> StaticResult:
        problem = hyperelastic_problem(
            mesh, conditions, materials, contacts=contacts(mesh), density=density, formulation=formulation, lips_friction=lips_friction
        )
        known = [] if start is None or problem.assembler.unsymmetric else [(1.0, start)]
        found = solve(problem, settings=settings, warm_start=known)
        return static_result(mesh, found, materials, goal)

    return solve_on


def static_result(mesh: Mesh, found: Solution, materials: Sequence[Material], goal: Goal) -> StaticResult:
    """Return the last state of a solution with the errors of the cells; see `hyperelastic_static`."""
    u = found.displacement
    energy = found.problem.assembler.forces(u)[0]
    if goal == "force":
        return _with_force_errors(mesh, found, energy)
    stress = first_piola(mesh, found.problem, u, simplices(mesh).displacement_gradients(u))
    shear = np.array([m.small_strain_shear_modulus for m in materials])[mesh.regions]
    return StaticResult(u, recovery_indicators(mesh, stress, shear), energy, found.reactions)


def _with_force_errors(mesh: Mesh, found: Solution, energy: float) -> StaticResult:
    """Return the result whose indicators are roots of the parts of the cells in the errors of the forces."""
    errors = path_force_errors(mesh, found.problem, found.states[-2:])[0]
    sums = np.zeros(mesh.n_cells)
    worst = 0.0
    for name, cells in errors.cells.items():
        along = float(np.abs(found.reactions[name] @ errors.directions[name]))
        parts = np.abs(cells) / (along if along > 0.0 else np.inf)
        sums += parts
        worst = max(worst, float(parts.sum()))
    return StaticResult(found.displacement, np.sqrt(sums), energy, found.reactions, dict(errors.total), worst)
