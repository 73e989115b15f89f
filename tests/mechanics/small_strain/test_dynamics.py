"""Motion in time: rates of convergence against matrix exponentials, energy, stability at huge steps, supports that move and let go."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from naibu.core.errors import ConvergenceError, InputError
from naibu.core.mesh import Mesh
from naibu.mechanics.finite_elements.hyperelasticity import lame_parameters
from naibu.mechanics.finite_elements.linear_simplices import connection_matrices
from naibu.mechanics.prescribed_motion import PrescribedMotion
from naibu.mechanics.small_strain.dynamics import METHODS, Series, explicit_step_limit, simulate_motion
from naibu.mechanics.small_strain.implicit_integrators import MotionState
from naibu.mechanics.small_strain.linear_elasticity import LinearBody
from naibu.mechanics.small_strain.mass_matrix import ConsistentMass, mass_of
from naibu.mechanics.small_strain.rheology import CellRheology, elastic, maxwell, three_element, voigt
from naibu.mechanics.small_strain.supports import Support
from naibu.meshing.primitives import box
from naibu.meshing.structured_2d import interval, rectangle
from naibu.validation.analytic.viscoelastic import free_motion

ORDER = {"sdirk2": 2, "generalized_alpha": 2, "backward_euler": 1, "rk4": 4, "rkf45": 4}
IMPLICIT = ("sdirk2", "backward_euler", "generalized_alpha")
ELEMENTS, RATIOS = (10.0, 3.0, 20.0), (0.3, 0.2, 0.4)
GEL = three_element(*ELEMENTS, RATIOS[0], voigt_poisson_ratio=RATIOS[1], series_poisson_ratio=RATIOS[2])


def small_block() -> tuple[LinearBody, np.ndarray, Support]:
    """Two square cells on a floor; its free nodes."""
    mesh = rectangle((2.0, 1.0), (2, 1))
    return LinearBody.of(mesh), np.flatnonzero(mesh.points[:, 1] > 0.0), Support("floor", np.flatnonzero(mesh.points[:, 1] == 0.0))


def flung(body: LinearBody, free: np.ndarray, seed: int = 1) -> MotionState:
    velocity = np.zeros(body.points.shape)
    velocity[free] = np.random.default_rng(seed).standard_normal((len(free), body.points.shape[1]))
    return replace(MotionState.at_rest(body.simplices), velocity=velocity)


def exact_motion(body: LinearBody, free: np.ndarray, start: MotionState, kind: str, time: float) -> tuple[np.ndarray, np.ndarray]:
    """Free nodes' displacement and velocity from the nodal equations of motion by a matrix exponential."""
    unknown = (2 * free[:, None] + np.arange(2)).ravel()
    parts = []
    for part, matrices in enumerate(connection_matrices(body.simplices)):
        full = np.zeros((body.points.size,) * 2)
        for cell, matrix in zip(body.simplices.cells, matrices, strict=True):
            index = (2 * cell[:, None] + np.arange(2)).ravel()
            full[np.ix_(index, index)] += matrix
        parts.append((full[np.ix_(unknown, unknown)], tuple(lame_parameters(e, nu)[part] for e, nu in zip(ELEMENTS, RATIOS, strict=True))))
    mass = mass_of(body, 1.0, kind)
    nodal = mass.matrix.toarray() if isinstance(mass, ConsistentMass) else np.diag(mass.of_node)  # type: ignore[attr-defined]
    inertia = np.kron(nodal[np.ix_(free, free)], np.eye(2))
    u, v = free_motion(inertia, parts, (start.displacement[free].ravel(), start.velocity[free].ravel()), [time])  # type: ignore[arg-type]
    return u[0], v[0]


def rate_of(errors: list[float]) -> float:
    return float(np.log2(errors[-2] / errors[-1]))


