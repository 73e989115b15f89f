"""Linear solvers: they agree with each other and with dense algebra, refuse singular systems, and can be reused."""

import os
import subprocess
import sys

import numpy as np
import pytest
import scipy.sparse as sp
from builders import assembler, distorted, of, relative
from hypothesis import given, settings
from hypothesis import strategies as st

from naibu.core.errors import ConvergenceError, InputError
from naibu.mechanics.linear_algebra import direct, recycled_factors, solver_selection
from naibu.mechanics.linear_algebra.block_matrix import with_dirichlet_rows
from naibu.mechanics.linear_algebra.direct import PardisoSolver, SuperLUSolver, direct_solver, pardiso_library
from naibu.mechanics.linear_algebra.iterative import RecycledCholesky
from naibu.mechanics.linear_algebra.multigrid.multigrid_solver import MultigridSolver, rigid_body_modes
from naibu.mechanics.linear_algebra.recycled_factors import RecycledFactors, gmres
from naibu.mechanics.linear_algebra.solver_selection import choose_solver
from naibu.meshing.surface import side_nodes

needs_pardiso = pytest.mark.skipif(pardiso_library() is None, reason="oneMKL is not installed")


def body(divisions: int):
    """A block, and which of its degrees of freedom are constrained."""
    mesh = distorted("hexahedron", divisions=divisions, amount=0.1)
    constrained = np.zeros((mesh.n_points, 3), dtype=bool)
    constrained[side_nodes(distorted("hexahedron", divisions=divisions, amount=0.0), "z-")] = True
    return mesh, constrained


MESH, CONSTRAINED = body(5)


def stiffness(young=20.0, nu=0.45, squeeze=0.05, constrained=CONSTRAINED, mesh=MESH) -> sp.bsr_matrix:
    """Tangent of a block that is compressed by `squeeze` at constant volume: positive definite where it is constrained."""
    made = assembler(mesh, of("neo_hookean", nu, young))
    widening = (1 - squeeze) ** -0.5 - 1
    return with_dirichlet_rows(made.pattern.matrix(made.evaluate(mesh.points * [widening, widening, -squeeze])[2]), constrained)


def unsymmetric() -> sp.bsr_matrix:
    """The tangent with an unsymmetric part as friction gives it."""
    matrix = stiffness()
    matrix.data = matrix.data * np.random.default_rng(0).uniform(0.97, 1.03, matrix.data.shape)
    return matrix


def solvers(matrix, *, symmetric):
    made = [SuperLUSolver()]
    if pardiso_library() is not None:
        made += [PardisoSolver(matrix, symmetric=s) for s in ({symmetric, False})]
    return made


@pytest.mark.parametrize("symmetric", [True, False])
@pytest.mark.parametrize("columns", [None, 1, 4])
def test_all_solvers_agree_with_dense_algebra(symmetric, columns):
    matrix = stiffness() if symmetric else unsymmetric()
    shape = matrix.shape[0] if columns is None else (matrix.shape[0], columns)
    b = np.random.default_rng(1).normal(size=shape)
    b[CONSTRAINED.ravel()] = 0
    exact = np.linalg.solve(matrix.toarray(), b)
    for solver in solvers(matrix, symmetric=symmetric):
        x = solver.factorize(matrix).solve(b)
        assert x.shape == b.shape, solver.name
        assert relative(x, exact) < 1e-8, solver.name


@pytest.mark.parametrize("symmetric", [True, False])
def test_a_solver_serves_other_values_of_the_same_pattern(symmetric):
    b = np.random.default_rng(2).normal(size=3 * MESH.n_points) * ~CONSTRAINED.ravel()
    matrices = [stiffness(), stiffness(young=200.0, nu=0.3), stiffness(squeeze=0.2)]
    for solver in solvers(matrices[0], symmetric=symmetric):
        for matrix in matrices:
            exact = SuperLUSolver().factorize(matrix.copy()).solve(b)
            assert relative(solver.factorize(matrix).solve(b), exact) < 1e-8, solver.name


@needs_pardiso
def test_pardiso_survives_an_indefinite_matrix_and_comes_back():
    matrix = stiffness()
    shifted = matrix.copy()
    blocks = np.flatnonzero(np.repeat(np.arange(MESH.n_points), np.diff(matrix.indptr)) == matrix.indices)
    shifted.data[blocks] -= 0.2 * np.abs(matrix.data).max() * np.eye(3)
    assert np.linalg.eigvalsh(shifted.toarray())[0] < 0 < np.linalg.eigvalsh(matrix.toarray())[0]
    solver, b = PardisoSolver(matrix, symmetric=True), np.random.default_rng(3).normal(size=matrix.shape[0])
    for m in (matrix, shifted, matrix):
        assert relative(solver.factorize(m).solve(b), np.linalg.solve(m.toarray(), b)) < 1e-8


