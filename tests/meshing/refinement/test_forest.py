"""Bisection forests: conformity, volume and quality under any sequence of changes, and the way back."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import Delaunay

from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.meshing.primitives import box
from naibu.meshing.quality import scaled_jacobians
from naibu.meshing.refinement import _forest_kernels as kernels
from naibu.meshing.refinement.forest import BisectionForest
from naibu.meshing.structured_2d import rectangle


def delaunay(seed, dimension=3, n=40):
    """Return a mesh of random points, without its flattest cells but with regions."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(size=(n, dimension))
    cells = Delaunay(points).simplices.astype(np.int64)
    size = np.linalg.det(points[cells][:, 1:] - points[cells][:, :1])
    cells[size < 0, -2:] = cells[size < 0, -2:][:, ::-1]
    cells = cells[np.abs(size) > 1e-3]
    used, number = np.unique(cells, return_inverse=True)
    regions = rng.integers(0, 2, len(cells))
    kind = "tetra" if dimension == 3 else "triangle"
    return Mesh.from_arrays(points[used], number.reshape(cells.shape), kind, regions=regions, region_names=("soft", "stiff"))


def kuhn(n=2):
    return box((1, 1, 1), (n, n, n), cell_type="tetra")


MESHES = {
    "kuhn": kuhn,
    "random": lambda: delaunay(1),
    "plane": lambda: rectangle((2, 1), (3, 2)),
    "random plane": lambda: delaunay(2, 2),
}


def measures(mesh):
    corners = mesh.points[mesh.cells]
    return np.linalg.det(corners[:, 1:] - corners[:, :1]) / (2 if mesh.dimension == 2 else 6)


def faces_of(cells):
    k = cells.shape[1]
    return np.sort(np.concatenate([np.delete(cells, i, axis=1) for i in range(k)]), axis=1)


def boundary_size(mesh):
    """Area (length) of the faces that one cell has; also that of a crack, so that it tells whether a mesh conforms."""
    faces, count = np.unique(faces_of(mesh.cells), axis=0, return_counts=True)
    assert count.max() <= 2
    p = mesh.points[faces[count == 1]]
    if mesh.dimension == 2:
        return np.linalg.norm(p[:, 1] - p[:, 0], axis=1).sum()
    return np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1).sum() / 2


def require_sound(forest, start):
    """Check all that a forest promises of its leaves."""
    leaf = forest.leaf_mesh()
    mesh = leaf.mesh
    volumes = measures(mesh)
    assert volumes.min() > 0
    assert volumes.sum() == pytest.approx(measures(start).sum(), rel=1e-12)
    assert boundary_size(mesh) == pytest.approx(boundary_size(start), rel=1e-12)  # no cracks, no overlaps
    for region in range(len(start.region_names)):
        assert volumes[mesh.regions == region].sum() == pytest.approx(measures(start)[start.regions == region].sum(), rel=1e-12)
    assert len(np.unique(mesh.cells)) == forest.n_nodes == mesh.n_points
    # neighbours share the face that lies opposite to the vertex
    cells, across = forest.simplices, forest.neighbours
    for place in range(mesh.dimension + 1):
        other = across[leaf.cells, place]
        inner = other >= 0
        here = np.sort(np.delete(cells[leaf.cells], place, axis=1)[inner], axis=1)
        assert (forest.children[other[inner]] == -1).all()
        shared = (here[:, :, None] == cells[other[inner]][:, None, :]).any(axis=2)
        assert shared.all()
        assert (across[other[inner]] == leaf.cells[inner, None]).any(axis=1).all()
    holds = cells[forest.node_cells[leaf.nodes]] == leaf.nodes[:, None]
    assert holds.any(axis=1).all() and (forest.children[forest.node_cells[leaf.nodes]] == -1).all()
    made = leaf.nodes[forest.node_parents[leaf.nodes, 0] >= 0]
    assert (forest.midpoints(forest.node_parents[made]) == made).all()
    assert (forest.midpoints(forest.node_parents[made][:, ::-1]) == made).all()