@pytest.mark.parametrize("kind", ["lumped", "consistent"])
@pytest.mark.parametrize("method", METHODS)
def test_rate_of_convergence(method: str, kind: str) -> None:
    """A block is flung; the error at 1 s falls as the method's order says."""
    body, free, floor = small_block()
    start = flung(body, free)
    u, v = exact_motion(body, free, start, kind, 1.0)
    errors = []
    for count in (40, 80):
        tolerance = 1e-5 * (40 / count) ** 4  # of Runge-Kutta-Fehlberg, whose steps then keep their proportion
        end = simulate_motion(
            body, GEL, 1.0, [floor], [0.0, 1.0], step=1.0 / count, method=method, mass=kind, initial=start, tolerance=tolerance
        ).final
        errors.append(max(np.abs(end.displacement[free].ravel() - u).max(), np.abs(end.velocity[free].ravel() - v).max()))
    assert rate_of(errors) == pytest.approx(ORDER[method], abs=0.4)
    assert errors[-1] < {1: 1e-2, 2: 1e-4, 4: 1e-6}[ORDER[method]]


SMOOTH = PrescribedMotion.of(lambda t: (0.02 * np.sin(3 * t), -0.1 * np.sin(2 * t) ** 2))
BROKEN = PrescribedMotion.through([0.0, 0.3, 0.6], [(0.0, 0.0), (0.0, -0.1), (0.05, -0.1)])


@pytest.mark.parametrize("kind", ["lumped", "consistent"])
@pytest.mark.parametrize("support", ["smooth", "broken and released"])
@pytest.mark.parametrize("method", ["sdirk2", "generalized_alpha", "backward_euler"])
def test_rate_under_moving_supports(method: str, support: str, kind: str) -> None:
    """Displacement, velocity, reactions and work keep the order where plates move, change their speed and let go."""
    body, free, floor = small_block()
    plate = Support("plate", free[:1], motion=SMOOTH) if support == "smooth" else Support("plate", free[:1], motion=BROKEN, end_s=0.7)
    fine = simulate_motion(body, GEL, 1.0, [floor, plate], [0.0, 0.5, 1.0], step=1 / 800, method="rk4", mass=kind)
    errors = []
    for count in (40, 80):
        motion = simulate_motion(body, GEL, 1.0, [floor, plate], [0.0, 0.5, 1.0], step=1 / count, method=method, mass=kind)
        names = ("displacement", "velocity", "reaction", "work")
        errors.append([np.abs(getattr(motion, name) - getattr(fine, name)).max() for name in names])
    rates = np.log2(np.array(errors[0]) / errors[1])
    assert rates == pytest.approx(ORDER[method], abs=0.3)


@pytest.mark.parametrize(("method", "order"), [("sdirk2", 2), ("backward_euler", 1)])
def test_rate_without_inertia(method: str, order: int) -> None:
    body, free, floor = small_block()
    plate = Support("plate", free[:1], motion=BROKEN, end_s=0.7)
    fine = simulate_motion(body, GEL, None, [floor, plate], [0.0, 1.0], step=1 / 3000).final
    errors = [
        np.abs(
            simulate_motion(body, GEL, None, [floor, plate], [0.0, 1.0], step=1 / n, method=method).final.displacement - fine.displacement
        ).max()
        for n in (40, 80)
    ]
    assert rate_of(errors) == pytest.approx(order, abs=0.2)


def test_slow_motion_is_that_without_inertia() -> None:
    body, free, floor = small_block()
    slow = PrescribedMotion.through([0.0, 30.0, 60.0], [(0.0, 0.0), (0.0, -0.1), (0.05, -0.1)])
    plate = Support("plate", free[:1], motion=slow)
    still, moving = (simulate_motion(body, GEL, rho, [floor, plate], np.linspace(0, 60, 13), step=0.1) for rho in (None, 1e-3))
    assert moving.displacement == pytest.approx(still.displacement, abs=1e-5)
    assert moving.force("plate")[1:] == pytest.approx(still.force("plate")[1:], abs=2e-3)


