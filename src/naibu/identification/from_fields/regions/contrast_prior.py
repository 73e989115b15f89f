"""Normal prior of how much regions differ from the largest one, which holds while they are sought.

A lump of too few cells fits best nearly empty, or rigid, where data no longer say how much, and nothing leads from there to a larger
lump of a lower contrast. The moduli of regions that are found are fitted without it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from naibu.core.arrays import FloatArray

PRIOR_SD = 1.0  # of the logarithms of moduli about those of the largest region, or of clusters' means while merging
MODERATE = 1.5  # jump of a logarithm from which a fit of borders starts at most


@dataclass(frozen=True, slots=True, eq=False)
class ContrastPrior:
    """Half the sum of squared differences of logarithms of moduli from those of the region number `largest`, over their variance."""

    largest: int
    name: str = "normal prior of contrasts"

    def value(self, theta: FloatArray) -> float:
        """Return the penalty."""
        return float(0.5 * theta @ (self.hessian(theta) @ theta))

    def gradient(self, theta: FloatArray) -> FloatArray:
        """Return its gradient (2 count,)."""
        return np.asarray(self.hessian(theta) @ theta)

    def hessian(self, theta: FloatArray) -> sp.csr_matrix:
        """Return its Hessian (2 count, 2 count)."""
        away = np.eye(len(theta) // 2)
        away[:, self.largest] -= 1.0
        return sp.csr_matrix(np.kron(np.eye(2), away.T @ away) / PRIOR_SD**2)


def moderated(theta: FloatArray, largest: int) -> FloatArray:
    """Return logarithms of moduli (2 count,) that differ from those of the region number `largest` by no more than `MODERATE`."""
    values = theta.reshape(2, -1)
    middle = values[:, largest, None]
    return np.asarray((middle + np.clip(values - middle, -MODERATE, MODERATE)).ravel())
