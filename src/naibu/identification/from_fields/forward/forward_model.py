"""Forward model of a load case with a measured displacement field: material law, equilibrium and the weighted residual.

The forces on the loaded components of the nodes are not measured, so their displacement b is unknown; that of all other components follows
from equilibrium. The state of a load case is thus a function of the moduli and of b, an ordinary simulation under prescribed displacement,
and the measured field constrains both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import ConvergenceError, InputError
from naibu.core.mesh import Mesh
from naibu.identification.from_fields.forward.field_laws import FieldLaw, NeoHookean
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase
from naibu.identification.from_fields.forward.refinement import Refinement
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.mechanics.finite_strain.problem import Problem, SolverSettings
from naibu.mechanics.finite_strain.statics import solve
from naibu.mechanics.linear_algebra.block_matrix import with_dirichlet_rows
from naibu.mechanics.linear_algebra.direct import direct_solver, pardiso_library
from naibu.mechanics.linear_algebra.protocols import Factorization, LinearSolver
from naibu.mechanics.linear_algebra.solver_selection import DIRECT_LIMIT, SolverName, choose_solver
from naibu.meshing.point_location import interpolation_operator

EXACT = 1e-3  # standard deviation ascribed to data that are called exact, as a fraction of the largest displacement: models are not exact
SURFACE_STRAIN = 0.2  # standard deviation of the strain along loaded nodes: constrains those near which nothing was measured
NEWTON_TOLERANCE = 1e-9  # residual force over the force on the loaded nodes
NEWTON_ITERATIONS = 12
KEPT_TOLERANCE = 1e-12  # the same with the tangent of an earlier point, whose last step gains a factor, and not that error squared
KEPT_SERVES = 0.3  # of what is unbalanced, that a solution with the tangent of an earlier point may leave
PATIENT_ITERATIONS = 30  # from a displacement that larger cells lend
LONG_WAY = 30_000  # unknowns up to which equilibrium is sought from rest as well: twenty factorizations or more, minutes beyond
MOST_FROM_REST = 100  # iterations on that path; most take twenty to forty
HALVINGS = 6
ITERATIVE_FROM = 30_000  # unknowns from which a body solved only once or twice is solved by iteration


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """Measurements of a load case, whitened, and the components of the model's nodes that follow from equilibrium.

    The displacement of the loaded components is that of the given nodes; mid-edge nodes between them lie half-way.

    Attributes
    ----------
    load_case : FieldLoadCase
        The load case, on the nodes on which equilibrium is computed.
    operator : csr_matrix, shape (q, n d)
        From nodal displacements to whitened data, 1/mm.
    information : csr_matrix, shape (n d, n d)
        The operator's transpose times the operator, 1/mm^2.
    data : ndarray, shape (q,)
        Whitened measurements.
    loaded : ndarray, shape (n_l,), int64
        Numbers of all loaded components among the n d.
    unknown : ndarray, shape (n_b,), int64
        Those of the given nodes, whose displacement is sought.
    basis : csr_matrix, shape (n_l, n_b)
        From the sought displacements to those of all loaded components.
    prior : csr_matrix, shape (n_b, n_b)
        Inverse covariance of the weak prior on the sought displacements, 1/mm^2.
    noise_mm : float
        Root mean square standard deviation of a component, mm.
    exact : bool
        Whether the data were called exact, so that `noise_mm` is nominal.
    """

    load_case: FieldLoadCase
    operator: sp.csr_matrix
    information: sp.csr_matrix
    data: FloatArray
    loaded: IntArray
    unknown: IntArray
    basis: sp.csr_matrix
    prior: sp.csr_matrix
    noise_mm: float
    exact: bool

    @classmethod
    def of(cls, mesh: Mesh, computed: Mesh, load_case: FieldLoadCase) -> Observed:
        """Whiten the valid measurements of a load case of `mesh`, whose equilibrium is computed on another of the same first nodes.

        Raises
        ------
        InputError
            Some data have a standard deviation and others none, a field that does not move, or points outside the mesh.
        """
        field, d = load_case.field, mesh.dimension
        valid = field.valid
        whiten, noise, exact = whitening(field, load_case.name)
        where = interpolation_operator(computed, field.points[valid]) if d == 3 else _at_nodes(mesh, field.points[valid], load_case.name)
        blocks = np.arange(len(whiten) + 1)
        operator = (sp.bsr_matrix((whiten, blocks[:-1], blocks)).tocsr() @ sp.kron(where, sp.identity(d), format="csr")).tocsr()
        data = np.einsum("nij,nj->ni", whiten, field.vectors[valid]).ravel()
        unknown = np.flatnonzero(load_case.loaded.ravel()).astype(np.int64)
        if computed is mesh:
            loaded, basis = unknown, sp.identity(len(unknown), format="csr")
        else:
            finer = Refinement.of(mesh)  # the nodes of quadratic cells are those of refined ones
            load_case = finer.load_case(load_case)
            loaded = np.flatnonzero(load_case.loaded.ravel()).astype(np.int64)
            basis = sp.kron(finer.parents, sp.identity(d), format="csr")[loaded][:, unknown]
        return cls(
            load_case, operator, (operator.T @ operator).tocsr(), data, loaded, unknown, basis, _surface_prior(mesh, unknown), noise, exact
        )

    def sought(self, u: FloatArray) -> FloatArray:
        """Return the sought displacements (n_b,), mm, among the displacement (n, d) of all nodes."""
        return u.ravel()[self.unknown]

    @property
    def points(self) -> FloatArray:
        """Positions of the measurements (k, d), mm."""
        return self.load_case.field.points[self.load_case.field.valid]

    def beyond(self, modes: FloatArray, data: FloatArray) -> FloatArray:
        """Return what of whitened data (q,) or (q, r) no combination of displacements (n d, m) of all nodes, mm, explains."""
        columns = self.operator @ modes
        return np.asarray(data - columns @ np.linalg.lstsq(columns, data, rcond=None)[0])

    def residual(self, u: FloatArray) -> FloatArray:
        """Return the whitened difference (q,) of a displacement (n, d), mm, from the measurements."""
        return np.asarray(self.operator @ u.ravel() - self.data)


def whitening(field: DisplacementField, name: str) -> tuple[FloatArray, float, bool]:
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
    edges = mesh.cells[:, np.stack([a, b], axis=1)].reshape(-1, 2)
    at_node = np.zeros(mesh.n_points, dtype=bool)
    at_node[loaded // d] = True
    edges = np.unique(np.sort(edges[at_node[edges].all(axis=1)], axis=1), axis=0)
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
    """Linear solvers, one for each set of loaded components, analysed once; large systems that are solved once, by iteration."""

    def __init__(self, law: FieldLaw, points: FloatArray, *, iterative: bool = False) -> None:
        self._law, self._points = law, points
        self._limit = ITERATIVE_FROM if iterative else DIRECT_LIMIT
        self._solvers: dict[bytes, LinearSolver] = {}
        self._held: dict[bytes, tuple[Factorization, tuple[FloatArray, ...]]] = {}

    def held(self, constrained: BoolArray, owner: bytes = b"") -> Factorization | None:
        """Return the last direct factorization of these `constrained` (n, d) and `owner`, of whatever moduli and displacement, if any."""
        found = self._held.get(owner + np.packbits(constrained).tobytes())
        return None if found is None else found[0]

    def factorized(self, lame: FloatArray, shear: FloatArray, u: FloatArray, constrained: BoolArray, owner: bytes = b"") -> Factorization:
        """Factorize the stiffness at `u` with the components `constrained` (n, d) taken out, unless that was the last one.

        A factorization is valid until the next one of the same `constrained` and `owner`.
        """
        key, at = owner + np.packbits(constrained).tobytes(), (lame, shear) if self._law.linear else (lame, shear, u)
        factor, of = self._held.pop(key, (None, ()))  # none is held where what follows fails
        if factor is None or not all(map(np.array_equal, of, at)):
            factor = self._anew(key, lame, shear, u, constrained)
        if u.size <= self._limit:
            self._held[key] = factor, tuple(a.copy() for a in at)
        return factor

    def _anew(self, key: bytes, lame: FloatArray, shear: FloatArray, u: FloatArray, constrained: BoolArray) -> Factorization:
        matrix = with_dirichlet_rows(self._law.stiffness(lame, shear, u), constrained)
        if key not in self._solvers:
            small = matrix.shape[0] <= self._limit
            if small and pardiso_library() is not None:
                chosen = direct_solver(matrix, symmetric=True)
            else:
                name: SolverName = "automatic" if small else "multigrid"
                chosen = choose_solver(matrix, self._points, constrained, symmetric=True, solver=name)
            self._solvers[key] = chosen
        return self._solvers[key].factorize(matrix)


def equilibrium(
    law: FieldLaw,
    solvers: Solvers,
    lame: FloatArray,
    shear: FloatArray,
    load_case: FieldLoadCase,
    guess: FloatArray,
    owner: bytes,
    iterations: int = NEWTON_ITERATIONS,
) -> tuple[FloatArray, Factorization]:
    """Return the displacement (n, d), mm, in equilibrium, with the loaded components as in `guess`, and the factorized tangent there.

    Raises
    ------
    ConvergenceError
        Newton's method fails from this guess, or a cell inverts.
    """
    constrained = load_case.loaded
    u = guess if law.linear else _nearer(law, solvers.held(constrained, owner), lame, shear, load_case, guess)
    factor, before = solvers.factorized(lame, shear, u, constrained, owner), np.inf
    force = law.forces(lame, shear, u)
    for _ in range(iterations):
        residual, norm = _unbalanced(load_case, force)
        if not np.isfinite(norm):
            raise ConvergenceError(f"load case {load_case.name!r}: a cell is inverted")
        if norm <= NEWTON_TOLERANCE and not law.linear:
            return u, factor if before == np.inf else solvers.factorized(lame, shear, u, constrained, owner)
        if norm > 0.1 * before:  # the tangent of an earlier displacement serves no more
            factor = solvers.factorized(lame, shear, u, constrained, owner)
        before = norm
        step = np.where(constrained, 0.0, factor.solve(residual.ravel()).reshape(u.shape))
        if law.linear:
            return u - step, factor
        u, force = _stepped(law, lame, shear, u, step)
    raise ConvergenceError(f"load case {load_case.name!r}: Newton's method did not reach equilibrium within {iterations} iterations")


def _nearer(
    law: FieldLaw, kept: Factorization | None, lame: FloatArray, shear: FloatArray, load_case: FieldLoadCase, guess: FloatArray
) -> FloatArray:
    """Return a displacement (n, d), mm, nearer to equilibrium than the guess, as far as a factorization of an earlier tangent leads fast.

    A solution with it takes a tenth of a factorization, or less.
    """
    if kept is None:
        return guess
    u, (residual, norm) = guess, _unbalanced(load_case, law.forces(lame, shear, guess))
    if norm <= NEWTON_TOLERANCE:
        return guess
    while np.isfinite(norm) and norm > KEPT_TOLERANCE:
        step = np.where(load_case.loaded, 0.0, kept.solve(residual.ravel()).reshape(u.shape))
        residual, new = _unbalanced(load_case, law.forces(lame, shear, u - step))
        if not new < KEPT_SERVES * norm:
            break
        u, norm = u - step, new
    return u


def _unbalanced(load_case: FieldLoadCase, force: FloatArray) -> tuple[FloatArray, float]:
    """Return the forces (n, d), mN, that nothing balances at nodes that are not loaded, and their sum as a fraction of the loads'.

    Not finite where a cell is inverted.
    """
    residual = force - load_case.external_force
    scale = float(np.abs(residual[load_case.loaded]).sum() + np.abs(load_case.external_force).sum())
    residual[load_case.loaded] = 0.0
    return residual, float(np.abs(residual).sum()) / max(scale, 1e-300) if np.isfinite(scale) else np.nan


def _stepped(law: FieldLaw, lame: FloatArray, shear: FloatArray, u: FloatArray, step: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return ``u - step`` and the forces there, the step halved until no cell is inverted."""
    for _ in range(HALVINGS):
        force = law.forces(lame, shear, u - step)
        if np.isfinite(force).all():
            break
        step = 0.5 * step
    return u - step, force


