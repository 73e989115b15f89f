"""The mask of the object holds its air: lungs with an open airway, hollow and cut bodies; gaps of the outline stay outside."""

from __future__ import annotations

import numpy as np
import pytest
from thorax import body, chest, chest_grid, lungs

from naibu.core.volume import Volume
from naibu.imaging.preprocessing.object_mask import mask_jumps, object_mask
from naibu.imaging.preprocessing.resampling import positions

Array = np.ndarray


def solid(inside: Array, spacing: float = 1.0) -> Volume:
    noise = np.random.default_rng(0).standard_normal(inside.shape)
    return Volume.from_array(100.0 * inside + 3.0 * noise, spacing_mm=(spacing,) * 3)


def lattice(n: int = 48) -> Array:
    return np.stack(np.meshgrid(*(np.arange(n) - 0.5 * (n - 1),) * 3, indexing="ij")[::-1], axis=-1)


@pytest.mark.parametrize("table", [False, True])
def test_lungs_belong_to_the_chest_in_every_slice(table: bool) -> None:
    grid = chest_grid()
    mask = object_mask(chest(grid, table=table))
    x = positions(grid)
    inside, lung = body(x) > 4.0, (lungs(x) > 4.0) & (body(x) > 12.0)
    assert mask[lung].mean() > 0.98
    for page, wanted, air in zip(mask, inside, lung, strict=True):
        assert (page & wanted).sum() > 0.97 * wanted.sum()
        assert not air.any() or page[air].mean() > 0.8
    assert (mask & (body(x) < -8.0)).sum() < 0.02 * mask.sum()
    assert not len(mask_jumps(mask))


def test_a_chamber_behind_a_throat_is_inside_and_a_gap_is_not() -> None:
    x = lattice()
    r = np.linalg.norm(x, axis=-1)
    shell = (r < 20.0) & (r > 13.0)
    pierced = shell & ~((np.hypot(x[..., 0], x[..., 1]) < 1.6) & (x[..., 2] > 0.0))
    assert object_mask(solid(pierced))[r < 12.0].all()
    slit = (r < 20.0) & ~((np.abs(x[..., 0]) < 4.0) & (x[..., 2] > -6.0))
    mask = object_mask(solid(slit))
    assert not mask[(np.abs(x[..., 0]) < 1.0) & (x[..., 2] > 0.0)].any()


def test_an_open_tube_and_a_ring_keep_their_hole() -> None:
    x = lattice()
    r = np.hypot(x[..., 0], x[..., 1])
    tube = (r < 20.0) & (r > 11.0) & (np.abs(x[..., 2]) < 15.0)
    assert not object_mask(solid(tube))[(r < 7.0)].any()


def test_the_marrow_of_a_limb_that_the_scan_cuts_belongs_to_it() -> None:
    x = lattice()
    r = np.hypot(x[..., 0], x[..., 1])
    limb = (r < 20.0) & (r > 6.0)
    assert object_mask(solid(limb))[r < 19.0].all()


def test_jumps_between_slices_are_found() -> None:
    mask = np.zeros((12, 20, 20), dtype=bool)
    mask[2:10, 4:16, 4:16] = True
    assert not len(mask_jumps(mask))
    mask[5:7, 6:14, 6:14] = False
    assert mask_jumps(mask).tolist() == [5, 7]
    mask[5:7] = False
    assert mask_jumps(mask).tolist() == [5, 7]
    assert not len(mask_jumps(np.zeros_like(mask)))
