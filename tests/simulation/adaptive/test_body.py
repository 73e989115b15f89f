"""Adaptive finite elements in motion: linear and hyperelastic, explicit and implicit, against each other and conservation laws."""

import numpy as np
import pytest

from naibu.core.errors import ConvergenceError, InputError
from naibu.mechanics.finite_elements.hyperelasticity import material
from naibu.mechanics.finite_strain.viscoelasticity import PronySeries
from naibu.mechanics.small_strain.rheology import elastic, three_element, voigt
from naibu.meshing.primitives import box
from naibu.meshing.refinement.marking import EdgeStretch
from naibu.meshing.structured_2d import rectangle
from naibu.simulation.adaptive.body import AdaptiveBody, BodyState
from naibu.simulation.adaptive.conditions import Conditions, face_force, weight
from naibu.simulation.adaptive.hyperelastic_dynamics import HyperelasticDynamics
from naibu.simulation.adaptive.linear_dynamics import LinearDynamics

E_KPA, NU, DENSITY, SIDE = 50.0, 0.3, 1e-6, 20.0
NEO_HOOKEAN = (material("neo_hookean", young_modulus=E_KPA, poisson_ratio=NU),)
LINEAR = (material("linear_elastic", young_modulus=E_KPA, poisson_ratio=NU),)


def block():
    return box((SIDE, SIDE, SIDE), (2, 2, 2), cell_type="tetra", centred=False)


def at_start(points):
    return points[:, 0] < points[:, 0].min() + 1e-9


def nowhere(points):
    return np.zeros(len(points), dtype=bool)


def pulled(force):
    return Conditions(at_start, loads=(face_force(lambda p: p[:, 0] > SIDE - 1e-9, (0.0, 0.0, force)),))


