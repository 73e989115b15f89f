"""What every model of a breast between two plates can tell of one view."""

from __future__ import annotations

from typing import Protocol

from numpy.typing import ArrayLike

from naibu.applications.mammography.breast_shape import BreastShape
from naibu.core.arrays import BoolArray, FloatArray


class PressedView(Protocol):
    """A breast between two plates: maps between the unloaded breast, the compressed one and its image."""

    @property
    def shape(self) -> BreastShape:
        """The unloaded breast."""
        ...

    @property
    def silhouette(self) -> tuple[float, float]:
        """Factors by which the outline is wider and deeper than that of the unloaded breast."""
        ...

    @property
    def hidden_mm(self) -> float:
        """Tissue at the chest wall that the image does not reach."""
        ...

    def outline(self) -> FloatArray:
        """Return the outline (m, 2) in the image, depth and position along the chest wall, mm, without what the image does not reach."""
        ...

    def compress(self, points: ArrayLike) -> FloatArray:
        """Return positions along the detector, along the compression and away from the chest wall of unloaded points (..., 3), mm."""
        ...

    def uncompress(self, points: ArrayLike) -> FloatArray:
        """Return unloaded positions (..., 3): the inverse of `compress`."""
        ...

    def project(self, points: ArrayLike) -> FloatArray:
        """Return depths and positions along the chest wall (..., 2) in the image of unloaded points (..., 3), mm."""
        ...

    def on_ray(self, place: ArrayLike, count: int = 101) -> tuple[FloatArray, BoolArray]:
        """Return unloaded points (..., count, 3) that appear at a place (..., 2), and which of them lie in the breast."""
        ...
