"""Repeated steps of which each leaves most of some errors."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.imaging.volume_correlation.mixed_steps import MixedSteps


@pytest.mark.parametrize("depth", [1, 2, 3])
def test_as_many_slow_errors_as_steps_are_mixed_end(depth: int) -> None:
    """Linear iterations, exact after depth + 2 steps, as GMRES is (Walker and Ni 2011, theorem 2.2); the first step ends fast errors."""
    rng, steps = np.random.default_rng(depth), depth + 2
    axes = np.linalg.qr(rng.normal(size=(12, 12)))[0]
    left = axes[:, :depth] @ np.diag(np.linspace(0.8, 0.9, depth)) @ axes[:, :depth].T
    right, x, mix = rng.normal(size=12), np.zeros(12), MixedSteps(depth)
    first = np.linalg.norm(right)
    for _ in range(steps):
        own = left @ (x - right) + right - x
        x = x + mix.mixed(own, own)
    assert np.linalg.norm(left @ (x - right) + right - x) < 1e-10 * first
    assert np.linalg.norm(np.linalg.matrix_power(left, steps + 1) @ right) > 0.01 * first  # by themselves
