"""How far the cells of a body are crushed: the least principal stretch of any of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import FloatArray, IntArray

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
    def of(cls, points: FloatArray, cells: IntArray, parts: int) -> CrushedCells:
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

    def least_stretch(self, positions: FloatArray, part: int) -> tuple[float, FloatArray]:
        """Return the least principal stretch of the cells of a part, and where that cell is (3,), mm; infinite where there are none.

        It is negative in a cell that is inverted.

        Parameters
        ----------
        positions : ndarray, shape (n, 3)
            Of the nodes, mm.
        part : int
            Number of the part.
        """
        if not len(self.cells[part]):
            return np.inf, np.zeros(3)
        stretches = least_principal_stretches(self.inverse[part] @ _edges(positions, self.cells[part]))  # of transposed gradients
        least = int(stretches.argmin())
        return float(stretches[least]), positions[self.cells[part][least]].mean(axis=0)


def least_principal_stretches(gradient: FloatArray) -> FloatArray:
    """Return the least principal stretch (m,) of deformation gradients (m, 3, 3), negative where they invert.

    It is the smallest root of the characteristic polynomial of the Cauchy-Green tensor, in closed form :cite:p:`smith1961`.
    """
    a, b, c = np.ascontiguousarray(gradient.transpose(1, 2, 0))  # rows; operations on long arrays are fast
    xx, yy, zz, xy, xz, yz = (p[0] * q[0] + p[1] * q[1] + p[2] * q[2] for p, q in ((a, a), (b, b), (c, c), (a, b), (a, c), (b, c)))
    third = (xx + yy + zz) / 3.0
    dx, dy, dz = xx - third, yy - third, zz - third
    spread = np.sqrt((dx * dx + dy * dy + dz * dz + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0)
    half = 0.5 * (dx * (dy * dz - yz * yz) - xy * (xy * dz - yz * xz) + xz * (xy * yz - dy * xz))
    ratio = np.clip(half / np.maximum(spread, 1e-12 * third + 1e-90) ** 3, -1.0, 1.0)
    squared = third + 2.0 * spread * np.cos((np.arccos(ratio) + 2.0 * np.pi) / 3.0)
    volume = sum(a[i] * (b[j] * c[k] - b[k] * c[j]) for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)))
    return np.asarray(np.copysign(np.sqrt(np.maximum(squared, 0.0)), volume))


def _edges(points: FloatArray, cells: IntArray) -> FloatArray:
    """Return the three edges of tetrahedra from their first node (m, 3, 3), mm."""
    corners = points[cells]
    return np.asarray(corners[:, 1:] - corners[:, :1])
