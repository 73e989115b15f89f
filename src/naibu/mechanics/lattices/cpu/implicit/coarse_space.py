"""Coarse space of a two-level preconditioner for the implicit solver of a lattice :cite:p:`toselli2005`.

Neighbours pass a residual on slowly; coarse functions spread it over the lattice at once.
Hat functions of a grid over the lattice at rest, linear in x, y and z, take the residual of the nodes to few coarse nodes, where a small
matrix is inverted, and its solution back. The matrix is that of the lattice at rest, in which components that are constrained count as if
their nodes hung on springs as stiff as all their elements. Where steps take many iterations, what contacts add to the matrix of the step is
added as coarse functions see it (Galerkin's way): a body that lies on a floor is held by nothing else, and its rigid motion would be the
slowest of all to settle. It is only a preconditioner: where the lattice has turned, or is constrained or touched
elsewhere than it knows of, the solver takes more iterations, nothing else. On large lattices a grid between the nodes and the coarse one is
added, of which only the diagonal is used. Positions are all that is needed, so that every mask, octree or mesh will do.
"""

from __future__ import annotations

import numpy as np

from naibu._numba.intrinsics.packed_tuples import packed
from naibu._numba.intrinsics.simd import WIDTH, aligned
from naibu.core.arrays import AnyFloatArray, FloatArray, IntArray
from naibu.mechanics.lattices.cpu.implicit._coarse_kernels import NODES, PLAIN, PRICE, assemble, build, no_contacts
from naibu.mechanics.lattices.cpu.scratch import KernelTuple
from naibu.mechanics.lattices.model.hat_functions import corner_weights
from naibu.mechanics.lattices.model.lattice import Lattice

_LEAST = 3.5  # spacings between coarse nodes; closer ones take more work than iterations
_FAR = 5.5  # spacings between coarse nodes from which a grid between pays
_BETWEEN = 2.7  # its spacings
_MOST = 378  # unknowns of the small matrix
_FRACTION = 2.5  # numbers of the small matrix for each element, at most: it takes about a fifth of the time of their multiplication
_SHIFT = 1e-5  # of the diagonal, added so that the inverse is positive definite in single precision, whatever the masses are
_WORTH = 0.05  # mean fraction of the mass in the diagonal above which the diagonal does alone
_FEW = 7_000  # elements below which it does as well
_LANE = 3  # what eight values at a time cost beside one
_PRICE = 2  # how many iterations' multiplications of an element a number of the small matrix's cube is worth, to rebuild it at leisure


