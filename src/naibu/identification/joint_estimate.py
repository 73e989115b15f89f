"""Estimates of several kinds of data that share parameters, as one: the weighted least squares of their normal approximations.

Each kind of data is fitted by itself. About its own optimum half of its chi squared is a quadratic, so that the sum of all has its least
value where generalized least squares puts it, and parameters that only one kind knows move along by their covariances. Where the estimates
contradict each other by more than their covariances allow, all are widened by the ratio of :cite:t:`birge1932`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError

CONTRADICTED = 0.01  # probability of so large a chi squared, below which estimates contradict each other
UNDETERMINED = 1e6  # standard deviation of a logarithm from which an estimate says nothing


@dataclass(frozen=True, slots=True, eq=False)
class NormalEstimate:
    """Parameters as one kind of data tells them.

    Attributes
    ----------
    names : tuple of str
        Of the parameters.
    values : ndarray, shape (k,)
        Estimates, on scales on which they are about normally distributed, such as logarithms.
    covariance : ndarray, shape (k, k)
        Of them; infinite on the diagonal where the data tell nothing.
    """

    names: tuple[str, ...]
    values: FloatArray
    covariance: FloatArray

    def standard_deviation(self, name: str) -> float:
        """Return that of a parameter; infinite where it is not among them."""
        return float(np.sqrt(self.covariance[i, i])) if (i := _index(self.names, name)) >= 0 else np.inf

    def value(self, name: str) -> float:
        """Return the estimate of a parameter; NaN where it is not among them."""
        return float(self.values[i]) if (i := _index(self.names, name)) >= 0 else np.nan


@dataclass(frozen=True, slots=True, eq=False)
class JointEstimate:
    """What several kinds of data tell together.

    Attributes
    ----------
    together : NormalEstimate
        All parameters.
    shared : tuple of str
        Those of which more than one kind of data tells something.
    chi_squared : float
        By how much the kinds contradict each other, in units of their covariances.
    degrees_of_freedom : int
        Its mean if they do not.
    widened : float
        Factor on all standard deviations, 1 where they do not contradict each other.
    """

    together: NormalEstimate
    shared: tuple[str, ...]
    chi_squared: float
    degrees_of_freedom: int
    widened: float

    @property
    def contradicted(self) -> bool:
        """Whether the kinds of data contradict each other."""
        return self.widened > 1.0


def joint_estimate(estimates: Sequence[NormalEstimate]) -> JointEstimate:
    """Return the estimate from several independent kinds of data.

    Parameters
    ----------
    estimates : sequence of NormalEstimate
        Of each kind by itself; parameters of one name are one.

    Raises
    ------
    InputError
        No parameter of which more than one kind tells something.
    """
    kept = [_determined(e) for e in estimates]
    names = tuple(dict.fromkeys(name for e in kept for name in e.names))
    shared = tuple(n for n in names if sum(n in e.names for e in kept) > 1)
    if not shared:
        told = "; ".join(", ".join(e.names) or "nothing" for e in kept)
        raise InputError(f"no parameter is told by more than one kind of data, so that nothing joins them; they tell {told}")
    information, right = np.zeros((len(names), len(names))), np.zeros(len(names))
    chosen = [np.array([names.index(n) for n in e.names]) for e in kept]
    weights = [np.linalg.inv(e.covariance) for e in kept]
    for at, weight, e in zip(chosen, weights, kept, strict=True):
        information[np.ix_(at, at)] += weight
        right[at] += weight @ e.values
    covariance: FloatArray = np.linalg.inv(information).astype(np.float64)
    values = covariance @ right
    left = [values[at] - e.values for at, e in zip(chosen, kept, strict=True)]
    chi_squared = sum(float(r @ w @ r) for r, w in zip(left, weights, strict=True))
    freedom = sum(len(e.names) for e in kept) - len(names)
    widened = float(np.sqrt(chi_squared / freedom)) if chdtrc(freedom, chi_squared) < CONTRADICTED else 1.0
    return JointEstimate(
        NormalEstimate(names, values, np.asarray(covariance * widened**2, dtype=np.float64)), shared, chi_squared, freedom, widened
    )


def moved_along(
    values: FloatArray, covariance: FloatArray, slope: FloatArray, own: NormalEstimate, together: NormalEstimate
) -> tuple[FloatArray, FloatArray]:
    """Return all parameters of a model, and their covariance, once what other data told of some of them is known too.

    The model's own data tell nothing else, so that its other parameters follow those that are shared by their regression on them.

    Parameters
    ----------
    values, covariance : ndarray, shape (n,), (n, n)
        Parameters of the model as its own data tell them.
    slope : ndarray, shape (k, n)
        Derivatives of the shared parameters by them.
    own : NormalEstimate
        The k shared parameters as these data tell them.
    together : NormalEstimate
        What all data tell; what is not among it stays as it is.
    """
    kept = [i for i, name in enumerate(own.names) if name in together.names and 0.0 < own.standard_deviation(name) < UNDETERMINED]
    at = np.array([together.names.index(own.names[i]) for i in kept], dtype=np.int64)
    across = covariance @ slope[kept].T
    spread = slope[kept] @ across
    gain = np.linalg.solve(spread, across.T).T
    moved = values + gain @ (together.values[at] - own.values[kept])
    changed = covariance + gain @ (together.covariance[np.ix_(at, at)] - spread) @ gain.T
    return np.asarray(moved, dtype=np.float64), np.asarray(0.5 * (changed + changed.T), dtype=np.float64)


def _determined(e: NormalEstimate) -> NormalEstimate:
    sd = np.sqrt(np.diag(e.covariance))
    kept = np.flatnonzero(np.isfinite(sd) & (sd < UNDETERMINED) & (sd > 0.0))
    return NormalEstimate(tuple(e.names[i] for i in kept), e.values[kept], e.covariance[np.ix_(kept, kept)])


def _index(names: Sequence[str], name: str) -> int:
    return names.index(name) if name in names else -1
