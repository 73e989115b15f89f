"""Dirichlet boundary conditions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.errors import InputError


@dataclass(frozen=True, slots=True, eq=False)
class Prescribed:
    """Displacement components that are given; they grow in proportion to the load.

    Attributes
    ----------
    constrained : ndarray, shape (n, d), bool
        Which components are prescribed.
    values : ndarray, shape (n, d)
        Their values at full load, mm.
    """

    constrained: BoolArray
    values: FloatArray

    @classmethod
    def nothing(cls, n_points: int, dimension: int = 3) -> Prescribed:
        """Return a support that holds nothing."""
        return cls(np.zeros((n_points, dimension), dtype=bool), np.zeros((n_points, dimension)))

    def and_also(self, nodes: ArrayLike, values: ArrayLike, components: tuple[bool, ...] | None = None) -> Prescribed:
        """Return the support with the `components` (all by default) of `nodes` prescribed to `values` (d,) or (len(nodes), d), mm, as well.

        Raises
        ------
        InputError
            A node number outside the mesh, or a value that is not finite.
        """
        index = np.asarray(nodes, dtype=np.int64)
        given = np.broadcast_to(np.asarray(values, dtype=float), (len(index), self.constrained.shape[1]))
        if len(index) and (index.min() < 0 or index.max() >= len(self.constrained)):
            raise InputError(f"prescribed node {index.max()} does not exist; the mesh has nodes 0 to {len(self.constrained) - 1}")
        if not np.isfinite(given).all():
            raise InputError("prescribed displacements must be finite numbers; leave a component free instead of giving NaN")
        constrained, all_values = self.constrained.copy(), self.values.copy()
        for axis in range(self.constrained.shape[1]) if components is None else np.flatnonzero(components):
            constrained[index, axis] = True
            all_values[index, axis] = given[:, axis]
        return Prescribed(constrained, all_values)
