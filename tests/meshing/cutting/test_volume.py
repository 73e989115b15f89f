"""Cutting of tetrahedral meshes: volume, conformity, distance from the blade, pieces, fronts, crossing cuts, and what is kept."""

from __future__ import annotations

import functools
import operator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import Delaunay

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.core.rigid_transform import RigidTransform, rotation_matrix
from naibu.meshing import SweptBlade, VolumeCut, blade_poses, box, cut_volume, signed_volumes, swept_blade
from naibu.meshing.quality import smallest_dihedral_angle
from naibu.meshing.surface import boundary_faces

SIZE = 20.0


def cube(divisions: int = 4) -> Mesh:
    return box((SIZE, SIZE, SIZE), (divisions, divisions, divisions), cell_type="tetra", layers=[("low", 10.0), ("high", 10.0)])


def plane(x: float = 0.3, *, tilt: float = 0.0, until_y: float = 15.0, from_z: float = -5.0) -> SweptBlade:
    """A blade that stands upright from `from_z` to above the cube and moves along y from before the cube to `until_y`."""
    y = np.linspace(-15.0, until_y, 5)
    return swept_blade(np.stack([[[x + tilt * v, v, from_z], [x + tilt * v, v, SIZE + 5.0]] for v in y]))


def volume(mesh: Mesh) -> float:
    return float(signed_volumes(mesh).sum())


def check(before: Mesh, cut: VolumeCut, distance: float) -> None:
    """What holds for every cut."""
    assert volume(cut.mesh) == pytest.approx(volume(before), rel=1e-12)
    assert signed_volumes(cut.mesh).min() > 0.0
    assert cut.deviation_mm <= 0.5 * distance
    faces = np.sort(cut.mesh.cells[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3), axis=1)
    assert np.unique(faces, axis=0, return_counts=True)[1].max() <= 2  # conforming: no face of more than two cells
    # the cells of a piece, and no others, share nodes across faces; two pieces share none
    for piece in range(cut.n_pieces):
        own = np.unique(cut.mesh.cells[cut.piece == piece])
        others = np.unique(cut.mesh.cells[cut.piece != piece])
        assert not np.intersect1d(own, others).size
    kept = np.zeros(before.n_cells)
    np.add.at(kept, cut.parents, signed_volumes(cut.mesh))
    np.testing.assert_allclose(kept, signed_volumes(before), rtol=1e-9)
    np.testing.assert_array_equal(before.regions[cut.parents], cut.mesh.regions)
    first, second = np.split(cut.faces, 2)
    np.testing.assert_allclose(cut.mesh.points[first].mean(axis=1), cut.mesh.points[second].mean(axis=1), atol=1e-12)
    added = _area(cut.mesh.points, cut.faces)  # what the cut says is new is what the surface of the mesh grew by
    assert _area(cut.mesh.points, boundary_faces(cut.mesh).faces) - _area(before.points, boundary_faces(before).faces) == pytest.approx(
        added, abs=1e-8
    )


def _area(points: FloatArray, faces: np.ndarray) -> float:
    return 0.5 * float(np.linalg.norm(_area_vectors(points, faces), axis=1).sum())


@pytest.mark.parametrize("distance", [8.0, 2.0])
def test_a_whole_cut_gives_two_pieces_of_the_volumes_on_both_sides(distance: float) -> None:
    cut = cut_volume(cube(), plane(2.0), distance)
    check(cube(), cut, distance)
    assert cut.n_pieces == 2
    volumes = [signed_volumes(cut.mesh)[cut.piece == k].sum() for k in (0, 1)]
    assert abs(volumes[0] - 12.0 * SIZE**2) < 0.5 * distance * SIZE**2
    area = 0.5 * _area_vectors(cut.mesh.points, np.split(cut.faces, 2)[0]).sum(axis=0)
    assert abs(area[0]) == pytest.approx(SIZE**2, rel=1e-9)  # seen along x, facets cover the section exactly once


def _area_vectors(points: FloatArray, faces: np.ndarray) -> FloatArray:
    a, b, c = points[faces].transpose(1, 0, 2)
    return np.cross(b - a, c - a)


