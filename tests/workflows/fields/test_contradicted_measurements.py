"""Measurements that their neighbours contradict are left out before moduli are sought, and no others are."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.displacement_field import DisplacementField
from naibu.workflows.fields.contradicted_measurements import contradicted

AXIS = np.arange(0.0, 40.0, 2.5)
GRID = np.stack(np.meshgrid(AXIS, AXIS, AXIS, indexing="ij"), axis=-1).reshape(-1, 3)


def bent(points: FloatArray) -> FloatArray:
    """Return a displacement whose strain changes in space, up to 4 mm."""
    x, y, z = points.T / 40.0
    return 4.0 * np.stack([x * z**2, 0.3 * np.sin(3.0 * y) * x, -(z**1.5) * (1.0 + 0.2 * y)], axis=1)


def field(noise: FloatArray | float, stated: float | None, seed: int = 0) -> tuple[FloatArray, DisplacementField]:
    rng = np.random.default_rng(seed)
    points = GRID[np.linalg.norm(GRID - 19.0, axis=1) < 20.0]
    vectors = bent(points) + noise * rng.standard_normal(points.shape)
    return points, DisplacementField.from_arrays(points, vectors, sd_mm=stated)


def with_errors(some: DisplacementField, share: float, seed: int = 1) -> tuple[DisplacementField, BoolArray, FloatArray]:
    rng = np.random.default_rng(seed)
    wrong = rng.random(len(some.points)) < share
    error = np.where(wrong[:, None], rng.uniform(-4.0, 4.0, some.vectors.shape), 0.0)
    covariance = some.covariance
    return DisplacementField.from_arrays(some.points, some.vectors + error, covariance=covariance), wrong, np.linalg.norm(error, axis=1)


@pytest.mark.parametrize("share", [0.02, 0.1])
@pytest.mark.parametrize("stated", [None, 0.013, 0.04])
def test_gross_errors_are_found_whatever_noise_is_stated(share: float, stated: float | None) -> None:
    """Errors of half a millimetre beside noise of .04 mm."""
    some, wrong, size = with_errors(field(0.04, stated)[1], share)
    found = contradicted(some)
    assert found[wrong & (size > 1.0)].mean() > 0.98
    assert found[~wrong].mean() < 0.002


@pytest.mark.parametrize("noise", [0.0, 0.04, 0.4])
def test_noise_and_bending_are_no_contradiction(noise: float) -> None:
    """At borders and in corners of the grid neighbours lie on one side only."""
    assert contradicted(field(noise, noise or None)[1]).mean() < 1e-3


def test_noise_that_grows_in_space_is_no_contradiction() -> None:
    points, _ = field(0.0, None)
    _, some = field(0.02 * np.exp(points[:, 2:] / 12.0), 0.05)
    assert contradicted(some).mean() < 2e-3


def test_parts_that_slide_past_each_other_are_no_contradiction() -> None:
    """Points on either side of a plane move by 3 mm against each other: a jump of the body, and not an error of points."""
    points, some = field(0.04, 0.04)
    apart = some.vectors + np.where(points[:, :1] > 20.0, [0.0, 0.0, 3.0], 0.0)
    assert contradicted(DisplacementField.from_arrays(points, apart, sd_mm=0.04)).mean() < 2e-3


def test_points_that_are_known_to_be_uncertain_stay() -> None:
    some, wrong, size = with_errors(field(0.04, 0.04)[1], 0.05)
    sd = np.where(wrong, 2.0, 0.04)[:, None] * np.ones(3)
    assert not contradicted(DisplacementField.from_arrays(some.points, some.vectors, sd_mm=sd))[size > 0.0].any()
