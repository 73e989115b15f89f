"""The object in a scan as hexahedra that fill it, one zone a label."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Mapping
from itertools import pairwise

import numpy as np
from scipy import ndimage

from naibu.core.arrays import AnyArray, BoolArray, FloatArray, IntArray, require_lengths
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.core.volume import Volume
from naibu.identification.from_fields.assumptions.other_assumptions import MovedBorder
from naibu.io.images import read_volume
from naibu.meshing.primitives import grid_cells
from naibu.meshing.surface import boundary_faces

CELLS = 1200  # by default
BLURRED = 0.01  # part of the object that cubes may misrepresent without a word
OF_ZONE = 0.02  # the same of a zone: small ones are a small part of the object, and their moduli err by about as much as their cubes
MOST_CELLS = 100_000  # of a mesh whose size is asked for: beyond, a factorization does not fit into memory
MOST_LABEL = 65535
BEYOND = "beyond the object"  # region of cells around it, which help to fit others to its surface and are then removed
PLANE = 0.5  # part of a section of the object that changes its zone there: cells begin at such a plane
# part of a zone, or of its cells, that is not the other: with 0.37 a thin skin was found 2 to 7 times too stiff
LOST = 0.25
SMALLER, MOST_BY_DEFAULT = 0.95, 5000  # steps of the size of cells, such that borders fall between cells, and how many are made unasked
NARROWEST = 0.3  # of a cell, in edge lengths, between such planes
WHOLE_VOXELS = 1.000001  # of a stated edge length: lengths of voxels are rounded in headers
HALF_FILLED = 0.5  # part of a cell that must lie in the object
UNIFORM = 3.0**0.5  # standard deviations from the middle of a voxel to its end, of a place that is anywhere in it


def labelled_object(mask: str | os.PathLike[str] | None, zones: str | os.PathLike[str] | None) -> tuple[Volume, IntArray]:
    """Return the object as a volume of ones and zeros, and the label of every voxel."""
    read = [None if path is None else read_volume(path) for path in (mask, zones)]
    first = next((v for v in read if v is not None), None)
    if first is None:
        raise InputError("give `mask`, the voxels of the object, or `zones`, a label for each material")
    if read[0] is not None and read[1] is not None and not read[0].same_grid(read[1]):
        raise InputError("mask and zones lie on different grids; resample one of them")
    labels = np.ones(first.shape, dtype=np.int64) if read[1] is None else _whole(read[1].values)
    inside = (labels > 0) & (True if read[0] is None else read[0].values != 0)
    if not inside.any():
        raise InputError("mask and zones have no voxel in common: there is no object")
    return first.with_values(inside.astype(np.uint8)), labels


def _whole(values: AnyArray) -> IntArray:
    """Return labels as whole numbers."""
    wrong = ~(np.abs(values) <= MOST_LABEL) | (values != np.round(values))  # also what is not a number
    if wrong.any():
        at = tuple(int(i) for i in np.argwhere(wrong)[0])
        raise InputError(
            f"zones has the value {values[at]:g} at voxel {at[::-1]} (x, y, z): labels are whole numbers up to {MOST_LABEL}; "
            "is it a scan, or was it interpolated?"
        )
    return values.astype(np.int64)


def names_of_labels(labels: IntArray, inside: Volume, given: Mapping[int, str]) -> dict[int, str]:
    """Return the names of the labels that occur in the object.

    Raises
    ------
    InputError
        A name of a label that does not occur.
    """
    there = np.unique(labels[inside.values != 0]).tolist()
    if unknown := sorted(set(given) - set(there)):
        raise InputError(f"zone_names names label {unknown[0]}, which no voxel of the object has; there are {', '.join(map(str, there))}")
    return {label: given.get(label, f"label {label}" if len(there) > 1 else "body") for label in there}


def sizes_of_voxels(inside: Volume, element_size_mm: float) -> tuple[str, ...]:
    """Say along which axes cells of a stated size, mm, are as long as voxels, because these are longer.

    Raises
    ------
    InputError
        A size that is no length, or below that of voxels along every axis.
    """
    require_lengths(element_size_mm=element_size_mm)
    spacing = np.asarray(inside.spacing_mm)
    if (spacing > WHOLE_VOXELS * element_size_mm).all():
        raise InputError(
            f"element_size_mm is {element_size_mm:g} mm, less than the voxels of mask and zones ({' x '.join(f'{s:.3g}' for s in spacing)} "
            f"mm), of which cells are made; choose at least {spacing.min():.3g} mm"
        )
    return tuple(
        f"Along {axis} of the grid elements are {length:.3g} mm long, as voxels are, and not {element_size_mm:g} mm."
        for axis, length in zip("xyz", spacing, strict=True)
        if length > WHOLE_VOXELS * element_size_mm
    )


def block_mesh(inside: Volume, labels: IntArray, names: Mapping[int, str], element_size_mm: float) -> tuple[Mesh, IntArray]:
    """Return hexahedra that fill the object, and the cell of every voxel (nz, ny, nx), -1 outside.

    Where zones meet in a plane of the grid, cells end there; other borders are those of the cells with most of their voxels.

    Parameters
    ----------
    inside : Volume
        Not zero in the object.
    labels : ndarray, shape (nz, ny, nx), int64
        Zone of every voxel.
    names : mapping
        Names of the labels.
    element_size_mm : float
        Edge length; along an axis on which voxels are longer, theirs; 0 for about 1200 cells.

    Raises
    ------
    InputError
        A size so small or large that there are too many cells or too few.
    """
    voxels = np.argwhere(inside.values != 0)[:, ::-1]
    volume = len(voxels) * float(np.prod(inside.spacing_mm))
    size = element_size_mm or (volume / CELLS) ** (1.0 / 3.0)
    low, high = voxels.min(axis=0), voxels.max(axis=0) + 1
    edges = [_edges(inside, labels, axis, int(low[axis]), int(high[axis]), size) for axis in range(3)]
    counts = np.array([len(e) - 1 for e in edges])
    if volume / size**3 > MOST_CELLS and np.prod(counts) > MOST_CELLS:
        least = (volume / MOST_CELLS) ** (1.0 / 3.0)
        raise InputError(f"element_size_mm is {size:.3g} mm, which makes more than {MOST_CELLS} cells; choose at least {least:.2g} mm")
    layer = [np.searchsorted(e, np.arange(n) + 0.5, side="right") - 1 for e, n in zip(edges, high - low, strict=True)]  # of voxels
    block = np.stack([of_axis[v] for of_axis, v in zip(layer, (voxels - low).T, strict=True)], axis=1)
    number = block @ np.array([1, counts[0], counts[0] * counts[1]])
    total = int(np.prod(counts))
    per_axis = [np.bincount(of_axis, minlength=c) for of_axis, c in zip(layer, counts, strict=True)]
    room = (per_axis[2][:, None, None] * per_axis[1][:, None] * per_axis[0]).ravel()  # voxels of a full cell
    share = np.bincount(number, minlength=total) / room
    parts, _ = ndimage.label((share >= HALF_FILLED).reshape(counts[::-1]))
    largest = int(np.argmax(np.bincount(parts.ravel())[1:])) + 1 if parts.any() else 1
    kept = np.flatnonzero(parts.ravel() == largest)
    if len(kept) < 8:
        raise InputError(f"the object has room for {len(kept)} cells of {size:.3g} mm; choose a smaller element_size_mm")
    order = sorted(names)
    votes = np.stack([np.bincount(number[labels[tuple(voxels.T[::-1])] == label], minlength=total) for label in order])
    corners = grid_cells(*(counts + 1))[kept]
    used, cells = np.unique(corners, return_inverse=True)
    axes = np.stack(np.unravel_index(used, tuple(counts[::-1] + 1))[::-1], axis=1)
    points = inside.to_physical(low - 0.5 + np.stack([e[i] for e, i in zip(edges, axes.T, strict=True)], axis=1))
    regions = votes[:, kept].argmax(axis=0)
    mesh = Mesh.from_arrays(points, cells.reshape(corners.shape), "hexahedron", regions=regions, region_names=[names[k] for k in order])
    if np.linalg.det(inside.direction) < 0.0:
        mesh = Mesh(mesh.points, mesh.cells[:, [4, 5, 6, 7, 0, 1, 2, 3]], "hexahedron", mesh.regions, mesh.region_names)
    cell = np.full(total, -1, dtype=np.int64)
    cell[kept] = np.arange(len(kept))
    of_voxel = np.full(inside.shape, -1, dtype=np.int64)
    of_voxel[tuple(voxels.T[::-1])] = cell[number]
    return mesh, of_voxel


def _edges(inside: Volume, labels: IntArray, axis: int, low: int, high: int, size_mm: float) -> FloatArray:
    """Return where cells begin and end along an axis, in voxels from `low`: at plane borders of zones, and evenly between them."""
    width = size_mm / float(inside.spacing_mm[axis])
    fixed = [0]
    for plane in (_planes(inside, labels, axis) - low).tolist():
        if plane - fixed[-1] >= NARROWEST * width and high - low - plane >= NARROWEST * width:
            fixed.append(plane)
    fixed.append(high - low)
    parts = [np.linspace(a, b, int(np.clip(np.round((b - a) / width), 1, b - a)), endpoint=False) for a, b in pairwise(fixed)]
    return np.append(np.concatenate(parts), float(high - low))


def _planes(inside: Volume, labels: IntArray, axis: int) -> IntArray:
    """Return the first voxel behind every plane of the grid normal to an axis in which zones meet."""
    here, there = (np.moveaxis(a, 2 - axis, 0) for a in (inside.values != 0, labels))
    both = here[1:] & here[:-1]
    across = both & (there[1:] != there[:-1])
    pairs, changes = both.sum(axis=(1, 2)), across.sum(axis=(1, 2))
    return np.asarray(np.flatnonzero(changes > PLANE * np.maximum(pairs, 1)) + 1)


def moved_borders(mesh: Mesh, inside: Volume, labels: IntArray) -> tuple[MovedBorder, ...]:
    """Return the mesh of `block_mesh` with each plane border of zones half a voxel further.

    Labels say to a voxel where a border lies. Where it runs across the grid, what they round differs from voxel to voxel and hardly moves
    the whole; in a plane of the grid it is the same everywhere, and may be anything up to half a voxel.
    """
    index, out = inside.to_index(mesh.points), []
    surface = boundary_faces(mesh).faces
    lowest, highest = np.full(mesh.n_points, len(mesh.region_names)), np.full(mesh.n_points, -1)
    np.minimum.at(lowest, mesh.cells, mesh.regions[:, None])
    np.maximum.at(highest, mesh.cells, mesh.regions[:, None])
    for axis in range(3):
        for plane in _planes(inside, labels, axis).tolist():
            within = np.abs(index[:, axis] - (plane - 0.5)) < 1e-6
            nodes = within & (lowest != highest)
            nodes[surface[within[surface].all(axis=1)]] = False  # where a step of the surface lies in the plane
            if not nodes.any():
                continue
            moved = index.copy()
            moved[nodes, axis] += 0.5
            meeting = np.unique(mesh.regions[nodes[mesh.cells].any(axis=1)])
            names = " and ".join(repr(mesh.region_names[region]) for region in meeting)
            way = f"half a voxel ({0.5 * inside.spacing_mm[axis]:.2g} mm) further along {'xyz'[axis]} of the grid"
            out.append(MovedBorder(f"with the border of {names} {way}", inside.to_physical(moved), UNIFORM))
    return tuple(out)


NO_SIZE = f"no element_size_mm would do whose cells, at most {MOST_CELLS}, can be computed, and that is no less than the voxels"


class ZoneTooThin(InputError):
    """A zone that shares too little with its cubes: `shared` is the part of their volume, and `size_mm` the edge length of the cubes."""

    def __init__(self, zone: str, shared: float, size_mm: float, mend: str = "choose a smaller element_size_mm") -> None:
        super().__init__(
            f"zone {zone!r} and its cubes of {size_mm:.3g} mm share only {100 * shared:.0f} % of their volume, too little "
            f"for its modulus: {mend}, or give the zone the label of its neighbour"
        )
        self.zone, self.shared, self.size_mm = zone, shared, size_mm

    def with_size(self, inside: Volume, labels: IntArray, names: Mapping[int, str], sought: Collection[str]) -> ZoneTooThin:
        """Return the error that names the largest size of cells at which all zones that are sought share enough with theirs."""
        size = float(f"{SMALLER * self.size_mm:.3g}")
        while size >= min(inside.spacing_mm):
            try:
                mesh, _ = mesh_that_shows(inside, labels, names, sought, size, exactly=True)
            except ZoneTooThin:
                size = float(f"{SMALLER * size:.3g}")
            except InputError:  # too many cells
                break
            else:
                return ZoneTooThin(self.zone, self.shared, self.size_mm, f"element_size_mm {size:g} would do, with {_within(mesh)} cells")
        return ZoneTooThin(self.zone, self.shared, self.size_mm, NO_SIZE)


def mesh_that_shows(
    inside: Volume,
    labels: IntArray,
    names: Mapping[int, str],
    sought: Collection[str],
    element_size_mm: float,
    *,
    exactly: bool,
    most: int = MOST_BY_DEFAULT,
) -> tuple[Mesh, IntArray]:
    """Return hexahedra as `block_mesh`, so small that zones that are sought share three quarters with their own cells.

    Parameters
    ----------
    inside, labels, names, element_size_mm
        See `block_mesh`.
    sought : collection of str
        Names of zones.
    exactly : bool
        Whether cells must be of that size; otherwise they may be smaller.
    most : int
        Cells that are made at most, those of the region `BEYOND` not counted.

    Raises
    ------
    ZoneTooThin
        A zone that does not: what would be found for its cells is not its modulus.
    """
    size = element_size_mm
    while True:
        mesh, cells = block_mesh(inside, labels, names, size)
        lost = _lost(mesh, cells, inside.values != 0, labels, names, sought)
        worst = max(lost, key=lambda name: lost[name], default="")
        if not lost or lost[worst] <= LOST:
            return mesh, cells
        if exactly or _within(mesh) > most * SMALLER**3 or size <= min(inside.spacing_mm):
            raise ZoneTooThin(worst, 1.0 - lost[worst], size)
        size *= SMALLER


def _lost(
    mesh: Mesh, cells: IntArray, there: BoolArray, labels: IntArray, names: Mapping[int, str], sought: Collection[str]
) -> dict[str, float]:
    """Return which part of every zone that is sought, or of its cells, is not the other, of the voxels that are `there` (nz, ny, nx)."""
    given = np.where(cells >= 0, np.array(sorted(names))[mesh.regions[cells]], -1)
    lost = {}
    for label, name in names.items():
        if name in sought:
            zone, own = there & (labels == label), there & (given == label)
            lost[name] = 1.0 - float((zone & own).sum() / max(zone.sum(), own.sum(), 1))
    return lost


def _within(mesh: Mesh) -> int:
    """Return how many cells are of the object."""
    return mesh.n_cells - sum(int((mesh.regions == k).sum()) for k, name in enumerate(mesh.region_names) if name == BEYOND)


def regions_of(labels: IntArray, names: Mapping[int, str]) -> IntArray:
    """Return the number of the region of a mesh from `block_mesh` of every voxel (nz, ny, nx), -1 for labels without a name."""
    of_label = np.full(labels.max() + 1, -1, dtype=np.int64)
    of_label[sorted(names)] = np.arange(len(names))
    return np.asarray(of_label[np.maximum(labels, 0)])


def region_in(inside: Volume, labels: IntArray, names: Mapping[int, str]) -> Callable[[FloatArray], IntArray]:
    """Return what gives the number of the region of a mesh from `block_mesh` at points (k, 3), mm; -1 outside of the object."""
    numbers = np.where(inside.values != 0, regions_of(labels, names), -1)

    def at(points: FloatArray) -> IntArray:
        index = np.round(inside.to_index(points)).astype(np.int64)[:, ::-1]
        index = np.clip(index, 0, np.array(numbers.shape) - 1)
        return np.asarray(numbers[tuple(index.T)])

    return at


def misplaced(mesh: Mesh, cell_of_voxel: IntArray, inside: Volume, labels: IntArray, names: Mapping[int, str]) -> tuple[float, float]:
    """Return which parts of the object the cubes leave out, and assign to another zone."""
    there = inside.values != 0
    cells = cell_of_voxel[there]
    wrong = np.array(sorted(names))[mesh.regions[cells]] != labels[there]
    return float(np.mean(cells < 0)), float(np.mean((cells >= 0) & wrong))


def lost_parts(mesh: Mesh, cell_of_voxel: IntArray, labels: IntArray, names: Mapping[int, str]) -> dict[str, float]:
    """Return which part of every zone, or of its cubes, is not the other, by name; what cubes leave out of the object does not count."""
    return _lost(mesh, cell_of_voxel, cell_of_voxel >= 0, labels, names, names.values())


def ends_within(wrong: float, lost: Mapping[str, float]) -> bool:
    """Whether zones end inside of cubes, so that moduli need a correction: from `misplaced` and `lost_parts`."""
    return wrong >= BLURRED or max(lost.values(), default=0.0) >= OF_ZONE


def blurred(left_out: float, wrong: float, lost: Mapping[str, float], *, corrected: bool) -> tuple[str, ...]:
    """Say what cubes make of the object, from `misplaced` and `lost_parts`, and whether moduli are corrected for it; if little, nothing."""
    cost = "what this costs is not in the intervals; compare with other sizes of elements."
    told = []
    if left_out >= BLURRED:
        told.append(f"The cubes leave out {100 * left_out:.2g} % of the object, at its surface: {cost}")
    if ends_within(wrong, lost):
        own = "moduli are corrected for what cubes of half the size change, and as much is part of their standard deviations."
        worst = max(lost, key=lambda name: lost[name], default="")
        small = wrong < BLURRED  # in all, but much of a small zone
        what = f"share only {100 * (1.0 - lost[worst]):.2g} % of their volume with {worst}" if small else ""
        all_of_it = f"assign {100 * wrong:.2g} % of the object to another zone"
        told.append(f"The cubes {what or all_of_it}, because zones end inside of them: {own if corrected else cost}")
    return tuple(told)
