"""Element factors of octree lattices that keep forces and surface shape of the classic lattice.

Nodes that hang on the edges and faces of coarser cubes are constrained by the finer side only, so that an octree that has the energy of the
classic lattice in uniform strain (`naibu.mechanics.lattices.model.octrees.energy_scaling.energy_factors`) yields there and is too soft, the
more so the more levels it has. Elements of like surroundings get one more factor each, found by the method of Gauss and Newton such that
the octree takes the energies of the classic lattice in two kinds of tests:

- The surface is moved by any polynomial up to the fourth degree which leaves the inner nodes of a classic lattice in equilibrium. Its
  energy there is known without solving anything.
- The floor is constrained and forces are put on the rest of the surface, smooth ones and some on spots. The classic lattice is solved for
them
  once, if it has at most `LOADED_MASSES` nodes.

Energies of pairs of motions determine forces and displacements of the surface; inner nodes do not enter.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import product

import numpy as np
import scipy.linalg as sla
import scipy.sparse as sp
from numpy.typing import ArrayLike

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.errors import ConvergenceError
from naibu.mechanics.lattices.model.octrees.energy_scaling import OctreeGrid, surroundings
from naibu.mechanics.linear_algebra.direct import direct_solver, pardiso_library
from naibu.mechanics.linear_algebra.protocols import LinearSolver
from naibu.mechanics.linear_algebra.solver_selection import choose_solver

DEGREE = 4  # of the polynomials; with lower ones the surface yields between them
TOLERANCE = 0.005  # of the energies, weighed against
FACTOR_SPREAD = 0.5  # the logarithm of the factors
STEPS, LONGEST_STEP, ENOUGH = 12, 0.7, 5e-3  # a step that lowers the misfit by less, relatively, is the last
LOADED_MASSES = 10_000
SPOTS, SPOT_RADIUS = 40, 0.35  # of forces; of half the longest side of the object

_DIRECTIONS = np.array([d for d in product((-1, 0, 1), repeat=3) if d > (0, 0, 0)])


def response_factors(grid: OctreeGrid, start: FloatArray, class_stiffness: FloatArray) -> FloatArray:
    """Return factors (m,) with which the surface of an octree lattice responds as that of the classic lattice does.

    Parameters
    ----------
    grid : OctreeGrid
        The octree.
    start : ndarray, shape (m,)
        Factors that need correction only for the compliance of nodes on edges and faces of coarser cubes.
    class_stiffness : ndarray, shape (3,)
        K of short, normal and long elements of the classic lattice, in any unit.
    """
    around = grid.around_masses()
    surface, hanging = (around == 0).any(axis=1), grid.hanging(around) > 0
    if surface.all() or not hanging.any():
        return start
    stiffness = class_stiffness / class_stiffness.max()
    elements = _Elements.of(grid.nodes, grid.pairs, start * stiffness[grid.element_class], surroundings(grid))
    motions = EquilibriumPolynomials.of(grid.filled, stiffness).at(grid.nodes)
    tests = [_EnergyTest.of_motions(elements, surface, motions)]
    floor = grid.nodes[:, 2] == grid.nodes[:, 2].min()
    loaded = surface & ~hanging & ~floor
    if loaded.any() and len(_classic_masses(grid.filled)) <= LOADED_MASSES:
        with suppress(ConvergenceError):  # a part that hinges on one edge answers to forces by turning
            tests.append(_EnergyTest.of_forces(elements, floor, _orthonormal_forces(grid, loaded, stiffness)))
    return np.asarray(start * np.exp(_fitted(tests))[surroundings(grid)])


def _fitted(tests: Sequence[_EnergyTest]) -> FloatArray:
    """Return the logarithms (groups,) of the factors that weigh errors of the energies against the spread of the factors."""

    def evaluated(x: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        parts = [test.evaluated(x) for test in tests]
        error = np.concatenate([part[0] for part in parts] + [x / FACTOR_SPREAD])
        slope = np.vstack([part[1] for part in parts] + [np.eye(len(x)) / FACTOR_SPREAD])
        return error, slope, float(error @ error)

    x = np.zeros(tests[0].elements.n_groups)
    error, slope, misfit = evaluated(x)
    for _ in range(STEPS):
        step = np.clip(-np.linalg.solve(slope.T @ slope, slope.T @ error), -LONGEST_STEP, LONGEST_STEP)
        for _ in range(3):
            new = evaluated(x + step)
            if new[2] < misfit:
                break
            step *= 0.4
        else:
            break
        done = misfit - new[2] < ENOUGH * misfit
        x, (error, slope, misfit) = x + step, new
        if done:
            break
    return x


@dataclass(frozen=True, slots=True, eq=False)
class _Elements:
    """Elements sorted by their groups.

    Attributes
    ----------
    longer : csr_matrix, shape (m, 3 n)
        How much longer elements become by displacements of the nodes.
    stiffness : ndarray, shape (m,)
        Before correction.
    group : ndarray, shape (m,)
        Their group.
    parts : ndarray, shape (groups + 1,)
        Where the groups begin, and the last one ends.
    nodes : ndarray, shape (n, 3)
        Positions of the nodes on the grid.
    """

    longer: sp.csr_matrix
    stiffness: FloatArray
    group: IntArray
    parts: IntArray
    nodes: IntArray

    @classmethod
    def of(cls, nodes: IntArray, pairs: IntArray, stiffness: FloatArray, group: IntArray) -> _Elements:
        order = np.argsort(group, kind="stable")
        parts = np.searchsorted(group[order], np.arange(int(group.max()) + 2))
        return cls(lengthening(nodes, pairs[order]), stiffness[order], group[order], parts, nodes)

    @property
    def n_groups(self) -> int:
        return len(self.parts) - 1


def lengthening(nodes: IntArray, pairs: IntArray) -> sp.csr_matrix:
    """Return the map (m, 3 n) from small displacements of nodes at grid positions (n, 3) to the lengthening of elements (m, 2)."""
    offset = nodes[pairs[:, 1]] - nodes[pairs[:, 0]]
    unit = offset / np.linalg.norm(offset, axis=1)[:, None]
    columns = 3 * pairs[:, [1, 1, 1, 0, 0, 0]] + np.array([0, 1, 2, 0, 1, 2])
    entries = (np.hstack([unit, -unit]).ravel(), columns.ravel(), 6 * np.arange(len(pairs) + 1))
    return sp.csr_matrix(entries, shape=(len(pairs), 3 * len(nodes)))


class _EnergyTest:
    """Energies of pairs of p motions of an octree, which are to be those of the unit matrix, by factors of groups of elements."""

    def __init__(self, elements: _Elements, free: BoolArray, imposed: FloatArray | None, forces: FloatArray | None) -> None:
        self.elements = elements
        self._longer = sp.csr_matrix(elements.longer[:, np.flatnonzero(np.repeat(free, 3))])
        self._imposed, self._forces = imposed, forces
        self._points = elements.nodes[free].astype(np.float64)
        self._solver: LinearSolver | None = None
        given = imposed if imposed is not None else forces
        assert given is not None
        self._triangle = np.triu_indices(given.shape[1])
        self._weight = np.where(self._triangle[0] == self._triangle[1], 1.0, np.sqrt(2.0)) / TOLERANCE

    @classmethod
    def of_motions(cls, elements: _Elements, moved: BoolArray, motions: FloatArray) -> _EnergyTest:
        """Move some nodes (n,) by motions (n, 3, p)."""
        constrained = np.flatnonzero(np.repeat(moved, 3))
        imposed = elements.longer[:, constrained] @ motions.reshape(len(moved) * 3, -1)[constrained]
        return cls(elements, ~moved, np.asarray(imposed), None)

    @classmethod
    def of_forces(cls, elements: _Elements, constrained: BoolArray, forces: FloatArray) -> _EnergyTest:
        """Fix some nodes (n,), and put forces (n, 3, p) on others."""
        return cls(elements, ~constrained, None, forces[~constrained].reshape(3 * int((~constrained).sum()), -1))

    def evaluated(self, logarithms: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the errors (r,), positive where the octree is too stiff, in units of the tolerance, and their derivatives (r, groups)."""
        elements = self.elements
        k = elements.stiffness * np.exp(logarithms)[elements.group]
        weighted = sp.csr_matrix(self._longer.multiply(k[:, None]))
        matrix = (weighted.T @ self._longer).tobsr((3, 3))
        if self._solver is None:
            self._solver = _solver(matrix, self._points)
        right = self._forces if self._imposed is None else -np.asarray(weighted.T @ self._imposed)
        assert right is not None
        inner = self._solver.factorize(matrix).solve(right)
        own = np.empty((elements.n_groups, len(self._weight)))
        for g, (begin, end) in enumerate(zip(elements.parts[:-1], elements.parts[1:], strict=True)):
            longer = self._longer[begin:end] @ inner
            if self._imposed is not None:
                longer = longer + self._imposed[begin:end]
            longer *= np.sqrt(k[begin:end, None])
            own[g] = (longer.T @ longer)[self._triangle]
        # a stiffer group adds its energy where motions are given, and takes it away where forces are
        error = own.sum(axis=0) - (self._triangle[0] == self._triangle[1])
        return (error if self._forces is None else -error) * self._weight, (own * self._weight).T


