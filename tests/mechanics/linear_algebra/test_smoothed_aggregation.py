"""Own smoothed aggregation beside pyamg's, dense linear algebra, and bodies whose solution is known."""

from __future__ import annotations

import numba
import numpy as np
import pyamg
import pytest
import scipy.linalg
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from naibu.core.errors import ConvergenceError
from naibu.core.mesh import Mesh
from naibu.mechanics.linear_algebra import row_chunks
from naibu.mechanics.linear_algebra.block_matrix import with_dirichlet_rows
from naibu.mechanics.linear_algebra.iterative import conjugate_gradients
from naibu.mechanics.linear_algebra.multigrid import _aggregation_kernels as aggregation
from naibu.mechanics.linear_algebra.multigrid import smoothed_aggregation as module
from naibu.mechanics.linear_algebra.multigrid.multigrid_solver import MultigridSolver, rigid_body_modes
from naibu.mechanics.linear_algebra.multigrid.smoothed_aggregation import SmoothedAggregation
from naibu.mechanics.small_strain.linear_elasticity import LinearBody
from naibu.meshing.primitives import box


@pytest.fixture
def chunked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small matrices in chunks, and levels down to a few unknowns."""
    monkeypatch.setattr(row_chunks, "LEAST_ROWS", 1)
    monkeypatch.setattr(module, "COARSEST", 60)


def fixed_body(cells: int, contrast: float = 1.0, seed: int | None = None) -> tuple[Mesh, sp.bsr_matrix, np.ndarray]:
    """A cube of tetrahedra on a fixed base, with random moduli up to `contrast` and, with a seed, its nodes in random order."""
    mesh = box((float(cells),) * 3, (cells,) * 3, cell_type="tetra")
    if seed is not None:
        order = np.random.default_rng(seed).permutation(mesh.n_points)
        mesh = Mesh.from_arrays(mesh.points[order], np.argsort(order)[mesh.cells], "tetra")
    factor = contrast ** np.random.default_rng(seed or 0).random(mesh.n_cells)
    constrained = np.zeros(mesh.points.shape, dtype=bool)
    constrained[mesh.points[:, 2] < mesh.points[:, 2].min() + 1e-9] = True
    return mesh, with_dirichlet_rows(LinearBody.of(mesh).stiffness(30.0 * factor, 10.0 * factor), constrained), constrained


def modes_of(mesh: Mesh, constrained: np.ndarray) -> np.ndarray:
    return np.where(constrained.ravel()[:, None], 0.0, rigid_body_modes(mesh.points))


@pytest.mark.parametrize("seed", [None, 3])
def test_a_cycle_is_symmetric_and_positive_definite_whatever_the_chunks(chunked: None, seed: int | None) -> None:
    """As conjugate gradients need it; nodes in random order make chunks that are all neighbours of one another."""
    mesh, matrix, constrained = fixed_body(5, seed=seed)
    hierarchy = SmoothedAggregation(matrix, modes_of(mesh, constrained)).hierarchy(matrix)
    assert hierarchy.finest.next is not None
    cycle = hierarchy.correction(np.eye(matrix.shape[0]))
    assert np.abs(cycle - cycle.T).max() < 1e-5 * np.abs(cycle).max()
    eigenvalues = scipy.linalg.eigvals(0.5 * (cycle + cycle.T) @ matrix.toarray()).real
    assert eigenvalues.min() > 0.05
    assert eigenvalues.max() < 1.6  # one with exact smoothing; above it by the smoother's overshoot at most


def test_iterations_are_no_more_than_those_of_pyamg_and_do_not_grow_with_the_mesh() -> None:
    """pyamg's with the same smoother, rigid-body modes and aggregation by all neighbours."""
    np.random.seed(0)  # noqa: NPY002 - pyamg begins its estimates of eigenvalues at random
    taken = []
    for cells in (8, 16):
        mesh, matrix, constrained = fixed_body(cells, contrast=10.0)
        modes, b = modes_of(mesh, constrained), np.where(constrained, 0.0, 1.0).reshape(-1, 1)
        own = SmoothedAggregation(matrix, modes).hierarchy(matrix).correction
        other = pyamg.smoothed_aggregation_solver(
            matrix, B=modes, strength=("symmetric", {"theta": 0.0}), smooth=("jacobi", {"omega": 4.0 / 3.0}), improve_candidates=None,
            max_coarse=600,
            presmoother=("block_gauss_seidel", {"sweep": "forward"}), postsmoother=("block_gauss_seidel", {"sweep": "backward"}),
        ).aspreconditioner()  # fmt: skip
        counts = [
            conjugate_gradients(lambda x, m=matrix: m @ x, b, c, 1e-8, 200)[1]  # type: ignore[misc]
            for c in (own, lambda r, o=other: o(r[:, 0])[:, None])
        ]
        assert counts[0] <= 1.5 * counts[1]  # some 25 and 20: rows in chunks, and a smoother that allows for them
        taken.append(counts[0])
    assert taken[1] <= taken[0] + 8


