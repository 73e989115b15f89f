"""Intervals along a curved valley of chi-squared against its profile in closed form, and of linear models against least squares."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from naibu.identification.lattice_calibration.evaluation import EvaluatedPoint, Residual
from naibu.identification.lattice_calibration.intervals.residual_model import BOX, RISE, ResidualModel
from naibu.identification.lattice_calibration.intervals.widened_covariance import FARTHEST, widened_covariance

WEAK_PRIOR = 100.0


class Sum:
    """Two values whose sum, 2, is determined by a thousandth, and the logarithm of whose ratio, 0, by `sd` only."""

    def __init__(self, sd: float, offset: float = 0.0):
        self.sd, self.offset, self.runs = sd, offset, 0

    def residual(self, theta: np.ndarray, *, fine: bool = False) -> Residual:
        wrong = 0.0 if fine else self.offset
        return np.array([1e3 * (np.exp(theta).sum() - 2.0) + wrong]), np.array([(theta[0] - theta[1]) / self.sd + wrong])

    def point(self) -> EvaluatedPoint:
        slopes = (np.array([[1e3, 1e3]]), np.array([[1.0, -1.0]]) / self.sd)
        return EvaluatedPoint(np.zeros(2), self.residual(np.zeros(2), fine=True), slopes)

    def many(self, _: Any, trials: list[tuple[np.ndarray, bool]]) -> list[Residual]:
        self.runs += len(trials)
        return [self.residual(theta, fine=fine) for theta, fine in trials]


class Linear:
    """Residuals that are linear in logarithms."""

    runs = 0

    def __init__(self, slopes: np.ndarray):
        self.slopes = slopes

    def many(self, _: Any, trials: list[tuple[np.ndarray, bool]]) -> list[Residual]:
        self.runs += len(trials)
        return [(self.slopes[:5] @ theta, self.slopes[5:] @ theta) for theta, _ in trials]


@pytest.mark.parametrize("sd", [0.1, 0.25, 0.4, 0.5, 0.6])
@pytest.mark.parametrize("offset", [0.0, 3.0])
def test_intervals_reach_to_the_end_of_the_profile_along_a_curved_valley(sd: float, offset: float) -> None:
    """On K1 + K2 = 2 the logarithm d of the ratio rises to 1.96 sd: K1 = 2 / (1 + exp(d)) there; derivatives say exp(-d / 2)."""
    law = Sum(sd, offset)
    widened = widened_covariance(law, law.point(), np.zeros(2), WEAK_PRIOR, law)  # type: ignore[arg-type]
    d = np.sqrt(RISE) * sd
    expected = np.log((1.0 + np.exp(d)) / 2.0)
    np.testing.assert_allclose(1.96 * np.sqrt(np.diag(widened.covariance)), expected, rtol=0.02)
    assert expected > (1.02 if sd < 0.2 else 1.1) * d / 2.0  # what derivatives say is too little
    assert law.runs < 40
    assert bool(widened.unconfirmed) == (expected > FARTHEST)  # up to there chi-squared is followed


class Branches:
    """Two valleys, in relative changes x and y: x + y is determined to `SD`, y is 0 or `BETWEEN`, where chi-squared is higher by 2."""

    BETWEEN, SD, runs = 0.2, 0.025, 0

    def residual(self, theta: np.ndarray) -> Residual:
        x, y = np.expm1(theta)
        return np.array([(x + y) / self.SD, np.sqrt(2.0) * y / self.BETWEEN]), np.array([200.0 * y * (y - self.BETWEEN)])

    def point(self) -> EvaluatedPoint:
        slopes = (np.array([[1.0, 1.0], [0.0, self.SD * np.sqrt(2.0) / self.BETWEEN]]) / self.SD, np.array([[0.0, -200.0 * self.BETWEEN]]))
        return EvaluatedPoint(np.zeros(2), self.residual(np.zeros(2)), slopes)

    def many(self, _: Any, trials: list[tuple[np.ndarray, bool]]) -> list[Residual]:
        self.runs += len(trials)
        return [self.residual(theta) for theta, _ in trials]

    def profile(self, k: int) -> np.ndarray:
        """Return the farthest places, down and up, where chi-squared is within its quantile: on a grid."""
        x, y = np.meshgrid(np.linspace(-0.4, 0.4, 1601), np.linspace(-0.4, 0.4, 1601), indexing="ij")
        (first, second), (third,) = ((x + y) / self.SD, np.sqrt(2.0) * y / self.BETWEEN), (200.0 * y * (y - self.BETWEEN),)
        within = np.log1p((x, y)[k][first**2 + second**2 + third**2 < RISE])
        return np.array([within.min(), within.max()])


def test_intervals_reach_to_values_that_fit_as_well_beyond_others_that_do_not() -> None:
    """Between the valleys chi-squared rises above its quantile, whatever the other value: the first crossing is no end."""
    law = Branches()
    widened = widened_covariance(law, law.point(), np.zeros(2), WEAK_PRIOR, law)  # type: ignore[arg-type]
    expected = [np.abs(law.profile(k)).max() for k in range(2)]
    assert expected[0] > 4.0 * 1.96 * law.SD
    np.testing.assert_allclose(1.96 * np.sqrt(np.diag(widened.covariance)), expected, rtol=0.03)
    assert widened.unconfirmed == ()
    assert law.runs < 40


def test_ends_that_no_simulation_confirms_are_told_and_not_drawn_in() -> None:
    """The profile rises to its quantile far beyond where it is followed."""
    law = Sum(5.0)
    widened = widened_covariance(law, law.point(), np.zeros(2), WEAK_PRIOR, law)  # type: ignore[arg-type]
    derivatives = np.sqrt(RISE) * 5.0 / 2.0
    assert (1.96 * np.sqrt(np.diag(widened.covariance)) > 0.99 * derivatives).all()
    assert widened.unconfirmed == (0, 1)
    assert "ends of the intervals of K1, K2" in widened.remarks(("K1", "K2"))[0]


class Valley(Linear):
    """Residuals of a valley in which chi-squared is lower by 100 beyond a step of the logarithm of 0.3."""

    def many(self, at: Any, trials: list[tuple[np.ndarray, bool]]) -> list[Residual]:
        found = super().many(at, trials)
        return [(np.append(a, 10.0 * (theta[0] < 0.3)), b) for (a, b), (theta, _) in zip(found, trials, strict=True)]


def test_a_better_fit_beyond_the_end_of_an_interval_is_told() -> None:
    law = Valley(np.diag([5.0] * 5 + [0.0])[:, :5])
    zero, slopes = np.zeros(5), np.vstack([law.slopes[:5], np.zeros(5)])
    point = EvaluatedPoint(zero, (np.append(np.zeros(5), 10.0), np.zeros(1)), (slopes, law.slopes[5:]))
    widened = widened_covariance(law, point, zero, WEAK_PRIOR, law)  # type: ignore[arg-type]
    assert widened.lower > 80.0
    assert any("there is a better fit" in remark for remark in widened.remarks(tuple("abcde")))


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_way_to_an_end_stops_where_no_logarithm_may_change_any_more(side: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """From a minimum next to that place, chi-squared flat, the way was walked for ever."""
    slopes = np.array([[1e-3, 0.0], [0.0, 1.0]])
    point = EvaluatedPoint(np.zeros(2), (np.zeros(2), np.zeros(0)), (slopes, np.zeros((0, 2))))
    model = ResidualModel(point, np.eye(2), np.zeros(2), 100.0, np.zeros((2, 3)))
    left, coefficients = [500], ResidualModel.coefficients

    def counted(self: ResidualModel, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        left[0] -= 1
        assert left[0], "no end"
        return coefficients(self, theta)

    monkeypatch.setattr(ResidualModel, "coefficients", counted)
    minimum = np.array([side * 0.98 * BOX, 0.0])
    end = model.cost().end(minimum, 0.0, 0, side * 2.0, FARTHEST)
    np.testing.assert_allclose(end, [side * 0.99 * BOX, 0.0], atol=1e-6)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_both_ends_of_a_profile_are_those_of_its_closed_form(side: float) -> None:
    law = Sum(0.4)
    model = ResidualModel(law.point(), np.array([[1.0], [-1.0]]) / np.sqrt(2.0), np.zeros(2), WEAK_PRIOR)
    d = np.sqrt(RISE) * 0.4
    exact = np.log(2.0) - np.log1p(np.exp([-side * d, side * d]))
    for x in np.linspace(-0.4, 0.4, 9)[[0, 1, 2, 3, 5, 6, 7, 8]]:
        theta = np.log1p([x, -x])
        model.learn(theta, np.concatenate(law.residual(theta)))
    model.fit()
    offset = np.concatenate(law.residual(exact)) - model.predicted(exact)
    end = model.cost(offset).end(np.zeros(2), 0.0, 0, side * d / 2.0, 2.0)
    np.testing.assert_allclose(end, exact, atol=0.02)


def test_chi_squared_of_a_model_has_the_gradient_of_its_differences() -> None:
    rng = np.random.default_rng(2)
    slopes = rng.standard_normal((12, 3))
    point = EvaluatedPoint(0.1 * rng.standard_normal(3), (rng.standard_normal(5), rng.standard_normal(7)), (slopes[:5], slopes[5:]))
    model = ResidualModel(point, np.linalg.qr(rng.standard_normal((3, 2)))[0], np.zeros(3), 1.2)
    for theta in 0.3 * rng.standard_normal((8, 3)):
        model.learn(theta, rng.standard_normal(12))
    model.fit()
    cost, at = model.cost(rng.standard_normal(12)), np.array([0.2, -0.1, 0.3])
    differences = [(cost(at + h)[0] - cost(at - h)[0]) / 4e-5 for h in 1e-5 * np.eye(3)]
    np.testing.assert_allclose(cost(at)[1], differences, rtol=1e-6)


def test_linear_models_keep_the_covariance_of_least_squares() -> None:
    rng = np.random.default_rng(1)
    law = Linear(rng.standard_normal((40, 5)) * [20.0, 10.0, 5.0, 3.0, 2.0])
    zero = np.zeros(5)
    point = EvaluatedPoint(zero, (np.zeros(5), np.zeros(35)), (law.slopes[:5], law.slopes[5:]))
    found = widened_covariance(law, point, zero, WEAK_PRIOR, law).covariance  # type: ignore[arg-type]
    expected = np.linalg.inv(law.slopes.T @ law.slopes + np.eye(5) / WEAK_PRIOR**2)
    np.testing.assert_allclose(np.sqrt(np.diag(found) / np.diag(expected)), 1.0, atol=0.02)