@pytest.mark.parametrize("symmetric", [True, False])
def test_singular_systems_are_refused(symmetric):
    free = stiffness(constrained=np.zeros_like(CONSTRAINED), squeeze=0.0)  # six rigid motions
    loose = stiffness()  # one node on which nothing acts
    node = MESH.n_points // 2
    rows = np.repeat(np.arange(MESH.n_points), np.diff(loose.indptr))
    loose.data[(rows == node) | (loose.indices == node)] = 0
    for solver in solvers(free, symmetric=symmetric):
        for matrix in (free, loose):
            if isinstance(solver, SuperLUSolver) and matrix is free:
                continue  # its last pivot is rounding, not zero
            with pytest.raises(ConvergenceError, match=r"singular.*constrained"):
                solver.factorize(matrix)
        constrained = stiffness()
        np.testing.assert_allclose(constrained @ solver.factorize(constrained).solve(np.ones(constrained.shape[0])), 1, atol=1e-9)


def test_multigrid_agrees_with_direct_solvers_also_with_an_aged_hierarchy():
    mesh, constrained = body(9)
    assert mesh.n_points > 600  # more than the size of the coarsest level
    solver = MultigridSolver(mesh.points, constrained, relative_tolerance=1e-11)
    rng = np.random.default_rng(5)
    for young, nu, squeeze in ((20.0, 0.45, 0.05), (20.0, 0.45, 0.06), (20.0, 0.49, 0.3)):
        matrix = stiffness(young, nu, squeeze, constrained=constrained, mesh=mesh)
        b = rng.normal(size=(matrix.shape[0], 2)) * ~constrained.reshape(-1, 1)
        x = solver.factorize(matrix).solve(b)
        assert relative(x, SuperLUSolver().factorize(matrix).solve(b)) < 1e-8


def test_multigrid_says_when_it_does_not_converge():
    mesh, constrained = body(9)
    matrix = stiffness(constrained=constrained, mesh=mesh)
    with pytest.raises(ConvergenceError, match="in 2 CG iterations"):
        MultigridSolver(mesh.points, constrained, max_iterations=2).factorize(matrix).solve(np.ones(matrix.shape[0]))


def test_without_pardiso_superlu_is_used(monkeypatch):
    matrix = stiffness()
    for module in (direct, solver_selection):
        monkeypatch.setattr(module, "pardiso_library", lambda: None)
    solver = direct_solver(matrix, symmetric=True)
    assert solver.name == SuperLUSolver.name
    b = np.ones(matrix.shape[0])
    np.testing.assert_allclose(matrix @ solver.factorize(matrix).solve(b), b, atol=1e-9)
    with pytest.raises(InputError, match="naibu\\[fast\\]"):
        PardisoSolver(matrix, symmetric=True)
    monkeypatch.setattr(solver_selection, "DIRECT_LIMIT", 60)
    assert choose_solver(matrix, MESH.points, CONSTRAINED, symmetric=False).name == SuperLUSolver.name


@pytest.mark.parametrize("symmetric", [True, False])
def test_size_and_symmetry_choose_the_solver(monkeypatch, symmetric):
    matrix = stiffness()
    small = choose_solver(matrix, MESH.points, CONSTRAINED, symmetric=symmetric)
    assert not isinstance(small, MultigridSolver)
    monkeypatch.setattr(solver_selection, "DIRECT_LIMIT", 60)
    large = choose_solver(matrix, MESH.points, CONSTRAINED, symmetric=symmetric)
    assert isinstance(large, MultigridSolver) == symmetric


@given(seed=st.integers(0, 2**32 - 1), dimension=st.integers(1, 3))
@settings(max_examples=10, deadline=None)
def test_rigid_body_modes_span_rigid_motions(seed, dimension):
    rng = np.random.default_rng(seed)
    points, spin = rng.normal(scale=20, size=(9, dimension)), rng.normal(size=(dimension, dimension))
    motion = points @ (spin - spin.T) + rng.normal(size=dimension)
    modes = rigid_body_modes(points)
    assert modes.shape[1] == np.linalg.matrix_rank(modes) == dimension * (dimension + 1) // 2
    found = np.linalg.lstsq(modes, motion.ravel(), rcond=None)[0]
    np.testing.assert_allclose(modes @ found, motion.ravel(), atol=1e-10)


