"""Progress of long computations: one kind of report, and one kind of callback that takes it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ProgressReport:
    """How far a computation has come.

    Attributes
    ----------
    stage : str
        What is being computed, in words for the user.
    done : float or None
        Number of parts finished: iterations, frames, levels, files; None where they are not counted.
    total : float or None
        Number of parts in all; None where it is not known beforehand.
    objective : float or None
        Value that a search minimises, or None.
    """

    stage: str
    done: float | None = None
    total: float | None = None
    objective: float | None = None

    @property
    def fraction(self) -> float | None:
        """Fraction done, between 0 and 1; None where it is not known."""
        if self.done is None or not self.total:
            return None
        return min(max(self.done / self.total, 0.0), 1.0)


Progress = Callable[[ProgressReport], None]


def report_progress(
    progress: Progress | None, stage: str, *, done: float | None = None, total: float | None = None, objective: float | None = None
) -> None:
    """Call `progress` with a report, where there is somebody to call."""
    if progress is not None:
        progress(ProgressReport(stage, done, total, objective))
