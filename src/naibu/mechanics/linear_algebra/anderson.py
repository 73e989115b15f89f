"""Anderson's acceleration of fixed-point iterations :cite:p:`walker2011`."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from naibu._numba.compilation import njit
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
            mixed = np.empty_like(d)
            _mix(np.array(self._x), np.array(self._d), x, d, mixed)
        self._x, self._d = [*self._x, x][-self.depth :], [*self._d, d][-self.depth :]
        return np.asarray(mixed)


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc"})
def _mix(earlier_x, earlier_d, x, d, mixed):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Put d less the mean of the differences from earlier steps, and from where they began, whose weights leave least of d, in place."""
    count, n = earlier_x.shape
    change, products, right = np.empty((count, n)), np.empty((count, count)), np.empty(count)
    for a in range(count):
        for i in range(n):
            change[a, i] = d[i] - earlier_d[a, i]
    for a in range(count):
        for b in range(a + 1):
            total = 0.0
            for i in range(n):
                total += change[a, i] * change[b, i]
            products[a, b] = products[b, a] = total
        total = 0.0
        for i in range(n):
            total += change[a, i] * d[i]
        right[a] = total
    weights = np.linalg.lstsq(products, right, 1e-10)[0]
    mixed[:] = d
    for a in range(count):
        for i in range(n):
            mixed[i] -= weights[a] * (x[i] - earlier_x[a, i] + change[a, i])
