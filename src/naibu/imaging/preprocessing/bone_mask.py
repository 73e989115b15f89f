"""Where the bone is: threshold, largest components, and filled cavities (spec S2)."""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy import ndimage

from naibu.core.arrays import AnyFloatArray, BoolArray, FloatArray
from naibu.core.errors import InputError
from naibu.core.volume import Volume

BINS = 128


def bone_mask(
    volume: Volume,
    *,
    appearance: Literal["bright", "dark"],
    threshold: float | None = None,
    count: int = 1,
    classes: int = 3,
    margin_mm: float = 0.0,
) -> BoolArray:
    """Return the largest bones of a volume.

    Parameters
    ----------
    volume : Volume
        A scan with nothing but the object and air about it.
    appearance : {"bright", "dark"}
        ``"bright"`` for computed tomography, where bone is brighter than all else; ``"dark"`` for magnetic resonance, where its compact
        rim is darker than all other tissue and encloses bright marrow.
    threshold : float, optional
        Grey value between bone and the rest; by default Otsu's, between the last two of `classes` classes of grey values
        (bright), or half way from the median of the air to that of the object (dark).
    count : int
        Number of bones.
    classes : int
        Number of kinds of matter that differ in grey value, air among them, where bone is the brightest.
    margin_mm : float
        By how much the mask reaches over the bone, mm.

    Returns
    -------
    ndarray, shape (nz, ny, nx), bool
        Bones with the marrow they enclose in every slice.

    Raises
    ------
    InputError
        Fewer bones than asked for, or a volume without contrast.
    """
    if appearance not in ("bright", "dark"):
        raise InputError(f"appearance must be 'bright' (computed tomography) or 'dark' (magnetic resonance), not {appearance!r}")
    values = np.asarray(volume.values, dtype=float)
    if appearance == "bright":
        found = values > (otsu_thresholds(values, classes)[-1] if threshold is None else threshold)
    else:
        body = _filled(_largest(values > otsu_thresholds(values, 2)[0], 1))
        air = float(np.median(values[~body])) if not body.all() else float(values.min())
        limit = 0.5 * (air + float(np.median(values[body]))) if threshold is None else threshold
        # the outermost voxels are dark because they hold some air; where the body runs out of the volume it goes on
        found = (values < limit) & ndimage.binary_erosion(body, _ball(2), border_value=1)
    bones = _largest(found, count)
    bones = _filled(ndimage.binary_closing(np.pad(bones, 1, mode="edge"), _ball(1))[1:-1, 1:-1, 1:-1])
    if margin_mm > 0.0:
        bones |= ndimage.distance_transform_edt(~bones, sampling=volume.spacing_mm[::-1]) <= margin_mm
    return np.asarray(bones)


def otsu_thresholds(values: AnyFloatArray, classes: int = 2) -> FloatArray:
    """Return the grey values (classes - 1,) that part the values into classes with the least variance within.

    Parameters
    ----------
    values : ndarray
        Grey values.
    classes : int
        Number of classes, 2 or more.

    Raises
    ------
    InputError
        Values without contrast, or fewer than two classes.

    References
    ----------
    N. Otsu: A threshold selection method from gray-level histograms. IEEE Trans. Systems, Man and Cybernetics 9 (1979) 62-66.
    """
    if classes < 2:
        raise InputError(f"values are parted into two classes or more, not {classes}")
    low, high = float(values.min()), float(values.max()) if values.size else 0.0
    if not high > low:
        raise InputError("all voxels have one grey value: there is nothing to part")
    counts, edges = np.histogram(values, bins=BINS, range=(low, high))
    middles = 0.5 * (edges[1:] + edges[:-1])
    weight, first = (np.concatenate([[0.0], np.cumsum(counts * m)]) for m in (np.ones(BINS), middles))
    mass = weight[None, :] - weight[:, None]
    between = np.where(mass > 0, (first[None, :] - first[:, None]) ** 2 / np.where(mass > 0, mass, 1.0), 0.0)
    between[np.tril_indices(BINS + 1)] = -np.inf
    # best[i]: the largest variance between classes of the bins below i, cut into so many classes
    best, cuts = between[0].copy(), []
    for _ in range(classes - 1):
        total = best[:, None] + between
        cuts.append(np.argmax(total, axis=0))
        best = total.max(axis=0)
    at, found = BINS, []
    for cut in cuts[::-1]:
        at = int(cut[at])
        found.append(float(edges[at]))
    return np.array(found[::-1])


def _largest(found: BoolArray, count: int) -> BoolArray:
    labels, n = ndimage.label(found, _ball(1))
    if n < count:
        raise InputError(f"{n} bodies were found where {count} are asked for; set the threshold")
    sizes = np.bincount(labels.ravel())[1:]
    keep = 1 + np.argsort(sizes, kind="stable")[::-1][:count]
    return np.isin(labels, keep)


def _filled(found: BoolArray) -> BoolArray:
    """Fill in every slice what is enclosed: bones and limbs run out of the volume at both ends."""
    return np.stack([ndimage.binary_fill_holes(page) for page in found])


def _ball(radius: int) -> BoolArray:
    grid = np.arange(-radius, radius + 1)
    return np.asarray(grid[:, None, None] ** 2 + grid[:, None] ** 2 + grid**2 <= radius**2)
