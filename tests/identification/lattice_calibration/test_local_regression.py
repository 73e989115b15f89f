"""Estimates from residuals that jump, against the truth that made them, and against least squares where nothing jumps."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import uniform_filter1d

from naibu.identification.lattice_calibration.intervals.local_regression import (
    WORTH,
    LocalRegression,
    Pair,
    Regression,
    _of_another,
    regression,
)
from naibu.identification.lattice_calibration.least_squares import unsettled_covariance
from naibu.identification.lattice_calibration.simulated_points import SimulatedPoints

COUNT, PRIOR_SD, ALIKE = 2000, 3.0, 25


class Jumping:
    """Residuals of a law that jumps by a random vector of its own wherever it is evaluated, and so did where the measurements were made."""

    def __init__(self, seed: int, sensitivity: list[float], jump: float, *, noise: float = 1.0, offset: float = 0.0, bend: float = 0.0):
        self.rng, self.jump, self.offset, self.bend, p = np.random.default_rng(seed), jump, offset, bend, len(sensitivity)
        self.slopes = self.rng.standard_normal((COUNT, p)) * sensitivity
        self.directions = self.rng.standard_normal((4, COUNT))  # residuals jump together
        self.truth = 0.05 * self.rng.standard_normal(p)
        self.constant = self.rng.standard_normal(COUNT)
        self.measured = self._law(self.truth, fine=True) + noise * self.rng.standard_normal(COUNT)
        self.unknowns = SimpleNamespace(held=lambda values: values)

    def _law(self, theta: np.ndarray, *, fine: bool) -> np.ndarray:
        own = np.random.default_rng(np.frombuffer(theta.tobytes(), np.uint32)).standard_normal(4)
        smooth = self.slopes @ theta + self.bend * (self.slopes @ theta) ** 2 + (0.0 if fine else self.offset) * self.constant
        return np.asarray(smooth + self.jump * own @ self.directions)

    def many(self, _: Any, trials: list[tuple[np.ndarray, bool]]) -> list[tuple[np.ndarray, np.ndarray]]:
        found = [self._law(theta, fine=fine) - self.measured for theta, fine in trials]
        return [(r[: COUNT // 2], r[COUNT // 2 :]) for r in found]

    def estimated(self, begin: np.ndarray | None = None, prior_sd: float = PRIOR_SD) -> tuple[np.ndarray, np.ndarray, bool]:
        """Return errors and standard deviations, and whether the regressions settled; they begin in the centre of the prior, zero."""
        p, points = len(self.truth), SimulatedPoints(self, self)  # type: ignore[arg-type]
        begin = np.zeros(p) if begin is None else begin
        local = LocalRegression(points, begin, points.simulated([(begin, False)])[0], np.zeros(p), prior_sd, 0.03**2 * np.eye(p))
        point, covariance = local.run()
        return point.theta - self.truth, np.sqrt(np.diag(covariance)), local.settled


def test_without_jumps_it_is_least_squares() -> None:
    made = Jumping(0, [0.3, 1.0, 2.0], 0.0)
    base = made._law(np.zeros(3), fine=True) - made.measured
    pairs = []
    for row in 0.03 * np.random.default_rng(1).standard_normal((20, 3)):
        one, other = (made._law(side * row, fine=True) - made.measured for side in (1.0, -1.0))
        pairs.append(Pair(np.log1p([row, -row]), 0.5 * (one - other), 0.5 * (one + other) - base))
    fit = regression(pairs, np.zeros(3), base, COUNT // 2, 0.03**2 * np.eye(3), np.zeros(3), PRIOR_SD)
    hessian = made.slopes.T @ made.slopes + np.eye(3) / PRIOR_SD**2
    np.testing.assert_allclose(fit.steps[0], -np.linalg.solve(hessian, made.slopes.T @ base), rtol=1e-6)
    np.testing.assert_allclose(fit.slopes, made.slopes, atol=1e-8)
    np.testing.assert_allclose(fit.covariance, np.linalg.inv(hessian), rtol=1e-5, atol=1e-9)


def test_intervals_hold_where_residuals_jump_together() -> None:
    """In 40 draws of three parameters 114 of 120 truths are expected within, or more: what jumps tell is rather under- than overrated."""
    found = [Jumping(seed, [0.5, 1.0, 2.0], 0.03, offset=0.3).estimated() for seed in range(40)]
    held = np.array([np.abs(error) < 1.96 * sd for error, sd, settled in found if settled])
    assert len(held) > 0.8 * len(found)
    assert held.mean() >= 0.93


@pytest.mark.parametrize(("promising", "ends"), [(5.0, False), (0.005, True)])
def test_a_search_whose_steps_bring_nothing_ends_only_where_they_promise_nothing(promising: float, ends: bool) -> None:
    """Residuals do not change at all here, whatever derivatives say: with steps that fail, chi-squared falls no longer either."""
    made, zero, step = Jumping(0, [0.0, 0.0], 0.0), np.zeros(2), np.array([-0.05, 0.0])
    points = SimulatedPoints(made, made)  # type: ignore[arg-type]
    long = points.simulated([(zero, False)])[0]
    local = LocalRegression(points, zero, long, zero, PRIOR_SD, 0.03**2 * np.eye(2))
    local._offset = np.zeros(COUNT)
    slopes = np.column_stack([promising * long, np.zeros(COUNT)])
    fit = Regression((step, step), step, 0.03**2 * np.eye(2), slopes, np.ones(COUNT), 1.0, 5)
    assert (local._move(fit, 0.06**2 * np.eye(2)) < WORTH * 2) is ends


class Lacking(Jumping):
    """Forces that the law lacks for a while, and derivatives of forces that are alike in neighbouring windows."""

    def __init__(self, seed: int):
        super().__init__(seed, [0.5, 1.0, 2.0], 0.0)
        forces = slice(COUNT // 2, None)
        before = self.measured[forces] - self._law(self.truth, fine=True)[forces]
        self.slopes[forces] = uniform_filter1d(self.slopes[forces], ALIKE, axis=0) * np.sqrt(ALIKE)
        lack = uniform_filter1d(self.rng.standard_normal(COUNT // 2), ALIKE) * np.sqrt(ALIKE)
        self.measured[forces] = self._law(self.truth, fine=True)[forces] + before + 2.0 * lack


def test_intervals_hold_where_what_forces_lack_is_alike_in_neighbouring_windows() -> None:
    found = [Lacking(seed).estimated() for seed in range(40)]
    held = np.array([np.abs(error) < 1.96 * sd for error, sd, settled in found if settled])
    assert len(held) > 0.8 * len(found)
    assert held.mean() >= 0.93


def test_an_offset_of_long_steps_is_corrected() -> None:
    error, sd, settled = Jumping(3, [0.5, 1.0, 2.0], 0.0, offset=3.0).estimated()
    assert settled
    assert (np.abs(error) < 3.0 * sd).all()


def test_what_jumps_alone_move_is_not_determined() -> None:
    _, sd, _ = Jumping(4, [0.0, 1.0], 0.5).estimated()
    assert sd[0] > 0.5


@pytest.mark.parametrize("away", [-2.6, 2.6])
def test_what_is_not_determined_holds_what_the_prior_holds_wherever_the_search_ended(away: float) -> None:
    """A search may go a factor of 13 away along a parameter that the data say nothing of: 95 % of the prior are within the interval."""
    error, sd, settled = Jumping(4, [0.0, 1.0], 0.03).estimated(np.array([away, 0.0]), prior_sd=1.2)
    assert settled
    assert np.sign(away) * error[0] > 1.5
    assert 1.96 * sd[0] > np.abs(error[0]) + 1.64 * 1.2
    assert sd[1] < 0.5


def test_where_a_search_did_not_come_to_rest_intervals_hold_what_the_prior_holds() -> None:
    """However far from the middle of the prior it ended, as in a calibration that ended up to four logarithms away."""
    rng, centre, prior_sd = np.random.default_rng(0), np.array([0.0, 1.0, -2.0]), 1.2
    truth = centre + prior_sd * rng.standard_normal((20_000, 3))
    for away in (0.0, 2.0, 4.0):
        theta = centre + away
        half = 1.96 * np.sqrt(np.diag(unsettled_covariance(theta, centre, prior_sd)))
        assert (np.mean(np.abs(truth - theta) < half, axis=0) > 0.945).all()


@pytest.mark.parametrize("count", [3, 6])
def test_what_few_errors_tell_of_another_one_holds_it_in_95_of_100(count: int) -> None:
    drawn = np.random.default_rng(8).standard_normal((200_000, count + 1))
    known, other = drawn[:, :-1], drawn[:, -1]
    about = ((known - known.mean(axis=1, keepdims=True)) ** 2).sum(axis=1)
    half = 1.96 * np.sqrt(about * (1.0 / (count - 1) + _of_another(count)))
    assert np.mean(np.abs(other - known.mean(axis=1)) < half) == pytest.approx(0.95, abs=0.002)
