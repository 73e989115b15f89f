"""Digital volume correlation of parts of an object that slide on each other, such as lungs on the wall of the chest.

The displacement jumps where organs slide, and one smooth field misses it on both sides. Registration of each part by itself, within a
mask, lets it jump :cite:p:`wu2008`. Parts are told apart by their intensity, and tried by themselves only where one field leaves
structures apart. They keep their fields where these differ, at the surface that the parts share, by more than both are uncertain by. What
slides within a part is left out of its field, and not answered.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import ndimage

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.progress import Progress
from naibu.core.volume import Volume
from naibu.imaging.preprocessing.field_of_view import fields_of_view
from naibu.imaging.preprocessing.intensity_parts import intensity_parts, structures_of_another
from naibu.imaging.preprocessing.morphology import large_regions
from naibu.imaging.preprocessing.object_mask import mask_in_view
from naibu.imaging.volume_correlation.correlate import correlate_volumes
from naibu.imaging.volume_correlation.results.correlation_result import CorrelationResult

# empirical: fraction of the cells that one field leaves more than a voxel apart, above which parts are measured by themselves. Legs and
# chests that move as one have none, lungs that slide by 17 mm along a wall without texture 0.05, those that slide by 20 mm 0.3
APART = 0.04
# empirical: voxels that one field leaves structures apart, and in which fraction of the cells, above which parts are tried. Legs, and
# chests that move as one, have none; lungs that slide by 5 mm in scans of 3 mm voxels 0.024, those that slide by 11 mm 0.15
TRIED_VOXELS, TRIED = 0.25, 0.01
# empirical: of the voxels on the surface that two parts share, those where the fields of both differ by more than the 95 % region of their
# difference. Chests whose lungs do not slide have up to 0.05, those whose lungs slide by 13 mm or more 0.3 to 0.55
JUMPING = 0.1
CHI_SQUARED_95 = 7.815  # three degrees of freedom
# a voxel next to another part may hold as much of that one: at the surface half of it, a voxel away none, a quarter in the mean
OF_THE_OTHER = 0.25
# of what one field leaves apart in a part. Where the own field of a part leaves less than that, parts slide on each other, and one field is
# wrong on both sides of where they do: every part then has its own, unless that leaves so much more that it has lost its way
LESS, LOST = 0.8, 2.0
# empirical, voxels: what a field leaves apart without having lost its way. What is in one scan only, at the surface of a part that slides,
# counts too: up to half a voxel in parts whose fields are right
LITTLE_VOXELS = 0.5
# share of a part that has to match: both scans are known to show it. What does not match is not answered, as what slides within it
LEAST_MATCHED = 0.5
# empirical: voxels that the own field of a part leaves structures apart, in a fraction `APART` of its cells, above which something slides
# within it. The walls of chests with livers that slide by 20 to 45 mm have 0.13 to 0.28, halves of balls that slide on each other 0.02
FAR_VOXELS = 3.0
# empirical: median of the weights of bending without what slides within a part, over that with it. Without livers the walls of chests have
# 9 to 42, a ball of which a third is another one in the second scan, which hides nothing of the rest, 1.02
STIFFER = 2.0
# empirical, cells: what is so near to voxels that are left so far apart may be the same, since the place of a residual is known by its cell
# only. Of the livers of two chests, up to 0.3 per cent lay within 0.17 cells, off by 25 mm, and no other was answered
RIM = 0.2
SMALLEST = 0.02  # of a part: smaller regions that its field brings together may be so by chance
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
        Voxels of parts, as of `with_thin_structures`, all of them if their fields differ where they meet, or the own field of one leaves
        less apart, but for those that cannot be measured by themselves; none where the object moves as one, or has one intensity only.
    """
    if whole.apart_fraction(TRIED_VOXELS) < TRIED:
        return ()
    parts = intensity_parts(reference, inside)
    if not parts:
        return ()
    shown = intensity_parts(deformed, mask_in_view(deformed, fields_of_view(reference, deformed)[1]))
    found, left = [], []
    for part, there in zip(parts, shown or (None,) * len(parts), strict=True):
        try:
            own = correlate_volumes(reference, deformed, mask=part, deformed_mask=there, least_matched=LEAST_MATCHED, progress=progress)
            if own.apart_fraction(FAR_VOXELS) > APART:
                own = without_what_slides(reference, deformed, part, own, progress)
        except InputError:
            continue  # too small, or without content in common: the field of the whole object stands, and tells that it is uncertain
        found.append((part, own))
        answered = part & own.valid
        left.append((_left_apart(own, answered), _left_apart(whole, answered)))
    little = LITTLE_VOXELS * float(np.prod(reference.spacing_mm)) ** (1.0 / 3.0)
    # a field that has lost its way is no witness of a slide
    seen = len(found) == len(parts) and all(with_own_field(left, jumping=True, little_mm=little))
    jumping = seen and jump_fraction(*found) > JUMPING
    if not jumping and whole.misplaced_fraction < APART:
        return ()
    chosen = with_own_field(left, jumping=jumping, little_mm=little)
    kept = tuple(each for each, own in zip(found, chosen, strict=True) if own)
    return with_thin_structures(reference, parts, kept)


