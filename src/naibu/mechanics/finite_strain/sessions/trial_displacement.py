"""A displacement that an iteration of a step has reached, and what is out of balance there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import FloatArray

FINISHED = 2.5e-3  # out-of-balance force, as a fraction of all forces, at which a step ends
SETTLED = 1e-4  # below which no iteration is worth while, also as a fraction of the contact forces, if ten times as much
FELT = 5e-3  # fraction of the contact forces that it must also be below: beside forces in a nearly incompressible body those are small
PASSABLE = 5e-2  # at which a step may end that is late
VOLUME_ERROR = 3e-4  # difference of the volume strain and that of its pressure


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """A displacement and its pressures, and what is out of balance there.

    Attributes
    ----------
    displacement : ndarray, shape (n, 3)
        mm.
    pressure : ndarray, shape (m,)
        kPa, see `naibu.mechanics.finite_elements.pressure_elements`.
    balance : ndarray, shape (n, 3)
        All forces but those of contact, those on constrained nodes included, mN.
    contact : ndarray, shape (n, 3)
        Forces of contact, mN.
    mismatch : ndarray, shape (m,)
        Of the pressures with the dilatations, kPa.
    error : float
        Sum of the out-of-balance forces of the nodes, as a fraction of that of all forces.
    felt : float
        The same, as a fraction of the forces of contact, or of pulls on gripped nodes where these are more; 0 without contact.
    """

    displacement: FloatArray
    pressure: FloatArray
    balance: FloatArray
    contact: FloatArray
    mismatch: FloatArray
    error: float
    felt: float

    @property
    def unbalanced(self) -> float:
        """What is out of balance, as a fraction of all forces, or of those of contact or pulling, whichever is most."""
        return max(self.error, self.felt)

    def better(self, other: Trial | None) -> Trial:
        """Return the one nearer to balance."""
        return self if other is None or self.error <= other.error else other

    def finished(self, bulk: FloatArray, *, begun: bool) -> bool:
        """Whether the step may end here, at the beginning of the iterations or where they have `begun`; for bulk moduli (m,), kPa."""
        error, felt = (FINISHED, FELT) if begun else (SETTLED, 10.0 * SETTLED)
        return self.felt <= felt and self.error <= error and self._volume_error(bulk) <= VOLUME_ERROR

    def passable(self, bulk: FloatArray) -> bool:
        """Whether a step that is late may end here."""
        return self.error <= PASSABLE and self._volume_error(bulk) <= 10.0 * VOLUME_ERROR

    def _volume_error(self, bulk: FloatArray) -> float:
        return float(np.abs(self.mismatch / bulk).max())
