"""Transfer of values between meshes: mass, momentum and integrals are conserved, linear fields exact."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from naibu.meshing.primitives import box
from naibu.meshing.refinement.forest import BisectionForest
from naibu.meshing.refinement.transfer import transferred_cells, transferred_motion, transferred_nodes
from naibu.meshing.structured_2d import rectangle

MESHES = {3: lambda: box((1, 2, 1), (2, 2, 1), cell_type="tetra"), 2: lambda: rectangle((2, 1), (3, 2))}


def random_changes(forest, seed, count=14):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        leaves = forest.leaves()
        if rng.uniform() < 0.6:
            yield forest.refine(rng.choice(leaves, min(4, len(leaves))))
        else:
            yield forest.coarsen(rng.choice(leaves, rng.integers(1, len(leaves) + 1), replace=False))


@pytest.mark.parametrize("dimension", MESHES)
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=15, deadline=None)
def test_mass_and_momentum_are_conserved(dimension, seed):
    start = MESHES[dimension]()
    forest, rng = BisectionForest.of(start), np.random.default_rng(seed)
    density = rng.uniform(1, 2, start.n_cells)
    cell_mass = density * forest.volumes(np.arange(start.n_cells))
    mass = np.bincount(forest.simplices.ravel(), np.repeat(cell_mass, dimension + 1) / (dimension + 1))
    velocity = rng.normal(size=(start.n_points, dimension))
    total, momentum = mass.sum(), (mass[:, None] * velocity).sum(axis=0)
    for change in random_changes(forest, seed):
        cell_mass = transferred_cells(forest, change, cell_mass, extensive=True)
        mass, velocity = transferred_motion(forest, change, mass, velocity, cell_mass)
    used = forest.node_used
    mass, velocity = mass[: len(used)][used], velocity[: len(used)][used]
    leaves = forest.leaf_mesh()
    lumped = np.bincount(leaves.mesh.cells.ravel(), np.repeat(cell_mass[leaves.cells], dimension + 1) / (dimension + 1))
    assert mass == pytest.approx(lumped, rel=1e-12)
    assert mass.sum() == pytest.approx(total, rel=1e-13)
    assert (mass[:, None] * velocity).sum(axis=0) == pytest.approx(momentum, rel=1e-11, abs=1e-12)


@pytest.mark.parametrize("dimension", MESHES)
def test_linear_fields_and_integrals_are_exact(dimension):
    start = MESHES[dimension]()
    forest = BisectionForest.of(start)
    slope = np.arange(1.0, dimension + 1)
    nodal = start.points @ slope
    history = np.random.default_rng(0).normal(size=(start.n_cells, 2, 2))
    integral = np.einsum("c,cij->ij", forest.volumes(np.arange(start.n_cells)), history)
    for change in random_changes(forest, 5, 30):
        nodal, history = transferred_nodes(forest, change, nodal), transferred_cells(forest, change, history)
        leaves = forest.leaves()
        assert np.einsum("c,cij->ij", forest.volumes(leaves), history[leaves]) == pytest.approx(integral, rel=1e-12)
    used = np.flatnonzero(forest.node_used)
    assert nodal[used] == pytest.approx(forest.points[used] @ slope, rel=1e-12)


def test_children_inherit_and_values_that_fit_are_changed_in_place():
    forest = BisectionForest.of(MESHES[3]())
    values = np.zeros(1000)
    values[: forest.n_roots] = np.arange(forest.n_roots)
    change = forest.refine([3])
    assert transferred_cells(forest, change, values) is values
    assert (values[change.children] == change.parents[:, None]).all()
    change = forest.coarsen(change.children.ravel())
    assert (values[change.parents] == change.parents).all() and len(change.parents)
