"""Rigid indenter geometry: signed distance of a plane, bar, box, cylinder, sphere, capsule or triangle mesh, with its derivatives.

The same shapes press finite elements (`naibu.mechanics.contact.penalty_contact`) and lattices (`naibu.mechanics.lattices`). Distances are
exact outside of a shape; inside, they are those to the nearest face.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray, IntArray, as_points, as_vector, require_finite
from naibu.core.errors import InputError
from naibu.mechanics.contact._geometry_kernels import BAR, BOX, CAPSULE, CYLINDER, MESH, PLANE, SPHERE, distances
from naibu.mechanics.contact.triangle_tree import TriangleTree

KINDS = ("plane", "box", "cylinder", "sphere", "capsule", "bar", "mesh")

MeshArrays = tuple[FloatArray, IntArray, IntArray, IntArray, FloatArray, IntArray]
GeometryArrays = tuple[IntArray, FloatArray, MeshArrays]


@dataclass(frozen=True, slots=True, eq=False)
class IndenterGeometry:
    """Shape of a rigid indenter, in a frame that moves with it.

    Attributes
    ----------
    kind : int
        Index in `KINDS`.
    size : ndarray, shape (3,)
        mm: half edges of a box; radius and half length of a cylinder; radius of a sphere; radius of a capsule and half the distance between
        the centres of its ends; half width and corner radius of a bar.
    axes : ndarray, shape (3, 3)
        Rows are the shape's axes in the indenter's frame; the third is the outward normal of a plane or of a bar's face, and the axis of a
        cylinder or capsule; the first is the direction across a bar.
    vertices : ndarray, shape (v, 3)
        Of a mesh, mm.
    tree : TriangleTree, optional
        Of a mesh.
    """

    kind: int
    size: FloatArray
    axes: FloatArray
    vertices: FloatArray
    tree: TriangleTree | None = None

    @property
    def name(self) -> str:
        """Name of the kind."""
        return KINDS[self.kind]

    @property
    def normal(self) -> FloatArray:
        """Outward normal (3,) of a plane or of a bar's face."""
        return np.asarray(self.axes[2])

    @property
    def flat(self) -> bool:
        """Whether the surface has the same normal everywhere."""
        return self.kind == PLANE

    @property
    def convex(self) -> bool:
        """Whether the shape is known to be convex: all but meshes."""
        return self.tree is None

    @property
    def inradius(self) -> float:
        """Radius of the largest sphere inside, mm; of a mesh a bound from below, infinite for a half space."""
        if self.kind == PLANE:
            return np.inf
        if self.kind == BOX:
            return float(self.size.min())
        if self.kind == CYLINDER:
            return float(self.size[:2].min())
        if self.tree is not None:
            corners = self.vertices[self.tree.triangles]
            area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
            volume = np.einsum("ti,ti->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
            return float(volume / area)
        return float(self.size[0])

    @property
    def curvature(self) -> float:
        """Largest curvature of the round part of the surface, 1/mm; 0 where all is flat."""
        return {CYLINDER: 1.0, SPHERE: 1.0, CAPSULE: 1.0}.get(self.kind, 0.0) / max(float(self.size[0]), 1e-300)

    @property
    def volume_per_area(self) -> float:
        """Volume over area of the surface, mm: a third of the radius of a sphere, half of the thickness of a thin plate."""
        r, length = float(self.size[0]), 2.0 * float(self.size[1])
        if self.kind == BOX:
            return float(0.5 / (1.0 / (2.0 * self.size)).sum())
        if self.kind == CYLINDER:
            return r * length / (2.0 * (r + length))
        if self.kind == CAPSULE:
            return r * (length + 4.0 / 3.0 * r) / (2.0 * length + 4.0 * r)
        return {SPHERE: r / 3.0, BAR: 0.5 * r}.get(self.kind, self.inradius)

    def reach(self, direction: ArrayLike) -> float:
        """Return how far the shape extends from its reference point along a unit vector (3,), mm; infinite for planes and bars.

        It is the support function of the shape.
        """
        along = self.axes @ np.asarray(direction, dtype=float)
        if self.tree is not None:
            return float((self.vertices @ along).max())
        if self.kind == BOX:
            return float(self.size @ np.abs(along))
        if self.kind in (PLANE, BAR):
            return np.inf
        radius, half = float(self.size[0]), float(self.size[1])
        if self.kind == CYLINDER:
            return half * abs(float(along[2])) + radius * float(np.hypot(along[0], along[1]))
        return radius + half * abs(float(along[2]))

    def distance(self, points: ArrayLike) -> FloatArray:
        """Return the signed distances (p,), mm, of points (p, 3) in the indenter's frame; positive outside."""
        return self.distance_derivatives(points)[0]

    def distance_derivatives(self, points: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return signed distances (p,), mm, their gradients (p, 3) and second derivatives (p, 3, 3), 1/mm, at points (p, 3)."""
        at = np.ascontiguousarray(points, dtype=float)
        gap, gradient, second = np.empty(len(at)), np.empty((len(at), 3)), np.empty((len(at), 3, 3))
        distances(packed_geometry(self), self.axes, at, gap, gradient, second)
        return gap, gradient, second


@functools.lru_cache(maxsize=64)
def packed_geometry(shape: IndenterGeometry) -> GeometryArrays:
    """Return one shape as the kernels read it, see `packed_geometries`; kept, as evaluations of one contact ask for it many times."""
    return packed_geometries([shape])


def packed_geometries(shapes: Sequence[IndenterGeometry]) -> GeometryArrays:
    """Return kinds (k,), sizes (k, 3) and the meshes one after the other, as the kernels read them.

    The meshes are vertices, triangles, order, start and boxes of their trees, and where those of each shape begin: tree nodes, triangles,
    vertices (k + 1, 3).
    """
    none = TriangleTree(np.zeros((0, 3), np.int64), np.zeros(0, np.int64), np.zeros((0, 2), np.int64))
    trees = [shape.tree or none for shape in shapes]
    counts = [(len(tree.start), len(tree.triangles), len(shape.vertices)) for tree, shape in zip(trees, shapes, strict=True)]
    first = np.concatenate([np.zeros((1, 3), np.int64), np.cumsum(np.array(counts, dtype=np.int64).reshape(-1, 3), axis=0)])
    boxes = [tree.boxes(shape.vertices) for tree, shape in zip(trees, shapes, strict=True)]
    mesh = (
        np.concatenate([np.zeros((0, 3)), *(shape.vertices for shape in shapes)]),
        np.concatenate([none.triangles, *(tree.triangles for tree in trees)]),
        np.concatenate([none.order, *(tree.order for tree in trees)]),
        np.concatenate([none.start, *(tree.start for tree in trees)]),
        np.concatenate([np.zeros((0, 6)), *boxes]),
        first,
    )
    return np.array([s.kind for s in shapes], dtype=np.int64), np.array([s.size for s in shapes], dtype=float).reshape(-1, 3), mesh


def plane_geometry(normal: ArrayLike = (0.0, 0.0, 1.0)) -> IndenterGeometry:
    """Return a half space that ends at a plane through the reference point, with an outward normal of any length.

    Raises
    ------
    InputError
        The normal has no length.
    """
    return _shape(PLANE, (0.0, 0.0, 0.0), frame_about(normal, "the normal of a plane"))


def bar_geometry(axis: str, width_mm: float, *, corner_radius_mm: float = 1.0) -> IndenterGeometry:
    """Return a bar with its face downwards, lying along ``"x"`` or ``"y"``, with rounded edges.

    Raises
    ------
    InputError
        The corner radius is not between 0 and half of the width.
    """
    if not 0.0 < corner_radius_mm <= 0.5 * width_mm:
        raise InputError(f"the bar's corner radius must lie between 0 and half of its width {width_mm:g} mm, not {corner_radius_mm:g} mm")
    lateral, normal = np.array([0.0, 1.0, 0.0] if axis == "x" else [1.0, 0.0, 0.0]), np.array([0.0, 0.0, -1.0])
    return _shape(BAR, (0.5 * width_mm, corner_radius_mm, 0.0), np.stack([lateral, np.cross(normal, lateral), normal]))


def box_geometry(edges: ArrayLike, axes: ArrayLike | None = None) -> IndenterGeometry:
    """Return a box with given edges, mm, along `axes` (rows; by default those of the frame), about the reference point.

    Raises
    ------
    InputError
        Edges that are not positive, or axes that are not orthonormal.
    """
    rows = np.eye(3) if axes is None else np.array(axes, dtype=float)
    if rows.shape != (3, 3) or np.abs(rows @ rows.T - np.eye(3)).max() > 1e-9:
        raise InputError("the axes of a box are three orthonormal rows; normalize them")
    return _shape(BOX, 0.5 * _positive(edges, "edges of a box"), rows)


def cylinder_geometry(radius: float, length: float, axis: ArrayLike = (0.0, 0.0, 1.0)) -> IndenterGeometry:
    """Return a cylinder with flat ends, mm, about an axis through the reference point, its middle.

    Raises
    ------
    InputError
        A radius or length that is not positive, or an axis without length.
    """
    sizes = _positive([radius, length, 1.0], "radius and length of a cylinder")
    return _shape(CYLINDER, sizes * (1.0, 0.5, 0.0), frame_about(axis, "the axis of a cylinder"))


def sphere_geometry(radius: float) -> IndenterGeometry:
    """Return a sphere, mm, about the reference point.

    Raises
    ------
    InputError
        A radius that is not positive.
    """
    return _shape(SPHERE, _positive([radius, 1.0, 1.0], "radius of a sphere") * (1.0, 0.0, 0.0), np.eye(3))


def capsule_geometry(radius: float, length: float, axis: ArrayLike = (0.0, 0.0, 1.0)) -> IndenterGeometry:
    """Return a cylinder with hemispherical ends, mm; `length` is the distance between the centres of the ends.

    Raises
    ------
    InputError
        A radius or length that is not positive, or an axis without length.
    """
    sizes = _positive([radius, length, 1.0], "radius and length of a capsule")
    return _shape(CAPSULE, sizes * (1.0, 0.5, 0.0), frame_about(axis, "the axis of a capsule"))


def mesh_geometry(vertices: ArrayLike, triangles: ArrayLike) -> IndenterGeometry:
    """Return a closed triangulated surface.

    Parameters
    ----------
    vertices : array_like, shape (v, 3)
        mm, from the reference point.
    triangles : array_like, shape (t, 3)
        Vertices, counter-clockwise seen from outside.

    Raises
    ------
    InputError
        Vertices that are missing or not finite, a surface that is not closed, or one that is turned inside out.
    """
    points, corners = as_points("vertices", vertices, 3, least=4), np.array(triangles, dtype=np.int64)
    if corners.ndim != 2 or corners.shape[1] != 3 or not len(corners) or corners.min() < 0 or corners.max() >= len(points):
        raise InputError(f"triangles must have shape (t, 3) and name vertices 0 to {len(points) - 1}, and have shape {corners.shape}")
    edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    unique, count = np.unique(edges, axis=0, return_counts=True)
    known = {(int(a), int(b)) for a, b in unique}
    if (count > 1).any() or any((b, a) not in known for a, b in known):
        raise InputError("the triangles are no closed surface with all normals on one side; close its holes and orient it")
    volume = float(np.einsum("ti,ti->", points[corners[:, 0]], np.cross(points[corners[:, 1]], points[corners[:, 2]]))) / 6.0
    if not volume > 0.0:
        raise InputError(f"the triangles enclose the volume {volume:g} mm^3: normals point inwards; reverse their vertices")
    return IndenterGeometry(MESH, np.zeros(3), np.eye(3), points, TriangleTree.of(corners, points))


def frame_about(direction: ArrayLike, what: str = "a direction") -> FloatArray:
    """Return orthonormal axes (rows) whose third one has a direction.

    Raises
    ------
    InputError
        The direction has no length.
    """
    third = as_vector(what, direction)
    length = float(np.linalg.norm(third))
    if not length > 0.0:
        raise InputError(f"{what} must have a length, and ({', '.join(f'{v:g}' for v in third)}) has none")
    third = third / length
    first = np.cross(np.eye(3)[int(np.argmin(np.abs(third)))], third)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(third, first), third])


def _shape(kind: int, size: ArrayLike, axes: FloatArray) -> IndenterGeometry:
    return IndenterGeometry(kind, require_finite(f"size of a {KINDS[kind]}", np.array(size, dtype=float)), axes, np.zeros((0, 3)))


def _positive(values: ArrayLike, what: str) -> FloatArray:
    sizes = np.array(values, dtype=float)
    if sizes.shape != (3,) or not (np.isfinite(sizes) & (sizes > 0.0)).all():
        raise InputError(f"the {what} must be positive, and are {', '.join(f'{v:g}' for v in sizes.ravel())} mm")
    return sizes
