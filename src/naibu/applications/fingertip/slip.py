"""Slip from readings: how far the moment over F_z moves away from where a contact began tells the sideways share of the force.

While a rod presses towards the centre, the moment over F_z changes little, and in a known way. A sideways force T moves it in proportion to
T / F, whether the surface sticks or slips; the proportion is found from presses of the model that slide. When T / F reaches the friction
coefficient, the whole contact slides. Before that its rim slips: under Hertz's pressure the part that still sticks has
(1 - T / (mu F))^(1/3) of the contact's radius :cite:p:`mindlin1949,johnson1985`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.applications.fingertip._decoder_kernels import terms
from naibu.applications.fingertip.decoder import NORMAL_95, ForceDecoder, Training, spread_95, training_samples
from naibu.applications.fingertip.pressing import Pressing
from naibu.applications.fingertip.readings import ReadingChain
from naibu.core.arrays import BoolArray, FloatArray, IntArray, as_points, as_vector, require_positive, require_shape, require_within
from naibu.core.errors import InputError

LEAST_SLIDING_STATES = 3
_ITERATIONS = 40  # to the ratio of a tilt
_ENDS = 0.5  # of the least F_z that is answered
_BEYOND = 1.5  # times the largest ratio of the training
_TOUCH_S = 1.0
SLIPS_FROM = 0.9  # of the friction coefficient


@dataclass(frozen=True, slots=True, eq=False)
class SidewaysForces:
    """Sideways force over the force along the rod, since every contact began; NaN where nothing touches or a reading is not answered.

    Attributes
    ----------
    share : ndarray, shape (n, 2)
        T / F along x and y.
    sd : ndarray, shape (n,)
        Standard deviation of either component.
    contact : ndarray, shape (n,), int
        Number of the contact, from 1; 0 where nothing touches.
    """

    share: FloatArray
    sd: FloatArray
    contact: IntArray

    @property
    def size(self) -> FloatArray:
        """Size of T / F (n,)."""
        return np.asarray(np.hypot(*self.share.T))

    @property
    def size_95(self) -> FloatArray:
        """Its 95 % interval (n, 2)."""
        half = NORMAL_95 * self.sd
        return np.stack([np.maximum(self.size - half, 0.0), self.size + half], axis=1)

    def slides(self, friction: float, share: float = SLIPS_FROM) -> BoolArray:
        """Return whether the contact slides (n,), bool: T / F is `share` of the coefficient of static friction or more."""
        return np.asarray(np.nan_to_num(self.size) >= _limit(friction, share))

    def may_slide(self, friction: float, share: float = SLIPS_FROM) -> BoolArray:
        """Return whether the contact may slide (n,), bool: the interval of T / F reaches so far."""
        return np.asarray(np.nan_to_num(self.size_95[:, 1]) >= _limit(friction, share))

    def sticking_radius(self, friction: float) -> FloatArray:
        """Return the radius of the part that sticks over that of the contact (n,), under Hertz's pressure :cite:p:`mindlin1949`."""
        require_positive("friction", friction)
        return np.asarray(np.cbrt(np.clip(1.0 - self.size / friction, 0.0, 1.0)))


