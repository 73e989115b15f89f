"""Blocks of elements and tables that hold equal coefficients once, beside sorting by NumPy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from naibu.mechanics.lattices.cpu.element_blocks import Blocks
from naibu.mechanics.lattices.model.lattice import box_mask, classic_lattice
from naibu.mechanics.lattices.model.octrees.octree import octree_lattice


def bodies():
    holes = np.random.default_rng(2).random((7, 6, 9)) < 0.8
    holes[:, :, 4] = True
    yield classic_lattice(box_mask((8, 8, 8)), 1.0, density=1e-6)
    yield classic_lattice(holes, 1.0, density=1e-6)
    yield octree_lattice(box_mask((16, 16, 16)), 1.0, density=1e-6, scaling="edge")


def shuffled(lattice, seed):
    """The same elements in another order, some from the larger node to the smaller."""
    rng = np.random.default_rng(seed)
    elements = rng.permutation(lattice.elements)
    elements[::3] = elements[::3, ::-1]
    return replace(lattice, elements=elements)


@pytest.mark.parametrize("lattice", list(bodies()))
@pytest.mark.parametrize("mixed", [False, True])
def test_blocks_are_the_eights_of_nodes_and_distances_that_occur(lattice, mixed):
    lattice = shuffled(lattice, 0) if mixed else lattice
    blocks = Blocks.of(lattice)
    i, j = np.sort(lattice.elements, axis=1).T
    lane = blocks.lane % 8
    np.testing.assert_array_equal(blocks.first[blocks.lane // 8] + lane, i)
    np.testing.assert_array_equal(blocks.second[blocks.lane // 8] + lane, j)
    wanted = np.unique(np.stack([i // 8 * 8, j - i], axis=1), axis=0)
    found = np.stack([blocks.first, blocks.second - blocks.first], axis=1)
    np.testing.assert_array_equal(found[np.lexsort(found.T[::-1])], wanted)
    assert (np.diff(blocks.first) >= 0).all()
    for first in np.unique(blocks.first):  # every fourth distance, from the first, the second, the third and the fourth on
        gaps = wanted[wanted[:, 0] == first, 1]
        np.testing.assert_array_equal(found[blocks.first == first, 1], np.concatenate([gaps[k::4] for k in range(4)]))


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("lattice", list(bodies()))
def test_tables_hold_each_kind_of_block_once(lattice, shared, monkeypatch):
    """As many kinds as NumPy finds among whole rows, also where all blocks should share the number that tells them apart."""
    if shared:
        monkeypatch.setattr(Blocks, "_keys", lambda self, filled, bits: np.zeros(self.n_blocks, dtype=np.uint64))
    rng = np.random.default_rng(4)
    columns = [rng.integers(0, 2, lattice.n_elements) * 0.1, np.where(rng.random(lattice.n_elements) < 0.9, 2.0, -0.0)]
    blocks = Blocks.of(lattice)
    rows, tables = blocks.patterns(*columns)
    wide = np.zeros((3, 8 * blocks.n_blocks))
    wide[0, blocks.lane] = 1.0
    for own, column, table in zip(wide[1:], columns, tables, strict=True):
        own[blocks.lane] = column
        read = table[rows[:, None] + np.arange(8)].ravel()
        np.testing.assert_array_equal(read, own)
        np.testing.assert_array_equal(np.signbit(read), np.signbit(own))
    kinds = np.unique(np.concatenate(wide.reshape(3, -1, 8), axis=1).view(np.int64), axis=0)
    assert len(tables[0]) == 8 * len(kinds)


def test_equal_parameters_take_one_row_per_arrangement_of_lanes():
    lattice = classic_lattice(box_mask((7, 3, 3)), 1.0, density=1e-6)  # eight nodes in a row: seven joined along x, eight across, and so on
    blocks = Blocks.of(lattice)
    _, (table,) = blocks.patterns(np.full(lattice.n_elements, 3.0))
    assert sorted(table.reshape(-1, 8).sum(axis=1) / 3.0) == [7.0, 7.0, 8.0]