def test_faces_of_the_two_sides_look_at_each_other() -> None:
    cut = cut_volume(cube(), plane(0.3, tilt=0.1), 3.0)
    first, second = np.split(cut.faces, 2)
    np.testing.assert_allclose(_area_vectors(cut.mesh.points, first), -_area_vectors(cut.mesh.points, second), atol=1e-9)


def test_a_cut_that_ends_inside_leaves_one_piece_with_a_front() -> None:
    cut = cut_volume(cube(), plane(0.3, until_y=0.0), 2.0)
    check(cube(), cut, 2.0)
    assert cut.n_pieces == 1
    assert len(cut.faces) > 0
    first, second = np.split(cut.faces, 2)
    shared = np.intersect1d(first, second)  # nodes of the front belong to both sides
    assert len(shared) > 0
    assert np.abs(cut.mesh.points[shared][:, 1]).max() < 4.0


def test_crossing_cuts_give_four_pieces_and_cells_hang_on_faces_only() -> None:
    first = cut_volume(cube(), plane(0.3), 4.0)
    crossing = np.stack([[[v, 0.2, -5.0], [v, 0.2, SIZE + 5.0]] for v in np.linspace(-15.0, 15.0, 4)])
    second = cut_volume(first.mesh, swept_blade(crossing), 4.0)
    check(first.mesh, second, 4.0)
    assert second.n_pieces == 4
    volumes = [signed_volumes(second.mesh)[second.piece == k].sum() for k in range(4)]
    np.testing.assert_allclose(volumes, SIZE**3 / 4.0, rtol=0.35)


def test_a_blade_that_goes_on_step_by_step_cuts_as_in_one_go() -> None:
    mesh, ys = cube(), np.linspace(-15.0, 15.0, 31)
    steps = [swept_blade([[[1.3 + 0.1 * y, y, -5.0], [1.3 + 0.1 * y, y, 25.0]] for y in ys[k : k + 2]]) for k in range(30)]
    cut, first = None, mesh
    for k, blade in enumerate(steps):
        before = mesh if cut is None else cut.mesh
        earlier = None if k == 0 else functools.reduce(operator.add, steps[max(0, k - 8) : k])
        made = cut_volume(before, blade, 2.0, forest=None if cut is None else cut.forest, earlier=earlier)
        check(before, made, 2.0)
        assert cut is None or (cut.forest is not made.forest and cut.forest.n_cells == cut.mesh.n_cells)
        cut = made
    whole = cut_volume(first, plane(1.3, tilt=0.1), 2.0)
    assert cut is not None and cut.n_pieces == whole.n_pieces == 2
    assert cut.smallest_angle_deg == pytest.approx(45.0, abs=1e-6)
    sizes = [np.bincount(c.piece, signed_volumes(c.mesh)) for c in (cut, whole)]
    np.testing.assert_allclose(sizes[0], sizes[1], rtol=0.02)
    with pytest.raises(InputError, match="give that of the cut that made the mesh"):
        cut_volume(mesh, steps[0], 2.0, forest=cut.forest)


@pytest.mark.parametrize("seed", range(4))
def test_a_blade_that_goes_on_step_by_step_parts_irregular_meshes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    corners = np.array(list(np.ndindex(2, 2, 2)), dtype=float)
    points = SIZE * np.concatenate([corners, rng.uniform(size=(40, 3))])
    cells = Delaunay(points).simplices.astype(np.int64)
    turned = np.linalg.det(points[cells][:, 1:] - points[cells][:, :1]) < 0.0
    cells[turned, 2:] = cells[turned, 3:1:-1]
    before = mesh = Mesh.from_arrays(points, cells, "tetra")
    edge, way, bulge = np.linalg.qr(rng.normal(size=(3, 3)))[0].T
    s = np.linspace(-24.0, 24.0, 33)[:, None]
    poses = (10.0 + s * way + 2.0 * np.sin(0.15 * s) * bulge)[:, None] + np.array([[-40.0], [40.0]]) * edge
    swept = [swept_blade(poses[k : k + 2]) for k in range(32)]
    cut = None
    for k, blade in enumerate(swept):
        made = cut_volume(mesh, blade, 3.0, forest=None if cut is None else cut.forest, earlier=sum(swept[1:k], swept[0]) if k else None)
        check(mesh, made, 3.0)
        cut, mesh = made, made.mesh
    assert cut is not None
    whole = cut_volume(before, swept_blade(poses), 3.0)
    sizes = [np.bincount(c.piece, signed_volumes(c.mesh)) for c in (cut, whole)]
    assert sizes[0][:2].sum() > 0.999 * SIZE**3  # besides the two, nothing but splinters
    np.testing.assert_allclose(sizes[0][:2], sizes[1][:2], rtol=0.02)


