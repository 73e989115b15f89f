"""Forces decoded from readings of presses on another mesh, with another friction and modulus; offsets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from naibu.applications.fingertip._decoder_kernels import LOG_POWERS, RATIO_POWERS, TERMS, TILT_OUT, terms
from naibu.applications.fingertip.decoder import ForceDecoder, Training, directions, train_decoder, true_contact
from naibu.applications.fingertip.fingertip import Fingertip, FingertipResolution
from naibu.applications.fingertip.offset import OffsetTracker
from naibu.applications.fingertip.pressing import FingertipModel, Press, Pressing, rotated_loads
from naibu.applications.fingertip.readings import ReadingChain
from naibu.core.errors import InputError


def test_intervals_hold_presses_of_another_mesh_friction_and_modulus(decoder: ForceDecoder, chain: ReadingChain) -> None:
    other = FingertipModel.of(Fingertip(), FingertipResolution(3, 2, 10)).pressed(Press(15.0, 2000.0, friction=0.6)).for_modulus(230.0)
    along = np.array([600.0, 1000.0, 1500.0, 1900.0])
    force, tilt, place = true_contact(other, along)
    truth = directions(np.rad2deg(tilt), np.full(4, 130.0))
    found = decoder.decode(chain.volts(rotated_loads(other.at_force(along), 130.0)), noise_share=0.01)
    assert found.answered.all()
    assert ((found.force_95[:, 0] < force) & (force < found.force_95[:, 1])).all()
    assert np.abs(found.force_mn / force - 1.0).max() < 0.06
    angle = np.rad2deg(np.arccos((found.direction * truth).sum(axis=1)))
    assert (angle < found.cone_95_deg).all() and angle.max() < 2.0
    where = 10.0 * directions(np.rad2deg(place), np.full(4, 130.0))
    assert (np.linalg.norm(found.position_mm - where, axis=1) < found.position_95_mm).all()
    assert found.azimuth_deg == pytest.approx(np.full(4, 130.0))


def test_noise_widens_the_intervals_that_then_hold_the_truth(decoder: ForceDecoder, chain: ReadingChain, coarse: FingertipModel) -> None:
    pressing = coarse.pressed(Press(20.0, 1000.0, friction=0.6))
    force, tilt, _ = true_contact(pressing, np.array([900.0]))
    clean = chain.volts(pressing.at_force(np.array([900.0])))
    rng = np.random.default_rng(1)
    found = decoder.decode(clean + chain.readout.noise_sd * rng.standard_normal((2000, 3)))
    inside = (found.force_95[:, 0] < force) & (force < found.force_95[:, 1])
    angle = np.arccos((found.direction * directions(np.rad2deg(tilt), np.zeros(1))).sum(axis=1))
    assert inside.mean() > 0.95 and (np.rad2deg(angle) < found.cone_95_deg).mean() > 0.95
    narrow = decoder.decode(clean, noise_share=0.01)
    assert np.ptp(narrow.force_95) < np.ptp(found.force_95, axis=1).mean()


def test_readings_beyond_the_training_are_not_answered(decoder: ForceDecoder, chain: ReadingChain) -> None:
    low, high, ratio = decoder.limits
    loads = np.array(
        [[0.5 * low, 0, 0], [1.1 * high, 0, 0], [high / 2, 1.2 * ratio * decoder.unit[1] * high / 2, 0], [-1, 0, 0], [high / 2, 0, 0]]
    )
    found = decoder.decode(loads * chain.volts_per_load)
    assert found.answered.tolist() == [False] * 4 + [True]
    assert found.tilt_deg[-1] == 0.0 and np.isnan(found.position_mm[0]).all()


def test_polynomials_that_turn_the_finger_over_are_no_answer(decoder: ForceDecoder) -> None:
    low, high, ratio = decoder.limits
    load = np.array([[np.sqrt(low * high), 0.0, 0.9 * ratio * np.sqrt(low * high) * decoder.unit[1]]])
    assert decoder.decode_loads(load)[0, TILT_OUT] > 0.0
    for row in (1, 2):  # of the tilt, of the contact's angle
        steeper = decoder.coefficients.copy()
        steeper[row] *= 20.0
        assert np.isnan(replace(decoder, coefficients=steeper).decode_loads(load)).all()


def test_the_kernel_evaluates_the_polynomials_and_propagates_their_derivatives(decoder: ForceDecoder) -> None:
    load = np.array([[4.0, -0.3, 0.9]])
    found = decoder.decode_loads(load, 1.0)[0]
    assert LOG_POWERS * RATIO_POWERS == TERMS

    def value(normal: float, moment: float) -> np.ndarray:
        ratio = np.array([moment / (normal * decoder.unit[1])])
        basis = terms(np.log(np.array([normal]) / decoder.unit[0]), ratio)
        return (decoder.coefficients @ basis[0]) * np.array([1.0, ratio[0], ratio[0]])

    moment = np.hypot(0.3, 0.9)
    assert np.exp(value(4.0, moment)[0]) == pytest.approx(found[0])
    assert value(4.0, moment)[1:] == pytest.approx(found[[2, 6]])
    step = 1e-5
    by_load = (value(4.0 + step, moment) - value(4.0 - step, moment)) / (2.0 * step)
    by_moment = (value(4.0, moment + step) - value(4.0, moment - step)) / (2.0 * step)
    # moments at a fixed ratio to F_z carry the error of the model by themselves
    sd_load = np.hypot(decoder.noise[0], decoder.model_error * 4.0)
    sd_moment = np.hypot(decoder.noise[1], decoder.model_error * moment)
    assert np.sqrt((by_load * sd_load) ** 2 + (by_moment * sd_moment) ** 2 + decoder.spread**2) == pytest.approx(found[[1, 3, 7]])


def test_a_decoder_needs_its_presses(coarse: FingertipModel, chain: ReadingChain, training: Training, tilted: Pressing) -> None:
    with pytest.raises(InputError, match="pressings has 1 presses, the training 8"):
        train_decoder(coarse.fingertip, chain, training, [tilted])
    with pytest.raises(InputError, match="tilts_deg"):
        Training((5.0, 10.0, 20.0, 30.0))
    with pytest.raises(InputError, match="young_moduli_kpa is 3 to 2"):
        Training(young_moduli_kpa=(3.0, 2.0))


def test_the_offset_follows_a_drift_while_free_and_not_under_a_load() -> None:
    rng = np.random.default_rng(0)
    noise = np.array([0.06, 0.017, 0.017])
    tracker = OffsetTracker(noise, share=0.02)
    drift = np.linspace(0.0, 0.4, 4000)
    tracker.restart(noise * rng.standard_normal((50, 3)))
    for value in drift:
        tracker.without_offset(value * np.ones(3) * [1.0, 0.1, 0.1] + noise * rng.standard_normal(3))
    assert tracker.offset_volts == pytest.approx([0.4, 0.04, 0.04], abs=0.03)
    before = tracker.offset_volts.copy()
    for _ in range(500):
        tracker.without_offset([5.0, 2.0, 0.0])
    assert (tracker.offset_volts == before).all()
