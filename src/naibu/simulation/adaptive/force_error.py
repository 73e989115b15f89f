"""Errors of the forces of rigid indenters, estimated by dual-weighted recovery: with them a force is corrected, and a mesh refined for it.

The error of a quantity is the residual of the solution, weighted by the error of the adjoint one :cite:p:`becker2001`. Both are known here
from recovered gradients and stresses :cite:p:`zienkiewicz1987`; an estimate that is subtracted leaves a force of higher order
:cite:p:`giles2002`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.mesh import Mesh
from naibu.mechanics.finite_elements.linear_simplices import Simplices, simplices
from naibu.mechanics.finite_elements.stress_history import second_piola
from naibu.mechanics.finite_strain.newton import Newton
from naibu.mechanics.finite_strain.penalties import with_normal_stiffness
from naibu.mechanics.finite_strain.problem import Problem, SolverSettings
from naibu.mechanics.finite_strain.statics import LoadState
from naibu.simulation.adaptive.error_estimator import linear_products, recovered_differences


@dataclass(frozen=True, slots=True, eq=False)
class ForceErrors:
    """Estimated errors of the forces of moving indenters, along their travel.

    Attributes
    ----------
    total : mapping
        By how much the force (3,), mN, of every indenter is too large, by its name.
    cells : mapping
        Parts of the cells (m,), mN, along the travel, by the name of the indenter.
    directions : mapping
        Unit vectors (3,) of the travel, by the name of the indenter.
    forces : mapping
        The forces (3,), mN, of all rigid bodies on the body, by their names.
    """

    total: Mapping[str, FloatArray]
    cells: Mapping[str, FloatArray]
    directions: Mapping[str, FloatArray]
    forces: Mapping[str, FloatArray]


def path_force_errors(mesh: Mesh, problem: Problem, states: tuple[LoadState, ...]) -> tuple[ForceErrors, ...]:
    """Return the errors of the forces in all states of a load path but the first.

    Parameters
    ----------
    mesh : Mesh
        Linear tetrahedra.
    problem : Problem
        What was solved on it. Indenters that do not move have no error here.
    states : tuple of LoadState
        Along the path of the load.

    Raises
    ------
    ConvergenceError
        The tangent at a state is singular.

    Notes
    -----
    With friction the adjoint solution is that of the last load step alone; what earlier steps make of the error is left out.
    """
    body = simplices(mesh)
    return tuple(_errors(mesh, body, problem, before, state) for before, state in pairwise(states))


def first_piola(mesh: Mesh, problem: Problem, displacement: FloatArray, gradient: FloatArray) -> FloatArray:
    """Return the first Piola-Kirchhoff stress (m, 3, 3), kPa, of every cell, of a displacement (n, 3) and its gradient (m, 3, 3)."""
    assembler = problem.assembler
    at_points = second_piola(assembler, assembler.parameters, displacement)
    used = assembler.elements.weights > 0.0
    stress = np.empty((mesh.n_cells, 3, 3))
    stress[assembler.elements.cell_of_point[used]] = at_points[used]
    return np.asarray((gradient + np.eye(3)) @ stress)


def _errors(mesh: Mesh, body: Simplices, problem: Problem, before: LoadState, state: LoadState) -> ForceErrors:
    u = state.displacement
    newton = Newton(with_normal_stiffness(problem, state.normal_stiffness), SolverSettings())
    derivatives = np.zeros((*u.shape, len(newton.problem.contacts)))
    directions, forces = {}, {}
    for k, contact in enumerate(newton.problem.contacts):
        response = contact.evaluate(u, before.anchors[k], state.load)
        forces[contact.name] = (response.force @ response.orientation.T).sum(axis=0)
        travel = contact.stop - contact.start
        directions[contact.name] = along = travel / max(float(np.linalg.norm(travel)), 1e-300)
        change = -np.einsum("pji,j->pi", response.stiffness, response.orientation.T @ along)  # of the force along it, by a point's place
        derivatives[:, :, k] = contact.scattered(change, len(u), response.orientation)
    adjoint = newton.adjoint(u, before.anchors, state.load, derivatives)
    stress = first_piola(mesh, problem, u, body.displacement_gradients(u))
    stress_gap = recovered_differences(mesh, body, stress.reshape(-1, 9))
    total, cells = {}, {}
    for k, (name, along) in enumerate(directions.items()):
        dual = body.displacement_gradients(np.ascontiguousarray(adjoint[:, :, k]))
        cells[name] = -linear_products(body, stress_gap, recovered_differences(mesh, body, dual.reshape(-1, 9)))
        total[name] = float(cells[name].sum()) * along
    return ForceErrors(total, cells, directions, forces)
