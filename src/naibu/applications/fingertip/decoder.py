"""Contact forces from readings of the chip: size, direction and place with intervals, learnt from presses of the model.

Of the three readings, F_z grows with the force, and the size of the moment over F_z with the tilt; the moment's direction tells the
azimuth. Polynomials in the logarithm of F_z and in the ratio are fitted to presses of many tilts, frictions and Young's moduli; what they
leave of these goes into the intervals, beside the noise of the readings and a stated relative error of the model.

Three readings do not tell five unknowns: the decoder supposes a rod that presses towards the centre of the hemisphere. Under a force that
drags sideways, direction and place are wrong; `naibu.applications.fingertip.slip` tells of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.applications.fingertip._decoder_kernels import (
    ACROSS_SD,
    AZIMUTH_OUT,
    FORCE_OUT,
    FORCE_SD,
    OUTPUTS,
    POSITION_OUT,
    POSITION_SD,
    TILT_OUT,
    TILT_SD,
    decode_readings,
    terms,
)
from naibu.applications.fingertip.fingertip import Fingertip
from naibu.applications.fingertip.pressing import Press, Pressing
from naibu.applications.fingertip.readings import ReadingChain
from naibu.core.arrays import BoolArray, FloatArray, as_points, require_count, require_within
from naibu.core.errors import InputError

NORMAL_95 = 1.96
PLANE_95 = 2.4477  # radius that holds 95 % of a normal distribution in the plane
_LOADS = 24  # forces of every press that the polynomials are fitted to
_LEAST_POSITION_MM = 1e-3
_SLIDE, _SLIDE_FORCE = 0.15, 0.7  # of the radius, and of the largest force


@dataclass(frozen=True, slots=True)
class Training:
    """Presses that a decoder learns from.

    Attributes
    ----------
    tilts_deg : tuple of float
        At least four, the first 0; the decoder answers between them.
    frictions : tuple of float
        Coefficients between which the friction lies.
    young_moduli_kpa : tuple of float
        Smallest and largest Young's modulus of the gel.
    force_mn : tuple of float
        Smallest and largest force.
    model_error : float
        Relative standard deviation of the model's F_z and moments: of the mesh, and of what is not modelled.

    Raises
    ------
    InputError
        Too few tilts, or ranges that do not grow.
    """

    tilts_deg: tuple[float, ...] = (0.0, 10.0, 20.0, 28.0, 35.0)
    frictions: tuple[float, ...] = (0.2, 1.0)
    young_moduli_kpa: tuple[float, float] = (200.0, 240.0)
    force_mn: tuple[float, float] = (150.0, 3300.0)
    model_error: float = 0.02

    def __post_init__(self) -> None:
        require_count("number of tilts_deg", len(self.tilts_deg), 4)
        if self.tilts_deg[0] != 0.0 or any(b - a < 1.0 for a, b in zip(self.tilts_deg, self.tilts_deg[1:], strict=False)):
            raise InputError(f"tilts_deg are {list(self.tilts_deg)}; begin with 0, and let them grow by at least 1 degree")
        require_count("number of frictions", len(self.frictions), 1)
        for name in ("young_moduli_kpa", "force_mn"):
            low, high = getattr(self, name)
            if not 0.0 < low < high < np.inf:
                raise InputError(f"{name} is {low:g} to {high:g}; give two positive numbers that grow")
        require_within("model_error", self.model_error, 0.0, 0.5)

    def presses(self, fingertip: Fingertip) -> tuple[Press, ...]:
        """Return the presses that must be computed: their forces suffice for every modulus in the range."""
        most = 1.02 * self.force_mn[1] * max(1.0, fingertip.young_modulus_kpa / self.young_moduli_kpa[0])
        return tuple(Press(tilt, most, friction) for friction in self.frictions for tilt in self.tilts_deg)

    def slides(self, fingertip: Fingertip) -> tuple[Press, ...]:
        """Return presses that are then dragged, to either side, with tilts between those of the others."""
        friction, way, force = max(self.frictions), _SLIDE * fingertip.radius_mm, _SLIDE_FORCE * self.force_mn[1]
        low, high = np.mean(self.tilts_deg[:2]), np.mean(self.tilts_deg[-2:])
        return Press(float(low), force, friction, way), Press(float(high), force, friction, -way)

    def moduli(self) -> FloatArray:
        """Return the moduli (3,) that the decoder learns from, kPa."""
        low, high = self.young_moduli_kpa
        return np.array([low, 0.5 * (low + high), high])


@dataclass(frozen=True, slots=True, eq=False)
class DecodedForces:
    """Forces on a fingertip; NaN where a reading is not answered.

    Attributes
    ----------
    force_mn : ndarray, shape (n,)
        Size of the force, mN.
    force_95 : ndarray, shape (n, 2)
        Its 95 % interval.
    tilt_deg, azimuth_deg : ndarray, shape (n,)
        Direction from which the force comes: angle from the base's normal, and from x towards y, degrees.
    tilt_95_deg : ndarray, shape (n, 2)
        Interval of the tilt.
    cone_95_deg : ndarray, shape (n,)
        Half angle of the cone around the direction that holds the true one, degrees.
    position_mm : ndarray, shape (n, 3)
        Centre of the contact, on the hemisphere at rest.
    position_95_mm : ndarray, shape (n,)
        Radius around it that holds the true one.
    """

    force_mn: FloatArray
    force_95: FloatArray
    tilt_deg: FloatArray
    azimuth_deg: FloatArray
    tilt_95_deg: FloatArray
    cone_95_deg: FloatArray
    position_mm: FloatArray
    position_95_mm: FloatArray

    @property
    def direction(self) -> FloatArray:
        """Unit vectors (n, 3) from which the forces come: the forces on the fingertip are opposite."""
        return directions(self.tilt_deg, self.azimuth_deg)

    @property
    def answered(self) -> BoolArray:
        """Whether a reading lies within the training (n,), bool."""
        return np.asarray(np.isfinite(self.force_mn))


def directions(tilt_deg: ArrayLike, azimuth_deg: ArrayLike) -> FloatArray:
    """Return unit vectors (..., 3) of tilts from z and azimuths from x towards y, degrees."""
    tilt, azimuth = np.deg2rad(tilt_deg), np.deg2rad(azimuth_deg)
    return np.stack([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt) * np.ones_like(azimuth)], axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class ForceDecoder:
    """Force, direction and place of a contact from three voltages.

    Attributes
    ----------
    radius_mm : float
        Of the hemisphere.
    volts_per_load : ndarray, shape (3,)
        Of F_z, M_x and M_y, V/mN and V/(mN mm).
    noise : ndarray, shape (3,)
        Standard deviation of F_z, M_x and M_y, mN and mN mm, of the readings that are decoded; less where they are filtered.
    coefficients : ndarray, shape (3, terms)
        Of log force, of tilt over ratio, and of the contact's angle over ratio, rad.
    unit : ndarray, shape (2,)
        F_z, mN, and length, mm, that scale the readings.
    spread : ndarray, shape (3,)
        Standard deviation of what the polynomials leave of the training: of log force, tilt and the contact's angle.
    limits : ndarray, shape (3,)
        Smallest and largest F_z, mN, and largest moment over F_z and length.
    model_error : float
        Relative standard deviation of F_z and moments.
    """

    radius_mm: float
    volts_per_load: FloatArray
    noise: FloatArray
    coefficients: FloatArray
    unit: FloatArray
    spread: FloatArray
    limits: FloatArray
    model_error: float

    def decode(self, volts: ArrayLike, *, offset: ArrayLike = 0.0, noise_share: float = 1.0) -> DecodedForces:
        """Decode readings.

        Parameters
        ----------
        volts : array_like, shape (n, 3)
            Of F_z, M_x and M_y, V.
        offset : array_like, shape (3,)
            Readings without load, V.
        noise_share : float
            Standard deviation of the noise that is left over that of the readings, such as `noise_gain` of a filter.

        Raises
        ------
        InputError
            Readings of another shape.
        """
        loads = (as_points("volts", volts, 3) - np.asarray(offset, dtype=float)) / self.volts_per_load
        found = self.decode_loads(loads, noise_share)
        tilt, azimuth = np.rad2deg(np.maximum(found[:, TILT_OUT], 0.0)), np.rad2deg(found[:, AZIMUTH_OUT])
        sd = np.rad2deg(found[:, TILT_SD])
        cone = PLANE_95 * np.maximum(sd, np.rad2deg(found[:, ACROSS_SD]))
        half = NORMAL_95 * sd
        relative = NORMAL_95 * found[:, FORCE_SD]
        force = found[:, FORCE_OUT]
        place = directions(np.rad2deg(found[:, POSITION_OUT]), azimuth) * self.radius_mm
        return DecodedForces(
            force, np.stack([force * np.exp(-relative), force * np.exp(relative)], axis=1), tilt, azimuth,
            np.stack([np.maximum(tilt - half, 0.0), tilt + half], axis=1), cone, place,
            np.maximum(PLANE_95 * found[:, POSITION_SD] * self.radius_mm, _LEAST_POSITION_MM),
        )  # fmt: skip

    def decode_loads(self, loads: FloatArray, noise_share: float = 1.0) -> FloatArray:
        """Return what the kernel finds of F_z, M_x, M_y (n, 3), mN and mN mm: (n, 8), see `_decoder_kernels`; the fast way for a loop."""
        out = np.empty((len(loads), OUTPUTS))
        noise = noise_share * self.noise[:2]
        decode_readings(loads, self.coefficients, self.unit, self.spread, noise, self.model_error, self.limits, out)
        return out


def train_decoder(fingertip: Fingertip, chain: ReadingChain, training: Training, pressings: Sequence[Pressing]) -> ForceDecoder:
    """Fit a decoder to presses.

    Parameters
    ----------
    fingertip : Fingertip
        That was pressed.
    chain : ReadingChain
        Its chip.
    training : Training
        What the presses are.
    pressings : sequence of Pressing
        Of ``training.presses(fingertip)``, in that order.

    Raises
    ------
    InputError
        Another number of presses.
    """
    wanted = training.presses(fingertip)
    if len(pressings) != len(wanted):
        raise InputError(f"pressings has {len(pressings)} presses, the training {len(wanted)}; give those of `presses`")
    samples = [training_samples(p.for_modulus(e), chain, training) for p in pressings for e in training.moduli()]
    loads, force, tilt, place = (np.concatenate(column) for column in zip(*samples, strict=True))
    unit = np.array([float(np.exp(np.log(loads[:, 0]).mean())), fingertip.package_diameter_mm])
    ratio = np.hypot(loads[:, 1], loads[:, 2]) / (loads[:, 0] * unit[1])
    basis = terms(np.log(loads[:, 0] / unit[0]), ratio)
    coefficients = np.empty((3, basis.shape[1]))
    spread = np.empty(3)
    coefficients[0] = np.linalg.lstsq(basis, np.log(force), rcond=None)[0]
    spread[0] = spread_95(basis @ coefficients[0] - np.log(force))
    for k, angle in ((1, tilt), (2, place)):
        coefficients[k] = np.linalg.lstsq(ratio[:, None] * basis, angle, rcond=None)[0]
        spread[k] = spread_95(ratio * (basis @ coefficients[k]) - angle)
    limits = np.array([loads[:, 0].min(), loads[:, 0].max(), ratio.max()])
    return ForceDecoder(fingertip.radius_mm, chain.volts_per_load, chain.noise, coefficients, unit, spread, limits, training.model_error)


def training_samples(pressing: Pressing, chain: ReadingChain, training: Training) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return loads as measured (k, 3), sizes of the force, mN, its tilts and those of the contact's centre (k,), rad."""
    along = np.geomspace(*training.force_mn, _LOADS)
    loads = chain.measured_loads(chain.volts(pressing.at_force(along)))
    return loads, *true_contact(pressing, along)


def true_contact(pressing: Pressing, along_rod_mn: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return size of the force (k,), mN, and the angles from z of its direction and of the contact's centre (k,), rad.

    Parameters
    ----------
    pressing : Pressing
        A press.
    along_rod_mn : ndarray, shape (k,)
        Forces along its rod, mN.
    """
    force = pressing.interpolated(pressing.force_mn, along_rod_mn)
    touched = np.isfinite(pressing.contact_mm[:, 0])
    first = pressing.contact_mm[touched][0]
    centre = pressing.interpolated(np.where(touched[:, None], pressing.contact_mm, first), along_rod_mn)
    return np.linalg.norm(force, axis=1), np.arctan2(-force[:, 0], -force[:, 2]), np.arctan2(centre[:, 0], centre[:, 2])


def spread_95(residual: FloatArray) -> float:
    """Return a standard deviation whose 95 % interval holds 99 % of the residuals."""
    return float(np.quantile(np.abs(residual), 0.99)) / NORMAL_95
