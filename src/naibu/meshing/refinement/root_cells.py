"""The cells that a bisection forest begins with: what is refused, and which of them share faces."""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import FloatArray, Int32Array
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.meshing.refinement import _forest_kernels as kernels


def require_volumes(mesh: Mesh) -> None:
    """Check that a mesh has triangles or linear tetrahedra, all of which have an area or a volume.

    Raises
    ------
    InputError
        They do not.
    """
    if mesh.cell_type not in ("triangle", "tetra"):
        raise InputError(f"a bisection forest has triangles or linear tetrahedra, not {mesh.cell_type!r} cells; split the cells first")
    size = _determinants(mesh.points[mesh.cells])
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
    others = np.array([[j for j in range(k) if j != i] for i in range(k)])
    faces = np.sort(cells[:, others].reshape(-1, k - 1), axis=1)
    bad = int(kernels.neighbours_by_faces(cells, np.lexsort(faces.T), faces, k))
    if bad >= 0:
        raise InputError(f"three cells share the face with nodes {faces[bad].tolist()}; at most two can: remove duplicate cells")
    for place in range(k):
        own = np.flatnonzero(cells[:, 4 + place] > np.arange(len(cells)))
        across = cells[own, 4 + place]
        opposite = cells[across, np.argmax(cells[across, 4 : 4 + k] == own[:, None], axis=1)]
        here, there = mesh.points[cells[own, :k]], mesh.points[cells[own, :k]]
        there[:, place] = mesh.points[opposite]
        overlapping = np.flatnonzero(np.sign(_determinants(here)) == np.sign(_determinants(there)))
        if len(overlapping):
            raise _overlap(cells[:, :k], int(own[overlapping[0]]), int(across[overlapping[0]]))


def _overlap(corners: Int32Array, one: int, two: int) -> InputError:
    one, two = min(one, two), max(one, two)
    if set(corners[one].tolist()) == set(corners[two].tolist()):
        return InputError(f"cells {one} and {two} have the same nodes; remove duplicate cells, which share what they fill")
    return InputError(
        f"cells {one} and {two} lie on the same side of the face that they share: one of them is inverted; mend the mesh there"
    )


def _determinants(corners: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.det(corners[:, 1:] - corners[:, :1]))
