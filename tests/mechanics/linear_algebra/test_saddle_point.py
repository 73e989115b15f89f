"""Quadratic functions under linear constraints: the same minimum as by elimination with dense matrices."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg as sl
import scipy.sparse as sp

from naibu.mechanics.linear_algebra.direct import pardiso_library
from naibu.mechanics.linear_algebra.saddle_point import SaddlePoint


@pytest.mark.skipif(pardiso_library() is None, reason="oneMKL is not installed")
def test_the_minimum_is_that_of_the_null_space() -> None:
    """Moduli that differ ten thousand times, and variables that the quadratic function does not tell but by the constraints."""
    rng, n, m = np.random.default_rng(4), 90, 40
    constraints = rng.standard_normal((m, n)) * (rng.random((m, n)) < 0.3) * 10.0 ** rng.uniform(-2.0, 2.0, (m, 1))
    constraints[:, :m] += np.diag(10.0 ** rng.uniform(-2.0, 2.0, m))
    seen = rng.standard_normal((n - m + 10, n)) * (np.arange(n) >= 15)
    null = sl.null_space(constraints)
    b = rng.standard_normal((n, 3))
    expected = null @ np.linalg.solve(null.T @ seen.T @ seen @ null, null.T @ b)
    found = SaddlePoint(sp.csr_matrix(seen.T @ seen), sp.csr_matrix(constraints))
    np.testing.assert_allclose(found.solve(b), expected, atol=1e-5 * np.abs(expected).max())
    np.testing.assert_allclose(found.solve(b[:, 1]), expected[:, 1], atol=1e-5 * np.abs(expected).max())