def test_a_closed_path_cuts_a_column_out() -> None:
    around = [[5.0 * np.cos(t), 5.0 * np.sin(t)] for t in np.linspace(0.0, 2.0 * np.pi, 25)]
    cut = cut_volume(cube(6), swept_blade(np.stack([[[x, y, -1.0], [x, y, SIZE + 1.0]] for x, y in around])), 2.0)
    check(cube(6), cut, 2.0)
    assert cut.n_pieces == 2
    column = signed_volumes(cut.mesh)[cut.piece == 1].sum()
    assert column == pytest.approx(np.pi * 25.0 * SIZE, rel=0.15)


def test_a_blade_through_nodes_and_along_faces_cuts_all_the_same() -> None:
    cut = cut_volume(cube(), plane(0.0), 10.0)  # x = 0 is a plane of faces of the mesh
    check(cube(), cut, 10.0)
    assert cut.n_pieces == 2
    assert cut.deviation_mm < 1e-9
    assert cut.mesh.n_cells == cube().n_cells  # nothing to refine
    np.testing.assert_allclose([signed_volumes(cut.mesh)[cut.piece == k].sum() for k in (0, 1)], SIZE**3 / 2.0)


def test_a_blade_outside_leaves_the_mesh_as_it_was() -> None:
    mesh = cube()
    cut = cut_volume(mesh, plane(100.0), 2.0)
    assert len(cut.faces) == 0
    assert cut.n_pieces == 1
    np.testing.assert_array_equal(cut.mesh.points, mesh.points)
    np.testing.assert_array_equal(np.sort(cut.mesh.cells, axis=1), np.sort(mesh.cells, axis=1))


def test_linear_fields_momentum_and_regions_are_kept() -> None:
    mesh = cube()
    rng = np.random.default_rng(3)
    gradient, velocity = rng.normal(size=(3, 3)), rng.normal(size=(mesh.n_points, 3))
    cut = cut_volume(mesh, plane(0.4, tilt=0.2), 2.0)
    np.testing.assert_allclose(cut.nodal(mesh.points @ gradient), cut.mesh.points @ gradient, atol=1e-12)

    def momentum(m: Mesh, v: FloatArray) -> FloatArray:
        return np.asarray((signed_volumes(m)[:, None] * v[m.cells].mean(axis=1)).sum(axis=0))

    np.testing.assert_allclose(momentum(cut.mesh, cut.nodal(velocity)), momentum(mesh, velocity), rtol=1e-10)
    np.testing.assert_array_equal(cut.cellwise(mesh.regions), cut.mesh.regions)


def test_the_blade_passes_the_deformed_body() -> None:
    mesh = cube()
    moved = mesh.points + np.array([50.0, 0.0, 0.0])
    assert len(cut_volume(mesh, plane(2.0), 4.0, positions=moved).faces) == 0
    cut = cut_volume(mesh, plane(52.0), 4.0, positions=moved)
    assert cut.n_pieces == 2
    np.testing.assert_allclose(cut.positions, cut.mesh.points + np.array([50.0, 0.0, 0.0]), atol=1e-12)


@settings(max_examples=15, deadline=None)
@given(st.floats(-8.0, 8.0), st.floats(-0.6, 0.6), st.floats(-14.0, 14.0), st.floats(-4.0, 18.0), st.sampled_from([2.5, 5.0]))
def test_any_cut_keeps_volume_quality_and_distance(x: float, tilt: float, until_y: float, from_z: float, distance: float) -> None:
    mesh = cube(3)
    cut = cut_volume(mesh, plane(x, tilt=tilt, until_y=until_y, from_z=from_z), distance)
    check(mesh, cut, distance)
    assert cut.smallest_angle_deg > 15.0


