"""Volumes at several resolutions: what the specification requires, where voxels lie at every level, and reading them again."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from naibu.core.chunked_volume import ChunkedVolume
from naibu.core.errors import InputError
from naibu.core.rigid_transform import rotation_matrix
from naibu.core.volume import Volume
from naibu.io.image_formats.ome_zarr import halved
from naibu.io.images import open_volume, read_volume, write_displacement, write_volume

zarr = pytest.importorskip("zarr")
SPACING, ORIGIN, SHAPE = (0.5, 0.6, 2.0), (3.0, -4.0, 5.0), (40, 131, 270)


def positions(axis: int) -> Volume:
    """A volume whose intensity is the position of the voxel along x, y or z, mm."""
    along = ORIGIN[axis] + SPACING[axis] * np.arange(SHAPE[2 - axis])
    shape = [1, 1, 1]
    shape[2 - axis] = -1
    values = np.broadcast_to(along.reshape(shape), SHAPE).astype(np.float32)
    return Volume.from_array(values, spacing_mm=SPACING, origin_mm=ORIGIN)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_stated_position_of_a_voxel_is_that_of_what_it_shows(tmp_path: Path, axis: int) -> None:
    """The mean of a linear intensity over 2 x 2 x 2 voxels is its value at their centre, where the level must state the voxel."""
    write_volume(tmp_path / "a.ome.zarr", positions(axis))
    group = zarr.open_group(str(tmp_path / "a.ome.zarr"), mode="r")
    (image,) = group.attrs["multiscales"]
    assert len(image["datasets"]) == 4  # 270, 135, 68, 34 voxels along x
    for level in image["datasets"]:
        values = group[level["path"]][...]
        scale, shift = (step[step["type"]] for step in level["coordinateTransformations"])
        k = 2 - axis
        whole = [n // round(s / g) for n, s, g in zip(SHAPE, scale, SPACING[::-1], strict=True)]  # voxels that are means of eight
        stated = shift[k] + scale[k] * np.arange(whole[k])
        found = np.moveaxis(values[: whole[0], : whole[1], : whole[2]], k, -1)
        np.testing.assert_allclose(found, np.broadcast_to(stated, found.shape), rtol=2e-6)


def test_metadata_are_those_that_the_specification_requires(tmp_path: Path) -> None:
    """Version 0.4: https://ngff.openmicroscopy.org/0.4, sections multiscales and omero; the store is a Zarr group of version 2."""
    field = np.zeros((*SHAPE, 3), dtype=np.float32)
    write_displacement(tmp_path / "u.ome.zarr", field, positions(0))
    assert json.loads((tmp_path / "u.ome.zarr" / ".zgroup").read_text(encoding="utf-8")) == {"zarr_format": 2}
    told = json.loads((tmp_path / "u.ome.zarr" / ".zattrs").read_text(encoding="utf-8"))
    (image,) = told["multiscales"]
    assert image["version"] == "0.4" and [axis["name"] for axis in image["axes"]] == ["c", "z", "y", "x"]
    assert [axis["type"] for axis in image["axes"]] == ["channel", "space", "space", "space"]
    assert all(axis["unit"] == "millimeter" for axis in image["axes"][1:])
    for level in image["datasets"]:
        array = json.loads((tmp_path / "u.ome.zarr" / level["path"] / ".zarray").read_text(encoding="utf-8"))
        assert array["dimension_separator"] == "/" and len(array["shape"]) == 4 and array["shape"][0] == 3
        assert [step["type"] for step in level["coordinateTransformations"]] == ["scale", "translation"]
        assert all(len(step[step["type"]]) == 4 for step in level["coordinateTransformations"])
    assert [channel["label"] for channel in told["omero"]["channels"]] == ["x", "y", "z"]
    assert all({"color", "window"} <= set(channel) for channel in told["omero"]["channels"])


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
def test_values_and_geometry_come_back(tmp_path: Path, dtype: str) -> None:
    values = np.random.default_rng(0).integers(0, 250, (20, 70, 81)).astype(dtype)
    direction = rotation_matrix(np.array([0.2, 0.1, -0.4]))
    before = Volume.from_array(values, spacing_mm=SPACING, origin_mm=ORIGIN, direction=direction)
    write_volume(tmp_path / "a.ome.zarr", before)
    for after in (read_volume(tmp_path / "a.ome.zarr"), open_volume(tmp_path / "a.ome.zarr").volume()):
        assert after.values.dtype == before.values.dtype and after.same_grid(before)
        np.testing.assert_array_equal(after.values, before.values)
    write_volume(tmp_path / "a.ome.zarr", before.with_values(np.zeros_like(values)))
    assert (read_volume(tmp_path / "a.ome.zarr").values == 0).all()
    assert [p.name for p in tmp_path.iterdir()] == ["a.ome.zarr"]


def test_halves_are_means_of_what_is_known() -> None:
    values = np.array([[[1.0, 3.0, 5.0], [np.nan, np.nan, 7.0]], [[np.nan, np.nan, np.nan], [np.nan, np.nan, np.nan]], [[np.nan] * 3] * 2])
    np.testing.assert_allclose(halved(values), [[[2.0, 6.0]], [[np.nan, np.nan]]])
    assert halved(np.array([[[1, 2], [2, 2]]], dtype=np.uint8)).tolist() == [[[2.0]]]


def test_only_boxes_are_read(tmp_path: Path) -> None:
    class Lazy:
        shape, dtype = (300, 40, 40), np.dtype(np.uint16)
        most = 0

        def __getitem__(self, box: object) -> np.ndarray:
            part = np.broadcast_to(np.arange(300, dtype=np.uint16)[:, None, None], self.shape)[box]
            Lazy.most = max(Lazy.most, part.size)
            return part

    grid = ChunkedVolume.from_array(Lazy(), spacing_mm=(1, 1, 1))
    from naibu.io.image_formats.ome_zarr import write_levels

    write_levels(tmp_path / "a.ome.zarr", grid.values, grid)
    assert Lazy.most < 300 * 40 * 40 / 2
    assert (open_volume(tmp_path / "a.ome.zarr").values[299] == 299).all()


def test_other_stores_and_shapes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such Zarr store"):
        open_volume(tmp_path / "absent.ome.zarr")
    zarr.create_group(str(tmp_path / "b.ome.zarr"))
    with pytest.raises(InputError, match="no OME-Zarr image"):
        read_volume(tmp_path / "b.ome.zarr")
    write_displacement(tmp_path / "u.ome.zarr", np.zeros((4, 5, 6, 3)), Volume.from_array(np.zeros((4, 5, 6)), spacing_mm=(1, 1, 1)))
    with pytest.raises(InputError, match="axes czyx"):
        read_volume(tmp_path / "u.ome.zarr")
    group = zarr.open_group(str(tmp_path / "u.ome.zarr"))
    (image,) = group.attrs["multiscales"]
    write_volume(tmp_path / "c.ome.zarr", Volume.from_array(np.zeros((4, 5, 6)), spacing_mm=(1, 1, 1)))
    store = zarr.open_group(str(tmp_path / "c.ome.zarr"))
    (image,) = store.attrs["multiscales"]
    for axis in image["axes"]:
        axis["unit"] = "parsec"
    store.attrs["multiscales"] = [image]
    with pytest.raises(InputError, match=r"parsec.*unit_mm"):
        read_volume(tmp_path / "c.ome.zarr")
    assert read_volume(tmp_path / "c.ome.zarr", unit_mm=2.0).spacing_mm.tolist() == [2.0, 2.0, 2.0]
