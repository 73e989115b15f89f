"""The cells that a bisection forest begins with: what is refused, and which of them share faces."""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import FloatArray, Int32Array, IntArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.meshing.refinement import _root_kernels as kernels


def require_volumes(mesh: Mesh) -> None:
    """Check that a mesh has triangles or linear tetrahedra, all of which have an area or a volume.

    Raises
    ------
    InputError
        They do not.
    """
    if mesh.cell_type not in ("triangle", "tetra"):
        raise InputError(f"a bisection forest has triangles or linear tetrahedra, not {mesh.cell_type!r} cells; split the cells first")
    size = determinants(mesh.points, mesh.cells)
    if not (size != 0.0).all():
        bad = int(np.argmin(np.abs(size)))
        raise InputError(f"cell {bad} of {mesh.n_cells} has no volume; remove it, or move its nodes apart")


def join_roots(cells: Int32Array, k: int, mesh: Mesh) -> None:
    """Set the neighbours of the cells (m, ...) of a conforming mesh, which are -1 before.

    Raises
    ------
    InputError
        Three cells share a face, or two cells lie on the same side of the one that they share.
    """
    faces = np.empty((len(cells) * k, k - 1), dtype=np.int64)
    kernels.faces_of(cells, k, faces)
    bad = int(kernels.neighbours_by_faces(cells, faces, np.zeros(mesh.n_points + 1, dtype=np.int64), np.empty(len(faces), dtype=np.int64)))
    if bad >= 0:
        raise InputError(f"three cells share the face with nodes {faces[bad].tolist()}; at most two can: remove duplicate cells")
    one, two = kernels.overlapping(mesh.points, cells, k, np.empty(k, dtype=np.int64))
    if one >= 0:
        raise _overlap(cells[:, :k], int(one), int(two))


def _overlap(corners: Int32Array, one: int, two: int) -> InputError:
    one, two = min(one, two), max(one, two)
    if set(corners[one].tolist()) == set(corners[two].tolist()):
        return InputError(f"cells {one} and {two} have the same nodes; remove duplicate cells, which share what they fill")
    return InputError(
        f"cells {one} and {two} lie on the same side of the face that they share: one of them is inverted; mend the mesh there"
    )


def determinants(points: FloatArray, cells: IntArray | Int32Array) -> FloatArray:
    """Return the determinants (m,) of the edges from the first vertex of each cell: two or six times its size, with the sign of its order.

    Parameters
    ----------
    points : ndarray, shape (n, d)
        mm.
    cells : ndarray, shape (m, d + 1)
        Triangles or tetrahedra.
    """
    out = np.empty(len(cells))
    kernels.determinants(np.ascontiguousarray(points), np.ascontiguousarray(cells, dtype=np.int64), out)
    return out
