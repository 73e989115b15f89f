"""How often volumes larger than memory are passed through, and what is done in which pass."""

from __future__ import annotations

from dataclasses import dataclass

ROUGH_PASSES = 6  # Gauss-Newton steps with voxels of an edge in between, where there are such
MORE_PASSES = 2  # while cells still move


@dataclass(frozen=True, slots=True)
class Schedule:
    """Numbers of passes through the volumes.

    Attributes
    ----------
    rough : int
        Those with voxels of an edge in between, from which the others begin nearly converged.
    """

    rough: int

    @classmethod
    def of(cls, factor: int) -> Schedule:
        """Return the schedule for coarse volumes of every so many voxels."""
        return cls(ROUGH_PASSES if factor > 2 and factor % 2 == 0 else 0)

    @property
    def adapted(self) -> int:
        """The one in which weights are adapted."""
        return self.rough + (2 if self.rough else 4)

    @property
    def least(self) -> int:
        """The last one where cells no longer move."""
        return self.rough + (4 if self.rough else 7)

    @property
    def most(self) -> int:
        """The last one."""
        return self.least + MORE_PASSES

    def is_first_of_its_kind(self, number: int) -> bool:
        """Whether a pass has other voxels or weights than the one before, so that other steps follow."""
        return number in (1, self.rough + 1, self.adapted, self.adapted + 1)