@st.composite
def blades(draw: st.DrawFn) -> SweptBlade:
    """A straight edge that moves and turns at random, through the cube or not, in two to four poses."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    poses = draw(st.integers(2, 4))
    start, way = np.array([0.0, 0.0, 10.0]) + rng.uniform(-12.0, 12.0, 3), rng.normal(size=3)
    edge = np.cross(way, rng.normal(size=3))
    edge /= np.linalg.norm(edge)
    length, turns = rng.uniform(5.0, 40.0), rng.normal(scale=0.3, size=(poses, 3))
    centres = start + np.cumsum(rng.uniform(2.0, 10.0, poses))[:, None] * way / np.linalg.norm(way)
    edges = edge + turns * np.arange(poses)[:, None]
    return swept_blade(centres[:, None] + 0.5 * length * np.array([-1.0, 1.0])[:, None] * edges[:, None])


@settings(max_examples=15, deadline=None)
@given(blades(), blades(), st.sampled_from([2.5, 4.0]))
def test_two_random_blades_that_may_cross(first: SweptBlade, second: SweptBlade, distance: float) -> None:
    mesh = cube(3)
    once = cut_volume(mesh, first, distance)
    check(mesh, once, distance)
    twice = cut_volume(once.mesh, second, distance)
    check(once.mesh, twice, distance)
    assert min(once.smallest_angle_deg, twice.smallest_angle_deg) > 15.0


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([2.0, 4.0, 6.0]))
def test_a_plane_through_a_cube_leaves_two_pieces_and_no_splinter(seed: int, distance: float) -> None:
    rng = np.random.default_rng(seed)
    (u, v, normal), centre = np.linalg.qr(rng.normal(size=(3, 3)))[0].T, np.array([0.0, 0.0, 10.0]) + rng.uniform(-6.0, 6.0, 3)
    cut = cut_volume(cube(), swept_blade(centre + 60.0 * np.array([[-u - v, v - u], [u - v, u + v]])), distance)
    check(cube(), cut, distance)
    assert cut.n_pieces == 2
    side = (cut.mesh.points[cut.mesh.cells].mean(axis=1) - centre) @ normal
    for piece in (0, 1):  # cells of a piece that lie wholly beyond the tolerance are on one side of the plane
        signs = np.sign(side[(cut.piece == piece) & (np.abs(side) > distance)])
        assert len(np.unique(signs)) <= 1


@pytest.mark.parametrize("seed", [0, 1, 2, 3, 4, 5, 38, 49, 58, 74, 96])
def test_planes_that_cross_at_more_than_half_a_right_angle_leave_four_pieces(seed: int) -> None:
    """And no splinters, on cubes and on Delaunay's cells; the second cut is of the mesh as it is, or of its forest."""
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    angle = rng.uniform(np.pi / 4, np.pi / 2)
    normals = np.array([[1.0, 0.0, 0.0], [np.cos(angle), np.sin(angle), 0.0]]) @ turn.T
    centre = np.array([0.0, 0.0, 10.0]) + rng.uniform(-1.5, 1.5, 3)
    mesh, distance = cube(3) if seed % 2 else _delaunay(rng), float(rng.choice([1.6, 2.4]))
    forest = None
    for normal in normals:
        u = np.linalg.svd(normal[None])[2][1:]
        cut = cut_volume(
            mesh, swept_blade(centre + 60.0 * np.array([[-u[0] - u[1], u[1] - u[0]], [u[0] - u[1], u[0] + u[1]]])), distance, forest=forest
        )
        check(mesh, cut, distance)
        mesh, forest = cut.mesh, cut.forest if seed % 4 < 2 else None
    side = (mesh.points[mesh.cells].mean(axis=1) - centre) @ normals.T
    far = (np.abs(side) > 0.5 * distance).all(axis=1)
    above = (side > 0.0) @ [1, 2]
    pieces = [np.unique(cut.piece[far & (above == quarter)]) for quarter in range(4)]
    assert sorted(len(piece) for piece in pieces) == [1, 1, 1, 1] and len(np.unique(np.concatenate(pieces))) == 4
    assert cut.n_pieces == 4