@pytest.mark.parametrize("name", MESHES)
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=12, deadline=None)
def test_any_sequence_of_changes_keeps_a_conforming_mesh_of_the_same_body(name, seed):
    start = MESHES[name]()
    forest, rng = BisectionForest.of(start), np.random.default_rng(seed)
    for _ in range(12):
        leaves = forest.leaves()
        chosen = rng.choice(leaves, rng.integers(1, len(leaves) + 1), replace=False)
        if rng.uniform() < 0.6:
            forest.refine(chosen[: rng.integers(1, 8)])
        else:
            forest.coarsen(chosen)
    require_sound(forest, start)


@pytest.mark.parametrize("name", MESHES)
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=12, deadline=None)
def test_coarsening_returns_to_the_start(name, seed):
    start = MESHES[name]()
    forest, rng = BisectionForest.of(start), np.random.default_rng(seed)
    for _ in range(25):
        forest.refine(rng.choice(forest.leaves(), 2))
    while forest.coarsen(forest.leaves()):
        pass
    found = forest.leaf_mesh()
    assert np.array_equal(found.cells, np.arange(start.n_cells)) and np.array_equal(found.nodes, np.arange(start.n_points))
    assert np.array_equal(found.mesh.points, start.points)
    assert np.array_equal(np.sort(found.mesh.cells, axis=1), np.sort(start.cells, axis=1))
    assert np.array_equal(found.mesh.regions, start.regions)
    require_sound(forest, start)


def shape_classes(mesh):
    """Return the sorted edge lengths of every cell over the longest one, rounded, each once."""
    i, j = np.triu_indices(4, 1)
    p = mesh.points[mesh.cells]
    lengths = np.sort(np.linalg.norm(p[:, i] - p[:, j], axis=2), axis=1)
    return np.unique(np.round(lengths / lengths[:, -1:], 9), axis=0)


def test_kuhn_cubes_have_three_classes_that_recur_every_third_level():
    forest = BisectionForest.of(kuhn(1))
    classes = []
    for _ in range(7):
        found = shape_classes(forest.leaf_mesh().mesh)
        assert len(found) == 1
        classes.append(found[0])
        forest.refine(forest.leaves())
    assert all(np.array_equal(classes[i], classes[i + 3]) for i in range(4))
    assert len(np.unique(classes, axis=0)) == 3
    # ratio of the longest to the shortest edge, as printed for types I, II and III
    assert [1 / c[0] for c in classes[:3]] == pytest.approx([np.sqrt(3), 2 * np.sqrt(2) / np.sqrt(3), 2])


def test_three_bisections_of_the_cuboid_double_its_cells():
    forest = BisectionForest.of(box((4, 4, 4), (4, 4, 4), cell_type="tetra"))
    assert (forest.n_nodes, forest.n_cells) == (125, 384)
    for _ in range(3):
        forest.refine(forest.leaves())
    assert (forest.n_nodes, forest.n_cells) == (729, 3072)
    assert forest.volumes(forest.leaves()) == pytest.approx(1 / 48)


def root_of(forest, cells):
    out = cells.copy()
    while (forest.parents[out] >= 0).any():
        out = np.where(forest.parents[out] >= 0, forest.parents[out], out)
    return out


@pytest.mark.parametrize("seed", range(3))
def test_quality_is_bounded_by_that_of_the_first_generations(seed):
    start = delaunay(seed, n=8)
    uniform, local = BisectionForest.of(start), BisectionForest.of(start)
    lowest = scaled_jacobians(start)
    for _ in range(9):
        uniform.refine(uniform.leaves()[uniform.levels[uniform.leaves()] == uniform.levels[uniform.leaves()].min()])
        leaf = uniform.leaf_mesh()
        np.minimum.at(lowest, root_of(uniform, leaf.cells), scaled_jacobians(leaf.mesh))
    rng = np.random.default_rng(seed)
    for _ in range(12):  # towards random points
        leaf = local.leaf_mesh()
        centre = leaf.mesh.points[leaf.mesh.cells].mean(axis=1)
        at = start.points.mean(axis=0) + rng.normal(scale=0.02, size=3)
        local.refine(leaf.cells[np.linalg.norm(centre - at, axis=1).argsort()[:20]])
    for _ in range(8):
        local.refine(local.leaves()[local.levels[local.leaves()] == local.levels[local.leaves()].max()])
    leaf = local.leaf_mesh()
    assert local.levels[leaf.cells].max() > 15
    assert (scaled_jacobians(leaf.mesh) >= (1 - 1e-6) * lowest[root_of(local, leaf.cells)]).all()


