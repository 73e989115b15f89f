"""Interpolation at points: exact for the fields the cells contain, and honest about points outside."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import Delaunay

from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.meshing.element_conversion import to_quadratic, to_tetra
from naibu.meshing.point_location import interpolation_operator, locate
from naibu.meshing.primitives import box, cylinder, half_ellipsoid

_ROUND = half_ellipsoid((100, 80, 40), 12)
MESHES = {
    "hexahedron": _ROUND,
    "tetra": to_tetra(_ROUND),
    "tetra10": to_quadratic(to_tetra(_ROUND)),
    "graded": box((40, 40, 30), (10, 3, 8), grading=(5, 1, 2)),
    "flat": box((100, 1, 0.1), (30, 1, 1)),
}


def points_inside(mesh: Mesh, rng: np.random.Generator, n: int) -> np.ndarray:
    """Convex combinations of the corners of random cells: inside any convex cell."""
    corners = mesh.cells[rng.integers(mesh.n_cells, size=n)][:, : 4 if mesh.cell_type == "tetra10" else None]
    return np.einsum("nk,nkx->nx", rng.dirichlet(np.ones(corners.shape[1]), size=n), mesh.points[corners])


@given(st.integers(0, 2**32 - 1), st.sampled_from(sorted(MESHES)))
@settings(max_examples=25, deadline=None)
def test_linear_fields_are_reproduced_exactly(seed, name):
    mesh, rng = MESHES[name], np.random.default_rng(seed)
    matrix, shift = rng.normal(size=(3, 3)), rng.normal(size=3)
    points = points_inside(mesh, rng, 200)
    operator = interpolation_operator(mesh, points)
    assert operator.shape == (200, mesh.n_points)
    scale = np.abs(mesh.points).max()
    np.testing.assert_allclose(operator @ (mesh.points @ matrix + shift), points @ matrix + shift, atol=1e-11 * scale, rtol=0)
    np.testing.assert_allclose(operator.sum(axis=1), 1, atol=1e-12)


@pytest.mark.parametrize("name", sorted(MESHES))
def test_nodes_are_found_at_themselves(name):
    mesh = MESHES[name]
    location = locate(mesh, mesh.points)
    assert (location.distance_mm == 0).all()
    np.testing.assert_allclose(location.weights.max(axis=1), 1, atol=1e-9)
    operator = interpolation_operator(mesh, mesh.points)
    values = np.random.default_rng(0).normal(size=mesh.n_points)
    np.testing.assert_allclose(operator @ values, values, atol=1e-8)


def test_quadratic_cells_reproduce_quadratic_fields():
    mesh, rng = MESHES["tetra10"], np.random.default_rng(1)
    points = points_inside(mesh, rng, 300)
    quadratic = rng.normal(size=(3, 3))

    def field(x: np.ndarray) -> np.ndarray:
        return np.einsum("ni,ij,nj->n", x, quadratic, x)

    np.testing.assert_allclose(interpolation_operator(mesh, points) @ field(mesh.points), field(points), atol=1e-9)


def test_curved_quadratic_cells_are_inverted():
    mesh = to_quadratic(box((2, 2, 2), (2, 2, 2), cell_type="tetra"))

    def bend(x: np.ndarray) -> np.ndarray:
        return x + np.stack([0.15 * x[:, 1] ** 2, 0 * x[:, 0], 0 * x[:, 0]], axis=1)

    straight = points_inside(mesh, np.random.default_rng(2), 200)
    bent = mesh.moved(bend(mesh.points) - mesh.points)
    operator = interpolation_operator(bent, bend(straight))
    np.testing.assert_allclose(operator @ bent.points, bend(straight), atol=1e-10)
    np.testing.assert_allclose(operator @ mesh.points, straight, atol=1e-8)


def test_twisted_hexahedra_are_inverted():
    mesh = box((20, 20, 20), (4, 4, 4))
    rng = np.random.default_rng(3)
    twisted = mesh.moved(rng.uniform(-1, 1, size=mesh.points.shape))
    inside = rng.uniform([-7, -7, 3], [7, 7, 17], size=(500, 3))
    location = locate(twisted, inside)
    assert location.weights.min() > -1e-7
    np.testing.assert_allclose(np.einsum("nk,nkx->nx", location.weights, twisted.points[twisted.cells[location.cells]]), inside, atol=1e-10)


def test_points_just_outside_are_extrapolated_and_measured():
    mesh = box((20, 20, 20), (4, 4, 4))
    points = np.array([[0, 0, -0.3], [10.2, 0, 3], [1.0, 1.0, 5.0]])
    location = locate(mesh, points)
    np.testing.assert_allclose(location.distance_mm, [0.3, 0.2, 0], atol=1e-12)
    np.testing.assert_allclose(interpolation_operator(mesh, points) @ mesh.points, points, atol=1e-12)


@pytest.mark.parametrize("cell_type", ["hexahedron", "tetra"])
def test_points_far_outside_are_listed(cell_type):
    mesh = cylinder(20, 20, 5, cell_type=cell_type)
    points = [[0, 0, 10], [0, 0, -4], [50, 0, 10]]
    with pytest.raises(InputError, match=r"2 of 3 points .*: 1 at \[0.0, 0.0, -4.0\] by 4 mm; 2 at "):
        locate(mesh, points)
    distance = locate(mesh, points, tolerance_mm=100).distance_mm
    np.testing.assert_allclose(distance, [0, 4, 40], atol=0.05)


def test_bad_points_are_named():
    mesh = box((1, 1, 1), (1, 1, 1))
    with pytest.raises(InputError, match="shape"):
        locate(mesh, [0, 0, 0])
    with pytest.raises(InputError, match=r"points_mm\[1, 1\] is nan"):
        locate(mesh, [[0, 0, 0], [0, np.nan, 0]])
    assert locate(mesh, np.zeros((0, 3))).weights.shape == (0, 8)


@pytest.mark.parametrize(("cell_type", "dimension"), [("triangle", 2), ("line", 1)])
def test_points_in_planes_and_on_lines(cell_type, dimension):
    rng = np.random.default_rng(0)
    if dimension == 2:
        points = np.vstack([[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]], rng.uniform(0.0, 1.0, (30, 2))])
        cells = Delaunay(points).simplices
    else:
        points = np.sort(np.append(rng.uniform(0.0, 1.0, 20), [0.0, 1.0]))[:, None]
        cells = np.column_stack([np.arange(21), np.arange(1, 22)])
    mesh = Mesh.from_arrays(points, cells, cell_type)
    wanted = rng.uniform(0.01, 0.99, (600, dimension))
    linear = mesh.points @ rng.standard_normal((dimension, 2)) + 1.0
    slope = np.linalg.lstsq(np.c_[mesh.points, np.ones(len(points))], linear, rcond=None)[0]
    np.testing.assert_allclose(interpolation_operator(mesh, wanted) @ linear, np.c_[wanted, np.ones(600)] @ slope, atol=1e-12)
    with pytest.raises(InputError, match="outside the mesh"):
        interpolation_operator(mesh, [[1.5] * dimension])
