"""What this room uses of NVIDIA Warp's arrays; Warp is optional, and its devices, scalars and data types count as plain objects."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from naibu.core.arrays import AnyArray


class WarpArray(Protocol):
    """An array on a device."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Length along every axis."""

    @property
    def dtype(self) -> Callable[[float], object]:
        """Type of its elements, which makes one of a number."""

    def numpy(self) -> AnyArray:
        """Return its values, copied from the device where they are not on the processor."""

    def assign(self, values: object) -> None:
        """Set its values."""

    def fill_(self, value: object) -> None:
        """Set all its elements to a value."""

    def zero_(self) -> None:
        """Set all its elements to zero."""