def random_law(m: int, rng: np.random.Generator) -> CellRheology:
    """Every cell with its own elements, over many decades, some without one of them, each with its own Poisson ratios."""
    first = 10.0 ** rng.uniform(-4, 4, m) * (rng.random(m) < 0.6)
    second = np.where(rng.random(m) < 0.6, 10.0 ** rng.uniform(-4, 4, m), np.inf)
    ratios = rng.uniform(0.0, 0.49, (3, m))
    return CellRheology.from_arrays(m, 10.0 ** rng.uniform(-3, 4, m), first, second, *ratios)


@given(
    st.integers(0, 10_000), st.floats(-6.0, 4.0), st.sampled_from(["sdirk2", "backward_euler"]), st.sampled_from(["lumped", "consistent"])
)
@settings(max_examples=40, deadline=None)
def test_energy_never_grows(seed: int, exponent: float, method: str, kind: str) -> None:
    """Kinetic and spring energy fall in every step, at any step length, for any mixture of materials; a free body included.

    (Steps so long that stiffness times step squared exceeds mass by more than the digits of a double are left out.)
    """
    rng = np.random.default_rng(seed)
    mesh = rectangle((2.0, 1.0), (3, 2))
    body = LinearBody.of(mesh)
    floor = [Support("floor", np.flatnonzero(mesh.points[:, 1] == 0.0))] if seed % 3 else []
    free = np.flatnonzero(mesh.points[:, 1] > 0.0)
    step = 10.0**exponent
    motion = simulate_motion(
        body, random_law(mesh.n_cells, rng), 1.0, floor, step * np.arange(8.0), method=method, mass=kind, initial=flung(body, free, seed)
    )
    energy = motion.kinetic + motion.elastic
    assert (np.diff(energy) <= 1e-9 * energy[0]).all()
    assert motion.factorizations == 1


@pytest.mark.parametrize("method", IMPLICIT)
@pytest.mark.parametrize("step", [1e-2, 1.0, 1e4])
def test_stable_at_huge_steps(method: str, step: float) -> None:
    """Steps up to ten million times too long for Runge-Kutta: a block that is pushed comes to its equilibrium."""
    body, free, floor = small_block()
    soft = voigt(10.0, 0.1, 0.3)
    assert step > 1.5 * explicit_step_limit(body, soft, 1e-4)
    plate = Support("plate", free, motion=PrescribedMotion.through([0.0, step], [(0.0, 0.0), (0.01, -0.02)]))
    motion = simulate_motion(body, soft, 1e-4, [floor, plate], step * np.arange(201.0), method=method)
    constrained = np.zeros(body.points.shape)
    constrained[free] = (0.01, -0.02)
    assert motion.final.displacement == pytest.approx(constrained, abs=1e-12)
    assert motion.final.reaction == pytest.approx(body.forces(*lame_parameters(10.0, 0.3), constrained), abs=1e-5)


def test_the_default_damps_what_is_too_fast_for_its_steps() -> None:
    """Overdamped nodes that are let go stop at once, rather than to swing from step to step."""
    body, free, floor = small_block()
    motion = simulate_motion(body, voigt(1.0, 1e3, 0.3), 1e-6, [floor], [0.0, 1.0, 2.0], initial=flung(body, free))
    speed = np.abs(motion.velocity).max(axis=(1, 2))
    assert speed[1] < 1e-6 * speed[0] and speed[2] <= speed[1]


def test_generalized_alpha_keeps_or_damps_as_asked() -> None:
    """Spectral radius 1 keeps the energy of an elastic body for ever; a smaller one does not."""
    body, free, floor = small_block()
    start = flung(body, free)
    energy = [
        (m.kinetic + m.elastic) / m.kinetic[0]
        for m in (
            simulate_motion(
                body, elastic(10.0, 0.3), 1.0, [floor], 0.5 * np.arange(200.0), method="generalized_alpha", spectral_radius=r, initial=start
            )
            for r in (1.0, 0.5)
        )
    ]
    assert energy[0] == pytest.approx(1.0, rel=1e-6) and energy[1][-1] < 0.1


