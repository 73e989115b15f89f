"""Geometry of volumes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from naibu.core.errors import InputError
from naibu.core.rigid_transform import rotation_matrix
from naibu.core.volume import Volume


@given(st.integers(0, 1000))
def test_indices_and_positions_are_inverse(seed: int) -> None:
    rng = np.random.default_rng(seed)
    turn = rotation_matrix(rng.standard_normal(3))
    volume = Volume.from_array(np.zeros((3, 4, 5)), spacing_mm=rng.uniform(0.1, 3.0, 3), origin_mm=rng.standard_normal(3), direction=turn)
    index = rng.uniform(-2.0, 6.0, (7, 3))
    np.testing.assert_allclose(volume.to_index(volume.to_physical(index)), index, atol=1e-12)
    step = volume.to_physical([1.0, 0.0, 0.0]) - volume.to_physical([0.0, 0.0, 0.0])
    np.testing.assert_allclose(step, volume.spacing_mm[0] * turn[:, 0], atol=1e-12)


def test_a_crop_keeps_its_place() -> None:
    values = np.arange(60).reshape(3, 4, 5)
    volume = Volume.from_array(values, spacing_mm=(1.0, 2.0, 3.0), origin_mm=(10.0, 0.0, 0.0))
    part = volume.cropped((1, 2, 0), (4, 4, 2))
    np.testing.assert_array_equal(part.values, values[0:2, 2:4, 1:4])
    np.testing.assert_allclose(part.origin_mm, [11.0, 4.0, 0.0])
    assert not part.same_grid(volume) and volume.same_grid(volume.with_values(values + 1))


def test_the_difference_of_two_grids_is_named() -> None:
    values, turn = np.zeros((3, 4, 5)), rotation_matrix(np.array([0.0, 0.0, 0.1]))
    volume = Volume.from_array(values, spacing_mm=(1.0, 2.0, 3.0))
    for other, words in (
        (volume, ""),
        (Volume.from_array(values[:2], spacing_mm=(1.0, 2.0, 3.0)), "their sizes differ: 5 x 4 x 3 and 5 x 4 x 2 voxels"),
        (Volume.from_array(values, spacing_mm=(1.0, 2.0, 3.1)), "their voxel spacings differ: [1.0, 2.0, 3.0] and [1.0, 2.0, 3.1] mm"),
        (Volume.from_array(values, spacing_mm=(1.0, 2.0, 3.0), direction=turn), "their axes differ: "),
        (
            Volume.from_array(values, spacing_mm=(1.0, 2.0, 3.0), origin_mm=(0.0, 3.0, 4.0)),
            "they agree in size and spacing, but their origins lie 5 mm apart: [0.0, 0.0, 0.0] and [0.0, 3.0, 4.0] mm",
        ),
    ):
        assert volume.grid_difference(other).startswith(words)
        assert volume.same_grid(other) == (not words)


@pytest.mark.parametrize(
    ("values", "options", "message"),
    [
        (np.zeros((2, 2, 2, 3)), {"spacing_mm": (1, 1, 1)}, "three axes"),
        (np.full((2, 2, 2), np.nan), {"spacing_mm": (1, 1, 1)}, r"voxel \(0, 0, 0\)"),
        (np.zeros((2, 2, 2)), {"spacing_mm": (1, 0, 1)}, "positive"),
        (np.zeros((2, 2, 2)), {"spacing_mm": (1, 1, 1), "direction": [[1, 0.2, 0], [0, 1, 0], [0, 0, 1]]}, "orthonormal"),
    ],
)
def test_bad_volumes_are_refused(values: np.ndarray, options: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Volume.from_array(values, **options)
