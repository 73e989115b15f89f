"""Volumes thinned out to boxes of voxels, without reading them whole, and the memory that volume correlation takes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from naibu.core.arrays import Float32Array, IntArray
from naibu.core.chunked_volume import ChunkedVolume
from naibu.core.volume import Volume

# measured (benchmarks/large_volumes.py): memory of volume correlation in memory, MB, and bytes a voxel of a volume that an object fills
BASE_MB, BYTES_PER_VOXEL = 300.0, 350.0
# voxels of the coarse volume: enough for the default grid of an object that fills a third of its width; more take longer, not less error
COARSE_VOXELS = 2_500_000
SMOOTHING = 0.5  # of the Gaussian before voxels are left out, coarse voxels: as on the levels of volume correlation
TILE = (64, 512)  # voxels along z and y that are read at a time


def needed_memory_mb(shape: tuple[int, ...]) -> float:
    """Return an estimate of the memory that `naibu.imaging.correlate_volumes` takes for volumes of a shape, MB."""
    return BASE_MB + BYTES_PER_VOXEL * math.prod(shape) / 2.0**20


def thinning_factor(shape: tuple[int, ...], voxels: float = COARSE_VOXELS) -> int:
    """Return the edge of the boxes of voxels whose means make a volume of at most so many voxels."""
    factor = max(1, math.ceil((math.prod(shape) / voxels) ** (1.0 / 3.0) - 1e-9))
    factor += factor % 2 if factor > 2 else 0  # so that there are voxels of an edge in between
    return int(min(factor, max(1, min(shape) // 8)))


def thinned(volume: ChunkedVolume, factor: int, *, filled: bool = False) -> Volume:
    """Return every so many voxels of a volume after smoothing, as on a coarse level of volume correlation; NaN spreads.

    Parameters
    ----------
    volume : ChunkedVolume
        Volume that is read part by part.
    factor : int
        Distance of the voxels that are taken, along every axis from the first.
    filled : bool
        Whether the fractions of voxels that are not zero are wanted, as of masks.
    """
    return with_thinned_values(
        volume, factor, [thinned_slab(volume, factor, slab, filled=filled) for slab in slabs_of(volume.shape, factor)]
    )


def slabs_of(shape: tuple[int, ...], factor: int) -> list[tuple[int, int]]:
    """Return the slabs, first plane and the one after the last, in which a volume of a shape is thinned out one after the other."""
    planes, deep = -(-shape[0] // factor), max(1, TILE[0] // factor)
    return [(z, min(z + deep, planes)) for z in range(0, planes, deep)]


def thinned_slab(volume: ChunkedVolume, factor: int, slab: tuple[int, int], *, filled: bool = False) -> Float32Array:
    """Return a slab of the voxels of `thinned`, of which only what it needs is read."""
    shape = tuple(-(-n // factor) for n in volume.shape)
    out, reach, wide = np.empty((slab[1] - slab[0], *shape[1:]), np.float32), _reach(factor), max(1, TILE[1] // factor)
    for y in range(0, shape[1], wide):
        ends = [slab, (y, min(y + wide, shape[1])), (0, shape[2])]
        read = [(max(a * factor - reach, 0), min((b - 1) * factor + reach + 1, n)) for (a, b), n in zip(ends, volume.shape, strict=True)]
        values = np.asarray(volume.values[tuple(slice(a, b) for a, b in read)])
        part = (values != 0).astype(np.float32) if filled else values.astype(np.float32)
        for axis, ((a, b), (first, _)) in enumerate(zip(ends, read, strict=True)):
            part = _smoothed(part, np.arange(a, b) * factor - first, factor, axis)
        out[:, y : ends[1][1]] = part
    return out


def thinned_slab_of_pair(
    reference: ChunkedVolume, deformed: ChunkedVolume, mask: ChunkedVolume | None, factor: int, which: tuple[int, tuple[int, int]]
) -> Float32Array:
    """Return a slab of the reference, ``(0, slab)``, or of the deformed volume, ``(1, slab)``, of `thinned`; it does not need the mask."""
    return thinned_slab((reference, deformed)[which[0]], factor, which[1])


def with_thinned_values(volume: ChunkedVolume, factor: int, slabs: Sequence[Float32Array]) -> Volume:
    """Return the volume of `thinned` from all slabs."""
    values = np.concatenate(slabs)
    return Volume.from_array(
        values,
        spacing_mm=volume.spacing_mm * factor,
        origin_mm=volume.origin_mm,
        direction=volume.direction,
        missing=bool(np.isnan(values).any()),
    )


def _reach(factor: int) -> int:
    return 0 if factor == 1 else int(np.ceil(3.0 * SMOOTHING * factor))


def _smoothed(values: Float32Array, at: IntArray, factor: int, axis: int) -> Float32Array:
    """Return Gaussian means about some indices along an axis; beyond the ends the last values go on."""
    if factor == 1:
        return values.take(at, axis)
    away = np.arange(-_reach(factor), _reach(factor) + 1)
    weights = np.exp(-0.5 * (away / (SMOOTHING * factor)) ** 2)
    out = np.zeros(tuple(len(at) if k == axis else n for k, n in enumerate(values.shape)), np.float32)
    for k, w in zip(away, weights / weights.sum(), strict=True):
        out += np.float32(w) * values.take(np.clip(at + k, 0, values.shape[axis] - 1), axis)
    return out


@dataclass(frozen=True, slots=True, eq=False)
class ThinnedValues:
    """Means of boxes of voxels, which are read and averaged when they are sliced.

    Attributes
    ----------
    source : array with ``shape`` and slicing, shape (nz, ny, nx)
        Voxels.
    factor : int
        Edge of a box, voxels.
    """

    source: Any
    factor: int

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of whole boxes along z, y, x."""
        nz, ny, nx = (int(n) // self.factor for n in self.source.shape)
        return nz, ny, nx

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the means."""
        return np.dtype(np.float32)

    def __getitem__(self, box: tuple[slice, slice, slice]) -> Float32Array:
        """Return the means of a box of slices along z, y, x, without steps."""
        ends = [s.indices(n)[:2] for s, n in zip(box, self.shape, strict=True)]
        fine = tuple(slice(a * self.factor, b * self.factor) for a, b in ends)
        return _means(np.asarray(self.source[fine]), self.factor)


def _means(values: Float32Array, factor: int) -> Float32Array:
    if factor == 1:
        return values.astype(np.float32)
    nz, ny, nx = (n // factor for n in values.shape)
    # along z first: whole planes are added
    total = values.reshape(nz, factor, ny * factor, nx * factor).sum(axis=1, dtype=np.float32)
    total = total.reshape(nz, ny, factor, nx * factor).sum(axis=2)
    return np.asarray(total.reshape(nz, ny, nx, factor).sum(axis=3) / np.float32(factor**3), dtype=np.float32)