def test_bar_vibrates_at_its_frequency() -> None:
    """A rod fixed at one end, released from a stretch: quarter waves of speed sqrt(E / rho)."""
    length, divisions = 10.0, 40
    body = LinearBody.of(interval(length, divisions))
    speed = np.sqrt(9.0 / 1e-3)
    period = 4.0 * length / speed
    x = body.points[:, 0]
    shape = np.sin(0.5 * np.pi * x / length)
    start = replace(MotionState.at_rest(body.simplices), velocity=0.3 * shape[:, None])
    times = np.linspace(0.0, 2.0 * period, 9)
    motion = simulate_motion(body, elastic(9.0, 0.0), 1e-3, [Support("wall", np.array([0]))], times, step=period / 400, initial=start)
    expected = 0.3 * period / (2.0 * np.pi) * np.sin(2.0 * np.pi * times / period)
    assert motion.displacement[:, -1, 0] == pytest.approx(expected, abs=2e-3 * 0.3 * period / 6.0)


def test_energy_balance_of_a_push() -> None:
    """Work is kinetic plus spring energy plus what dashpots dissipate, and they never return any."""
    body, free, floor = small_block()
    plate = Support("plate", free[:1], motion=BROKEN, end_s=0.7)
    motion = simulate_motion(body, GEL, 0.1, [floor, plate], np.linspace(0.0, 3.0, 301), step=0.002)
    assert (np.diff(motion.dissipated) >= -1e-12).all()
    frictionless = simulate_motion(body, elastic(10.0, 0.3), 0.1, [floor, plate], np.linspace(0.0, 0.7, 8), step=0.0002)
    assert np.abs(frictionless.dissipated).max() < 2e-4 * frictionless.work.max()
    assert motion.work[-1] == pytest.approx(motion.work[75], rel=1e-12)  # nobody pushes any more


def test_forces_balance() -> None:
    """Weight, floor and inertia: what the floor carries, less the weight, is the change of momentum."""
    mesh = box((4.0, 4.0, 4.0), (2, 2, 2), cell_type="tetra")
    body = LinearBody.of(mesh)
    masses = mass_of(body, 1e-3, "lumped").apply(np.ones(mesh.points.shape))
    weight = masses * [0.0, 0.0, -9810.0]
    floor = Support("floor", np.flatnonzero(mesh.points[:, 2] < 1e-9))
    motion = simulate_motion(body, voigt(100.0, 0.5, 0.4), 1e-3, [floor], np.linspace(0.0, 3.0, 61), step=0.01, load=weight)
    total = 1e-3 * 64.0 * 9810.0
    assert motion.force("floor")[-1] == pytest.approx([0.0, 0.0, total], abs=1e-3 * total)
    assert motion.displacement[-1] == pytest.approx(body.solve(*lame_parameters(100.0, 0.4), _fixed(mesh, floor), weight), abs=1e-3)


def _fixed(mesh: Mesh, floor: Support):  # type: ignore[no-untyped-def]
    from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement

    return PrescribedDisplacement.none(mesh.n_points).and_also(floor.nodes, np.zeros(3))


def test_going_on_is_the_same_as_going_through() -> None:
    body, free, floor = small_block()
    plate = Support("plate", free[:1], motion=SMOOTH)
    for method in ("sdirk2", "backward_euler", "rk4"):
        whole = simulate_motion(body, GEL, 1.0, [floor, plate], [0.0, 0.5, 1.0], step=0.01, method=method)
        half = simulate_motion(body, GEL, 1.0, [floor, plate], [0.0, 0.5], step=0.01, method=method)
        rest = simulate_motion(body, GEL, 1.0, [floor, plate], [0.5, 1.0], step=0.01, method=method, initial=half.final)
        assert rest.final.displacement == pytest.approx(whole.final.displacement, abs=1e-4)
        assert rest.final.displacement == pytest.approx(whole.final.displacement, abs=1e-13) or method != "rk4"


