"""Dirichlet boundary conditions: prescribed displacement components."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.errors import InputError


@dataclass(frozen=True, slots=True, eq=False)
class PrescribedDisplacement:
    """Prescribed displacement components of all nodes; they grow in proportion to the load.

    Attributes
    ----------
    constrained : ndarray, shape (n, d), bool
        Which components are prescribed.
    values : ndarray, shape (n, d)
        Their values at full load, mm.
    start : ndarray, shape (n, d), optional
        Their values without load, mm; zero by default.
    """

    constrained: BoolArray
    values: FloatArray
    start: FloatArray | None = None

    def at(self, load: float) -> FloatArray:
        """Return the values (n, d), mm, at a fraction of the load."""
        return np.asarray(load * self.values if self.start is None else self.start + load * (self.values - self.start))

    @classmethod
    def none(cls, n_points: int, dimension: int = 3) -> PrescribedDisplacement:
        """Return no constraint on any of `n_points` nodes."""
        return cls(np.zeros((n_points, dimension), dtype=bool), np.zeros((n_points, dimension)))

    def and_also(self, nodes: ArrayLike, values: ArrayLike, components: tuple[bool, ...] | None = None) -> PrescribedDisplacement:
        """Return these conditions with further components prescribed.

        Parameters
        ----------
        nodes : array_like, shape (k,)
            Node numbers.
        values : array_like, shape (d,) or (k, d)
            Displacements at full load, mm.
        components : tuple of bool, optional
            Which of the d components are prescribed; all by default.

        Raises
        ------
        InputError
            A node number outside the mesh, or a value that is not finite.
        """
        index = np.asarray(nodes, dtype=np.int64)
        given = np.broadcast_to(np.asarray(values, dtype=float), (len(index), self.constrained.shape[1]))
        outside = (index < 0) | (index >= len(self.constrained))
        if outside.any():
            raise InputError(f"nodes has node {index[outside][0]}; the mesh has nodes 0 to {len(self.constrained) - 1}")
        if not np.isfinite(given).all():
            raise InputError("values must be finite displacements; leave a component out of `components` instead of giving NaN")
        constrained, all_values = self.constrained.copy(), self.values.copy()
        for axis in range(self.constrained.shape[1]) if components is None else np.flatnonzero(components):
            constrained[index, axis] = True
            all_values[index, axis] = given[:, axis]
        return PrescribedDisplacement(constrained, all_values, self.start)
