"""Adaptive bodies that are cut while they move: conservation, loose pieces, adaptation behind the cut, and refusals."""

from __future__ import annotations

import functools
import operator

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.mechanics.finite_elements.hyperelasticity import material
from naibu.mechanics.finite_strain.viscoelasticity import PronySeries
from naibu.mechanics.lattices.model.state import LatticeState
from naibu.mechanics.small_strain.rheology import three_element
from naibu.meshing import EdgeStretch, box, forest_pieces, rectangle, signed_volumes, swept_blade
from naibu.meshing.cutting.swept_blade import SweptBlade
from naibu.simulation import (
    AdaptiveBody,
    AdaptiveLattice,
    Conditions,
    HyperelasticDynamics,
    LinearDynamics,
    SpringMaterial,
    weight,
)
from naibu.simulation.adaptive.body import BodyState

E_KPA, NU, DENSITY, SIDE = 50.0, 0.3, 1e-6, 20.0
LAW = (material("neo_hookean", young_modulus=E_KPA, poisson_ratio=NU),)
DYNAMICS = {
    "linear": LinearDynamics(three_element(E_KPA, 0.02, 1.0, NU), DENSITY, 1e-4),
    "hyperelastic": HyperelasticDynamics(LAW, DENSITY, 1e-4, retardation_s=1e-3),
    "hyperelastic, relaxing": HyperelasticDynamics(LAW, DENSITY, 1e-4, relaxation=PronySeries((0.3,), (0.01,))),
}


def block(n=4):
    return box((SIDE, SIDE, SIDE), (n, n, n), cell_type="tetra", centred=False)


def nowhere(points):
    return np.zeros(len(points), dtype=bool)


def upright(x: float, until_y: float = 30.0) -> SweptBlade:
    return swept_blade([[[x, y, -10.0], [x, y, 30.0]] for y in (-10.0, until_y)])


@pytest.mark.parametrize("name", DYNAMICS)
@pytest.mark.parametrize("x", [10.0, 11.3])
def test_momentum_mass_and_strain_history_pass_through_a_cut(name: str, x: float) -> None:
    body = AdaptiveBody.of(block(2), DYNAMICS[name], Conditions(nowhere), EdgeStretch(1.02, 1.005), max_level=9, interval=5)
    velocity = np.random.default_rng(0).normal(scale=300.0, size=body.state.velocity.shape) + 50.0
    body.state = BodyState(0.0, body.state.displacement, velocity, body.state.history)
    momentum, mass = (body.prepared.mass[:, None] * velocity).sum(axis=0), body.prepared.mass.sum()
    body.step(12)
    found = body.cut(upright(x), 6.0)
    assert len(found.faces) and len(found.copies)
    assert body.prepared.mass.sum() == pytest.approx(mass, rel=1e-12)
    assert (body.prepared.mass[:, None] * body.state.velocity).sum(axis=0) == pytest.approx(momentum, rel=1e-6)
    leaves = body.mesh.leaf.cells
    assert body.change(leaves[::4])
    assert body.change(coarsen=body.mesh.leaf.cells)
    body.step(12)
    assert (body.prepared.mass[:, None] * body.state.velocity).sum(axis=0) == pytest.approx(momentum, rel=1e-6)


def test_energy_is_kept_by_a_cut_between_cells_and_by_the_motion_behind_it() -> None:
    body = AdaptiveBody.of(block(), HyperelasticDynamics(LAW, DENSITY, 1e-5, "symplectic_euler"), Conditions(nowhere), None)
    points = body.mesh.leaf.mesh.points
    stretched = BodyState(0.0, points * [0.1, -0.03, -0.03], points[:, ::-1] * 20.0, body.state.history)
    body.state = stretched
    energy = body.prepared.energy(body.state)
    body.cut(upright(10.0, 8.0), 6.0)  # along faces of the mesh: nothing is refined
    assert body.prepared.energy(body.state) == pytest.approx(energy, rel=1e-12)
    opened = body.step(300)
    assert body.prepared.energy(opened) == pytest.approx(energy, rel=0.01)  # of symplectic Euler steps
    assert np.abs(opened.displacement - body.prepared.at_rest().displacement).max() > 1.0


def test_refinement_by_a_cut_keeps_the_energy_of_linear_fields_and_the_kinetic_one_of_consistent_masses() -> None:
    body = AdaptiveBody.of(block(2), HyperelasticDynamics(LAW, DENSITY, 1e-4), Conditions(nowhere), None)
    points = body.mesh.leaf.mesh.points
    body.state = BodyState(0.0, 0.05 * points[:, ::-1], np.random.default_rng(1).normal(size=points.shape), body.state.history)

    def energies() -> tuple[float, float]:
        cells, mass = body.mesh.leaf.mesh.cells, body.prepared.cell_mass
        v = body.state.velocity[cells]
        kinetic = (mass / 40.0 * ((v**2).sum(axis=(1, 2)) + (v.sum(axis=1) ** 2).sum(axis=1))).sum()
        return body.prepared.assembler.forces(body.state.displacement)[0], kinetic

    before = energies()
    assert body.cut(upright(11.3), 2.0).changes
    assert energies() == pytest.approx(before, rel=1e-10)


