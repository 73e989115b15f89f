"""Amplifiers, offset and analogue-to-digital conversion behind the bridges, with noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray, require_count, require_positive, require_within
from naibu.core.errors import InputError

_SD_IN_WIDTH = 6.0  # a noise's width from peak to peak, in standard deviations


@dataclass(frozen=True, slots=True)
class Readout:
    """Electronics of the three channels F_z, M_x and M_y.

    Attributes
    ----------
    gains : tuple of float
        Of the three amplifiers.
    noise_width : tuple of float
        Peak-to-peak width of the noise after the amplifiers, V, taken as six standard deviations.
    adc_bits : int
        Of the converter.
    adc_limit : float
        The converter takes voltages between minus and plus this, V.
    sample_rate_hz : float
        Readings a second.

    Raises
    ------
    InputError
        Gains, widths, limits or rates that are not positive, or a number of bits beyond 1 to 32.
    """

    gains: tuple[float, float, float]
    noise_width: tuple[float, float, float]
    adc_bits: int
    adc_limit: float
    sample_rate_hz: float

    def __post_init__(self) -> None:
        for name, values in (("gains", self.gains), ("noise_width", self.noise_width)):
            if len(values) != 3:
                raise InputError(f"{name} has {len(values)} numbers; give three, for F_z, M_x and M_y")
            for value in values:
                require_positive(name, value)
        require_count("adc_bits", self.adc_bits)
        require_within("adc_bits", self.adc_bits, 1, 32)
        require_positive("adc_limit", self.adc_limit, "V")
        require_positive("sample_rate_hz", self.sample_rate_hz)

    @property
    def step(self) -> float:
        """Smallest difference of the converter, V."""
        return float(2.0 * self.adc_limit / 2**self.adc_bits)

    @property
    def noise_sd(self) -> FloatArray:
        """Standard deviation of the noise (3,), V."""
        return np.asarray(self.noise_width) / _SD_IN_WIDTH

    def measurable(self, sensitivities: ArrayLike) -> FloatArray:
        """Return the largest loads (3,), mN and mN mm, before the converter saturates; sensitivities (3,) in mV per unit."""
        return np.asarray(self.adc_limit / (np.asarray(self.gains) * 1e-3 * np.abs(np.asarray(sensitivities, dtype=float))))

    def load_noise(self, sensitivities: ArrayLike) -> FloatArray:
        """Return the standard deviation of a reading (3,), mN and mN mm, of noise and conversion."""
        total = np.sqrt(self.noise_sd**2 + self.step**2 / 12.0)
        return np.asarray(total / (np.asarray(self.gains) * 1e-3 * np.abs(np.asarray(sensitivities, dtype=float))))

    def converted(
        self, bridge_mv: FloatArray, rng: np.random.Generator, *, offset_mv: ArrayLike = 0.0, trimmed_mv: ArrayLike = 0.0
    ) -> FloatArray:
        """Return the readings of the converter.

        Parameters
        ----------
        bridge_mv : ndarray, shape (n, 3)
            Outputs of the bridges, mV.
        rng : numpy.random.Generator
            Of the noise.
        offset_mv, trimmed_mv : array_like, shape (3,)
            Output of the bridges without load, and what the trimmer at the bridge takes off before the amplifier, mV.

        Returns
        -------
        ndarray, shape (n, 3)
            V; at the limits where the converter saturates.
        """
        offset = np.asarray(offset_mv, dtype=float) - np.asarray(trimmed_mv, dtype=float)
        volts = 1e-3 * np.asarray(self.gains) * (bridge_mv + offset)
        noisy = volts + self.noise_sd * rng.standard_normal(bridge_mv.shape)
        codes = np.clip(np.round(noisy / self.step), -(2 ** (self.adc_bits - 1)), 2 ** (self.adc_bits - 1) - 1)
        return np.asarray(codes * self.step)


def report_readout() -> Readout:
    """Return gains 2000, 500, 500 and noise 0.37, 0.1, 0.1 V of the 2008 report :cite:p:`hirai2008`.

    Its converter has 12 bits; the range of 10 V and 100 readings a second are assumed.
    """
    return Readout((2000.0, 500.0, 500.0), (0.37, 0.1, 0.1), 12, 10.0, 100.0)
