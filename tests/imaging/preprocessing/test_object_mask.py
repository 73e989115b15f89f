"""The mask of the object holds its air: lungs with an open airway, hollow and cut bodies; gaps of the outline stay outside."""

from __future__ import annotations

import numpy as np
import pytest
from thorax import body, chest, chest_grid, lungs

from naibu.core.volume import Volume
from naibu.imaging.preprocessing.object_mask import left_out, mask_jumps, object_mask
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


def lung(inside: float, *, opening: float = 4.0, mattress: bool = False) -> tuple[Volume, Array, Array]:
    """Return a ball of 100 in air of 0 with a cavity of another intensity and a lattice of vessels, and what is cavity and open slit.

    A slit opens it; vessels leave no room for a ball wider than the slit. A mattress of the intensity of the cavity may lie below.
    """
    x = lattice(56)
    r = np.linalg.norm(x, axis=-1)
    vessels = (np.abs(np.mod(x + 4.0, 8.0) - 4.0) < 1.0).sum(axis=-1) >= 2
    slit = (np.abs(x[..., 0]) < opening) & (x[..., 1] < 0.0) & (np.abs(x[..., 2]) < 12.0) & (r >= 16.0)
    values = np.where(r < 22.0, 100.0, 0.0)
    values[(r < 16.0) & ~vessels] = inside
    values[slit] = 0.0
    if mattress:
        values[(x[..., 1] > 20.0) & (r >= 22.0)] = inside
    rng = np.random.default_rng(0)
    return Volume.from_array(values + 3.0 * rng.standard_normal(values.shape), spacing_mm=(1.0,) * 3), r < 16.0, slit


@pytest.mark.parametrize("mattress", [False, True])
def test_what_is_denser_than_air_and_surrounded_belongs_to_the_object_though_it_is_open(mattress: bool) -> None:
    volume, cavity, slit = lung(15.0, mattress=mattress)
    mask = object_mask(volume)
    assert mask[cavity].mean() > 0.98
    assert mask[slit].mean() < 0.6  # its sides and its floor are blurred
    x = lattice(56)
    assert mask[np.linalg.norm(x, axis=-1) > 24.0].mean() < 0.005
    left = left_out(volume, mask, (slice(None),) * 3)
    assert left.surrounded < 0.02 and left.separate == 0.0


def test_how_much_is_left_out_as_air_is_told() -> None:
    volume, cavity, _ = lung(0.0)
    mask = object_mask(volume)
    left = left_out(volume, mask, (slice(None),) * 3)
    assert mask[cavity].mean() < 0.6
    assert left.surrounded == pytest.approx((cavity & ~mask).sum() / mask.sum(), rel=0.3)
    x = lattice()
    balls = [np.linalg.norm(x - [d, 0.0, 0.0], axis=-1) < r for d, r in ((-11.0, 10.0), (12.0, 9.0))]
    two = solid(balls[0] | balls[1])
    left = left_out(two, object_mask(two), (slice(None),) * 3)
    assert left.surrounded == 0.0 and left.separate == pytest.approx(0.9**3, rel=0.1)


def test_padding_about_the_circle_of_reconstruction_is_no_part_of_the_contrast() -> None:
    """-3024 outside of the circle once put the threshold below air, and all that the circle holds into the mask."""
    x = lattice()
    r = np.hypot(x[..., 0], x[..., 1])
    inside = np.hypot(x[..., 0], 1.4 * x[..., 1]) < 17.0
    noise = 20.0 * np.random.default_rng(0).standard_normal(r.shape)
    scan = np.where(r < 24.0, np.where(inside, 30.0, -1000.0) + noise, -3024.0)
    mask = object_mask(Volume.from_array(scan, spacing_mm=(1.0,) * 3))
    assert (mask != inside).sum() < 0.1 * inside.sum()
    # a textured block in a background of one intensity is an object in air: nothing is padding
    block = np.where(np.hypot(x[..., 0], x[..., 1]) < 23.9, 100.0 + noise, 0.0)
    mask = object_mask(Volume.from_array(block, spacing_mm=(1.0,) * 3))
    assert (mask != (block > 0.0)).sum() < 0.06 * mask.sum()


def test_jumps_between_slices_are_found() -> None:
    mask = np.zeros((12, 20, 20), dtype=bool)
    mask[2:10, 4:16, 4:16] = True
    assert not len(mask_jumps(mask))
    mask[5:7, 6:14, 6:14] = False
    assert mask_jumps(mask).tolist() == [5, 7]
    mask[5:7] = False
    assert mask_jumps(mask).tolist() == [5, 7]
    assert not len(mask_jumps(np.zeros_like(mask)))


def test_the_tip_of_an_object_is_no_jump_in_a_few_slices_either() -> None:
    mask = np.zeros((3, 20, 20), dtype=bool)
    mask[0], mask[1, :2, :2], mask[2, 0, 0] = True, True, True
    assert mask_jumps(mask).tolist() == [1]


@pytest.mark.parametrize("slice_mm", [1.0, 2.0, 3.0])
@pytest.mark.parametrize("phase", [0.1, 0.5, 0.9])
def test_the_rounded_ends_of_an_object_in_thick_slices_are_no_jumps(slice_mm: float, phase: float) -> None:
    z, y, x = np.meshgrid((np.arange(50) + phase) * slice_mm - 75.0, *2 * [np.arange(-25.0, 25.0)], indexing="ij", sparse=True)
    ball = (x / 22.0) ** 2 + (y / 20.0) ** 2 + ((z - 25.0 * slice_mm + 75.0) / 18.0) ** 2 < 1.0
    assert ball.any()
    assert not len(mask_jumps(ball))
    cut = ball.copy()
    middle = int(np.argmax(ball.sum(axis=(1, 2))))
    cut[middle, :, :25] = False
    assert mask_jumps(cut).tolist() == [middle, middle + 1]
    torn = ball.copy()
    torn[::2, :, :20] = False
    assert len(mask_jumps(torn)) > 4 * len(mask_jumps(ball))
