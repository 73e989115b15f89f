"""Times of exponential responses against their closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.applications.ischemia.response_times import response_times
from naibu.core.errors import InputError

TIMES = np.unique(np.concatenate([np.linspace(0.0, 0.5, 400), np.linspace(0.5, 3.0, 800)]))


def loaded(rise_s: float, fall_s: float, flow: float = 0.0) -> np.ndarray:
    up = 1.0 - np.exp(-TIMES / rise_s) + flow * TIMES
    top = 1.0 - np.exp(-0.5 / rise_s) + flow * 0.5
    left = 0.5 * flow
    return np.where(TIMES <= 0.5, up, left + (top - left) * np.exp(-(TIMES - 0.5) / fall_s))


def test_exponential_responses_have_their_time_constants() -> None:
    found = response_times(TIMES, loaded(0.02, 0.15), 0.5)
    assert found.rise_constant_s == pytest.approx(0.02, rel=0.01) and found.fall_constant_s == pytest.approx(0.15, rel=0.01)
    assert found.rise_s == pytest.approx(0.02 * np.log(9.0), rel=0.01) and found.fall_s == pytest.approx(0.15 * np.log(9.0), rel=0.01)
    assert found.peak == pytest.approx(1.0) and found.residual == pytest.approx(0.0, abs=1e-6)


def test_a_flow_under_the_load_does_not_change_the_time_constant() -> None:
    found = response_times(TIMES, loaded(0.02, 0.15, flow=0.5), 0.5)
    assert found.rise_constant_s == pytest.approx(0.02, rel=0.02) and found.residual == pytest.approx(0.25, rel=0.01)
    assert found.rise_s > 5.0 * 0.02 * np.log(9.0)


def test_what_does_not_move_has_no_times() -> None:
    found = response_times(TIMES, np.zeros_like(TIMES), 0.5)
    assert np.isnan([found.rise_s, found.fall_s, found.rise_constant_s, found.fall_constant_s]).all() and found.peak == 0.0


def test_what_changes_between_two_instants_changes_at_once_whatever_their_distance() -> None:
    for times in (np.linspace(0.0, 3.0, 61), np.linspace(0.0, 3.0, 601)):  # a pressure follows its load without delay
        found = response_times(times, np.where((times > 0.0) & (times <= 0.5), 2.0, 0.0), 0.5)
        assert (found.rise_s, found.rise_constant_s, found.fall_s, found.fall_constant_s) == (0.0, 0.0, 0.0, 0.0)


def test_a_response_slower_than_the_record_has_no_time_constant() -> None:
    assert np.isnan(response_times(TIMES, loaded(0.02, 50.0), 0.5).fall_constant_s)


@pytest.mark.parametrize(
    ("times", "values", "what"),
    [
        (TIMES, TIMES[1:], "of one shape"),
        (TIMES[::-1], TIMES, "increasing"),
        (TIMES, np.full_like(TIMES, np.nan), "finite"),
        (TIMES[:10], TIMES[:10], "four or more instants up to the release at 0.5 s"),
    ],
)
def test_bad_records_are_named(times: np.ndarray, values: np.ndarray, what: str) -> None:
    with pytest.raises(InputError, match=what):
        response_times(times, values, 0.5)