@dataclass(frozen=True, slots=True, eq=False)
class SlipDetector:
    """Sideways share of the force, and slip, from F_z, M_x and M_y.

    Attributes
    ----------
    decoder : ForceDecoder
        Of the fingertip.
    coefficients : ndarray, shape (terms,)
        Of the rod's tilt over the ratio, rad: how the moment over F_z changes while an undragged rod presses more or less.
    spread : float
        Standard deviation of what they leave, of the training and of presses with other tilts, rad.
    sensitivity_mm : float
        Change of the moment over F_z per change of T / F, mm.
    sensitivity_error : float
        Its relative standard deviation.

    Raises
    ------
    InputError
        A sensitivity that is not positive, or an error beyond 0 to 1.
    """

    decoder: ForceDecoder
    coefficients: FloatArray
    spread: float
    sensitivity_mm: float
    sensitivity_error: float

    def __post_init__(self) -> None:
        require_positive("sensitivity_mm", self.sensitivity_mm, "mm")
        require_within("sensitivity_error", self.sensitivity_error, 0.0, 1.0)

    def followed(self, times_s: ArrayLike, loads: ArrayLike, *, noise_share: float = 1.0, touch_s: float = _TOUCH_S) -> SidewaysForces:
        """Return sideways forces of a recording.

        A contact begins where the decoder answers a reading, and ends where F_z is less than half of the decoder's least. What its readings
        tell during `touch_s`, in the mean, is where it touches; the rod is supposed to keep its direction from then on.

        Parameters
        ----------
        times_s : array_like, shape (n,)
            Of the readings, growing.
        loads : array_like, shape (n, 3)
            F_z, M_x and M_y as measured, without offset, mN and mN mm.
        noise_share : float
            Standard deviation of their noise over that of the decoder's electronics.
        touch_s : float
            How long a contact is taken to be undragged, s.

        Raises
        ------
        InputError
            Arrays that do not belong together, or a time that is not positive.
        """
        rows, times = as_points("loads", loads, 3), np.asarray(times_s, dtype=float)
        require_shape("times_s", times, (len(rows),))
        require_positive("touch_s", touch_s, "s")
        answered = np.isfinite(self.decoder.decode_loads(rows, noise_share)[:, 0])
        change = np.where(answered, 1, np.where(rows[:, 0] < _ENDS * self.decoder.limits[0], -1, 0))
        touching = change[np.maximum.accumulate(np.where(change != 0, np.arange(len(rows)), 0))] > 0
        begins = touching & ~np.concatenate([[False], touching[:-1]])
        contact = np.where(answered, np.cumsum(begins), 0)
        share, sd = np.full((len(rows), 2), np.nan), np.full(len(rows), np.nan)
        for k in range(1, int(contact.max(initial=0)) + 1):
            held = np.flatnonzero(contact == k)
            first = held[times[held] <= times[held[0]] + touch_s]
            share[held], sd[held] = self._since(rows[held], rows[first], noise_share)
        return SidewaysForces(share, sd, contact)

    def tangential_share(self, loads: ArrayLike, at_touch: ArrayLike) -> FloatArray:
        """Return T / F along x and y (n, 2), against when the contact began.

        Parameters
        ----------
        loads : array_like, shape (n, 3)
            F_z, M_x and M_y as measured, mN and mN mm; F_z must be positive.
        at_touch : array_like, shape (3,)
            The same after the contact was made, before it was dragged.

        Raises
        ------
        InputError
            F_z that is not positive.
        """
        now, before = as_points("loads", loads, 3), as_vector("at_touch", at_touch)
        if not (now[:, 0] > 0.0).all() or not before[0] > 0.0:
            raise InputError(f"F_z is {min(float(now[:, 0].min(initial=0.0)), float(before[0])):g} mN; without a press there is no slip")
        return self._since(now, before[None], 0.0)[0]

    def _since(self, now: FloatArray, before: FloatArray, noise_share: float) -> tuple[FloatArray, FloatArray]:
        """Return T / F (n, 2) since the mean of the readings `before` (m, 3), and its standard deviations (n,)."""
        weight = before[:, 0] ** 2
        tilt = weight @ _tilts(self.decoder, self.coefficients, before) / weight.sum()
        expected = _moments_over_force(self.decoder, self.coefficients, now[:, 0], tilt)
        share = _across(now[:, 1:] / now[:, :1] - expected) / self.sensitivity_mm
        noise, lever = noise_share * self.decoder.noise, np.hypot(*expected.T)
        # noise of filtered readings is alike in neighbours, so that the mean at the touch is no better than its best reading
        least = np.hypot(noise[1], noise[0] * lever) / before[:, 0].max()
        own = np.hypot(noise[1], noise[0] * lever) / now[:, 0]
        fit = self.spread * self.decoder.unit[1] / abs(float(self.coefficients[0]))
        sd = np.sqrt(own**2 + least**2 + fit**2 + (self.decoder.model_error * lever) ** 2) / self.sensitivity_mm
        return share, np.hypot(sd, self.sensitivity_error * np.hypot(*share.T))


def _limit(friction: float, share: float) -> float:
    return require_positive("friction", friction) * require_within("share", share, 0.01, 1.0)


