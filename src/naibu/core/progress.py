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
    share : float or None
        Fraction done where parts differ in length; None where it is `done` over `total`.
    """

    stage: str
    done: float | None = None
    total: float | None = None
    objective: float | None = None
    share: float | None = None

    @property
    def fraction(self) -> float | None:
        """Fraction done, between 0 and 1; None where it is not known."""
        if self.share is None and (self.done is None or not self.total):
            return None
        share = self.share if self.share is not None else float(self.done or 0.0) / float(self.total or 1.0)
        return min(max(share, 0.0), 1.0)


Progress = Callable[[ProgressReport], None]


def report_progress(
    progress: Progress | None,
    stage: str,
    *,
    done: float | None = None,
    total: float | None = None,
    objective: float | None = None,
    share: float | None = None,
) -> None:
    """Call `progress` with a report, where there is somebody to call."""
    if progress is not None:
        progress(ProgressReport(stage, done, total, objective, share))
