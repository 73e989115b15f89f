"""Results block by block are those in memory, on one process and on two workers, in memory that does not grow with the volume."""

from __future__ import annotations

import os
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import grid, inner, pair
from scipy import ndimage

from naibu.core.chunked_volume import ChunkedVolume
from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.imaging.dense_matching.block_matching import block_matching
from naibu.imaging.dense_matching.optical_flow import horn_schunck
from naibu.imaging.feature_matching.harris import harris_response
from naibu.imaging.out_of_core import (
    chunked_block_matching,
    chunked_harris_response,
    chunked_horn_schunck,
    map_overlapping,
    stored,
    unpacked,
)

pytest.importorskip("dask.array")
zarr = pytest.importorskip("zarr")


def motion(x: np.ndarray) -> np.ndarray:
    return np.stack([1.5 + 0.03 * x[..., 1], -1.0 + 0.02 * x[..., 0], 0.5 + 0 * x[..., 0]], axis=-1)


def scans(shape: tuple[int, int, int] = (22, 50, 61)) -> tuple[Volume, Volume]:
    """Return two scans of integer intensities."""
    before, after, _ = pair(grid(shape, (1.0, 0.9, 1.3)), motion, seed=4, wave_mm=(5.0, 16.0), noise=3.0)
    return tuple(v.with_values(np.clip(np.rint(10.0 * v.values), 0, None).astype(np.uint16)) for v in (before, after))


def chunked(volume: Volume) -> ChunkedVolume:
    return ChunkedVolume.of(volume)


@given(st.tuples(*[st.integers(5, 40)] * 3), st.integers(0, 3))
@settings(max_examples=15, deadline=None)
def test_filters_are_the_same_in_blocks_of_any_size(block: tuple[int, int, int], reach: int) -> None:
    values = np.random.default_rng(0).uniform(0, 1, (13, 37, 29))
    size = (1, 2 * reach + 1, 2 * reach + 1)
    found = map_overlapping(_largest, [values, values], (reach, reach, 0), block=block, dtype=float)
    assert found.shape == values.shape and found.dtype == float
    both = map_overlapping(lambda a, b: _largest(a, b, reach), [values, values], (reach, reach, 0), block=block, dtype=float)
    # reflected at faces of the volume, and at no others
    np.testing.assert_array_equal(both.compute(scheduler="synchronous"), ndimage.maximum_filter(values, size) + values)


def _largest(a: np.ndarray, b: np.ndarray, reach: int = 0) -> np.ndarray:
    return ndimage.maximum_filter(a, (1, 2 * reach + 1, 2 * reach + 1)) + b


def test_blocks_may_have_components_and_begin_at_even_voxels() -> None:
    values = np.arange(10 * 21 * 17, dtype=float).reshape(10, 21, 17)
    starts = []

    def two(a: np.ndarray) -> np.ndarray:
        starts.append(np.argwhere(values == a[0, 0, 0])[0])
        return np.stack([a, -a], axis=-1)

    found = map_overlapping(two, [values], (3, 3, 3), block=(6, 7, 5), aligned=4, components=2, dtype=float).compute(
        scheduler="synchronous"
    )
    np.testing.assert_array_equal(found, np.stack([values, -values], axis=-1))
    assert (np.array(starts) % 4 == 0).all() and len(starts) > 8


@pytest.mark.parametrize("response", ["ratio", "harris"])
@pytest.mark.parametrize("block", [(16, 16, 16), (23, 11, 40)])
def test_harris_responses_are_those_in_memory(response: str, block: tuple[int, int, int]) -> None:
    volume, _ = scans()
    found = chunked_harris_response(chunked(volume), response=response, block=block, window_sigma_mm=1.7)
    expected = harris_response(volume, response=response, window_sigma_mm=1.7)
    np.testing.assert_array_equal(found.compute(scheduler="synchronous"), expected)


