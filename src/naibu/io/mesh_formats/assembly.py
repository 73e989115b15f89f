"""Helpers of the mesh readers: assembly of cell blocks into one mesh, triangulation of polygons, parsing of numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.mesh import NODES_PER_CELL, Mesh

# Cell types without volume, which files may contain beside the volume cells: boundaries and geometry.
FLAT_KINDS = frozenset(
    {"vertex", "poly_vertex", "line", "poly_line", "triangle", "triangle_strip", "polygon", "pixel", "quad"}
    | {"line3", "triangle6", "quad8", "quad9", "triangle7", "line4"}
)


class Block(NamedTuple):
    """Cells of one kind in a file.

    Attributes
    ----------
    kind : str
        Name of the cell type.
    cells : ndarray, shape (m, k), int64
        Indices of points, in VTK order.
    tags : ndarray, shape (m,), int64
        Region tag of every cell, as numbered in the file.
    """

    kind: str
    cells: IntArray
    tags: IntArray


def volume_mesh(source: str, points: FloatArray, blocks: Sequence[Block], names: Mapping[int, str]) -> Mesh:
    """Assemble the volume cells of a file into one mesh; points that none of them uses are dropped.

    Parameters
    ----------
    source : str
        Name of the file, for errors.
    points : ndarray, shape (n, 3)
        All points of the file, in its unit of length.
    blocks : sequence of Block
        All cells of the file; those without volume are ignored.
    names : mapping of int to str
        Region name of each tag. A tag without one is called ``"region_<tag>"`` (``"volume_<n>"`` for the tag -n, which the Gmsh reader
        gives to volumes in no physical group), or ``"body"`` if it is the only one.

    Raises
    ------
    InputError
        No volume cells, types that naibu has no elements for, several types in one file, or cells that refer to missing points.
    """
    volume = [block for block in blocks if block.kind not in FLAT_KINDS and len(block.cells)]
    if not volume:
        kinds = sorted({block.kind for block in blocks})
        raise InputError(
            f"{source}: contains no volume cells (only {kinds or 'points'}); mesh it with volume cells, or save a surface as .stl, .ply, "
            ".obj or .wrl"
        )
    for block in volume:
        if block.kind not in NODES_PER_CELL:
            found = f"{len(block.cells)} cells of type {block.kind!r}"
            raise InputError(f"{source}: contains {found}; naibu has elements for {sorted(NODES_PER_CELL)}: mesh it again with those")
    if len(kinds := sorted({block.kind for block in volume})) > 1:
        raise InputError(f"{source}: mixes volume cells of types {kinds}; only one type is supported: convert all cells to tetrahedra")
    cells = np.concatenate([block.cells for block in volume])
    if cells.min() < 0 or cells.max() >= len(points):
        raise InputError(f"{source}: cells refer to points {cells.min()} to {cells.max()}, but the file has points 0 to {len(points) - 1}")
    tags, regions = np.unique(np.concatenate([block.tags for block in volume]), return_inverse=True)
    unnamed = ["body" if len(tags) == 1 else (f"region_{tag}" if tag >= 0 else f"volume_{-tag}") for tag in tags.tolist()]
    region_names = [names.get(tag, other) for tag, other in zip(tags.tolist(), unnamed, strict=True)]
    used, numbered = np.unique(cells, return_inverse=True)
    if len(used) < len(points):
        points, cells = points[used], numbered.reshape(cells.shape)
    return Mesh.from_arrays(points, cells, kinds[0], regions=regions.ravel(), region_names=region_names)


def fan_triangles(corners: IntArray, counts: IntArray) -> IntArray:
    """Triangulate polygons as fans about their first corner, shape (t, 3).

    Parameters
    ----------
    corners : ndarray, shape (sum of counts,), int64
        Corners of all polygons, concatenated.
    counts : ndarray, shape (f,), int64
        Number of corners of each; polygons with fewer than three are dropped.
    """
    starts = np.cumsum(counts) - counts
    triangles = np.maximum(counts - 2, 0)
    first = np.repeat(starts, triangles)
    step = np.arange(int(triangles.sum())) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    return np.stack([corners[first], corners[first + step + 1], corners[first + step + 2]], axis=1).astype(np.int64)


def numbers(source: str, what: str, text: bytes | str) -> FloatArray:
    """Parse whitespace-separated numbers; an error names the file and the part of it."""
    tokens = text.split()
    try:
        return np.array(tokens, dtype=np.float64)
    except ValueError as error:
        raise InputError(f"{source}: {what} contains something that is not a number ({error}); the file is damaged or truncated") from error
