"""Relaxing stress against convolutions written out, closed forms of the generalized Maxwell solid, limits, rotations, derivatives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from builders import KINDS, assembler, distorted, of, problem, relative
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from naibu.core.errors import ConvergenceError, InputError
from naibu.core.status import Status
from naibu.mechanics.contact.contact_surfaces import Friction, rigid_contact
from naibu.mechanics.contact.indenter_geometry import plane_geometry
from naibu.mechanics.finite_elements import stress_history
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.mechanics.finite_elements.hyperelasticity import LAWS, Material, from_moduli
from naibu.mechanics.finite_elements.stress_history import HistoryAssembler, second_piola
from naibu.mechanics.finite_strain.statics import solve
from naibu.mechanics.finite_strain.viscoelasticity import ELASTIC, PronySeries, ViscoelasticBody, simulate_viscoelastic
from naibu.meshing.primitives import box
from naibu.meshing.surface import faces_towards
from naibu.validation.analytic.finite_strain import first_piola, uniaxial

SERIES = PronySeries((0.3, 0.25), (0.4, 3.0))
SPLIT = ("neo_hookean_isochoric", "mooney_rivlin", "yeoh")
UNIAXIAL, SHEAR = np.diag([1.1, 1.08, 0.8]), np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
SIDE = 10.0
CUBE = box((SIDE,) * 3, (1, 1, 1))


def affine(f, points=CUBE.points) -> np.ndarray:
    return points @ (np.asarray(f) - np.eye(3)).T


def stress_of_forces(force, points=CUBE.points) -> np.ndarray:
    """First Piola-Kirchhoff stress of a uniformly strained cube: the moment of its nodal forces over its volume."""
    return force.T @ points / SIDE**3


def parts(m: Material, f) -> tuple[np.ndarray, np.ndarray]:
    """Isochoric and volumetric second Piola-Kirchhoff stress of a split law, written out."""
    j = np.linalg.det(f)
    inverse = np.linalg.inv(f)
    volumetric = 0.5 * m.parameters[-1] * (j * j - 1.0) * inverse @ inverse.T
    return inverse @ first_piola(m, f) - volumetric, volumetric


def followed(body: ViscoelasticBody, path, times):
    """Nodal forces (k, n, 3) along displacements (k, n, 3) at times (k,), loaded at once at the first."""
    history, before, out = body.at_rest(), times[0], []
    for u, t in zip(path, times, strict=True):
        out.append(body.step(history, t - before).forces(u)[1])
        history, before = body.updated(history, u, t - before), t
    return np.array(out), history


@pytest.mark.parametrize("law", SPLIT)
@pytest.mark.parametrize("f", [UNIAXIAL, SHEAR, UNIAXIAL @ SHEAR], ids=["uniaxial", "shear", "both"])
def test_isochoric_stress_relaxes_exactly_after_a_jump(law, f):
    """However long the steps: the recurrence is exact where the strain does not change."""
    m = of(law, 0.45)
    times = np.array([0.0, 0.05, 0.3, 2.0, 2.5, 40.0])
    forces, _ = followed(ViscoelasticBody.of(assembler(CUBE, m), SERIES), [affine(f)] * len(times), times)
    isochoric, volumetric = parts(m, f)
    for force, g in zip(forces, SERIES.relaxation(times), strict=True):
        assert np.linalg.inv(f) @ stress_of_forces(force) == pytest.approx(volumetric + g * isochoric, rel=1e-10, abs=1e-10)


@pytest.mark.parametrize("law", [law for law in LAWS if law != "linear_elastic"])
def test_whole_stress_relaxes_exactly_after_a_jump(law):
    m, f, times = of(law, 0.4), UNIAXIAL @ SHEAR, np.array([1.0, 1.2, 9.0])
    forces, _ = followed(ViscoelasticBody.of(assembler(CUBE, m), SERIES, relaxing="all"), [affine(f)] * 3, times)
    for force, g in zip(forces, SERIES.relaxation(times - 1.0), strict=True):
        assert stress_of_forces(force) == pytest.approx(g * first_piola(m, f), rel=1e-10, abs=1e-10)


def motion(t: float) -> np.ndarray:
    """A smooth strain path with shear, pressure and rotation."""
    stretch = np.eye(3) + np.sin(t) * np.array([[0.2, 0.25, 0.0], [0.05, -0.15, 0.1], [0.0, -0.1, -0.1]])
    return Rotation.from_rotvec([0.3 * t, 0.2 * t * t, -0.4 * t]).as_matrix() @ stretch


def convolved(m: Material, end: float, n: int = 4000) -> np.ndarray:
    """P at `end` from the convolution of the isochoric stress, integrated by parts over fine midpoints."""
    times = (np.arange(n) + 0.5) * end / n
    past = np.array([parts(m, motion(t))[0] for t in times])
    rate = -sum((g / tau * np.exp(-(end - times) / tau))[:, None, None] * past for g, tau in zip(SERIES.weights, SERIES.times, strict=True))
    isochoric, volumetric = parts(m, motion(end))
    return motion(end) @ (volumetric + isochoric + rate.sum(axis=0) * end / n)


def test_any_path_converges_to_the_convolution_with_second_order():
    m, end = of("mooney_rivlin", 0.45), 1.5
    exact = convolved(m, end)
    body = ViscoelasticBody.of(assembler(CUBE, m), SERIES)
    errors = []
    for n in (8, 16, 32):
        times = np.linspace(0.0, end, n + 1)
        forces, _ = followed(body, [affine(motion(t)) for t in times], times)
        errors.append(np.abs(stress_of_forces(forces[-1]) - exact).max() / np.abs(exact).max())
    assert errors[-1] < 4e-5
    assert 3.6 < errors[0] / errors[1] < 4.4
    assert 3.6 < errors[1] / errors[2] < 4.4


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(KINDS), st.sampled_from(SPLIT))
def test_a_rotation_on_top_turns_the_forces_and_leaves_the_memory(seed, kind, law):
    rng = np.random.default_rng(seed)
    mesh = distorted(kind, divisions=2)
    body = ViscoelasticBody.of(assembler(mesh, of(law, 0.48)), SERIES)
    times = np.cumsum(rng.uniform(0.0, 1.0, 4))
    path = rng.uniform(-0.25, 0.25, (4, *mesh.points.shape))
    turns = Rotation.random(4, random_state=seed % 2**31).as_matrix()
    turned = [(mesh.points + u) @ q.T - mesh.points for u, q in zip(path, turns, strict=True)]
    forces, history = followed(body, path, times)
    after, same = followed(body, turned, times)
    assert relative(after, np.einsum("kij,knj->kni", turns, forces)) < 1e-9
    assert relative(same.branches, history.branches) < 1e-9


@pytest.mark.parametrize("formulation", ["mean_dilatation", "standard"])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("law", SPLIT)
def test_tangent_of_a_step_is_the_derivative_of_its_forces(law, kind, formulation):
    mesh = distorted(kind, divisions=2)
    body = ViscoelasticBody.of(assembler(mesh, of(law, 0.48), formulation=formulation), SERIES)
    rng = np.random.default_rng(5)
    _, history = followed(body, rng.uniform(-0.3, 0.3, (3, *mesh.points.shape)), np.array([0.0, 0.3, 1.0]))
    step = body.step(history, 0.2)
    u, direction = rng.uniform(-0.3, 0.3, mesh.points.shape), rng.normal(size=mesh.points.shape)
    energy, force, blocks, smallest = step.evaluate(u)
    assert smallest > 0.0
    matrix = step.pattern.matrix(blocks)
    forward, backward = (step.forces(u + h * direction) for h in (1e-6, -1e-6))
    assert relative((matrix @ direction.ravel()).reshape(-1, 3), (forward[1] - backward[1]) / 2e-6) < 1e-6
    assert (forward[0] - backward[0]) / 2e-6 == pytest.approx((force * direction).sum(), rel=1e-6)
    assert abs(matrix - matrix.T).max() < 1e-10 * abs(matrix).max()
    assert energy == step.forces(u)[0]


def test_threads_give_what_one_gives(monkeypatch):
    mesh = distorted("hexahedron")
    body = ViscoelasticBody.of(assembler(mesh, of("yeoh", 0.48)), SERIES)
    path = np.random.default_rng(2).uniform(-0.4, 0.4, (2, *mesh.points.shape))
    alone, history = followed(body, path, np.array([0.0, 0.5]))
    blocks = body.step(history, 0.1).evaluate(path[0])[2]
    monkeypatch.setattr(stress_history, "LARGE", 0)
    together, same = followed(body, path, np.array([0.0, 0.5]))
    assert relative(together, alone) < 1e-12
    assert relative(same.branches, history.branches) < 1e-12
    assert relative(body.step(history, 0.1).evaluate(path[0])[2], blocks) < 1e-12


def test_derivatives_by_parameters_leave_the_history_out():
    mesh = distorted("tetra")
    body = assembler(mesh, of("yeoh", 0.48))
    history = np.random.default_rng(1).normal(size=(*body.elements.weights.shape, 3, 3))
    carrying = HistoryAssembler.of(body, history + history.transpose(0, 1, 3, 2))
    u, direction = np.random.default_rng(2).uniform(-0.4, 0.4, mesh.points.shape), np.ones_like(body.parameters)
    assert (carrying.forces_of_parameter(u, direction) == body.forces_of_parameter(u, direction)).all()
    assert relative(carrying.forces(u)[1], body.forces(u)[1]) > 1e-3


def test_stress_at_the_points_is_that_of_the_law():
    m, f = of("yeoh", 0.48), UNIAXIAL @ SHEAR
    mesh = distorted("tetra10")
    body = assembler(mesh, m)
    found = second_piola(body, body.parameters, affine(f, mesh.points))
    expected = np.broadcast_to(np.linalg.inv(f) @ first_piola(m, f), found.shape)
    assert relative(found, expected) < 1e-9


def ramped(t, weights_times=SERIES) -> np.ndarray:
    """Integral of g from 0 to t: the stress of a strain that grows by 1 a second, over the modulus."""
    terms = [g * (t - tau * -np.expm1(-t / tau)) for g, tau in zip(weights_times.weights, weights_times.times, strict=True)]
    return t - sum(terms)


def bar(m: Material, value=None, force: float = 0.0, divisions=(1, 1, 2)):
    """A cube on a frictionless floor, its free sides constrained against rotation; the top is moved by `value`, or pulled by `force` mN."""
    mesh = box((SIDE,) * 3, divisions, centred=False)
    x = mesh.points
    constrained = PrescribedDisplacement.none(len(x))
    for axis in range(3):
        only = tuple(k == axis for k in range(3))
        constrained = constrained.and_also(np.flatnonzero(x[:, axis] < 1e-9), (0, 0, 0), only)
    top = np.flatnonzero(x[:, 2] > SIDE - 1e-9)
    if value is not None:
        constrained = constrained.and_also(top, (0, 0, value), (False, False, True))
    nodal = np.zeros_like(x)
    nodal[top, 2] = force / len(top)
    return problem(mesh, m, prescribed=constrained, force=nodal), top


def test_slow_and_fast_ramps_are_the_maxwell_solids_of_small_strain():
    """Uniaxial, whole stress relaxing: sigma = E rate (integral of g)."""
    m, strain = of("neo_hookean", 0.4), 1e-5
    for duration in (0.1, 2.0, 50.0):
        p, top = bar(m, strain * SIDE)
        times = np.linspace(0.0, duration, 5)
        found = simulate_viscoelastic(p, SERIES, times=times, loads=times / duration, relaxing="all")
        stress = [s.internal_force[top, 2].sum() / SIDE**2 for s in found.steps]
        expected = m.young_modulus * strain / duration * ramped(times)
        assert stress == pytest.approx(expected, rel=1e-4, abs=1e-9)


def test_shear_of_a_nearly_incompressible_solid_is_the_maxwell_solids():
    m, rate = of("mooney_rivlin", 0.499), 1e-5
    times = np.linspace(0.0, 4.0, 9)
    body = ViscoelasticBody.of(assembler(CUBE, m), SERIES)
    path = [affine(np.eye(3) + rate * t * np.outer([1, 0, 0], [0, 1, 0])) for t in times]
    forces, _ = followed(body, path, times)
    found = [stress_of_forces(force)[0, 1] for force in forces]
    assert found == pytest.approx(m.small_strain_shear_modulus * rate * ramped(times), rel=1e-4)


def test_creep_is_the_standard_solids_and_converges_with_second_order():
    """Under a constant force strain grows with the retardation time tau / g_inf."""
    m, one, pull = of("neo_hookean", 0.4), PronySeries((0.6,), (2.0,)), 0.002
    errors = []
    for n in (8, 16, 32):
        times = np.linspace(0.0, 6.0, n + 1)
        p, top = bar(m, force=pull)
        found = simulate_viscoelastic(p, one, times=times, loads=np.zeros_like(times), relaxing="all")
        strain = found.displacement[:, top, 2].mean(axis=1) / SIDE
        elastic = pull / SIDE**2 / m.young_modulus
        expected = elastic / 0.4 * (1.0 - 0.6 * np.exp(-0.4 * times / 2.0))
        errors.append(np.abs(strain / expected - 1.0).max())
    assert errors[-1] < 1e-4
    assert 3.5 < errors[0] / errors[1] < 4.5
    assert 3.5 < errors[1] / errors[2] < 4.5


def squeezed(m: Material, divisions=(3, 3, 3)):
    """A block pressed by 25 % between plates that hold it: the strain is far from uniform."""
    mesh = box((SIDE,) * 3, divisions)
    z = mesh.points[:, 2]
    constrained = PrescribedDisplacement.none(mesh.n_points).and_also(np.flatnonzero(z < 1e-9), (0, 0, 0))
    top = np.flatnonzero(z > SIDE - 1e-9)
    return problem(mesh, m, prescribed=constrained.and_also(top, (0.3, 0, -2.5))), top


def scaled(m: Material, factor: float) -> Material:
    """The law with its isochoric parameters scaled."""
    return from_moduli(m.law, factor * m.small_strain_shear_modulus, m.small_strain_bulk_modulus, (0.3,))


def test_at_once_and_at_last_the_body_is_elastic():
    m = of("mooney_rivlin", 0.47)
    p, top = squeezed(m)
    found = simulate_viscoelastic(p, SERIES, times=[0.0, 1e-6, 300.0, 600.0], loads=[1, 1, 1, 1])
    for k, factor in ((0, 1.0), (1, 1.0), (3, SERIES.long_term)):
        elastic, _ = squeezed(scaled(m, factor))
        end = solve(elastic)
        assert relative(found.steps[k].solution.displacement, end.displacement) < 1e-5
        force = elastic.assembler.forces(end.displacement)[1][top].sum(axis=0)
        assert found.steps[k].internal_force[top].sum(axis=0) == pytest.approx(force, rel=1e-5)


def test_whole_stress_of_a_body_that_is_held_relaxes_without_motion():
    p, top = squeezed(of("neo_hookean", 0.47))
    times = np.array([0.0, 0.2, 1.0, 5.0])
    found = simulate_viscoelastic(p, SERIES, times=times, loads=np.ones(4), relaxing="all")
    force = np.array([s.internal_force[top].sum(axis=0) for s in found.steps])
    assert force == pytest.approx(SERIES.relaxation(times)[:, None] * force[0], rel=1e-6, abs=1e-6 * np.abs(force).max())
    assert found.displacement == pytest.approx(np.broadcast_to(found.displacement[0], found.displacement.shape), abs=1e-6)


def test_unloaded_body_returns_to_its_shape():
    p, _ = squeezed(of("yeoh", 0.47))
    times = [0.0, 1.0, 1.5, 5.0, 60.0, 200.0]
    found = simulate_viscoelastic(p, SERIES, times=times, loads=[0, 1, 1, 0, 0, 0])
    size = [np.abs(u).max() for u in found.displacement]
    assert size[1] > 1.0
    assert 1e-3 < size[3] < 0.5  # free of load, not yet of history
    assert size[5] < 1e-5


@settings(max_examples=20, deadline=None)
@given(st.floats(0.02, 0.35), st.floats(0.1, 20.0), st.sampled_from(SPLIT), st.booleans())
def test_a_closed_cycle_dissipates(amplitude, period, law, sheared):
    """Work over a cycle that starts from rest, ends at the first shape, and waits there until all is relaxed."""
    m = of(law, 0.45)
    body = ViscoelasticBody.of(assembler(CUBE, m), SERIES)
    phase = np.linspace(0.0, 1.0, 161)
    shape = np.outer([1.0, 0, 0], [0, 1.0, 0]) if sheared else np.diag([-0.5, -0.5, 1.0])
    path = np.array([affine(np.eye(3) + amplitude * np.sin(2 * np.pi * p) * shape) for p in phase])
    forces, _ = followed(body, path, phase * period)
    work = (0.5 * (forces[1:] + forces[:-1]) * np.diff(path, axis=0)).sum()
    assert work > 0.0


def test_loss_of_a_small_oscillation_is_that_of_the_loss_modulus():
    """Once settled, a cycle of shear gamma dissipates pi G'' gamma^2 a volume; G'' = mu sum g w tau / (1 + w^2 tau^2)."""
    m, gamma, frequency = of("mooney_rivlin", 0.499), 1e-4, 0.7
    body = ViscoelasticBody.of(assembler(CUBE, m), SERIES)
    w, n = 2 * np.pi * frequency, 200
    times = np.arange(20 * n + 1) / (n * frequency)
    path = np.array([affine(np.eye(3) + gamma * np.sin(w * t) * np.outer([1, 0, 0], [0, 1, 0])) for t in times])
    forces, _ = followed(body, path, times)
    work = (0.5 * (forces[-n:] + forces[-n - 1 : -1]) * np.diff(path, axis=0)[-n:]).sum() / SIDE**3
    loss = m.small_strain_shear_modulus * sum(
        g * w * tau / (1 + (w * tau) ** 2) for g, tau in zip(SERIES.weights, SERIES.times, strict=True)
    )
    assert work == pytest.approx(np.pi * loss * gamma**2, rel=2e-3)


def test_each_region_relaxes_by_its_own_series():
    """Two layers of Poisson's ratio 0, one on the other, carry the same force; the elastic one expands when the other relaxes."""
    m = from_moduli(LAWS["neo_hookean"], 10.0, 20.0 / 3.0)
    mesh = box((SIDE,) * 3, (1, 1, 2), layers=[("soft", 5.0), ("firm", 5.0)], centred=False)
    p, top = bar(m, -1e-4)
    p = problem(mesh, m, m, prescribed=p.prescribed)
    times = [0.0, 200.0, 400.0]
    found = simulate_viscoelastic(p, [SERIES, ELASTIC], times=times, loads=[1, 1, 1], regions=mesh.regions, relaxing="all")
    middle = np.abs(mesh.points[:, 2] - 5.0) < 1e-9
    at_once, at_last = (found.displacement[k, middle, 2].mean() for k in (0, -1))
    fraction = SERIES.long_term
    assert at_once == pytest.approx(-0.5e-4, rel=1e-4)
    assert at_last == pytest.approx(-1e-4 / (1.0 + fraction), rel=1e-4)
    force = [s.internal_force[top, 2].sum() for s in found.steps]
    assert force[-1] / force[0] == pytest.approx(2.0 * fraction / (1.0 + fraction), rel=1e-4)