@pytest.mark.parametrize("measure", ["sad", "ssd", "ncc"])
@pytest.mark.parametrize("sub_voxel", [False, True])
def test_matched_blocks_are_those_in_memory(measure: str, sub_voxel: bool) -> None:
    before, after = scans()
    options = {"search": (3, 4, 1), "measure": measure, "sub_voxel": sub_voxel, "least_range": 300.0}
    expected = block_matching(before, after, block=(3, 5, 3), **options)
    found = chunked_block_matching(chunked(before), chunked(after), matched_block=(3, 5, 3), block=(20, 17, 12), **options).computed()
    assert 0.2 < expected.valid.mean() < 1.0
    np.testing.assert_array_equal(found.valid, expected.valid)
    np.testing.assert_array_equal(found.vectors, expected.vectors)
    np.testing.assert_array_equal(found.quality, expected.quality)


def test_images_and_parts_without_contrast_are_matched_too() -> None:
    before, after = scans((1, 60, 70))
    flat = before.with_values(np.where(np.arange(70) < 40, 7, before.values).astype(np.uint16))
    expected = block_matching(flat, after, block=(5, 5, 1), search=(3, 3, 0))
    found = chunked_block_matching(chunked(flat), chunked(after), matched_block=(5, 5, 1), search=(3, 3, 0), block=(20, 20, 1))
    np.testing.assert_array_equal(found.computed().vectors, expected.vectors)
    one = found.block((slice(None), slice(20, 40), slice(0, 20)))
    assert not one.valid.any()


def test_flow_is_nearly_that_in_memory_and_nearer_the_more_is_seen() -> None:
    before, after = scans((20, 72, 78))
    options = {"full_scale": 1500.0, "levels": 2, "data_weight": 0.05}
    expected = horn_schunck(before, after, **options)
    inside = inner(before.shape, 4)
    off = []
    for overlap in (4, 24):
        found = chunked_horn_schunck(chunked(before), chunked(after), overlap=(overlap,) * 3, block=(36, 36, 20), **options).computed()
        off.append(np.linalg.norm((found.vectors - expected.vectors)[inside], axis=-1))
    # a median may choose another neighbour at single voxels
    assert np.percentile(off[1], 99.5) < 0.02 and off[1].mean() < 0.001
    assert off[1].mean() < 0.1 * off[0].mean()


def test_flow_says_where_it_saw_nothing() -> None:
    before, after = scans((24, 40, 120))
    dark = [v.with_values(np.where(np.arange(120) < 80, 5, v.values).astype(np.uint16)) for v in (before, after)]
    found = chunked_horn_schunck(*map(chunked, dark), overlap=(8, 8, 8), block=(40, 40, 24), levels=2).computed()
    assert not found.valid[:, :, :40].any() and found.valid[4:20, 8:32, 88:112].all()


def stored_scans(folder: Path, shape: tuple[int, int, int] = (22, 50, 61)) -> tuple[Volume, Volume, list[ChunkedVolume]]:
    """Return scans, and the same in Zarr stores."""
    volumes = scans(shape)
    kept = []
    for volume, name in zip(volumes, ("before", "after"), strict=True):
        array = zarr.create_array(str(folder / f"{name}.zarr"), shape=volume.shape, chunks=(8, 16, 16), dtype=volume.values.dtype)
        array[...] = volume.values
        kept.append(ChunkedVolume(array, volume.spacing_mm, volume.origin_mm, volume.direction))
    return *volumes, kept


