"""Virtual bodies of quadratic hexahedra with known moduli, solved by code that shares nothing with the finite elements of `mechanics`.

Elements have 27 nodes, quadratic displacement and linear discontinuous pressure (Q2/P-1, :cite:t:`hughes2000`), which neither locks near
incompressibility nor has spurious pressures; small strain. Bodies are images of a cube, their lower half unknown, their upper half known.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.mesh import Mesh
from naibu.mechanics.linear_algebra.direct import direct_solver
from naibu.meshing.primitives import box

SIDE_MM = 40.0
UNKNOWN, KNOWN = (5.0, 0.45), (10.0, 0.4)  # Young's modulus, kPa, and Poisson's ratio
_GAUSS = (np.array([-np.sqrt(0.6), 0.0, np.sqrt(0.6)]), np.array([5.0, 8.0, 5.0]) / 9.0)


class Inclusion(NamedTuple):
    """A sphere: its middle and radius, mm, Young's modulus, kPa, and Poisson's ratio."""

    middle_mm: tuple[float, float, float]
    radius_mm: float
    young_modulus: float
    poisson_ratio: float

    def holds(self, points: FloatArray) -> BoolArray:
        """Return which points (..., 3), mm, lie in it."""
        return np.asarray(np.linalg.norm(points - self.middle_mm, axis=-1) < self.radius_mm)


class Solved(NamedTuple):
    """Nodes (n, 3), mm, elements (m, 27) and displacement (n, 3), mm, of a body of `divisions` elements a side."""

    points: FloatArray
    cells: IntArray
    displacement: FloatArray
    divisions: int

    def at(self, parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return positions and displacements (k, 3), mm, of points given by their coordinates (k, 3) in the unit cube."""
        scaled = np.clip(parameters, 0.0, 1.0 - 1e-12) * self.divisions
        index = scaled.astype(int)
        cell = self.cells[index @ np.array([1, self.divisions, self.divisions**2])]
        weights = np.stack([_shape(x)[0] for x in 2.0 * (scaled - index) - 1.0])
        return np.einsum("pa,pai->pi", weights, self.points[cell]), np.einsum("pa,pai->pi", weights, self.displacement[cell])


@dataclass(frozen=True, slots=True, eq=False)
class QuadraticBody:
    """A body whose lower half is unknown and whose upper half is known, between a fixed floor and a plate on top, bonded to both.

    Attributes
    ----------
    name : str
        ``"cube"``, ``"tapered"`` (by a third, and twisted by 25 degrees) or ``"barrel"``, see `SHAPES`.
    unknown, known : (float, float)
        Young's modulus, kPa, and Poisson's ratio of the lower and of the upper half.
    inclusions : tuple of Inclusion
        Spheres in either half.
    sliding : bool
        Whether the halves slide along each other without friction, and stay in touch; otherwise they are bonded.
    """

    name: str
    unknown: tuple[float, float] = UNKNOWN
    known: tuple[float, float] = KNOWN
    inclusions: tuple[Inclusion, ...] = ()
    sliding: bool = False

    def solved(self, push: ArrayLike, divisions: int = 8) -> Solved:
        """Return the equilibrium when the plate moves by `push` (3,), mm; `divisions` elements a side, even."""
        per_axis = 2 * divisions + 1
        axis = np.linspace(0.0, SIDE_MM, per_axis)
        z, y, x = (a.ravel() for a in np.meshgrid(axis, axis, axis, indexing="ij"))
        points, cells = SHAPES[self.name](np.stack([x, y, z], axis=1)), _cells(divisions)
        upper = np.repeat(np.arange(divisions) >= divisions // 2, divisions**2)
        moduli = np.repeat(np.where(upper[:, None], _lame(*self.known), _lame(*self.unknown))[:, None], 27, axis=1)
        at = np.einsum("qa,mai->mqi", np.stack([_shape(_GAUSS[0][list(q)])[0] for q in np.ndindex(3, 3, 3)]), points[cells])
        for one in self.inclusions:
            moduli[one.holds(at)] = _lame(one.young_modulus, one.poisson_ratio)
        points, cells, tied = _parted(points, cells, upper) if self.sliding else (points, cells, None)
        z = points[:, 2]
        fixed = np.repeat((z < 1e-9) | (z > SIDE_MM - 1e-9), 3)
        u: FloatArray = np.where((z > 0.5 * SIDE_MM)[:, None], np.asarray(push, dtype=float), 0.0).ravel() * fixed
        matrix = _stiffness(points, cells, *np.moveaxis(moduli, -1, 0))
        if tied is not None:
            matrix = (tied.T @ matrix @ tied).tocsr()
            fixed |= np.asarray(tied.sum(axis=0)).ravel() == 0.0
        free = sp.diags((~fixed).astype(float))
        right = -(free @ (matrix @ u))
        held = sp.bsr_matrix(free @ matrix @ free + sp.diags(fixed * matrix.diagonal().mean()), blocksize=(3, 3))
        held.sort_indices()
        u = u + direct_solver(held, symmetric=True).factorize(held).solve(right)
        return Solved(points, cells, (u if tied is None else tied @ u).reshape(-1, 3), divisions)

    def model(self, cells: int, cell_type: str) -> tuple[Mesh, BoolArray]:
        """Return a mesh of linear cells, `cells` a side, with regions "unknown" and "known", and which nodes (n,) floor and plate load."""
        half = 0.5 * SIDE_MM
        mesh = box((SIDE_MM,) * 3, (cells,) * 3, layers=[("unknown", half), ("known", half)], centred=False, cell_type=cell_type)
        z = mesh.points[:, 2]
        return replace(mesh, points=SHAPES[self.name](mesh.points)), (z < 1e-9) | (z > SIDE_MM - 1e-9)


def _tapered(points: FloatArray) -> FloatArray:
    height, middle = points[:, 2] / SIDE_MM, 0.5 * SIDE_MM
    x, y = ((points[:, :2] - middle) * (1.15 - 0.4 * height)[:, None]).T
    c, s = np.cos(np.radians(25.0) * height), np.sin(np.radians(25.0) * height)
    return np.stack([middle + c * x - s * y, middle + s * x + c * y, points[:, 2]], axis=1)


def _barrel(points: FloatArray) -> FloatArray:
    middle = 0.5 * SIDE_MM
    x, y = ((points[:, :2] - middle) / middle).T
    round_off = np.stack([x * np.sqrt(1.0 - 0.35 * y**2), y * np.sqrt(1.0 - 0.35 * x**2)], axis=1)
    bulge = 1.0 + 0.25 * np.sin(np.pi * points[:, 2] / SIDE_MM)
    return np.column_stack([middle + middle * round_off * bulge[:, None], points[:, 2]])


SHAPES: dict[str, Callable[[FloatArray], FloatArray]] = {"cube": np.array, "tapered": _tapered, "barrel": _barrel}


def _lame(young: float, poisson: float) -> FloatArray:
    return np.array([young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson)), young / (2.0 * (1.0 + poisson))])