def _solver(matrix: sp.bsr_matrix, points: FloatArray) -> LinearSolver:
    """Return a direct solver, which serves all motions at once, where a fast one is installed."""
    if pardiso_library() is not None:
        return direct_solver(matrix, symmetric=True)
    return choose_solver(matrix, points, np.zeros(points.shape, dtype=bool), symmetric=True)


@dataclass(frozen=True, slots=True, eq=False)
class EquilibriumPolynomials:
    """Polynomial motions in which no inner node of a classic lattice feels a force, orthonormal by their energy in it.

    Attributes
    ----------
    powers : ndarray, shape (q, 3), int64
        Exponents of the monomials.
    coefficients : ndarray, shape (p, 3, q)
        Of the p motions.
    centre : ndarray, shape (3,)
        Position on the grid where the coordinates are zero.
    radius : float
        Length in voxels by which the coordinates are divided.
    """

    powers: IntArray
    coefficients: FloatArray
    centre: FloatArray
    radius: float

    @classmethod
    def of(cls, filled: BoolArray, stiffness: FloatArray, degree: int = DEGREE) -> EquilibriumPolynomials:
        """Return the motions of the classic lattice of a mask, with the given K (3,) of short, normal and long elements."""
        used = np.argwhere(filled)
        low, high = used.min(axis=0), used.max(axis=0) + 1
        powers = np.array([p for p in product(range(degree + 1), repeat=3) if sum(p) <= degree])
        radius = float((high - low).max()) / 2.0
        free = cls(powers, _balanced(powers, stiffness, 1.0 / radius), (low + high) / 2.0, radius)
        energy = np.zeros((len(free.coefficients),) * 2)
        for direction in _DIRECTIONS:
            at = _classic_elements(filled, direction)
            unit = direction / np.linalg.norm(direction)
            longer = np.einsum("a,eap->ep", unit, free.at(at + direction) - free.at(at))
            energy += stiffness[np.count_nonzero(direction) - 1] * longer.T @ longer
        values, vectors = np.linalg.eigh(energy)
        strained = values > 1e-9 * values[-1]  # the others are rigid motions
        basis = (vectors[:, strained] / np.sqrt(values[strained])).T
        return cls(powers, np.einsum("pr,raq->paq", basis, free.coefficients), free.centre, radius)

    def at(self, positions: ArrayLike) -> FloatArray:
        """Return the displacements (n, 3, p) at positions (n, 3) on the grid."""
        values = _monomials((np.asarray(positions) - self.centre) / self.radius, self.powers)
        p, _, q = self.coefficients.shape
        return np.asarray(values @ self.coefficients.transpose(2, 1, 0).reshape(q, 3 * p)).reshape(-1, 3, p)


