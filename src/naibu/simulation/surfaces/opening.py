"""Opening of a cut in a surface under tension :cite:p:`hirai2008`: the springs of the surface come to rest."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import bsr_array, bsr_matrix, coo_array, csr_array, eye_array, kron
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from naibu.core.arrays import BoolArray, FloatArray, IntArray, require_positive, require_within
from naibu.core.errors import ConvergenceError, InputError
from naibu.mechanics.linear_algebra.direct import direct_solver
from naibu.meshing.cutting.surfaces.surface_result import SurfaceCut
from naibu.simulation.surfaces.springs import SurfaceSprings, surface_springs

ITERATIONS = 200
SMALLEST_SHARE = 1e-4
SINGULAR = 1e-7  # of the largest stiffness: added where nothing resists
BALANCED = 1e-5  # of the largest force of a spring at the start
LARGEST_TENSION = 0.9


def opened(
    cut: SurfaceCut,
    springs: SurfaceSprings,
    tension: float,
    held: ArrayLike,
    *,
    joined: ArrayLike | None = None,
    normals: ArrayLike | None = None,
    start: FloatArray | None = None,
) -> FloatArray:
    """Return where the points (n, 3), mm, of a cut surface under tension come to rest.

    Parameters
    ----------
    cut : SurfaceCut
        The surface.
    springs : SurfaceSprings
        Of its points and triangles.
    tension : float
        Strain by which all springs are stretched before the cut: their length at rest is shorter by this share.
    held : array_like of bool, shape (n,) or (n, 3)
        Points, or single coordinates of them, that do not move. There is no bending stiffness and no inside that resists.
    joined : array_like of int, shape (n,), optional
        Points of the same number move as one, as where the cut has not come yet.
    normals : array_like, shape (n, 3), optional
        Unit vectors along which points do not move, as where something firm lies beneath; zero where they may. All coordinates of a point
        are held then, or none.
    start : ndarray, shape (n, 3), optional
        Positions at which the search begins, mm; those of the cut by default.

    Raises
    ------
    InputError
        A tension outside 0 to 0.9, an array of another shape, or a piece with nothing held.
    ConvergenceError
        The springs do not come to balance.
    """
    require_within("tension", tension, 0.0, LARGEST_TENSION)
    points, n = cut.points, len(cut.points)
    fixed = _held(held, n)
    group = np.arange(n) if joined is None else np.unique(np.asarray(joined), return_inverse=True)[1].ravel()
    normal = np.zeros((n, 3)) if normals is None else np.asarray(normals, dtype=np.float64)
    if len(group) != n or normal.shape != (n, 3):
        raise InputError(f"joined and normals must have one row for each of the {n} points, not {len(group)} and {len(normal)}")
    if normal.any() and (fixed.any(axis=1) != fixed.all(axis=1)).any():
        raise InputError("held has points with some coordinates held; with normals, hold all coordinates of a point or none")
    number = _bodies(cut, group)
    loose = set(np.unique(number).tolist()) - set(np.unique(number[fixed.any(axis=1)]).tolist())
    if loose:
        raise InputError(f"held leaves piece {cut.piece[_triangle_of(cut, number == min(loose))]} free to drift; hold one of its points")
    first = np.unique(group, return_index=True)[1]
    free = np.ones((len(first), 3), dtype=bool)
    np.logical_and.at(free, group, ~fixed)
    begin = np.zeros((len(first), 3)) if start is None else (start - points)[first]
    return _at_rest(points, springs, tension, group, free, normal[first], begin)


def _held(held: ArrayLike, n: int) -> BoolArray:
    mask = np.asarray(held, dtype=bool)
    if mask.shape not in ((n,), (n, 3)):
        raise InputError(f"held must have shape {(n,)} or {(n, 3)}, not {mask.shape}")
    return np.broadcast_to(mask if mask.ndim == 2 else mask[:, None], (n, 3))


def _bodies(cut: SurfaceCut, group: IntArray) -> IntArray:
    """Return the number (n,) of what hangs together by triangles and joined points."""
    a, b, c = cut.triangles.T
    _, first, place = np.unique(group, return_index=True, return_inverse=True)
    rows, columns = np.concatenate([a, b, np.arange(len(group))]), np.concatenate([b, c, first[place]])
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(len(group), len(group)))
    return np.asarray(connected_components(graph, directed=False)[1])


def _triangle_of(cut: SurfaceCut, points: BoolArray) -> int:
    return int(np.flatnonzero(points[cut.triangles[:, 0]])[0])


def _at_rest(
    points: FloatArray,
    springs: SurfaceSprings,
    tension: float,
    group: IntArray,
    free: BoolArray,
    normal: FloatArray,
    start: FloatArray,
) -> FloatArray:
    """Minimise the energy of the springs over the displacement of groups of points, by Newton's method with line search."""
    moves: BoolArray = np.any(free[group], axis=1)
    moving = moves[springs.edges[:, 0]] | moves[springs.edges[:, 1]]
    (i, j), stiffness = springs.edges[moving].T, springs.stiffness[moving]
    rest, before = (1.0 - tension) * springs.length[moving], points[j] - points[i]
    m, e = len(free), int(moving.sum())
    basis = _directions(free, normal)
    rows = np.arange(e)
    difference = coo_array(
        (np.repeat([1.0, -1.0], e), (np.tile(rows, 2), np.concatenate([group[j], group[i]]))), shape=(e, m)
    ).tocsr()  # fmt: skip
    operator = (kron(difference, eye_array(3)) @ basis).tocsr()  # from unknowns to changes of the vectors along the springs
    largest = float((springs.stiffness * springs.length).max())
    balanced, unknown = BALANCED * max(largest * tension, 1e-300), basis.T @ start.ravel()

    def vectors(y: FloatArray) -> tuple[FloatArray, FloatArray]:
        gap = before + (operator @ y).reshape(-1, 3)
        return gap, np.maximum(np.linalg.norm(gap, axis=1), 1e-300)

    def energy(y: FloatArray) -> float:
        return 0.5 * float((stiffness * (vectors(y)[1] - rest) ** 2).sum())

    left = np.inf
    for _ in range(ITERATIONS):
        gap, now = vectors(unknown)
        gradient = operator.T @ ((stiffness * (now - rest) / now)[:, None] * gap).ravel()
        left = float(np.abs(gradient).max(initial=0.0))
        if left <= balanced:
            break
        matrix = _stiffness(operator, gap, now, stiffness, rest)
        solver = direct_solver(matrix, symmetric=True)  # a new one: entries that vanish are not stored, so that the pattern changes
        step = -solver.factorize(matrix).solve(gradient)
        share, least = 1.0, energy(unknown)
        while energy(unknown + share * step) > least + 1e-4 * share * float(gradient @ step) and share > SMALLEST_SHARE:
            share *= 0.5
        unknown = unknown + share * step
    if left > 100.0 * balanced:
        raise ConvergenceError(f"the springs are out of balance by {left / largest:.2g} of their largest force; hold more points")
    return np.asarray(points + (basis @ unknown).reshape(-1, 3)[group])