def test_a_plate_feels_the_body_relax():
    """Contact without friction on the whole top: uniaxial compression whose force falls to that of the long-term law."""
    m = of("neo_hookean_isochoric", 0.45)
    p, _ = bar(m)
    mesh = box((SIDE,) * 3, (1, 1, 2), centred=False)
    faces = faces_towards(mesh, (0, 0, 1))
    plate = rigid_contact(
        "plate", mesh.points, faces, plane_geometry((0, 0, -1)), start=(0, 0, SIDE), stop=(0, 0, 0.8 * SIDE),
        friction=Friction(0.0), normal_stiffness=1e6,
    )  # fmt: skip
    p = problem(mesh, m, contacts=[plate], prescribed=p.prescribed)
    found = simulate_viscoelastic(p, SERIES, times=[0.0, 1.0, 100.0, 300.0], loads=[0, 1, 1, 1])
    force = found.reaction("plate")[:, 2]
    long_term = from_moduli(m.law, SERIES.long_term * m.parameters[0], m.parameters[1])
    elastic = solve(problem(mesh, long_term, contacts=[plate], prescribed=p.prescribed))
    assert force[0] == pytest.approx(0.0, abs=1e-9)
    assert force[-1] == pytest.approx(elastic.reactions["plate"][2], rel=1e-6)
    assert force[-1] == pytest.approx(uniaxial(long_term, 0.8).nominal_stress[2] * SIDE**2, rel=3e-4)  # the plate yields a little
    assert force[1] < 1.2 * force[-1] < 0.0


