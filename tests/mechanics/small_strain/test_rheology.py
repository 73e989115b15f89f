"""Rheological cells: limits of the three-element solid, closed solutions in one dimension, kernels against connection matrices."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.mechanics.finite_elements.hyperelasticity import lame_parameters
from naibu.mechanics.finite_elements.linear_simplices import connection_matrices, simplices
from naibu.mechanics.prescribed_motion import PrescribedMotion
from naibu.mechanics.small_strain._rheology_kernels import advanced, elastic_energy, rates, stage_forces
from naibu.mechanics.small_strain.dynamics import Series, simulate_motion
from naibu.mechanics.small_strain.linear_elasticity import LinearBody
from naibu.mechanics.small_strain.rheology import CellRheology, Rheology, elastic, maxwell, per_region, three_element, voigt
from naibu.mechanics.small_strain.supports import Support
from naibu.meshing.primitives import box
from naibu.meshing.structured_2d import interval, rectangle
from naibu.validation.analytic.viscoelastic import complex_modulus, creep_strain, ramp_stress, released_strain, residual_strain

Elements = tuple[float, float, float]
THREE = (10.0, 4.0, 30.0)
CASES: dict[str, Elements] = {
    "elastic": (10.0, 0.0, np.inf), "voigt": (10.0, 4.0, np.inf), "maxwell": (10.0, 0.0, 30.0), "three": THREE,
    "dashpots": (0.0, 4.0, 30.0),
}  # fmt: skip
moduli = st.floats(0.01, 1e4)
ratios = st.floats(0.001, 0.499)


def rod(length: float = 5.0, divisions: int = 4) -> LinearBody:
    return LinearBody.of(interval(length, divisions), cross_section_mm2=2.0)


def material(elements: Elements) -> Rheology:
    return three_element(*elements, 0.0)  # in one dimension J is that of lambda = 0, 2 mu = E


def pulled(elements: Elements, path: PrescribedMotion, times: np.ndarray, **options: object) -> Series:
    """A rod of 5 mm and 2 mm^2, without inertia, whose right end follows a path."""
    body = rod()
    supports = [Support("wall", np.array([0])), Support("hand", np.array([4]), motion=path)]
    return simulate_motion(body, material(elements), None, supports, times, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", CASES)
def test_creep_and_recovery(name: str) -> None:
    """A stress of 3 kPa for 2 s and then none: strain s/E (1 - exp(-E t/C1)) + s t/C2, second order in the step."""
    body, elements = rod(), CASES[name]
    pull = np.zeros((5, 1))
    pull[4] = 3.0 * 2.0
    times = np.linspace(0.0, 5.0, 51)
    wall = Support("wall", np.array([0]))
    expected = creep_strain(elements, 3.0, 2.0, times)
    expected[[0, 20]] = creep_strain(elements, 3.0, 2.0, [0.0, 2.0])
    errors = []
    for step in (0.1, 0.05):
        motion = simulate_motion(
            body, material(elements), None, [wall], times, step=step, load=lambda t: pull if t < 2.0 else 0.0 * pull, breaks=[2.0]
        )
        strain = motion.displacement[:, 4, 0] / 5.0
        keep = np.arange(51) != 20 if elements[1] == 0.0 else np.ones(51, dtype=bool)  # without C1 the strain jumps there
        keep[0] = elements[1] > 0.0
        errors.append(np.abs(strain - expected)[keep].max())
    assert errors[1] < 5e-4 * expected.max()
    assert errors[1] < 0.3 * errors[0] or errors[1] < 1e-6 * expected.max()


@pytest.mark.parametrize("name", CASES)
def test_stress_of_a_ramp_is_exact_at_any_step(name: str) -> None:
    """A strain that grows evenly and then stays constant: the exponential update leaves no error, whatever the step."""
    elements, strain = CASES[name], 0.02
    times = np.array([0.0, 0.7, 1.5, 4.0, 40.0, 4000.0])
    motion = pulled(elements, PrescribedMotion.through([0.0, 1.5], [[0.0], [5.0 * strain]]), times, step=1e6)
    assert motion.steps == 5
    stress = motion.force("hand")[1:, 0] / 2.0
    assert stress == pytest.approx(ramp_stress(elements, strain, 1.5, times[1:]), rel=1e-9, abs=1e-9)
    assert motion.force("wall") == pytest.approx(-motion.force("hand"), abs=1e-9)


@pytest.mark.parametrize("name", ["elastic", "voigt", "maxwell", "three"])
def test_displacement_that_stays(name: str) -> None:
    """Pulled in 1.5 s, kept for 3 s, released: the residual is the strain of the series dashpot."""
    elements = CASES[name]
    times = np.array([0.0, 4.5, 5.0, 6.0, 60.0])
    path = PrescribedMotion.through([0.0, 1.5], [[0.0], [0.1]])
    body = rod()
    supports = [Support("wall", np.array([0])), Support("hand", np.array([4]), motion=path, end_s=4.5)]
    motion = simulate_motion(body, material(elements), None, supports, times, step=0.02)
    assert motion.displacement[:, 4, 0] == pytest.approx(5.0 * released_strain(elements, 0.02, 1.5, 3.0, times), abs=1e-5)
    assert motion.displacement[-1, 4, 0] == pytest.approx(5.0 * residual_strain(elements, 0.02, 1.5, 3.0), abs=1e-5)
    assert motion.force("hand")[2:] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("name", ["voigt", "maxwell", "three"])
def test_steady_vibration(name: str) -> None:
    """Stress over strain of a steady vibration is the complex modulus of the chain."""
    elements, w = CASES[name], 3.0
    path = PrescribedMotion.of(lambda t: [0.1 * np.sin(w * t)], velocity=lambda t: [0.1 * w * np.cos(w * t)])
    start = 60.0
    times = np.concatenate([[0.0], start + np.linspace(0.0, 2.0 * np.pi / w, 9)])
    motion = pulled(elements, path, times, step=0.02)
    stress, phase = motion.force("hand")[1:9, 0] / 2.0, w * times[1:9]
    found = 2.0 / 8.0 * (stress @ np.sin(phase) + 1j * (stress @ np.cos(phase))) / 0.02
    assert found == pytest.approx(complex(complex_modulus(elements, w)), rel=1e-3)


@pytest.mark.parametrize("name", CASES)
def test_references_solve_the_chain(name: str) -> None:
    """The closed solutions against a numerical solution of spring and dashpots, each with its own strain."""
    modulus, first, second = CASES[name]
    soft = max(first, 1e-6), min(second, 1e9)  # the chain below divides by C1 and C2

    def flow(t: float, y: np.ndarray) -> list[float]:  # strain of the Voigt part and of the series dashpot under a given stress
        stress = 3.0 if t <= 2.0 else 0.0
        return [(stress - modulus * y[0]) / soft[0], stress / soft[1]]

    times = np.array([0.5, 1.9, 2.5, 6.0])
    solved = [solve_ivp(flow, (0.0, 2.0), [0.0, 0.0], method="LSODA", rtol=1e-9, atol=1e-11, dense_output=True)]
    solved.append(
        solve_ivp(lambda t, y: flow(t + 2.1, y), (0.0, 4.0), solved[0].y[:, -1], method="LSODA", rtol=1e-9, atol=1e-11, dense_output=True)
    )
    expected = [solved[0].sol(t).sum() if t <= 2.0 else solved[1].sol(t - 2.0).sum() for t in times]
    assert creep_strain(CASES[name], 3.0, 2.0, times) == pytest.approx(expected, rel=1e-5, abs=1e-7)
    if np.isfinite(second) and first > 0.0:
        total = solve_ivp(lambda t, y: [float(ramp_stress(CASES[name], 0.02, 1.5, t))], (0.0, 1.5), [0.0], rtol=1e-9, atol=1e-12).y[0, -1]
        total += solve_ivp(
            lambda t, y: [float(ramp_stress(CASES[name], 0.02, 1.5, 1.5 + 1e-12 + t))], (0.0, 3.0), [0.0], rtol=1e-9, atol=1e-12
        ).y[0, -1]
        assert residual_strain(CASES[name], 0.02, 1.5, 3.0) == pytest.approx(total / second, rel=1e-6)


@given(moduli, moduli, moduli, ratios)
@settings(max_examples=40, deadline=None)
def test_limits_of_the_coefficients(young: float, first: float, second: float, nu: float) -> None:
    """C2 -> inf is Voigt, C1 -> 0 Maxwell, both elastic, E -> 0 dashpots in series - also of what a step does."""

    def same(a: Rheology, b: Rheology, tolerance: float) -> None:
        x, y = (CellRheology.of(1, m).over(0.3) for m in (a, b))
        assert x.effective == pytest.approx(y.effective, rel=tolerance)
        assert x.decay == pytest.approx(y.decay, abs=tolerance)
        small = tolerance * y.effective.max()
        assert x.dashpot == pytest.approx(y.dashpot, abs=small)
        assert x.spring * x.gain == pytest.approx(y.spring * y.gain, abs=small)

    big = 1e10 * max(young, first)
    same(three_element(young, first, big, nu), voigt(young, first, nu), 1e-6)
    same(three_element(young, 1e-12 * min(young, second), second, nu), maxwell(young, second, nu), 1e-6)
    same(three_element(young, 0.0, big, nu), elastic(young, nu), 1e-6)
    same(three_element(1e-12 * min(first, second), first, second, nu), three_element(0.0, first, second, nu), 1e-6)
    law = CellRheology.of(1, three_element(young, first, second, nu))
    assert law.dashpot == pytest.approx(law.voigt * law.series / (law.voigt + law.series))


@given(moduli, st.floats(0.0, 1e4), moduli, ratios, st.floats(1e-8, 1e8))
@settings(max_examples=60, deadline=None)
def test_a_step_is_the_solution_of_the_internal_equation(young: float, first: float, second: float, nu: float, step: float) -> None:
    """Two half steps are one step, and the stress never exceeds that of the springs and dashpots alone."""
    law = CellRheology.of(1, three_element(young, first, second, nu))
    whole, half = law.over(step), law.over(0.5 * step)
    assert half.decay**2 == pytest.approx(whole.decay, rel=1e-9, abs=1e-300)
    assert half.decay * half.gain + half.gain == pytest.approx(whole.gain, rel=1e-9)
    assert (whole.effective <= law.dashpot + law.spring * law.viscosity_ratio * step + 1e-9).all()
    assert (whole.effective <= law.series * (1.0 + 1e-9)).all()  # no faster than the series dashpot lets it


@pytest.mark.parametrize("dimension", [1, 2, 3])
def test_kernel_equals_connection_matrices(dimension: int) -> None:
    rng = np.random.default_rng(dimension)
    mesh = {1: interval(3.0, 4), 2: rectangle((3.0, 2.0), (3, 2)), 3: box((3.0, 2.0, 2.0), (2, 2, 1), cell_type="tetra")}[dimension]
    mesh = mesh.moved(0.1 * rng.random(mesh.points.shape))
    body, d = simplices(mesh), dimension
    m, shape = mesh.n_cells, mesh.points.shape
    table = CellRheology.from_arrays(m, rng.uniform(1, 9, m), rng.uniform(0, 3, m), rng.uniform(1, 9, m), 0.3, 0.2, 0.4)
    history = rng.standard_normal(shape)  # of which the internal strain is that of the nodes
    gradient = body.displacement_gradients(history)
    trace, strain = np.einsum("maa->m", gradient), 0.5 * (gradient + np.swapaxes(gradient, 1, 2))
    velocity, step = rng.standard_normal(shape), table.over(0.4)
    force, new_trace, new_strain = advanced(body, step, velocity, trace, strain)
    expected = np.zeros(shape)
    for c, matrices in enumerate(zip(*connection_matrices(body), strict=True)):
        nodes = mesh.cells[c]
        for part, matrix in enumerate(matrices):
            inner = step.decay[c, part] * history[nodes] + step.gain[c, part] * velocity[nodes]
            stress = step.dashpot[c, part] * velocity[nodes] + step.spring[c, part] * inner
            np.add.at(expected, nodes, (matrix @ stress.ravel()).reshape(d + 1, d))
    assert force == pytest.approx(expected, rel=1e-11, abs=1e-11)
    assert stage_forces(body, step, velocity, trace, strain) == pytest.approx(force, abs=1e-12)
    of_end = body.displacement_gradients(history * step.decay[0, 1] + velocity * step.gain[0, 1])[0]
    assert new_strain[0] == pytest.approx(0.5 * (of_end + of_end.T), abs=1e-12)
    assert new_trace[0] == pytest.approx(step.decay[0, 0] * trace[0] + step.gain[0, 0] * np.trace(body.displacement_gradients(velocity)[0]))
    small = 1e-7
    now, trace_rate, strain_rate = rates(body, table.flow(), velocity, trace, strain)
    _, after_trace, after_strain = advanced(body, table.over(small), velocity, trace, strain)
    assert (after_trace - trace) / small == pytest.approx(trace_rate, abs=1e-5)
    assert (after_strain - strain) / small == pytest.approx(strain_rate, abs=1e-5)
    assert stage_forces(body, table.over(1e-12), velocity, trace, strain) == pytest.approx(now, abs=1e-9)


def test_elastic_and_stored_energy_are_those_of_the_stiffness() -> None:
    mesh = box((3.0, 2.0, 2.0), (2, 2, 2), cell_type="tetra")
    body, rng = LinearBody.of(mesh), np.random.default_rng(0)
    u = rng.standard_normal(mesh.points.shape)
    gradient = body.simplices.displacement_gradients(u)
    trace, strain = np.einsum("maa->m", gradient), 0.5 * (gradient + np.swapaxes(gradient, 1, 2))
    law, lame = CellRheology.of(mesh.n_cells, elastic(10.0, 0.4)), lame_parameters(10.0, 0.4)
    still = np.zeros_like(u)
    assert rates(body.simplices, law.flow(), still, trace, strain)[0] == pytest.approx(body.forces(*lame, u), abs=1e-11)
    assert elastic_energy(body.simplices, law, trace, strain) == pytest.approx(0.5 * (u * body.forces(*lame, u)).sum())


def test_regions_have_their_own_materials() -> None:
    mesh = rectangle((2.0, 2.0), (2, 2))
    layered = replace(mesh, regions=(mesh.points[mesh.cells][:, :, 1].mean(axis=1) > 1.0).astype(np.int64), region_names=("low", "high"))
    table = per_region(layered, {"high": maxwell(5.0, 2.0, 0.4), "low": elastic(10.0, 0.2)})
    assert table.elastic[layered.regions == 0] == pytest.approx(np.tile(lame_parameters(10.0, 0.2), (4, 1)))
    assert np.isinf(table.series[layered.regions == 0]).all()
    assert table.series[layered.regions == 1] == pytest.approx(np.tile(lame_parameters(2.0, 0.4), (4, 1)))
    with pytest.raises(InputError, match="regions low, high"):
        per_region(layered, {"high": elastic(1.0, 0.2)})


def test_a_damper_without_lambda_part_carries_no_pressure() -> None:
    """Series dashpot of Poisson ratio 0: its lambda part is nothing, so nothing resists the lambda strain of the spring."""
    law = CellRheology.of(1, maxwell(10.0, 3.0, 0.4, series_poisson_ratio=0.0))
    step = law.over(0.1)
    assert step.effective[0, 0] == 0.0 and step.effective[0, 1] > 0.0
    assert np.isfinite(step.decay).all()


@pytest.mark.parametrize(
    ("values", "what"),
    [
        ((-1.0, 0.0, np.inf, 0.3), "Young's modulus must not be negative"),
        ((np.nan, 0.0, np.inf, 0.3), "young_modulus must be finite"),
        ((1.0, -2.0, np.inf, 0.3), "C1 must not be negative: cell 0 has -2 kPa s"),
        ((1.0, 1.0, -2.0, 0.3), "C2 must be positive"),
        ((1.0, 1.0, 0.0, 0.3), "C2 must be positive"),
        ((1.0, 1.0, np.nan, 0.3), "series_viscosity must be finite"),
        ((1.0, 1.0, 2.0, 0.5), "Poisson's ratio must lie"),
        ((1.0, 1.0, 2.0, -1.0), "Poisson's ratio must lie"),
        ((0.0, 0.0, 2.0, 0.3), "both are zero"),
    ],
)  # fmt: skip
def test_bad_materials_are_named(values: tuple[float, float, float, float], what: str) -> None:
    with pytest.raises(InputError, match=what):
        three_element(*values)


def test_more_bad_input() -> None:
    with pytest.raises(InputError, match="negative Poisson ratio is stable only if all three are equal"):
        voigt(1.0, 1.0, -0.2, voigt_poisson_ratio=0.2)
    with pytest.raises(InputError, match="are for 3 cells, the body has 4"):
        CellRheology.of(4, CellRheology.of(3, elastic(1.0, 0.3)))
    with pytest.raises(InputError, match="one for each of the 4 cells"):
        CellRheology.from_arrays(4, np.ones(3), 0.0, np.inf, 0.3)
    with pytest.raises(InputError, match="length_mm must be positive"):
        interval(0.0, 3)
    with pytest.raises(InputError, match="size_mm and divisions must be positive"):
        rectangle((1.0, np.nan), (2, 2))
    with pytest.raises(InputError, match="other way round"):
        LinearBody.of(Mesh.from_arrays([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], [[0, 2, 1]], "triangle"))


def test_rectangles_fill_their_area() -> None:
    for diagonals in ("alternating", "one_way"):
        mesh = rectangle((3.0, 2.0), (6, 5), diagonals=diagonals)
        assert simplices(mesh).measures.sum() == pytest.approx(6.0)
        assert (mesh.points.min(axis=0), mesh.points.max(axis=0)) == (pytest.approx([-1.5, 0.0]), pytest.approx([1.5, 2.0]))
        edges = np.sort(np.concatenate([mesh.cells[:, [0, 1]], mesh.cells[:, [1, 2]], mesh.cells[:, [2, 0]]]), axis=1)
        counts = np.unique(edges, axis=0, return_counts=True)[1]
        assert counts.max() == 2 and (counts == 1).sum() == 2 * (6 + 5)
