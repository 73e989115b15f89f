"""The sides of cuts of a mesh, which do not pass through each other."""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.mesh import Mesh
from naibu.mechanics.contact.cut_lips import CutLips
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_elements.hyperelasticity import small_strain_bulk_moduli, small_strain_shear_moduli
from naibu.mechanics.finite_strain.lip_assembly import lips_of, with_lips
from naibu.meshing.cutting.swept_blade import SweptBlade
from naibu.meshing.cutting.volume import VolumeCut
from naibu.meshing.surface import boundary_faces

STEPS = 0.02  # by which facets are larger than the cut that they follow, from which on they are steps
YIELDING = 0.02  # of an edge of steps over the shear modulus: how they yield to a pressure that rises in three time steps between walls
MARGIN = 1.2  # on how the penalty yields, as the pressure rises smoothly over its ramp
LEAST_SOFTER = 5.0  # % that are worth saying


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


def softer_behind_cuts(assembler: Assembler) -> float:
    """Return by how much, %, a force may be too low that presses a cut body between walls, where it cannot give way sideways.

    That is in time steps, while the force rises. A body of thickness L and constrained modulus M then yields by ``L / M`` to a pressure.
    The sides of a cut through it yield by ``1 / k`` of their penalty, where that is not made up from step to step; where facets follow a
    blade in steps, also as these hand over the stress along the blade, which is as large as that across it where the body is nearly
    incompressible, some steps late. At rest a force is nearer: two to seven per cent too low where 8 to 59 % is said.
    """
    found = 0.0
    for lips in lips_of(assembler):
        cells = np.isin(assembler.elements.connectivity, lips.pairs).any(axis=1)
        chosen = np.unique(assembler.elements.cell_of_point[cells, 0])
        shear = small_strain_shear_moduli(assembler.law_codes[chosen], assembler.parameters[chosen])
        bulk = small_strain_bulk_moduli(assembler.law_codes[chosen], assembler.parameters[chosen])
        facets, across = _facets(lips)
        thickness = float((np.ptp(lips.points, axis=0) / np.maximum(np.abs(across), 1e-300)).min())  # of the box around the body
        stepped = facets > (1.0 + STEPS) * lips.area.sum()
        of_penalty = 0.0 if lips.yields else MARGIN / float(lips.stiffness.min())  # made up from step to step
        yielding = of_penalty + stepped * YIELDING * float(lips.edge.max()) / float(shear.min())
        found = max(found, float((bulk + 4.0 / 3.0 * shear).max()) * yielding / thickness)
    return 100.0 * found / (1.0 + found)


def caution_of_cuts(assembler: Assembler, force: str) -> str:
    """Return that a force may be too low behind the cuts of a body, and by how much; empty where that is not worth saying."""
    softer = softer_behind_cuts(assembler)
    if softer < LEAST_SOFTER:
        return ""
    return (
        f"Behind the cut {force} may be up to {softer:.0f} % too low where walls keep the body from giving way sideways, as long as it "
        "rises: the body is nearly incompressible there, and the steps in which the cut follows the blade yield at first."
    )


def _facets(lips: CutLips) -> tuple[float, FloatArray]:
    """Return the area of the facets that pairs stand for, mm2, and the direction (3,) across the cut."""
    first = lips.faces[: len(lips.faces) // 2]
    a, b, c = lips.points[first].transpose(1, 0, 2)
    vectors = 0.5 * np.cross(b - a, c - a)
    shares = np.isin(first, lips.pairs).sum(axis=1) / 3.0  # corners at the front of a cut belong to no pair
    mean = vectors.sum(axis=0)
    return float(shares @ np.linalg.norm(vectors, axis=1)), mean / max(float(np.linalg.norm(mean)), 1e-300)
