"""Forward model of a load case with a measured displacement field: material law, equilibrium and the weighted residual.

The forces on the loaded components of the nodes are not measured, so their displacement b is unknown; that of all other components follows
from equilibrium. The state of a load case is thus a function of the moduli and of b, an ordinary simulation under prescribed displacement,
and the measured field constrains both.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
import scipy.sparse as sp

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import ConvergenceError, InputError
from naibu.core.mesh import Mesh
from naibu.identification.from_fields.load_cases import FieldLoadCase
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.mechanics.finite_elements.elements import elements
from naibu.mechanics.finite_elements.hyperelasticity import material
from naibu.mechanics.finite_elements.linear_simplices import Simplices, parameter_forces, simplices
from naibu.mechanics.finite_elements.modulus_derivatives import unit_forces
from naibu.mechanics.finite_strain.problem import Problem, SolverSettings
from naibu.mechanics.finite_strain.statics import solve
from naibu.mechanics.linear_algebra.block_matrix import with_dirichlet_rows
from naibu.mechanics.linear_algebra.direct import direct_solver, pardiso_library
from naibu.mechanics.linear_algebra.protocols import Factorization, LinearSolver
from naibu.mechanics.linear_algebra.solver_selection import DIRECT_LIMIT, choose_solver
from naibu.mechanics.small_strain.linear_elasticity import LinearBody
from naibu.meshing.point_location import interpolation_operator

LawName = Literal["linear", "neo_hookean"]
EXACT = 1e-3  # standard deviation ascribed to data that are called exact, as a fraction of the largest displacement: models are not exact
SURFACE_STRAIN = 1.0  # standard deviation of the strain along loaded nodes: constrains those near which nothing was measured
NEWTON_TOLERANCE = 1e-9  # residual force over the force on the loaded nodes
NEWTON_ITERATIONS = 12


class FieldLaw(Protocol):
    """A law on the cells of a mesh, linear in lambda and mu of every cell (kPa)."""

    simplices: Simplices
    linear: bool

    def forces(self, lame: FloatArray, shear: FloatArray, u: FloatArray) -> FloatArray:
        """Return the nodal forces (n, d), mN, at a displacement (n, d), mm; not finite where a cell is inverted."""
        ...

    def stiffness(self, lame: FloatArray, shear: FloatArray, u: FloatArray) -> sp.bsr_matrix:
        """Return the tangent stiffness (n d, n d), mN/mm."""
        ...

    def unit_forces(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the forces at the vertices of every cell for lambda = 1 kPa and for mu = 1 kPa, (m, d + 1, d) each, mN."""
        ...