@pytest.mark.parametrize("seed", [1, 2])
def test_longest_edges_never_wait_for_each_other_in_a_circle(seed):
    # with the flags of Arnold, Mukherjee and Pouly, cells of these meshes do, at level 4
    start = delaunay(seed, n=60)
    forest = BisectionForest.of(start)
    for level in range(6):
        forest.refine(forest.leaves()[forest.levels[forest.leaves()] <= level])
    assert forest.levels[forest.leaves()].min() == 6
    assert boundary_size(forest.leaf_mesh().mesh) == pytest.approx(boundary_size(start))


def test_roots_of_all_four_kinds_are_bisected_at_their_longest_edges():
    start = delaunay(3, n=60)
    forest = BisectionForest.of(start)
    assert set(forest._arrays[0][: start.n_cells, kernels.TAG]) == {3, 4, 5, 6}
    i, j = np.triu_indices(4, 1)
    longest = np.linalg.norm(start.points[start.cells[:, i]] - start.points[start.cells[:, j]], axis=2).max(axis=1)
    ends = forest.simplices[: start.n_cells, [0, 3]]
    assert np.linalg.norm(start.points[ends[:, 0]] - start.points[ends[:, 1]], axis=1) == pytest.approx(longest)


def test_levels_are_limited():
    forest = BisectionForest.of(kuhn())
    for _ in range(6):
        forest.refine(forest.leaves(), max_level=3)
    assert set(forest.levels[forest.leaves()]) == {3}
    assert not forest.refine(forest.leaves(), max_level=3)


def test_boundary_markers_are_inherited_and_return():
    start = kuhn()
    forest = BisectionForest.of(start)
    faces, markers = forest.boundary_faces()
    assert (markers == 0).all()

    def heights(pairs):
        corners = np.array([np.delete(forest.simplices[c], s) for c, s in pairs])
        return forest.points[corners][:, :, 2]

    forest.mark_boundary(faces, np.where((heights(faces) == 1.0).all(axis=1), 7, 2))
    for _ in range(5):
        forest.refine(forest.leaves()[::3])
        faces, markers = forest.boundary_faces()
        assert np.array_equal(markers == 7, (heights(faces) == 1.0).all(axis=1))
    while forest.coarsen(forest.leaves()):
        pass
    faces, markers = forest.boundary_faces()
    assert np.array_equal(markers == 7, (heights(faces) == 1.0).all(axis=1)) and set(markers) == {2, 7}
    inner = int(np.flatnonzero((forest.neighbours >= 0).all(axis=1))[0]) if (forest.neighbours >= 0).all(axis=1).any() else 0
    place = int(np.flatnonzero(forest.neighbours[inner] >= 0)[0])
    with pytest.raises(InputError, match="not on the boundary"):
        forest.mark_boundary([[inner, place]], 1)
    with pytest.raises(InputError, match="must not be negative"):
        forest.mark_boundary(faces[:1], -3)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=10, deadline=None)
def test_cells_around_edges_and_vertices_are_those_of_the_mesh(seed):
    forest, rng = BisectionForest.of(delaunay(4)), np.random.default_rng(seed)
    for _ in range(8):
        forest.refine(rng.choice(forest.leaves(), 3))
    leaves = forest.leaves()
    cell = int(rng.choice(leaves))
    first, second = rng.choice(forest.simplices[cell], 2, replace=False).tolist()
    corners = forest.simplices[leaves]
    on = (corners == first).any(axis=1)
    assert set(forest.around_node(first)) == set(leaves[on])
    assert set(forest.around_edge(cell, first, second)) == set(leaves[on & (corners == second).any(axis=1)])


