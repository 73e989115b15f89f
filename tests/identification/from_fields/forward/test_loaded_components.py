"""Number of loaded components that the measurements determine: its estimate for many of them is the exact trace."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg as sl
import scipy.sparse as sp

from naibu.identification.from_fields.forward import loaded_components
from naibu.identification.from_fields.forward.loaded_components import _trace_of_prior


def test_the_trace_by_random_signs_is_that_of_the_inverse_within_a_few_components(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a chain of 400 springs between nodes that are measured more or less well."""
    n, rng = 400, np.random.default_rng(2)
    prior = sp.diags([-np.ones(n - 1), np.r_[1.0, np.full(n - 2, 2.0), 1.0], -np.ones(n - 1)], [-1, 0, 1]).tocsr()
    hessian = prior.toarray() + np.diag(rng.uniform(0.1, 10.0, n))
    factor = sl.cho_factor(hessian)
    exact = float(np.trace(prior.toarray() @ np.linalg.inv(hessian)))
    assert _trace_of_prior(factor, prior) == pytest.approx(exact, rel=1e-10)
    monkeypatch.setattr(loaded_components, "EXACT_TRACE", 0)
    assert _trace_of_prior(factor, prior) == pytest.approx(exact, abs=0.01 * n)
