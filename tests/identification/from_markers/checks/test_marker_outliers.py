"""Misplaced and mislabelled markers are named and left out, and none of those that were measured well."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from squeezed_box import squeezed_box

from naibu import datasets
from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.identification.from_markers.checks.marker_outliers import isolated, without_outliers


def off_by_16_mm(points: FloatArray) -> FloatArray:
    points[59] += [16.0, 0.0, 0.0]
    return points


def two_labels_exchanged(points: FloatArray) -> FloatArray:
    points[[20, 77]] = points[[77, 20]]
    return points


def numbered_from_two(points: FloatArray) -> FloatArray:
    return np.roll(points, 1, axis=0)


def test_a_misplaced_marker_is_named_and_left_out() -> None:
    cleaned, outliers = without_outliers([squeezed_box(loaded=off_by_16_mm)])
    assert [(o.experiment, o.state, o.marker, o.axis) for o in outliers] == [("box", "pressed", 60, "x")]
    assert outliers[0].offset_mm == pytest.approx(16.0, abs=0.6)
    assert np.flatnonzero(~cleaned[0].states[1].markers.trusted).tolist() == [59]
    assert cleaned[0].states[0].markers.trusted.all()


def test_a_marker_misplaced_in_the_reference_configuration_is_left_out_there() -> None:
    cleaned, outliers = without_outliers([squeezed_box({"pressed": 45.0, "more": 38.0}, initial=off_by_16_mm)])
    assert [(o.state, o.marker, o.axis) for o in outliers] == [("initial", 60, "x")]
    assert outliers[0].offset_mm == pytest.approx(16.0, abs=0.6)
    assert np.flatnonzero(~cleaned[0].states[0].markers.trusted).tolist() == [59]


def test_exchanged_labels_are_both_left_out() -> None:
    _, outliers = without_outliers([squeezed_box(loaded=two_labels_exchanged)])
    assert sorted(o.marker for o in outliers) == [21, 78]


def test_labels_shifted_by_one_are_refused() -> None:
    with pytest.raises(InputError, match=r"\d\d of 125 markers do not move with their neighbours.*same label"):
        without_outliers([squeezed_box(loaded=numbered_from_two)])


@pytest.mark.parametrize("name", [n for n in datasets.names() if not n.endswith("_agar")])
def test_no_measured_marker_is_left_out(name: str) -> None:
    experiment = datasets.load(name)
    cleaned, outliers = without_outliers([experiment])
    assert outliers == () and cleaned[0] is experiment


def test_no_marker_of_a_noisy_scan_is_left_out() -> None:
    for seed in range(20):
        assert without_outliers([squeezed_box(noise_mm=0.5, seed=seed)])[1] == ()


def test_states_that_are_not_used_are_not_searched() -> None:
    good = squeezed_box({"pressed": 45.0, "more": 38.0})
    bad = squeezed_box({"pressed": 45.0, "more": 38.0}, loaded=off_by_16_mm)
    mixed = replace(good, states=(good.states[0], good.states[1], bad.states[2]))
    assert without_outliers([mixed], {"box": ["pressed"]})[1] == ()
    assert [o.state for o in without_outliers([mixed])[1]] == ["more"]


def test_residuals_that_neighbours_share_are_not_isolated() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(0.0, 60.0, (200, 3))
    residual = 0.1 * rng.normal(size=points.shape) + np.column_stack([0.1 * points[:, 2], np.zeros((200, 2))])
    assert not isolated(points, residual, np.full(3, 0.1))[0].any()
    residual[7, 2] += 2.0
    assert np.flatnonzero(isolated(points, residual, np.full(3, 0.1))[0]).tolist() == [7]
