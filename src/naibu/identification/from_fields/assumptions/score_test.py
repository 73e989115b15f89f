"""Score tests of another assumption against the best fit, errors of elements beside it (:cite:t:`rao1948`).

Another assumption changes the model's displacement in some direction; moduli and the motion of the loaded nodes follow. How far the
field asks to go in that direction, and with what standard error, is found to first order. Errors of elements may resemble it; how large
they are is sought as well.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from scipy.special import chdtrc

from naibu.core.arrays import BoolArray, FloatArray
from naibu.identification.from_fields.assumptions.assumed_law import UNLIKELY
from naibu.identification.from_fields.forward.sensitivities import Concentrated, Linearised
from naibu.identification.from_fields.inversion.told_combinations import told
from naibu.identification.from_fields.mesh_error import Refit, refitted

Direction = TypeVar("Direction")

MOST_OF_RATIO = 1.0  # change of ln(kappa / mu) that counts: near incompressibility it may be any, to first order


@dataclass(frozen=True, slots=True, eq=False)
class Asked:
    """What a field says of a direction.

    Attributes
    ----------
    part : float
        How far it asks to go, 1 for the change that was given.
    size : float
        Inverse variance of `part` for whitened residuals of unit variance, independent of each other.
    theta : ndarray, shape (2 count,)
        By how much ln mu and ln(kappa / mu) of the zones change with the whole of it, but for combinations of these without bounds.
    of_elements : float
        By how much elements of half the size change `part` where their error is not taken off.
    """

    part: float
    size: float
    theta: FloatArray
    of_elements: float

    @property
    def fall(self) -> float:
        """By how much chi squared falls with it."""
        return self.part**2 * self.size

    def score(self, variance: float) -> float:
        """Return the score for whitened residuals of a variance, errors of elements counted: chi squared of one freedom by chance."""
        return self.part**2 / (variance / self.size + self.of_elements**2)

    def shift(self, stretch: FloatArray, part: float | None = None) -> FloatArray:
        """Return by how much logarithms (2 count,) would change with `part`, all that is asked by default.

        At vanishing element size they change by `stretch` (2 count,) as much; of the ratios `MOST_OF_RATIO` counts at most.
        """
        most = np.repeat([np.inf, MOST_OF_RATIO], len(stretch) // 2)
        return np.asarray(np.clip((self.part if part is None else part) * stretch * self.theta, -most, most))


@dataclass(frozen=True, slots=True, eq=False)
class ScoreTest:
    """The best fit, with what it leaves (2, n) and what of that elements change; see `_left`."""

    at: Linearised
    quadratic: Concentrated
    theta: FloatArray
    left: FloatArray
    errors: FloatArray

    @classmethod
    def of(cls, at: Linearised, quadratic: Concentrated, finer: Sequence[FloatArray] | None) -> ScoreTest:
        """Begin at the best fit; `finer` are whitened residuals (q,) on elements of half the size, None where there are none."""
        given = refitted(at, quadratic, [np.zeros(len(o.data)) for o in at.model.observed])
        left = _left(at, given)
        errors = np.zeros_like(left)
        if finer is not None:
            pairs = zip(at.model.observed, at.point.states, finer, strict=True)
            errors = _left(at, refitted(at, quadratic, [r - o.residual(u) for o, u, r in pairs])) - left
        return cls(at, quadratic, given.theta, left, errors)

    def of_residuals(self, changes: list[FloatArray]) -> Asked | None:
        """Return what the residuals alone say of changes (q,) of them, whatever the motion of the loaded nodes does."""
        return self.along(changes, [np.ones(len(o.data), dtype=bool) for o in self.at.model.observed])

    def along(self, changes: list[FloatArray], counted: Sequence[BoolArray] | None = None) -> Asked | None:
        """Return what the field says of changes (q,) of the whitened residuals; None where moduli and motion make up for all of them.

        Where only some of the residuals (q,) are `counted`, the motion of the loaded nodes is not.
        """
        changed = refitted(self.at, self.quadratic, changes)
        left, errors, slope = self.left, self.errors, _left(self.at, changed) - self.left
        if counted is not None:
            rows = np.flatnonzero(np.concatenate(counted))
            left, errors, slope = left[:, rows], errors[:, rows], slope[:, rows]
        whole, slope = slope, _beside(slope, errors)
        size = _product(slope, slope)
        if not size > 0.0:
            return None
        of_elements = -_product(errors, whole) / _product(whole, whole)
        kept = told(self.quadratic.hessian)[1]
        return Asked(-_product(left, slope) / size, size, kept @ (kept.T @ (changed.theta - self.theta)), of_elements)


def most_asked(found: Mapping[Direction, Asked | None], variance: float) -> tuple[Direction, Asked] | None:
    """Return the direction that a field asks for most of those that were tried, None where chance or errors of elements give as much.

    Parameters
    ----------
    found : mapping
        What the field says of each of them; None counts as tried.
    variance : float
        Of whitened residuals, errors that neighbours share counted.
    """
    there = [(direction, one) for direction, one in found.items() if one is not None]
    best = max(there, key=lambda each: each[1].score(variance), default=None)
    # of the largest of so many by chance, at most
    return best if best is not None and len(found) * float(chdtrc(1, best[1].score(variance))) < UNLIKELY else None


def _left(at: Linearised, refit: Refit) -> FloatArray:
    """Return what a refit leaves (2, n): whitened residuals and the motion of the loaded nodes, that in the second row times its prior."""
    motions = [o.sought(u + moved) for o, u, moved in zip(at.model.observed, at.point.states, refit.moved, strict=True)]
    dual = [o.prior @ b for o, b in zip(at.model.observed, motions, strict=True)]
    return np.stack([np.concatenate([*refit.residuals, *motions]), np.concatenate([*refit.residuals, *dual])])


def _product(one: FloatArray, other: FloatArray) -> float:
    return float(one[0] @ other[1])


def _beside(rows: FloatArray, errors: FloatArray) -> FloatArray:
    """Return rows (2, n) without what resembles errors of elements."""
    size = _product(errors, errors)
    return np.asarray(rows - _product(errors, rows) / size * errors) if size > 0.0 else rows
