"""Steps of the Gauss-Newton search within bounds that follow how well the quadratic model has foretold the last step.

The bounds are a box about the present parameters whose size is adapted like the radius of a trust region (:cite:p:`nocedal2006`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.parameters import Parameter

WIDEST_STEP = 3.0  # of an unknown on a linear scale: mm for positions
SHORTEST_REACH = 0.1  # of the largest changes of the parameters in one step


def next_reach(reach: float, kept: float) -> float:
    """Factor on the largest changes in the next step after one that kept this fraction of its promise: steps too long alternate."""
    return max(0.5 * reach, SHORTEST_REACH) if kept < 0.25 else min(1.0, 2.0 * reach) if kept > 0.75 else reach


def step_limits(free: Sequence[Parameter], rough: bool) -> FloatArray:
    """Largest change of each free parameter in one step, on the optimiser's scale: values far from the prior are approached slowly.

    While the search is `rough`, parameters with narrow priors (tilts, offsets) are fixed, lest they compensate a wrong height.
    """
    limits = np.array([{"log": 1.0, "incompressibility": 1.5}.get(q.scale, min(q.prior_sd, WIDEST_STEP)) for q in free])
    nearly_known = np.array([q.scale == "linear" and q.prior_sd < WIDEST_STEP for q in free])
    return np.where(nearly_known & rough, 0.0, limits)


def bounded_step(hessian: FloatArray, gradient: FloatArray, limits: FloatArray) -> FloatArray:
    """Minimise the quadratic model with the first unknowns within +-`limits`: those that would go further stay at their limit."""
    step = np.zeros(len(gradient))
    loose = np.ones(len(gradient), dtype=bool)
    bound = np.concatenate([limits, np.full(len(gradient) - len(limits), np.inf)])
    while loose.any():
        rest = gradient[loose] - hessian[np.ix_(loose, ~loose)] @ step[~loose]
        step[loose] = np.linalg.solve(hessian[np.ix_(loose, loose)], rest)
        over = loose & (np.abs(step) > bound)
        if not over.any():
            break
        step[over] = np.sign(step[over]) * bound[over]
        loose &= ~over
    return step
