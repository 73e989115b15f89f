"""Replacement of leaves of a bisection forest by other cells in their place, as a cut makes them, at the cost of what changes."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import IntArray, as_points
from naibu.core.errors import InputError
from naibu.meshing.refinement import _forest_kernels as kernels
from naibu.meshing.refinement._forest_kernels import CHILD, FLIPPED, FREE, LEAF, LEVEL, MARK, PARENT, PLACE, REGION, TAG
from naibu.meshing.refinement.forest import BisectionForest
from naibu.meshing.refinement.root_cells import determinants
from naibu.meshing.refinement.tagging import tagged


def added_nodes(forest: BisectionForest, points: ArrayLike) -> IntArray:
    """Add vertices (k, d), mm, for `replaced_cells`, and return their numbers (k,); each must get a cell before anything else is asked for.

    Raises
    ------
    InputError
        Positions of another shape, or that are not finite.
    """
    given = as_points("points", points, forest.dimension)
    forest.reserve(len(given))
    _, places, nodes, _, _, counters = forest.arrays
    first = int(counters[kernels.NODES])
    numbers = np.arange(first, first + len(given))
    places[numbers] = given
    nodes[numbers] = (-1, -1, 0, -1)
    counters[kernels.NODES] += len(given)
    counters[kernels.COUNT] += len(given)
    return numbers


def replaced_cells(
    forest: BisectionForest,
    cells: ArrayLike,
    simplices: ArrayLike,
    *,
    regions: ArrayLike | None = None,
    levels: ArrayLike = 0,
    marker: int = 0,
) -> IntArray:
    """Replace leaves by other cells that fill the same part of the body, and return the numbers (k,) of these.

    New cells are joined to each other, and to the cells around those that were removed, wherever they share a face; faces that are
    shared with nothing become boundary. So vertices that are doubled (`added_nodes`) open a crack. The parents of removed leaves are not
    restored any more, and new cells are roots.

    Parameters
    ----------
    forest : BisectionForest
        Changed.
    cells : array_like, shape (c,)
        Leaves to remove.
    simplices : array_like, shape (k, d + 1)
        Vertices of the new cells, positively oriented.
    regions : array_like, shape (k,), optional
        Their regions; by default that of the removed leaf of the same shape, or of the first one.
    levels : array_like
        Levels of cells of other shapes than those removed, one number or one a cell, from which bisections count on.
    marker : int
        Marker of new boundary faces; faces that were boundary before keep theirs, also where vertices were doubled.

    Raises
    ------
    InputError
        Numbers that are no leaves, a face of three cells, cells without positive volume, or a vertex that would belong to no cell; the
        mesh is then as it was.

    Notes
    -----
    The cost is that of the cells replaced. Cells of the shape of a removed one, some of whose vertices were doubled, are bisected as that
    one would have been. Others begin with their longest edge, which may not suit the cells around them: where `BisectionForest.refine`
    then finds that cells wait for each other, it refuses and leaves the mesh as it was.
    """
    old = np.unique(np.asarray(cells, dtype=np.int64))
    new = np.asarray(simplices, dtype=np.int64).reshape(-1, forest.dimension + 1)
    _require_leaves(forest, old)
    volumes = determinants(forest.points, new)
    if not (volumes > 0.0).all():
        bad = int(np.argmin(volumes))
        raise InputError(f"simplices[{bad}] has the volume {volumes[bad]:g}; give its vertices in positive order")
    before = _places_before(forest, old, new)
    inner, outer, kept = _matched(forest, old, new, before)
    _require_nodes(forest, old, new)
    forest.reserve(len(new))
    table, _, nodes, _, leaves, counters = forest.arrays
    first = int(counters[kernels.ROWS])
    numbers = np.arange(first, first + len(new))
    counters[kernels.ROWS] += len(new)
    order, tags, origin = _tagged(forest, old, new, before)
    place_of = np.argmax(order[:, None, :] == new[:, :, None], axis=2)  # where each given vertex stands now
    table[numbers] = 0
    table[numbers, : new.shape[1]], table[numbers, PARENT], table[numbers, CHILD], table[numbers, MARK] = order, -1, LEAF, 0
    table[numbers, TAG] = tags
    table[numbers, LEVEL] = np.where(origin >= 0, forest.levels[origin], levels)
    table[numbers, REGION] = forest.regions[np.where(origin >= 0, origin, old[0])] if regions is None else np.asarray(regions)
    table[numbers, FLIPPED] = determinants(forest.points, order) < 0.0
    table[numbers, 4 : 4 + new.shape[1]] = -1 - marker
    for (one, i), (two, j) in inner:
        table[numbers[one], 4 + place_of[one, i]], table[numbers[two], 4 + place_of[two, j]] = numbers[two], numbers[one]
    for (one, i), (cell, place) in outer:
        table[numbers[one], 4 + place_of[one, i]], table[cell, 4 + place] = cell, numbers[one]
    for (one, i), value in kept:
        table[numbers[one], 4 + place_of[one, i]] = value
    _open(forest, old, marker, {(cell, place) for _, (cell, place) in outer})
    for t in old:
        gap, last = int(table[t, PLACE]), int(counters[kernels.LEAVES]) - 1
        leaves[gap] = leaves[last]
        table[leaves[gap], PLACE] = gap
        counters[kernels.LEAVES] = last
        table[t, CHILD], table[t, PLACE] = FREE, -1
    count = int(counters[kernels.LEAVES])
    leaves[count : count + len(new)], table[numbers, PLACE] = numbers, np.arange(count, count + len(new))
    counters[kernels.LEAVES] += len(new)
    nodes[order.ravel(), 3] = np.repeat(numbers, new.shape[1])
    return numbers


Face = tuple[int, int]  # a cell and the place of the vertex opposite to the face


def _require_leaves(forest: BisectionForest, cells: IntArray) -> None:
    if not len(cells) or cells[0] < 0 or cells[-1] >= forest.cell_rows or (forest.children[cells] != LEAF).any():
        raise InputError(f"cells must be numbers of leaves, at least one, not {cells[:8].tolist()}")


def _require_nodes(forest: BisectionForest, old: IntArray, new: IntArray) -> None:
    """Check that vertices of removed cells belong to new ones, or to cells that stay, and let them know one that does."""
    gone, lost = set(old.tolist()), np.setdiff1d(forest.simplices[old], new)
    found = {}
    for v in lost.tolist():
        staying = [t for t in forest.around_node(v).tolist() if t not in gone]
        if not staying:
            raise InputError(f"vertex {v} would belong to no cell; use it in simplices")
        found[v] = staying[0]
    for v, t in found.items():
        forest.arrays[2][v, 3] = t


def _tagged(forest: BisectionForest, old: IntArray, new: IntArray, before: dict[int, int]) -> tuple[IntArray, IntArray, IntArray]:
    """Return the vertices of new cells in the order of bisection, their tags, and the removed leaf of the same shape, or -1."""
    order, tags = tagged(forest.points, new)
    found, origin = tags.astype(np.int64), np.full(len(new), -1)
    known = {tuple(sorted(row)): t for t, row in zip(old.tolist(), forest.simplices[old].tolist(), strict=True)}
    for c, row in enumerate(new.tolist()):
        now = {before.get(v, v): v for v in row}
        t = known.get(tuple(sorted(now)))
        if t is not None:
            origin[c], found[c] = t, forest.arrays[0][t, TAG]
            order[c] = [now[v] for v in forest.simplices[t].tolist()]
    return order, found, origin


def _matched(
    forest: BisectionForest, old: IntArray, new: IntArray, before: dict[int, int]
) -> tuple[list[tuple[Face, Face]], list[tuple[Face, Face]], list[tuple[Face, int]]]:
    """Return the pairs of faces of new cells, those of new and staying cells, and the faces on the old boundary with its values."""
    k, gone = new.shape[1], set(old.tolist())
    around: dict[tuple[int, ...], Face] = {}
    boundary: dict[tuple[int, ...], int] = {}
    for t in old.tolist():
        corners, across = forest.simplices[t].tolist(), forest.neighbours[t].tolist()
        for i, u in enumerate(across):
            key = tuple(sorted(corners[:i] + corners[i + 1 :]))
            if u < 0:
                boundary[key] = u
            elif u not in gone:
                around[key] = (u, forest.neighbours[u].tolist().index(t))
    open_faces: dict[tuple[int, ...], Face] = {}
    inner, outer, kept, done = [], [], [], set()
    for c, corners in enumerate(new.tolist()):
        for i in range(k):
            key = tuple(sorted(corners[:i] + corners[i + 1 :]))
            if key in done:
                raise InputError(f"three cells would share the face with nodes {list(key)}; at most two can")
            if key in open_faces:
                inner.append((open_faces.pop(key), (c, i)))
                done.add(key)
            elif key in around:
                outer.append(((c, i), around[key]))
                done.add(key)
            else:
                open_faces[key] = (c, i)
    for key, face in open_faces.items():
        value = boundary.get(tuple(sorted(before.get(v, v) for v in key)))
        if value is not None:
            kept.append((face, value))
    return inner, outer, kept


def _places_before(forest: BisectionForest, old: IntArray, new: IntArray) -> dict[int, int]:
    """Return the vertices of removed cells that others, only of new cells, stand at the place of."""
    known = np.unique(forest.simplices[old])
    at = {tuple(p): v for v, p in zip(known.tolist(), forest.points[known].tolist(), strict=True)}
    doubled = np.setdiff1d(new, known)
    pairs = ((v, at.get(tuple(p))) for v, p in zip(doubled.tolist(), forest.points[doubled].tolist(), strict=True))
    return {v: w for v, w in pairs if w is not None}


def _open(forest: BisectionForest, old: IntArray, marker: int, joined: set[Face]) -> None:
    """Make the faces of staying cells that lead to removed ones boundary, but for those that are joined to new ones."""
    gone = set(old.tolist())
    for t in old.tolist():
        for u in forest.neighbours[t].tolist():
            if u >= 0 and u not in gone:
                for place, across in enumerate(forest.neighbours[u].tolist()):
                    if across == t and (u, place) not in joined:
                        forest.neighbours[u, place] = -1 - marker
