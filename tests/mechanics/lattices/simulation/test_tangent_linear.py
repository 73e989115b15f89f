"""Derivatives of a lattice's motion by its parameters against differences of fourth order, and the motion against the engine's own."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from naibu.core.errors import InputError
from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.model.lattice import Lattice, LatticeParameters, box_mask, classic_lattice, lattice_parameters
from naibu.mechanics.lattices.model.state import ConstrainedNodes
from naibu.mechanics.lattices.simulation.tangent_linear import DrivenMotion, Loads, ParameterChange, driven_steps

Array = NDArray[np.float64]
STEPS, STEP_S = 40, 0.01


@pytest.fixture(scope="module")
def lattice() -> Lattice:
    return classic_lattice(box_mask((4, 3, 3)), 20.0, total_mass_kg=0.5)


def parameters(lattice: Lattice) -> LatticeParameters:
    k = {"short": 60.0, "normal": 40.0, "long": 20.0}
    return lattice_parameters(lattice, k, {"short": 40.0, "normal": 30.0, "long": 15.0}, {"short": 60.0, "normal": 40.0, "long": 30.0})


def pushed(lattice: Lattice, given: LatticeParameters, changes: tuple[ParameterChange, ...] = (), tolerance: float = 1e-10) -> DrivenMotion:
    """A face moved inwards, the one across pushed by a force, the floor constrained."""
    engine = LatticeEngine.of(lattice, given, step=STEP_S, tolerance=tolerance)
    p = lattice.points
    constrained = ConstrainedNodes.of(np.flatnonzero(p[:, 2] == 0.0), 0) + ConstrainedNodes.of(
        np.flatnonzero((p[:, 0] == 0.0) & (p[:, 2] > 0.0)), 1
    )
    loaded = np.flatnonzero((p[:, 0] == 80.0) & (p[:, 2] > 10.0))
    loads = Loads(loaded, np.full(len(loaded), 1.0 / len(loaded)), np.full(len(loaded), 2))
    velocity, force = np.zeros((2, STEPS, 3, 3))
    velocity[:, 1, 0], force[:, 2, 0] = 20.0, -800.0
    return driven_steps(engine, engine.rest(), STEPS, constrained, velocity, loads=loads, force=force, changes=changes)


@pytest.mark.parametrize(("kind", "group"), [(0, 0), (0, 2), (1, 1), (2, 0), (2, 2)])
def test_derivatives_are_those_of_finite_differences(lattice: Lattice, kind: int, group: int) -> None:
    base = parameters(lattice)
    values = [base.stiffness, base.voigt_damping, base.series_damping]
    slopes = [np.where((lattice.element_class == group) & (k == kind), v, 0.0) for k, v in enumerate(values)]
    found = pushed(lattice, base, (ParameterChange(*slopes),))
    h = 1e-2
    around = {
        s: pushed(lattice, LatticeParameters(*(v + s * h * d for v, d in zip(values, slopes, strict=True)), base.voigt_fraction))
        for s in (-2, -1, 1, 2)
    }

    def difference(of: Callable[[DrivenMotion], Array]) -> Array:
        return (8.0 * (of(around[1]) - of(around[-1])) - (of(around[2]) - of(around[-2]))) / (12.0 * h)

    for of, ours in (
        (lambda m: m.state.position, found.state_change.position[0]),
        (lambda m: m.state.extension, found.state_change.extension[0]),
        (lambda m: m.reaction, found.reaction_change[0]),
    ):
        expected = difference(of)
        assert np.abs(ours - expected).max() < 3e-5 * np.abs(expected).max()


def test_the_motion_is_the_engines_own(lattice: Lattice) -> None:
    given = parameters(lattice)
    engine = LatticeEngine.of(lattice, given, step=STEP_S, tolerance=1e-8)
    constrained = ConstrainedNodes.of(np.flatnonzero(lattice.points[:, 2] == 0.0), 0) + ConstrainedNodes.of(
        np.flatnonzero(lattice.points[:, 2] == 60.0), 1
    )
    velocity = np.zeros((STEPS, 2, 3))
    velocity[:, 1, 2] = -10.0
    ours, own = driven_steps(engine, engine.rest(), STEPS, constrained, velocity), engine.run(engine.rest(), STEPS, constrained, velocity)
    np.testing.assert_allclose(ours.state.position, own.state.position, atol=1e-9)
    np.testing.assert_allclose(ours.reaction, own.reaction, atol=1e-6)


def test_a_run_in_two_parts_is_the_run_in_one(lattice: Lattice) -> None:
    given = parameters(lattice)
    change = (ParameterChange(given.stiffness, 0.0 * given.stiffness, 0.0 * given.stiffness),)
    engine = LatticeEngine.of(lattice, given, step=STEP_S, tolerance=1e-8)
    constrained = ConstrainedNodes.of(np.flatnonzero(lattice.points[:, 2] == 0.0), 0) + ConstrainedNodes.of(
        np.flatnonzero(lattice.points[:, 2] == 60.0), 1
    )
    velocity = np.zeros((2, 3))
    velocity[1, 2] = -10.0
    whole = driven_steps(engine, engine.rest(), STEPS, constrained, velocity, changes=change)
    half = driven_steps(engine, engine.rest(), STEPS // 2, constrained, velocity, changes=change)
    rest = driven_steps(engine, half.state, STEPS // 2, constrained, velocity, changes=change, state_change=half.state_change)
    np.testing.assert_allclose(
        rest.state_change.position, whole.state_change.position, atol=1e-6 * np.abs(whole.state_change.position).max()
    )
    np.testing.assert_allclose(
        rest.reaction_change, whole.reaction_change[:, STEPS // 2 :], atol=1e-4 * np.abs(whole.reaction_change).max()
    )


def test_what_a_body_pushes_with_is_answered_but_for_inertia(lattice: Lattice) -> None:
    """The answer of the lattice to a force is the force less the momentum that the loaded nodes took up."""
    found = pushed(lattice, parameters(lattice))
    p = lattice.points
    loaded = np.flatnonzero((p[:, 0] == 80.0) & (p[:, 2] > 10.0))
    taken = (lattice.node_mass[loaded, None] * found.state.velocity[loaded]).sum(axis=0)
    pushed_with = np.array([-800.0, 0.0, 0.0]) * STEPS * STEP_S
    np.testing.assert_allclose(STEP_S * found.reaction[:, 2].sum(axis=0), pushed_with - taken, atol=1e-9 * 800.0)


def test_wrong_input_is_told(lattice: Lattice) -> None:
    given = parameters(lattice)
    engine = LatticeEngine.of(lattice, given, method="euler")
    with pytest.raises(InputError, match="make one with method='implicit'"):
        driven_steps(engine, engine.rest(), 1, ConstrainedNodes.none(), 0.0)
    engine = LatticeEngine.of(lattice, given)
    wrong = ParameterChange(np.ones(3), given.voigt_damping, given.series_damping)
    with pytest.raises(InputError, match=r"the change of K has shape \(3,\)"):
        driven_steps(engine, engine.rest(), 1, ConstrainedNodes.none(), 0.0, changes=(wrong,))