def test_two_workers_give_the_same(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    before, after, kept = stored_scans(tmp_path)
    displacement = zarr.create_array(str(tmp_path / "u.zarr"), shape=(*before.shape, 5), chunks=(7, 9, 11, 5), dtype="f8")
    response = zarr.create_array(str(tmp_path / "r.zarr"), shape=before.shape, chunks=(12, 12, 12), dtype="f4")
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster,
        distributed.Client(cluster) as client,
    ):
        assert len(client.scheduler_info()["workers"]) == 2
        packed = chunked_block_matching(*kept, search=(3, 4, 1), block=(20, 17, 12)).packed
        stored([packed, chunked_harris_response(kept[0], block=(24, 24, 12))], [displacement, response])

        def process(a: np.ndarray) -> np.ndarray:
            time.sleep(0.1)
            return np.full(a.shape, os.getpid())

        pids = np.unique(map_overlapping(process, [before.values], (0, 0, 0), block=(16, 16, 8), dtype=int).compute())
        assert len(pids) == 2 and os.getpid() not in pids
    expected = block_matching(before, after, search=(3, 4, 1))
    found = unpacked(displacement[...], before)
    np.testing.assert_array_equal(found.vectors, expected.vectors)
    np.testing.assert_array_equal(found.valid, expected.valid)
    np.testing.assert_array_equal(response[...], harris_response(before))


def peak_bytes(work: Callable[[], object]) -> int:
    tracemalloc.start()
    work()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak


def test_memory_does_not_grow_with_the_volume(tmp_path: Path) -> None:
    peaks, in_memory = [], []
    for nz in (48, 192):
        values = zarr.create_array(str(tmp_path / f"v{nz}.zarr"), shape=(nz, 96, 96), chunks=(24, 48, 48), dtype="u2")
        for k in range(0, nz, 24):
            values[k : k + 24] = np.random.default_rng(k).integers(0, 4000, (24, 96, 96))
        target = zarr.create_array(str(tmp_path / f"r{nz}.zarr"), shape=values.shape, chunks=(24, 48, 48), dtype="f4")
        volume = ChunkedVolume.from_array(values, spacing_mm=(1, 1, 1))
        work = lambda v=volume, t=target: stored([chunked_harris_response(v, block=(48, 48, 24))], [t])  # noqa: E731
        work()
        peaks.append(min(peak_bytes(work) for _ in range(3)))  # Zarr's threads hold more or less of what they read
        in_memory.append(peak_bytes(lambda v=volume: harris_response(v.volume())))
        np.testing.assert_array_equal(target[...], harris_response(volume.volume()))
    assert in_memory[1] > 3.5 * in_memory[0]
    # but for the list of what is to be done
    assert peaks[1] - peaks[0] < 0.03 * (in_memory[1] - in_memory[0]) and peaks[1] < 0.1 * in_memory[1]
    print(f"peak {peaks[0] / 1e6:.1f}, {peaks[1] / 1e6:.1f} MB in blocks, {in_memory[0] / 1e6:.0f}, {in_memory[1] / 1e6:.0f} MB in memory")


def test_invalid_arguments_are_refused() -> None:
    before, after = scans((12, 30, 30))
    constant = before.with_values(np.full(before.shape, 3, dtype=np.uint16))
    other = Volume.from_array(after.values, spacing_mm=(1, 1, 1))
    for work, message in (
        (lambda: map_overlapping(np.abs, [before.values, after.values[1:]], (1, 1, 1)), "one shape"),
        (lambda: map_overlapping(np.abs, [before.values], (1, 1)), "three whole numbers"),
        (lambda: map_overlapping(np.abs, [before.values], (1, 1, -1)), "three whole numbers"),
        (lambda: map_overlapping(lambda a: a[1:], [before.values], (1, 1, 1)).compute(scheduler="synchronous"), "the voxels that it gets"),
        (lambda: chunked_harris_response(chunked(constant)), "constant"),
        (lambda: chunked_harris_response(chunked(before), response="best"), "response must be"),
        (lambda: chunked_block_matching(chunked(before), chunked(constant)), "deformed volume is constant"),
        (lambda: chunked_horn_schunck(chunked(before), chunked(other)), "different grids"),
        (lambda: chunked_block_matching(chunked(before), chunked(after), matched_block=(2, 3, 3)), "must be odd"),
    ):
        with pytest.raises(InputError, match=message):
            work()