def _delaunay(rng: np.random.Generator) -> Mesh:
    """Random cells of a cube; nodes of its faces and edges have moved along them."""
    grid = box((SIZE, SIZE, SIZE), (3, 3, 3), cell_type="tetra").points - [0.0, 0.0, 10.0]
    moved = grid + np.where(np.abs(grid) < 9.9, rng.uniform(-2.0, 2.0, grid.shape), 0.0)
    points = np.concatenate([moved, rng.uniform(-9.0, 9.0, (20, 3))]) + np.array([0.0, 0.0, 10.0])
    cells = Delaunay(points).simplices
    volumes = np.linalg.det(points[cells[:, 1:]] - points[cells[:, :1]])
    cells[volumes < 0.0] = cells[volumes < 0.0][:, [0, 1, 3, 2]]
    return Mesh.from_arrays(points, cells[np.abs(volumes) > 1e-6], "tetra")


@pytest.mark.parametrize("thickness", [2.4, 1.2])
def test_slices_that_are_thinner_than_a_cell_are_cut_off(thickness: float) -> None:
    mesh = box((SIZE, SIZE, SIZE), (2, 2, 2), cell_type="tetra")  # centres of cells lie 2.5 mm and more inside
    cut = cut_volume(mesh, plane(10.0 - thickness), 1.5)
    check(mesh, cut, 1.5)
    assert cut.n_pieces == 2
    assert abs(signed_volumes(cut.mesh)[cut.piece == 1].sum() / SIZE**2 - thickness) < 0.75


def test_a_blade_that_goes_back_along_its_cut_has_cut() -> None:
    there = [[[1.0, y, -5.0], [1.0, y, 25.0]] for y in (-15.0, 15.0)]
    assert cut_volume(cube(), swept_blade(there + there[::-1]), 3.0).n_pieces == 2
    assert cut_volume(cube(), swept_blade(there + there[::-1] + there), 3.0).n_pieces == 2


def test_the_smallest_dihedral_angle_on_cubes_is_45_degrees_however_fine_the_cut() -> None:
    # of Kuhn's tetrahedra and of both other classes of similar cells that bisection makes of them (Maubach 1995)
    for divisions, distance in ((2, 6.0), (4, 3.0), (4, 1.2)):
        mesh = box((SIZE, SIZE, SIZE), (divisions, divisions, divisions), cell_type="tetra")
        assert cut_volume(mesh, plane(0.3, tilt=0.3), distance).smallest_angle_deg == pytest.approx(45.0, abs=1e-6)


