"""Constraint stabilisation: system (9) of Hirai et al. (2008), how gaps close, and contact forces against those of exact supports."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp

from naibu.core.errors import ConvergenceError, InputError
from naibu.mechanics.prescribed_motion import PrescribedMotion
from naibu.mechanics.small_strain._rheology_kernels import rates
from naibu.mechanics.small_strain.constraint_stabilization import Stabilization, stabilized_accelerations
from naibu.mechanics.small_strain.dynamics import METHODS, simulate_motion
from naibu.mechanics.small_strain.implicit_integrators import MotionState
from naibu.mechanics.small_strain.linear_elasticity import LinearBody
from naibu.mechanics.small_strain.mass_matrix import mass_of
from naibu.mechanics.small_strain.rheology import CellRheology, three_element, voigt
from naibu.mechanics.small_strain.supports import Support
from naibu.meshing.structured_2d import rectangle

GEL = three_element(10.0, 3.0, 20.0, 0.3)
PUSH = PrescribedMotion.of(
    lambda t: (0.02 * np.sin(3 * t), -0.1 * np.sin(2 * t) ** 2),
    velocity=lambda t: (0.06 * np.cos(3 * t), -0.2 * np.sin(4 * t)),
    acceleration=lambda t: (-0.18 * np.sin(3 * t), -0.8 * np.cos(4 * t)),
)


def block() -> tuple[LinearBody, Support, np.ndarray]:
    mesh = rectangle((2.0, 1.0), (2, 1))
    return LinearBody.of(mesh), Support("floor", np.flatnonzero(mesh.points[:, 1] == 0.0)), np.flatnonzero(mesh.points[:, 1] > 0.0)


def test_system_of_the_report() -> None:
    """Accelerations and multipliers satisfy equations (7) and (8) for any constraint, inclined ones included."""
    rng = np.random.default_rng(0)
    n, c, w = 8, 3, 7.0
    half = rng.standard_normal((n, n))
    mass, a = sp.csc_matrix(half @ half.T + np.eye(n)), sp.csc_matrix(rng.standard_normal((n, c)))
    u, v, force = rng.standard_normal((3, n))
    g, speed, second = rng.standard_normal((3, c))
    acceleration, multiplier = stabilized_accelerations(mass, a, force, (u, v), w, (g, speed, second))
    assert mass @ acceleration == pytest.approx(force + a @ multiplier, abs=1e-10)
    law = a.T @ acceleration - second + 2.0 * w * (a.T @ v - speed) + w**2 * (a.T @ u - g)
    assert law == pytest.approx(0.0, abs=1e-10)
    resting, _ = stabilized_accelerations(mass, a, force, (u, v), w)
    assert a.T @ resting + a.T @ (2.0 * w * v + w**2 * u) == pytest.approx(0.0, abs=1e-10)


@pytest.mark.parametrize("kind", ["lumped", "consistent"])
def test_a_simulation_obeys_the_system(kind: str) -> None:
    """Reactions of a simulated state are the multipliers of system (9) for that state."""
    body, floor, free = block()
    plate = Support("plate", free[:1], motion=PUSH)
    motion = simulate_motion(body, GEL, 1.0, [floor, plate], [0.0, 0.4], step=0.01, method="rk4", mass=kind, stabilization=15.0)
    state, n = motion.final, body.points.size
    law = CellRheology.of(body.simplices.n_cells, GEL)
    force = -rates(body.simplices, law.flow(), state.velocity, state.trace, state.strain)[0].ravel()
    inertia = mass_of(body, 1.0, kind)
    mass = sp.csc_matrix(np.stack([inertia.apply(column.reshape(-1, 2)).ravel() for column in np.eye(n)], axis=1))
    constrained = np.zeros(body.points.shape, dtype=bool)
    constrained[floor.nodes] = constrained[plate.nodes] = True
    constraint = sp.csc_matrix(np.eye(n)[:, constrained.ravel()])
    path = [np.zeros(body.points.shape) for _ in range(3)]
    for values, function in zip(path, (PUSH.displacement, lambda t: PUSH.velocity(t, -1), PUSH.acceleration), strict=True):
        values[plate.nodes] = function(0.4)
    given = tuple(values[constrained] for values in path)
    _, multiplier = stabilized_accelerations(mass, constraint, force, (state.displacement.ravel(), state.velocity.ravel()), 15.0, given)  # type: ignore[arg-type]
    assert motion.reaction[-1][constrained] == pytest.approx(multiplier, abs=1e-9)


@pytest.mark.parametrize("method", METHODS)
def test_gaps_close_like_a_critically_damped_oscillator(method: str) -> None:
    """A body that starts off its floor: the gap is (1 + w t) exp(-w t), whatever the body does."""
    body, floor, _ = block()
    lifted = np.zeros(body.points.shape)
    lifted[floor.nodes] = [0.0, 0.05]
    start = replace(MotionState.at_rest(body.simplices), displacement=lifted)
    times = np.linspace(0.0, 1.0, 11)
    motion = simulate_motion(
        body,
        GEL,
        1.0,
        [floor],
        times,
        step=0.0005 if method == "backward_euler" else 0.005,
        method=method,
        stabilization=10.0,
        initial=start,
    )
    expected = 0.05 * (1.0 + 10.0 * times) * np.exp(-10.0 * times)
    assert motion.displacement[:, floor.nodes, 1] == pytest.approx(np.tile(expected[:, None], len(floor.nodes)), abs=1e-4)


@pytest.mark.parametrize("method", METHODS)
def test_contact_forces_are_those_of_exact_supports(method: str) -> None:
    """Stiff stabilisation and elimination agree in shape and force, while a plate moves and after it has let go."""
    body, floor, free = block()
    plate = Support("plate", free[:1], motion=PUSH, end_s=0.6)
    step = 0.002
    exact, kept = (
        simulate_motion(body, GEL, 1.0, [floor, plate], np.linspace(0.0, 1.0, 11), step=step, method=method, stabilization=w)
        for w in (None, 200.0)
    )
    assert kept.displacement == pytest.approx(exact.displacement, abs=5e-4)
    moving = slice(2, 7)
    largest = np.abs(exact.force("plate")[moving]).max()
    assert kept.force("plate")[moving] == pytest.approx(exact.force("plate")[moving], abs=0.03 * largest)
    assert kept.force("plate")[7:] == pytest.approx(0.0, abs=1e-12)
    assert np.abs(kept.displacement[1:6, free[0]] - [PUSH.displacement(t) for t in kept.times[1:6]]).max() < 1e-3


def test_stable_with_stiff_stabilisation_and_huge_steps() -> None:
    body, floor, free = block()
    plate = Support("plate", free, motion=PrescribedMotion.through([0.0, 1.0], [(0.0, 0.0), (0.0, -0.1)]))
    motion = simulate_motion(body, voigt(10.0, 1.0, 0.3), 1.0, [floor, plate], np.arange(60.0), step=1.0, stabilization=1e4)
    assert motion.displacement[-1, free] == pytest.approx(np.tile([0.0, -0.1], (len(free), 1)), abs=1e-9)
    exact = simulate_motion(body, voigt(10.0, 1.0, 0.3), 1.0, [floor, plate], np.arange(60.0), step=1.0)
    assert motion.reaction[-1] == pytest.approx(exact.reaction[-1], abs=1e-6)


def test_bad_input_is_named() -> None:
    with pytest.raises(InputError, match="must be positive, 1/s, not 0"):
        Stabilization(0.0)
    with pytest.raises(InputError, match="must be positive"):
        Stabilization(float("nan"))
    identity, zero = sp.identity(4, format="csc"), np.zeros(4)
    twice = sp.csc_matrix(np.eye(4)[:, [0, 0]])
    with pytest.raises(ConvergenceError, match="linearly dependent"):
        stabilized_accelerations(identity, twice, zero, (zero, zero), 1.0)
    with pytest.raises(InputError, match="force must have shape"):
        stabilized_accelerations(identity, twice, np.zeros(3), (zero, zero), 1.0)