def coarse_space(lattice: Lattice, stiff: FloatArray, diagonal: FloatArray, smoother: AnyFloatArray, pad: int, parts: int) -> KernelTuple:
    """Return the arrays of the coarse correction for the kernels; they are empty where it does not pay.

    Parameters
    ----------
    lattice : Lattice
        Masses and elements.
    stiff : ndarray, shape (m,)
        h^2 a of every element, kg.
    diagonal : ndarray, shape (n,)
        Of the matrix of the step, kg.
    smoother : ndarray, shape (pad,)
        Its inverse.
    pad, parts : int
        Places of an array of nodes, and how many threads sum up apart.

    Returns
    -------
    tuple
        Steps from the nodes to the nodes of a grid: lanes from nodes to columns of nodes along z, lanes from these to lines along x, and
        shares from lines to nodes. Their vectors: columns of every part, what goes back to them, lines, and right sides and values of
        nodes. Steps and vectors from that grid to a coarser one, if there are two. Matrix without constrained components (3, n, 3, n);
        inverse diagonal of the finer grid three times, its diagonal; inverse of the matrix three times: without constrained components,
        with those last constrained, and with contacts too. Nodes (n, 8) and weights of every node on the coarser grid and on the finer one.
        Memory: constrained nodes and directions, the numbers of `lattice_coarse_kernels`, and how much contacts add at the coarse nodes
        (2, n), to the inverse and at present.
    """
    if lattice.n_elements < _FEW or lattice.node_mass.sum() > _WORTH * diagonal.sum():
        return no_coarse_space()
    cells = _cells(lattice)
    between = _between(lattice, cells)
    corner, weight, used = _hats(lattice.points, cells)
    fine = _hats(lattice.points, between * cells)
    i, j = lattice.elements.T
    directions = lattice.points[j] - lattice.points[i]
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    wide, mass = -(-len(used) // WIDTH) * WIDTH, lattice.node_mass + _SHIFT * diagonal
    base, fine_diagonal = np.zeros((3, wide, 3, wide)), np.zeros((3, len(fine[2]) if between > 1 else 0))
    assemble(lattice.elements, directions, stiff, corner, weight, base, np.zeros((0, 0)))
    _add_masses(base, mass, corner, weight, len(used))
    low, extent = lattice.points.min(axis=0), np.ptp(lattice.points, axis=0)
    place = (lattice.points - low) * np.divide(between * cells, extent, out=np.zeros(3), where=extent > 0.0)
    further = _steps(np.zeros((0, 3)), cells, used, 0, 1)
    if between > 1:
        assemble(lattice.elements, directions, stiff, *fine[:2], np.zeros((0, 0, 0, 0)), fine_diagonal)
        fine_diagonal += np.bincount(fine[0].ravel(), (fine[1] ** 2 * mass[:, None]).ravel(), minlength=len(fine[2]))
        shape = between * cells + 1
        nodes = np.stack([fine[2] % shape[0], fine[2] // shape[0] % shape[1], fine[2] // (shape[0] * shape[1])], axis=1)
        further = _steps(nodes / between, cells, used, -(-len(nodes) // WIDTH) * WIDTH, 1)
    small = (
        base,
        aligned((3, -(-fine_diagonal.shape[1] // WIDTH) * WIDTH), np.float32),
        fine_diagonal,
        aligned((3, 3 * wide, 3 * wide), np.float32),
    )
    state = np.zeros(6, dtype=np.int64)
    state[NODES], state[PRICE] = -1, _PRICE * wide**3 // lattice.n_elements
    memory = (np.zeros(3 * lattice.n_nodes, np.int64), np.zeros((3 * lattice.n_nodes, 3)), state, np.zeros((2, wide)))
    coarse = (*_steps(place, between * cells, fine[2], pad, parts), further, small, (corner, weight, *fine[:2]), memory)
    free = packed(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int64))
    build(packed(*coarse), smoother, free, no_contacts(), PLAIN)
    return coarse


def _cells(lattice: Lattice) -> IntArray:
    """Return how many cells the coarse grid has along each axis: as many as its small matrix and the spacing of the nodes allow."""
    extent = np.ptp(lattice.points, axis=0)
    most = min(_MOST, np.sqrt(_FRACTION * lattice.n_elements))
    cells = np.ones(3, dtype=np.int64)
    for k in range(2, int(extent.max() / (_LEAST * lattice.spacing_mm)) + 1):
        more = np.maximum(np.rint(k * extent / extent.max()), 1).astype(np.int64)
        if 3 * len(_hats(lattice.points, more)[2]) > most:
            break
        cells = more
    return cells


def _between(lattice: Lattice, cells: IntArray) -> int:
    """Return into how many parts the finer grid divides the coarse spacing; one where there is none."""
    apart = float(np.ptp(lattice.points, axis=0).max() / cells.max() / lattice.spacing_mm)
    return max(round(apart / _BETWEEN), 1) if apart > _FAR else 1


def _hats(points: FloatArray, cells: IntArray) -> tuple[IntArray, FloatArray, IntArray]:
    """Return the hat functions of points (n, 8) on a grid over all of them, without gaps, their weights, and the grid's numbers."""
    low, extent = points.min(axis=0), np.ptp(points, axis=0)
    place = (points - low) * np.divide(cells, extent, out=np.zeros(3), where=extent > 0.0)
    corner, weight = corner_weights(place, cells)
    used, number = np.unique(corner[weight > 0.0], return_inverse=True)
    nodes = np.zeros(corner.shape, dtype=np.int64)
    nodes[weight > 0.0] = number.ravel()
    return nodes, weight, used


def _add_masses(dense: FloatArray, mass: FloatArray, corner: IntArray, weight: FloatArray, count: int) -> None:
    """Add the nodal masses to the coarse matrix, and ones where it has no node."""
    size = dense.shape[1]
    pairs = (corner[:, :, None] * size + corner[:, None, :]).ravel()
    values = (mass[:, None, None] * weight[:, :, None] * weight[:, None, :]).ravel()
    scalar = np.bincount(pairs, values, minlength=size**2).reshape(size, size)
    for axis in range(3):
        dense[axis, :, axis, :] += scalar
        dense[axis, range(count, size), axis, range(count, size)] = 1.0


def _steps(place: FloatArray, cells: IntArray, used: IntArray, pad: int, parts: int) -> KernelTuple:
    """Return the three steps from places (n, 3), in cells, to the nodes of a grid, along z, y and x, and their vectors.

    What follows one another along x does so in columns and lines as well, so that eight are taken at a time; where there are no such rows,
    it is quicker to go to the nodes one by one.
    """
    count = len(place)
    place = np.where(np.abs(place - np.rint(place)) < 1e-6, np.rint(place), place)
    along_z = _reduced(place, 2, cells)
    along_y = _reduced(along_z[3], 1, cells)
    columns, rows = _lanes(*along_z[:3], 0, pad), _lanes(*along_y[:3], WIDTH, len(along_z[3]) + WIDTH)
    counts, last = (len(along_z[3]), len(along_y[3])), along_y[3]
    if _LANE * (len(columns[1]) + len(rows[1])) + 2 * len(last) > _LANE * count // 4 + 8 * count:
        same, ones = np.arange(count), np.ones(count)
        columns, rows = _lanes(same, same, ones, 0, pad), _lanes(same, same, ones, WIDTH, count + WIDTH)
        counts, last = (count, count), place
    corner, weight = corner_weights(last, cells)
    most = np.argsort(-weight, axis=1, kind="stable")[:, : int((weight > 0.0).sum(axis=1).max(initial=1))]
    corner, weight = np.take_along_axis(corner, most, axis=1), np.take_along_axis(weight, most, axis=1)
    node = np.minimum(np.searchsorted(used, corner), len(used) - 1)
    fractions = (node.astype(np.uint64), np.where(used[node] == corner, weight, 0.0).astype(np.float32), WIDTH)
    n_columns, n_lines = (WIDTH * (-(-k // WIDTH) + 2) for k in counts)
    nodes = (3, -(-len(used) // WIDTH) * WIDTH)
    shapes = ((parts, 3, n_columns), (3, n_columns), (3, n_lines), nodes, nodes)
    return (columns, rows, fractions), tuple(aligned(shape, np.float32) for shape in shapes)


def _reduced(place: FloatArray, axis: int, cells: IntArray) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
    """Return how values at places (n, 3), in cells, go to the planes of the grid across an axis: sources, targets, weights, and new places.

    Targets are sorted by their planes, and then by their first source, so that what follows one another does so still.
    """
    nearest = np.rint(place[:, axis])
    exact = np.where(np.abs(place[:, axis] - nearest) < 1e-6, nearest, place[:, axis])
    low = np.minimum(exact.astype(np.int64), cells[axis] - 1)
    source = np.tile(np.arange(len(place)), 2)
    weight = np.concatenate([low + 1 - exact, exact - low])
    reached = place[source]
    reached[:, axis] = np.concatenate([low, low + 1])
    some = weight > 0.0
    source, weight, reached = source[some], weight[some], reached[some]
    grid = np.rint(1e4 * reached).astype(np.int64)
    _, start, number = np.unique(grid[:, 0] + (grid[:, 1] + (grid[:, 2] << 21) << 21), return_index=True, return_inverse=True)
    first = np.full(len(start), len(place))
    np.minimum.at(first, number.ravel(), source)
    planes = [grid[start, a] for a in range(axis, 3)]
    order = np.lexsort((first, *planes))
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    return source, rank[number.ravel()], weight, reached[start[order]]


def _lanes(source: IntArray, target: IntArray, weight: FloatArray, shift: int, places: int) -> KernelTuple:
    """Return targets and weights of every eight sources, as `gather` reads them; targets stand eight places further on."""
    apart = len(source) + len(target) + 4 * WIDTH
    key = (source + shift) // WIDTH * (2 * apart) + (target + WIDTH) - (source + shift) + apart
    pair, place = np.unique(key, return_inverse=True)
    wide = np.zeros((len(pair), WIDTH), dtype=np.float32)
    wide[place.ravel(), (source + shift) % WIDTH] = weight
    rows = wide.view([("", wide.dtype)] * WIDTH).ravel()
    _, chosen, number = np.unique(rows, return_index=True, return_inverse=True)
    tile, gap = np.divmod(pair, 2 * apart)
    starts = np.searchsorted(tile, np.arange(-(-places // WIDTH) + 1))
    table = aligned((WIDTH * len(chosen),), np.float32)
    table[:] = wide[chosen].ravel()
    return starts, WIDTH * tile + gap - apart, WIDTH * number.ravel(), table


def no_coarse_space() -> KernelTuple:
    """Return the arrays of no coarse correction."""
    steps, vectors = _steps(np.zeros((0, 3)), np.ones(3, dtype=np.int64), np.zeros(1, dtype=np.int64), 0, 1)
    single, whole, square = np.float32, np.zeros(0, np.int64), np.zeros((0, 8), np.int64)
    small = (np.zeros((3, 0, 3, 0)), np.zeros((3, 0), single), np.zeros((3, 0)), np.zeros((3, 0, 0), single))
    weights = (square, square + 0.0, square, square + 0.0)
    return steps, vectors, (steps, vectors), small, weights, (whole, np.zeros((0, 3)), whole, np.zeros((2, 0)))
