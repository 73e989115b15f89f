"""Boundaries, tributary areas, selections, and interfaces."""

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.meshing.element_conversion import to_quadratic, to_tetra
from naibu.meshing.interfaces import split_at_plane
from naibu.meshing.primitives import box, cylinder, half_ellipsoid
from naibu.meshing.quality import check, duplicate_points, signed_volumes
from naibu.meshing.surface import (
    boundary_faces,
    boundary_nodes,
    face_normals,
    faces_among,
    faces_towards,
    node_areas,
    nodes_on_plane,
    side_nodes,
    triangles_of_faces,
)


def box_of(cell_type: str) -> Mesh:
    mesh = box((6, 4, 2), (3, 2, 2), layers=[("a", 1), ("b", 1)], cell_type="hexahedron" if cell_type == "hexahedron" else "tetra")
    return to_quadratic(mesh) if cell_type == "tetra10" else mesh


@pytest.mark.parametrize("cell_type", ["hexahedron", "tetra", "tetra10"])
def test_areas_of_a_box(cell_type):
    mesh = box_of(cell_type)
    assert node_areas(mesh).sum() == pytest.approx(2 * (24 + 12 + 8))
    top = faces_towards(mesh, (0, 0, 1), max_angle_deg=10)
    assert (mesh.points[top][:, :, 2] == 2).all()
    areas = node_areas(mesh, top)
    assert areas.sum() == pytest.approx(24)
    if cell_type == "tetra10":
        assert (areas[top[:, :3]] == 0).all()
    # A uniform pressure has its resultant in the middle of the face.
    np.testing.assert_allclose(areas @ mesh.points / 24, [0, 0, 2], atol=1e-12)
    assert set(np.unique(top)) == set(side_nodes(mesh, "z+"))
    assert len(faces_among(mesh, side_nodes(mesh, "z+"))) == len(top)


@pytest.mark.parametrize("cell_type", ["hexahedron", "tetra", "tetra10"])
def test_triangles_keep_area_and_orientation(cell_type):
    mesh = box_of(cell_type)
    faces = boundary_faces(mesh).faces
    triangles = triangles_of_faces(faces)
    np.testing.assert_allclose(face_normals(mesh.points, triangles).sum(axis=0), 0, atol=1e-12)
    centre = mesh.points[triangles].mean(axis=1) - [0, 0, 1]
    assert (np.einsum("fi,fi->f", centre, face_normals(mesh.points, triangles)) > 0).all()


def test_triangles_of_hexahedra_match_their_tetrahedra():
    mesh = half_ellipsoid((30, 20, 10), 5)
    from_faces = np.sort(triangles_of_faces(boundary_faces(mesh).faces), axis=1)
    from_cells = np.sort(boundary_faces(to_tetra(mesh)).faces, axis=1)
    assert set(map(tuple, from_faces)) == set(map(tuple, from_cells))


def test_area_of_a_hemisphere_approaches_its_closed_form():
    mesh = half_ellipsoid((20, 20, 10), 1.5)
    assert node_areas(mesh).sum() == pytest.approx(3 * np.pi * 100, rel=0.01)


def test_selection_by_plane():
    mesh = box((6, 4, 2), (3, 2, 2))
    assert len(nodes_on_plane(mesh, (0, 0, 1), (0, 0, -5))) == 12
    assert len(nodes_on_plane(mesh, (1, 0, 0), (1, 0, 0))) == 9
    assert len(nodes_on_plane(mesh, (0.5, 0, 0), (1, 0, 0))) == 0
    assert len(boundary_nodes(mesh)) == mesh.n_points - 2
    with pytest.raises(InputError, match="normal is"):
        nodes_on_plane(mesh, (0, 0, 0), (0, 0, 0))
    with pytest.raises(InputError, match="'up'"):
        side_nodes(mesh, "up")


def test_a_face_shared_by_three_cells_is_named():
    mesh = box((1, 1, 1), (1, 1, 2))
    cells = np.vstack([mesh.cells, mesh.cells[:1]])
    with pytest.raises(InputError, match="share the face"):
        boundary_faces(Mesh.from_arrays(mesh.points, cells, "hexahedron"))


@pytest.mark.parametrize("cell_type", ["hexahedron", "tetra", "tetra10"])
def test_splitting_opens_the_interface_and_nothing_else(cell_type):
    mesh = box_of(cell_type)
    split, pairs = split_at_plane(mesh, 1.0)
    check(split)
    np.testing.assert_allclose(signed_volumes(split), signed_volumes(mesh))
    assert (split.points[pairs[:, 0]] == split.points[pairs[:, 1]]).all()
    assert (split.points[pairs, 2] == 1).all()
    assert len(duplicate_points(split)) == len(pairs) == len(nodes_on_plane(mesh, (0, 0, 1), (0, 0, 1)))
    upper = np.unique(split.cells[split.regions == 1])
    assert set(pairs[:, 1]) <= set(upper)
    assert not set(pairs[:, 0]) & set(upper)
    assert node_areas(split).sum() == pytest.approx(node_areas(mesh).sum() + 2 * 24)


def test_a_plane_through_cells_or_outside_is_refused():
    mesh = cylinder(10, 10, 2, layers=[("a", 4), ("b", 6)])
    with pytest.raises(InputError, match=r"crosses z = 4\.5"):
        split_at_plane(mesh, 4.5)
    with pytest.raises(InputError, match="no cells meet at z = 10"):
        split_at_plane(mesh, 10)
