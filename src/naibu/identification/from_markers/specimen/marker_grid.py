"""Regular lattices of markers: indices from the numbering, and positions of markers that lack a coordinate."""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray, IntArray

FILLED_SD_MM = 0.35  # how far a marker lies from its lattice position (threads give way while the gel cures)


def lattice_indices(ids: IntArray, points: FloatArray) -> IntArray | None:
    """Return indices (k, 3) of markers numbered row by row and layer by layer, or None where the numbering shows no such order.

    A numbering ``n = 1 + i + p j + q k`` is recognised by its periods p and q: the affine fit of the complete positions to (i, j, k) must
    leave less than a fifth of the spacing.

    Parameters
    ----------
    ids : ndarray, shape (k,), int64
        Labels, from 1.
    points : ndarray, shape (k, 3)
        Positions, mm; NaN where missing.
    """
    complete = np.isfinite(points).all(axis=1)
    count = int(ids.max())
    best: tuple[float, IntArray] | None = None
    for p in range(2, count // 2 + 1):
        for q in range(2 * p, count // 2 + 1, p):
            if count % q:
                continue
            n = ids - 1
            index = np.stack([n % p, (n // p) % (q // p), n // q], axis=1)
            if complete.sum() < 8:
                return None
            fit = _affine(index[complete], points[complete])
            error = float(np.sqrt(((points[complete] - _apply(fit, index[complete])) ** 2).mean()))
            spacing = float(np.linalg.norm(fit[1:], axis=1).min())
            if error < 0.2 * spacing and (best is None or error < best[0]):
                best = error, index
    return None if best is None else best[1]


def completed(ids: IntArray, points: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Fill missing coordinates from the lattice; return positions (k, 3) and which of them, (k, 3) bool, were filled.

    A marker keeps its missing coordinates where the numbering shows no lattice.
    """
    filled = points.copy()
    index = lattice_indices(ids, points) if len(ids) else None
    if index is None:
        return filled, np.zeros(points.shape, dtype=bool)
    layer = (index[:, 2:] == np.arange(index[:, 2].max() + 1)).astype(float)  # layers need not be equally spaced
    i, j, k = index.T
    design = np.column_stack([layer, i, j, i * k, j * k, i * j])
    for axis in range(3):
        known = np.isfinite(points[:, axis])
        coefficients = np.linalg.lstsq(design[known], points[known, axis], rcond=None)[0]
        filled[~known, axis] = design[~known] @ coefficients
    return filled, np.isnan(points) & np.isfinite(filled)


def _affine(index: IntArray, points: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.lstsq(np.column_stack([np.ones(len(index)), index]), points, rcond=None)[0], dtype=float)


def _apply(fit: FloatArray, index: IntArray) -> FloatArray:
    return np.column_stack([np.ones(len(index)), index]) @ fit
