"""Gaussian image pyramids :cite:p:`burt1983` of a pair of volumes, and interpolation of displacements between their levels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from naibu.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from naibu.imaging.preprocessing._interpolation_kernels import refine
from naibu.imaging.preprocessing.filters import smoothed

# empirical: voxels along an axis below which it is not halved again: fewer show too little of the object
SMALLEST = 12
# SD, voxels, of the Gaussian against aliasing before every second voxel is dropped
BLUR = 0.8


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """A pair of volumes on one grid.

    Attributes
    ----------
    reference, deformed : ndarray, shape (nz, ny, nx), float32
        Intensities.
    wanted : ndarray, shape (nz, ny, nx), bool
        Voxels that count.
    spacing_mm : ndarray, shape (3,)
        Voxel spacing along x, y, z, mm.
    factor : ndarray, shape (3,), int64
        Ratio of the spacing to that of the next finer level, 1 or 2 along x, y, z; 1 at the finest.
    """

    reference: Float32Array
    deformed: Float32Array
    wanted: BoolArray
    spacing_mm: FloatArray
    factor: IntArray


def pyramid(reference: Float32Array, deformed: Float32Array, wanted: BoolArray, spacing_mm: FloatArray, levels: int | None) -> list[Level]:
    """Return levels from coarse to fine.

    Each level halves the resolution of the axes whose voxels are not much longer than the shortest, so that thick slices are kept until
    the pixels in them are as large. Voxel 0 keeps its position.

    Parameters
    ----------
    reference, deformed : ndarray, shape (nz, ny, nx), float32
        Intensities.
    wanted : ndarray, shape (nz, ny, nx), bool
        Voxels that count.
    spacing_mm : ndarray, shape (3,)
        Voxel spacing along x, y, z, mm.
    levels : int, optional
        Number of levels; by default until an axis would have fewer than 12 voxels.
    """
    found = [Level(reference, deformed, wanted, np.asarray(spacing_mm, dtype=float), np.ones(3, dtype=np.int64))]
    while levels is None or len(found) < levels:
        fine = found[-1]
        size = np.array(fine.reference.shape[::-1])
        active = size > 1
        near = fine.spacing_mm < 1.5 * fine.spacing_mm[active].min()
        factor = np.where(active & near & (size >= 2 * SMALLEST), 2, 1)
        if (factor == 1).all():
            break
        pick = tuple(slice(None, None, int(f)) for f in factor[::-1])
        blur = np.where(factor == 2, BLUR, 0.0)
        counted = ndimage.maximum_filter(fine.wanted, tuple(int(2 * f - 1) for f in factor[::-1]))
        found.append(
            Level(
                np.ascontiguousarray(smoothed_known(fine.reference, blur)[pick]),
                np.ascontiguousarray(smoothed_known(fine.deformed, blur)[pick]),
                np.ascontiguousarray(counted[pick]),
                fine.spacing_mm * factor,
                factor,
            )
        )
    return found[::-1]


def smoothed_known(values: Float32Array, sigma: FloatArray) -> Float32Array:
    """Return smoothed values where most of the Gaussian covers known ones; NaN elsewhere (normalised convolution)."""
    known = np.isfinite(values)
    if known.all():
        return smoothed(values, sigma)
    fraction = smoothed(known.astype(np.float32), sigma)
    total = smoothed(np.where(known, values, np.float32(0.0)), sigma)
    return np.where(fraction > 0.5, total / np.maximum(fraction, 0.5), np.float32(np.nan))


def refined(displacement: Float32Array, coarse: Level, fine: Level) -> Float32Array:
    """Return a displacement (3, nz, ny, nx), mm, on the grid of the next finer level."""
    out = np.empty((3, *fine.reference.shape), dtype=np.float32)
    refine(displacement, coarse.factor, np.ones(3), out)
    return out


def coarsened(displacement: Float32Array, levels: list[Level]) -> Float32Array:
    """Return a displacement (3, nz, ny, nx), mm, of the finest level on the grid of the coarsest."""
    out = displacement
    for level in levels[:0:-1]:
        above = levels[[id(v) for v in levels].index(id(level)) - 1]
        blur = np.where(above.factor == 2, BLUR, 0.0)
        pick = tuple(slice(None, None, int(f)) for f in above.factor[::-1])
        out = np.stack([smoothed(component, blur)[pick] for component in out])
    return np.ascontiguousarray(out, dtype=np.float32)
