"""Pyramids: which axes are halved, that voxel 0 keeps its position, and that fields are unchanged from level to level."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from naibu.imaging.preprocessing.pyramid import SMALLEST, Level, coarsened, pyramid, refined, smoothed_known

SPACING = np.array([0.8, 0.8, 3.2])


def levels_of(shape: tuple[int, int, int], spacing: np.ndarray, levels: int | None = None, seed: int = 0) -> list[Level]:
    rng = np.random.default_rng(seed)
    a, b = (rng.uniform(0, 100, shape).astype(np.float32) for _ in range(2))
    return pyramid(a, b, np.ones(shape, dtype=bool), spacing, levels)


def places(level: Level) -> np.ndarray:
    """Return the positions (3, nz, ny, nx) of the voxels of a level, mm from voxel 0."""
    z, y, x = np.indices(level.reference.shape)
    return np.stack([x, y, z]) * level.spacing_mm[:, None, None, None]


def test_thick_slices_are_left_alone() -> None:
    found = levels_of((20, 64, 64), SPACING)
    assert [level.reference.shape for level in found] == [(20, 16, 16), (20, 32, 32), (20, 64, 64)]
    np.testing.assert_allclose(found[0].spacing_mm, [3.2, 3.2, 3.2])


@given(st.tuples(st.integers(1, 40), st.integers(8, 60), st.integers(8, 60)), st.floats(0.5, 4.0))
@settings(max_examples=25, deadline=None)
def test_no_axis_gets_too_short_and_a_slice_stays_one(shape: tuple[int, int, int], thickness: float) -> None:
    found = levels_of(shape, np.array([1.0, 1.0, thickness]))
    for coarse, fine in pairwise(found):
        size, finer = np.array(coarse.reference.shape[::-1]), np.array(fine.reference.shape[::-1])
        np.testing.assert_array_equal(size, -(-finer // coarse.factor))
        assert (size[coarse.factor == 2] >= SMALLEST).all() and (coarse.factor == 2).any()
        np.testing.assert_allclose(coarse.spacing_mm, fine.spacing_mm * coarse.factor)
    assert found[-1].reference.shape == shape and (found[-1].factor == 1).all()
    if shape[0] == 1:
        assert all(level.reference.shape[0] == 1 for level in found)


def test_the_number_of_levels_can_be_given() -> None:
    assert len(levels_of((48, 48, 48), np.ones(3), 2)) == 2
    assert len(levels_of((48, 48, 48), np.ones(3), 1)) == 1


def test_intensity_ramps_keep_their_position() -> None:
    shape = (24, 48, 52)
    fine = Level(np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.ones(shape, bool), np.ones(3), np.ones(3, np.int64))
    slope = np.array([0.7, -0.4, 1.1])
    ramp = np.tensordot(slope, places(fine), 1).astype(np.float32)
    for level in pyramid(ramp, 2.0 * ramp, fine.wanted, fine.spacing_mm, None):
        expected = np.tensordot(slope, places(level), 1)
        # smoothing bends ramps near the faces alone
        inside = tuple(slice(3, -3) for _ in range(3))
        np.testing.assert_allclose(level.reference[inside], expected[inside], atol=1e-3)
        np.testing.assert_allclose(level.deformed[inside], 2.0 * expected[inside], atol=1e-3)


@pytest.mark.parametrize("shape", [(24, 48, 52), (1, 49, 51)])
def test_linear_fields_are_refined_exactly(shape: tuple[int, int, int]) -> None:
    found = levels_of(shape, np.array([1.0, 1.0, 1.2]))
    assert len(found) > 1
    rng = np.random.default_rng(1)
    matrix, shift = rng.standard_normal((3, 3)), rng.standard_normal(3)

    def field(level: Level) -> np.ndarray:
        return (np.tensordot(matrix, places(level), 1) + shift[:, None, None, None]).astype(np.float32)

    for coarse, fine in pairwise(found):
        up = refined(field(coarse), coarse, fine)
        # the last voxel of an even axis lies beyond the coarse grid, whose last value goes on there
        inside = tuple(slice(0, n - 1) if n > 1 else slice(None) for n in fine.reference.shape)
        np.testing.assert_allclose(up[(slice(None), *inside)], field(fine)[(slice(None), *inside)], atol=1e-3)
    down = coarsened(field(found[-1]), found)
    core = tuple(slice(3, -3) if n > 8 else slice(None) for n in found[0].reference.shape)
    np.testing.assert_allclose(down[(slice(None), *core)], field(found[0])[(slice(None), *core)], atol=1e-2)


def test_unknown_values_do_not_spread() -> None:
    v = np.full((20, 24, 28), 7.0, dtype=np.float32)
    v[:, :, 15:] = np.nan
    out = smoothed_known(v, np.array([0.8, 0.8, 0.8]))
    assert np.isnan(out[:, :, 15:]).all()
    np.testing.assert_allclose(out[:, :, :15], 7.0, rtol=1e-5)


def test_voxels_that_count_are_not_lost_on_coarse_grids() -> None:
    shape = (24, 48, 48)
    wanted = np.zeros(shape, dtype=bool)
    wanted[7, 13, 21] = True
    blank = np.zeros(shape, dtype=np.float32)
    for level in pyramid(blank, blank, wanted, np.ones(3), None):
        at = np.argwhere(level.wanted) * level.spacing_mm[::-1]
        assert len(at) >= 1
        assert (np.abs(at - [7, 13, 21]) <= 2.0 * level.spacing_mm[::-1]).all()
