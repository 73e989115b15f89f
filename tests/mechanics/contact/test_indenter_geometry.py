"""Signed distances of rigid indenters: closed forms, and their derivatives against finite differences."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.rigid_transform import rotation_matrix
from naibu.mechanics.contact._geometry_kernels import distance_from_turned_block
from naibu.mechanics.contact.indenter_geometry import (
    IndenterGeometry,
    bar_geometry,
    box_geometry,
    capsule_geometry,
    cylinder_geometry,
    mesh_geometry,
    packed_geometries,
    plane_geometry,
    sphere_geometry,
)

TURNED = rotation_matrix(np.array([0.3, -0.5, 0.8]))
CUBE = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], dtype=float)
SIDES = np.array([[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]])
FACES = np.concatenate([SIDES[:, [0, 1, 2]], SIDES[:, [0, 2, 3]]])


def box_mesh(edges: tuple[float, float, float]) -> tuple[FloatArray, IntArray]:
    return (CUBE - 0.5) * edges, FACES


SHAPES = {
    "plane": plane_geometry((0.2, -0.4, 1.0)),
    "bar along x": bar_geometry("x", 6.0, corner_radius_mm=1.5),
    "bar along y": bar_geometry("y", 6.0, corner_radius_mm=2.9),
    "box": box_geometry((4.0, 6.0, 3.0), TURNED),
    "cylinder": cylinder_geometry(2.0, 5.0, (1.0, 2.0, -0.5)),
    "sphere": sphere_geometry(2.5),
    "capsule": capsule_geometry(1.5, 4.0, (0.0, 1.0, 1.0)),
    "mesh": mesh_geometry(*box_mesh((4.0, 6.0, 3.0))),
}


@pytest.mark.parametrize("name", SHAPES)
def test_derivatives_are_those_of_the_distance(name: str) -> None:
    """Outside and inside, where the closest feature is the same within the step of the differences."""
    shape, step = SHAPES[name], 1e-5
    points = np.random.default_rng(1).uniform(-5.0, 5.0, (400, 3))
    gap, gradient, second = shape.distance_derivatives(points)
    ahead = np.stack([np.stack([shape.distance(points + s * step * e) for e in np.eye(3)], axis=1) for s in (1.0, -1.0)])
    turned = np.stack([np.stack([shape.distance_derivatives(points + s * step * e)[1] for e in np.eye(3)], axis=1) for s in (1.0, -1.0)])
    smooth = np.abs(turned[0] - turned[1]).max(axis=(1, 2)) < 1e-2  # leaves out edges where the closest feature changes
    assert smooth.mean() > 0.95
    np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), 1.0, rtol=1e-12)
    np.testing.assert_allclose(gradient[smooth], (ahead[0] - ahead[1])[smooth] / (2.0 * step), atol=1e-5)
    clear = smooth & (np.abs(gap) > 0.05)
    np.testing.assert_allclose(second[clear], (turned[0] - turned[1])[clear] / (2.0 * step), atol=2e-3)
    assert (gap < 0.0).any() and (gap > 0.0).any()


@pytest.mark.parametrize("name", ["plane", "box"])
def test_kernels_that_take_numbers_give_the_closed_form(name: str) -> None:
    """The distance from a half space is the height; from a box that of what is beyond its faces, or the depth below the nearest one."""
    shape = SHAPES[name]
    points = np.random.default_rng(3).uniform(-5.0, 5.0, (400, 3))
    own, axes, half = points @ shape.axes.T, tuple(shape.axes.ravel()), tuple(np.resize(shape.size, 3))
    beyond = np.abs(own) - half
    gap = own[:, 2] if name == "plane" else np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)
    found = np.array([distance_from_turned_block(shape.kind, half, axes, *point) for point in points])
    np.testing.assert_allclose(found[:, 0], gap, atol=1e-12)
    ahead = np.array([distance_from_turned_block(shape.kind, half, axes, *point)[0] for point in points + 1e-6 * found[:, 1:]])
    np.testing.assert_allclose(np.linalg.norm(found[:, 1:], axis=1), 1.0, rtol=1e-12)
    np.testing.assert_allclose((ahead - gap) / 1e-6, 1.0, atol=1e-6)  # no other direction than the normal goes away as fast


@pytest.mark.parametrize("name", [name for name in SHAPES if name != "plane" and not name.startswith("bar")])
def test_a_shape_reaches_as_far_as_the_farthest_of_its_points(name: str) -> None:
    shape, spacing = SHAPES[name], 0.1
    grid = np.stack(np.meshgrid(*[np.arange(-5.0, 5.0, spacing)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = grid[shape.distance(grid) <= 0.0]
    for direction in np.vstack([np.eye(3), -np.eye(3), np.random.default_rng(4).normal(size=(10, 3))]):
        unit = direction / np.linalg.norm(direction)
        farthest = float((inside @ unit).max())
        assert farthest <= shape.reach(unit) + 1e-9
        assert shape.reach(unit) < farthest + 2.0 * spacing
    assert SHAPES["plane"].reach(np.array([0.0, 0.0, 1.0])) == np.inf


def test_a_mesh_of_a_box_is_the_box() -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform(-6.0, 6.0, (500, 3))
    edges = (4.0, 6.0, 3.0)
    exact, closed, bent = box_geometry(edges).distance_derivatives(points)
    gap, gradient, second = mesh_geometry(*box_mesh(edges)).distance_derivatives(points)
    np.testing.assert_allclose(gap, exact, atol=1e-12)
    apart = np.sort(0.5 * np.array(edges) - np.abs(points), axis=1)
    clear = (exact > 0.0) | (apart[:, 1] - apart[:, 0] > 1e-9)  # one nearest face
    np.testing.assert_allclose(gradient[clear], closed[clear], atol=1e-9)
    np.testing.assert_allclose(second[exact > 0.01], bent[exact > 0.01], atol=1e-8)


def test_a_concave_mesh_tells_inside_from_outside() -> None:
    """An L of three cubes: its hollow is outside."""
    cells = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
    quads = []
    outward = np.array([[0, 0, -1], [0, 0, 1], [0, -1, 0], [0, 1, 0], [-1, 0, 0], [1, 0, 0]])
    for cell in cells:
        for side, way in zip(SIDES, outward, strict=True):
            if tuple(np.add(cell, way)) not in cells:
                quads.append(CUBE[side] + cell)
    corners = np.array(quads).reshape(-1, 3)
    vertices, number = np.unique(corners, axis=0, return_inverse=True)
    four = number.reshape(-1, 4)
    shape = mesh_geometry(vertices, np.concatenate([four[:, [0, 1, 2]], four[:, [0, 2, 3]]]))
    points = np.random.default_rng(3).uniform(-1.0, 3.0, (600, 3))
    inside = np.zeros(len(points), dtype=bool)
    outside = np.full(len(points), np.inf)
    for cell in cells:
        distance = box_geometry((1.0, 1.0, 1.0)).distance(points - np.array(cell) - 0.5)
        inside |= distance < 0.0
        outside = np.minimum(outside, distance)
    gap = shape.distance(points)
    np.testing.assert_array_equal(gap < 0.0, inside)
    np.testing.assert_allclose(gap[~inside], outside[~inside], atol=1e-12)


def test_a_capsule_is_a_segment_at_a_distance() -> None:
    shape = SHAPES["capsule"]
    points = np.random.default_rng(4).uniform(-6.0, 6.0, (300, 3))
    axis = np.array([0.0, 1.0, 1.0]) / np.sqrt(2.0)
    nearest = np.clip(points @ axis, -2.0, 2.0)[:, None] * axis
    np.testing.assert_allclose(shape.distance(points), np.linalg.norm(points - nearest, axis=1) - 1.5, atol=1e-12)


def test_a_bar_is_a_rounded_edge() -> None:
    """Beside the corner: the distance to its circle; below and beside the bar: to its faces."""
    shape = bar_geometry("y", 6.0, corner_radius_mm=1.0)
    points = np.array([[0.0, 5.0, -2.0], [4.0, -7.0, 3.0], [2.0 + 3.0, 0.0, 1.0 - 4.0], [0.0, 0.0, 0.5]])
    np.testing.assert_allclose(shape.distance(points), [2.0, 1.0, 5.0 - 1.0, -0.5], atol=1e-12)


@pytest.mark.parametrize("name", SHAPES)
def test_the_inradius_is_the_deepest_distance(name: str) -> None:
    """Of a mesh it is a bound from below."""
    shape = SHAPES[name]
    deepest = -shape.distance(np.random.default_rng(2).uniform(-5.0, 5.0, (20000, 3))).min()
    if name == "plane":
        assert shape.inradius == np.inf
    elif name == "mesh":
        assert 0.3 * deepest < shape.inradius <= deepest
    else:
        assert 0.85 * shape.inradius < deepest <= shape.inradius + 1e-9


def test_packed_meshes_keep_apart() -> None:
    """Two meshes and a sphere in one set of arrays."""
    shapes: list[IndenterGeometry] = [SHAPES["mesh"], SHAPES["sphere"], mesh_geometry(*box_mesh((1.0, 1.0, 1.0)))]
    kinds, sizes, (vertices, triangles, _, start, boxes, first) = packed_geometries(shapes)
    assert kinds.tolist() == [6, 3, 6] and sizes.shape == (3, 3)
    assert first[:, 1].tolist() == [0, 12, 12, 24] and first[-1].tolist() == [len(start), len(triangles), len(vertices)]
    np.testing.assert_allclose(boxes[first[2, 0]], [-0.5, -0.5, -0.5, 0.5, 0.5, 0.5])


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: plane_geometry((0.0, 0.0, 0.0)), "the normal of a plane must have a length"),
        (lambda: bar_geometry("x", 2.0, corner_radius_mm=1.5), "corner radius must lie between 0 and half of its width 2 mm, not 1.5 mm"),
        (lambda: box_geometry((1.0, 0.0, 1.0)), "edges of a box must be positive, and are 1, 0, 1 mm"),
        (lambda: box_geometry((1.0, 1.0, 1.0), np.ones((3, 3))), "orthonormal"),
        (lambda: capsule_geometry(1.0, -1.0), "radius and length of a capsule"),
        (lambda: mesh_geometry(CUBE, FACES[1:]), "no closed surface"),
        (lambda: mesh_geometry(CUBE, FACES[:, ::-1]), "normals point inwards"),
        (lambda: mesh_geometry(CUBE, FACES + 1), "name vertices 0 to 7"),
    ],
)
def test_bad_input_is_named(call: object, said: str) -> None:
    with pytest.raises(InputError) as caught:
        call()  # type: ignore[operator]
    assert said in str(caught.value)
