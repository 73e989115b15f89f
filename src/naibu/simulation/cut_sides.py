"""The sides of cuts of a mesh, which do not pass through each other."""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.mesh import Mesh
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_strain.lip_assembly import with_lips
from naibu.meshing.cutting.swept_blade import SweptBlade
from naibu.meshing.cutting.volume import VolumeCut
from naibu.meshing.surface import boundary_faces


def with_sides_of_cuts(assembler: Assembler, mesh: Mesh, friction: float = 0.0, outward: FloatArray | None = None) -> Assembler:
    """Return an assembler in which the sides of the cuts of a mesh of tetrahedra touch each other; the same where there is no cut.

    Parameters
    ----------
    assembler : Assembler
        Of the mesh.
    mesh : Mesh
        Linear tetrahedra; cuts have doubled some of its nodes.
    friction : float
        Coulomb's coefficient between the two sides.
    outward : ndarray, shape (n, 3), optional
        Outward normals of blades at the nodes on the sides of their cuts; see `outward_normals`.

    Raises
    ------
    InputError
        A negative coefficient.
    """
    points = mesh.points[np.lexsort(mesh.points.T)]
    if not (points[1:] == points[:-1]).all(axis=1).any():  # no node is doubled: the boundary need not be looked for
        return assembler
    return with_lips(assembler, mesh.points, boundary_faces(mesh).faces, friction, mesh.cells, outward)


def outward_normals(found: VolumeCut, blade: SweptBlade, before: FloatArray | None = None) -> FloatArray:
    """Return the normals of blades at the nodes (n, 3) on the sides of their cuts, in the reference configuration and outwards.

    Zero at other nodes, and at the front of a cut, which belongs to both sides.

    Parameters
    ----------
    found : VolumeCut
        The cut.
    blade : SweptBlade
        What it is along, in the body as it was then.
    before : ndarray, shape (m, 3), optional
        Those of earlier cuts, at the nodes before this one.
    """
    out = np.zeros_like(found.mesh.points) if before is None else found.nodal(before)
    size = np.linalg.norm(out, axis=1)
    out /= np.where(size > 0.0, size, 1.0)[:, None]
    first, second = (np.unique(side) for side in np.array_split(found.faces, 2))
    out[np.intersect1d(first, second)] = 0.0
    for nodes, other, sign in ((first, second, 1.0), (second, first, -1.0)):
        own = np.setdiff1d(nodes, other)
        out[own] = sign * blade.normals_near(found.positions[own])
    now = np.setxor1d(first, second)
    cells = found.mesh.cells[np.isin(found.mesh.cells, now).any(axis=1)]
    rest, moved = (p[cells[:, 1:]] - p[cells[:, :1]] for p in (found.mesh.points, found.positions))
    gradient = np.linalg.det(rest)[:, None, None] * np.linalg.solve(rest, moved)  # transposed, times six volumes
    pulled = np.zeros_like(out)
    np.add.at(pulled, cells, np.einsum("cij,ckj->cki", gradient, out[cells]))  # normals are covectors: F^T n
    size = np.linalg.norm(pulled[now], axis=1)
    out[now] = pulled[now] / np.where(size > 0.0, size, 1.0)[:, None]
    return out