@pytest.mark.parametrize("cells", [3, 12])
@pytest.mark.parametrize("constrain", ["base", "planes of symmetry", "everything"])
def test_systems_are_solved_to_their_tolerance(cells: int, constrain: str) -> None:
    """Whether the first level is coarse enough to be factorized, nodes are constrained in part, or nothing is left to be solved."""
    mesh, _, constrained = fixed_body(cells)
    if constrain != "base":
        constrained = np.isclose(mesh.points, mesh.points.min(axis=0)) if constrain != "everything" else np.ones_like(constrained)
    matrix = with_dirichlet_rows(LinearBody.of(mesh).stiffness(30.0, 10.0), constrained)
    b = np.random.default_rng(1).standard_normal((matrix.shape[0], 3)) * [1.0, 1e-30, 1e30]
    x = MultigridSolver(mesh.points, constrained, relative_tolerance=1e-10).factorize(matrix).solve(b)
    assert (np.linalg.norm(matrix @ x - b, axis=0) <= 2e-10 * np.linalg.norm(b, axis=0)).all()


def test_a_plane_body_and_nodes_without_cells_are_solved_too() -> None:
    side = np.arange(60)
    x, y = np.meshgrid(side, side, indexing="ij")
    at = np.arange(3600).reshape(60, 60)
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
    points = np.append(np.stack([x.ravel(), y.ravel()], axis=1), [[-5.0, -5.0]], axis=0)
    mesh = Mesh.from_arrays(points, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]), "triangle")
    constrained = np.zeros(points.shape, dtype=bool)
    constrained[points[:, 0] <= 0.0] = True
    matrix = with_dirichlet_rows(LinearBody.of(mesh).stiffness(30.0, 10.0), constrained)
    right = np.where(constrained, 0.0, 1.0).ravel()
    found = MultigridSolver(points, constrained, relative_tolerance=1e-10).factorize(matrix).solve(right)
    np.testing.assert_allclose(found, sp.linalg.spsolve(matrix.tocsc(), right), rtol=0.0, atol=1e-6 * np.abs(found).max())


def test_results_do_not_depend_on_the_number_of_threads(chunked: None) -> None:
    mesh, matrix, constrained = fixed_body(9)
    b, found, most = np.where(constrained, 0.0, 1.0).ravel(), [], numba.get_num_threads()
    for threads in {1, most}:
        numba.set_num_threads(threads)
        try:
            found.append(MultigridSolver(mesh.points, constrained).factorize(matrix).solve(b))
        finally:
            numba.set_num_threads(most)
    assert np.array_equal(found[0], found[-1])


def test_the_hierarchy_of_another_matrix_keeps_the_pattern() -> None:
    """Twice the stiffness, half the correction; and a matrix of another pattern is analysed anew."""
    mesh, matrix, constrained = fixed_body(12)
    solver, b = MultigridSolver(mesh.points, constrained), np.where(constrained, 0.0, 1.0).reshape(-1, 1)
    first = solver.preconditioner(matrix)(b)
    analysed = solver._aggregation
    np.testing.assert_allclose(solver.preconditioner(2.0 * matrix)(b), 0.5 * first, rtol=1e-4, atol=1e-6 * np.abs(first).max())
    assert solver._aggregation is analysed
    solver.preconditioner(sp.block_diag([matrix.tocsr()[:-3, :-3], sp.eye(3)]).tobsr((3, 3)))
    assert solver._aggregation is not analysed


@given(seed=st.integers(0, 2**32 - 1), density=st.floats(0.01, 0.3))
@settings(max_examples=20, deadline=None)
def test_every_node_that_is_not_apart_belongs_to_one_aggregate(seed: int, density: float) -> None:
    generator = np.random.default_rng(seed)
    graph = sp.random(40, 40, density, random_state=generator, format="csr")
    graph = (graph + graph.T + sp.identity(40)).tocsr()
    apart = generator.random(40) < 0.2
    label, count = aggregation.aggregates(graph.indptr, graph.indices, apart)
    assert (label[apart] == -1).all()
    assert set(label[~apart]) == set(range(count))
    nodes, start = aggregation.members(label, count)
    assert sorted(nodes) == sorted(np.flatnonzero(~apart))
    assert all((label[nodes[start[c] : start[c + 1]]] == c).all() for c in range(count))


def test_a_matrix_that_is_not_positive_definite_is_refused() -> None:
    mesh, matrix, constrained = fixed_body(3)
    solver = MultigridSolver(mesh.points, constrained)
    with pytest.raises(ConvergenceError, match="rigid-body motions"):
        solver.factorize(-matrix).solve(np.ones(matrix.shape[0]))
    fallen = MultigridSolver(mesh.points, constrained, falls_back=True).factorize(-matrix).solve(np.ones(matrix.shape[0]))
    np.testing.assert_allclose(-matrix @ fallen, 1.0, atol=1e-8)
