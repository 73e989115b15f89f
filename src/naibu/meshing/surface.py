"""The boundary of a mesh: faces, tributary areas of nodes, and selection by plane and by direction."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import BoolArray, FloatArray, IntArray, as_vector
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh

# Faces of a cell in VTK order, counterclockwise seen from outside; quadratic triangles list corners, then mid-edge nodes.
CELL_FACES = {
    "tetra": np.array([[0, 1, 3], [1, 2, 3], [2, 0, 3], [0, 2, 1]]),
    "tetra10": np.array([[0, 1, 3, 4, 8, 7], [1, 2, 3, 5, 9, 8], [2, 0, 3, 6, 7, 9], [0, 2, 1, 6, 5, 4]]),
    "hexahedron": np.array([[0, 4, 7, 3], [1, 2, 6, 5], [0, 1, 5, 4], [3, 7, 6, 2], [0, 3, 2, 1], [4, 5, 6, 7]]),
}
_SIDES = {"x-": (0, -1), "x+": (0, 1), "y-": (1, -1), "y+": (1, 1), "z-": (2, -1), "z+": (2, 1)}
_QUAD_TURNS = (np.arange(4)[:, None] + np.arange(4)) % 4
_GAUSS = 1 / np.sqrt(3.0)


class Boundary(NamedTuple):
    """Faces that belong to one cell only.

    Attributes
    ----------
    faces : ndarray, shape (f, k), int64
        Node numbers, counterclockwise seen from outside: k = 3 (``"tetra"``), 4 (``"hexahedron"``) or 6 (``"tetra10"``: three
        corners, then the mid-edge nodes).
    cells : ndarray, shape (f,), int64
        The cell that each face belongs to.
    """

    faces: IntArray
    cells: IntArray


def boundary_faces(mesh: Mesh) -> Boundary:
    """Return the outward oriented faces of the mesh that have a cell on one side only.

    Raises
    ------
    InputError
        A face is shared by more than two cells, so the mesh does not conform.
    """
    return faces_of_cells(mesh.cells, mesh.cell_type)


def faces_of_cells(cells: IntArray, cell_type: str) -> Boundary:
    """Return the boundary of bare cells (m, k); see `boundary_faces`."""
    local = CELL_FACES[cell_type]
    faces = cells[:, local].reshape(-1, local.shape[1])
    corners = 4 if cell_type == "hexahedron" else 3
    keys = np.sort(faces[:, :corners], axis=1)
    order = np.lexsort(keys.T)
    starts = np.flatnonzero(np.concatenate([[True], (np.diff(keys[order], axis=0) != 0).any(axis=1)]))
    counts = np.diff(np.concatenate([starts, [len(faces)]]))
    if counts.max() > 2:
        bad = keys[order[starts[counts.argmax()]]]
        raise InputError(f"{counts.max()} cells share the face with nodes {bad.tolist()}; at most two can: remove duplicate cells")
    single = np.sort(order[starts[counts == 1]])
    return Boundary(faces[single], (single // len(local)).astype(np.int64))


def boundary_nodes(mesh: Mesh) -> IntArray:
    """Return the sorted numbers (n,) of the nodes on the boundary."""
    return np.unique(boundary_faces(mesh).faces)


def triangles_of_faces(faces: IntArray) -> IntArray:
    """Split faces (f, 3 | 4 | 6) into triangles (t, 3) of the same orientation.

    Quadrilaterals are cut by the diagonal of their lowest node, like `naibu.meshing.element_conversion.split_hexahedra` does, and quadratic
    triangles into four.
    """
    if faces.shape[1] == 3:
        return faces
    if faces.shape[1] == 6:
        return faces[:, [0, 3, 5, 3, 1, 4, 5, 4, 2, 3, 4, 5]].reshape(-1, 3)
    turned = np.take_along_axis(faces, _QUAD_TURNS[faces.argmin(axis=1)], axis=1)
    return turned[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)


def face_normals(points: FloatArray, faces: IntArray) -> FloatArray:
    """Return the area vector (f, 3), mm^2, of faces (f, 3 | 4 | 6): it points outwards and its length is the area of a plane face."""
    p = points[faces]
    if faces.shape[1] == 4:
        return 0.5 * np.cross(p[:, 2] - p[:, 0], p[:, 3] - p[:, 1])
    return 0.5 * np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])


def node_areas(mesh: Mesh, faces: IntArray | None = None) -> FloatArray:
    r"""Return the tributary area of every node, :math:`\int N_i \, dA`.

    A uniform pressure loads node i by pressure times this area.

    Parameters
    ----------
    mesh : Mesh
        Mesh with n points.
    faces : ndarray, shape (f, k), optional
        Faces to integrate over; default: the whole boundary.

    Returns
    -------
    ndarray, shape (n,)
        Areas, mm^2; their sum is the area of the faces. Corners of quadratic triangles (straight-sided) get none.
    """
    faces = boundary_faces(mesh).faces if faces is None else faces
    if faces.shape[1] == 4:
        parts = _quad_areas(mesh.points[faces])
    else:
        area = np.linalg.norm(face_normals(mesh.points, faces), axis=1)
        weights = np.full(3, 1 / 3) if faces.shape[1] == 3 else np.repeat([0, 1 / 3], 3)
        parts = area[:, None] * weights
    return np.asarray(np.bincount(faces.ravel(), weights=parts.ravel(), minlength=mesh.n_points), dtype=np.float64)


def nodes_on_plane(mesh: Mesh, point_mm: ArrayLike, normal: ArrayLike, *, tolerance_mm: float | None = None) -> IntArray:
    """Return the numbers of the nodes on a plane.

    Parameters
    ----------
    mesh : Mesh
        Any mesh.
    point_mm : array_like, shape (3,)
        A point of the plane, mm.
    normal : array_like, shape (3,)
        Its normal, of any length but zero.
    tolerance_mm : float, optional
        Largest distance from the plane; default: a millionth of the diagonal of the mesh.

    Returns
    -------
    ndarray, shape (k,), int64
        Sorted node numbers; empty if the plane meets no node.

    Raises
    ------
    InputError
        The normal is zero.
    """
    distance = (mesh.points - np.asarray(point_mm, dtype=np.float64)) @ _unit("normal", normal)
    limit = 1e-6 * float(np.linalg.norm(np.ptp(mesh.points, axis=0))) if tolerance_mm is None else tolerance_mm
    return np.flatnonzero(np.abs(distance) <= limit).astype(np.int64)


def side_nodes(mesh: Mesh, side: str, *, tolerance_mm: float | None = None) -> IntArray:
    """Return the nodes at one end of the mesh: ``"z-"`` are those of least z, ``"x+"`` those of greatest x.

    Parameters
    ----------
    mesh : Mesh
        Any mesh.
    side : {"x-", "x+", "y-", "y+", "z-", "z+"}
        Axis and end.
    tolerance_mm : float, optional
        See `nodes_on_plane`.

    Raises
    ------
    InputError
        Another value of `side`.
    """
    if side not in _SIDES:
        raise InputError(f"side is {side!r}; use one of {sorted(_SIDES)}")
    axis, sign = _SIDES[side]
    extreme = mesh.points[(sign * mesh.points[:, axis]).argmax()]
    return nodes_on_plane(mesh, extreme, np.eye(3)[axis], tolerance_mm=tolerance_mm)


def faces_towards(mesh: Mesh, direction: ArrayLike, *, max_angle_deg: float = 45.0) -> IntArray:
    """Return the boundary faces (f, k) whose outward normal is near a direction.

    Parameters
    ----------
    mesh : Mesh
        Any mesh.
    direction : array_like, shape (3,)
        Direction, of any length but zero.
    max_angle_deg : float
        Largest angle between normal and direction, degrees.

    Raises
    ------
    InputError
        The direction is zero.
    """
    faces = boundary_faces(mesh).faces
    normals = face_normals(mesh.points, faces)
    cosine = (normals @ _unit("direction", direction)) / np.linalg.norm(normals, axis=1)
    towards: BoolArray = cosine >= np.cos(np.radians(max_angle_deg)) - 1e-12
    return faces[towards]


def faces_among(mesh: Mesh, nodes: ArrayLike) -> IntArray:
    """Return the boundary faces (f, k) all of whose nodes are in `nodes` (n,)."""
    chosen = np.zeros(mesh.n_points, dtype=bool)
    chosen[np.asarray(nodes, dtype=np.int64)] = True
    faces = boundary_faces(mesh).faces
    return faces[chosen[faces].all(axis=1)]


def _unit(name: str, vector: ArrayLike) -> FloatArray:
    """Return a direction of length one."""
    array = as_vector(name, vector)
    length = float(np.linalg.norm(array))
    if not length > 0:
        raise InputError(f"{name} is {array.tolist()}; give three numbers that are not all zero")
    return array / length


def _quad_areas(p: FloatArray) -> FloatArray:
    """Return the integral (f, 4) of each bilinear shape function over quadrilaterals p (f, 4, 3), by 2 x 2 Gauss points."""
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=np.float64)
    parts = np.zeros(p.shape[:2])
    for r, s in signs * _GAUSS:
        shape = (1 + r * signs[:, 0]) * (1 + s * signs[:, 1]) / 4
        along_r = np.einsum("i,fix->fx", signs[:, 0] * (1 + s * signs[:, 1]) / 4, p)
        along_s = np.einsum("i,fix->fx", signs[:, 1] * (1 + r * signs[:, 0]) / 4, p)
        parts += np.linalg.norm(np.cross(along_r, along_s), axis=1)[:, None] * shape
    return parts


def level_extents(starts: FloatArray, ends: FloatArray, levels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return how far line segments in a plane reach at levels of their first coordinate.

    Parameters
    ----------
    starts, ends : ndarray, shape (e, 2)
        Ends of the segments, mm: of a curve, or of the edges of a projected surface.
    levels : ndarray, shape (n,)
        Levels, mm, growing; the last one may lie at the farthest point.

    Returns
    -------
    low, high : ndarray, shape (n,)
        Least and greatest second coordinate, mm; infinite where no segment crosses the level.
    """
    at = np.minimum(levels, levels[-1] * (1.0 - 1e-9))[:, None]
    crossed = (np.minimum(starts[:, 0], ends[:, 0]) <= at) & (at <= np.maximum(starts[:, 0], ends[:, 0]))
    run = ends[:, 0] - starts[:, 0]
    share = np.clip(np.where(run == 0.0, 0.0, (at - starts[:, 0]) / np.where(run == 0.0, 1.0, run)), 0.0, 1.0)
    reach = starts[:, 1] + share * (ends[:, 1] - starts[:, 1])
    return np.where(crossed, reach, np.inf).min(axis=1), np.where(crossed, reach, -np.inf).max(axis=1)