def test_a_loose_piece_falls_as_a_body_of_its_own() -> None:
    gravity = np.array([9800.0, 0.0, 0.0])  # away from the rest, which it would touch otherwise
    held = Conditions(lambda p: p[:, 0] < 1e-9, loads=(weight(gravity),))
    body = AdaptiveBody.of(block(2), HyperelasticDynamics(LAW, DENSITY, 5e-4), held, EdgeStretch(), interval=10)
    body.cut(upright(9.4), 5.0)
    state = body.step(40)
    mesh = body.mesh.leaf.mesh
    loose = mesh.points[:, 0] > 15.0
    time = 40 * 5e-4
    fall = 0.5 * gravity[0] * time * (time + 5e-4)  # of implicit Euler steps
    np.testing.assert_allclose(state.displacement[loose], np.tile([fall, 0.0, 0.0], (int(loose.sum()), 1)), atol=1e-6 * abs(fall))
    assert np.abs(state.displacement[mesh.points[:, 0] < 1e-9]).max() == 0.0


def test_a_blade_that_goes_on_while_the_body_swings_parts_it() -> None:
    body = AdaptiveBody.of(block(2), DYNAMICS["hyperelastic"], Conditions(nowhere), EdgeStretch(1.02, 1.005), max_level=6, interval=3)
    points = body.mesh.leaf.mesh.points
    body.state = BodyState(0.0, points * [0.06, 0.0, 0.0], np.tile([0.0, 200.0, 0.0], (len(points), 1)), body.state.history)
    poses, strips = [[[10.9, y, -5.0], [10.9, y, 30.0]] for y in np.linspace(-3.0, 27.0, 16)], []
    for k in range(15):
        body.step(3)
        swept = swept_blade(poses[max(0, k - 1) : k + 2])  # from one pose before the last, as the body has moved since
        body.cut(swept, 4.0, earlier=functools.reduce(operator.add, strips[-6:]) if strips else None)
        strips.append(swept)
    piece = forest_pieces(body.mesh.forest)
    volumes = np.bincount(piece, signed_volumes(body.mesh.leaf.mesh))
    assert len(volumes) == 2
    assert volumes.sum() == pytest.approx(SIDE**3, rel=1e-12)
    assert volumes.min() > 0.4 * SIDE**3
    assert body.adaptations > 15


def test_adaptive_lattices_are_cut_while_they_move() -> None:
    material = SpringMaterial(E_KPA, DENSITY, series_damping=5.0)
    lattice = AdaptiveLattice.of(block(2), material, Conditions(nowhere), EdgeStretch(1.02, 1.005), interval=5, step=1e-3)
    state = lattice.state()
    velocity = np.random.default_rng(0).normal(scale=100.0, size=state.velocity.shape) + 50.0
    lattice.restore(LatticeState(state.position, velocity, state.extension))
    mass, stiffness = lattice.lattice.total_mass, lattice.springs.parameters.stiffness.sum()
    momentum = (lattice.lattice.node_mass[:, None] * velocity).sum(axis=0)
    energy = lattice.session.engine.energy(lattice.state())
    found = lattice.cut(upright(10.0), 6.0)  # along faces
    assert not found.changes
    assert lattice.lattice.total_mass == pytest.approx(mass, rel=1e-12)
    assert lattice.springs.parameters.stiffness.sum() == pytest.approx(stiffness, rel=1e-12)
    assert lattice.session.engine.energy(lattice.state()) == pytest.approx(energy, rel=1e-9)
    lattice.step(steps=12)
    assert lattice.cut(upright(13.0, 14.0), 4.0).changes
    lattice.step(steps=12)
    behind = lattice.state()
    assert (lattice.lattice.node_mass[:, None] * behind.velocity).sum(axis=0) == pytest.approx(momentum, rel=1e-3)
    lattice.close()


def test_what_cannot_be_cut_leaves_the_body_as_it_was() -> None:
    body = AdaptiveBody.of(rectangle((SIDE, SIDE), (2, 2)), DYNAMICS["linear"], Conditions(nowhere), None)
    with pytest.raises(InputError, match="tetrahedra, not of triangles"):
        body.cut(upright(10.0), 2.0)
    solid = AdaptiveBody.of(block(2), DYNAMICS["hyperelastic"], Conditions(nowhere), None)
    mesh, state = solid.mesh.leaf, solid.state
    with pytest.raises(InputError, match="larger than the body"):
        solid.cut(upright(10.0), 50.0)
    assert solid.mesh.leaf is mesh and solid.state is state
    solid.step()
