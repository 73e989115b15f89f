"""Mass-spring-dashpot lattices of three-element (Jeffreys) elements :cite:p:`hirai2008` (chapter 4.3)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import product

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike
from scipy.sparse.csgraph import connected_components

from naibu.core.arrays import BoolArray, FloatArray, Int8Array, IntArray
from naibu.core.errors import InputError
from naibu.core.rigid_transform import RigidTransform
from naibu.mechanics.lattices.model.voxel_elements import VoxelElements

CLASSES = ("short", "normal", "long")  # edges, face diagonals and space diagonals of a cube
ZONES = ("core", "surface")
_HEXAHEDRON = (0, 1, 3, 2, 4, 5, 7, 6)  # VTK's order of corners that are numbered x fastest

ByClass = float | ArrayLike | Mapping[str, "float | Mapping[str, float]"]


@dataclass(frozen=True, slots=True, eq=False)
class Lattice:
    """Mass-spring-dashpot lattice: nodes with mass, and the elements between them.

    Attributes
    ----------
    points : ndarray, shape (n, 3)
        Positions at rest, mm; sorted by z, then y, then x where they stand on a grid.
    elements : ndarray, shape (m, 2), int64
        Numbers of the two nodes of every element, the smaller one first.
    node_mass : ndarray, shape (n,)
        kg.
    element_class : ndarray, shape (m,), int8
        0 short, 1 normal, 2 long: see `CLASSES`.
    element_zone : ndarray, shape (m,), int8
        0 core, 1 surface, which has a node on the surface: see `ZONES`.
    element_level : ndarray, shape (m,), int8
        Level of the octree, 0 for the finest voxels.
    surface_node : ndarray, shape (n,), bool
        Nodes on the surface.
    spacing_mm : float
        Edge of the finest voxels, mm; the mean length of elements where there are none.
    scale : ndarray, shape (m,)
        How many times stiffer, and more viscous, than between the finest voxels an element is to be so that the solid answers as the
        classic lattice does: see `naibu.mechanics.lattices.model.octrees.octree.octree_lattice`. One in classic lattices, read-only.
    cells : ndarray, shape (c, 8), int64, optional
        Nodes of the cubes in VTK's order of a hexahedron; None of lattices of any other shape.
    faces : ndarray, shape (f, 3) or (f, 4), int64, optional
        Outer faces that may come into contact, counter-clockwise seen from outside; None: those of the cells, or single nodes where there
        are none.
    frame : RigidTransform
        From `points` to the frame of the scanner, in which results are written; the identity where there was no scan.
    parted : ndarray, shape (k,), int64, optional
        Faces ``6 cube + face`` that cuts have gone through, of the larger cube where two sizes meet; None of lattices that were never cut.
    """

    points: FloatArray
    elements: IntArray
    node_mass: FloatArray
    element_class: Int8Array
    element_zone: Int8Array
    element_level: Int8Array
    surface_node: BoolArray
    spacing_mm: float
    scale: FloatArray
    cells: IntArray | None = None
    frame: RigidTransform = field(default_factory=RigidTransform.identity)
    faces: IntArray | None = None
    parted: IntArray | None = None

    @property
    def n_nodes(self) -> int:
        """Number of nodes."""
        return len(self.points)

    @property
    def n_elements(self) -> int:
        """Number of elements."""
        return len(self.elements)

    @property
    def lengths(self) -> FloatArray:
        """Lengths at rest (m,), mm."""
        i, j = self.elements.T
        return np.asarray(np.linalg.norm(self.points[j] - self.points[i], axis=1))

    @property
    def total_mass(self) -> float:
        """Mass of the lattice, kg."""
        return float(self.node_mass.sum())


@dataclass(frozen=True, slots=True, eq=False)
class LatticeParameters:
    """Parameters of the three-element elements of a lattice.

    Attributes
    ----------
    stiffness : ndarray, shape (m,)
        K of the spring, mN/mm.
    voigt_damping : ndarray, shape (m,)
        C1 of the dashpot beside the spring, mN s/mm.
    series_damping : ndarray, shape (m,)
        C2 of the dashpot in line with both, mN s/mm; infinite for Kelvin-Voigt elements, which leave no residual displacement.
    voigt_fraction : ndarray, shape (m,)
        Part `a` of the length at rest that the Voigt part takes. It changes neither force nor shape: only the extension Z - a L enters.
        Read-only where it is one number.
    """

    stiffness: FloatArray
    voigt_damping: FloatArray
    series_damping: FloatArray
    voigt_fraction: FloatArray


def classic_lattice(
    mask: BoolArray,
    spacing_mm: float,
    *,
    total_mass_kg: float | None = None,
    density: float | None = None,
    lumping: str = "volume",
    origin: ArrayLike = (0.0, 0.0, 0.0),
    frame: RigidTransform | None = None,
) -> Lattice:
    """Return the regular lattice of a voxel mask: nodes at the corners of voxels, each joined to its up to 26 neighbours.

    Two nodes are joined where a voxel has both as corners.

    Parameters
    ----------
    mask : ndarray, shape (nx, ny, nz), bool
        Voxels of the object.
    spacing_mm : float
        Edge of a voxel, mm.
    total_mass_kg, density : float
        One of the two: kg, or kg/mm^3.
    lumping : str
        ``"volume"``: every voxel gives an eighth of its mass to each corner; ``"equal"``: all nodal masses are equal, as in the report.
    origin : array_like, shape (3,)
        Position of the corner (0, 0, 0) of the grid, mm.
    frame : RigidTransform, optional
        From these positions to the scanner's frame; see `naibu.mechanics.lattices.model.voxels.voxel_mask`.

    Raises
    ------
    InputError
        A mask without voxels or in pieces, a spacing, mass or density that is not positive, or an unknown lumping.
    """
    filled = checked_mask(mask)
    require_positive(spacing_mm, "the spacing", "mm")
    found = VoxelElements.of(filled)
    n, m = len(found.nodes), len(found.pairs)
    volumes = np.full(len(found.cells), spacing_mm**3)
    masses = lumped_masses(found.cells, volumes, n, total_mass_kg=total_mass_kg, density=density, lumping=lumping)
    if not found.connected:
        require_connected(found.pairs, n, np.asarray(found.nodes * spacing_mm, dtype=np.float64))
    points = np.asarray(origin, dtype=float) + spacing_mm * found.nodes
    level, placed = np.zeros(m, dtype=np.int8), frame or RigidTransform.identity()
    kind, zone, spacing = found.element_class, found.element_zone, float(spacing_mm)
    scale = np.broadcast_to(1.0, m)  # takes no memory
    return Lattice(points, found.pairs, masses, kind, zone, level, found.surface, spacing, scale, found.cells, placed)


def box_mask(shape: tuple[int, int, int]) -> BoolArray:
    """Return a mask of nx x ny x nz voxels, all of them in the object."""
    return np.ones(shape, dtype=bool)


def checked_mask(mask: BoolArray) -> BoolArray:
    """Return a mask of voxels as booleans.

    Raises
    ------
    InputError
        It has not three axes, or no voxel.
    """
    array = np.asarray(mask)
    if array.ndim != 3:
        raise InputError(f"a mask of voxels has three axes, not {array.ndim}")
    if array.dtype.kind == "f" and np.isnan(array).any():
        raise InputError(f"the mask holds {int(np.isnan(array).sum())} NaN; give booleans, true in the object")
    filled = array.astype(bool)
    if not filled.any():
        raise InputError(f"the mask of shape {array.shape} holds no voxel; lower the threshold that made it, or give another mask")
    return filled


def require_positive(value: float, what: str, unit: str) -> None:
    """Check a number.

    Raises
    ------
    InputError
        It is not positive and finite.
    """
    if not (np.isfinite(value) and value > 0.0):
        raise InputError(f"{what} must be positive and finite, not {value:g} {unit}")


def lumped_masses(
    corners: IntArray, volumes: FloatArray, n_nodes: int, *, total_mass_kg: float | None, density: float | None, lumping: str
) -> FloatArray:
    """Return the mass of every node (n,), kg, from cubes of given volumes, mm^3.

    Raises
    ------
    InputError
        Both or none of mass and density, one that is not positive, or an unknown lumping.
    """
    if (total_mass_kg is None) == (density is None):
        raise InputError("give the mass of the object (total_mass_kg) or its density (kg/mm^3), one of the two")
    if total_mass_kg is None:
        assert density is not None
        require_positive(density, "the density", "kg/mm^3")
        total = density * float(volumes.sum())
    else:
        require_positive(total_mass_kg, "the mass of the object", "kg")
        total = total_mass_kg
    if lumping == "equal":
        return np.full(n_nodes, total / n_nodes)
    if lumping != "volume":
        raise InputError(f"masses are lumped by 'volume' or 'equal', not by {lumping!r}")
    per_node, eighth = np.zeros(n_nodes), volumes / 8.0
    for own in corners.T:
        per_node += np.bincount(own, eighth, minlength=n_nodes)
    return np.asarray(total * per_node / volumes.sum())


def assembled(
    nodes: IntArray,
    corners: IntArray,
    pairs: IntArray,
    level: Int8Array,
    masses: FloatArray,
    surface: BoolArray,
    spacing_mm: float,
    origin: ArrayLike,
    scale: FloatArray,
    frame: RigidTransform | None = None,
) -> Lattice:
    """Return the lattice of nodes at grid positions (n, 3) and elements (m, 2), classed by their directions.

    Raises
    ------
    InputError
        The elements leave it in pieces.
    """
    require_connected(pairs, len(nodes), np.asarray(nodes * spacing_mm, dtype=np.float64))
    offset = np.abs(nodes[pairs[:, 1]] - nodes[pairs[:, 0]])
    kind = (np.count_nonzero(offset, axis=1) - 1).astype(np.int8)
    zone = (surface[pairs[:, 0]] | surface[pairs[:, 1]]).astype(np.int8)
    points = np.asarray(origin, dtype=float) + spacing_mm * nodes
    cells, placed = corners[:, _HEXAHEDRON], frame or RigidTransform.identity()
    return Lattice(points, pairs, masses, kind, zone, level, surface, float(spacing_mm), scale, cells, placed)


def require_connected(pairs: IntArray, n_nodes: int, points: FloatArray) -> None:
    """Check that all nodes are connected.

    Raises
    ------
    InputError
        They do not; the message counts the pieces and says where the smallest lies.
    """
    graph = sp.coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n_nodes, n_nodes))
    count, piece = connected_components(graph, directed=False)
    if count > 1:
        sizes = np.bincount(piece)
        where = points[piece == int(np.argmin(sizes))].mean(axis=0)
        raise InputError(
            f"the lattice falls into {count} pieces; the smallest has {sizes.min()} masses around "
            f"({where[0]:.4g}, {where[1]:.4g}, {where[2]:.4g}) mm: keep the largest piece of the mask, or make one lattice of each"
        )


def lattice_parameters(
    lattice: Lattice,
    stiffness: ByClass,
    voigt_damping: ByClass,
    series_damping: ByClass,
    voigt_fraction: ByClass = 0.7,
    *,
    scaled: bool = True,
) -> LatticeParameters:
    """Return the parameters of all elements.

    Each argument is one number, an array (m,) with one number an element, or a mapping with the keys ``"short"``, ``"normal"``, ``"long"``
    or ``"core"``, ``"surface"``; values may be mappings with the keys of the other kind.

    Parameters
    ----------
    lattice : Lattice
        The nodes and elements.
    stiffness, voigt_damping, series_damping, voigt_fraction : float, array_like or mapping
        K (mN/mm), C1, C2 (mN s/mm) and a. K and C1 may be zero, C2 may be infinite.
    scaled : bool
        Whether K, C1 and C2 are those between the finest voxels, and are to be multiplied by `Lattice.scale` between coarser ones.

    Raises
    ------
    InputError
        A parameter that is negative, NaN or infinite where it may not be, C2 = 0, which would leave an element without force, or `a`
        outside of 0 to 1; missing or unknown keys; an array of another length.
    """
    k = _per_element(lattice, stiffness, "K")
    c1 = _per_element(lattice, voigt_damping, "C1")
    c2 = _per_element(lattice, series_damping, "C2")
    a = (
        np.broadcast_to(voigt_fraction, lattice.n_elements)
        if isinstance(voigt_fraction, float)
        else _per_element(lattice, voigt_fraction, "a")
    )
    if scaled:
        for values in (k, c1, c2):
            values *= lattice.scale
    for name, unit, values, bounds, rule in (
        ("K", " mN/mm", k, (0.0, np.inf, "[)"), "must be finite and not negative"),
        ("C1", " mN s/mm", c1, (0.0, np.inf, "[)"), "must be finite and not negative"),
        ("C2", " mN s/mm", c2, (0.0, np.inf, "(]"), "must be positive (infinite for none)"),
        ("a", "", a, (0.0, 1.0, "()"), "must lie between 0 and 1"),
    ):
        if _within(values.min(), bounds) and _within(values.max(), bounds):  # NaN passes on to both
            continue
        valid = _within(values, bounds)
        bad = int(np.argmin(valid))
        raise InputError(f"{name} of element {bad} is {values[bad]:g}{unit}; it {rule}: {int((~valid).sum())} of {len(valid)} are not")
    return LatticeParameters(k, c1, c2, a)


def _within(values: FloatArray, bounds: tuple[float, float, str]) -> BoolArray:
    """Return which values lie in an interval, open or closed at its ends."""
    low, high, ends = bounds
    above = values >= low if ends[0] == "[" else values > low
    return np.asarray(above & (values <= high if ends[1] == "]" else values < high))


def _per_element(lattice: Lattice, value: ByClass, name: str) -> FloatArray:
    m = lattice.n_elements
    if not isinstance(value, Mapping):
        values = np.asarray(value, dtype=float)
        if values.ndim and values.shape != (m,):
            raise InputError(f"{name} has shape {values.shape}; give one number, or one for each of {m} elements")
        return np.array(np.broadcast_to(values, m))
    result = np.full(m, np.nan)
    for names, codes in ((CLASSES, lattice.element_class), (ZONES, lattice.element_zone)):
        if set(value) <= set(names):
            missing = [names[code] for code in np.unique(codes) if names[code] not in value]
            if missing:
                raise InputError(f"{name} is given for {', '.join(sorted(value))} elements, the lattice also has {', '.join(missing)} ones")
            for key, inner in value.items():
                chosen = codes == names.index(key)
                result[chosen] = _per_element(lattice, inner, f"{name} of {key} elements")[chosen]
            return result
    known = ", ".join((*CLASSES, *ZONES))
    raise InputError(f"{name} has the keys {', '.join(map(str, value))}; known are {known}, either classes or zones at one depth")


def voxel_parameters(lattice: Lattice, mask: BoolArray, values: ArrayLike, origin: ArrayLike = (0.0, 0.0, 0.0)) -> FloatArray:
    """Return one number an element (m,) from one number a voxel: the mean over the voxels of the mask that hold the element.

    Parameters
    ----------
    lattice : Lattice
        A classic lattice of the mask.
    mask : ndarray, shape (nx, ny, nz), bool
        Voxels of the object.
    values : array_like, shape (nx, ny, nz)
        Any parameter; read in the mask only.
    origin : array_like, shape (3,)
        As given to `classic_lattice`, mm.

    Raises
    ------
    InputError
        Values of another shape, NaN in the mask, or a lattice that is no classic lattice of the mask.
    """
    filled, given = checked_mask(mask), np.asarray(values, dtype=float)
    if given.shape != filled.shape:
        raise InputError(f"the values have shape {given.shape}, the mask {filled.shape}")
    if np.isnan(given[filled]).any():
        raise InputError(f"{int(np.isnan(given[filled]).sum())} voxels of the mask have the value NaN; fill them")
    weight = np.pad(filled.astype(float), 1)
    weighted = np.pad(np.where(filled, given, 0.0), 1)
    at = np.rint((lattice.points - np.asarray(origin, dtype=float)) / lattice.spacing_mm).astype(np.int64)
    ends = np.sort(at[lattice.elements], axis=1)
    if at.min() < 0 or (at.max(axis=0) > filled.shape).any() or (ends[:, 1] - ends[:, 0]).max() > 1:
        raise InputError("the lattice is no classic lattice of this mask; give the mask and the origin that it was made with")
    sums, counts = np.zeros(lattice.n_elements), np.zeros(lattice.n_elements)
    for step in product((0, 1), repeat=3):  # an element along an axis lies in both neighbours across it
        across = ends[:, 0] == ends[:, 1]
        counted = (across | (np.array(step) == 0)).all(axis=1)
        cell = ends[:, 0] + 1 - np.where(across, step, 0)
        index = tuple(cell[counted].T)
        sums[counted] += weighted[index]
        counts[counted] += weight[index]
    if not (counts > 0.0).all():
        raise InputError("the lattice is no classic lattice of this mask; give the mask and the origin that it was made with")
    return np.asarray(sums / counts)


def general_lattice(points: ArrayLike, elements: ArrayLike, node_mass: ArrayLike) -> Lattice:
    """Return a lattice from arrays of nodes and elements; all elements count as short ones of the core, and no node as on the surface.

    Parameters
    ----------
    points : array_like, shape (n, 3)
        Positions at rest, mm.
    elements : array_like, shape (m, 2)
        Numbers of the two nodes of every element.
    node_mass : array_like, shape (n,)
        kg.

    Raises
    ------
    InputError
        Shapes that do not fit, NaN, masses that are not positive, elements without length, given twice or between nodes that are
        not there, or a lattice in pieces.
    """
    at, pairs, masses = np.asarray(points, dtype=float), np.asarray(elements, dtype=np.int64), np.asarray(node_mass, dtype=float)
    if at.ndim != 2 or at.shape[1] != 3 or masses.shape != (len(at),) or pairs.ndim != 2 or pairs.shape[1] != 2:
        raise InputError(
            f"points, elements and node_mass must have shapes (n, 3), (m, 2) and (n,), not {at.shape}, {pairs.shape}, {masses.shape}"
        )
    if not np.isfinite(at).all():
        raise InputError(f"{int((~np.isfinite(at)).any(axis=1).sum())} of {len(at)} points are NaN or infinite; leave them out")
    if not (np.isfinite(masses) & (masses > 0.0)).all():
        raise InputError(f"masses must be positive; the least is {np.nanmin(masses):g} kg")
    if not len(pairs) or pairs.min() < 0 or pairs.max() >= len(at):
        raise InputError(f"elements join nodes 0 to {len(at) - 1}; give at least one, and none beyond")
    pairs = np.sort(pairs, axis=1)
    lengths = np.linalg.norm(at[pairs[:, 1]] - at[pairs[:, 0]], axis=1)
    if not (lengths > 0.0).all():
        raise InputError(f"element {int(np.argmin(lengths))} joins two nodes at one place; merge them")
    if len(np.unique(pairs, axis=0)) < len(pairs):
        raise InputError(f"{len(pairs) - len(np.unique(pairs, axis=0))} elements are given twice; add up their stiffness instead")
    require_connected(pairs, len(at), at)
    zero = np.zeros(len(pairs), dtype=np.int8)
    return Lattice(at, pairs, masses, zero, zero, zero, np.zeros(len(at), dtype=bool), float(lengths.mean()), np.ones(len(pairs)))