def with_thin_structures(
    reference: Volume, parts: tuple[BoolArray, ...], found: tuple[tuple[BoolArray, CorrelationResult], ...]
) -> tuple[tuple[BoolArray, CorrelationResult], ...]:
    """Return parts with their displacement, each with what it has of thin structures within the others, and without what they have in it.

    Tongues of tissue between lungs, too thin to be told apart by their size, do not move as the lungs do. Nor are they measured with the
    part that they belong to: they are not answered. On the surface of the part that they belong to, `doubt_beside` holds either motion.

    Parameters
    ----------
    reference : Volume
        Volume before the deformation.
    parts : tuple of ndarray, shape (nz, ny, nx), bool
        All parts of the object.
    found : tuple of (ndarray of shape (nz, ny, nx), CorrelationResult)
        Those that have a field of their own, with it.
    """
    shown = [part.copy() for part in parts]
    for k, part in enumerate(parts):
        for m, other in enumerate(parts):
            if m == k:
                continue
            thin, beside = structures_of_another(reference, part, other), _next_to(part, other)
            fields = [field for where, field in found if where is other]
            if fields:
                moved = fields[0].displacement_at(reference.to_physical(beside[:, ::-1]))
                thin[tuple(beside[np.isfinite(moved).all(axis=1)].T)] = False
            shown[k] &= ~thin
            shown[m] |= thin
    return tuple((mine, field) for mine, part in zip(shown, parts, strict=True) for where, field in found if where is part)


def _not_answered(found: CorrelationResult, left: BoolArray) -> CorrelationResult:
    """Return a field without an answer in some voxels (nz, ny, nx)."""
    field = found.displacement
    vectors = field.vectors.copy()
    vectors[left] = np.nan
    return replace(found, displacement=replace(field, vectors=vectors, valid=field.valid & ~left))


def without_what_slides(
    reference: Volume, deformed: Volume, part: BoolArray, found: CorrelationResult, progress: Progress | None = None
) -> CorrelationResult:
    """Return the field of a part without what another field of it leaves apart, such as a liver within the wall of a chest.

    What slides within a part drags its field along, and makes penalties of bending look too strong everywhere: their most probable weights
    are higher without it. `found` itself is returned where they are not, or too little of the part is left. What is within `RIM` of it may
    be the same, and is not answered either.
    """
    kept = _brought_together(part, found)
    if not kept.any():
        return found
    moved = np.median(found.volume.to_index(found.volume.origin_mm + found.displacement.vectors[kept]), axis=0)
    there = ndimage.shift(kept.astype(np.uint8), np.rint(moved)[::-1], order=0).astype(bool)
    shown = there if there.any() else None
    try:
        rest = correlate_volumes(reference, deformed, mask=kept, deformed_mask=shown, least_matched=LEAST_MATCHED, progress=progress)
    except InputError:
        return found
    if not np.nanmedian(rest.bending) > STIFFER * np.nanmedian(found.bending):
        return found
    # nothing tells how what is left apart moves, nor exactly where it ends
    away = ndimage.distance_transform_edt(kept | ~(part & found.valid), sampling=reference.spacing_mm[::-1])
    return _not_answered(rest, away < RIM * float(found.grid.step_mm.mean()))


