"""Element conversion: hexahedra to tetrahedra, and linear to quadratic tetrahedra."""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import IntArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh

# Row v turns a hexahedron, without mirroring it, so that its local node v becomes node 0.
_TURNS = np.array(
    [
        [0, 1, 2, 3, 4, 5, 6, 7],
        [1, 2, 3, 0, 5, 6, 7, 4],
        [2, 3, 0, 1, 6, 7, 4, 5],
        [3, 0, 1, 2, 7, 4, 5, 6],
        [4, 7, 6, 5, 0, 3, 2, 1],
        [5, 4, 7, 6, 1, 0, 3, 2],
        [6, 5, 4, 7, 2, 1, 0, 3],
        [7, 6, 5, 4, 3, 2, 1, 0],
    ]
)
# The three faces that do not touch local node 0, seen counterclockwise from outside.
_FAR_FACES = np.array([[1, 2, 6, 5], [3, 7, 6, 2], [4, 5, 6, 7]])
_QUAD_TURNS = (np.arange(4)[:, None] + np.arange(4)) % 4
# Edges of a tetrahedron in the order in which VTK numbers the mid-edge nodes of a quadratic tetrahedron.
TETRA_EDGES = np.array([[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3]])
HEXAHEDRON_EDGES = np.array([[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4], [0, 4], [1, 5], [2, 6], [3, 7]])


def split_hexahedra(cells: IntArray) -> IntArray:
    """Split hexahedra into six tetrahedra each, which conform across every shared face :cite:p:`dompierre1999`.

    The diagonal of a face starts at its node of lowest number, which is the same for both neighbours; the cell is then the cone of its own
    lowest node over the three faces that do not touch it. On a tensor grid this is Kuhn's triangulation :cite:p:`kuhn1960`.

    Parameters
    ----------
    cells : ndarray, shape (m, 8), int64
        Hexahedra in VTK order.

    Returns
    -------
    ndarray, shape (6 m, 4), int64
        Tetrahedra, positively oriented where the hexahedra are; cell ``i`` becomes rows ``6 i`` to ``6 i + 5``.
    """
    turned = np.take_along_axis(cells, _TURNS[cells.argmin(axis=1)], axis=1)
    faces = turned[:, _FAR_FACES]
    faces = np.take_along_axis(faces, _QUAD_TURNS[faces.argmin(axis=2)], axis=2)
    triangles = np.stack([faces[:, :, [0, 1, 2]], faces[:, :, [0, 2, 3]]], axis=2).reshape(len(cells), 6, 3)
    apex = np.broadcast_to(turned[:, None, :1], (len(cells), 6, 1))
    return np.concatenate([apex, triangles], axis=2).reshape(-1, 4)


def to_tetra(mesh: Mesh) -> Mesh:
    """Return a hexahedral mesh as linear tetrahedra on the same nodes (six a cell), or a tetrahedral mesh unchanged.

    Parameters
    ----------
    mesh : Mesh
        Mesh of hexahedra (or of tetrahedra).

    Returns
    -------
    Mesh
        Cells ``6 i`` to ``6 i + 5`` fill hexahedron ``i`` and keep its region.

    Raises
    ------
    InputError
        `mesh` has quadratic cells.
    """
    if mesh.cell_type == "tetra":
        return mesh
    if mesh.cell_type != "hexahedron":
        raise InputError(f"a mesh of {mesh.cell_type!r} cells cannot be split into linear tetrahedra; give one of 'hexahedron' cells")
    return Mesh(mesh.points, split_hexahedra(mesh.cells), "tetra", np.repeat(mesh.regions, 6), mesh.region_names)


def to_quadratic(mesh: Mesh) -> Mesh:
    """Return a mesh of linear tetrahedra as ten-node tetrahedra with straight edges.

    Parameters
    ----------
    mesh : Mesh
        Mesh of ``"tetra"`` cells with n points.

    Returns
    -------
    Mesh
        The first n points are those of `mesh`; one more follows for every edge, at its middle (mm).

    Raises
    ------
    InputError
        `mesh` is not made of linear tetrahedra.
    """
    if mesh.cell_type != "tetra":
        raise InputError(f"only 'tetra' meshes can be made quadratic, not {mesh.cell_type!r}; use to_tetra first")
    ends = np.sort(mesh.cells[:, TETRA_EDGES].reshape(-1, 2), axis=1)
    # One integer an edge sorts several times faster than rows do.
    _, first, edge = np.unique(ends[:, 0] * mesh.n_points + ends[:, 1], return_index=True, return_inverse=True)
    points = np.concatenate([mesh.points, mesh.points[ends[first]].mean(axis=1)])
    cells = np.concatenate([mesh.cells, mesh.n_points + edge.reshape(-1, 6)], axis=1)
    return Mesh(points, np.ascontiguousarray(cells, dtype=np.int64), "tetra10", mesh.regions, mesh.region_names)