@settings(max_examples=5, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_angles_on_irregular_meshes_stay_above_a_tenth_of_those_before(seed: int) -> None:
    mesh = cube()
    inside = (np.abs(mesh.points - [0.0, 0.0, 10.0]) < 9.0).all(axis=1)
    points = mesh.points + np.where(inside[:, None], np.random.default_rng(seed).uniform(-1.2, 1.2, mesh.points.shape), 0.0)
    moved = Mesh(points, mesh.cells, "tetra", mesh.regions, mesh.region_names)
    cut = cut_volume(moved, plane(0.3, tilt=0.3), 2.0)
    check(moved, cut, 2.0)
    assert cut.smallest_angle_deg >= 0.1 * smallest_dihedral_angle(points, mesh.cells)


def test_a_cut_that_would_lose_quality_is_refused() -> None:
    mesh = cube()
    points, cells = mesh.points.copy(), mesh.cells.copy()
    with pytest.raises(InputError, match=r"45 degrees would be made, less than 46; choose a larger distance.*The mesh is as it was"):
        cut_volume(mesh, plane(0.3, tilt=0.3), 1.5, least_angle_deg=46.0)
    np.testing.assert_array_equal(mesh.points, points)
    np.testing.assert_array_equal(mesh.cells, cells)


def test_poses_carry_the_edge() -> None:
    poses = [RigidTransform.of(rotation_matrix(np.array([0.0, 0.0, a])), (0.0, 0.0, 1.0)) for a in (0.0, np.pi / 2)]
    np.testing.assert_allclose(blade_poses([[1.0, 0, 0], [2.0, 0, 0]], poses)[1], [[0, 1, 1], [0, 2, 1]], atol=1e-12)


def test_what_cannot_be_cut_is_refused() -> None:
    mesh = cube()
    for distance in (0.0, -1.0, np.nan):
        with pytest.raises(InputError, match="distance_mm"):
            cut_volume(mesh, plane(), distance)
    with pytest.raises(InputError, match="larger than the body"):
        cut_volume(mesh, plane(), 100.0)
    with pytest.raises(InputError, match="sweeps no area"):
        swept_blade([[[0.0, 0, 0], [1.0, 0, 0]], [[2.0, 0, 0], [3.0, 0, 0]]])
    with pytest.raises(InputError, match="not finite in pose 1"):
        swept_blade([[[0.0, 0, 0], [1.0, 0, 0]], [[0.0, 1, np.nan], [1.0, 1, 0]]])
    with pytest.raises(InputError, match="at least two poses"):
        swept_blade([[[0.0, 0, 0], [1.0, 0, 0]]])
    with pytest.raises(InputError, match="not 'hexahedron' cells"):
        cut_volume(box((1.0, 1.0, 1.0), (1, 1, 1)), plane(), 0.5)
    flat = mesh.points * np.array([1.0, 1.0, -1.0])
    with pytest.raises(InputError, match="is inverted"):
        cut_volume(mesh, plane(), 2.0, positions=flat)
    twice = Mesh.from_arrays(mesh.points, np.concatenate([mesh.cells, mesh.cells[:1], mesh.cells[:1]]), "tetra")
    with pytest.raises(InputError, match="share"):
        cut_volume(twice, plane(), 10.0)
    alone = Mesh.from_arrays(mesh.points[mesh.cells[0]], [[0, 1, 2, 3], [0, 1, 2, 3]], "tetra")
    with pytest.raises(InputError, match="cells 0 and 1 have the same nodes"):
        cut_volume(alone, plane(), 1.0)
    lost = mesh.points.copy()
    lost[3] = np.nan
    with pytest.raises(InputError, match="1 of 125 nodes are not finite"):
        cut_volume(mesh, plane(), 2.0, positions=lost)


@pytest.mark.parametrize("touching", ["edge", "node"])
def test_pieces_that_touched_elsewhere_do_not_hang_on_an_edge_or_a_node(touching: str) -> None:
    """A chain of cubes whose ends touch at a mere edge or node, as meshes from label volumes do: parted in the middle, they come free."""
    chains = {
        "edge": [(1, 1, 0), (0, 1, 0), (0, 2, 0), (0, 3, 0), (1, 3, 0), (2, 3, 0), (2, 2, 0)],
        "node": [(1, 1, 0), (0, 1, 0), (0, 2, 0), (0, 3, 0), (0, 3, 1), (1, 3, 1), (2, 3, 1), (2, 2, 1)],
    }
    whole = box((40.0, 40.0, 20.0), (4, 4, 2), cell_type="tetra")
    place = np.floor((whole.points[whole.cells].mean(axis=1) - whole.points.min(axis=0)) / 10.0).astype(int)
    kept = whole.cells[np.isin(place @ [16, 4, 1], np.array(chains[touching]) @ [16, 4, 1])]
    used, cells = np.unique(kept, return_inverse=True)
    chain = Mesh.from_arrays(whole.points[used], cells.reshape(kept.shape), "tetra")
    x, y = whole.points.min(axis=0)[:2] + np.array([-6.0, 24.7])  # through the third cube
    blade = swept_blade(np.stack([[[x + v, y, -5.0], [x + v, y, 25.0]] for v in np.linspace(0.0, 19.0, 5)]))
    cut = cut_volume(chain, blade, 4.0)
    assert cut.n_pieces == 2
    check(chain, cut, 4.0)
