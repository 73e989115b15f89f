"""Adaptive lattices: the report's parameters by level, conservation, history, and stationary states that do not depend on the path."""

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.mechanics.lattices.model.state import LatticeState
from naibu.mechanics.lattices.model.tetrahedral_springs import volumetric_lattice
from naibu.meshing.primitives import box
from naibu.meshing.refinement.forest import BisectionForest
from naibu.meshing.refinement.marking import EdgeStretch
from naibu.simulation.adaptive.conditions import Conditions, face_force, weight
from naibu.simulation.adaptive.lattice import AdaptiveLattice, SpringMaterial
from naibu.simulation.adaptive.spring_levels import level_spring

E_KPA, DENSITY, CUBE = 50.0, 1e-7, 10.0
MATERIAL = SpringMaterial(E_KPA, DENSITY)


def cuboid(n=2):
    return box((n * CUBE,) * 3, (n, n, n), cell_type="tetra", centred=False)


def at_start(points):
    return points[:, 0] < 1e-9


def nowhere(points):
    return np.zeros(len(points), dtype=bool)


def scattered(lattice, seed=0):
    """Return numbers of some leaves."""
    leaves = lattice.mesh.leaf.cells
    return np.random.default_rng(seed).choice(leaves, len(leaves) // 4, replace=False)


@pytest.mark.parametrize("level", range(7))
def test_springs_inside_follow_the_closed_forms_by_level(level):
    forest = BisectionForest.of(cuboid())
    for _ in range(level):
        forest.refine(forest.leaves())
    expected = level_spring(level, young_modulus=E_KPA, cube_mm=CUBE)
    lattice = AdaptiveLattice.of(forest.leaf_mesh().mesh, MATERIAL, Conditions(nowhere), None)
    # what the next bisection would halve: inside, the edge is shared by six, four or eight cells
    change = BisectionForest.of(forest.leaf_mesh().mesh)
    ends = np.sort(forest.refine(forest.leaves()).ends, axis=1)
    middle = forest.points[ends].mean(axis=1)
    inside = ((middle > 1e-6) & (middle < 2 * CUBE - 1e-6)).all(axis=1)
    if not inside.any():
        pytest.skip("the refinement edges of this level lie on the surface")
    number = {tuple(pair): k for k, pair in enumerate(lattice.lattice.elements)}
    leaf_nodes = {tuple(np.round(p, 9)): k for k, p in enumerate(change.points)}
    chosen = [number[tuple(sorted(leaf_nodes[tuple(np.round(forest.points[v], 9))] for v in pair))] for pair in ends[inside]]
    assert lattice.lattice.lengths[chosen] == pytest.approx(expected.length_mm)
    assert lattice.session.engine.parameters.stiffness[chosen] == pytest.approx(expected.stiffness)


def test_masses_and_springs_of_a_refined_mesh_are_those_of_a_new_one():
    lattice = AdaptiveLattice.of(cuboid(), MATERIAL, Conditions(at_start), EdgeStretch())
    lattice.change(scattered(lattice))
    fresh, parameters = volumetric_lattice(lattice.mesh.leaf.mesh, density=DENSITY, young_modulus=E_KPA)
    assert np.array_equal(fresh.elements, lattice.lattice.elements)
    assert lattice.lattice.node_mass == pytest.approx(fresh.node_mass)
    for name in ("stiffness", "voigt_damping"):
        assert getattr(lattice.session.engine.parameters, name) == pytest.approx(getattr(parameters, name))


def test_momentum_of_a_free_body_is_conserved_while_its_mesh_changes():
    material = SpringMaterial(E_KPA, DENSITY, damping_ratio=0.05)
    lattice = AdaptiveLattice.of(
        cuboid(), material, Conditions(nowhere), EdgeStretch(1.01, 1.005), interval=5, step=5e-6, method="symplectic_euler"
    )
    rest = lattice.lattice.points
    start = LatticeState(
        rest.copy(), np.random.default_rng(0).normal(scale=400.0, size=rest.shape) + 100.0, np.zeros(lattice.lattice.n_elements)
    )
    lattice.restore(start)
    momentum = (lattice.lattice.node_mass[:, None] * start.velocity).sum(axis=0)
    mass, counts = lattice.lattice.total_mass, set()
    for _ in range(60):
        lattice.step(steps=5)
        counts.add(lattice.mesh.leaf.mesh.n_points)
    state = lattice.state()
    assert len(counts) > 5
    assert lattice.lattice.total_mass == pytest.approx(mass, rel=1e-13)
    assert (lattice.lattice.node_mass[:, None] * state.velocity).sum(axis=0) == pytest.approx(momentum, rel=1e-9)


def test_creep_is_carried_as_a_strain():
    material = SpringMaterial(E_KPA, DENSITY, series_damping=1.0)
    lattice = AdaptiveLattice.of(cuboid(), material, Conditions(at_start), None)
    rng = np.random.default_rng(1)
    strain = 0.05 * rng.normal(size=(3, 3))
    strain = strain + strain.T
    gradient = np.eye(3) + 0.1 * rng.normal(size=(3, 3))

    def extension():
        model, position = lattice.lattice, lattice.lattice.points @ gradient.T
        along = np.diff(model.points[model.elements], axis=1)[:, 0]
        lengths = np.linalg.norm(np.diff(position[model.elements], axis=1)[:, 0], axis=1)
        return position, lengths - model.lengths - np.einsum("ei,ij,ej->e", along, strain, along) / model.lengths

    position, y = extension()
    lattice.restore(LatticeState(position, np.zeros_like(position), y))
    for _ in range(3):
        assert lattice.change(scattered(lattice))
        position, y = extension()
        assert lattice.state().position == pytest.approx(position, abs=1e-9)
        assert lattice.state().extension == pytest.approx(y, abs=1e-9)
    while lattice.change(coarsen=lattice.mesh.leaf.cells):
        assert lattice.state().extension == pytest.approx(extension()[1], abs=1e-9)
    assert lattice.lattice.n_nodes == cuboid().n_points


def settled(lattice):
    """Return positions by the nodes' places at rest, after the motion has come to rest."""
    lattice.mesh.criterion = None
    lattice.step(steps=400)
    return {tuple(p): x for p, x in zip(np.round(lattice.lattice.points, 9), lattice.positions(), strict=True)}


def test_the_stationary_state_does_not_depend_on_the_path_of_refinement():
    conditions = Conditions(lambda p: at_start(p) | (p[:, 0] > 2 * CUBE - 1e-9), loads=(weight((0, 0, -9810.0)),))
    shapes = []
    for path in ("at once", "in motion", "there and back"):
        lattice = AdaptiveLattice.of(cuboid(), MATERIAL, conditions, None, step=2e-2, interval=10, tolerance=1e-7)
        if path != "at once":
            lattice.step(steps=3)
            lattice.change(scattered(lattice))
            lattice.step(steps=3)
        if path == "there and back":
            lattice.change(coarsen=lattice.mesh.leaf.cells)
            lattice.step(steps=2)
        while (coarse := lattice.mesh.leaf.cells[lattice.mesh.forest.levels[lattice.mesh.leaf.cells] < 3]).size:
            lattice.change(coarse)
        shapes.append(settled(lattice))
    sag = max(abs(x[2] - p[2]) for p, x in shapes[0].items())
    assert sag > 1e-3
    for other in shapes[1:]:
        assert other.keys() == shapes[0].keys()
        assert max(np.abs(other[p] - x).max() for p, x in shapes[0].items()) < 1e-6 * sag


def test_the_mesh_follows_the_deformation_and_returns():
    load = face_force(lambda p: p[:, 0] > 2 * CUBE - 1e-9, (0.0, 0.0, -600.0))
    lattice = AdaptiveLattice.of(cuboid(), MATERIAL, Conditions(at_start, loads=(load,)), EdgeStretch(), step=5e-4, interval=20)
    forces = lattice.step(steps=300)
    assert forces.bodies.shape == (300, 1, 3)
    assert forces.bodies[-1, 0] == pytest.approx([0, 0, 600.0], abs=0.5)
    assert lattice.mesh.leaf.mesh.n_points > 27
    lattice.constrain(Conditions(at_start))
    lattice.step(steps=300)
    assert lattice.mesh.leaf.mesh.n_points == 27
    assert lattice.positions() == pytest.approx(lattice.lattice.points, abs=1e-3)


def test_bodies_move_nodes_on_every_mesh():
    moved = Conditions(at_start, (lambda p: p[:, 0] > 2 * CUBE - 1e-9,))
    lattice = AdaptiveLattice.of(cuboid(), MATERIAL, moved, EdgeStretch(), step=5e-3, interval=2)
    lattice.step([[0, 0, 0], [40.0, 0, 0]], steps=10)
    end = lattice.lattice.points[:, 0] > 2 * CUBE - 1e-9
    assert end.sum() > 9
    assert lattice.positions()[end, 0] == pytest.approx(2 * CUBE + 2.0, abs=1e-6)


def test_what_cannot_be_is_refused():
    conditions = Conditions(at_start)
    with pytest.raises(InputError, match="tetrahedra"):
        AdaptiveLattice.of(box((1, 1, 1), (1, 1, 1)), MATERIAL, conditions, None)
    for wrong in ({"interval": 0}, {"max_level": -1}, {"bisections": 0}, {"step": 0.0}):
        with pytest.raises(InputError):
            AdaptiveLattice.of(cuboid(), MATERIAL, conditions, None, **wrong)
    with pytest.raises(InputError, match="damping_ratio"):
        SpringMaterial(E_KPA, DENSITY, damping_ratio=-1.0)
    with pytest.raises(InputError, match="no boundary face"):
        AdaptiveLattice.of(cuboid(), MATERIAL, Conditions(at_start, loads=(face_force(nowhere, (0, 0, 1)),)), None)
    with pytest.raises(InputError, match="level"):
        level_spring(-1, young_modulus=1.0, cube_mm=1.0)
    lattice = AdaptiveLattice.of(cuboid(), MATERIAL, conditions, None)
    assert not lattice.adapt()
    with pytest.raises(InputError, match="at least 1"):
        lattice.step(steps=0)
