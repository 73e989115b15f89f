"""The object as the reference scan saw it: lying on its table, already bent by its weight.

The nodes of a mesh stand where the reference scan found the object. Its weight, which is applied between side plates, where nothing else
holds the object down, moves them from there; markers of a loaded scan have moved by what the plates add to that. The difference of both
displacements is right to first order in the deformation by the weight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.mechanics.finite_strain.newton import Newton
from naibu.mechanics.finite_strain.problem import Problem, SolverSettings
from naibu.mechanics.finite_strain.sensitivities import Direction, sensitivities
from naibu.mechanics.finite_strain.statics import Solution, solve

AWAY = 1.0  # extents of the object by which indenters are taken away from it
UNDER_WEIGHT = SolverSettings(first_step=1.0, largest_step=1.0, tolerance=1e-6)


def resting_problem(problem: Problem) -> Problem | None:
    """Return the problem of the same body without its indenters; None where it has no weight."""
    if not problem.external_force.any():
        return None
    extent = AWAY * float(np.ptp(problem.points, axis=0).max())
    contacts = []
    for c in problem.contacts:
        if c.name.startswith("indenter"):
            place = c.start - extent * (c.rotation @ c.surface.normal)
            contacts.append(replace(c, start=place, stop=place, tilt=None))
        else:
            contacts.append(c)
    return problem.with_changes(contacts=tuple(contacts))


def resting_state(solution: Solution, near: Solution | None = None) -> Solution | None:
    """Return the equilibrium of a solved body under its weight alone; None where it has none.

    Parameters
    ----------
    solution : Solution
        Of the body with its indenters.
    near : Solution, optional
        Equilibrium under its weight of a body like it, to start from.

    Raises
    ------
    ConvergenceError
        The weight flattens the body.
    """
    problem = resting_problem(solution.problem)
    if problem is None:
        return None
    return solve(problem, settings=UNDER_WEIGHT, warm_start=() if near is None else [(1.0, near.displacement)])


def since_scan(solution: Solution, displacement: FloatArray | None = None) -> FloatArray:
    """Return by how much the nodes (n, 3) of a solved body have moved since the reference scan, mm; of the last state by default."""
    total = solution.displacement if displacement is None else displacement
    resting = resting_state(solution)
    return total if resting is None else np.asarray(total - resting.displacement)


def resting_derivatives(resting: Solution, directions: Sequence[Direction]) -> FloatArray:
    """Return the derivatives (n, 3, k) of the displacement under the weight alone along k directions."""
    newton = Newton(resting.problem, UNDER_WEIGHT)
    return sensitivities(resting.problem, resting.states, list(directions), newton=newton)[-1]
