"""The voxels at a resolution that a correlation compares."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from naibu.imaging.volume_correlation.image_level import ImageLevel

SPACING = np.array([0.5, 0.7, 1.3])


@pytest.mark.parametrize("at_the_end", [False, True])
def test_depth_is_the_distance_from_the_nearest_voxel_outside(at_the_end: bool) -> None:
    z, y, x = np.indices((30, 34, 40))
    mask = ((z - 15) / 12.0) ** 2 + ((y - 16) / 14.0) ** 2 + ((x - 20) / 21.0) ** 2 < 1.0
    mask[10:14, 10:14, 10:20] = False
    if at_the_end:  # an object that the volume cuts off has no surface there
        mask = mask[:18]
    image = np.random.default_rng(0).normal(size=mask.shape).astype(np.float32)
    level = ImageLevel(image, image, mask, SPACING, (1, 1, 1), 1.0)
    outside = np.pad(mask, 1, mode="edge")
    expected = ndimage.distance_transform_edt(outside, sampling=SPACING[::-1])[1:-1, 1:-1, 1:-1][mask]
    assert level.depth_mm(mask) == pytest.approx(expected, abs=1e-5)
