"""Sideways forces and slip told from readings, against what the rod of the finite elements did; incipient slip against Mindlin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from naibu.applications.fingertip.decoder import Training, train_decoder
from naibu.applications.fingertip.fingertip import Fingertip, FingertipResolution
from naibu.applications.fingertip.pressing import FingertipModel, Press, Pressing, rotated_loads
from naibu.applications.fingertip.readings import ReadingChain
from naibu.applications.fingertip.slip import SidewaysForces, SlipDetector, train_slip_detector, true_tangential_share
from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError

FRICTION = 0.4


@pytest.fixture(scope="module")
def model() -> FingertipModel:
    return FingertipModel.of(Fingertip(), FingertipResolution(3, 2, 10))


@pytest.fixture(scope="module")
def detector(model: FingertipModel, chain: ReadingChain) -> SlipDetector:
    training = Training((0.0, 10.0, 20.0, 30.0), (0.6,), (200.0, 240.0), (300.0, 1500.0))
    pressings = [model.pressed(press) for press in training.presses(model.fingertip)]
    slides = [model.pressed(press) for press in training.slides(model.fingertip)]
    decoder = train_decoder(model.fingertip, chain, training, pressings)
    return train_slip_detector(decoder, chain, training, pressings, slides)


@pytest.fixture(scope="module")
def dragged(model: FingertipModel) -> Pressing:
    return model.pressed(Press(15.0, 1000.0, friction=FRICTION, slide_mm=2.5))


def loads_of(pressing: Pressing, chain: ReadingChain, azimuth: float = 0.0) -> FloatArray:
    return chain.measured_loads(chain.volts(rotated_loads(pressing.chip_loads, azimuth)))


def test_drag_from_rest_to_slip_is_told_with_its_interval(detector: SlipDetector, dragged: Pressing, chain: ReadingChain) -> None:
    truth = true_tangential_share(dragged)
    assert truth.max() == pytest.approx(FRICTION, abs=0.02)  # it slides at the end
    touched = dragged.along_rod_mn > 350.0
    loads, from_there = loads_of(dragged, chain)[touched], (truth - truth[np.argmax(touched)])[touched]
    # one reading a second: the first one is the touch
    found = detector.followed(2.0 * np.arange(len(loads)), loads, noise_share=0.23)
    assert (found.contact == 1).all()
    low, high = found.size_95.T
    assert (low <= np.abs(from_there)).all() and (np.abs(from_there) <= high).all() and (high - low).max() < 0.4
    sliding, still = dragged.slide_mm[touched] > 2.0, dragged.slide_mm[touched] == 0.0
    share = 0.6  # on so coarse a mesh the sensitivity differs by 13 % from press to press
    assert found.slides(FRICTION, share)[sliding].all() and not found.slides(FRICTION, share)[still].any()
    assert found.may_slide(FRICTION)[sliding].all() and not found.may_slide(FRICTION)[still].any()


def test_drag_turns_with_the_azimuth(detector: SlipDetector, dragged: Pressing, chain: ReadingChain) -> None:
    first = int(np.flatnonzero(dragged.slide_mm)[0]) - 1
    turned = loads_of(dragged, chain, 90.0)
    share = detector.tangential_share(turned[first:], turned[first])
    straight = detector.tangential_share(loads_of(dragged, chain)[first:], loads_of(dragged, chain)[first])
    assert share[:, 1] == pytest.approx(straight[:, 0], abs=1e-6) and share[:, 0] == pytest.approx(0.0, abs=1e-6)
    assert straight[-1, 0] > 0.2  # away from the base's normal


def test_every_contact_counts_from_its_own_beginning(detector: SlipDetector, dragged: Pressing, chain: ReadingChain) -> None:
    first, last = (loads_of(dragged, chain)[k] for k in (int(np.flatnonzero(dragged.slide_mm)[0]) - 1, -1))
    rows = np.array([np.zeros(3), first, last, np.zeros(3), last, last])
    found = detector.followed(10.0 * np.arange(6), rows)
    assert found.contact.tolist() == [0, 1, 1, 0, 2, 2]
    assert np.isnan(found.size[[0, 3]]).all() and found.size[2] > 0.2
    assert found.size[4:] == pytest.approx(0.0, abs=1e-6)  # nobody saw how it came there
    faint = 0.8 * detector.decoder.limits[0] / first[0] * first  # not answered, but still touching
    assert detector.followed(np.arange(4.0), np.array([first, faint, first, np.zeros(3)])).contact.tolist() == [1, 0, 1, 0]


def test_noise_widens_the_interval_and_is_held_by_it(detector: SlipDetector, dragged: Pressing, chain: ReadingChain) -> None:
    first = int(np.flatnonzero(dragged.slide_mm)[0]) - 1
    truth = true_tangential_share(dragged)
    rng, noise = np.random.default_rng(0), 0.2
    rows = np.concatenate([np.repeat(loads_of(dragged, chain)[[k]], 300, axis=0) for k in (first, first + 1)])
    found = detector.followed(np.arange(600), rows + noise * chain.noise * rng.standard_normal((600, 3)), noise_share=noise, touch_s=200.0)
    truly = truth[first + 1] - truth[first]
    inside = (found.size_95[300:, 0] <= truly) & (truly <= found.size_95[300:, 1])
    assert inside.mean() > 0.9
    quiet = detector.followed(np.arange(600), rows, noise_share=0.001, touch_s=200.0)
    assert (found.sd[:300] > quiet.sd[:300]).all()


def test_the_middle_that_sticks_is_that_of_mindlin() -> None:
    half = SidewaysForces(np.array([[0.3, 0.4], [0.0, 0.0], [0.8, 0.6]]), np.full(3, 0.05), np.ones(3, np.int64))
    assert half.size == pytest.approx([0.5, 0.0, 1.0])
    # Johnson, Contact Mechanics, eq. (7.42)
    assert half.sticking_radius(1.0) == pytest.approx([0.5 ** (1.0 / 3.0), 1.0, 0.0])


def test_slip_needs_a_press_and_a_way(detector: SlipDetector, dragged: Pressing, chain: ReadingChain) -> None:
    training = Training((0.0, 10.0, 20.0, 30.0), (0.6,), (200.0, 240.0), (300.0, 900.0))
    still = replace(dragged, slide_mm=np.zeros_like(dragged.slide_mm))
    with pytest.raises(InputError, match="does not slide"):
        train_slip_detector(detector.decoder, chain, training, [dragged], [still])
    with pytest.raises(InputError, match="without a press there is no slip"):
        detector.tangential_share([[0.0, 1.0, 1.0]], [1.0, 0.0, 0.0])
    with pytest.raises(InputError, match="friction"):
        SidewaysForces(np.zeros((1, 2)), np.ones(1), np.ones(1, np.int64)).slides(0.0)
    with pytest.raises(InputError, match="touch_s"):
        detector.followed([0.0], [[1.0, 0.0, 0.0]], touch_s=0.0)
