"""Faster convergence of repeated steps that each leave a fixed share of an error."""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import AnyFloatArray, FloatArray

DEPTH = 2  # deeper ones gain nothing: empirical, on textured balls


class MixedSteps:
    """Anderson acceleration :cite:p:`walker2011` of steps, from what they change.

    Robust weights follow the residuals, and the matrix has their curvature only in part: by themselves such steps leave a share of an
    error.

    Parameters
    ----------
    depth : int
        Number of earlier steps that are used, 1 or more.
    """

    def __init__(self, depth: int = DEPTH) -> None:
        self._depth = depth
        self._own: list[AnyFloatArray] = []
        self._changes: list[FloatArray] = []
        self._taken: list[AnyFloatArray] = []

    def mixed(self, own: AnyFloatArray, change: FloatArray) -> AnyFloatArray:
        """Return the step to take, in place of one (any shape) that by itself would `change` (m,) what is to become right."""
        self._own, self._changes = [*self._own, own][-self._depth - 1 :], [*self._changes, change][-self._depth - 1 :]
        taken = own
        if len(self._own) > 1:
            share = np.linalg.lstsq(np.diff(np.stack(self._changes, axis=1), axis=1), change, rcond=None)[0]
            for part, before, first, second in zip(share, self._taken, self._own[:-1], self._own[1:], strict=True):
                taken = taken - own.dtype.type(part) * (before + second - first)
        self._taken = [*self._taken, taken][-self._depth :]
        return taken