def _brought_together(part: BoolArray, found: CorrelationResult) -> BoolArray:
    """Return the voxels of a part that a field answers, and does not leave far apart, in regions that are not small."""
    at = np.argwhere(part & found.valid)
    apart = found.misplacement_at(found.volume.to_physical(at[:, ::-1]))
    kept = np.zeros(part.shape, dtype=bool)
    most = FAR_VOXELS**2 * float(np.prod(found.volume.spacing_mm)) ** (2.0 / 3.0)
    kept[tuple(at[apart < most].T)] = True
    return large_regions(kept, SMALLEST * part.sum())


def with_own_field(left_mm: Sequence[tuple[float, float]], *, jumping: bool = False, little_mm: float = 0.0) -> list[bool]:
    """Return which parts are measured by themselves, of what their own field and that of the whole object leave apart in each, mm.

    `jumping` is whether the fields of the parts differ where they meet; a field that leaves no more than `little_mm` is no lost one.
    """
    if not jumping and not any(own < LESS * one for own, one in left_mm):
        return [False] * len(left_mm)
    return [own <= max(LOST * one, little_mm) for own, one in left_mm]


def jump_fraction(one: tuple[BoolArray, CorrelationResult], other: tuple[BoolArray, CorrelationResult]) -> float:
    """Return at which fraction of the voxels of one part next to the other the fields of both differ beyond their 95 % region."""
    at = _next_to(one[0], other[0])
    (here, first), (there, second) = (_answered(found, at) for _, found in (one, other))
    jump, covariance = here - there, first + second
    known = np.isfinite(jump).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
    if not known.any():
        return 0.0
    squared = np.einsum("ni,ni->n", jump[known], np.linalg.solve(covariance[known], jump[known, :, None])[..., 0])
    return float((squared > CHI_SQUARED_95).mean())


def doubt_beside(
    one: tuple[BoolArray, CorrelationResult], other: tuple[BoolArray, CorrelationResult]
) -> tuple[tuple[IntArray, ...], FloatArray]:
    """Return the voxels (z, y, x) of one part next to another, and what is added to their covariance (n, 3, 3), mm^2.

    Such a voxel may show the material of the other part, which moves as the field of that one says: a mixture of both.
    """
    at = _next_to(one[0], other[0])
    jump = np.nan_to_num(_answered(other[1], at)[0] - _answered(one[1], at)[0])
    return tuple(at.T), OF_THE_OTHER * jump[:, :, None] * jump[:, None, :]


def _next_to(part: BoolArray, other: BoolArray) -> IntArray:
    """Return the voxels (n, 3) of a part, z, y, x, that share a face with another."""
    return np.argwhere(part & ndimage.binary_dilation(other))


def _answered(found: CorrelationResult, at: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return the displacement (n, 3), mm, and its covariance (n, 3, 3) in voxels (n, 3), z, y, x."""
    points = found.volume.to_physical(at[:, ::-1])
    return found.displacement_at(points), found.covariance_at(points)


def _left_apart(found: CorrelationResult, part: BoolArray) -> float:
    """Return the mean distance, mm, that a field leaves between structures of a part; NaN if that has no voxels."""
    at = np.argwhere(part)[::SAMPLED, ::-1]
    if not len(at):
        return float("nan")
    return float(np.nanmean(np.sqrt(found.misplacement_at(found.volume.to_physical(at)))))
