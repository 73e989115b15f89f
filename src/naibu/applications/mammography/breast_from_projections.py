"""Shape of an unloaded breast from two projections of a magnetic resonance volume, from above and from the side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.applications.mammography.breast_outline import BreastOutline
from naibu.applications.mammography.breast_shape import BreastShape, shape_from_widths
from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError

_DEPTHS = 0.1  # by which the depths of one body may differ in two projections
_ANGLE = 90.0  # between the directions along the chest wall


@dataclass(frozen=True, slots=True, eq=False)
class ProjectedBreast:
    """A breast in two projections.

    Attributes
    ----------
    shape : BreastShape
        Sections parallel to the chest wall as ellipses with the widths of both outlines.
    axial, sagittal : BreastOutline
        Outlines from above (laterally) and from the side (upwards).
    """

    shape: BreastShape
    axial: BreastOutline
    sagittal: BreastOutline

    def from_scan(self, point: ArrayLike) -> FloatArray:
        """Return a point (3,) as lateral and upward from the nipple, and from the chest wall, mm.

        Its first two coordinates are those of the axial image, its third one is the second coordinate of the sagittal image.
        """
        x, lateral, upward = np.asarray(point, dtype=float)
        depth, along = self.axial.from_image([x, lateral])
        part = depth / self.axial.depth_mm
        return np.array([along, upward - self.sagittal.nipple_mm, part * self.shape.depth_mm])


def breast_in_projections(axial: BreastOutline, sagittal: BreastOutline) -> ProjectedBreast:
    """Build the unloaded shape from outlines of maximum intensity projections.

    Parameters
    ----------
    axial, sagittal : BreastOutline
        Of the unloaded breast, from above (its second coordinate is lateral) and from the side (upwards).

    Raises
    ------
    InputError
        Depths that differ by more than a tenth, as those of one breast do not, or widths that no ellipses have.
    """
    deepest, flattest = max(axial.depth_mm, sagittal.depth_mm), min(axial.depth_mm, sagittal.depth_mm)
    if deepest - flattest > _DEPTHS * deepest:
        raise InputError(
            f"the breast is {axial.depth_mm:.4g} mm deep in the axial projection and {sagittal.depth_mm:.4g} mm in the sagittal one; "
            "outlines of one unloaded breast end at one chest wall: check both outlines and their units"
        )
    depth_mm = 0.5 * (deepest + flattest)
    parts = axial.depths / axial.depth_mm
    widths = [
        np.column_stack([np.interp(parts, outline.depths / outline.depth_mm, end) for end in (outline.low, outline.high)])
        for outline in (axial, sagittal)
    ]
    return ProjectedBreast(shape_from_widths(depth_mm * parts, widths[0], widths[1], _ANGLE), axial, sagittal)
