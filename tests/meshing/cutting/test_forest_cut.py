"""Cutting of bisection forests: what is kept, refinement and coarsening behind the cut, and forests that stay as they were."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.meshing import BisectionForest, ForestCut, box, cut_forest, forest_pieces, rectangle, signed_volumes, swept_blade
from naibu.meshing.cutting.swept_blade import SweptBlade
from naibu.meshing.refinement._forest_kernels import TAG

SIZE = 20.0


def forest(divisions: int = 3) -> BisectionForest:
    return BisectionForest.of(
        box((SIZE, SIZE, SIZE), (divisions, divisions, divisions), cell_type="tetra", layers=[("a", 12.0), ("b", 8.0)])
    )


def plane(x: float, until_y: float = 15.0, slope: float = 0.2) -> SweptBlade:
    return swept_blade([[[x + slope * y, y, -5.0], [x + slope * y, y, 25.0]] for y in (-15.0, 0.5 * until_y, until_y)])


def check(found: BisectionForest, pieces: int | None = None) -> None:
    """The leaves fill the cube, neighbours know each other, and vertices are shared by cells that faces join only."""
    leaf = found.leaf_mesh()
    volumes = signed_volumes(leaf.mesh)
    assert volumes.min() > 0.0
    assert volumes.sum() == pytest.approx(SIZE**3, rel=1e-12)
    cells, across = leaf.cells, found.neighbours
    for place in range(4):
        inside = across[cells, place] >= 0
        there = across[cells[inside], place]
        assert (found.children[there] == -1).all()
        assert (across[there] == cells[inside][:, None]).sum(axis=1).tolist() == [1] * len(there)
        own = np.sort(np.delete(found.simplices[cells[inside]], place, axis=1), axis=1)
        other = found.simplices[there][across[there] != cells[inside][:, None]].reshape(-1, 3)
        np.testing.assert_array_equal(own, np.sort(other, axis=1))
    corner, vertex = np.divmod(np.argsort(found.simplices[cells].ravel(), kind="stable"), 4)[0], np.sort(found.simplices[cells].ravel())
    for v in np.unique(vertex)[::7]:
        assert set(found.around_node(int(v)).tolist()) == set(cells[corner[vertex == v]].tolist())
    if pieces is not None:
        assert forest_pieces(found).max() + 1 == pieces


def test_leaves_keep_number_level_tag_region_and_marker() -> None:
    found = forest()
    found.refine(found.leaves()[:40])
    faces, _ = found.boundary_faces()
    found.mark_boundary(faces, 7)
    before = found.copied()
    cut = cut_forest(found, plane(0.4), 6.0)
    check(found, 2)
    stay = np.intersect1d(before.leaves(), found.leaves())
    assert len(stay) > 40
    np.testing.assert_array_equal(found.levels[stay], before.levels[stay])
    np.testing.assert_array_equal(found.parents[stay], before.parents[stay])
    np.testing.assert_array_equal(found.regions[stay], before.regions[stay])
    np.testing.assert_array_equal(found.arrays[0][stay, TAG], before.arrays[0][stay, TAG])
    faces, markers = found.boundary_faces()
    new = {(int(c), int(s)) for pair in (cut.faces[:, :2], cut.faces[:, 2:]) for c, s in pair}
    assert [(int(c), int(s)) in new for c, s in faces] == (markers == 0).tolist()
    assert (markers[markers != 0] == 7).all()


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(-6.0, 6.0), st.sampled_from([-3.0, 4.0, 15.0]))
def test_refinement_and_coarsening_go_on_around_cuts(seed: int, x: float, until_y: float) -> None:
    found, rng = forest(), np.random.default_rng(seed)
    found.refine(rng.choice(found.leaves(), 30))
    cut_forest(found, plane(x, until_y), 4.0)
    check(found)
    for _ in range(3):
        found.refine(rng.choice(found.leaves(), 30))
        found.coarsen(rng.choice(found.leaves(), 60, replace=False))
    cut_forest(found, plane(-x, until_y, slope=-0.5), 4.0)  # crosses the first
    check(found)
    finest = found.n_cells
    for _ in range(20):
        found.coarsen(found.leaves())
    check(found)
    assert found.n_cells < finest


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(-6.0, 6.0), st.floats(-8.0, 8.0), st.sampled_from([3.0, 5.0]))
def test_the_front_of_a_cut_stays_closed_until_the_cut_goes_on(seed: int, x: float, until_y: float, distance: float) -> None:
    found, rng = forest(), np.random.default_rng(seed)
    whole = _surface(found)
    cut = cut_forest(found, plane(x, until_y), distance)
    opened = _area(found, cut)
    assert _surface(found) == pytest.approx(whole + opened, rel=1e-12)
    changed = found.copied()
    for _ in range(4):
        found.refine(rng.choice(found.leaves(), 20))
        assert _surface(found) == pytest.approx(whole + opened, rel=1e-12)  # refinement opens nothing
        changed.refine(rng.choice(changed.leaves(), 20))
        changed.coarsen(rng.choice(changed.leaves(), changed.n_cells // 2, replace=False))
        assert _surface(changed) == pytest.approx(whole + opened, rel=1e-12)
    there = swept_blade([[[x + 0.2 * y, y, -5.0], [x + 0.2 * y, y, 25.0]] for y in (until_y, 16.0)])
    on = cut_forest(found, there, distance, earlier=plane(x, until_y))
    assert _surface(found) == pytest.approx(whole + opened + _area(found, on), rel=1e-12)
    check(found)
    sizes = np.bincount(forest_pieces(found), found.volumes(np.sort(found.leaves())))
    assert sizes[1] > 0.1 * SIZE**3  # parted; beside the two there may be splinters of cells that were bisected in between


@pytest.mark.parametrize("seed", range(10))
def test_a_blade_in_steps_between_which_the_mesh_is_refined_leaves_no_splinter(seed: int) -> None:
    """Two pieces, one on each side of a plane in any direction, however many cells are bisected at random between the steps."""
    rng, found = np.random.default_rng(seed), forest()
    edge, way, normal = np.linalg.qr(rng.normal(size=(3, 3)))[0].T
    centre, distance = np.array([0.0, 0.0, 10.0]) + rng.uniform(-3.0, 3.0, 3), float(rng.choice([3.0, 5.0]))
    poses = centre + np.linspace(-24.0, 24.0, 9)[:, None, None] * way + np.array([[-40.0], [40.0]]) * edge
    for k in range(8):
        found.refine(rng.choice(found.leaves(), 20))
        cut = cut_forest(found, swept_blade(poses[k : k + 2]), distance, earlier=swept_blade(poses[: k + 1]) if k else None)
        assert cut.deviation_mm <= 0.5 * distance
    check(found, 2)
    leaves = np.sort(found.leaves())
    height = (found.points[found.simplices[leaves].astype(np.int64)].mean(axis=1) - centre) @ normal
    piece = forest_pieces(found)
    assert len(set(piece[height > distance]) | set(piece[height < -distance])) == 2
    assert not set(piece[height > distance]) & set(piece[height < -distance])


def _surface(found: BisectionForest) -> float:
    faces, _ = found.boundary_faces()
    return _areas(found, faces)


def _area(found: BisectionForest, cut: ForestCut) -> float:
    return _areas(found, cut.faces.reshape(-1, 2))


def _areas(found: BisectionForest, faces: IntArray) -> float:
    corners = [np.delete(found.simplices[t], s) for t, s in faces.tolist()]
    a, b, c = found.points[np.array(corners).reshape(-1, 3)].transpose(1, 0, 2)
    return 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def test_cells_near_a_cut_are_coarsened_again_but_for_those_that_it_runs_through() -> None:
    found = forest()
    cut_forest(found, plane(0.4), 2.0)
    fine = found.n_cells
    while found.coarsen(found.leaves()):
        pass
    check(found, 2)
    assert found.n_cells < 0.9 * fine


def test_fields_history_mass_and_momentum_are_kept() -> None:
    found, rng = forest(), np.random.default_rng(4)
    found.refine(rng.choice(found.leaves(), 30))
    gradient, history = rng.normal(size=(3, 3)), rng.normal(size=(found.cell_rows, 2))
    positions = found.points @ (np.eye(3) + 0.05 * gradient)
    mass = np.zeros(found.cell_rows)
    mass[found.leaves()] = found.volumes(found.leaves())
    total, kept = mass.sum(), history.copy()
    cut = cut_forest(found, plane(0.4), 4.0, positions=positions)
    after = cut.nodal(found, positions)
    used = found.node_used
    np.testing.assert_allclose(after[used], (found.points @ (np.eye(3) + 0.05 * gradient))[used], atol=1e-12)
    np.testing.assert_array_equal(history, kept)  # of the caller
    root = found.leaves()
    while (later := root >= len(kept)).any():
        root = np.where(later, found.parents[root], root)
    np.testing.assert_array_equal(cut.cellwise(found, history)[found.leaves()], kept[root])
    assert cut.cellwise(found, mass, extensive=True)[found.leaves()].sum() == pytest.approx(total, rel=1e-13)


def _arrays(found: BisectionForest) -> list[FloatArray]:
    leaf = found.leaf_mesh()
    return [leaf.mesh.points, leaf.mesh.cells, leaf.cells, found.neighbours[leaf.cells], found.levels[leaf.cells]]


@pytest.mark.parametrize(
    ("distance", "angle", "said"),
    [(4.0, 60.0, "less than 60"), (0.0, None, "distance_mm"), (90.0, None, "larger than the body"), (np.nan, None, "distance_mm")],
)
def test_what_is_refused_leaves_the_forest_as_it_was(distance: float, angle: float | None, said: str) -> None:
    found = forest()
    before = _arrays(found)
    with pytest.raises(InputError, match=said):
        cut_forest(found, plane(0.4), distance, least_angle_deg=angle)
    for then, now in zip(before, _arrays(found), strict=True):
        np.testing.assert_array_equal(then, now)


def test_triangles_inverted_cells_and_lost_positions_are_refused() -> None:
    found = forest()
    with pytest.raises(InputError, match="inverted"):
        cut_forest(found, plane(0.4), 2.0, positions=found.points * [1.0, 1.0, -1.0])
    with pytest.raises(InputError, match="not finite"):
        cut_forest(found, plane(0.4), 2.0, positions=np.where(np.arange(found.node_rows)[:, None] == 5, np.inf, found.points))
    with pytest.raises(InputError, match="tetrahedra, not of triangles"):
        cut_forest(BisectionForest.of(rectangle((1.0, 1.0), (2, 2))), plane(0.4), 0.5)
