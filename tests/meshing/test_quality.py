"""Measures of quality: known cells, rigid motions, and errors that name the culprit."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.meshing.element_conversion import to_quadratic, to_tetra
from naibu.meshing.primitives import box, cylinder
from naibu.meshing.quality import aspect_ratios, check, duplicate_points, min_jacobians, scaled_jacobians, signed_volumes, unused_nodes

REGULAR = np.array([[1, 1, 1], [-1, 1, -1], [1, -1, -1], [-1, -1, 1]], dtype=float)
MESHES = {
    "hexahedron": cylinder(10, 5, 2.5),
    "tetra": cylinder(10, 5, 2.5, cell_type="tetra"),
    "tetra10": to_quadratic(cylinder(10, 5, 2.5, cell_type="tetra")),
}


def test_ideal_cells_score_one():
    cube = box((3, 3, 3), (1, 1, 1))
    assert scaled_jacobians(cube) == pytest.approx(1)
    assert aspect_ratios(cube) == pytest.approx(1)
    tetra = Mesh.from_arrays(REGULAR, [[0, 1, 2, 3]], "tetra")
    tetra = tetra if signed_volumes(tetra)[0] > 0 else Mesh.from_arrays(REGULAR, [[0, 2, 1, 3]], "tetra")
    assert scaled_jacobians(tetra) == pytest.approx(1)
    assert signed_volumes(tetra) == pytest.approx(8 / 3)


@given(st.integers(0, 2**32 - 1), st.sampled_from(sorted(MESHES)))
@settings(max_examples=20, deadline=None)
def test_measures_do_not_change_under_rigid_motion(seed, cell_type):
    mesh = MESHES[cell_type]
    rng = np.random.default_rng(seed)
    turn = Rotation.random(random_state=rng).as_matrix()
    moved = mesh.moved(mesh.points @ turn.T + rng.normal(scale=50, size=3) - mesh.points)
    for measure in (signed_volumes, min_jacobians, scaled_jacobians, aspect_ratios):
        np.testing.assert_allclose(measure(moved), measure(mesh), rtol=1e-8, atol=1e-10)


@given(st.integers(0, 2**32 - 1), st.sampled_from(sorted(MESHES)))
@settings(max_examples=20, deadline=None)
def test_an_affine_map_scales_volumes_by_its_determinant(seed, cell_type):
    mesh = MESHES[cell_type]
    matrix = np.random.default_rng(seed).normal(size=(3, 3))
    moved = mesh.moved(mesh.points @ matrix.T - mesh.points)
    np.testing.assert_allclose(signed_volumes(moved), np.linalg.det(matrix) * signed_volumes(mesh), rtol=1e-8, atol=1e-10)


def test_curved_quadratic_volume_is_exact():
    # x -> x + a y^2 is a shear along x: it keeps every volume, and a quadratic cell represents it exactly.
    mesh = to_quadratic(box((2, 2, 2), (1, 1, 1), cell_type="tetra"))
    bent = mesh.moved(np.stack([0.2 * mesh.points[:, 1] ** 2, *np.zeros((2, mesh.n_points))], axis=1))
    np.testing.assert_allclose(signed_volumes(bent), signed_volumes(mesh), rtol=1e-12)


@pytest.mark.parametrize("cell_type", sorted(MESHES))
def test_the_first_inverted_cell_is_named(cell_type):
    mesh = MESHES[cell_type]
    mirrored = mesh.moved(mesh.points * [-1, 1, 1] - mesh.points)
    with pytest.raises(InputError, match=r"cell 0 of .* inverted"):
        check(mirrored)


def test_one_flat_cell_is_named():
    mesh = to_tetra(box((1, 1, 1), (1, 1, 1)))
    points = mesh.points.copy()
    cells = mesh.cells.copy()
    cells[3] = [0, 1, 2, 3]
    with pytest.raises(InputError, match=r"cell 3 of 6 .* flat"):
        check(Mesh.from_arrays(points, cells, "tetra"))


def test_unused_and_doubled_nodes_are_found():
    mesh = box((1, 1, 1), (1, 1, 1))
    more = Mesh.from_arrays(np.vstack([mesh.points, mesh.points[3]]), mesh.cells, "hexahedron")
    assert unused_nodes(more).tolist() == [8]
    assert duplicate_points(more).tolist() == [[3, 8]]
    with pytest.raises(InputError, match="node 8"):
        check(more)
