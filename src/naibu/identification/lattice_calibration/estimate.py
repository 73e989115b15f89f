"""Identified parameters of a lattice, with covariance and intervals."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray
from naibu.identification.lattice_calibration.evaluation import EvaluatedPoint
from naibu.identification.lattice_calibration.inverse_problem import InverseProblem, Unknowns
from naibu.identification.lattice_calibration.least_squares import (
    Evaluations,
    covariance_before_the_minimum,
    noise_factors,
    unsettled_covariance,
)
from naibu.identification.lattice_calibration.unknowns import identifiability
from naibu.identification.verdict import UNDETERMINED

IMPROVED = (
    "Intervals rest on derivatives that steps of the search improved, a few percent off, and are not widened to where chi-squared itself "
    "rises."
)
NOT_TOLD = "Nothing told how exact the values are: intervals hold what the weak prior holds."
CUT_SHORT = "The search was interrupted before anything told how exact its values are: intervals hold what the weak prior holds."


@dataclass(frozen=True, slots=True, eq=False)
class LatticeEstimate:
    """Identified lattice parameters with their covariance.

    Attributes
    ----------
    unknowns : LatticeUnknowns or StudyUnknowns
        What was sought.
    values : ndarray, shape (p,)
        mN/mm and mN s/mm.
    covariance : ndarray, shape (p, p)
        Of their logarithms; weak priors around the start included. Widened to where chi-squared itself rises by its 95 % quantile as a
        parameter changes and all others are fitted again (not in contact).
    information : ndarray, shape (p, p)
        Fisher information of the data alone.
    noise_factor : tuple of float
        Root mean square residual of points and of forces in units of the stated noise; NaN where they did not count.
    iterations, runs : int
        Gauss-Newton iterations, and simulated pushings; one with derivatives counts as 1 + p.
    undetermined : tuple of str
        In words, the combinations that the data do not determine.
    finished : bool
        Whether the search came to its end; otherwise Ctrl-C left the best so far.
    settled : bool
        Whether it came to rest there; otherwise the covariance holds what the weak prior holds.
    remarks : tuple of str
        In words, what the intervals rest on where they are not those that are described here.
    """

    unknowns: Unknowns
    values: FloatArray
    covariance: FloatArray
    information: FloatArray
    noise_factor: tuple[float, float]
    iterations: int
    runs: int
    undetermined: tuple[str, ...]
    finished: bool = True
    settled: bool = True
    remarks: tuple[str, ...] = ()

    def parameters(self) -> Any:
        """Return the parameters of all elements; of a study, a `naibu.identification.Trial`."""
        return self.unknowns.parameters(self.values)

    def intervals(self) -> FloatArray:
        """Return the 95 % intervals (p, 2) of all values."""
        half = 1.96 * np.sqrt(np.diag(self.covariance))
        return np.stack([self.values * np.exp(-half), self.values * np.exp(half)], axis=1)

    def determined(self) -> BoolArray:
        """Return which parameters (p,) the data determine within a factor of 4 at 95 %; of others little more is known than beforehand."""
        return np.asarray(1.96 * np.sqrt(np.diag(self.covariance)) <= np.log(UNDETERMINED))

    def sentences(self) -> tuple[str, ...]:
        """Return the result in sentences, what the data do not determine, and what the intervals rest on."""
        lines = []
        rows = zip(self.unknowns.names, self.unknowns.units, self.values, self.intervals(), self.determined(), strict=True)
        for name, unit, value, (low, high), known in rows:
            said = f"{value:.4g} {unit}".rstrip() if known else "not determined"
            lines.append(f"{name}: {said} (95 % between {low:.4g} and {high:.4g})")
        return (*lines, *self.undetermined, *self.remarks)


def estimate_from(
    problem: InverseProblem, point: EvaluatedPoint, covariance: FloatArray, iterations: int, runs: int, *, finished: bool = True
) -> LatticeEstimate:
    """Return the estimate at a point, with a covariance (p, p); `runs` are simulations of one load case."""
    factors = noise_factors(problem, point.residual)
    shown = tuple(f if len(r) else np.nan for f, r in zip(factors, point.residual, strict=True))
    return LatticeEstimate(
        problem.unknowns, np.exp(point.theta), covariance, point.information, (shown[0], shown[1]), iterations,
        runs * len(problem.load_cases), identifiability(problem.unknowns.names, point.information), finished,
    )  # fmt: skip


def without_intervals(
    problem: InverseProblem, point: EvaluatedPoint, centre: FloatArray, prior_sd: float, at: Evaluations
) -> LatticeEstimate:
    """Return a point at which a search stopped before anything told how exact it is: intervals hold what the weak prior holds."""
    covariance = unsettled_covariance(point.theta, centre, prior_sd)
    found = estimate_from(problem, point, covariance, at.count, at.runs, finished=False)
    nothing = np.zeros_like(covariance)
    return replace(found, information=nothing, undetermined=identifiability(problem.unknowns.names, nothing), settled=False)


def interrupted_estimate(
    problem: InverseProblem, point: EvaluatedPoint, centre: FloatArray, prior_sd: float, at: Evaluations
) -> LatticeEstimate:
    """Return the best so far; its derivatives may be those of steps, and in contact they count jumps as information."""
    if problem.shifts(np.exp(point.theta)) is not None:
        return replace(without_intervals(problem, point, centre, prior_sd, at), remarks=(CUT_SHORT,))
    covariance = covariance_before_the_minimum(point, centre, prior_sd)
    return replace(estimate_from(problem, point, covariance, at.count, at.runs, finished=False), remarks=(IMPROVED,))
