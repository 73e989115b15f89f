"""Replacement of leaves: subdivisions, cracks, and refinement across what was replaced."""

from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from naibu.core.errors import InputError
from naibu.meshing.primitives import box
from naibu.meshing.refinement.forest import BisectionForest
from naibu.meshing.refinement.replacement import added_nodes, replaced_cells


def cube(n=2):
    return BisectionForest.of(box((1, 1, 1), (n, n, n), cell_type="tetra", centred=False))


def positive(points, cells):
    corners = points[cells]
    cells = cells.copy()
    flipped = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0
    cells[flipped, -2:] = cells[flipped, -2:][:, ::-1]
    return cells


def measures(forest):
    """Return the volume and the area of the boundary, by faces of one cell; and that by neighbours."""
    mesh = forest.leaf_mesh().mesh
    corners = mesh.points[mesh.cells]
    volumes = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6
    assert volumes.min() > 0
    faces = np.sort(np.concatenate([np.delete(mesh.cells, i, axis=1) for i in range(4)]), axis=1)
    faces, count = np.unique(faces, axis=0, return_counts=True)
    assert count.max() <= 2
    area = triangle_areas(mesh.points, faces[count == 1]).sum()
    pairs, _ = forest.boundary_faces()
    own = np.array([np.delete(forest.simplices[c], s) for c, s in pairs])
    assert triangle_areas(forest.points, own).sum() == pytest.approx(area)
    cells, across = forest.leaves(), forest.neighbours
    for t in cells:
        for u in across[t][across[t] >= 0]:
            assert t in across[u] and forest.children[u] == -1
            assert len(set(forest.simplices[t]) & set(forest.simplices[u])) == 3
    assert len(np.unique(mesh.cells)) == forest.n_nodes == mesh.n_points
    return volumes.sum(), area


def triangle_areas(points, faces):
    p = points[faces]
    return np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1) / 2


def split_at_a_point(forest, cell, weights):
    """Split a leaf into four at a point inside."""
    corners = forest.simplices[cell].astype(np.int64)
    (node,) = added_nodes(forest, [weights @ forest.points[corners]])
    parts = np.array([np.where(np.arange(4) == i, node, corners) for i in range(4)])
    return replaced_cells(forest, [cell], positive(forest.points, parts), levels=forest.levels[cell])


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=10, deadline=None)
def test_subdivided_cells_are_refined_and_coarsened_with_the_others(seed):
    forest, rng = cube(), np.random.default_rng(seed)
    for _ in range(8):
        leaves = forest.leaves()
        split_at_a_point(forest, int(rng.choice(leaves)), rng.dirichlet(np.full(4, 9.0)))
        with suppress(InputError):  # cells that wait for each other
            forest.refine(rng.choice(forest.leaves(), 3))
        forest.coarsen(forest.leaves()[rng.uniform(size=forest.n_cells) < 0.5])
    assert measures(forest) == pytest.approx((1.0, 6.0))


@pytest.mark.parametrize("levels", [0, 2, 3])
def test_doubled_vertices_open_a_crack_that_stays_open(levels):
    forest = cube()
    for _ in range(levels):
        forest.refine(forest.leaves())
    leaves = forest.leaves()
    above = leaves[forest.points[forest.simplices[leaves]].mean(axis=1)[:, 2] > 0.5]
    plane = np.unique(forest.simplices[above])
    plane = plane[np.abs(forest.points[plane][:, 2] - 0.5) < 1e-9]
    doubled = dict(zip(plane.tolist(), added_nodes(forest, forest.points[plane]).tolist(), strict=True))
    touching = np.array([t for t in above if np.isin(forest.simplices[t], plane).any()])
    cells = np.array([[doubled.get(v, v) for v in row] for row in forest.simplices[touching].tolist()])
    before = np.sort(forest.levels[touching])
    made = replaced_cells(forest, touching, positive(forest.points, cells), marker=5)
    assert np.array_equal(np.sort(forest.levels[made]), before)
    assert len(made) == len(touching)
    assert measures(forest) == pytest.approx((1.0, 8.0))
    for seed in range(6):  # no cells wait for each other
        forest.refine(np.random.default_rng(seed).choice(forest.leaves(), 20))
    forest.coarsen(forest.leaves())
    assert measures(forest) == pytest.approx((1.0, 8.0))
    faces, markers = forest.boundary_faces()
    heights = np.array([forest.points[np.delete(forest.simplices[c], s)][:, 2] for c, s in faces])
    assert np.array_equal(markers == 5, (np.abs(heights - 0.5) < 1e-9).all(axis=1))


def test_cells_may_be_taken_out_where_their_vertices_stay():
    forest = cube(3)
    middle = forest.leaves()[np.argmin(np.linalg.norm(forest.points[forest.simplices[forest.leaves()]].mean(axis=1) - 0.5, axis=1))]
    around = forest.neighbours[middle][forest.neighbours[middle] >= 0]
    kept = positive(forest.points, forest.simplices[around].astype(np.int64))
    replaced_cells(forest, [middle, *around], kept)
    volume, area = measures(forest)
    assert volume == pytest.approx(1 - 1 / 162)
    assert area > 6.0


def test_what_does_not_fit_is_refused_and_changes_nothing():
    forest = cube()
    before = forest.leaf_mesh()
    corners = positive(forest.points, forest.simplices[[0]].astype(np.int64))
    with pytest.raises(InputError, match="volume"):
        replaced_cells(forest, [0], corners[:, [0, 1, 3, 2]])
    with pytest.raises(InputError, match="leaves"):
        replaced_cells(forest, [], corners)
    with pytest.raises(InputError, match="leaves"):
        replaced_cells(forest, [99], corners)
    with pytest.raises(InputError, match="three cells"):
        replaced_cells(forest, [0], np.repeat(corners, 3, axis=0))
    lonely = BisectionForest.of(box((1, 1, 1), (1, 1, 1), cell_type="tetra"))
    corner = min(range(8), key=lambda v: len(lonely.around_node(v)))
    cells, leaves = lonely.around_node(corner), lonely.leaves()
    elsewhere = lonely.simplices[leaves[~np.isin(leaves, cells)][:1]].astype(np.int64)
    with pytest.raises(InputError, match="no cell"):
        replaced_cells(lonely, cells, positive(lonely.points, elsewhere))
    after = forest.leaf_mesh()
    assert np.array_equal(before.mesh.cells, after.mesh.cells) and np.array_equal(before.cells, after.cells)
    change = forest.refine([0])
    with pytest.raises(InputError, match="leaves"):
        replaced_cells(forest, change.parents[:1], corners)
