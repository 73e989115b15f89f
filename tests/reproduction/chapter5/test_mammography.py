"""Section on mammography: what the measured markers show, and how far models without a marker are from them."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.reproduction.chapter5.half_ellipsoid import distances_mm, hardness_modulus, mechanical_model, phantom_markers
from naibu.reproduction.chapter5.mammography import mammography_section


def test_models_without_a_marker_come_near_the_measured_ones() -> None:
    phantom, seen = mammography_section().tables
    unmoved, plane, bent, soft, stiff = (float(str(row[2])) for row in phantom.rows)
    assert soft < stiff < 1.0 < bent < 1.5 < plane < unmoved
    held, free, soft, stiff = (float(str(row[3])) for row in phantom.rows[1:])
    assert soft < 1.5 < free < 3.0 < held
    assert soft < stiff
    assert "rise by" in str(seen.rows[1][1])


def test_a_durometer_sphere_that_hardly_penetrates_gives_the_modulus_of_hertz() -> None:
    depth, force = 0.01 * 2.54, 539.0 + 99.0 * 78.4
    hertz = force / (4.0 / 3.0 * 2.54**0.5 * depth**1.5) * (1.0 - 0.5**2)
    assert hardness_modulus(99.0) == pytest.approx(hertz, rel=2e-3)
    assert hardness_modulus(5.0) / hardness_modulus(0.0) == pytest.approx(222.0 / 125.0, rel=0.08)  # ratio of the compression tests


def test_a_coarse_and_a_fine_mesh_come_near_the_markers_alike() -> None:
    before, after = phantom_markers()
    assert len(before) > 150
    coarse, fine = (distances_mm(mechanical_model(hardness_modulus(0.0), edge=edge)(before), after) for edge in (0.2, 0.14))
    assert fine[2] < 1.5
    assert fine[1] < 0.75
    np.testing.assert_allclose(coarse, fine, atol=0.25)
