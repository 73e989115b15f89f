"""Blocks are recognised by the errors of their markers' places."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from naibu import datasets
from naibu.core.errors import InputError
from naibu.validation.specimens.specimen_matching import block_match


def lattice(seed: int) -> np.ndarray:
    layers, rows, columns = np.meshgrid(np.arange(2), np.arange(5), np.arange(5), indexing="ij")
    perfect = 10.0 * np.stack([columns, -rows, layers], axis=-1)
    return perfect + np.random.default_rng(seed).normal(scale=0.3, size=perfect.shape)


def half(number: int, first: int) -> np.ndarray:
    markers = datasets.load(f"ct_two_material_{number}").initial
    return markers.aligned(np.arange(first, first + 50)).reshape(2, 5, 5, 3)


@pytest.mark.parametrize(("turns", "over"), [(0, False), (1, False), (3, True), (0, True)])
def test_a_block_is_recognised_however_it_stands(turns: int, over: bool) -> None:
    block = lattice(1)
    renumbered = block[::-1, :, ::-1] if over else block
    renumbered = np.rot90(renumbered, -turns, axes=(1, 2))
    moved = renumbered @ Rotation.from_euler("xyz", [0.4, -0.2, 1.0]).as_matrix().T + [3.0, -2.0, 7.0]
    match = block_match(moved, block)
    assert match.distance_mm < 1e-9
    assert match.upside_down == over
    assert block_match(lattice(2), block).distance_mm > 0.4


def test_the_cubes_share_their_upper_block() -> None:
    upper = [half(n, 51) for n in (1, 2, 3)]
    assert max(block_match(upper[0], other).distance_mm for other in upper[1:]) < 0.3
    assert block_match(half(1, 1), half(2, 1)).distance_mm < 0.3
    turned = block_match(half(1, 1), half(4, 51))  # the soft block of cube 1 lies on top of cube 4
    assert turned.distance_mm < 0.3
    assert turned.upside_down
    assert block_match(half(1, 1), half(3, 1)).distance_mm > 0.4


def test_too_few_markers_are_told() -> None:
    sparse = np.full((2, 5, 5, 3), np.nan)
    with pytest.raises(InputError, match="fewer than 8"):
        block_match(sparse, lattice(1))
    with pytest.raises(InputError, match="one shape"):
        block_match(lattice(1)[:1], lattice(1))
