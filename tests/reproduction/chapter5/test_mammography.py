"""Section on mammography: what the measured markers show, and how far models without a marker are from them."""

from __future__ import annotations

from naibu.reproduction.chapter5.mammography import mammography_section


def test_models_without_a_marker_come_near_the_measured_ones() -> None:
    phantom, seen = mammography_section().tables
    unmoved, plane, bent, equilibrium = (row[2] for row in phantom.rows)
    assert isinstance(unmoved, float) and isinstance(plane, float) and isinstance(bent, float) and isinstance(equilibrium, float)
    assert equilibrium < 1.0 < bent < 1.5 < plane < unmoved
    held, free = phantom.rows[1][3], phantom.rows[2][3]
    assert isinstance(held, float) and isinstance(free, float)
    assert free < 3.0 < held
    assert "rise by" in str(seen.rows[1][1])
