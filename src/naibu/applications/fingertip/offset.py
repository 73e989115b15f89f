"""Offset of the readings, followed while nothing touches the fingertip."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray, as_vector, require_count, require_positive, require_within

_QUIET = 5.0  # standard deviations of a reading


@dataclass(slots=True)
class OffsetTracker:
    """Mean of the readings without load, which drifts: recalibrated while nothing touches.

    A reading within five standard deviations of the offset in all channels is taken as free; after `patience` free readings in a row the
    offset follows them. A drift under a load cannot be told from the load. A drift faster than five standard deviations in `patience`
    readings looks like a contact: call `restart` when the finger is known to be free.

    Attributes
    ----------
    noise_volts : ndarray, shape (3,)
        Standard deviation of a reading, V.
    share : float
        Of every free reading in the offset; the offset's own standard deviation is sqrt(share / 2) of the noise.
    patience : int
        Free readings in a row before the offset follows.
    offset_volts : ndarray, shape (3,)
        The offset, V.
    """

    noise_volts: FloatArray
    share: float = 0.01
    patience: int = 20
    offset_volts: FloatArray = field(default_factory=lambda: np.zeros(3))
    _free: int = 0

    def __post_init__(self) -> None:
        self.noise_volts, self.offset_volts = as_vector("noise_volts", self.noise_volts), as_vector("offset_volts", self.offset_volts)
        for value in self.noise_volts:
            require_positive("noise_volts", float(value), "V")
        require_within("share", self.share, 1e-6, 1.0)
        require_count("patience", self.patience)

    def restart(self, free_volts: ArrayLike) -> None:
        """Take the mean of readings (n, 3), V, of a finger that is known to be free as the offset."""
        self.offset_volts = np.asarray(free_volts, dtype=float).reshape(-1, 3).mean(axis=0)
        self._free = self.patience

    def without_offset(self, volts: ArrayLike) -> FloatArray:
        """Return a reading (3,), V, less the offset, and recalibrate the offset if the finger is free."""
        change = np.asarray(volts, dtype=float) - self.offset_volts
        if (np.abs(change) < _QUIET * self.noise_volts).all():
            self._free += 1
            if self._free > self.patience:
                self.offset_volts = self.offset_volts + self.share * change
        else:
            self._free = 0
        return np.asarray(change)
