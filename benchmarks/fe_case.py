"""The cube compressed by ``fe_compression.py`` and ``fe_linear.py``, and what their programs have in common (mm, kPa, mN)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from naibu.core.mesh import Mesh
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.mechanics.finite_elements.hyperelasticity import lame_parameters
from naibu.mechanics.linear_algebra.block_matrix import with_dirichlet_rows
from naibu.mechanics.linear_algebra.direct import PardisoSolver, SuperLUSolver
from naibu.mechanics.linear_algebra.protocols import Factorization, LinearSolver
from naibu.meshing.element_conversion import to_tetra
from naibu.meshing.primitives import box

Array = NDArray[np.float64]
SIDE, DEPTH, RADIUS = 60.0, 15.0, 15.0
SOFT, STIFF, POISSON = 10.0, 30.0, 0.45
STEPS, TOLERANCE = 5, 1e-8
LOWERED = 3.0  # mm, of the linear problem


@dataclass(frozen=True)
class Case:
    """The mesh, its Lame parameters (mu, lambda) for every cell, and the nodes below and above."""

    mesh: Mesh
    shear: Array
    lame: Array
    bottom: NDArray[np.int64]
    top: NDArray[np.int64]


@dataclass(frozen=True)
class Result:
    """Displacement (n, 3), mm, force on the top, mN (none of linear problems), and number of linear systems solved.

    Programs that run in processes of their own measure themselves: seconds and MB.
    """

    displacement: Array
    force: Array = field(default_factory=lambda: np.empty(0))
    iterations: int = 1
    measured: tuple[float, float] | None = None


def make_case(cells: int) -> Case:
    """Return the cube of ``6 cells^3`` tetrahedra."""
    mesh = to_tetra(box((SIDE,) * 3, (cells,) * 3))
    points = mesh.points - mesh.points.min(axis=0)
    inside = np.linalg.norm(points[mesh.cells].mean(axis=1) - SIDE / 2, axis=1) < RADIUS
    values = np.array([lame_parameters(young, POISSON) for young in (SOFT, STIFF)])[inside.astype(int)]
    mesh = Mesh(points, mesh.cells, "tetra", inside.astype(np.int64), ("soft", "stiff"))
    below, above = (np.flatnonzero(np.abs(points[:, 2] - level) < 1e-9) for level in (0.0, SIDE))
    return Case(mesh, values[:, 1].copy(), values[:, 0].copy(), below, above)


def prescribed(case: Case, depth: float = DEPTH) -> PrescribedDisplacement:
    nothing = PrescribedDisplacement.none(case.mesh.n_points)
    return nothing.and_also(case.bottom, (0.0, 0.0, 0.0)).and_also(case.top, (0.0, 0.0, -depth))


def largest_residual(case: Case) -> float:
    """Return the Euclidean norm, mN, at which a peer with an absolute criterion stops.

    It is `TOLERANCE` of the reactions of a soft bar without ball or lateral constraint after the first step, hence of less than the
    reactions of the cube after any step.
    """
    force = SOFT * SIDE**2 * DEPTH / SIDE / STEPS
    return TOLERANCE * force * float(np.sqrt(1 / len(case.bottom) + 1 / len(case.top)))


def pardiso(matrix: sp.bsr_matrix) -> LinearSolver:
    return PardisoSolver(matrix, symmetric=True)


class Cholesky:
    """Naibu's direct solver for peers; repeats the symbolic analysis only if the pattern has grown."""

    def __init__(self) -> None:
        self._solver: LinearSolver | None = None
        self._indices = np.empty(0, dtype=np.int32)

    def factorize(self, matrix: sp.bsr_matrix) -> Factorization:
        if self._solver is None or not np.array_equal(self._indices, matrix.indices):
            self._solver, self._indices = pardiso(matrix), matrix.indices.copy()
        return self._solver.factorize(matrix)


def newton(case: Case, forces: Callable[[Array], Array], tangent: Callable[[Array], sp.bsr_matrix], solver: str) -> Result:
    """Full Newton's method for a peer that assembles but does not iterate, with naibu's criterion and predictor."""
    support, u, count = prescribed(case), np.zeros_like(case.mesh.points), 0
    linear = SuperLUSolver() if solver == "superlu" else Cholesky()
    for step in range(1, STEPS + 1):
        jump = np.where(support.constrained, step / STEPS * support.values - u, 0.0)
        r = forces(u)
        for _ in range(20):
            matrix = tangent(u)
            rhs = r + (matrix @ jump.ravel()).reshape(-1, 3)
            rhs[support.constrained] = 0.0
            matrix = with_dirichlet_rows(matrix, support.constrained)
            u = u + jump - linear.factorize(matrix).solve(rhs.ravel()).reshape(-1, 3)
            jump[:] = 0.0
            count += 1
            r = forces(u)
            if np.abs(r[~support.constrained]).sum() <= TOLERANCE * np.abs(r[support.constrained]).sum():
                break
    return Result(u, forces(u)[case.top].sum(axis=0), count)