def _directions(free: BoolArray, normal: FloatArray) -> csr_array:
    """Return the matrix (3 m, r) from unknowns to displacements: the free coordinates of each point, or its two tangents."""
    sliding = np.flatnonzero(np.all(free, axis=1) & np.any(normal, axis=1))
    straight = free.copy()
    straight[sliding] = False
    node, axis = np.nonzero(straight)
    n = normal[sliding]
    helper = np.eye(3)[np.abs(n).argmin(axis=1)]
    first = np.cross(n, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    tangents = np.stack([first, np.cross(n, first)], axis=1)
    rows = np.concatenate([3 * node + axis, (3 * sliding[:, None, None] + np.arange(3) + np.zeros((1, 2, 1), dtype=np.int64)).ravel()])
    columns = np.concatenate([np.arange(len(node)), len(node) + np.repeat(np.arange(2 * len(sliding)), 3)])
    values = np.concatenate([np.ones(len(node)), tangents.ravel()])
    return coo_array((values, (rows, columns)), shape=(3 * len(free), len(node) + 2 * len(sliding))).tocsr()


def _stiffness(operator: csr_array, gap: FloatArray, now: FloatArray, stiffness: FloatArray, rest: FloatArray) -> bsr_matrix:
    """Return the second derivatives of the energy, without what makes springs under compression buckle."""
    along = gap / now[:, None]
    across = np.maximum(1.0 - rest / now, 0.0)
    blocks = (1.0 - across)[:, None, None] * along[:, :, None] * along[:, None, :] + across[:, None, None] * np.eye(3)
    e = len(now)
    matrix = operator.T @ (bsr_array((stiffness[:, None, None] * blocks, np.arange(e), np.arange(e + 1))) @ operator)
    firm = SINGULAR * float(matrix.diagonal().max(initial=1e-300))
    whole = bsr_matrix((matrix + firm * eye_array(matrix.shape[0])).tocsr(), blocksize=(1, 1))
    whole.sort_indices()
    return whole


def opening(cut: SurfaceCut, tension: float, *, free_mm: float | None = None, frames: int = 24) -> Iterator[FloatArray]:
    """Yield the displacement (n, 3), mm, of a surface under tension while it is cut: first with the cut closed, then behind the tool.

    The surface slides on something firm beneath, along its planes of tangency. Points far from the cut, and on the rim of an open
    surface, stay. A piece that falls out contracts about its centroid to the lengths of its springs at rest.

    Parameters
    ----------
    cut : SurfaceCut
        The surface.
    tension : float
        See `opened`.
    free_mm : float, optional
        Distance from the cut beyond which points stay, mm; as far as the cut is long by default.
    frames : int
        Number of states after the first.

    Raises
    ------
    InputError
        A value out of range.
    ConvergenceError
        See `opened`.
    """
    require_within("tension", tension, 0.0, LARGEST_TENSION)
    far = max(cut.length_mm, 1e-9) if free_mm is None else require_positive("free_mm", free_mm, "mm")
    springs = surface_springs(cut.points, cut.triangles, membrane_modulus=1.0, area_density=1.0)
    held, normals = _resting(cut, far), cut.normals
    copies = np.flatnonzero(cut.source != np.arange(len(cut.points)))  # in the order in which the cut made them
    now = cut.points
    for k in range(frames + 1):
        joined = np.arange(len(cut.points))
        closed = copies[round(k / frames * len(copies)) :]
        joined[closed] = cut.source[closed]
        while (joined != joined[joined]).any():
            joined = joined[joined]
        body = _bodies(cut, joined)
        loose = ~np.isin(body, body[held])
        now = opened(cut, springs, tension, held | loose, joined=joined, normals=normals, start=now)
        for piece in np.unique(body[loose]):
            own = np.flatnonzero(body == piece)
            centre = np.average(cut.points[own], axis=0, weights=springs.mass[own])
            now[own] = centre + (1.0 - tension) * (cut.points[own] - centre)
        yield now - cut.points


def _resting(cut: SurfaceCut, far: float) -> BoolArray:
    """Points (n,) of the rim, and farther from the cut than a distance."""
    half = np.concatenate([cut.triangles[:, [0, 1]], cut.triangles[:, [1, 2]], cut.triangles[:, [2, 0]]])
    n = len(cut.points)
    keys, back = half[:, 0] * n + half[:, 1], half[:, 1] * n + half[:, 0]
    rim = half[~np.isin(keys, back) & ~np.isin(keys, cut.lips[:, 0] * n + cut.lips[:, 1])]
    held = np.zeros(n, dtype=bool)
    held[rim.ravel()] = True
    if len(cut.cut_edges):
        held |= cKDTree(cut.cut_edges.reshape(-1, 3)).query(cut.points)[0] > far
    return held