def settled(
    law: FieldLaw, solvers: Solvers, points: FloatArray, lame: FloatArray, shear: FloatArray, load_case: FieldLoadCase, guess: FloatArray
) -> FloatArray:
    """Return the displacement (n, d), mm, in equilibrium, with the loaded components as in `guess`, sought from there, then from rest.

    A displacement that larger cells lend to small ones is rough at borders of stiff zones and at a surface near incompressibility. Newton's
    method overcomes that slowly or not at all. The path of the load from rest is then followed in bodies of up to `LONG_WAY` unknowns, by
    `MOST_FROM_REST` iterations; larger ones, and continuation where Newton's method fails again, took longer than all of an identification.

    Raises
    ------
    ConvergenceError
        Newton's method fails from this guess, and the body is too large for the path from rest, or that ends early.
    """
    try:
        return equilibrium(law, solvers, lame, shear, load_case, guess, b"", PATIENT_ITERATIONS)[0]
    except ConvergenceError:
        if points.size > LONG_WAY:
            raise
        start = loaded_from_rest(law, points, lame, shear, load_case, guess, at_length=False)
        return equilibrium(law, solvers, lame, shear, load_case, np.where(load_case.loaded, guess, start), b"")[0]


def loaded_from_rest(
    law: FieldLaw,
    points: FloatArray,
    lame: FloatArray,
    shear: FloatArray,
    load_case: FieldLoadCase,
    moved: FloatArray,
    *,
    at_length: bool = True,
) -> FloatArray:
    """Return the displacement (n, d), mm, in equilibrium under a finite-strain law, the loaded components moved in steps to `moved` (n, d).

    Where it is not sought `at_length`, the path ends after `MOST_FROM_REST` iterations or where Newton's method fails on short steps.

    Raises
    ------
    ConvergenceError
        The path of the load ends before that.
    """
    if not isinstance(law, NeoHookean):
        return moved
    values = np.where(load_case.loaded, moved, 0.0)
    problem = Problem(points, law.assembler(lame, shear), (), PrescribedDisplacement(load_case.loaded, values), load_case.external_force)
    settings = SolverSettings(first_step=0.2, largest_step=0.5, tolerance=1e-8)
    if not at_length:
        settings = replace(settings, max_total_iterations=MOST_FROM_REST, pseudo_transient=False)
    return solve(problem, settings=settings).displacement