class SmallStrain:
    """Linear elasticity."""

    linear = True

    def __init__(self, mesh: Mesh) -> None:
        self.body = LinearBody.of(mesh)
        self.simplices = self.body.simplices

    def forces(self, lame: FloatArray, shear: FloatArray, u: FloatArray) -> FloatArray:
        """Return the nodal forces (n, d), mN, at a displacement (n, d), mm."""
        return self.body.forces(lame, shear, u)

    def stiffness(self, lame: FloatArray, shear: FloatArray, u: FloatArray) -> sp.bsr_matrix:
        """Return the stiffness (n d, n d), mN/mm."""
        return self.body.stiffness(lame, shear)

    def unit_forces(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the forces at the vertices of every cell for lambda = 1 kPa and for mu = 1 kPa, (m, d + 1, d) each, mN."""
        return parameter_forces(self.simplices, u)


class NeoHookean:
    """Compressible neo-Hookean law ``W = mu (I1 - 3) / 2 - mu ln J + lambda (ln J)^2 / 2`` at finite strain, on linear tetrahedra.

    Raises
    ------
    InputError
        Other cells than linear tetrahedra.
    """

    linear = False

    def __init__(self, mesh: Mesh) -> None:
        if mesh.cell_type != "tetra":
            raise InputError(f"the neo-Hookean law needs linear tetrahedra, not {mesh.cell_type!r} cells; split them, or use law='linear'")
        self.simplices = simplices(mesh)
        each = np.zeros(mesh.n_cells, dtype=np.int64)
        some = material("neo_hookean", young_modulus=1.0, poisson_ratio=0.3)
        self._assembler = Assembler.from_materials(elements(mesh, "standard"), each, [some])

    def assembler(self, lame: FloatArray, shear: FloatArray) -> Assembler:
        """Return the assembler of the body with these moduli."""
        table = np.zeros((len(lame), self._assembler.parameters.shape[1]))
        table[:, 0], table[:, 1] = shear, lame
        return self._assembler.with_parameters(table)

    def forces(self, lame: FloatArray, shear: FloatArray, u: FloatArray) -> FloatArray:
        """Return the nodal forces (n, 3), mN, at a displacement (n, 3), mm; infinite where a cell is inverted."""
        _, force, smallest = self.assembler(lame, shear).forces(u)
        return force if smallest > 0.0 else np.full_like(force, np.inf)

    def stiffness(self, lame: FloatArray, shear: FloatArray, u: FloatArray) -> sp.bsr_matrix:
        """Return the tangent stiffness (n d, n d), mN/mm."""
        return self._assembler.pattern.matrix(self.assembler(lame, shear).evaluate(u)[2])

    def unit_forces(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the forces at the vertices of every cell for lambda = 1 kPa and for mu = 1 kPa, (m, 4, 3) each, mN."""
        return unit_forces(self.simplices, u, "neo_hookean")


def field_law(mesh: Mesh, name: LawName) -> FieldLaw:
    """Return the law of that name on a mesh.

    Raises
    ------
    InputError
        An unknown name, or cells that the law is not made for.
    """
    if name == "linear":
        return SmallStrain(mesh)
    if name == "neo_hookean":
        return NeoHookean(mesh)
    raise InputError(f"law {name!r} is not known for fields; use 'linear' or 'neo_hookean'")


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """Measurements of a load case, whitened, and the components of the model's nodes that follow from equilibrium.

    Attributes
    ----------
    load_case : FieldLoadCase
        The load case.
    operator : csr_matrix, shape (q, n d)
        From nodal displacements to whitened data, 1/mm.
    data : ndarray, shape (q,)
        Whitened measurements.
    loaded : ndarray, shape (n_b,), int64
        Numbers of the loaded components among the n d.
    prior : csr_matrix, shape (n_b, n_b)
        Weak prior on the displacement of the loaded components, 1/mm^2.
    noise_mm : float
        Root mean square standard deviation of a component, mm.
    exact : bool
        Whether the data were called exact, so that `noise_mm` is nominal.
    """

    load_case: FieldLoadCase
    operator: sp.csr_matrix
    data: FloatArray
    loaded: IntArray
    prior: sp.csr_matrix
    noise_mm: float
    exact: bool

    @classmethod
    def of(cls, mesh: Mesh, load_case: FieldLoadCase) -> Observed:
        """Whiten the valid measurements of a load case.

        Raises
        ------
        InputError
            Some data have a standard deviation and others none, a field that does not move, or points outside the mesh.
        """
        field, d = load_case.field, mesh.dimension
        valid = field.valid
        whiten, noise, exact = _whitening(field, load_case.name)
        where = interpolation_operator(mesh, field.points[valid]) if d == 3 else _at_nodes(mesh, field.points[valid], load_case.name)
        operator = (sp.block_diag(list(whiten), format="csr") @ sp.kron(where, sp.identity(d), format="csr")).tocsr()
        data = np.einsum("nij,nj->ni", whiten, field.vectors[valid]).ravel()
        loaded = np.flatnonzero(load_case.loaded.ravel()).astype(np.int64)
        return cls(load_case, operator, data, loaded, _surface_prior(mesh, loaded), noise, exact)

    def residual(self, u: FloatArray) -> FloatArray:
        """Return the whitened difference (q,) of a displacement (n, d), mm, from the measurements."""
        return np.asarray(self.operator @ u.ravel() - self.data)


def _whitening(field: DisplacementField, name: str) -> tuple[FloatArray, float, bool]:
    """Return the inverse square roots (k, d, d) of the covariances of the valid points, the RMS noise, mm, and whether it is nominal."""
    k, d = field.vectors[field.valid].shape
    covariance = np.zeros((k, d, d)) if field.covariance is None else field.covariance[field.valid]
    largest = float(np.abs(field.vectors[field.valid]).max())
    if not largest > 0.0:
        raise InputError(f"load case {name!r}: all displacements are zero; such a field does not determine moduli")
    values, vectors = np.linalg.eigh(covariance)
    exact = bool((values <= 0.0).all())
    if exact:
        values = np.full_like(values, (EXACT * largest) ** 2)
    if not (values > 0.0).all():
        raise InputError(f"load case {name!r}: some vectors have a standard deviation and others none; give one to all, or to none")
    whiten = np.einsum("nik,nk,njk->nij", vectors, 1.0 / np.sqrt(values), vectors)
    return whiten, float(np.sqrt(values.mean())), exact


def _at_nodes(mesh: Mesh, points: FloatArray, name: str) -> sp.csr_matrix:
    """Return the matrix (q, n) that picks the nodes at some points; in one and two dimensions data stand at nodes."""
    distance = np.linalg.norm(points[:, None] - mesh.points[None], axis=2)
    node = distance.argmin(axis=1)
    if distance.min(axis=1).max() > 1e-9 * float(np.ptp(mesh.points)):
        raise InputError(f"load case {name!r}: in {mesh.dimension} dimensions fields are measured at nodes of the mesh")
    return sp.csr_matrix((np.ones(len(points)), (np.arange(len(points)), node)), shape=(len(points), mesh.n_points))


def _surface_prior(mesh: Mesh, loaded: IntArray) -> sp.csr_matrix:
    """Return the graph Laplacian over the edges between loaded nodes, each weighted by (SURFACE_STRAIN length)^-2."""
    d, k = mesh.dimension, mesh.cells.shape[1]
    a, b = np.triu_indices(k, 1)
    edges = np.unique(np.sort(mesh.cells[:, np.stack([a, b], axis=1)].reshape(-1, 2), axis=1), axis=0)
    weight = (SURFACE_STRAIN * np.linalg.norm(mesh.points[edges[:, 0]] - mesh.points[edges[:, 1]], axis=1)) ** -2.0
    place = np.full(mesh.n_points * d, -1)
    place[loaded] = np.arange(len(loaded))
    rows, columns, values = [], [], []
    for axis in range(d):
        i, j = place[edges[:, 0] * d + axis], place[edges[:, 1] * d + axis]
        both = (i >= 0) & (j >= 0)
        i, j, w = i[both], j[both], weight[both]
        rows += [i, j, i, j]
        columns += [i, j, j, i]
        values += [w, w, -w, -w]
    index = np.concatenate(rows), np.concatenate(columns)
    return sp.csr_matrix((np.concatenate(values), index), shape=(len(loaded), len(loaded)))


class Solvers:
    """Linear solvers, one for each set of loaded components, analysed once."""

    def __init__(self, law: FieldLaw, points: FloatArray) -> None:
        self._law, self._points = law, points
        self._solvers: dict[bytes, LinearSolver] = {}

    def factorized(self, lame: FloatArray, shear: FloatArray, u: FloatArray, constrained: BoolArray, owner: bytes = b"") -> Factorization:
        """Factorize the stiffness at `u` with the components `constrained` (n, d) taken out.

        A factorization is valid until the next one of the same `constrained` and `owner`.
        """
        matrix = with_dirichlet_rows(self._law.stiffness(lame, shear, u), constrained)
        key = owner + np.packbits(constrained).tobytes()
        if key not in self._solvers:
            direct = matrix.shape[0] <= DIRECT_LIMIT and pardiso_library() is not None
            chosen = direct_solver(matrix, symmetric=True) if direct else choose_solver(matrix, self._points, constrained, symmetric=True)
            self._solvers[key] = chosen
        return self._solvers[key].factorize(matrix)


def equilibrium(
    law: FieldLaw, solvers: Solvers, lame: FloatArray, shear: FloatArray, load_case: FieldLoadCase, guess: FloatArray, owner: bytes
) -> tuple[FloatArray, Factorization]:
    """Return the displacement (n, d), mm, in equilibrium, with the loaded components as in `guess`, and the factorized tangent there.

    Raises
    ------
    ConvergenceError
        Newton's method fails from this guess, or a cell inverts.
    """
    u, constrained = guess, load_case.loaded
    factor, before = solvers.factorized(lame, shear, u, constrained, owner), np.inf
    for _ in range(NEWTON_ITERATIONS):
        residual = law.forces(lame, shear, u) - load_case.external_force
        scale = float(np.abs(residual[constrained]).sum() + np.abs(load_case.external_force).sum())
        if not np.isfinite(scale):
            raise ConvergenceError(f"load case {load_case.name!r}: a cell is inverted")
        residual[constrained] = 0.0
        norm = float(np.abs(residual).sum()) / max(scale, 1e-300)
        if norm <= NEWTON_TOLERANCE and not law.linear:
            return u, factor if before == np.inf else solvers.factorized(lame, shear, u, constrained, owner)
        if norm > 0.1 * before:  # the tangent of an earlier displacement serves no more
            factor = solvers.factorized(lame, shear, u, constrained, owner)
        before = norm
        u = u - np.where(constrained, 0.0, factor.solve(residual.ravel()).reshape(u.shape))
        if law.linear:
            return u, factor
    raise ConvergenceError(f"load case {load_case.name!r}: Newton's method did not reach equilibrium within {NEWTON_ITERATIONS} iterations")


def loaded_from_rest(
    law: FieldLaw, points: FloatArray, lame: FloatArray, shear: FloatArray, load_case: FieldLoadCase, moved: FloatArray
) -> FloatArray:
    """Return the displacement (n, d), mm, in equilibrium under a finite-strain law, the loaded components moved in steps to `moved` (n, d).

    Raises
    ------
    ConvergenceError
        The path of the load ends before that.
    """
    if not isinstance(law, NeoHookean):
        return moved
    values = np.where(load_case.loaded, moved, 0.0)
    problem = Problem(points, law.assembler(lame, shear), (), PrescribedDisplacement(load_case.loaded, values), load_case.external_force)
    return solve(problem, settings=SolverSettings(first_step=0.2, largest_step=0.5, tolerance=1e-8)).displacement
