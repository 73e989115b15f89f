"""Bones are found in volumes whatever the size of their voxels."""

from __future__ import annotations

import numpy as np
import pytest

from naibu.core.volume import Volume
from naibu.imaging.volume_correlation.rigid_parts.inclusion_candidates import inclusion_candidates


@pytest.mark.parametrize("voxel", [0.8, 2.0])
def test_marrow_in_a_dark_shell_is_a_candidate(voxel: float) -> None:
    """A ball of 60 mm with a bone of 26 mm, of which the cortex is dark and 3 mm thick; fine voxels are thinned out."""
    n = int(72 / voxel)
    grid = Volume.from_array(np.zeros((n, n, n)), spacing_mm=(voxel, voxel, voxel))
    r = np.linalg.norm(grid.positions() - 0.5 * voxel * (n - 1), axis=-1)
    values = np.where(r < 30.0, 100.0, 0.0)
    values[(r < 13.0) & (r > 10.0)] = 10.0
    values += 3.0 * np.random.default_rng(0).standard_normal(values.shape)
    labels = inclusion_candidates(grid.with_values(values), r < 30.0, 7.0)
    assert labels.shape == values.shape and labels.max() == 1
    found, bone = labels == 1, r < 13.0
    assert 2.0 * (found & bone).sum() / (found.sum() + bone.sum()) > 0.85
