"""O-grids: hexahedral meshes of round solids, a core grid wrapped in shells without degenerate cells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array, diags_array

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.mesh import Mesh
from naibu.meshing.element_conversion import HEXAHEDRON_EDGES
from naibu.meshing.quality import scaled_jacobians
from naibu.meshing.surface import faces_of_cells

# Sweeps without improvement of the worst cell after which smoothing stops.
_PATIENCE = 8


@dataclass(frozen=True, slots=True)
class WrappedGrid:
    """Topology of a core grid with shells around some of its sides.

    Attributes
    ----------
    cells : ndarray, shape (m, 8), int64
        Core cells, then shell by shell.
    owner : ndarray, shape (m,), int64
        The core cell beneath every cell.
    base : ndarray, shape (n,), int64
        The core node beneath every node.
    shell : ndarray, shape (n,), int64
        Number of the shell of every node; 0 in the core.
    """

    cells: IntArray
    owner: IntArray
    base: IntArray
    shell: IntArray


def wrapped(core: IntArray, bare: BoolArray, n_shells: int) -> WrappedGrid:
    """Extrude the boundary of a hexahedral core by `n_shells` layers of cells, except the faces all of whose nodes are `bare`.

    Parameters
    ----------
    core : ndarray, shape (m, 8), int64
        Cells of the core.
    bare : ndarray, shape (s, n), bool
        One row for each side without shells: the core nodes on it.
    n_shells : int
        Number of shells.
    """
    faces, owners = faces_of_cells(core, "hexahedron")
    covered = ~bare[:, faces].all(axis=2).any(axis=0)
    faces, owners = faces[covered], owners[covered]
    outer, local = np.unique(faces, return_inverse=True)
    local = local.reshape(faces.shape)
    n_core = bare.shape[1]
    numbers = np.concatenate([outer[None], n_core + np.arange(n_shells * len(outer)).reshape(n_shells, -1)])
    # An outward face is the bottom of the cell on top of it.
    shells = [np.concatenate([numbers[k][local], numbers[k + 1][local]], axis=1) for k in range(n_shells)]
    return WrappedGrid(
        np.concatenate([core, *shells]),
        np.concatenate([np.arange(len(core)), np.tile(owners, n_shells)]),
        np.concatenate([np.arange(n_core), np.tile(outer, n_shells)]),
        np.concatenate([np.zeros(n_core, dtype=np.int64), np.repeat(np.arange(1, n_shells + 1), len(outer))]),
    )


def round_positions(cube: FloatArray, shell: IntArray, core: float, bulge: float) -> FloatArray:
    """Return the positions of the nodes of a wrapped grid in the unit ball (or disc).

    Parameters
    ----------
    cube : ndarray, shape (n, d)
        Position in [-1, 1]^d of the core node beneath every node.
    shell : ndarray, shape (n,)
        Shell of every node, 0 in the core; the last shell is the sphere.
    core : float
        Half width of the core.
    bulge : float
        0 leaves the core a cube, 1 makes it a ball.
    """
    reach = np.abs(cube).max(axis=1, keepdims=True)
    # Equal angles rather than equal steps on the cube keep the cells of a face alike in size.
    direction = np.tan(np.pi / 4 * np.divide(cube, reach, out=np.zeros_like(cube), where=reach > 0))
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    direction = np.divide(direction, length, out=np.zeros_like(cube), where=length > 0)
    mix = bulge * reach
    inner = core * ((1 - mix) * cube + mix * reach * direction)
    t = (shell / shell.max())[:, None]
    return np.asarray((1 - t) * inner + t * direction, dtype=np.float64)


def smoothed(points: FloatArray, cells: IntArray, free: BoolArray, *, sweeps: int = 60) -> FloatArray:
    """Laplacian smoothing: move nodes towards the mean of their neighbours while the worst cell improves.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        Node positions, mm.
    cells : ndarray, shape (m, 8)
        Hexahedra.
    free : ndarray, shape (n, 3), bool
        Coordinates that may change.
    sweeps : int
        Maximum number of sweeps.

    Returns
    -------
    ndarray, shape (n, 3)
        The best positions found; their smallest scaled Jacobian is not below that of `points`.
    """
    mean = _neighbour_mean(cells, len(points))
    best, best_quality, trial, last = points, _worst(points, cells), points, 0
    for sweep in range(sweeps):
        trial = np.where(free, 0.5 * trial + 0.5 * (mean @ trial), points)
        quality = _worst(trial, cells)
        if quality > best_quality:
            best, best_quality, last = trial, quality, sweep
        if sweep > last + _PATIENCE:
            break
    return best


def _worst(points: FloatArray, cells: IntArray) -> float:
    """Return the smallest scaled Jacobian."""
    return float(scaled_jacobians(Mesh(points, cells, "hexahedron", np.zeros(len(cells), dtype=np.int64), ("body",))).min())


def _neighbour_mean(cells: IntArray, n: int) -> csr_array:
    """Return the matrix (n, n) that averages the neighbours along edges."""
    ends = cells[:, HEXAHEDRON_EDGES].reshape(-1, 2)
    ones = np.ones(2 * len(ends))
    links = coo_array((ones, (np.concatenate([ends[:, 0], ends[:, 1]]), np.concatenate([ends[:, 1], ends[:, 0]]))), shape=(n, n)).tocsr()
    links.data[:] = 1.0
    return csr_array(diags_array(1 / links.sum(axis=1)) @ links)
