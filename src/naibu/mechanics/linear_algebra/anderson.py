"""Anderson's acceleration of fixed-point iterations :cite:p:`walker2011`."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from naibu.core.arrays import FloatArray


@dataclass(slots=True, eq=False)
class AndersonMixing:
    """Steps of an iteration x -> x + d(x), mixed so that the linear part of what is left vanishes.

    Attributes
    ----------
    depth : int
        Earlier steps that are kept.
    """

    depth: int
    _x: list[FloatArray] = field(init=False, default_factory=list)
    _d: list[FloatArray] = field(init=False, default_factory=list)

    @property
    def steps(self) -> int:
        """Steps that are kept."""
        return len(self._x)

    def step(self, x: FloatArray, d: FloatArray) -> FloatArray:
        """Return the step (n,) to take from x (n,), where the iteration itself would step by d (n,)."""
        mixed = d
        if self._x:
            dx = np.stack([x - other for other in self._x])
            dd = np.stack([d - other for other in self._d])
            weights = np.linalg.lstsq(dd @ dd.T, dd @ d, rcond=1e-10)[0]
            mixed = d - weights @ (dx + dd)
        self._x, self._d = [*self._x, x][-self.depth :], [*self._d, d][-self.depth :]
        return np.asarray(mixed)
