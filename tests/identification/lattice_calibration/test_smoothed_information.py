"""Information of residuals that jump, against that of the same residuals without jumps."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from naibu.identification.lattice_calibration.evaluation import EvaluatedPoint
from naibu.identification.lattice_calibration.widened_covariance import LEAST, smoothed_information

COUNT, SHORT, PRIOR_SD = 4000, 0.01, 3.0


def information(slopes: np.ndarray, jump: float, upper: float = np.inf, curvature: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return the smoothed information of residuals that jump at random, and that of differences of the length `SHORT`."""
    n, p = slopes.shape

    def residual(theta: np.ndarray) -> np.ndarray:
        jumps = np.random.default_rng(np.frombuffer(theta.tobytes(), np.uint32)).standard_normal(n)
        return slopes @ theta + curvature * np.sum(theta**2) + jump * jumps

    class At:
        def many(self, _: Any, trials: list[tuple[np.ndarray, bool]]) -> list[tuple[np.ndarray, np.ndarray]]:
            found = [residual(theta) for theta, _ in trials]
            return [(r[: n // 2], r[n // 2 :]) for r in found]

    theta, at = np.zeros(p), At()
    held = SimpleNamespace(unknowns=SimpleNamespace(held=lambda values: np.minimum(values, np.exp(upper))))
    base = residual(theta)
    short = np.stack([(residual(SHORT * row) - base) / SHORT for row in np.eye(p)], axis=1)
    point = EvaluatedPoint(theta, (base[: n // 2], base[n // 2 :]), (short[: n // 2], short[n // 2 :]))
    found, runs = smoothed_information(held, point, SHORT, PRIOR_SD, at)  # type: ignore[arg-type]
    assert runs == 1 + 2 * 2 * p
    return found, point.information


def test_smooth_residuals_keep_their_information() -> None:
    slopes = np.random.default_rng(0).standard_normal((COUNT, 3)) * [0.1, 0.3, 1.0]
    found, short = information(slopes, 0.0)
    np.testing.assert_allclose(found, slopes.T @ slopes, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(short, slopes.T @ slopes, rtol=1e-6, atol=1e-6)


def test_what_jumps_tell_is_taken_away() -> None:
    """Short differences make standard deviations several times too small; these are within some per cent, or too large."""
    slopes = np.random.default_rng(1).standard_normal((COUNT, 3)) * [0.1, 0.3, 1.0]
    found, short = information(slopes, 0.02)
    true, apparent, smoothed = (np.sqrt(np.diag(np.linalg.inv(m))) for m in (slopes.T @ slopes, short, found))
    assert apparent[0] < 0.1 * true[0]
    assert (smoothed > 0.9 * true).all()
    assert (smoothed < 1.5 * true).all()


def test_what_has_no_influence_is_not_determined_by_jumps() -> None:
    slopes = np.random.default_rng(2).standard_normal((COUNT, 2)) * [0.0, 1.0]
    found, short = information(slopes, 0.02)
    assert 1.0 / np.sqrt(short[0, 0]) < 0.01  # a hundredth of a logarithm, from nothing
    assert found[0, 0] < 0.3 * 2.0 * 0.02**2 * COUNT / 0.1**2


@pytest.mark.parametrize("curvature", [0.0, 0.5])
def test_a_bound_and_curvature_leave_a_positive_information(curvature: float) -> None:
    slopes = np.random.default_rng(3).standard_normal((COUNT, 2)) * [0.3, 1.0]
    found, _ = information(slopes, 0.0, upper=0.0, curvature=curvature)
    ratio = np.linalg.eigvals(np.linalg.solve(slopes.T @ slopes, found)).real
    assert (ratio > 0.5 * LEAST).all()
    assert (ratio < 2.0).all()
