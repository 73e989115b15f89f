"""Volumes in Zarr stores come back as they were, whole, in parts, and without being read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from naibu.core.chunked_volume import ChunkedVolume
from naibu.core.errors import InputError
from naibu.core.rigid_transform import rotation_matrix
from naibu.core.volume import Volume
from naibu.io.image_formats.zarr_store import create_chunked
from naibu.io.images import open_volume, read_volume, read_volume_box, write_volume

zarr = pytest.importorskip("zarr")


def volume(dtype: str = "uint16") -> Volume:
    values = np.random.default_rng(0).integers(0, 60000, (20, 70, 81)).astype(dtype)
    return Volume.from_array(
        values, spacing_mm=(0.5, 0.6, 2.0), origin_mm=(3, -4, 5), direction=rotation_matrix(np.array([0.2, 0.1, -0.4]))
    )


@pytest.mark.parametrize("dtype", ["uint8", "int16", "uint16", "float32", "float64"])
def test_values_and_geometry_come_back(tmp_path: Path, dtype: str) -> None:
    before = volume(dtype)
    write_volume(tmp_path / "a.zarr", before)
    after = read_volume(tmp_path / "a.zarr")
    assert after.values.dtype == before.values.dtype and after.same_grid(before)
    np.testing.assert_array_equal(after.values, before.values)
    np.testing.assert_allclose(after.direction, before.direction, atol=1e-12)
    write_volume(tmp_path / "a.zarr", before.with_values(np.zeros_like(before.values)))
    assert (read_volume(tmp_path / "a.zarr").values == 0).all()
    assert [p.name for p in tmp_path.iterdir()] == ["a.zarr"]


def test_parts_are_read_alone(tmp_path: Path) -> None:
    before = volume()
    write_volume(tmp_path / "a.zarr", before)
    part = read_volume_box(tmp_path / "a.zarr", (1, 2, 3), (15, 68, 7))
    expected = before.cropped((1, 2, 3), (15, 68, 7))
    np.testing.assert_array_equal(part.values, expected.values)
    assert part.same_grid(expected)
    with pytest.raises(InputError, match="cannot read"):
        read_volume_box(tmp_path / "a.zarr", (0, 0, 0), (90, 8, 7))
    # a chunk that is gone is found out only by those who ask for it
    stored = open_volume(tmp_path / "a.zarr")
    assert stored.shape == before.shape and stored.grid.same_grid(before)
    box = (slice(2, 5), slice(10, 30), slice(0, 9))
    np.testing.assert_array_equal(stored.block(box).values, before.values[box])
    np.testing.assert_allclose(stored.block(box).origin_mm, before.to_physical((0, 10, 2)))
    np.testing.assert_array_equal(stored.volume().values, before.values)


def test_empty_volumes_are_filled_part_by_part(tmp_path: Path) -> None:
    before = volume("float32")
    target = create_chunked(tmp_path / "b.zarr", before, dtype=np.float32, chunk=32)
    assert target.chunks == (20, 32, 32)
    target[:, :35] = before.values[:, :35]
    target[:, 35:] = before.values[:, 35:]
    np.testing.assert_array_equal(read_volume(tmp_path / "b.zarr").values, before.values)
    vectors = create_chunked(tmp_path / "c.zarr", before, components=3)
    assert vectors.shape == (*before.shape, 3)
    with pytest.raises(InputError, match="4 axes"):
        read_volume(tmp_path / "c.zarr")


def test_what_is_no_volume_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such Zarr store"):
        read_volume(tmp_path / "a.zarr")
    zarr.create_group(str(tmp_path / "b.zarr"))
    with pytest.raises(InputError, match="array 'values'"):
        read_volume(tmp_path / "b.zarr")
    group = zarr.create_group(str(tmp_path / "c.zarr"))
    group.create_array("values", shape=(2, 2, 2), dtype="f4")
    with pytest.raises(InputError, match="spacing_mm"):
        read_volume(tmp_path / "c.zarr")
    (tmp_path / "d.zarr").mkdir()
    with pytest.raises(InputError, match="contains no volume"):
        read_volume(tmp_path / "d.zarr")
    with pytest.raises(InputError, match=r"a\.h5"):
        open_volume(tmp_path / "a.h5")


@pytest.mark.parametrize("form", [2, 3])
@pytest.mark.parametrize("shards", [None, (8, 8, 8)])
def test_missing_chunks_are_values_only_where_the_store_says_so(tmp_path: Path, form: int, shards: tuple[int, int, int] | None) -> None:
    if form == 2 and shards:
        pytest.skip("version 2 of Zarr has no shards")
    frame = {"spacing_mm": [1.0, 1.0, 1.0], "origin_mm": [0.0, 0.0, 0.0], "direction": np.eye(3).tolist()}
    group = zarr.create_group(str(tmp_path / "a.zarr"), zarr_format=form)
    group.attrs.update(frame)
    stored = group.create_array("values", shape=(9, 8, 8), chunks=(4, 4, 4), shards=shards, dtype="i2", fill_value=7)
    stored[:8] = 1
    with pytest.raises(InputError, match=r"chunks are missing, or were not written yet, and would be read as 7.*every_chunk_is_stored"):
        read_volume(tmp_path / "a.zarr")
    group.attrs["every_chunk_is_stored"] = False
    values = read_volume(tmp_path / "a.zarr").values
    assert (values[:8] == 1).all() and (values[8] == 7).all()
    stored[:] = 2
    del group.attrs["every_chunk_is_stored"]
    assert (read_volume(tmp_path / "a.zarr").values == 2).all()


def test_missing_chunks_of_unknown_values_are_unknown(tmp_path: Path) -> None:
    group = zarr.create_group(str(tmp_path / "a.zarr"))
    group.attrs.update(spacing_mm=[1.0, 1.0, 1.0], origin_mm=[0.0, 0.0, 0.0], direction=np.eye(3).tolist())
    stored = group.create_array("values", shape=(8, 8, 8), chunks=(4, 8, 8), dtype="f4", fill_value=np.nan)
    stored[:4] = 1.0
    assert np.isnan(np.asarray(open_volume(tmp_path / "a.zarr").values[4:])).all()
    with pytest.raises(InputError, match="nan; mask or repair"):
        read_volume(tmp_path / "a.zarr")


def test_arrays_of_other_shapes_are_no_volumes() -> None:
    with pytest.raises(InputError, match="three axes"):
        ChunkedVolume.from_array(np.zeros((3, 3)), spacing_mm=(1, 1, 1))
    with pytest.raises(InputError, match="spacing"):
        ChunkedVolume.from_array(np.zeros((3, 3, 3)), spacing_mm=(1, 0, 1))
