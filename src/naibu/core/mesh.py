"""Finite element mesh: nodes, cells of one type, and a named region for every cell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray, IntArray, require_finite, require_shape
from naibu.core.errors import InputError

NODES_PER_CELL = {"line": 2, "triangle": 3, "tetra": 4, "tetra10": 10, "hexahedron": 8}
DIMENSION = {"line": 1, "triangle": 2, "tetra": 3, "tetra10": 3, "hexahedron": 3}


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Finite element mesh of a solid (3-D), of triangles in the plane (2-D) or of lines on an axis (1-D).

    Attributes
    ----------
    points : ndarray, shape (n, d), float64
        Node positions, mm; d is the dimension of the cells.
    cells : ndarray, shape (m, k), int64
        Node numbers of every cell, in VTK order (a positive Jacobian for a correctly oriented cell).
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

    def __post_init__(self) -> None:
        """Keep arrays in row-major order: for another order, kernels are compiled once more."""
        for name in ("points", "cells"):
            object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name)))

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
        """Return a mesh of checked arrays.

        Parameters
        ----------
        points : array_like, shape (n, d)
            Node positions, mm.
        cells : array_like, shape (m, k)
            Node numbers of every cell, in VTK order.
        cell_type : str
            ``"tetra"``, ``"tetra10"``, ``"hexahedron"``, ``"triangle"`` or ``"line"``.
        regions : array_like, shape (m,), optional
            Index into `region_names` for every cell; by default 0.
        region_names : sequence of str
            Name of every region.

        Raises
        ------
        InputError
            Wrong shapes, an unknown cell type, node numbers out of range, non-finite points, or regions without a name.
        """
        p = np.ascontiguousarray(points, dtype=np.float64)
        c = np.ascontiguousarray(cells, dtype=np.int64)
        if cell_type not in NODES_PER_CELL:
            raise InputError(f"cell_type {cell_type!r} is not known; use one of {sorted(NODES_PER_CELL)}")
        dimension = DIMENSION[cell_type]
        if p.ndim != 2 or p.shape[1] != dimension:
            raise InputError(f"points of a mesh of {cell_type} cells must have shape (n, {dimension}), not {p.shape}")
        if c.ndim != 2 or c.shape[1] != NODES_PER_CELL[cell_type] or len(c) == 0:
            raise InputError(f"{cell_type} cells must have shape (m, {NODES_PER_CELL[cell_type]}) with m > 0, not {c.shape}")
        require_finite("points", p)
        if c.min() < 0 or c.max() >= len(p):
            raise InputError(f"cells refer to nodes {c.min()} to {c.max()}, but the mesh has nodes 0 to {len(p) - 1}")
        r = np.zeros(len(c), dtype=np.int64) if regions is None else np.ascontiguousarray(regions, dtype=np.int64)
        require_shape("regions (one per cell)", r, (len(c),))
        if r.min() < 0 or r.max() >= len(region_names):
            raise InputError(f"cells use region {r.max()}, but only {len(region_names)} region names are given")
        return cls(p, c, cell_type, r, tuple(region_names))

    @property
    def n_points(self) -> int:
        """Number of nodes."""
        return len(self.points)

    @property
    def dimension(self) -> int:
        """Spatial dimension, 1, 2 or 3."""
        return int(self.points.shape[1])

    @property
    def n_cells(self) -> int:
        """Number of cells."""
        return len(self.cells)

    def moved(self, displacement: FloatArray) -> Mesh:
        """Return the deformed mesh: every node moved by `displacement`, shape (n, d), mm.

        Raises
        ------
        InputError
            `displacement` has another shape.
        """
        require_shape("displacement", displacement, self.points.shape)
        return replace(self, points=self.points + displacement)
