"""Load cases: what all identifications have in common, whatever was measured under the load.

`MarkerLoadCase` (markers in a loaded state of a specimen), `FieldLoadCase` (a displacement field) and `MotionLoadCase` (displacement
histories) hold the data of different experiments and models, and are load cases in this sense.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from naibu.core.errors import InputError


class LoadCase(Protocol):
    """One loading of a body, with what was measured under it."""

    @property
    def name(self) -> str:
        """Name for messages and tables."""
        ...

    @property
    def n_data(self) -> int:
        """Number of measured components."""
        ...


def require_load_cases(load_cases: Sequence[LoadCase]) -> None:
    """Refuse an identification without data.

    Raises
    ------
    InputError
        There is no load case, or one without a measured component.
    """
    if not load_cases:
        raise InputError("load_cases is empty; give at least one load case")
    for load_case in load_cases:
        if not load_case.n_data:
            raise InputError(f"load case {load_case.name!r} has no measured component; leave it out")
