"""Normal priors of how much regions differ from the largest one, and of where their borders are.

A lump of too few cells fits best nearly empty, or rigid, where data no longer say how much, and nothing leads from there to a larger
lump of a lower contrast. While regions are sought the prior is the narrower one; that of fits with their borders leaves factors of tens
open. What the data alone say of the moduli, given the borders, is part of the intervals without any prior.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from naibu.core.arrays import FloatArray

PRIOR_SD = 1.0  # of the logarithms of moduli about those of the largest region, or of clusters' means while merging
SD_WITH_BORDERS = 1.5  # of them where borders are fitted as well
MODERATE = 1.5  # jump of a logarithm from which a fit of borders starts at most


@dataclass(frozen=True, slots=True, eq=False)
class ContrastPrior:
    """Half the sum of squared differences of logarithms of moduli from those of the region number `largest`, over the square of `sd`."""

    largest: int
    sd: float = PRIOR_SD
    name = "normal prior of contrasts"

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
        return sp.csr_matrix(np.kron(np.eye(2), away.T @ away) / self.sd**2)


@dataclass(frozen=True, slots=True, eq=False)
class BorderPrior:
    """Of logarithms of moduli (2 regions,), and of moves of borders about `moves` (j,), mm, with the edge of cells for their deviation."""

    moves: FloatArray
    edge_mm: float

    def value(self, theta: FloatArray, moves: FloatArray) -> float:
        """Return half the squares over their variances."""
        away = (moves - self.moves) / self.edge_mm
        return ContrastPrior(0, SD_WITH_BORDERS).value(theta) + 0.5 * float(away @ away)

    def gradient(self, theta: FloatArray, moves: FloatArray) -> FloatArray:
        """Return its gradient (2 regions + j,)."""
        return np.concatenate([ContrastPrior(0, SD_WITH_BORDERS).gradient(theta), (moves - self.moves) / self.edge_mm**2])

    def hessian(self, theta: FloatArray) -> FloatArray:
        """Return its Hessian (2 regions + j, 2 regions + j)."""
        of_moves = np.full(len(self.moves), self.edge_mm**-2.0)
        return np.asarray(sp.block_diag([ContrastPrior(0, SD_WITH_BORDERS).hessian(theta), sp.diags(of_moves)]).toarray())


def moderated(theta: FloatArray, largest: int, part: float = 1.0) -> FloatArray:
    """Return logarithms of moduli (2 count,) that differ from those of the region `largest` by a part of before, at most of `MODERATE`."""
    values = theta.reshape(2, -1)
    middle = values[:, largest, None]
    return np.asarray((middle + part * np.clip(values - middle, -MODERATE, MODERATE)).ravel())
