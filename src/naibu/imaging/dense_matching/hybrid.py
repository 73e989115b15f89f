"""Hybrid of block matching, where blocks have contrast, and Horn-Schunck optical flow elsewhere :cite:p:`hirai2008` (chapter 3.5)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.displacement_field import DisplacementField
from naibu.core.volume import Volume
from naibu.imaging.dense_matching.block_matching import Measure, block_matching
from naibu.imaging.dense_matching.optical_flow import horn_schunck
from naibu.imaging.preprocessing.resampling import warped


def hybrid_flow(
    reference: Volume,
    deformed: Volume,
    *,
    least_range: float = 30.0,
    block: ArrayLike = (3, 3, 3),
    search: ArrayLike = (15, 15, 1),
    measure: Measure = "sad",
    sub_voxel: bool = True,
    data_weight: float = 0.002,
    full_scale: float | None = None,
    iterations: int = 25,
    warps: int = 5,
    levels: int | None = None,
    mask: ArrayLike | None = None,
) -> DisplacementField:
    """Return the displacement by block matching where the intensity range of a block exceeds a limit, by Horn-Schunck elsewhere.

    Parameters
    ----------
    reference, deformed : Volume
        The image pair, on one grid; a volume of one slice is an image.
    least_range : float
        The limit, in intensities of the volume; the report takes 30 of 256 levels.
    block, search, measure, sub_voxel
        As in `naibu.imaging.dense_matching.block_matching.block_matching`.
    data_weight, full_scale, iterations, warps, levels
        As in `naibu.imaging.dense_matching.optical_flow.horn_schunck`; ``levels=1, warps=1`` as in the report.
    mask : array_like, shape (nz, ny, nx), optional
        Voxels of the reference that count.

    Returns
    -------
    DisplacementField
        Displacement, mm; its quality is the absolute intensity residual.

    Raises
    ------
    InputError
        As the two methods; also where no block has enough contrast.
    """
    blocks = block_matching(
        reference, deformed, block=block, search=search, measure=measure, sub_voxel=sub_voxel, least_range=least_range, mask=mask
    )
    flow = horn_schunck(
        reference,
        deformed,
        data_weight=data_weight,
        full_scale=full_scale,
        iterations=iterations,
        warps=warps,
        levels=levels,
        mask=mask,
    )
    vectors = np.where(blocks.valid[..., None], blocks.vectors, flow.vectors)
    left = np.abs(warped(deformed, vectors, reference) - reference.values)
    return DisplacementField.on_grid(reference, vectors, valid=blocks.valid | flow.valid, quality=left)
