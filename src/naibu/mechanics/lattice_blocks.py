"""Elements in blocks of eight whose masses stand in a row, so that vectors of numbers can be loaded as they lie (see `simd`)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from naibu.mechanics.lattice import Array, Integers, Lattice, LatticeParameters
from naibu.mechanics.lattice_coarse import coarse_space
from naibu.mechanics.simd import WIDTH, aligned

_STRIDE = 4  # a neighbour along y, z or a diagonal, and the two beside it along x, overlap


@dataclass(frozen=True, slots=True, eq=False)
class Blocks:
    """Where elements are stored: lane k of block b joins the masses first[b] + k and second[b] + k, or none.

    Attributes
    ----------
    first, second : ndarray, shape (nb,), int64
        Masses of lane 0. `first` is a multiple of eight and grows, so that what the blocks of eight masses share is loaded once.
    lane : ndarray, shape (m,), int64
        8 b + k of every element.
    n_nodes : int
        Number of masses; arrays of masses have eight more places, which lanes without element may read.
    """

    first: Integers
    second: Integers
    lane: Integers
    n_nodes: int

    @classmethod
    def of(cls, lattice: Lattice) -> Blocks:
        """Cover the elements of a lattice by blocks."""
        i, j = np.sort(lattice.elements, axis=1).T
        tile = i // WIDTH
        order = np.lexsort((j - i, tile))
        change = np.flatnonzero(np.diff(tile[order], prepend=-1) | np.diff((j - i)[order], prepend=-1))
        block = np.repeat(np.arange(len(change)), np.diff(change, append=len(order)))
        first, gap = WIDTH * tile[order][change], (j - i)[order][change]
        turn = _spread(first)
        place = np.empty(len(turn), dtype=np.int64)
        place[turn] = np.arange(len(turn))
        position = np.empty(len(order), dtype=np.int64)
        position[order] = WIDTH * place[block] + i[order] % WIDTH
        return cls(first[turn], (first + gap)[turn], position, lattice.n_nodes)

    @property
    def n_blocks(self) -> int:
        """Number of blocks."""
        return len(self.first)

    def stored(self, values: Array, dtype: type[np.floating] = np.float64) -> NDArray[np.floating]:
        """Return values (m,) as they lie in blocks (8 nb,), zero where there is no element."""
        result = np.zeros(WIDTH * self.n_blocks, dtype=dtype)
        result[self.lane] = values
        return result

    def patterns(self, *columns: Array, dtype: type[np.floating] = np.float64) -> tuple[Integers, list[NDArray[np.floating]]]:
        """Return where the coefficients of every block start, (nb,), in tables that hold equal ones once; zero in empty lanes.

        Most blocks of a lattice with few parameters share theirs, so that the tables stay in the fast cache.
        """
        wide = np.concatenate([self.stored(column).reshape(-1, WIDTH) for column in columns], axis=1)
        rows = np.ascontiguousarray(wide).view([("", wide.dtype)] * wide.shape[1]).ravel()
        _, chosen, number = np.unique(rows, return_index=True, return_inverse=True)
        kept = wide[chosen]
        tables = [np.ascontiguousarray(kept[:, WIDTH * c : WIDTH * (c + 1)]).astype(dtype).ravel() for c in range(len(columns))]
        return WIDTH * number.ravel().astype(np.int64), tables


def _spread(first: Integers) -> Integers:
    """Return an order of blocks that keeps `first` sorted but sets apart blocks whose second masses overlap.

    These are neighbours by their distance; a processor stalls where it loads what it has just stored in other pieces.
    """
    rank = np.arange(len(first)) - np.searchsorted(first, first)
    return np.lexsort((rank // _STRIDE, rank % _STRIDE, first))


def explicit_coefficients(parameters: LatticeParameters) -> tuple[Array, Array, Array, Array]:
    """Return A, B, D, G of every element: tension ``A l' + B y`` and ``y' = D l' - G y`` of the extension y = Z - a L (spec L1)."""
    k, c1, c2 = parameters.stiffness, parameters.voigt_damping, parameters.series_damping
    share = series_share(parameters)
    return c1 * share, k * share, share, k / (c1 + c2)


def explicit_tables(parameters: LatticeParameters, step: float, forward: bool) -> tuple[Array, Array, Array, Array]:
    """Return the coefficients of explicit steps of every element: tension ``A l' + B y``, and ``y`` grows by ``D l' - G y``.

    If not `forward`, the tension follows the extension after the step, as positions follow the velocity after it.
    """
    a, b, d, g = explicit_coefficients(parameters)
    if not forward:
        a, b = a + b * d * step, b * (1.0 - g * step)
    return a, b, d * step, g * step


