"""Displacements that are averages over a neighbourhood, of a body that other code solves."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from naibu.core.arrays import FloatArray
from naibu.core.displacement_field import DisplacementField
from naibu.identification.from_fields.assumptions.averaged_displacements import AVERAGES, Averaging, judged_averages, kernel
from naibu.identification.from_fields.estimate import identify_field
from naibu.identification.from_fields.field_estimate import FieldEstimate
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase, Zones
from naibu.identification.verdict import Explanation, Verdict
from naibu.validation.specimens.quadratic_body import SIDE_MM, QuadraticBody

HARD, COUNT = 50.0, 12
NOISE_MM = 0.04


def grid() -> FloatArray:
    """Points of a grid (COUNT^3, 3) in the unit cube."""
    axis = (np.arange(COUNT) + 0.5) / COUNT
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)


def averaged(vectors: FloatArray, steps: float) -> FloatArray:
    """Average vectors (COUNT^3, 3) of the grid over a Gaussian kernel of so many steps."""
    cube = vectors.reshape(COUNT, COUNT, COUNT, 3)
    return np.stack([gaussian_filter(cube[..., i], steps, mode="nearest") for i in range(3)], axis=-1).reshape(-1, 3)


def identified(steps: float) -> FieldEstimate:
    """Identify the hard lower half of a cube from displacements that are averaged over a kernel; their noise is stated as it was before."""
    body = QuadraticBody("cube", (HARD, 0.45))
    mesh, loaded = body.model(6, "hexahedron")
    points, u = body.solved((1.0, 0.0, -2.0), divisions=4).at(grid())
    noisy = u + NOISE_MM * np.random.default_rng(0).standard_normal(u.shape)
    measured = averaged(noisy, steps) if steps else noisy
    field = DisplacementField.from_arrays(points, measured, sd_mm=NOISE_MM)
    zones = Zones.of(mesh, known={"known": (10.0, 0.4)})
    return identify_field(mesh, [FieldLoadCase.of("pressed", field, mesh, loaded=loaded)], zones)


@pytest.mark.parametrize("steps", [1.5, 2.0])
def test_intervals_hold_the_truth_with_kernels_of_which_a_fit_follows_a_part(steps: float) -> None:
    """From what neighbours share in the residuals kernels were told too short, and to first order; the interval ended at 44 and 43 kPa."""
    found = identified(steps)
    low, high = found.intervals()[0][0]
    assert found.young_modulus[0] < 0.7 * HARD and low < HARD < high
    assert found.verdict is not None and found.verdict.explanation is Explanation.IN_PART and AVERAGES in " ".join(found.verdict.reasons)


def test_intervals_hold_the_truth_and_the_verdict_says_that_displacements_look_like_averages() -> None:
    found, plain = identified(1.0), identified(0.0)
    low, high = found.intervals()[0][0]
    assert found.young_modulus[0] < 0.9 * HARD and low < HARD < high
    assert found.verdict is not None and plain.verdict is not None
    assert found.verdict.explanation is Explanation.IN_PART and AVERAGES in found.verdict.sentence
    assert AVERAGES not in " ".join(plain.identifiability)
    low, high = plain.intervals()[0][0]
    assert low < HARD < high


@pytest.mark.parametrize("steps", [0.6, 1.0, 1.5])
def test_the_kernel_of_averages_is_found_from_what_neighbours_share(steps: float) -> None:
    points, noise = SIDE_MM * grid(), np.random.default_rng(1).standard_normal((COUNT**3, 3))
    assert kernel(points, averaged(noise, steps)).length_mm == pytest.approx(steps * SIDE_MM / COUNT, rel=0.15)
    assert kernel(points, noise).length_mm == 0.0
    assert kernel(points, noise + 2.0 * averaged(noise[::-1], steps)).length_mm == 0.0  # a small part of it is shared


def test_averages_are_told_last_where_residuals_are_more_than_noise() -> None:
    mesh = QuadraticBody("cube").model(2, "hexahedron")[0]
    zones, found = Zones.of(mesh, known={"known": (10.0, 0.4)}), Averaging(2.0, np.array([0.3, 0.0]))
    for factor, place in ((0.5, 0), (3.0, 1)):
        plain = Verdict(Explanation.IN_PART, ("another reason",), "lead", factor, 0.0, 0.5)
        told = judged_averages(plain, found, zones, np.log([5.0, 8.0]))
        assert told.reasons[place].startswith(AVERAGES) and "that of unknown 35 % higher" in told.reasons[place]
    assert judged_averages(plain, None, zones, np.log([5.0, 8.0])) is plain
