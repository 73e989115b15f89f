"""Zones too thin for cubes that cover the object, as skin does: left out, and the forces across their inner side taken as unknown.

Forces on the surface of the object are not known, and a covering that is thinner than cubes hides how they are distributed through it: its
modulus cannot be told, and any that were put into cubes would be wrong for what lies below. Without it the object ends where the covering
begins; the displacement there is measured and sought like that of any surface with unknown forces. This is exact whatever the covering is.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.core.volume import Volume
from naibu.identification.from_fields.field_estimate import FieldEstimate
from naibu.meshing.surface import boundary_nodes
from naibu.workflows.fields.block_mesh import BEYOND, MOST_BY_DEFAULT, ZoneTooThin, mesh_that_shows, regions_of
from naibu.workflows.fields.border_fitting import fitted_to_borders

COVERS = 0.25  # part of the surface of a zone that is that of the object, from which it covers this: a layer has nearly half
WHOLE = 0.95  # part of what is left that must hang together
GROWN = 1.0  # edge lengths of cubes by which a grid reaches beyond what is left, so that it has stairs to be moved onto its surface
SPREAD = 4  # voxels over which a border is spread to measure its area
REACHES = 0.2  # part of a cell in a covering from which forces at all of its nodes count as unknown
LEFT_OUT = "the modulus of {} is not determined, because {} thinner than elements and left out"
STATED = "{}, thinner than elements, {} left out"
TOLD = (
    "{}, {:.2g} mm thick, covers the object and is thinner than cubes can show. {} It is left out of the model: what it does to what lies "
    "below counts as unknown forces, and moduli of other zones do not depend on it."
)
WHY = "Forces on its outer side are not known, so that its modulus cannot be told."


@dataclass(frozen=True, slots=True, eq=False)
class Covering:
    """Zones that are left out.

    Attributes
    ----------
    names : tuple of str
        Of the zones, the outermost first.
    thickness_mm : tuple of float
        Of each, mm.
    voxels : ndarray, shape (nz, ny, nx), bool
        Where they are.
    """

    names: tuple[str, ...]
    thickness_mm: tuple[float, ...]
    voxels: BoolArray


def without_thin_coverings(
    inside: Volume,
    labels: IntArray,
    names: Mapping[int, str],
    sought: Collection[str],
    size_mm: float,
    *,
    exactly: bool,
    most: int,
    known: Collection[str] = (),
) -> tuple[Volume, dict[int, str], Covering | None]:
    """Return what is left of an object without zones that cover it and that cubes cannot show, the names of its labels, and these zones.

    Parameters
    ----------
    inside, labels, names, sought, size_mm, exactly
        See `naibu.workflows.fields.block_mesh.mesh_that_shows`.
    most : int
        Cells for which there are points and time enough: a zone that needs more is left out if it covers the object, and has them if not.
    known : collection of str
        Zones of known modulus that is not that of a rigid body: they are left out as well, but for the last one, which sets the scale.

    Raises
    ------
    ZoneTooThin
        A zone that is sought, that cubes cannot show and that does not cover the object, or is the only one.
    """
    left, of_left, out = inside, dict(names), Covering((), (), np.zeros(inside.shape, dtype=bool))
    most, stated = min(most, MOST_BY_DEFAULT), set(known)
    while True:
        wanted = (set(sought) | stated) - set(out.names)
        try:
            mesh_on_what_is_left(left, labels, of_left, wanted, size_mm, out.voxels, exactly=exactly, most=most)
        except ZoneTooThin as error:
            label = next(number for number, name in of_left.items() if name == error.zone)
            voxels = (left.values != 0) & (labels == label)
            rest = (left.values != 0) & ~voxels
            others = wanted & (stated if error.zone in stated else set(sought)) - {error.zone}
            if not others or not _covers(left, voxels, rest):
                if error.zone in stated:
                    stated.remove(error.zone)
                elif exactly or most == MOST_BY_DEFAULT:
                    raise error.with_size(left, labels, of_left, wanted) from None
                else:
                    most = MOST_BY_DEFAULT
                continue
            thickness = _thickness_mm(voxels, rest, left)
            out = Covering((*out.names, error.zone), (*out.thickness_mm, thickness), out.voxels | voxels)
            left, of_left = left.with_values(rest.astype(np.uint8)), {k: name for k, name in of_left.items() if k != label}
        else:
            return left, of_left, out if out.names else None


def mesh_on_what_is_left(
    left: Volume,
    labels: IntArray,
    names: Mapping[int, str],
    sought: Collection[str],
    size_mm: float,
    covered: BoolArray,
    *,
    exactly: bool,
    most: int = MOST_BY_DEFAULT,
) -> tuple[Mesh, IntArray]:
    """Return hexahedra that fill what is left, their nodes on its surface and on borders of zones, and the cell of every voxel.

    Parameters
    ----------
    left, labels, names, sought, size_mm, exactly, most
        See `naibu.workflows.fields.block_mesh.mesh_that_shows`.
    covered : ndarray, shape (nz, ny, nx), bool
        Voxels of what was left out; where there are none the hexahedra are those of `mesh_that_shows`.
    """
    if not covered.any():
        return mesh_that_shows(left, labels, names, sought, size_mm, exactly=exactly, most=most)
    margin = _margin(left, covered, size_mm)
    there = np.pad(left.values != 0, margin)
    beyond = int(labels.max()) + 1
    away = ndimage.distance_transform_edt(~there, sampling=left.spacing_mm[::-1])
    first = left.to_physical(-np.array([before for before, _ in margin][::-1], dtype=float)[None])[0]
    grown = Volume.from_array(
        (away <= GROWN * size_mm).astype(np.uint8), spacing_mm=left.spacing_mm, origin_mm=tuple(first), direction=left.direction
    )
    of_grown, all_names = np.where(there, np.pad(labels, margin), beyond), {**names, beyond: BEYOND}
    mesh, cells = mesh_that_shows(grown, of_grown, all_names, sought, size_mm, exactly=exactly, most=most)
    mesh, cells = fitted_to_borders(mesh, cells, grown, regions_of(of_grown, all_names))
    own = tuple(slice(before, before + n) for (before, _), n in zip(margin, left.shape, strict=True))
    return _within(mesh, np.where(there, cells, -1)[own], len(names))


def _margin(left: Volume, covered: BoolArray, size_mm: float) -> list[tuple[int, int]]:
    """Return how many voxels to add at the ends along z, y, x: a cube where the scan ends in a covering, none where it cuts the object."""
    out, there = [], left.values != 0
    for axis, spacing in enumerate(left.spacing_mm[::-1]):
        ends = [(np.take(covered, end, axis), np.take(there, end, axis)) for end in (0, -1)]
        added = int(np.ceil(GROWN * size_mm / spacing))
        before, after = (added if own.sum() > rest.sum() else 0 for own, rest in ends)
        out.append((before, after))
    return out


def _within(mesh: Mesh, cells: IntArray, beyond: int) -> tuple[Mesh, IntArray]:
    """Return the cells that are not of the last region, as far as they hang together, and the cell of every voxel (nz, ny, nx)."""
    chosen = np.flatnonzero(mesh.regions != beyond)
    if not len(chosen):
        raise InputError("without its thin coverings nothing is left of the object that cubes of this size show; choose a smaller size")
    used, corners = np.unique(mesh.cells[chosen], return_inverse=True)
    number = np.full(mesh.n_cells + 1, -1, dtype=np.int64)  # the last one for voxels without a cell
    number[chosen] = np.arange(len(chosen))
    kept = Mesh.from_arrays(
        mesh.points[used], corners.reshape(-1, 8), "hexahedron", regions=mesh.regions[chosen], region_names=mesh.region_names[:beyond]
    )
    return kept, number[cells]


def loaded_below(mesh: Mesh, covered: BoolArray, grid: Volume) -> BoolArray:
    """Return the nodes (n,) at which unknown forces act because a covering was left out there.

    They are those of the surface that are nearer to its voxels than half a cell, and all of cells a part of which lies in it: no balance of
    forces with the moduli of what is below holds there.
    """
    near = ndimage.distance_transform_edt(~covered, sampling=grid.spacing_mm[::-1])
    nodes = boundary_nodes(mesh)
    at = ndimage.map_coordinates(near, grid.to_index(mesh.points[nodes])[:, ::-1].T, order=1, mode="nearest")
    edge = float(np.linalg.norm(mesh.points[mesh.cells[:, 1]] - mesh.points[mesh.cells[:, 0]], axis=1).mean())
    out = np.zeros(mesh.n_points, dtype=bool)
    out[nodes[at <= 0.5 * edge]] = True
    beyond = np.flatnonzero(out[mesh.cells].any(axis=1))
    index = np.round(grid.to_index(_points_within(mesh, beyond).reshape(-1, 3))).astype(np.int64)[:, ::-1]
    there: BoolArray = np.asarray(((index >= 0) & (index < covered.shape)).all(axis=1))
    there[there] = covered[tuple(index[there].T)]
    part = there.reshape(len(beyond), -1).mean(axis=1)
    out[mesh.cells[beyond[part > REACHES]]] = True
    return out


def _points_within(mesh: Mesh, cells: IntArray) -> FloatArray:
    """Return points (c, 64, 3), mm, all over some hexahedra."""
    at = (np.arange(4) + 0.5) / 4.0
    x, y, z = (a.ravel()[:, None] for a in np.meshgrid(at, at, at, indexing="ij"))
    far = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]], dtype=bool)
    shape = np.where(far[:, 0], x, 1.0 - x) * np.where(far[:, 1], y, 1.0 - y) * np.where(far[:, 2], z, 1.0 - z)
    return np.asarray(np.einsum("ga,cad->cgd", shape, mesh.points[mesh.cells[cells]]))


def _covers(left: Volume, voxels: BoolArray, rest: BoolArray) -> bool:
    """Whether a zone lies at the surface of the object, and what is left without it hangs together."""
    if not rest.any():
        return False
    own, other = (np.pad(a, 1) for a in (voxels, left.values != 0))
    outer = faces = 0
    for axis in range(3):
        for way in (1, -1):
            outer += int((own & ~np.roll(other, way, axis)).sum())
            faces += int((own & ~np.roll(own, way, axis)).sum())
    parts, _ = ndimage.label(rest)
    return outer >= COVERS * max(faces, 1) and int(np.bincount(parts.ravel())[1:].max()) >= WHOLE * int(rest.sum())


def _thickness_mm(voxels: BoolArray, rest: BoolArray, grid: Volume) -> float:
    """Return the mean thickness of a covering, mm: its volume over the area of what it covers."""
    slopes = np.gradient(ndimage.gaussian_filter(rest.astype(np.float32), 1.0), *grid.spacing_mm[::-1])
    near = ndimage.binary_dilation(voxels, iterations=SPREAD)
    area = float(np.sqrt(sum(s**2 for s in slopes))[near].sum())
    return float(voxels.sum()) / max(area, 1e-12)


def told_left_out(found: FieldEstimate, covering: Covering | None, known: Collection[str]) -> FieldEstimate:
    """Return the estimate with the zones that were left out named in its verdict first, as not determined unless they are `known`."""
    if covering is None:
        return found
    own, stated = (tuple(name for name in covering.names if (name in known) == wanted) for wanted in (False, True))
    limits = [LEFT_OUT.format(" and ".join(own), "they are" if len(own) > 1 else "it is")] if own else []
    limits += [STATED.format(" and ".join(stated), "are" if len(stated) > 1 else "is")] if stated else []
    each = tuple(
        TOLD.format(name, mm, "" if name in known else WHY).replace("  ", " ")
        for name, mm in zip(covering.names, covering.thickness_mm, strict=True)
    )
    if found.verdict is None:
        return replace(found, identifiability=(*found.identifiability, *each))
    judged = replace(found.verdict, limits="; ".join(filter(None, (*limits, found.verdict.limits))))
    return replace(found, verdict=judged, identifiability=(judged.sentence, *each, *found.identifiability[1:]))
