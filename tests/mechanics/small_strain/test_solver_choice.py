"""A linear-elastic body through every solver that may be chosen for it: a uniform stretch is found exactly, whatever solves the system."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.mechanics.finite_elements.hyperelasticity import lame_parameters
from naibu.mechanics.linear_algebra import direct, recycled_factors, solver_selection
from naibu.mechanics.linear_algebra.direct import pardiso_library
from naibu.mechanics.linear_algebra.solver_selection import SolverName
from naibu.mechanics.small_strain.linear_elasticity import LinearBody
from naibu.meshing.element_conversion import to_tetra
from naibu.meshing.primitives import box

SIDE, YOUNG, POISSON, STRETCH = 30.0, 20.0, 0.45, 0.02
MKL = [pytest.param(True, marks=pytest.mark.skipif(pardiso_library() is None, reason="oneMKL is not installed")), False]
HERE = [name for name in get_args(SolverName) if name != "petsc"]  # that starts MPI: tests/mechanics/linear_algebra/test_petsc.py
NEEDS_MKL = ("pardiso", "recycled_cholesky")


def bar(cells: int) -> tuple[Mesh, PrescribedDisplacement, np.ndarray]:
    """A cube that is stretched along z and free to become thinner, and its displacement."""
    mesh = to_tetra(box((SIDE,) * 3, (cells,) * 3))
    points = mesh.points - mesh.points.min(axis=0)
    exact = points * [-POISSON * STRETCH, -POISSON * STRETCH, STRETCH]
    constrained = np.zeros(points.shape, dtype=bool)
    for axis in range(3):
        constrained[np.isclose(points[:, axis], 0.0), axis] = True  # planes of symmetry
    constrained[np.isclose(points[:, 2], SIDE), 2] = True
    return mesh, PrescribedDisplacement(constrained, np.where(constrained, exact, 0.0)), exact


def without_mkl(monkeypatch: pytest.MonkeyPatch) -> None:
    for place in (direct, recycled_factors, solver_selection):
        monkeypatch.setattr(place, "pardiso_library", lambda: None)


@pytest.mark.parametrize("with_mkl", MKL)
@pytest.mark.parametrize("solver", HERE)
def test_every_solver_finds_a_uniform_stretch(monkeypatch: pytest.MonkeyPatch, solver: SolverName, with_mkl: bool) -> None:
    if not with_mkl:
        without_mkl(monkeypatch)
    mesh, support, exact = bar(9)
    lam, mu = lame_parameters(YOUNG, POISSON)
    body = LinearBody.of(mesh)
    if solver in NEEDS_MKL and not with_mkl:
        with pytest.raises(InputError, match=r"naibu\[fast\]"):
            body.solve(lam, mu, support, solver=solver)
        return
    found = body.solve(lam, mu, support, solver=solver)
    np.testing.assert_allclose(found, exact, atol=1e-7 * SIDE)


@pytest.mark.parametrize("with_mkl", MKL)
@pytest.mark.parametrize("limit", [300, 10**9])
def test_the_solver_that_size_chooses_finds_it_too(monkeypatch: pytest.MonkeyPatch, with_mkl: bool, limit: int) -> None:
    """Small bodies, with the limit lowered below their size: what a large one meets."""
    if not with_mkl:
        without_mkl(monkeypatch)
    mesh, support, exact = bar(9)
    monkeypatch.setattr(solver_selection, "DIRECT_LIMIT", limit)
    chosen: list[str] = []
    choose = solver_selection.choose_solver

    def noted(*arguments: object, **options: object) -> object:
        found = choose(*arguments, **options)  # type: ignore[arg-type]
        chosen.append(type(found).__name__)
        return found

    monkeypatch.setattr("naibu.mechanics.small_strain.linear_elasticity.choose_solver", noted)
    lam, mu = lame_parameters(YOUNG, POISSON)
    found = LinearBody.of(mesh).solve(lam, mu, support)
    assert chosen == ["MultigridSolver" if limit == 300 else "PardisoSolver" if with_mkl else "SuperLUSolver"]
    np.testing.assert_allclose(found, exact, atol=1e-7 * SIDE)


@pytest.mark.parametrize(
    ("poisson", "unknowns", "expected"),
    [
        (POISSON, 2999, "MultigridSolver"),
        (POISSON, 3001, "PardisoSolver"),
        (0.49, 2999, "MultigridSolver"),  # the ratio itself, which comes back from Lame's constants with a rounding error
        (0.4999, 2999, "PardisoSolver"),
    ],
)
@pytest.mark.skipif(pardiso_library() is None, reason="oneMKL is not installed")
def test_a_single_system_that_is_not_nearly_incompressible_is_solved_by_multigrid_sooner(
    monkeypatch: pytest.MonkeyPatch, poisson: float, unknowns: int, expected: str
) -> None:
    """The same cube of 3000 unknowns with the limit on either side of its size; a body factorized for many loads keeps its factors."""
    mesh, support, exact = bar(9)
    assert support.constrained.size == 3000
    monkeypatch.setattr(solver_selection, "SINGLE_LIMIT", unknowns)
    chosen: list[str] = []
    choose = solver_selection.choose_solver

    def noted(*arguments: object, **options: object) -> object:
        found = choose(*arguments, **options)  # type: ignore[arg-type]
        chosen.append(type(found).__name__)
        return found

    monkeypatch.setattr("naibu.mechanics.small_strain.linear_elasticity.choose_solver", noted)
    lam, mu = lame_parameters(YOUNG, poisson)
    body = LinearBody.of(mesh)
    found = body.solve(lam, mu, support)
    body.factorized(lam, mu, support.constrained)
    assert chosen == [expected, "PardisoSolver"]
    if poisson == POISSON:
        np.testing.assert_allclose(found, exact, atol=1e-7 * SIDE)


@pytest.mark.parametrize("solver", ["automatic", "superlu", "multigrid"])
def test_constraints_of_another_shape_are_refused(solver: SolverName) -> None:
    mesh, support, _ = bar(3)
    lam, mu = lame_parameters(YOUNG, POISSON)
    with pytest.raises(InputError, match="constrained"):
        LinearBody.of(mesh).factorized(lam, mu, support.constrained.ravel(), solver=solver)
