"""Whether the outlines of CC and MLO may have been swapped: what outlines tell of it, and what they cannot.

Two outlines with one angle between their planes fit either order alike: the breast of the one order is the mirror image of that of the
other, with the same volumes, epipolar curves and errors. Only anatomy and gravity tell them apart: the breast hangs, so that in MLO more of
it lies above the nipple than below, while in CC it lies about as much laterally as medially.
"""

from __future__ import annotations

import numpy as np

from naibu.applications.mammography.breast_outline import BreastOutline

_LEAST = 0.001  # difference of the shares that counts


def excess_above_nipple(outline: BreastOutline) -> float:
    """Return the area of an outline above (in CC: laterally of) the nipple less that below, over all of it: -1 to 1."""
    part = np.gradient(outline.depths)
    return float(part @ (outline.high + outline.low) / (part @ (outline.high - outline.low)))


def may_be_swapped(cc: BreastOutline, mlo: BreastOutline) -> bool:
    """Return whether more of the breast lies laterally of the nipple in CC than above it in MLO: views that are swapped, or hung wrongly.

    Parameters
    ----------
    cc, mlo : BreastOutline
        As they were given.
    """
    return excess_above_nipple(mlo) < excess_above_nipple(cc) - _LEAST