def fan(n):
    """Return n tetrahedra around one edge."""
    angle = 2 * np.pi * np.arange(n) / n
    points = np.vstack([[0, 0, -9], [0, 0, 9], np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)])
    rim = 2 + np.arange(n)
    cells = np.stack([np.zeros(n, np.int64), np.ones(n, np.int64), np.roll(rim, -1), rim], axis=1)
    mesh = Mesh.from_arrays(points, cells, "tetra")
    return mesh if measures(mesh).min() > 0 else Mesh.from_arrays(points, cells[:, [0, 1, 3, 2]], "tetra")


def test_a_refused_refinement_leaves_the_mesh_as_it_was():
    crowd, few = fan(kernels.MAX_RING + 8), kuhn()
    points = np.vstack([crowd.points, few.points + 50.0])
    start = Mesh.from_arrays(points, np.vstack([few.cells + crowd.n_points, crowd.cells]), "tetra")
    forest = BisectionForest.of(start)
    with pytest.raises(InputError, match="as it was"):
        forest.refine(forest.leaves())
    found = forest.leaf_mesh()
    assert np.array_equal(np.sort(found.mesh.cells, axis=1), np.sort(start.cells, axis=1))
    require_sound(forest, start)
    assert len(BisectionForest.of(fan(300)).refine([0]).parents) == 300


def test_cells_that_are_numbered_the_other_way_round_are_turned():
    start = kuhn()
    cells = start.cells.copy()
    cells[::3] = cells[::3][:, [1, 0, 2, 3]]
    forest = BisectionForest.of(Mesh.from_arrays(start.points, cells, "tetra"))
    forest.refine(np.arange(20))
    require_sound(forest, start)


def test_unsuitable_meshes_and_numbers_are_refused():
    with pytest.raises(InputError, match="'hexahedron'"):
        BisectionForest.of(box((1, 1, 1), (1, 1, 1)))
    tetra = np.array([[0, 1, 2, 3]])
    with pytest.raises(InputError, match="no volume"):
        BisectionForest.of(Mesh.from_arrays([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], tetra, "tetra"))
    points = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 2], [0, 0, -1]]
    with pytest.raises(InputError, match="three cells share"):
        BisectionForest.of(Mesh.from_arrays(points, [[0, 1, 2, 3], [0, 1, 2, 4], [0, 1, 2, 5]], "tetra"))
    alone = Mesh.from_arrays([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2, 3], [1, 0, 2, 3]], "tetra")
    with pytest.raises(InputError, match="cells 0 and 1 have the same nodes; remove duplicate cells"):
        BisectionForest.of(alone)
    folded = kuhn()
    points = folded.points.copy()
    points[np.argmin(np.abs(points - [0, 0, 0.5]).sum(axis=1)), 0] += 0.9  # through the cells beside it
    with pytest.raises(InputError, match=r"cells \d+ and \d+ lie on the same side of the face that they share: one of them is inverted"):
        BisectionForest.of(Mesh.from_arrays(points, folded.cells, "tetra"))
    plane = rectangle((2, 1), (2, 2))
    points = plane.points.copy()
    points[4] += [1.5, 0]
    with pytest.raises(InputError, match="same side of the face"):
        BisectionForest.of(Mesh.from_arrays(points, plane.cells, "triangle"))
    forest = BisectionForest.of(kuhn())
    for wrong in ([-1], [48]):
        with pytest.raises(InputError, match="numbers 0 to 47"):
            forest.refine(wrong)
    with pytest.raises(InputError, match="shape"):
        forest.coarsen(np.ones(3, dtype=bool))
    with pytest.raises(InputError, match="not in use"):
        forest.around_node(1000)
    with pytest.raises(InputError, match="not the ends"):
        forest.around_edge(0, 5, 5)
    assert not forest.refine([]) and not forest.coarsen([])
