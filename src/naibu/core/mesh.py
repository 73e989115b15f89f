"""A finite element mesh: points, cells of one type, and the named region of every cell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError

NODES_PER_CELL = {"line": 2, "triangle": 3, "tetra": 4, "tetra10": 10, "hexahedron": 8}
DIMENSION = {"line": 1, "triangle": 2, "tetra": 3, "tetra10": 3, "hexahedron": 3}


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Points and cells: solids in three dimensions, triangles in the plane, or lines on an axis.

    Attributes
    ----------
    points : ndarray, shape (n, d), float64
        Node positions, mm; d is the dimension of the cells.
    cells : ndarray, shape (m, k), int64
        Node numbers of every cell, in VTK order (a positively oriented cell has a positive Jacobian).
    cell_type : str
        ``"tetra"`` (k = 4), ``"tetra10"`` (k = 10) or ``"hexahedron"`` (k = 8) with d = 3; ``"triangle"`` (k = 3, d = 2); ``"line"``
        (k = 2, d = 1).
    regions : ndarray, shape (m,), int64
        Index into `region_names` for every cell.
    region_names : tuple of str
        Name of every region, usually its material.
    """

    points: FloatArray
    cells: IntArray
    cell_type: str
    regions: IntArray
    region_names: tuple[str, ...]

    @classmethod
    def from_arrays(
        cls,
        points: ArrayLike,
        cells: ArrayLike,
        cell_type: str,
        *,
        regions: ArrayLike | None = None,
        region_names: Sequence[str] = ("body",),
    ) -> Mesh:
        """Check the arrays and make a mesh of them.

        Raises
        ------
        InputError
            Wrong shapes, an unknown cell type, node numbers out of range, NaN points, or regions without a name.
        """
        p = np.ascontiguousarray(points, dtype=np.float64)
        c = np.ascontiguousarray(cells, dtype=np.int64)
        if cell_type not in NODES_PER_CELL:
            raise InputError(f"cell type {cell_type!r} is not known; use one of {sorted(NODES_PER_CELL)}")
        dimension = DIMENSION[cell_type]
        if p.ndim != 2 or p.shape[1] != dimension:
            raise InputError(f"points of a mesh of {cell_type} cells must have shape (n, {dimension}), not {p.shape}")
        if c.ndim != 2 or c.shape[1] != NODES_PER_CELL[cell_type] or len(c) == 0:
            raise InputError(f"{cell_type} cells must have shape (m, {NODES_PER_CELL[cell_type]}) with m > 0, not {c.shape}")
        if not np.isfinite(p).all():
            bad = int(np.flatnonzero(~np.isfinite(p).all(axis=1))[0])
            raise InputError(f"mesh point {bad} is {p[bad].tolist()}: every coordinate must be a finite number")
        if c.min() < 0 or c.max() >= len(p):
            raise InputError(f"cells name nodes {c.min()} to {c.max()}, but the mesh has nodes 0 to {len(p) - 1}")
        r = np.zeros(len(c), dtype=np.int64) if regions is None else np.ascontiguousarray(regions, dtype=np.int64)
        if r.shape != (len(c),):
            raise InputError(f"regions must have one entry for each of the {len(c)} cells, not shape {r.shape}")
        if r.min() < 0 or r.max() >= len(region_names):
            raise InputError(f"cells use region {r.max()}, but only {len(region_names)} region names are given")
        return cls(p, c, cell_type, r, tuple(region_names))

    @property
    def n_points(self) -> int:
        """Number of nodes."""
        return len(self.points)

    @property
    def dimension(self) -> int:
        """Number of coordinates of a point."""
        return int(self.points.shape[1])

    @property
    def n_cells(self) -> int:
        """Number of cells."""
        return len(self.cells)

    def moved(self, displacement: FloatArray) -> Mesh:
        """Return the mesh with every node moved by `displacement` (n, d), mm."""
        if displacement.shape != self.points.shape:
            raise InputError(f"displacement must have shape {self.points.shape}, not {displacement.shape}")
        return replace(self, points=self.points + displacement)