def _monomials(positions: FloatArray, powers: IntArray) -> FloatArray:
    x, y, z = (positions[:, [axis]] ** np.arange(powers.max() + 1) for axis in range(3))
    return np.asarray(x[:, powers[:, 0]] * y[:, powers[:, 1]] * z[:, powers[:, 2]])


def _balanced(powers: IntArray, stiffness: FloatArray, spacing: float) -> FloatArray:
    """Return coefficients (p, 3, q) of a basis of the polynomial motions that all 26 elements of a node balance, wherever it is."""
    degree = int(powers.max())
    places = np.array(list(product(np.linspace(-1.0, 1.0, degree + 1), repeat=3)))
    here = _monomials(places, powers)
    force = np.zeros((len(places), 3, 3, len(powers)))
    for direction in np.concatenate([_DIRECTIONS, -_DIRECTIONS]):
        k = stiffness[np.count_nonzero(direction) - 1] / (direction @ direction)
        change = (_monomials(places + spacing * direction, powers) - here) / spacing**2
        force += k * np.einsum("a,b,nq->nabq", direction, direction, change)
    return np.asarray(sla.null_space(force.reshape(3 * len(places), -1), rcond=1e-9).T.reshape(-1, 3, len(powers)))


def _classic_elements(filled: BoolArray, direction: IntArray) -> IntArray:
    """Return the nodes (k, 3) from which an element of the classic lattice leads in a direction."""
    padded = np.pad(filled, 1)
    joined = np.zeros(tuple(n + 1 for n in filled.shape), dtype=bool)
    ways = [{0: (0, 1), 1: (1,), -1: (0,)}[int(d)] for d in direction]  # in which of the two voxels along each axis it may lie
    for step in product(*ways):
        joined |= padded[tuple(slice(s, s + n) for s, n in zip(step, joined.shape, strict=True))]
    return np.argwhere(joined)