@needs_pardiso
def test_a_solver_left_at_exit_makes_no_noise():
    code = (
        "import numpy as np, scipy.sparse as sp; from naibu.mechanics.linear_algebra.direct import PardisoSolver\n"
        "m = sp.bsr_matrix(np.eye(3), blocksize=(3, 3)); s = PardisoSolver(m, symmetric=True).factorize(m)\n"
        "import naibu.mechanics.linear_algebra.solver_selection as keep; keep.kept = s; s.me = s"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stderr == ""


FEWER_THREADS = """
import threading
import numpy as np
import scipy.sparse as sp
from naibu.mechanics.linear_algebra.direct import PardisoSolver, use_threads

line = sp.diags([-1.0, 2.0, -1.0], [-1, 0, 1], shape=(11, 11))
grid = sp.kronsum(sp.kronsum(line, line), line)
matrix = sp.bsr_matrix(sp.kron(grid, np.eye(3) + 0.1) + 0.01 * sp.eye(3 * 11**3), blocksize=(3, 3))


def fewer():
    use_threads(1)
    for _ in range(3):
        solver.factorize(matrix)
        assert np.abs(matrix @ solver.solve(np.ones(matrix.shape[0])) - 1).max() < 1e-2


for _ in range(10):
    solver = PardisoSolver(matrix, symmetric=True, single_precision=True)
    use_threads(2)
    solver.factorize(matrix)
    thread = threading.Thread(target=fewer)
    thread.start()
    thread.join()
print("done")
"""


@needs_pardiso
def test_pardiso_may_factorize_with_fewer_threads_than_before():
    """It analysed the pattern for two threads; factorized by one, solutions were wrong or the process ended."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("OMP_", "MKL_"))}
    result = subprocess.run([sys.executable, "-c", FEWER_THREADS], capture_output=True, text=True, timeout=120, env=environment)
    assert (result.returncode, result.stdout, result.stderr) == (0, "done\n", "")


@needs_pardiso
@pytest.mark.parametrize("symmetric", [True, False])
def test_solutions_on_two_threads_do_not_depend_on_which_ends_first(symmetric):
    block, constrained = body(11)
    matrix = stiffness(mesh=block, constrained=constrained)
    right = np.random.default_rng(3).standard_normal((matrix.shape[0], 40))
    direct.use_threads(2)
    try:
        solver = PardisoSolver(matrix, symmetric=symmetric)
        for columns in (0, slice(0, 2), slice(0, 40)):
            found = {solver.factorize(matrix).solve(right[:, columns]).tobytes()}
            found |= {solver.solve(right[:, columns]).tobytes() for _ in range(60 if columns == 0 else 3)}
            assert len(found) == 1
    finally:
        direct.use_threads(0)


@needs_pardiso
def test_recycled_cholesky_serves_other_tangents_and_many_columns():
    made = []

    class Counting(RecycledCholesky):
        def preconditioner(self, matrix):
            made.append(matrix)
            return super().preconditioner(matrix)

    matrices = [stiffness(squeeze=s) for s in (0.05, 0.06, 0.07, 0.08)]
    solver, rng = Counting(matrices[0]), np.random.default_rng(6)
    for matrix in matrices:
        b = rng.normal(size=(matrix.shape[0], 3)) * ~CONSTRAINED.reshape(-1, 1)
        b[:, 1] = 0.0
        factorization = solver.factorize(matrix)
        x = factorization.solve(b)
        assert not x[:, 1].any()
        np.testing.assert_allclose(matrix @ x, b, atol=1e-10 * np.abs(b).max())
        coarse = factorization.solve(b[:, 0], 0.01)
        assert np.linalg.norm(matrix @ coarse - b[:, 0]) <= 0.01 * np.linalg.norm(b[:, 0])
    assert len(made) < len(matrices)


@needs_pardiso
def test_recycled_cholesky_becomes_direct_where_the_tangent_is_indefinite_and_refuses_singular_ones():
    matrix = stiffness()
    shifted = matrix.copy()
    blocks = np.flatnonzero(np.repeat(np.arange(MESH.n_points), np.diff(matrix.indptr)) == matrix.indices)
    shifted.data[blocks] -= 0.2 * np.abs(matrix.data).max() * np.eye(3)
    b = np.random.default_rng(7).normal(size=matrix.shape[0])
    for first in (matrix, shifted):
        solver = RecycledCholesky(matrix)
        solver.factorize(first)
        for m in (shifted, matrix):
            assert relative(solver.factorize(m).solve(b), np.linalg.solve(m.toarray(), b)) < 1e-8
    with pytest.raises(ConvergenceError, match=r"singular.*constrained"):
        RecycledCholesky(matrix).factorize(stiffness(constrained=np.zeros_like(CONSTRAINED), squeeze=0.0)).solve(b)


@pytest.mark.parametrize("with_mkl", [pytest.param(True, marks=needs_pardiso), False])
def test_recycled_factors_serve_other_unsymmetric_matrices(monkeypatch, with_mkl):
    if not with_mkl:
        for module in (direct, recycled_factors):
            monkeypatch.setattr(module, "pardiso_library", lambda: None)
    first, rng = unsymmetric(), np.random.default_rng(8)
    solver, made = RecycledFactors(first), []
    renew = solver._renew
    solver._renew = lambda matrix: made.append(matrix) or renew(matrix)
    for scatter in (0.0, 0.001, 0.002, 0.003):
        matrix = first.copy()
        matrix.data = first.data * rng.uniform(1.0 - scatter, 1.0 + scatter, first.data.shape)
        b = rng.normal(size=(matrix.shape[0], 3)) * ~CONSTRAINED.reshape(-1, 1)
        dense, factorization = matrix.toarray(), solver.factorize(matrix)
        assert relative(factorization.solve(b), np.linalg.solve(dense, b)) < 1e-8
        assert relative(factorization.solve(b[:, 0]), np.linalg.solve(dense, b[:, 0])) < 1e-8
        for tolerance in (1e-2, 1e-6):
            x = factorization.solve(b[:, 1], tolerance)
            assert np.linalg.norm(dense @ x - b[:, 1]) <= 1.01 * tolerance * np.linalg.norm(b[:, 1])
        assert not factorization.solve(0.0 * b[:, 0], 1e-2).any()
    assert 0 < len(made) < 4
    if with_mkl:  # SuperLU takes pivots of rounding for pivots
        with pytest.raises(ConvergenceError, match=r"singular.*constrained"):
            solver.factorize(stiffness(constrained=np.zeros_like(CONSTRAINED), squeeze=0.0)).solve(b[:, 0], 1e-2)


def test_minimal_residuals_find_the_solution_in_as_many_iterations_as_there_are_eigenvalues():
    values = np.repeat([1.0, 3.0, -2.0, 40.0], 6)
    matrix = sp.bsr_matrix(np.diag(values))
    b = np.random.default_rng(9).normal(size=24)
    x, iterations = gmres(matrix, b, lambda r: r, 1e-12, 30)
    assert iterations == 4
    np.testing.assert_allclose(x, b / values, rtol=1e-10)
    assert gmres(matrix, b, lambda r: r, 1e-12, 3)[0] is None


@pytest.mark.parametrize("name", ["recycled_cholesky", "multigrid", "petsc"])
def test_iterative_solvers_refuse_unsymmetric_matrices(name):
    with pytest.raises(InputError, match="needs a symmetric matrix; with friction use 'recycled_lu'"):
        choose_solver(unsymmetric(), MESH.points, CONSTRAINED, symmetric=False, solver=name)


def test_unknown_solvers_and_constraints_of_another_shape_are_refused():
    with pytest.raises(InputError, match="solver='lu' is not known; use one of automatic, superlu"):
        choose_solver(stiffness(), MESH.points, CONSTRAINED, symmetric=True, solver="lu")
    with pytest.raises(InputError, match="constrained must have shape"):
        MultigridSolver(MESH.points, CONSTRAINED.ravel())


@needs_pardiso
def test_middle_sizes_recycle_their_factorization(monkeypatch):
    monkeypatch.setattr(solver_selection, "RECYCLING_FROM", 60)
    monkeypatch.setattr(solver_selection, "UNSYMMETRIC_FROM", 60)
    matrix = stiffness()
    assert isinstance(choose_solver(matrix, MESH.points, CONSTRAINED, symmetric=True), RecycledCholesky)
    assert isinstance(choose_solver(matrix, MESH.points, CONSTRAINED, symmetric=False), RecycledFactors)