def train_slip_detector(
    decoder: ForceDecoder, chain: ReadingChain, training: Training, pressings: Sequence[Pressing], slides: Sequence[Pressing]
) -> SlipDetector:
    """Fit how an undragged rod's moment over F_z changes with its force, and how much drag moves it.

    Parameters
    ----------
    decoder : ForceDecoder
        Trained on the same presses.
    chain : ReadingChain
        The chip.
    training : Training
        What the presses are.
    pressings, slides : sequence of Pressing
        Of ``training.presses(fingertip)`` and ``training.slides(fingertip)``.

    Raises
    ------
    InputError
        A slide without a way.
    """
    loads, tilt = [], []
    for pressing in pressings:
        for modulus in training.moduli():
            loads.append(training_samples(pressing.for_modulus(modulus), chain, training)[0])
            tilt.append(np.full(len(loads[-1]), np.deg2rad(pressing.press.tilt_deg)))
    rows, angle = np.concatenate(loads), np.concatenate(tilt)
    ratio = np.hypot(rows[:, 1], rows[:, 2]) / (rows[:, 0] * decoder.unit[1])
    basis = ratio[:, None] * terms(np.log(rows[:, 0] / decoder.unit[0]), ratio)
    coefficients = np.linalg.lstsq(basis, angle, rcond=None)[0]
    found = [_sensitivity(decoder, coefficients, chain, slide) for slide in slides]
    mean = float(np.mean(found))
    error = max(float(np.ptp(found)) / mean, training.model_error)
    left = [spread_95(basis @ coefficients - angle), *(_held_out(decoder, coefficients, chain, training, slide) for slide in slides)]
    return SlipDetector(decoder, coefficients, max(left), mean, error)


def _held_out(decoder: ForceDecoder, coefficients: FloatArray, chain: ReadingChain, training: Training, slide: Pressing) -> float:
    """Return a standard deviation of the tilt, rad, that holds what is left of a press with another tilt, before it slides."""
    pressed = (slide.slide_mm == 0.0) & (slide.along_rod_mn >= training.force_mn[0])
    loads = chain.measured_loads(chain.volts(slide.chip_loads[pressed]))
    left = _tilts(decoder, coefficients, loads)[:, 0] - np.deg2rad(slide.press.tilt_deg)
    return float(np.abs(left).max(initial=0.0)) / NORMAL_95


def _sensitivity(decoder: ForceDecoder, coefficients: FloatArray, chain: ReadingChain, pressing: Pressing) -> float:
    """Return the change of the moment over F_z per change of T / F, mm, of a press that slides in the plane of its tilt."""
    share, moved = true_tangential_share(pressing), pressing.slide_mm != 0.0
    if moved.sum() < LEAST_SLIDING_STATES:
        raise InputError("the press does not slide; give it a slide_mm other than 0")
    loads = chain.measured_loads(chain.volts(pressing.chip_loads))
    first = int(np.flatnonzero(moved)[0]) - 1
    tilt = _tilts(decoder, coefficients, loads[first : first + 1])[0]
    expected = _moments_over_force(decoder, coefficients, loads[moved, 0], tilt)
    change, moment = share[moved] - share[first], _across(loads[moved, 1:] / loads[moved, :1] - expected)[:, 0]
    return float(change @ moment / (change @ change))


def true_tangential_share(pressing: Pressing) -> FloatArray:
    """Return the force across the rod over that along it (n,), positive away from the base's normal, 0 without contact."""
    axis = pressing.press.axis
    across = pressing.force_mn @ np.array([axis[2], 0.0, -axis[0]])
    along = pressing.along_rod_mn
    return np.asarray(np.divide(across, along, out=np.zeros_like(across), where=along > 0.0))


def _across(moments: FloatArray) -> FloatArray:
    """Return moments about x and y (n, 2) as the directions of the sideways forces that make them."""
    return np.stack([moments[:, 1], -moments[:, 0]], axis=1)


def _tilts(decoder: ForceDecoder, coefficients: FloatArray, loads: FloatArray) -> FloatArray:
    """Return the rod's tilts towards x and y (n, 2), rad, also beyond the training."""
    over = _across(loads[:, 1:] / loads[:, :1]) / decoder.unit[1]
    return np.asarray(-over * (terms(np.log(loads[:, 0] / decoder.unit[0]), np.hypot(*over.T)) @ coefficients)[:, None])


def _moments_over_force(decoder: ForceDecoder, coefficients: FloatArray, normal: FloatArray, tilts: FloatArray) -> FloatArray:
    """Return M_x and M_y over F_z (n, 2), mm, of an undragged rod with tilts (2,), rad, towards x and y, at F_z (n,), mN."""
    size = float(np.hypot(*tilts))
    log, ratio = np.log(normal / decoder.unit[0]), np.zeros(len(normal))
    for _ in range(_ITERATIONS):
        ratio = np.clip(size / (terms(log, ratio) @ coefficients), 0.0, _BEYOND * decoder.limits[2])
    over = -decoder.unit[1] * ratio[:, None] * (tilts / size if size > 0.0 else np.zeros(2))
    return np.stack([-over[:, 1], over[:, 0]], axis=1)
