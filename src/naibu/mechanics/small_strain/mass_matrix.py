"""Mass matrices: lumped (one mass a node) or consistent (sparse) :cite:p:`hughes2000`."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from numpy.typing import ArrayLike

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.errors import InputError
from naibu.mechanics.finite_elements.linear_simplices import consistent_mass_matrices, lumped_mass, per_cell
from naibu.mechanics.small_strain.linear_elasticity import LinearBody


class Mass(Protocol):
    """Mass matrix of a body; the same for every displacement component."""

    def apply(self, velocity: FloatArray) -> FloatArray:
        """Return the momentum (n, d), kg mm/s, of a velocity (n, d), mm/s."""
        ...

    def add_to(self, matrix: sp.bsr_matrix, factor: float) -> None:
        """Add `factor` times the mass to a matrix with the pattern of the body's stiffness, in place."""
        ...

    def accelerations(self, force: FloatArray, constrained: BoolArray, known: FloatArray) -> FloatArray:
        """Return accelerations (n, d), mm/s^2, under forces (n, d), mN, with those of the components `constrained` known."""
        ...


class LumpedMass:
    """Lumped mass: every vertex has an equal fraction of the mass of its cells."""

    def __init__(self, body: LinearBody, density: FloatArray) -> None:
        self.of_node = lumped_mass(body.simplices, density)
        pattern = body.pattern
        self._diagonal = np.flatnonzero(pattern.indices == np.repeat(np.arange(pattern.n_points), np.diff(pattern.indptr)))

    def apply(self, velocity: FloatArray) -> FloatArray:
        """Return the momentum (n, d), kg mm/s."""
        return self.of_node[:, None] * velocity

    def add_to(self, matrix: sp.bsr_matrix, factor: float) -> None:
        """Add to the diagonal."""
        for a in range(matrix.blocksize[0]):
            matrix.data[self._diagonal, a, a] += factor * self.of_node

    def accelerations(self, force: FloatArray, constrained: BoolArray, known: FloatArray) -> FloatArray:
        """Divide forces by masses at the unconstrained components."""
        return np.where(constrained, known, force / self.of_node[:, None])


class ConsistentMass:
    """Consistent mass matrix; in one dimension equation (5.4) of :cite:t:`hirai2008`."""

    def __init__(self, body: LinearBody, density: FloatArray) -> None:
        pattern = body.pattern
        data = np.zeros(pattern.n_blocks)
        np.add.at(data, body.positions.ravel(), consistent_mass_matrices(body.simplices, density).ravel())
        self.matrix = sp.csr_matrix((data, pattern.indices, pattern.indptr), shape=(pattern.n_points, pattern.n_points))
        self._factors: dict[bytes, spla.SuperLU] = {}

    def apply(self, velocity: FloatArray) -> FloatArray:
        """Return the momentum (n, d), kg mm/s."""
        return np.asarray(self.matrix @ velocity)

    def add_to(self, matrix: sp.bsr_matrix, factor: float) -> None:
        """Add to the diagonal of every block."""
        for a in range(matrix.blocksize[0]):
            matrix.data[:, a, a] += factor * self.matrix.data

    def accelerations(self, force: FloatArray, constrained: BoolArray, known: FloatArray) -> FloatArray:
        """Solve for the components that are not known, direction by direction."""
        out = np.where(constrained, known, 0.0)
        right = force - self.apply(out)
        for a in range(force.shape[1]):
            free = ~constrained[:, a]
            if free.any():
                key = free.tobytes()
                if key not in self._factors:
                    self._factors[key] = spla.splu(self.matrix[free][:, free].tocsc())
                out[free, a] = self._factors[key].solve(right[free, a])
        return out


def mass_of(body: LinearBody, density: ArrayLike, kind: str) -> Mass:
    """Return the ``"lumped"`` or ``"consistent"`` mass matrix of a density in kg/mm^3 (water: 1e-6), one number or one a cell.

    Raises
    ------
    InputError
        A density that is not positive, an unknown kind, or a node that belongs to no cell.
    """
    given = per_cell(density, body.simplices.n_cells, "density")
    if not (given > 0.0).all():
        raise InputError(f"density must be positive, not {given.min():g} kg/mm^3; give None to neglect inertia")
    if kind not in ("lumped", "consistent"):
        raise InputError(f"mass must be 'lumped' or 'consistent', not {kind!r}")
    lonely = np.setdiff1d(np.arange(body.simplices.n_points), body.simplices.cells)
    if len(lonely):
        raise InputError(f"node {lonely[0]} belongs to no cell, so it has no mass: remove it from the mesh")
    return LumpedMass(body, given) if kind == "lumped" else ConsistentMass(body, given)
