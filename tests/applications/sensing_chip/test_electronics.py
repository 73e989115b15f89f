"""Readout, filters and design study: published figures, closed forms, linear-system theory, and brute force."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from naibu.applications.sensing_chip.bridge import closed_form_sensitivities
from naibu.applications.sensing_chip.design import assumed_chip
from naibu.applications.sensing_chip.design_study import pareto_front, study_designs
from naibu.applications.sensing_chip.electronics import report_readout
from naibu.applications.sensing_chip.filters import (
    RampKalman,
    first_order_filter,
    forward_backward_filter,
    noise_gain,
    ramp_lag,
    time_constant,
)
from naibu.applications.sensing_chip.load_envelope import load_limits
from naibu.core.errors import InputError


def test_the_reports_filter_has_the_published_attenuation_and_lag() -> None:
    assert noise_gain(0.1) == pytest.approx(0.23, abs=0.001)
    assert time_constant(0.1) == pytest.approx(9.5, abs=0.01)
    assert ramp_lag(0.1) == pytest.approx(9.0)


def test_the_first_order_filter_is_the_printed_recursion() -> None:
    u = np.random.default_rng(1).standard_normal((50, 3))
    v = [u[0]]
    for reading in u[1:]:
        v.append(0.1 * reading + 0.9 * v[-1])
    assert first_order_filter(u, 0.1) == pytest.approx(np.array(v))
    assert first_order_filter(u, 1.0) == pytest.approx(u)


def test_figures_of_the_filter_are_those_of_its_output() -> None:
    white = np.random.default_rng(2).standard_normal(200_000)
    assert first_order_filter(white, 0.1).std() == pytest.approx(noise_gain(0.1), rel=0.02)
    ramp = np.arange(300.0)
    assert (ramp - first_order_filter(ramp, 0.1))[-1] == pytest.approx(ramp_lag(0.1), rel=1e-6)
    step = first_order_filter(np.r_[0.0, np.ones(100)], 0.1)
    at = np.interp(1.0 - np.exp(-1.0), step, np.arange(101.0))
    assert at == pytest.approx(time_constant(0.1), abs=0.1)


def test_the_kalman_filter_follows_ramps_and_lets_through_as_much_noise() -> None:
    kalman = RampKalman.with_noise_gain(1.0, noise_gain(0.1))
    white = np.random.default_rng(3).standard_normal((3000, 5))
    assert kalman.filtered(white)[500:].std() == pytest.approx(noise_gain(0.1), rel=0.1)
    ramp = 0.5 * np.arange(400.0)
    assert kalman.filtered(ramp)[-1] == pytest.approx(ramp[-1], abs=1e-6)
    assert kalman.smoothed(ramp) == pytest.approx(ramp, abs=1e-4)


def test_steady_gains_solve_the_riccati_equation() -> None:
    kalman = RampKalman(0.7, 0.05)
    move, seen = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[1.0, 0.0]])
    drift = 0.05**2 * np.array([[0.25, 0.5], [0.5, 1.0]])
    ahead = solve_discrete_are(move.T, seen.T, drift, np.array([[0.49]]))
    gain = ahead[:, 0] / (ahead[0, 0] + 0.49)
    assert kalman.steady_gains == pytest.approx(tuple(gain), rel=1e-8)


def test_the_smoother_is_least_squares() -> None:
    """The mean of a Gaussian process given all readings minimises the weighted squares of readings, drifts and start."""
    n, noise, slope = 12, 0.5, 0.2
    kalman, u = RampKalman(noise, slope), np.random.default_rng(4).standard_normal(12).cumsum()
    # unknowns: level and slope at the start, then the change of the slope at every step
    levels = np.zeros((n, n + 1))
    levels[:, 0], levels[:, 1] = 1.0, np.arange(n)
    for k in range(1, n):
        levels[k:, 1 + k] = np.arange(n - k) + 0.5
    weights = np.concatenate([np.full(n, 1.0 / noise), [0.1 / noise], np.full(n - 1, 1.0 / slope)])
    prior = np.eye(n + 1)[1:]
    found = np.linalg.lstsq(weights[:, None] * np.vstack([levels, prior]), weights * np.r_[u, np.zeros(n)], rcond=None)[0]
    assert kalman.smoothed(u) == pytest.approx(levels @ found, abs=1e-8)


def test_a_jump_is_followed_at_once_and_noise_is_no_jump() -> None:
    noise = np.random.default_rng(6).standard_normal(800)
    kalman, jumping = (RampKalman.with_noise_gain(1.0, noise_gain(0.1), jump=jump) for jump in (np.inf, 5.0))
    assert jumping.filtered(noise) == pytest.approx(kalman.filtered(noise))
    u = noise + 100.0 * (np.arange(800) >= 400)
    found = jumping.filtered(u)
    assert abs(found[400:] - 100.0).max() < 5.0
    assert abs(kalman.filtered(u)[400:410] - 100.0).min() > 5.0
    assert abs(jumping.smoothed(u)[399] - 0.0) < 2.0
    with pytest.raises(InputError, match="jump"):
        RampKalman(1.0, 0.1, jump=0.0)


def test_forward_and_backward_has_no_lag() -> None:
    u = np.zeros(401)
    u[200] = 1.0
    response = forward_backward_filter(u, 0.1)
    assert np.sum(np.arange(401) * response) / response.sum() == pytest.approx(200.0, abs=1e-6)


def test_the_reports_gains_saturate_far_below_the_strength() -> None:
    """2000 x 0.2 mV/mN reaches the assumed 10 V at 25 mN, and 500 x 2.83 mV/(N um) at 7.07 N um."""
    assert report_readout().measurable((0.2, 2.83, 2.83)) == pytest.approx([25.0, 7.067, 7.067], rel=1e-3)


def test_readings_have_the_gain_the_noise_and_the_steps_of_the_electronics() -> None:
    readout, rng = report_readout(), np.random.default_rng(0)
    bridge = np.tile([1.0, 2.0, -2.0], (20_000, 1))  # mV
    read = readout.converted(bridge, rng)
    assert read.mean(axis=0) == pytest.approx([2.0, 1.0, -1.0], abs=2e-3)
    assert read.std(axis=0) == pytest.approx(np.array([0.37, 0.1, 0.1]) / 6.0, rel=0.02)
    assert read / readout.step == pytest.approx(np.round(read / readout.step))
    assert readout.step == pytest.approx(20.0 / 4096.0)
    high = readout.converted(np.full((2, 3), 1e3), rng, offset_mv=(100.0, 0.0, 0.0), trimmed_mv=(100.0, 0.0, 0.0))
    assert high == pytest.approx(10.0 - readout.step)
    trimmed = readout.converted(bridge, np.random.default_rng(0), offset_mv=(3.0, 1.0, 1.0), trimmed_mv=(3.0, 1.0, 1.0))
    assert trimmed == pytest.approx(read)


def test_the_study_repeats_the_assumed_chip() -> None:
    base = assumed_chip()
    own = study_designs(base, [base.beam_length_mm], [base.beam_width_mm], [base.beam_thickness_mm])
    assert (own.force_sensitivity[0], own.moment_sensitivity[0]) == pytest.approx(tuple(closed_form_sensitivities(base)[:2]))
    assert (own.force_limit[0], own.moment_limit[0]) == pytest.approx(tuple(load_limits(base)[:2]), rel=1e-9)


def test_sensitivity_times_range_does_not_depend_on_the_beams() -> None:
    study = study_designs(assumed_chip(), np.linspace(0.2, 0.8, 5), np.linspace(0.05, 0.3, 5), np.linspace(0.02, 0.1, 5))
    product = study.force_sensitivity * study.force_limit
    assert product == pytest.approx(np.full(product.shape, product[0]))


def test_the_front_is_that_of_all_pairs() -> None:
    values = np.round(np.random.default_rng(5).random((200, 3)), 1)
    worse = [any((other >= row).all() and (other > row).any() for other in values) for row in values]
    assert pareto_front(values).tolist() == [not w for w in worse]


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(InputError, match="share"):
        first_order_filter(np.zeros(3), 0.0)
    with pytest.raises(InputError, match="gain"):
        RampKalman.with_noise_gain(1.0, 1.5)
    with pytest.raises(InputError, match="gains must be positive"):
        dataclasses.replace(report_readout(), gains=(2000.0, -1.0, 500.0))
    with pytest.raises(InputError, match="adc_bits"):
        dataclasses.replace(report_readout(), adc_bits=0)
    with pytest.raises(InputError, match="must be positive"):
        study_designs(assumed_chip(), [-0.3], [0.1], [0.05])
    with pytest.raises(InputError, match="no combination"):
        study_designs(assumed_chip(), [0.1], [0.1], [0.05])