def some(body, seed=0):
    leaves = body.mesh.leaf.cells
    return np.random.default_rng(seed).choice(leaves, len(leaves) // 4, replace=False)


DYNAMICS = {
    "linear": LinearDynamics(three_element(E_KPA, 0.02, 1.0, NU), DENSITY, 1e-4),
    "linear, explicit": LinearDynamics(elastic(E_KPA, NU), DENSITY, 1e-4, "rk4"),
    "hyperelastic": HyperelasticDynamics(NEO_HOOKEAN, DENSITY, 1e-4, retardation_s=1e-3),
    "hyperelastic, explicit": HyperelasticDynamics(NEO_HOOKEAN, DENSITY, 2e-5, "symplectic_euler", 1e-4),
    "hyperelastic, relaxing": HyperelasticDynamics(NEO_HOOKEAN, DENSITY, 1e-4, relaxation=PronySeries((0.3,), (0.01,))),
}


@pytest.mark.parametrize("name", DYNAMICS)
def test_momentum_of_a_free_body_is_conserved_while_its_mesh_changes(name):
    body = AdaptiveBody.of(block(), DYNAMICS[name], Conditions(nowhere), None)
    velocity = np.random.default_rng(0).normal(scale=300.0, size=body.state.velocity.shape) + 50.0
    body.state = BodyState(0.0, body.state.displacement, velocity, body.state.history)
    momentum = (body.prepared.mass[:, None] * velocity).sum(axis=0)
    for k in range(3):
        body.step(6)
        assert body.change(some(body, k)) if k < 2 else body.change(coarsen=body.mesh.leaf.cells)
    state = body.step(3)
    assert body.adaptations == 3 and state.time == pytest.approx(21 * DYNAMICS[name].step)
    assert (body.prepared.mass[:, None] * state.velocity).sum(axis=0) == pytest.approx(momentum, rel=1e-6)


def test_two_independent_codes_agree_on_a_viscous_linear_body():
    # a Voigt solid: retardation time C1 / E, and the same backward Euler steps, in two assemblies
    one = LinearDynamics(voigt(E_KPA, 0.1, NU), DENSITY, 5e-4, "backward_euler")
    two = HyperelasticDynamics(LINEAR, DENSITY, 5e-4, retardation_s=0.1 / E_KPA)
    ends = []
    for dynamics in (one, two):
        body = AdaptiveBody.of(block(), dynamics, pulled(-300.0), None, max_level=3)
        body.step(10)
        body.change(body.mesh.leaf.cells[::5])
        ends.append(body.step(10).displacement)
    assert np.abs(ends[0]).max() > 0.1
    assert ends[1] == pytest.approx(ends[0], abs=1e-5 * np.abs(ends[0]).max())


def test_neo_hookean_bodies_move_as_linear_ones_at_small_strain():
    ends = []
    for law in (LINEAR, NEO_HOOKEAN):
        body = AdaptiveBody.of(block(), HyperelasticDynamics(law, DENSITY, 5e-4), pulled(-1.0), None)
        ends.append(body.step(20).displacement)
    assert ends[1] == pytest.approx(ends[0], abs=2e-3 * np.abs(ends[0]).max())


def test_explicit_and_implicit_steps_agree():
    ends = []
    for method, step in (("symplectic_euler", 2e-5), ("backward_euler", 2e-5)):
        dynamics = HyperelasticDynamics(NEO_HOOKEAN, DENSITY, step, method, 1e-3)
        body = AdaptiveBody.of(block(), dynamics, pulled(-600.0), EdgeStretch(1.01, 1.005), max_level=2, interval=40)
        state = body.step(160)
        ends.append(state.displacement[np.argmax(body.mesh.leaf.mesh.points.sum(axis=1))])
        assert body.adaptations
    assert ends[1] == pytest.approx(ends[0], abs=0.01 * np.abs(ends[0]).max())


def test_energy_of_explicit_steps_is_kept_without_viscosity():
    dynamics = HyperelasticDynamics(NEO_HOOKEAN, DENSITY, 1e-5, "symplectic_euler")
    body = AdaptiveBody.of(block(), dynamics, Conditions(at_start), None)
    velocity = np.where(at_start(body.mesh.leaf.mesh.points)[:, None], 0.0, [0.0, 0.0, 200.0])
    body.state = BodyState(0.0, body.state.displacement, velocity, body.state.history)
    before = body.prepared.energy(body.state)
    body.step(300)
    assert body.prepared.energy(body.state) == pytest.approx(before, rel=0.01)


def test_relaxed_bodies_creep_to_the_long_term_modulus():
    ends = []
    for relaxation in (None, PronySeries((0.4,), (0.01,))):
        dynamics = HyperelasticDynamics(NEO_HOOKEAN, DENSITY, 0.02, relaxation=relaxation)
        body = AdaptiveBody.of(block(), dynamics, pulled(-5.0), None)
        body.step(8)
        body.change(body.mesh.leaf.cells[::7])
        while body.change(coarsen=body.mesh.leaf.cells):
            pass
        ends.append(body.step(60).displacement)
    assert ends[1] == pytest.approx(ends[0] / 0.6, abs=5e-3 * np.abs(ends[1]).max())


def test_plane_bodies_adapt_too():
    load = weight((0.0, -300.0))
    body = AdaptiveBody.of(
        rectangle((40, 10), (8, 2)), LinearDynamics(voigt(5.0, 0.05, NU), DENSITY, 1e-2), Conditions(at_start, loads=(load,)),
        EdgeStretch(1.01, 1.002), max_level=4, bisections=2, interval=10,
    )  # fmt: skip
    state = body.step(60)
    assert body.mesh.leaf.mesh.n_points > 27 and state.displacement[:, 1].min() < -0.5
    levels = body.mesh.forest.levels[body.mesh.leaf.cells]
    clamped = (
        body.mesh.leaf.mesh.points[body.mesh.leaf.mesh.cells][:, :, 0].mean(axis=1) < 0.25 * 40 + body.mesh.leaf.mesh.points[:, 0].min()
    )
    assert levels[clamped].mean() > levels[~clamped].mean()
    body.constrain(Conditions(at_start))
    body.step(400)
    assert body.mesh.leaf.mesh.n_points == 27


def test_what_cannot_be_is_refused():
    dynamics = DYNAMICS["hyperelastic"]
    with pytest.raises(InputError, match="moved"):
        AdaptiveBody.of(block(), dynamics, Conditions(at_start, (nowhere,)), None)
    with pytest.raises(InputError, match="interval"):
        AdaptiveBody.of(block(), dynamics, Conditions(at_start), None, interval=0)
    with pytest.raises(InputError, match="tetrahedra"):
        AdaptiveBody.of(rectangle((1, 1), (1, 1)), dynamics, Conditions(at_start), None)
    for wrong in ({"density": 0.0}, {"step": -1.0}, {"method": "rk4"}, {"retardation_s": -1.0}):
        with pytest.raises(InputError):
            HyperelasticDynamics(**({"materials": NEO_HOOKEAN, "density": DENSITY, "step": 1e-3} | wrong))
    body = AdaptiveBody.of(block(), dynamics, Conditions(at_start), None)
    with pytest.raises(InputError, match="at least 1"):
        body.step(0)
    with pytest.raises(InputError, match="moved"):
        body.constrain(Conditions(at_start, (nowhere,)))
    too_long = HyperelasticDynamics(NEO_HOOKEAN, DENSITY, 5e-2, "symplectic_euler")
    with pytest.raises(ConvergenceError, match="shorter"):
        AdaptiveBody.of(block(), too_long, pulled(-600.0), None).step(50)