def test_a_jump_too_large_for_newton_is_divided_and_changes_nothing():
    m = of("neo_hookean_isochoric", 0.49)
    p, _ = squeezed(m)
    p = replace(p, prescribed=replace(p.prescribed, values=2.2 * p.prescribed.values))
    at_once = simulate_viscoelastic(p, SERIES, times=[0.0, 0.0], loads=[0, 1])
    slowly = simulate_viscoelastic(p, SERIES, times=np.zeros(12), loads=np.linspace(0, 1, 12))
    assert relative(at_once.displacement[-1], slowly.displacement[-1]) < 1e-5
    assert relative(at_once.history.branches, slowly.history.branches) < 1e-4


def test_a_body_that_cannot_follow_is_told():
    p, _ = squeezed(of("neo_hookean_isochoric", 0.49), (2, 2, 2))
    p = replace(p, prescribed=replace(p.prescribed, values=4.4 * p.prescribed.values))  # beyond the floor
    with pytest.raises(ConvergenceError, match="stopped between 1 and 2 s"):
        simulate_viscoelastic(p, SERIES, times=[0.0, 1.0, 2.0], loads=[0, 0.2, 1])
    found = simulate_viscoelastic(p, SERIES, times=[0.0, 1.0, 2.0], loads=[0, 0.2, 1], throw=False)
    assert found.status is Status.STEP_TOO_SMALL
    assert found.times.tolist() == [0.0, 1.0]


