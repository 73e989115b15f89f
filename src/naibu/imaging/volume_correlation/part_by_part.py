"""Digital volume correlation of parts of an object that slide on each other, such as lungs on the wall of the chest.

The displacement jumps where organs slide, and one smooth field misses it on both sides. Registration of each part by itself, within a mask,
lets it jump :cite:p:`wu2008`. Parts are told apart by their intensity, and measured by themselves only where one field leaves
structures apart.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from naibu.core.arrays import BoolArray
from naibu.core.errors import InputError
from naibu.core.progress import Progress
from naibu.core.volume import Volume
from naibu.imaging.preprocessing.field_of_view import fields_of_view
from naibu.imaging.preprocessing.intensity_parts import intensity_parts
from naibu.imaging.preprocessing.object_mask import mask_in_view
from naibu.imaging.volume_correlation.correlate import correlate_volumes
from naibu.imaging.volume_correlation.results.correlation_result import CorrelationResult

# empirical: fraction of the cells that one field leaves more than a voxel apart, above which parts are measured by themselves. Legs and
# chests that move as one have none, lungs that slide by 17 mm along a wall without texture 0.05, those that slide by 20 mm 0.3
APART = 0.04
# of what one field leaves apart in a part. Where the own field of a part leaves less than that, parts slide on each other, and one field is
# wrong on both sides of where they do: every part then has its own, unless that leaves so much more that it has lost its way
LESS, LOST = 0.8, 2.0
SAMPLED = 7  # every so many voxels of a part are looked at


def correlated_parts(
    reference: Volume, deformed: Volume, inside: BoolArray, whole: CorrelationResult, *, progress: Progress | None = None
) -> tuple[tuple[BoolArray, CorrelationResult], ...]:
    """Return parts of an object and their own displacement, where one field leaves structures of the object apart.

    Parameters
    ----------
    reference, deformed : Volume
        Volumes before and after the deformation, on one grid.
    inside : ndarray, shape (nz, ny, nx), bool
        Voxels of the object in the reference.
    whole : CorrelationResult
        Displacement of the object by one field.
    progress : Progress, optional
        As of `correlate_volumes`.

    Returns
    -------
    tuple of (ndarray of shape (nz, ny, nx), CorrelationResult)
        Voxels of parts, all of them if the own field of one leaves less apart, but for those that cannot be measured by themselves; none
        where the object moves as one, or has one intensity only.
    """
    if whole.misplaced_fraction < APART:
        return ()
    parts = intensity_parts(reference, inside)
    if not parts:
        return ()
    shown = intensity_parts(deformed, mask_in_view(deformed, fields_of_view(reference, deformed)[1]))
    found, left = [], []
    for part, there in zip(parts, shown or (None,) * len(parts), strict=True):
        try:
            own = correlate_volumes(reference, deformed, mask=part, deformed_mask=there, progress=progress)
        except InputError:
            continue  # too small, or without content in common: the field of the whole object stands, and tells that it is uncertain
        found.append((part, own))
        left.append((_left_apart(own, part), _left_apart(whole, part)))
    return tuple(each for each, chosen in zip(found, with_own_field(left), strict=True) if chosen)


def with_own_field(left_mm: Sequence[tuple[float, float]]) -> list[bool]:
    """Return which parts are measured by themselves, of what their own field and that of the whole object leave apart in each, mm."""
    if not any(own < LESS * one for own, one in left_mm):
        return [False] * len(left_mm)
    return [own <= LOST * one for own, one in left_mm]


def _left_apart(found: CorrelationResult, part: BoolArray) -> float:
    """Return the mean distance, mm, that a field leaves between structures of a part."""
    at = np.argwhere(part)[::SAMPLED, ::-1]
    return float(np.nanmean(np.sqrt(found.misplacement_at(found.volume.to_physical(at)))))
