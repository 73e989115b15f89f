"""What a sensing chip reads of the loads on its package: bridges, amplifiers and converter, and loads from voltages."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.applications.sensing_chip.bridge import MEASURED, sensitivity_matrix
from naibu.applications.sensing_chip.chip_mesh import ChipResolution
from naibu.applications.sensing_chip.design import ChipDesign
from naibu.applications.sensing_chip.electronics import Readout
from naibu.applications.sensing_chip.finite_elements import solve_chip
from naibu.core.arrays import BoolArray, FloatArray, as_points

_DECIMALS = 9  # of volts: less is rounding


@dataclass(frozen=True, slots=True, eq=False)
class ReadingChain:
    """From the loads on the chip to the converter's readings.

    Attributes
    ----------
    sensitivities : ndarray, shape (3, 6)
        Outputs of the bridges per unit of F_x, F_y, F_z, M_x, M_y, M_z, mV/mN and mV/(mN mm).
    readout : Readout
        The electronics.
    """

    sensitivities: FloatArray
    readout: Readout

    @classmethod
    def of_chip(cls, design: ChipDesign, readout: Readout, resolution: ChipResolution | None = None) -> ReadingChain:
        """Return the chain of a chip, by finite elements of the whole of it."""
        return cls(sensitivity_matrix(solve_chip(design, resolution)), readout)

    @property
    def own(self) -> FloatArray:
        """Sensitivity of every bridge to its own load (3,), mV per mN or mN mm."""
        return np.asarray(self.sensitivities[np.arange(3), list(MEASURED)])

    @property
    def volts_per_load(self) -> FloatArray:
        """Amplified voltage per unit of F_z, M_x and M_y (3,), V/mN and V/(mN mm)."""
        return np.asarray(1e-3 * np.asarray(self.readout.gains) * self.own)

    @property
    def noise(self) -> FloatArray:
        """Standard deviation of a reading (3,), mN and mN mm, of noise and conversion."""
        return self.readout.load_noise(self.own)

    def volts(self, loads: FloatArray) -> FloatArray:
        """Return amplified voltages (n, 3), V, of loads (n, 6) on the chip, mN and mN mm, without noise, offset or saturation."""
        return np.asarray(np.round(1e-3 * np.asarray(self.readout.gains) * (loads @ self.sensitivities.T), _DECIMALS) + 0.0)

    def converted(
        self, loads: FloatArray, rng: np.random.Generator, *, offset_mv: ArrayLike = 0.0, trimmed_mv: ArrayLike = 0.0
    ) -> FloatArray:
        """Return readings (n, 3), V, of loads (n, 6) with noise and saturation; see `Readout.converted` for the offsets (3,), mV."""
        return self.readout.converted(loads @ self.sensitivities.T, rng, offset_mv=offset_mv, trimmed_mv=trimmed_mv)

    def saturated(self, volts: FloatArray) -> BoolArray:
        """Return whether each reading (n, 3) is at the converter's limits, bool."""
        return np.asarray(np.abs(volts) >= self.readout.adc_limit - self.readout.step)

    def measured_loads(self, volts: ArrayLike) -> FloatArray:
        """Return F_z, M_x, M_y (n, 3), mN and mN mm, as the bridges read them, crosstalk of lateral forces included, from voltages."""
        return as_points("volts", volts, 3) / self.volts_per_load