def series_share(parameters: LatticeParameters) -> Array:
    """Return C2 / (C1 + C2) of every element, also where C2 is infinite."""
    return 1.0 / (1.0 + parameters.voigt_damping / parameters.series_damping)


def implicit_coefficients(parameters: LatticeParameters, step: float) -> tuple[Array, Array, Array, Array]:
    """Return a, b, E, g of every element for a step in s (spec L1).

    While the length changes evenly by dl, ``y1 = E y0 + g dl`` is exact and the mean tension is ``a dl + b y0``; all are finite and not
    negative for every K, C1 >= 0 and C2 > 0.
    """
    k, c1, c2 = parameters.stiffness, parameters.voigt_damping, parameters.series_damping
    share = series_share(parameters)
    x = k * step / (c1 + c2)
    decay = np.exp(-x)
    first, second = _exponential_means(x)
    return (c1 * share + share**2 * k * step * second) / step, k * share * first, decay, share * first


def _exponential_means(x: Array) -> tuple[Array, Array]:
    """Return (1 - exp(-x)) / x and (1 - that) / x without cancellation, 1 and 1/2 at 0."""
    small = x < 0.1  # the series of eight terms is exact to the last place below
    safe = np.where(small, 1.0, x)
    first = -np.expm1(-safe) / safe
    second = (1.0 - first) / safe
    series_first, series_second, term = np.zeros_like(x), np.zeros_like(x), np.ones_like(x)
    for n in range(1, 11):  # term = (-x)^(n-1) / n!
        term = term / n
        series_first += term
        series_second += term / (n + 1)
        term = -term * np.where(small, x, 0.0)
    return np.where(small, series_first, first), np.where(small, series_second, second)


def explicit_kernel(parameters: LatticeParameters, step: float, blocks: Blocks, mass: Any, threads: int, forward: bool) -> tuple[Any, ...]:
    """Return what explicit steps need: blocks, tables, masses with their inverses, and the parts of each thread.

    A part has blocks and masses; the masses that its blocks touch begin and end at the last two.
    """
    rows, tables = blocks.patterns(*explicit_tables(parameters, step, forward), dtype=mass.dtype.type)
    inverse = np.divide(1.0, mass, out=np.zeros_like(mass), where=mass > 0.0)
    first, second = blocks.first, blocks.second
    nodes = np.append(np.round(np.arange(threads) * blocks.n_nodes / threads / WIDTH).astype(np.int64) * WIDTH, len(mass) - WIDTH)
    cuts = np.searchsorted(first, nodes)
    low = np.minimum(first[np.minimum(cuts[:-1], len(first) - 1)], nodes[:-1]) if len(first) else nodes[:-1]
    ends = [second[i:j].max(initial=0) + WIDTH for i, j in pairwise(cuts)]
    return (first, second, rows), tuple(tables), (mass, inverse), (cuts, nodes, low, np.maximum(np.array(ends), nodes[1:]))


def implicit_kernel(lattice: Lattice, parameters: LatticeParameters, step: float, blocks: Blocks, mass: Any) -> tuple[Any, ...]:
    """Return what implicit steps need: blocks, tables, working arrays, and those of the solver in single precision."""
    a, b, decay, g = implicit_coefficients(parameters, step)
    rows, tables = blocks.patterns(a, b, decay, g, parameters.stiffness, step**2 * a)
    single, places, pad = np.float32, WIDTH * blocks.n_blocks, len(mass)
    diagonal = np.bincount(lattice.elements.ravel(), np.repeat(step**2 * a / 3.0, 2), minlength=lattice.n_nodes) + lattice.node_mass
    smoother, light = aligned((pad,), single), aligned((pad,), single)
    smoother[: lattice.n_nodes] = 1.0 / diagonal
    light[:] = mass
    work = (aligned((3, places), float), *(aligned((3 * pad,), float) for _ in range(3)))
    coarse = coarse_space(lattice, step**2 * a, diagonal, smoother, pad, 1)
    inner = (tables[5].astype(single), aligned((3, places), single), light, smoother, *(aligned((3 * pad,), single) for _ in range(4)))
    return (blocks.first, blocks.second, rows), tuple(tables), work, (*inner, coarse)
