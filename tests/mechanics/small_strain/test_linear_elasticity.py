"""Connection matrices and small-strain solutions against textbook stiffness, scikit-fem's published assembly, and closed forms."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.mechanics.finite_elements.hyperelasticity import lame_parameters
from naibu.mechanics.finite_elements.linear_simplices import (
    connection_matrices,
    consistent_mass_matrices,
    lumped_mass,
    parameter_forces,
    simplices,
)
from naibu.mechanics.linear_algebra import direct, recycled_factors, solver_selection
from naibu.mechanics.linear_algebra.direct import pardiso_library
from naibu.mechanics.linear_algebra.multigrid.multigrid_solver import MultigridSolver
from naibu.mechanics.linear_algebra.solver_selection import SolverName
from naibu.mechanics.small_strain.linear_elasticity import LinearBody
from naibu.meshing.primitives import box
from naibu.meshing.structured_2d import rectangle

needs_pardiso = pytest.mark.skipif(pardiso_library() is None, reason="oneMKL is not installed")


def random_simplex(dimension: int, seed: int) -> Mesh:
    rng = np.random.default_rng(seed)
    points = np.vstack([np.zeros(dimension), np.eye(dimension)]) + 0.15 * rng.standard_normal((dimension + 1, dimension))
    return Mesh.from_arrays(points, [range(dimension + 1)], {1: "line", 2: "triangle", 3: "tetra"}[dimension])


def textbook_stiffness(points: np.ndarray, lame: float, shear: float) -> np.ndarray:
    """``V B^T D B`` with engineering shear strains, as in any textbook; gradients from the inverse of [1 x]."""
    d = points.shape[1]
    coefficients = np.linalg.inv(np.hstack([np.ones((d + 1, 1)), points]))[1:].T
    volume = abs(np.linalg.det(np.hstack([np.ones((d + 1, 1)), points]))) / [1, 1, 2, 6][d]
    pairs = [(0, 1), (1, 2), (0, 2)][: d * (d - 1) // 2]
    strain = np.zeros((d + len(pairs), (d + 1) * d))
    for node, g in enumerate(coefficients):
        for a in range(d):
            strain[a, node * d + a] = g[a]
        for row, (a, b) in enumerate(pairs):
            strain[d + row, node * d + a], strain[d + row, node * d + b] = g[b], g[a]
    elastic = np.diag([2 * shear] * d + [shear] * len(pairs))
    elastic[:d, :d] += lame
    return volume * strain.T @ elastic @ strain


@pytest.mark.parametrize("dimension", [1, 2, 3])
@pytest.mark.parametrize("seed", range(5))
def test_connection_matrices_equal_textbook_stiffness(dimension: int, seed: int) -> None:
    mesh = random_simplex(dimension, seed)
    lame, shear = connection_matrices(simplices(mesh))
    expected = textbook_stiffness(mesh.points, 3.0, 2.0)
    assert 3.0 * lame[0] + 2.0 * shear[0] == pytest.approx(expected, rel=1e-12, abs=1e-13 * np.abs(expected).max())


def test_triangle_matches_the_block_form() -> None:
    """Equation (3.3) of Hirai et al. (2008): J_lambda = h / 4S [A], with A of edge vectors in x and y."""
    mesh = random_simplex(2, 1)
    (xi, yi), (xj, yj), (xk, yk) = mesh.points
    area = 0.5 * ((xj - xi) * (yk - yi) - (xk - xi) * (yj - yi))
    edges = [(yj - yk, -(xj - xk)), (yk - yi, -(xk - xi)), (yi - yj, -(xi - xj))]  # (eta_a - eta_b, -(xi_a - xi_b))
    expected = 2.0 / (4 * area) * np.outer(np.ravel(edges), np.ravel(edges))
    assert connection_matrices(simplices(mesh, thickness_mm=2.0))[0][0] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("dimension", [1, 2, 3])
@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_rigid_motion_makes_no_force_and_forces_balance(dimension: int, seed: int) -> None:
    mesh = random_simplex(dimension, seed % 50)
    rng = np.random.default_rng(seed)
    body = simplices(mesh)
    spin = rng.standard_normal((dimension, dimension))
    rigid = mesh.points @ (spin - spin.T) + rng.standard_normal(dimension)
    for force in parameter_forces(body, rigid):
        assert np.abs(force).max() < 1e-11
    for force in parameter_forces(body, rng.standard_normal(mesh.points.shape)):
        assert np.abs(force.sum(axis=1)).max() < 1e-11


def test_masses() -> None:
    body = simplices(box((10.0, 20.0, 30.0), (2, 2, 3), cell_type="tetra"))
    assert lumped_mass(body, 1e-6).sum() == pytest.approx(6e-3, rel=1e-12)
    consistent = consistent_mass_matrices(body, 1e-6)
    assert consistent.sum() == pytest.approx(6e-3, rel=1e-12)
    assert body.scattered(consistent.sum(axis=2)[..., None])[:, 0] == pytest.approx(lumped_mass(body, 1e-6), rel=1e-12)


def test_patch_test_and_uniaxial_stress() -> None:
    """Free sides under a stretch: u_z = e z, u_x = -nu e x, force = E e A."""
    mesh = box((10.0, 10.0, 20.0), (4, 4, 4), cell_type="tetra")
    points = mesh.points - mesh.points[np.argmin(np.linalg.norm(mesh.points - [*mesh.points[:, :2].mean(axis=0), 0.0], axis=1))]
    body, (lame, shear) = LinearBody.of(mesh), lame_parameters(30.0, 0.4)
    low, high = np.flatnonzero(points[:, 2] < 1e-9), np.flatnonzero(points[:, 2] > 20 - 1e-9)
    along = np.flatnonzero((np.abs(points[:, 1:]) < 1e-9).all(axis=1))
    vertical, sideways = (False, False, True), (False, True, False)
    support = PrescribedDisplacement.none(mesh.n_points).and_also(low, (0, 0, 0), vertical).and_also(high, (0, 0, -0.2), vertical)
    support = support.and_also(along, (0, 0, 0), sideways).and_also(along[points[along, 0] == 0.0], (0, 0, 0))
    u = body.solve(lame, shear, support)
    assert u == pytest.approx(points * [0.4 * 0.01, 0.4 * 0.01, -0.01], abs=1e-10)
    assert body.forces(lame, shear, u)[high, 2].sum() == pytest.approx(-30.0 * 0.01 * 100.0, rel=1e-10)


SOLVERS = [name for name in get_args(SolverName) if name != "petsc"]  # that starts MPI: tests/mechanics/linear_algebra/test_petsc.py


@pytest.mark.parametrize("with_mkl", [pytest.param(True, marks=needs_pardiso), False])
@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("dimension", [2, 3])
def test_every_linear_solver_finds_the_homogeneous_deformation(monkeypatch, solver: SolverName, with_mkl: bool, dimension: int) -> None:
    """All of the boundary follows a linear map, which is then the solution inside; the solvers differ in rounding only."""
    if not with_mkl:
        for module in (direct, recycled_factors, solver_selection):
            monkeypatch.setattr(module, "pardiso_library", lambda: None)
    mesh = box((8.0, 8.0, 8.0), (9, 8, 8), cell_type="tetra") if dimension == 3 else rectangle((8.0, 6.0), (25, 24))
    low, high = mesh.points.min(axis=0), mesh.points.max(axis=0)
    boundary = np.flatnonzero(((mesh.points < low + 1e-9) | (mesh.points > high - 1e-9)).any(axis=1))
    expected = mesh.points @ (0.01 * np.arange(1.0, dimension**2 + 1.0).reshape(dimension, dimension)).T
    support = PrescribedDisplacement.none(mesh.n_points, dimension).and_also(boundary, expected[boundary])
    if not with_mkl and solver in ("pardiso", "recycled_cholesky"):
        with pytest.raises(InputError, match=r"naibu\[fast\]"):
            LinearBody.of(mesh).solve(30.0, 10.0, support, solver=solver)
        return
    found = LinearBody.of(mesh).solve(30.0, 10.0, support, solver=solver)
    assert found == pytest.approx(expected, abs=1e-7 * np.abs(expected).max())


@pytest.mark.parametrize("with_mkl", [pytest.param(True, marks=needs_pardiso), False])
def test_large_bodies_are_solved_by_multigrid(monkeypatch, with_mkl: bool) -> None:
    if not with_mkl:
        for module in (direct, recycled_factors, solver_selection):
            monkeypatch.setattr(module, "pardiso_library", lambda: None)
    mesh = box((8.0, 8.0, 8.0), (8, 8, 8), cell_type="tetra")
    support = PrescribedDisplacement.none(mesh.n_points).and_also(np.flatnonzero(mesh.points[:, 2] < 1e-9), (0.0, 0.0, 0.0))
    weight = np.full(mesh.points.shape, -0.01)
    exact = LinearBody.of(mesh).solve(30.0, 10.0, support, weight)
    made = []
    monkeypatch.setattr(solver_selection, "DIRECT_LIMIT", 1000)
    monkeypatch.setattr(
        solver_selection, "MultigridSolver", lambda *given, **options: made.append(MultigridSolver(*given, **options)) or made[-1]
    )
    found = LinearBody.of(mesh).solve(30.0, 10.0, support, weight)
    assert len(made) == 1
    assert found == pytest.approx(exact, abs=1e-6 * np.abs(exact).max())


def test_bad_input_is_named() -> None:
    mesh = random_simplex(2, 0)
    with pytest.raises(InputError, match="other way round"):
        simplices(Mesh.from_arrays(mesh.points, mesh.cells[:, ::-1], "triangle"))
    with pytest.raises(InputError, match="one for each of the 1 cells"):
        LinearBody.of(mesh).stiffness(np.ones(3), 1.0)
    body = LinearBody.of(box((10.0, 10.0, 10.0), (2, 2, 2), cell_type="tetra"))
    with pytest.raises(InputError, match="6 of 6 rigid-body motions"):
        body.solve(1.0, 1.0, PrescribedDisplacement.none(27))
    with pytest.raises(InputError, match="3 of 6"):
        body.solve(1.0, 1.0, PrescribedDisplacement.none(27).and_also(range(9), (0, 0, 0), (False, False, True)))
