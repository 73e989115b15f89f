"""Bone masks: thresholds of :cite:t:`otsu1979`, largest connected components, and filled cavities."""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy import ndimage

from naibu.core.arrays import AnyFloatArray, BoolArray, FloatArray
from naibu.core.errors import InputError
from naibu.core.volume import Volume

BINS = 128  # of the histogram: thresholds are exact to 0.8 % of the intensity range


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
        Volume of nothing but the object and air about it.
    appearance : {"bright", "dark"}
        ``"bright"`` for computed tomography, where bone is the brightest tissue; ``"dark"`` for magnetic resonance, where compact bone is
        the darkest tissue and encloses bright marrow.
    threshold : float, optional
        Intensity between bone and the rest; by default Otsu's threshold between the last two of `classes` classes of intensities
        (bright), or half way from the median of the air to that of the object (dark).
    count : int
        Number of bones.
    classes : int
        Number of intensity classes, air included, where bone is the brightest.
    margin_mm : float
        Dilation of the mask, mm.

    Returns
    -------
    ndarray, shape (nz, ny, nx), bool
        Bones, with the marrow that they enclose in every slice.

    Raises
    ------
    InputError
        Fewer bones than `count`, or a volume without contrast.
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
        # the outermost voxels are dark because they contain some air; beyond the faces of the volume the body goes on
        found = (values < limit) & ndimage.binary_erosion(body, _ball(2), border_value=1)
    bones = _largest(found, count)
    bones = _filled(ndimage.binary_closing(np.pad(bones, 1, mode="edge"), _ball(1))[1:-1, 1:-1, 1:-1])
    if margin_mm > 0.0:
        bones |= ndimage.distance_transform_edt(~bones, sampling=volume.spacing_mm[::-1]) <= margin_mm
    return np.asarray(bones)


def otsu_thresholds(values: AnyFloatArray, classes: int = 2) -> FloatArray:
    """Return the thresholds (classes - 1,) of :cite:t:`otsu1979`, which minimise the variance within classes.

    Parameters
    ----------
    values : ndarray
        Intensities.
    classes : int
        Number of classes, 2 or more.

    Raises
    ------
    InputError
        Values without contrast, or fewer than two classes.
    """
    if classes < 2:
        raise InputError(f"classes must be 2 or more, not {classes}")
    low, high = float(values.min()), float(values.max()) if values.size else 0.0
    if not high > low:
        raise InputError("values are constant: there is no threshold between classes")
    counts, edges = np.histogram(values, bins=BINS, range=(low, high))
    middles = 0.5 * (edges[1:] + edges[:-1])
    weight, first = (np.concatenate([[0.0], np.cumsum(counts * m)]) for m in (np.ones(BINS), middles))
    mass = weight[None, :] - weight[:, None]
    between = np.where(mass > 0, (first[None, :] - first[:, None]) ** 2 / np.where(mass > 0, mass, 1.0), 0.0)
    between[np.tril_indices(BINS + 1)] = -np.inf
    # best[i]: the largest variance between classes of the bins below i
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
        raise InputError(f"{n} connected regions were found, fewer than count = {count}; set threshold")
    sizes = np.bincount(labels.ravel())[1:]
    keep = 1 + np.argsort(sizes, kind="stable")[::-1][:count]
    return np.isin(labels, keep)


def _filled(found: BoolArray) -> BoolArray:
    """Fill the holes of every slice: bones and limbs are cut by the volume at both ends."""
    return np.stack([ndimage.binary_fill_holes(page) for page in found])


def _ball(radius: int) -> BoolArray:
    grid = np.arange(-radius, radius + 1)
    return np.asarray(grid[:, None, None] ** 2 + grid[:, None] ** 2 + grid**2 <= radius**2)
