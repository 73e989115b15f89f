"""Octree lattices: the printed counts, connections, masses."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.datasets import paper_tables
from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.model.lattice import box_mask, classic_lattice, lattice_parameters
from naibu.mechanics.lattices.model.octrees.octree import octree_cubes, octree_lattice
from naibu.mechanics.lattices.model.state import LatticeState

TABLES = {table["id"]: table["rows"] for table in paper_tables()["tables"]}
MISPRINTS = {(9, "classic"): (7748, 7448), (9, 1): (6386, 6497)}  # contradicted by the memory of Table IX at 136 bytes an element


@pytest.mark.parametrize("edge", [9, 17, 33])
def test_the_counts_of_the_report(edge):
    masses, elements = (next(row for row in TABLES[name] if row[0] == edge) for name in ("4-I", "4-II"))
    mask = box_mask((edge - 1,) * 3)
    lattices = {"classic": classic_lattice(mask, 80.0 / (edge - 1), total_mass_kg=0.63)}
    lattices |= {kind: octree_lattice(mask, 80.0 / (edge - 1), kind, total_mass_kg=0.63, scaling="edge") for kind in (0, 1, 2)}
    for column, (kind, lattice) in enumerate(lattices.items(), start=1):
        printed, right = MISPRINTS.get((edge, kind), (elements[column], elements[column]))
        assert elements[column] == printed
        assert (lattice.n_nodes, lattice.n_elements) == (masses[column], right)
        assert lattice.total_mass == pytest.approx(0.63)


def test_the_misprints_contradict_the_memory_of_the_same_paper():
    memory = next(row for row in TABLES["4-IX"] if "element" in row[0])[1:5]
    for kind, right in zip(("classic", 0, 1, 2), (7448, 6858, 6497, 5769), strict=True):
        assert memory[("classic", 0, 1, 2).index(kind)] == pytest.approx(136 * right / 1000.0, rel=5e-4)


@pytest.mark.parametrize(("kind", "total"), [(0, 0.6117), (1, 0.5985), (2, 0.5835)])
def test_the_printed_mass_rule_loses_mass(kind, total):
    """0.864 g at nodes of fine voxels, 5.04 g (those of 5^3 nodes) at the others; their sum falls short of 630 g."""
    lattice = octree_lattice(box_mask((8, 8, 8)), 10.0, kind, total_mass_kg=0.63, lumping="smallest")
    np.testing.assert_allclose(np.unique(lattice.node_mass), [0.63 / 729, 0.63 / 125])
    assert lattice.total_mass == pytest.approx(total, abs=5e-5)


def ball(n=16):
    grid = np.indices((n, n, n)) + 0.5 - n / 2
    return (grid**2).sum(axis=0) < (n / 2 - 0.5) ** 2


@pytest.mark.parametrize("kind", [0, 1, 2])
@pytest.mark.parametrize("mask", [ball(), box_mask((5, 8, 6)), ball(12)[:, :, 3:]])
def test_any_mask_is_filled_once_and_connected_without_overlap(kind, mask):
    cubes, sizes = octree_cubes(mask, kind)
    count = np.zeros(mask.shape, dtype=int)
    for at, size in zip(cubes, sizes, strict=True):
        count[tuple(slice(a, a + size) for a in at)] += 1
    np.testing.assert_array_equal(count, mask)
    lattice = octree_lattice(mask, 1.0, kind, density=1e-6, scaling="energy")
    assert lattice.total_mass == pytest.approx(1e-6 * mask.sum())
    grid = {tuple(p): k for k, p in enumerate(np.rint(lattice.points * 2).astype(int))}
    for i, j in lattice.elements[:: max(1, lattice.n_elements // 400)]:
        a, b = np.rint(lattice.points[i] * 2).astype(int), np.rint(lattice.points[j] * 2).astype(int)
        parts = np.abs(b - a).max()
        assert not any(tuple(a + (b - a) * k // parts) in grid for k in range(1, parts))
    if mask.all():
        return
    assert (sizes[~np.isin(sizes, (1, 2, 4, 8))]).size == 0


def test_an_octree_of_the_finest_cubes_is_the_classic_lattice():
    mask = box_mask((2, 2, 2))
    octree, classic = octree_lattice(mask, 1.0, 0, density=1e-6), classic_lattice(mask, 1.0, density=1e-6)
    np.testing.assert_array_equal(octree.elements, classic.elements)
    np.testing.assert_allclose(octree.node_mass, classic.node_mass)
    np.testing.assert_array_equal(octree.scale, 1.0)


def test_cubes_of_one_size_scale_with_their_edge():
    """Springs K between nodes l apart make a solid of stiffness K / l: a lattice twice as coarse needs twice the K."""
    mask = box_mask((8, 8, 8))
    lattice = octree_lattice(mask, 1.0, 0, density=1e-6, scaling="edge")
    inner = (
        (lattice.element_level == 1)
        & (lattice.points[lattice.elements] > 2.5).all(axis=(1, 2))
        & (lattice.points[lattice.elements] < 5.5).all(axis=(1, 2))
    )
    assert (lattice.scale[lattice.element_zone == 1] == 1.0).all()
    assert lattice.scale.max() == 2.0
    assert not inner.any() or (lattice.scale[inner] == 2.0).all()


def test_an_octree_moves_with_both_momenta_kept():
    lattice = octree_lattice(ball(8), 5.0, 0, density=1e-6)
    engine = LatticeEngine.of(lattice, lattice_parameters(lattice, 5.0, 0.01, 0.2))
    velocity = 10.0 * np.random.default_rng(0).normal(size=lattice.points.shape)
    start = LatticeState(lattice.points, velocity, np.zeros(lattice.n_elements))
    end = engine.run(start, 50).state
    for arm in (lambda s: s.velocity, lambda s: np.cross(s.position, s.velocity)):
        before, after = (lattice.node_mass @ arm(s) for s in (start, end))
        np.testing.assert_allclose(after, before, rtol=1e-9, atol=1e-9)
    assert engine.energy(end) < engine.energy(start)


def test_unknown_types_and_empty_masks_are_refused():
    with pytest.raises(InputError, match="type 0, 1 or 2"):
        octree_lattice(box_mask((2, 2, 2)), 1.0, 3, density=1.0)
    with pytest.raises(InputError, match="no voxel"):
        octree_lattice(np.zeros((2, 2, 2), bool), 1.0, 0, density=1.0)
