"""A volume larger than memory at the voxels of another grid, box by box."""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import AnyArray
from naibu.core.chunked_volume import ChunkedVolume
from naibu.imaging.preprocessing.field_of_view import Box
from naibu.imaging.preprocessing.resampling import covered, on_voxels_of

MARGIN = 12  # voxels around a box, within which what lies beyond falls to 1e-7 in splines (its decay is .27 a voxel)
TRUNCATED = 2.0  # of the Gaussian against aliasing, voxels of the coarser grid


def resampled_box(volume: ChunkedVolume, reference: ChunkedVolume, box: Box) -> AnyArray:
    """Return the values of a volume at the voxels of a box of another grid, by the positions that both state.

    As `naibu.imaging.preprocessing.resampling.on_voxels_of`, of which it reads what the box needs; but where only other parts of the volume
    have unknown values, splines interpolate.

    Parameters
    ----------
    volume : ChunkedVolume
        Intensities.
    reference : ChunkedVolume
        The other grid; no value of it is read.
    box : tuple of slice
        Voxels along z, y, x.

    Returns
    -------
    ndarray, shape (z, y, x), real
        Values, NaN where a voxel lies outside of the volume.
    """
    grid = ChunkedVolume.of(reference.grid).block(box)
    if not covered(volume.grid, grid).any():
        return np.full(grid.shape, np.nan, dtype=np.float32)
    corners = np.array(list(np.ndindex(2, 2, 2))) * (np.array(grid.shape[::-1]) - 1)
    index = volume.grid.to_index(grid.to_physical(corners))
    coarser = np.abs(volume.direction.T @ reference.direction) @ reference.spacing_mm / volume.spacing_mm
    margin = MARGIN + np.ceil(TRUNCATED * coarser)
    low = np.maximum(np.floor(index.min(axis=0) - margin), 0).astype(int)
    high = np.minimum(np.ceil(index.max(axis=0) + margin).astype(int) + 1, volume.shape[::-1])
    z, y, x = (slice(a, b) for a, b in zip(low[::-1].tolist(), high[::-1].tolist(), strict=True))
    return np.asarray(on_voxels_of(volume.block((z, y, x)), grid).values)
