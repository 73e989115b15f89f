"""Boxes of a volume on another grid, put together, are the volume that is resampled as a whole."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from naibu.core.chunked_volume import ChunkedVolume
from naibu.core.volume import Volume
from naibu.imaging.large_volumes.field_blocks import boxes_of
from naibu.imaging.large_volumes.resampled_blocks import resampled_box
from naibu.imaging.preprocessing.resampling import on_voxels_of


def put_together(volume: Volume, reference: Volume) -> np.ndarray:
    out = np.zeros(reference.shape, dtype=np.float32)
    for box in boxes_of(reference.shape, 16):
        out[box] = resampled_box(ChunkedVolume.of(volume), ChunkedVolume.of(reference), box)
    return out


@pytest.mark.parametrize(
    ("spacing", "origin", "turned"),
    [
        ((1.0, 1.0, 1.0), (5.0, -3.0, 8.0), 0.0),  # a crop: values as they are stored
        ((0.9, 1.1, 1.3), (3.2, 4.1, 5.3), 0.0),
        ((2.0, 1.0, 1.0), (-4.0, 0.5, 60.0), 0.0),  # coarser, and partly beside
        ((1.0, 1.0, 0.8), (6.0, 2.0, 9.0), 12.0),
    ],
)
def test_boxes_are_what_the_whole_gives(spacing: tuple[float, ...], origin: tuple[float, ...], turned: float) -> None:
    values = np.random.default_rng(0).normal(100.0, 20.0, (70, 60, 50)).astype(np.float32)
    volume = Volume.from_array(values, spacing_mm=(1.0, 1.0, 1.0))
    direction = Rotation.from_euler("z", turned, degrees=True).as_matrix()
    reference = Volume.from_array(np.zeros((34, 40, 36)), spacing_mm=spacing, origin_mm=origin, direction=direction)
    whole = on_voxels_of(volume, reference).values
    boxes = put_together(volume, reference)
    np.testing.assert_array_equal(np.isnan(boxes), np.isnan(whole))
    assert np.isnan(whole).any() == (origin != (3.2, 4.1, 5.3))
    np.testing.assert_allclose(boxes, whole, rtol=0.0, atol=2e-4)


def test_a_box_beside_the_volume_is_unknown() -> None:
    volume = Volume.from_array(np.ones((8, 8, 8), dtype=np.float32), spacing_mm=(1.0, 1.0, 1.0))
    reference = Volume.from_array(np.zeros((8, 8, 40)), spacing_mm=(1.0, 1.0, 1.0))
    assert np.isnan(put_together(volume, reference)[:, :, 16:]).all()
