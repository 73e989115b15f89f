"""Hexahedral mesh of an unloaded breast, and its tissues smeared over the cells."""

from __future__ import annotations

import numpy as np

from naibu.applications.mammography.breast_shape import BreastShape
from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.mesh import Mesh
from naibu.meshing.primitives import half_ellipsoid
from naibu.meshing.quality import signed_volumes
from naibu.meshing.surface import boundary_faces, face_normals


def unit_breast_mesh(edge: float) -> Mesh:
    """Return a mesh of the half ball of radius 1 above z = 0, of hexahedra of an edge; `breast_nodes` makes a breast of its nodes."""
    return half_ellipsoid((2.0, 2.0, 1.0), edge)


def breast_nodes(shape: BreastShape, ball: FloatArray) -> FloatArray:
    """Return where points (n, 3) of the half ball lie in a breast, mm: sections stay sections, circles become the ellipses of the shape."""
    depth = shape.depth_mm * np.clip(ball[:, 2], 0.0, 1.0)
    centres, squares = shape.in_view(0.0, depth)
    rest = np.sqrt(np.maximum(1.0 - ball[:, 2] ** 2, 1e-9))
    xx, yy, xy = squares.T
    root = np.sqrt(np.maximum(xx * yy - xy**2, 0.0))
    scale = 1.0 / np.sqrt(np.maximum(xx + yy + 2.0 * root, 1e-12))  # square root of a symmetric 2 x 2 matrix
    x, y = ball[:, 0] / rest, ball[:, 1] / rest
    return np.column_stack([centres[:, 0] + scale * ((xx + root) * x + xy * y), centres[:, 1] + scale * (xy * x + (yy + root) * y), depth])


def free_and_wall_faces(mesh: Mesh) -> tuple[IntArray, IntArray, IntArray]:
    """Return the faces of the skin (f, 4), the cells beneath them (f,), and the faces at the chest wall (w, 4)."""
    faces, cells = boundary_faces(mesh)
    wall: BoolArray = mesh.points[faces][:, :, 2].max(axis=1) < 1e-9
    return faces[~wall], cells[~wall], faces[wall]


def young_moduli(mesh: Mesh, tissue_kpa: float, skin_kpa: float, skin_mm: float) -> FloatArray:
    """Return Young's moduli (m,), kPa, of cells of one tissue; the skin is smeared over the cells beneath it."""
    faces, cells, _ = free_and_wall_faces(mesh)
    area = np.linalg.norm(face_normals(mesh.points, faces), axis=1)
    thickness = np.abs(signed_volumes(mesh))[cells] / np.maximum(area, 1e-9)
    young = np.full(mesh.n_cells, tissue_kpa)
    np.add.at(young, cells, skin_kpa * np.minimum(skin_mm / thickness, 1.0))
    return young
