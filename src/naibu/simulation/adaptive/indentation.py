"""An indentation on meshes that are refined for the forces of the indenters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.mechanics.contact.rigid_indenters import RigidIndenter
from naibu.mechanics.finite_elements.elements import Formulation
from naibu.mechanics.finite_elements.hyperelasticity import Material
from naibu.mechanics.finite_strain.problem import SolverSettings
from naibu.mechanics.finite_strain.statics import Solution, solve
from naibu.simulation.adaptive.conditions import Conditions
from naibu.simulation.adaptive.contact_refinement import mesh_in_contact
from naibu.simulation.adaptive.force_error import path_force_errors
from naibu.simulation.adaptive.statics import (
    AdaptiveSolution,
    Goal,
    StaticResult,
    hyperelastic_problem,
    pressed_by,
    solve_adaptively,
    static_result,
)


@dataclass(frozen=True, slots=True, eq=False)
class Indentation:
    """Forces of indenters along their way into a body.

    Attributes
    ----------
    refinement : AdaptiveSolution
        Equilibria at the end of the way, on all meshes.
    mesh : Mesh
        The last one.
    fractions : ndarray, shape (s,)
        Of the way, from 0 to 1.
    displacement : ndarray, shape (s, n, 3)
        mm.
    forces : ndarray, shape (s, k, 3)
        Of the indenters on the body, mN.
    errors : ndarray, shape (s, k, 3)
        Estimated errors of the forces along the ways, mN.
    """

    refinement: AdaptiveSolution
    mesh: Mesh
    fractions: FloatArray
    displacement: FloatArray
    forces: FloatArray
    errors: FloatArray

    @property
    def corrected(self) -> FloatArray:
        """Forces (s, k, 3), mN, less their estimated errors."""
        return self.forces - self.errors


def indent(
    mesh: Mesh,
    materials: Sequence[Material],
    conditions: Conditions,
    indenters: Sequence[RigidIndenter],
    travel: ArrayLike,
    *,
    goal: Goal | None = "force",
    tolerance: float = 0.05,
    max_unknowns: int = 20_000,
    fraction: float = 0.6,
    steps: int = 10,
    formulation: Formulation = "standard",
    callback: Callable[[int, StaticResult], None] = lambda unknowns, result: None,
) -> Indentation:
    """Press indenters into a body on meshes that are refined for the forces at the end of the way.

    On every mesh the whole way is followed, from the states on the mesh before.

    Parameters
    ----------
    mesh : Mesh
        Linear tetrahedra, the coarsest mesh; it is refined under the indenters until they touch enough points.
    materials : sequence of Material
        One for each region.
    conditions : Conditions
        What is held, and loads.
    indenters : sequence of RigidIndenter
        At the start.
    travel : array_like, shape (k, 3)
        Their straight ways, mm.
    goal : {"force", "energy"} or None
        See `hyperelastic_static`; None keeps the mesh.
    tolerance, max_unknowns, fraction
        See `solve_adaptively`.
    steps : int
        States along the way.
    formulation : {"standard", "mean_dilatation"}
        See `hyperelastic_static`.
    callback : callable
        Called with the number of unknowns and the result after every mesh.

    Raises
    ------
    InputError
        Settings out of range, or an indenter that does not press into the body.
    ConvergenceError
        An equilibrium was not found.
    """
    if steps < 1:
        raise InputError(f"steps must be at least 1, not {steps}")
    ways = np.asarray(travel, dtype=float)
    contacts = pressed_by(indenters, ways)
    fractions = np.arange(1, steps + 1) / steps
    last: list[Solution] = []

    def solve_on(on: Mesh, start: FloatArray | None) -> StaticResult:
        problem = hyperelastic_problem(on, conditions, materials, contacts=contacts(on), formulation=formulation)
        if start is None:
            path = solve(problem, settings=SolverSettings(first_step=1.0 / steps, largest_step=1.0 / steps))
        else:
            path = solve(problem, warm_start=[(f, start[:, 3 * s : 3 * s + 3]) for s, f in enumerate(fractions.tolist())])
        last[:] = [path]
        found = static_result(on, path, materials, goal or "force")
        callback(found.displacement.size, found)
        return replace(found, carried=_between(path, fractions))

    limit = max_unknowns if goal else 1
    coarse = mesh_in_contact(mesh, indenters, ways)
    refined = solve_adaptively(coarse, solve_on, tolerance=tolerance, max_unknowns=limit, fraction=fraction)
    return _indentation(refined, last[0], len(indenters))


def _between(path: Solution, fractions: FloatArray) -> FloatArray:
    """Return the displacements (n, 3 s), mm, at fractions (s,) of the load, linear between the states of a path."""
    loads = np.array([state.load for state in path.states])
    after = np.clip(np.searchsorted(loads, fractions - 1e-9), 1, len(loads) - 1)
    share = (fractions - loads[after - 1]) / (loads[after] - loads[after - 1])
    moved = [
        (1.0 - w) * path.states[k - 1].displacement + w * path.states[k].displacement for k, w in zip(after.tolist(), share, strict=True)
    ]
    return np.concatenate(moved, axis=1)


def _indentation(refined: AdaptiveSolution, path: Solution, count: int) -> Indentation:
    mesh, states = refined.leaf.mesh, path.states
    forces, errors = np.zeros((len(states), count, 3)), np.zeros((len(states), count, 3))
    for s, found in enumerate(path_force_errors(mesh, path.problem, states), start=1):
        for k in range(count):
            errors[s, k] = found.total.get(f"indenter {k}", np.zeros(3))
            forces[s, k] = found.forces[f"indenter {k}"]
    fractions = np.array([state.load for state in states])
    return Indentation(refined, mesh, fractions, np.stack([state.displacement for state in states]), forces, errors)