def test_relative_support_pushes_from_where_the_body_is() -> None:
    """Released plastic square is pushed again: relative paths count from the shape that it kept."""
    body, free, floor = small_block()
    down = PrescribedMotion.through([0.0, 1.0], [(0.0, 0.0), (0.0, -0.1)])
    again = PrescribedMotion.through([3.0, 4.0], [(0.0, 0.0), (0.0, -0.1)])
    law = maxwell(10.0, 0.5, 0.3)
    supports = [floor, Support("first", free, motion=down, end_s=2.0), Support("second", free, motion=again, start_s=3.0, relative=True)]
    motion = simulate_motion(body, law, None, supports, np.linspace(0.0, 5.0, 51))
    assert motion.displacement[30, free, 1] == pytest.approx(-0.1, abs=1e-6)
    assert motion.displacement[40, free, 1] == pytest.approx(-0.2, abs=1e-6)
    assert motion.force("first")[25:] == pytest.approx(0.0) and motion.force("second")[:29] == pytest.approx(0.0)
    assert motion.force("first")[5, 1] < -0.1 and motion.force("second")[35, 1] < -0.1


def test_one_factorization_a_step_size_and_set_of_supports() -> None:
    body, free, floor = small_block()
    plate = Support("plate", free[:1], motion=BROKEN, end_s=0.6)
    assert simulate_motion(body, GEL, 1.0, [floor, plate], np.linspace(0.0, 1.2, 13), step=0.01).factorizations == 2
    assert simulate_motion(body, GEL, 1.0, [floor], np.linspace(0.0, 1.2, 13), step=0.01).factorizations == 1


def test_explicit_limit() -> None:
    """Just below the limit Runge-Kutta is stable; three times above it is unstable, and says so."""
    mesh = rectangle((2.0, 2.0), (4, 4))
    body, floor = LinearBody.of(mesh), Support("floor", np.flatnonzero(mesh.points[:, 1] == 0.0))
    for law in (elastic(10.0, 0.3), voigt(10.0, 5.0, 0.3), GEL):
        limit = explicit_step_limit(body, law, 1.0)
        start = flung(body, np.flatnonzero(mesh.points[:, 1] > 0.0))
        calm = simulate_motion(body, law, 1.0, [floor], limit * np.arange(301.0), method="rk4", initial=start)
        assert calm.kinetic[-1] + calm.elastic[-1] <= calm.kinetic[0]
        with pytest.raises(ConvergenceError, match="take shorter steps"):
            simulate_motion(body, law, 1.0, [floor], 3.0 * limit * np.arange(1001.0), method="rk4", initial=start)


def test_fehlberg_keeps_its_tolerance() -> None:
    body, free, floor = small_block()
    plate = Support("plate", free[:1], motion=BROKEN, end_s=0.7)
    fine = simulate_motion(body, GEL, 1.0, [floor, plate], [0.0, 1.0], step=1 / 2000, method="rk4").final
    found = [simulate_motion(body, GEL, 1.0, [floor, plate], [0.0, 1.0], method="rkf45", tolerance=tolerance) for tolerance in (1e-4, 1e-7)]
    errors = [np.abs(m.final.displacement - fine.displacement).max() / np.abs(fine.displacement).max() for m in found]
    assert errors[0] < 1e-3 and errors[1] < 1e-6 and found[0].steps < found[1].steps


def test_rejected_steps_do_not_loosen_the_error_control_of_a_stiff_body() -> None:
    # the first attempt is a hundred times too long; its end was once the measure of the errors of all later steps
    body, free, floor = small_block()
    stiff = three_element(30.0, 20.0, 200.0, 0.3)
    plate = Support("plate", free[:1], motion=PrescribedMotion.through([0.0, 0.05], [[0.0, 0.0], [0.0, -0.5]]))
    implicit, explicit = (
        simulate_motion(body, stiff, 1e-3, [floor, plate], [0.0, 0.05], step=step, method=method)
        for method, step in (("sdirk2", 2.5e-4), ("rkf45", None))
    )
    np.testing.assert_allclose(explicit.final.displacement, implicit.final.displacement, atol=1e-4)