def _shape(at: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the shape functions (27,) and their derivatives (27, 3) at a point of [-1, 1]^3, x fastest."""
    value = np.stack([at * (at - 1.0) / 2.0, 1.0 - at**2, at * (at + 1.0) / 2.0])
    slope = np.stack([at - 0.5, -2.0 * at, at + 0.5])
    parts = [[slope if a == b else value for b in range(3)] for a in range(3)]
    derivatives = [np.einsum("i,j,k->ijk", p[2][:, 2], p[1][:, 1], p[0][:, 0]).ravel() for p in parts]
    return np.einsum("i,j,k->ijk", value[:, 2], value[:, 1], value[:, 0]).ravel(), np.stack(derivatives, axis=1)


def _cells(n: int) -> IntArray:
    number = np.arange((2 * n + 1) ** 3).reshape((2 * n + 1,) * 3)
    corners = np.ndindex(n, n, n)
    return np.array([number[2 * k : 2 * k + 3, 2 * j : 2 * j + 3, 2 * i : 2 * i + 3].ravel() for k, j, i in corners])


def _parted(points: FloatArray, cells: IntArray, upper: BoolArray) -> tuple[FloatArray, IntArray, sp.csr_matrix]:
    """Return nodes and cells with nodes of the upper cells (m,) of their own on the border, which is level, and what ties the heights.

    The matrix (3 n, 3 n) gives all displacements from those that are free: the height of the new nodes is that of the old ones.
    """
    border = np.intersect1d(cells[upper], cells[~upper])
    own = np.arange(len(points))
    own[border] = len(points) + np.arange(len(border))
    free = np.arange(3 * (len(points) + len(border)))
    free[3 * own[border] + 2] = 3 * border + 2
    ones = np.ones(len(free))
    tied = sp.csr_matrix((ones, (np.arange(len(free)), free)), shape=(len(free),) * 2)
    return np.concatenate([points, points[border]]), np.where(upper[:, None], own[cells], cells), tied


def _stiffness(points: FloatArray, cells: IntArray, lame: FloatArray, shear: FloatArray) -> sp.csr_matrix:
    """Return the stiffness (3 n, 3 n), mN/mm, of moduli (m, 27), kPa, at integration points, the pressure of every element condensed."""
    m, x, bulk = len(cells), points[cells], lame + 2.0 / 3.0 * shear
    stiffness = np.zeros((m, 27, 3, 27, 3))
    mass, coupling = np.zeros((m, 4, 4)), np.zeros((m, 4, 27, 3))
    for q, index in enumerate(np.ndindex(3, 3, 3)):
        value, derivatives = _shape(_GAUSS[0][list(index)])
        jacobian = np.einsum("aj,mai->mij", derivatives, x)
        weight = np.linalg.det(jacobian) * np.prod(_GAUSS[1][list(index)])
        gradient = np.einsum("aj,mji->mai", derivatives, np.linalg.inv(jacobian))
        pressure = np.concatenate([np.ones((m, 1)), np.einsum("a,mai->mi", value, x) - x.mean(axis=1)], axis=1)
        mass += np.einsum("m,mp,mr->mpr", weight / bulk[:, q], pressure, pressure)
        coupling += np.einsum("m,mp,mai->mpai", weight, pressure, gradient)
        scaled = (weight * shear[:, q])[:, None, None] * gradient
        stiffness += np.einsum("maj,mbi->maibj", scaled, gradient) - 2.0 / 3.0 * np.einsum("mai,mbj->maibj", scaled, gradient)
        like = np.einsum("mac,mbc->mab", scaled, gradient)
        for i in range(3):
            stiffness[:, :, i, :, i] += like
    solved = np.linalg.solve(mass, coupling.reshape(m, 4, 81)).reshape(coupling.shape)
    stiffness += np.einsum("mpai,mpbj->maibj", coupling, solved, optimize=True)
    unknowns = (cells[:, :, None] * 3 + np.arange(3)).reshape(m, -1)
    index = np.repeat(unknowns, 81, axis=1).ravel(), np.tile(unknowns, (1, 81)).ravel()
    return sp.csr_matrix((stiffness.ravel(), index), shape=(3 * len(points),) * 2)
