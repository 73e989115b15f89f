"""Generated meshes against closed forms, and laws every mesh of a solid ball obeys."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.meshing.element_conversion import split_hexahedra, to_quadratic, to_tetra
from naibu.meshing.primitives import box, box_from_coordinates, cylinder, half_ellipsoid, hemisphere
from naibu.meshing.quality import check, duplicate_points, scaled_jacobians, signed_volumes, unused_nodes
from naibu.meshing.surface import CELL_FACES, boundary_faces, face_normals

STEPS = st.lists(st.floats(0.1, 5.0), min_size=1, max_size=4)
SOLIDS = {
    "box": lambda cell_type: box((40, 30, 20), (4, 3, 2), cell_type=cell_type),
    "half ellipsoid": lambda cell_type: half_ellipsoid((100, 80, 40), 12, cell_type=cell_type),
    "coarse half ellipsoid": lambda cell_type: half_ellipsoid((100, 80, 40), 60, cell_type=cell_type),
    "cylinder": lambda cell_type: cylinder(40, 30, 6, cell_type=cell_type),
}


def coordinates(steps: list[float], start: float = -3.0) -> np.ndarray:
    return start + np.concatenate([[0.0], np.cumsum(steps)])


def edges_of(mesh: Mesh) -> np.ndarray:
    faces = faces_of(mesh)
    ends = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)
    return np.unique(np.sort(ends, axis=1), axis=0)


def faces_of(mesh: Mesh) -> np.ndarray:
    local = CELL_FACES[mesh.cell_type]
    return mesh.cells[:, local].reshape(-1, local.shape[1])


@given(STEPS, STEPS, STEPS, st.sampled_from(["hexahedron", "tetra"]))
@settings(max_examples=30, deadline=None)
def test_a_tensor_grid_fills_its_box_exactly(dx, dy, dz, cell_type):
    x, y, z = coordinates(dx), coordinates(dy), coordinates(dz)
    mesh = box_from_coordinates(x, y, z, cell_type=cell_type)
    check(mesh)
    assert signed_volumes(mesh).sum() == pytest.approx(sum(dx) * sum(dy) * sum(dz), rel=1e-12)
    ix, iy, iz = len(x) - 1, 0, len(z) - 1
    assert mesh.points[ix + len(x) * (iy + len(y) * iz)].tolist() == [x[ix], y[iy], z[iz]]


@pytest.mark.parametrize("cell_type", ["hexahedron", "tetra"])
@pytest.mark.parametrize("solid", SOLIDS)
def test_solids_conform_and_have_the_topology_of_a_ball(solid, cell_type):
    mesh = SOLIDS[solid](cell_type)
    check(mesh)
    assert len(unused_nodes(mesh)) == len(duplicate_points(mesh)) == 0
    _, counts = np.unique(np.sort(faces_of(mesh), axis=1), axis=0, return_counts=True)
    assert set(counts) <= {1, 2}
    assert mesh.n_points - len(edges_of(mesh)) + len(counts) - mesh.n_cells == 1
    boundary = boundary_faces(mesh)
    assert len(boundary.faces) == (counts == 1).sum()
    assert np.abs(face_normals(mesh.points, boundary.faces).sum(axis=0)).max() < 1e-9


@pytest.mark.parametrize("solid", SOLIDS)
def test_outward_faces_enclose_the_volume(solid):
    mesh = SOLIDS[solid]("tetra")
    faces = boundary_faces(mesh).faces
    enclosed = np.einsum("fi,fi->", mesh.points[faces].mean(axis=1), face_normals(mesh.points, faces)) / 3
    assert enclosed == pytest.approx(signed_volumes(mesh).sum(), rel=1e-12)


@pytest.mark.parametrize(
    ("make", "volume"),
    [
        (lambda h: half_ellipsoid((100, 80, 40), h), np.pi / 6 * 100 * 80 * 40),
        (lambda h: hemisphere(60, h), 2 / 3 * np.pi * 30**3),
        (lambda h: cylinder(40, 30, h), np.pi * 20**2 * 30),
    ],
)
def test_round_solids_converge_at_second_order(make, volume):
    sizes = np.array([16.0, 8.0, 4.0])
    meshes = [make(h) for h in sizes]
    errors = np.array([1 - signed_volumes(mesh).sum() / volume for mesh in meshes])
    # Cell numbers are rounded, so that the true size is read off the mesh.
    true_sizes = np.array([np.cbrt(volume / mesh.n_cells) for mesh in meshes])
    slope = np.polyfit(np.log(true_sizes), np.log(errors), 1)[0]
    assert (errors > 0).all()
    assert slope == pytest.approx(2, abs=0.3)


@pytest.mark.parametrize("size", [(100, 80, 40), (60, 60, 30), (120, 80, 30), (40, 40, 40), (90, 30, 20)])
@pytest.mark.parametrize("element", [30, 10, 5])
def test_half_ellipsoids_have_good_cells(size, element):
    assert scaled_jacobians(half_ellipsoid(size, element)).min() > 0.2


def test_surface_nodes_lie_on_the_ellipsoid_and_the_flat_side_on_zero():
    mesh = half_ellipsoid((100, 80, 40), 8)
    nodes = np.unique(boundary_faces(mesh).faces)
    radius = np.linalg.norm(mesh.points[nodes] / [50, 40, 40], axis=1)
    flat = mesh.points[nodes, 2] == 0
    assert np.abs(radius[~flat] - 1).max() < 1e-12
    assert (mesh.points[:, 2] >= 0).all()
    assert flat.sum() > 20


@pytest.mark.parametrize("diameter", [10, 40])
def test_cylinder_cells_are_good_and_layers_exact(diameter):
    layers = [("gel", 4), ("bar", 3), ("gel", 5)]
    mesh = cylinder(diameter, 12, 3, layers=layers)
    assert scaled_jacobians(mesh).min() > 0.5
    assert mesh.region_names == ("gel", "bar")
    volumes = signed_volumes(mesh)
    assert volumes[mesh.regions == 1].sum() / volumes.sum() == pytest.approx(3 / 12, rel=1e-12)


def test_layers_and_breaks_fall_on_element_faces():
    mesh = box((50, 40, 30), (10, 8, 6), layers=[("soft", 11.5), ("hard", 18.5)], breaks={"x": (-6.5, 6.5)})
    x, z = np.unique(mesh.points[:, 0]), np.unique(mesh.points[:, 2])
    assert {-25.0, -6.5, 6.5, 25.0} <= set(x)
    assert {0.0, 11.5, 30.0} <= set(z)
    np.testing.assert_allclose(x, -x[::-1], atol=1e-12)
    volumes = signed_volumes(mesh)
    assert volumes[mesh.regions == 0].sum() == pytest.approx(50 * 40 * 11.5)
    assert (mesh.points[mesh.cells][mesh.regions == 0][:, :, 2] <= 11.5).all()


def test_grading_makes_cells_at_the_faces_smaller_by_its_ratio():
    x = np.unique(box((60, 10, 10), (40, 1, 1), grading=(3, 1, 1)).points[:, 0])
    steps = np.diff(x)
    assert len(steps) == 40
    assert steps.max() / steps.min() == pytest.approx(3, rel=0.06)
    np.testing.assert_allclose(steps, steps[::-1])


def test_uncentred_box_starts_at_the_origin():
    assert box((4, 3, 2), (2, 2, 2), centred=False).points.min(axis=0).tolist() == [0, 0, 0]
    assert box((4, 3, 2), (2, 2, 2)).points.min(axis=0).tolist() == [-2, -1.5, 0]


@given(st.permutations(range(27)))
@settings(max_examples=50, deadline=None)
def test_splitting_conforms_whatever_the_node_numbers(order):
    mesh = box((2, 2, 2), (2, 2, 2))
    order = np.array(order)
    points = np.empty_like(mesh.points)
    points[order] = mesh.points
    tetra = Mesh.from_arrays(points, split_hexahedra(order[mesh.cells]), "tetra")
    check(tetra)
    _, counts = np.unique(np.sort(faces_of(tetra), axis=1), axis=0, return_counts=True)
    assert (counts == 1).sum() == 2 * 24
    assert counts.max() == 2
    assert signed_volumes(tetra).sum() == pytest.approx(8)


def test_quadratic_cells_share_their_edge_nodes():
    tetra = to_tetra(cylinder(20, 10, 4, layers=[("a", 5), ("b", 5)]))
    quadratic = to_quadratic(tetra)
    assert quadratic.n_points == tetra.n_points + len(edges_of(tetra))
    np.testing.assert_allclose(signed_volumes(quadratic), signed_volumes(tetra), rtol=1e-12)
    for edge, (i, j) in enumerate([(0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)]):
        middle = tetra.points[tetra.cells[:, [i, j]]].mean(axis=1)
        np.testing.assert_allclose(quadratic.points[quadratic.cells[:, 4 + edge]], middle, atol=1e-12)
    assert (quadratic.regions == tetra.regions).all()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: box_from_coordinates([0, 1, 1], [0, 1], [0, 1]), "x coordinates"),
        (lambda: box_from_coordinates([0, 1], [0], [0, 1]), "y coordinates"),
        (lambda: box_from_coordinates([0, 1], [0, 1], [0, np.nan]), "z coordinates"),
        (lambda: box_from_coordinates([0, 1], [0, 1], [0, 1], region_of_slab=["a", "b"]), "region_of_slab"),
        (lambda: box((1, 1, 1), (1, 1, 1), cell_type="tetra10"), "to_quadratic"),
        (lambda: box((1, 1, -1), (1, 1, 1)), "size_mm"),
        (lambda: box((1, 1, 1), (1, 1.5, 1)), "divisions"),
        (lambda: box((1, 1, 1), (1, 1, 1), layers=[("a", 0.5)]), "add up to 0.5"),
        (lambda: box((1, 1, 1), (1, 1, 1), breaks={"x": [0.7]}), "breaks along x"),
        (lambda: box((1, 1, 1), (1, 1, 1), breaks={"w": [0.7]}), "'w'"),
        (lambda: half_ellipsoid((1, 1, 1), 0), "element_size_mm"),
        (lambda: to_quadratic(box((1, 1, 1), (1, 1, 1))), "to_tetra"),
    ],
)
def test_bad_measures_are_named(call, message):
    with pytest.raises(InputError, match=message):
        call()


def test_grading_with_breaks_keeps_order():
    x = np.unique(box((60, 10, 10), (12, 1, 1), grading=4, breaks={"x": (-29.9, 0, 29.9)}).points[:, 0])
    assert all(a < b for a, b in pairwise(x))
    assert {-29.9, 0.0, 29.9} <= set(x)