def _classic_masses(filled: BoolArray) -> IntArray:
    """Return the positions (n, 3) of the nodes of the classic lattice."""
    used = np.zeros(tuple(n + 1 for n in filled.shape), dtype=bool)
    for step in product((0, 1), repeat=3):
        used[tuple(slice(s, s + n) for s, n in zip(step, filled.shape, strict=True))] |= filled
    return np.argwhere(used)


def _orthonormal_forces(grid: OctreeGrid, loaded: BoolArray, stiffness: FloatArray) -> FloatArray:
    """Return forces (n, 3, p) on some nodes, orthonormal by the energies of the classic lattice with its floor constrained."""
    masses = _classic_masses(grid.filled)
    forces = _forces(grid, loaded)
    number = np.full(tuple(n + 1 for n in grid.filled.shape), -1, dtype=np.int64)
    number[tuple(masses.T)] = np.arange(len(masses))
    at = [_classic_elements(grid.filled, d) for d in _DIRECTIONS]
    pairs = [np.stack([number[tuple(a.T)], number[tuple((a + d).T)]], axis=1) for a, d in zip(at, _DIRECTIONS, strict=True)]
    k = np.repeat(stiffness[np.count_nonzero(_DIRECTIONS, axis=1) - 1], [len(a) for a in at])
    free = np.flatnonzero(np.repeat(masses[:, 2] > masses[:, 2].min(), 3))
    longer = sp.csr_matrix(lengthening(masses, np.concatenate(pairs))[:, free])
    matrix = (sp.csr_matrix(longer.multiply(k[:, None])).T @ longer).tobsr((3, 3))
    on_classic = np.zeros((len(masses), 3, forces.shape[2]))
    on_classic[number[tuple(grid.nodes.T)]] = forces
    right = on_classic.reshape(3 * len(masses), -1)[free]
    energy = right.T @ _solver(matrix, masses[masses[:, 2] > masses[:, 2].min()].astype(np.float64)).factorize(matrix).solve(right)
    values, vectors = np.linalg.eigh((energy + energy.T) / 2.0)
    felt = values > 1e-5 * values[-1]
    return np.asarray(forces @ (vectors[:, felt] / np.sqrt(values[felt])))


def _forces(grid: OctreeGrid, loaded: BoolArray) -> FloatArray:
    """Return forces (n, 3, p): along every axis all monomials up to the second degree, and one each on some spots, anywhere."""
    rng = np.random.default_rng(0)
    low, high = grid.nodes.min(axis=0), grid.nodes.max(axis=0)
    places = (2.0 * grid.nodes - low - high) / (high - low).max()
    powers = np.array([p for p in product(range(3), repeat=3) if sum(p) <= 2])
    centres = places[rng.choice(np.flatnonzero(loaded), SPOTS)]
    distance = ((places[:, None, :] - centres) ** 2).sum(axis=2)
    spots = np.exp(-distance / (2.0 * SPOT_RADIUS**2))[:, None, :] * rng.normal(size=(3, SPOTS))
    smooth = np.einsum("ab,nq->nabq", np.eye(3), _monomials(places, powers)).reshape(len(places), 3, -1)
    return np.asarray(np.concatenate([smooth, spots], axis=2) * loaded[:, None, None])
