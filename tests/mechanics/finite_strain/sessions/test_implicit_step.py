"""Damped Newton iterations of a step, from where the tangent is indefinite."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve

from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError
from naibu.mechanics import Assembler, elements, material
from naibu.mechanics.finite_strain.sessions.implicit_step import ImplicitStep
from naibu.meshing import box, to_tetra

EDGE = 10.0


def gel_step(duration: float, **values: float) -> ImplicitStep:
    """A step of a cube of a nearly incompressible gel that is held at its floor, and at rest without forces."""
    mesh = to_tetra(box((3 * EDGE,) * 3, (3, 3, 3)))
    assembler = Assembler.from_materials(
        elements(mesh, "mean_dilatation"), mesh.regions, [material(young_modulus=70.0, poisson_ratio=0.499)]
    )
    still = np.zeros_like(mesh.points)
    held = np.repeat((mesh.points[:, 2] < 1e-9)[:, None], 3, axis=1)
    mass = np.full(len(mesh.points), 27e-3 / len(mesh.points))
    return ImplicitStep(assembler, mass, duration, still, still, still, held, floor=1.0, **values)


def solve(matrix: sp.bsr_matrix, right: FloatArray) -> FloatArray:
    return np.asarray(spsolve(sp.csc_matrix(matrix), right.ravel())).reshape(-1, 3)


@pytest.mark.parametrize("seed", range(4))
def test_damped_iterations_find_the_state_of_rest_from_where_newtons_method_does_not(seed: int) -> None:
    """Nodes displaced at random by a fifth of an edge: volumes, and pressures, alternate from cell to cell. The truth is rest."""
    step = gel_step(1.0)
    rng = np.random.default_rng(seed)
    guess = np.where(step.constrained, 0.0, rng.uniform(-0.2, 0.2, step.displacement.shape) * EDGE)
    smallest = np.linalg.eigvalsh(step.tangent(guess).toarray()).min()
    assert smallest < 0.0
    with pytest.raises(ConvergenceError):
        step.solved(guess, solve)
    found = step.damped(guess, solve)
    assert np.abs(found).max() < 1e-3 * EDGE


def test_damped_iterations_are_newtons_where_those_converge() -> None:
    step = gel_step(1.0)
    guess = np.where(step.constrained, 0.0, np.random.default_rng(0).uniform(-0.005, 0.005, step.displacement.shape) * EDGE)
    counts = []
    for method in (step.solved, step.damped):
        solves = 0

        def counted(matrix: sp.bsr_matrix, right: FloatArray) -> FloatArray:
            nonlocal solves
            solves += 1
            return solve(matrix, right)

        found = method(guess, counted)
        assert np.abs(found).max() < 1e-3 * EDGE
        counts.append(solves)
    assert counts[0] == counts[1]


def test_a_step_without_balance_is_told() -> None:
    """An inverted cell at the beginning."""
    step = gel_step(1.0)
    guess = step.displacement.copy()
    guess[-1] -= 3.0 * EDGE
    with pytest.raises(ConvergenceError, match="inverted"):
        step.damped(guess, solve)