@given(st.floats(0.0, 1e3))
def test_series_relaxes_from_one_to_its_rest(t):
    assert SERIES.relaxation(0.0) == 1.0
    assert SERIES.relaxation(1e6) == pytest.approx(SERIES.long_term)
    expected = 1.0 - sum(g * (1.0 - np.exp(-t / tau)) for g, tau in zip(SERIES.weights, SERIES.times, strict=True))
    assert SERIES.relaxation(t) == pytest.approx(expected, rel=1e-12)
    assert ELASTIC.relaxation(t) == 1.0


@pytest.mark.parametrize(
    ("weights", "times", "message"),
    [
        ((0.5,), (1.0, 2.0), "one time for each weight"),
        ((0.5, 0.5), (1.0, 2.0), "sum below 1"),
        ((-0.1,), (1.0,), ">= 0"),
        ((np.nan,), (1.0,), ">= 0"),
        ((0.5,), (0.0,), "must be positive"),
        ((0.5,), (np.inf,), "must be positive"),
    ],
)
def test_impossible_series_are_refused(weights, times, message):
    with pytest.raises(InputError, match=message):
        PronySeries(weights, times)


@pytest.mark.parametrize(
    ("law", "options", "message"),
    [
        ("neo_hookean", {}, "'neo_hookean' is not split .* relaxing='all'"),
        ("saint_venant_kirchhoff", {}, "is not split"),
        ("linear_elastic", {"relaxing": "all"}, "is not objective"),
        ("yeoh", {"relaxing": "shear"}, "'shear' is not known"),
        ("yeoh", {"times": [0.0, -1.0]}, "-1 s follows 0 s"),
        ("yeoh", {"times": [0.0]}, "one shape"),
        ("yeoh", {"times": [0.0, np.inf]}, "finite"),
        ("yeoh", {"series": [SERIES, SERIES]}, "2 Prony series need the region"),
        ("yeoh", {"series": [SERIES], "regions": np.full(27, 1)}, "1 Prony series need the region"),
    ],
)
def test_what_cannot_relax_is_refused(law, options, message):
    p, _ = squeezed(of(law))
    options = {"series": SERIES, "times": [0.0, 1.0], "loads": [0.0, 1.0]} | options
    with pytest.raises(InputError, match=message):
        simulate_viscoelastic(p, **options)


def test_unknown_reaction_lists_those_there_are():
    p, _ = bar(of("yeoh"), 0.1)
    found = simulate_viscoelastic(p, SERIES, times=[0.0], loads=[1.0])
    with pytest.raises(InputError, match="'floor'; there are prescribed"):
        found.reaction("floor")
