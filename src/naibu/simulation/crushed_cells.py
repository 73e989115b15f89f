"""How far the cells of a body are crushed: the least principal stretch of any of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.simulation._stretch_kernels import least_of_cells

SLIVER = 0.2  # of the altitude of a regular tetrahedron of the same volume: flatter cells tell nothing of the body around them
REGULAR = (2.0 / 3.0) ** 0.5 * 72.0 ** (1.0 / 6.0)  # altitude of a regular tetrahedron over the cube root of its volume


@dataclass(frozen=True, slots=True, eq=False)
class CrushedCells:
    """The tetrahedra of a body, in parts that are examined one at a time.

    Attributes
    ----------
    cells : tuple of ndarray, shape (m, 4), int64
        Nodes of the tetrahedra of each part.
    inverse : tuple of ndarray, shape (m, 3, 3)
        Inverses of the matrices of their edges at rest, 1/mm.
    """

    cells: tuple[IntArray, ...]
    inverse: tuple[FloatArray, ...]

    @classmethod
    def of(cls, points: FloatArray, cells: IntArray, parts: int = 1) -> CrushedCells:
        """Return the cells (m, 4) of a body with nodes (n, 3) at rest, mm; slivers, as cuts leave them, are left out."""
        edges = _edges(points, cells)
        volume = np.linalg.det(edges) / 6.0
        kept = volume > 0.0
        edges, cells, volume = edges[kept], cells[kept], volume[kept]
        inverse = np.linalg.inv(edges)
        gradients = np.concatenate([inverse, inverse.sum(axis=2, keepdims=True)], axis=2)  # of the shape functions, one over each altitude
        flat = 1.0 / np.linalg.norm(gradients, axis=1).max(axis=1) < SLIVER * REGULAR * np.cbrt(volume)
        chosen, own = cells[~flat], inverse[~flat]
        return cls(tuple(chosen[k::parts].copy() for k in range(parts)), tuple(own[k::parts].copy() for k in range(parts)))

    def least_stretch(self, positions: FloatArray, part: int, watched: float = np.inf) -> tuple[float, FloatArray]:
        """Return the least principal stretch of the cells of a part, and where that cell is (3,), mm; of inverted cells it is negative.

        Parameters
        ----------
        positions : ndarray, shape (n, 3)
            Of the nodes, mm.
        part : int
            Number of the part.
        watched : float
            Stretches from here on do not count: it is returned where there are no others, with the origin.
        """
        place = np.zeros(3)
        return float(least_of_cells(positions, self.cells[part], self.inverse[part], watched, place)), place


def _edges(points: FloatArray, cells: IntArray) -> FloatArray:
    """Return the three edges of tetrahedra from their first node (m, 3, 3), mm."""
    corners = points[cells]
    return np.asarray(corners[:, 1:] - corners[:, :1])
