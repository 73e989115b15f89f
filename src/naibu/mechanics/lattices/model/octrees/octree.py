"""Octree lattices: fine voxels near the visible surface, coarse ones inside :cite:p:`hirai2008` (chapter 4.3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import BoolArray, FloatArray, Int8Array, IntArray
from naibu.core.errors import InputError
from naibu.core.rigid_transform import RigidTransform
from naibu.mechanics.lattices.model.lattice import Lattice, assembled, checked_mask, lumped_masses, require_positive
from naibu.mechanics.lattices.model.octrees.compliance_correction import response_factors
from naibu.mechanics.lattices.model.octrees.energy_scaling import OctreeGrid, edge_factors, energy_factors

SCALINGS = ("response", "energy", "edge")

_FACES = np.array([(-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1)])


def octree_lattice(
    mask: BoolArray,
    spacing_mm: float,
    kind: int = 0,
    *,
    total_mass_kg: float | None = None,
    density: float | None = None,
    lumping: str = "volume",
    origin: ArrayLike = (0.0, 0.0, 0.0),
    scaling: str = "response",
    class_stiffness: ArrayLike = (1.0, 1.0, 1.0),
    frame: RigidTransform | None = None,
) -> Lattice:
    """Return the octree lattice of a mask.

    A cube that the object fills is split while a face of it lies on the part of the surface that is to be fine: all of it (type 0), or all
    but the floor (types 1 and 2). Type 2 keeps cubes of two voxels whole in the corners of the object. Nodes are the corners of all
    cubes; within each cube its corners are joined, but where another node lies between them.

    Parameters
    ----------
    mask : ndarray, shape (nx, ny, nz), bool
        Voxels of the object; the floor is its lowest layer. It is embedded in the smallest cube of a power of two that holds it.
    spacing_mm : float
        Edge of a voxel, mm.
    kind : int
        0, 1 or 2.
    total_mass_kg, density : float
        One of the two: kg, or kg/mm^3.
    lumping : str
        ``"volume"``, ``"equal"``, or ``"smallest"``: the report's rule, by which a node at cubes of several sizes takes that of the
        smallest; it loses mass (up to a quarter of it).
    origin : array_like, shape (3,)
        Position of the corner (0, 0, 0) of the grid, mm.
    scaling : str
        Rule for `Lattice.scale`: ``"response"``, such that forces and the shape of the surface are those of the classic lattice;
        ``"energy"``, quicker, with the same energy in uniform strain, but softer as nodes on faces of coarser cubes are compliant;
        ``"edge"``, the mean edge of the cubes around an element. See `naibu.mechanics.lattices.model.octrees.compliance_correction`.
    class_stiffness : array_like, shape (3,)
        K of short, normal and long elements, in any unit, if they are known to differ much; for ``"response"`` only.
    frame : RigidTransform, optional
        As of `classic_lattice`.

    Raises
    ------
    InputError
        An unknown type, lumping or scaling, or what `classic_lattice` refuses.
    """
    if kind not in (0, 1, 2):
        raise InputError(f"octree lattices are of type 0, 1 or 2, not {kind!r}")
    filled = checked_mask(mask)
    require_positive(spacing_mm, "the spacing", "mm")
    cubes, sizes = octree_cubes(filled, kind)
    edge = 2 * max(filled.shape) + 2
    corners, nodes = _corner_numbers(cubes, (edge, edge, edge), sizes)
    corners, nodes = _finest_first(corners, nodes, sizes)
    pairs, level = _leaf_elements(corners, nodes, sizes)
    volumes = np.asarray((sizes * spacing_mm) ** 3.0, dtype=np.float64)
    rule = "volume" if lumping == "smallest" else lumping
    masses = lumped_masses(corners, volumes, len(nodes), total_mass_kg=total_mass_kg, density=density, lumping=rule)
    if lumping == "smallest":
        masses = _masses_of_smallest(corners, sizes, len(nodes), filled, float(masses.sum()))
    scale = octree_factors(OctreeGrid(filled, cubes, sizes, nodes, pairs), scaling, class_stiffness)
    return assembled(nodes, corners, pairs, level, masses, _on_surface(nodes, filled), spacing_mm, origin, scale, frame)


def octree_factors(grid: OctreeGrid, scaling: str = "response", class_stiffness: ArrayLike = (1.0, 1.0, 1.0)) -> FloatArray:
    """Return the factors (m,) by which K, C1 and C2 of the elements of an octree are to be multiplied.

    Parameters
    ----------
    grid : OctreeGrid
        The octree.
    scaling : str
        ``"response"``, ``"energy"`` or ``"edge"``.
    class_stiffness : array_like, shape (3,)
        K of short, normal and long elements of the classic lattice, in any unit; for ``"response"`` only.

    Raises
    ------
    InputError
        An unknown rule, or a K that is not positive.
    """
    stiffness = np.asarray(class_stiffness, dtype=float)
    if scaling not in SCALINGS:
        raise InputError(f"octree lattices are scaled by 'response', 'energy' or 'edge', not by {scaling!r}")
    if stiffness.shape != (3,) or not (np.isfinite(stiffness) & (stiffness > 0.0)).all():
        raise InputError(f"class_stiffness must be three positive numbers (short, normal, long), not {class_stiffness!r}")
    if scaling == "edge":
        return edge_factors(grid)
    factors = energy_factors(grid)
    return response_factors(grid, factors, stiffness) if scaling == "response" else factors


def _corner_numbers(cells: IntArray, shape: tuple[int, ...], sizes: IntArray) -> tuple[IntArray, IntArray]:
    """Return the numbers (k, 8) of the corners of cubes at `cells` (k, 3), of edges `sizes` (k,), and the grid positions (n, 3)."""
    steps = np.array([(a, b, c) for c in (0, 1) for b in (0, 1) for a in (0, 1)])
    at = cells[:, None, :] + sizes[:, None, None] * steps
    nx, ny = shape[0] + 1, shape[1] + 1
    keys, numbers = np.unique(at[..., 0] + nx * (at[..., 1] + ny * at[..., 2]), return_inverse=True)
    nodes = np.stack([keys % nx, keys // nx % ny, keys // (nx * ny)], axis=1)
    return numbers.reshape(at.shape[:2]), nodes


def _finest_first(corners: IntArray, nodes: IntArray, sizes: IntArray) -> tuple[IntArray, IntArray]:
    """Number the nodes at the finest cubes first, so that rows of them are alike: blocks of elements are then better filled."""
    least = np.full(len(nodes), np.iinfo(np.int64).max)
    np.minimum.at(least, corners.ravel(), np.repeat(sizes, corners.shape[1]))
    order = np.argsort(least, kind="stable")
    number = np.empty(len(nodes), dtype=np.int64)
    number[order] = np.arange(len(nodes))
    return number[corners], nodes[order]


def _masses_of_smallest(corners: IntArray, sizes: IntArray, n_nodes: int, filled: BoolArray, total: float) -> FloatArray:
    """Return masses (n,), kg, by the report's rule: that of a node in the classic lattice of the smallest cubes that it touches."""
    least = np.full(n_nodes, np.iinfo(np.int64).max)
    np.minimum.at(least, corners.ravel(), np.repeat(sizes, 8))
    steps = np.array(list(np.ndindex(2, 2, 2)))
    masses = np.zeros(n_nodes)
    for size in np.unique(least):
        coarse = np.unique(np.argwhere(filled) // size, axis=0)
        masses[least == size] = total / len(np.unique((coarse[:, None, :] + steps).reshape(-1, 3), axis=0))
    return masses


def octree_cubes(mask: BoolArray, kind: int) -> tuple[IntArray, IntArray]:
    """Return positions (k, 3) and edges (k,), in voxels, of the cubes that an octree of a type fills the mask with."""
    filled = checked_mask(mask)
    edge = 1 << (max(filled.shape) - 1).bit_length()
    grid = np.zeros((edge, edge, edge), dtype=bool)
    grid[tuple(slice(0, n) for n in filled.shape)] = filled
    exposed = _exposed_faces(grid, kind)
    corner = _corner_block(grid) if kind == 2 else None
    at, size = np.zeros((1, 3), dtype=np.int64), edge
    cubes, sizes = [], []
    while len(at):
        full, empty, refined = _cube_content(grid, exposed, at, size)
        split = ~empty & (~full | refined) if size > 1 else np.zeros(len(at), dtype=bool)
        if corner is not None and size == 2:
            split &= ~(full & corner[tuple(at.T)])
        leaf = ~split & full
        cubes.append(at[leaf])
        sizes.append(np.full(int(leaf.sum()), size))
        size //= 2
        steps = np.array([(a, b, c) for a in (0, size) for b in (0, size) for c in (0, size)])
        at = (at[split][:, None, :] + steps).reshape(-1, 3) if size else np.zeros((0, 3), dtype=np.int64)
    return np.concatenate(cubes), np.concatenate(sizes)


def _exposed_faces(grid: BoolArray, kind: int) -> BoolArray:
    """Return which voxels have a face on the surface that is to be fine."""
    padded = np.pad(grid, 1)
    exposed = np.zeros_like(grid)
    layers = np.flatnonzero(grid.any(axis=(0, 1)))
    for face in _FACES:
        outside = ~np.roll(padded, -face, axis=(0, 1, 2))[1:-1, 1:-1, 1:-1]
        if kind and face[2] == -1:
            outside[:, :, layers[0]] = False
        exposed |= grid & outside
    return exposed


def _corner_block(grid: BoolArray) -> BoolArray:
    """Return which voxels lie in the eight corner blocks, a quarter of each edge, of the box around the object."""
    used = np.argwhere(grid)
    low, high = used.min(axis=0), used.max(axis=0) + 1
    inside = np.ones(grid.shape, dtype=bool)
    for axis in range(3):
        index = np.arange(grid.shape[axis])
        quarter = (high[axis] - low[axis]) // 4
        near = (index < low[axis] + quarter) | (index >= high[axis] - quarter)
        inside &= near.reshape([-1 if a == axis else 1 for a in range(3)])
    return inside


def _cube_content(grid: BoolArray, exposed: BoolArray, at: IntArray, size: int) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Return which cubes are full, which are empty, and which have a voxel with a face on the fine surface."""
    count = len(grid) // size
    blocks: tuple[IntArray, ...] = tuple((at // size).T)
    by_cube = grid.reshape(count, size, count, size, count, size)
    touched = exposed.reshape(count, size, count, size, count, size).any(axis=(1, 3, 5))
    full, used = np.asarray(by_cube.all(axis=(1, 3, 5))), np.asarray(by_cube.any(axis=(1, 3, 5)))
    return full[blocks], ~used[blocks], np.asarray(touched)[blocks]


def _leaf_elements(corners: IntArray, nodes: IntArray, sizes: IntArray) -> tuple[IntArray, Int8Array]:
    """Return the elements (m, 2) of cubes, and the levels of the smallest cubes that have them; none has a node on it."""
    first, second = np.triu_indices(8, 1)
    pairs = np.sort(np.stack([corners[:, first].ravel(), corners[:, second].ravel()], axis=1), axis=1)
    level = np.repeat(np.log2(sizes).astype(np.int8), len(first))
    order = np.lexsort((level, pairs[:, 1], pairs[:, 0]))
    pairs, level = pairs[order], level[order]
    new = np.append(True, (np.diff(pairs, axis=0) != 0).any(axis=1))
    pairs, level = pairs[new], level[new]
    stride = int(nodes.max()) + 2
    taken = np.sort(_key(nodes, stride))
    offset = nodes[pairs[:, 1]] - nodes[pairs[:, 0]]
    span = np.abs(offset).max(axis=1)
    blocked = np.zeros(len(pairs), dtype=bool)
    for parts in 2 ** np.arange(1, int(span.max()).bit_length()):  # nodes stand at multiples of a finer edge
        for k in range(1, parts, 2):
            longer = np.flatnonzero((span >= parts) & ~blocked)
            between = _key(nodes[pairs[longer, 0]] + offset[longer] * k // parts, stride)
            spot = np.minimum(np.searchsorted(taken, between), len(taken) - 1)
            blocked[longer[taken[spot] == between]] = True
    return pairs[~blocked], level[~blocked]


def _key(nodes: IntArray, stride: int) -> IntArray:
    return np.asarray(nodes[:, 0] + stride * (nodes[:, 1] + stride * nodes[:, 2]))


def _on_surface(nodes: IntArray, filled: BoolArray) -> BoolArray:
    """Return which grid positions (n, 3) have an empty voxel beside them."""
    padded = np.pad(filled, 1)
    around = np.stack([padded[tuple((nodes + np.array(s)).T)] for s in np.ndindex(2, 2, 2)])
    return np.asarray(~around.all(axis=0))
