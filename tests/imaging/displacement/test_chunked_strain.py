"""Strain of a field in a file is that of the field in memory, and only what is asked for, and a voxel around it, is read."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.imaging.displacement import chunked_strain
from naibu.imaging.displacement.chunked_strain import COMPONENTS, ChunkedStrain
from naibu.imaging.displacement.strain import green_lagrange_strain

SHAPE = (9, 7, 11)


class Counted:
    """A displacement in a file, of which it is counted what is read at a time."""

    def __init__(self, values: np.ndarray) -> None:
        self.values, self.shape, self.dtype, self.most = values, values.shape, values.dtype, 0

    def __getitem__(self, box: Any) -> np.ndarray:
        part = self.values[box]
        self.most = max(self.most, part[..., 0].size)
        return part


def turned_grid(shape: tuple[int, ...] = SHAPE) -> Volume:
    turn = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    return Volume(np.broadcast_to(np.float32(0.0), shape), np.array([0.5, 0.7, 1.1]), np.zeros(3), turn)


@pytest.mark.parametrize("box", [np.s_[:, :, :], np.s_[2:5, 0:3, 6:11], np.s_[8:9, 6:7, 0:1], np.s_[3], np.s_[-1], np.s_[4:4, :, :]])
@pytest.mark.parametrize("voxels", [1, 250_000])
def test_every_box_has_the_strain_of_the_whole_field(box: Any, voxels: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chunked_strain, "_VOXELS", voxels)
    u = np.random.default_rng(1).standard_normal((*SHAPE, 3)).astype(np.float32)
    u[4, 2, 3] = np.nan
    grid = turned_grid()
    strain = ChunkedStrain.of(u, grid)
    whole = green_lagrange_strain(u, grid)
    wanted = np.stack([whole[..., "xyz".index(a), "xyz".index(b)] for a, b in COMPONENTS], axis=-1).astype(np.float32)
    assert strain.shape == wanted.shape
    np.testing.assert_array_equal(strain[box], wanted[box])


def test_a_stretched_and_turned_field_has_the_strain_of_the_stretch() -> None:
    grid = turned_grid((6, 5, 8))
    z, y, x = np.indices(grid.shape)
    at = grid.to_physical(np.stack([x, y, z], axis=-1).reshape(-1, 3).astype(float))
    stretch = np.diag([1.1, 1.0, 0.8])
    axes = grid.direction @ stretch @ grid.direction.T  # along the axes of the grid
    f = Rotation.from_rotvec([0.1, 0.4, -0.3]).as_matrix() @ axes
    u = (at @ (f - np.eye(3)).T).reshape(*grid.shape, 3)
    wanted = 0.5 * (f.T @ f - np.eye(3))
    found = ChunkedStrain.of(u, grid)[2:4, 1:3, 5:]
    for k, name in enumerate(COMPONENTS):
        np.testing.assert_allclose(found[..., k], wanted["xyz".index(name[0]), "xyz".index(name[1])], atol=1e-6)


def test_no_more_is_read_than_is_asked_for() -> None:
    kept = Counted(np.zeros((40, 30, 30, 3), np.float32))
    ChunkedStrain.of(kept, turned_grid((40, 30, 30)))[10:14, 5:9, 5:9]
    assert kept.most == 6 * 6 * 6


def test_a_field_of_another_grid_is_refused() -> None:
    with pytest.raises(InputError, match=r"displacement must have shape \(9, 7, 11, 3\)"):
        ChunkedStrain.of(np.zeros((3, 7, 11, 3)), turned_grid())