def push(**changes: object) -> Series:
    body, _, floor = small_block()
    options: dict[str, object] = {"density": 1.0, "supports": [floor], "times": [0.0, 1.0]}
    options |= changes
    return simulate_motion(body, GEL, options.pop("density"), options.pop("supports"), options.pop("times"), **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"step": 0.0}, "step must be positive, not 0 s"),
        ({"step": -0.1}, "step must be positive"),
        ({"step": np.nan}, "step must be positive"),
        ({"times": [0.0]}, "two or more"),
        ({"times": [0.0, 0.0]}, "that increase"),
        ({"times": [0.0, np.nan]}, "finite"),
        ({"density": 0.0}, "density must be positive"),
        ({"density": np.nan}, "density must be finite"),
        ({"method": "euler"}, "method='euler' is not known; use one of sdirk2"),
        ({"mass": "heavy"}, "'lumped' or 'consistent'"),
        ({"density": None, "method": "rk4"}, "density=None needs method"),
        ({"density": None, "stabilization": 10.0}, "density=None needs method"),
        ({"density": None, "supports": []}, "3 of 3 rigid-body motions"),
        ({"stabilization": -1.0}, "stabilization must be positive"),
        ({"method": "generalized_alpha", "spectral_radius": 1.5}, r"in \[0, 1\]"),
        ({"method": "rkf45", "tolerance": 0.0}, "tolerance"),
        ({"load": np.zeros(3)}, "finite forces of shape"),
        ({"load": lambda t: np.full((6, 2), np.nan)}, "finite forces of shape"),
        ({"breaks": [np.inf]}, "breaks must be finite"),
        ({"supports": [Support("a", np.array([17]))]}, "a node or an axis"),
        ({"supports": [Support("a", np.array([0]), axes=(2,))]}, "a node or an axis"),
        ({"supports": [Support("a", np.array([0])), Support("a", np.array([1]))]}, "different names"),
        ({"supports": [Support("a", np.array([0])), Support("b", np.array([0]))]}, "another support constrains"),
        ({"supports": [Support("a", np.array([0]), motion=PrescribedMotion.through([0.0, 1.0], [[0.0], [1.0]]))]}, "not 2 finite numbers"),
    ],
)
def test_bad_input_is_named(changes: dict[str, object], what: str) -> None:
    with pytest.raises(InputError, match=what):
        push(**changes)


def test_bad_supports_are_named() -> None:
    for arguments, what in [
        (("a", np.array([], dtype=int)), "list of node numbers"),
        (("a", np.array([0.5])), "list of node numbers"),
        (("a", np.array([0]), (0, 0)), "name each once"),
        (("a", np.array([0]), None, None, 2.0, 1.0), "end must come later"),
    ]:
        with pytest.raises(InputError, match=what):
            Support(*arguments)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="no support is called 'hand'; there are floor"):
        push().force("hand")
    lonely = Mesh.from_arrays([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [5.0, 5.0]], [[0, 1, 2]], "triangle")
    with pytest.raises(InputError, match="node 3 belongs to no cell"):
        simulate_motion(LinearBody.of(lonely), GEL, 1.0, [], [0.0, 1.0])
    body, free, floor = small_block()
    with pytest.raises(InputError, match="times start at 1 s"):
        simulate_motion(body, GEL, 1.0, [floor], [1.0, 2.0], initial=flung(body, free))
    with pytest.raises(InputError, match="initial is the state of another body"):
        simulate_motion(body, GEL, 1.0, [floor], [0.0, 2.0], initial=MotionState.at_rest(LinearBody.of(lonely).simplices))
