"""Volumes as microscopes and converters write them: OME-TIFF, OME-Zarr with five axes, HDF5 with the size of a voxel, raw values."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.io.images import open_volume, read_volume

tifffile, zarr = pytest.importorskip("tifffile"), pytest.importorskip("zarr")
VALUES = np.arange(4 * 5 * 6, dtype=np.uint16).reshape(4, 5, 6)
STORES = ("a.ome.zarr", "a.zarr")


@pytest.mark.parametrize(("unit", "per_mm"), [("µm", 1e3), ("nm", 1e6), ("mm", 1.0), (None, 1e3)])
def test_ome_tiff_states_its_spacing(tmp_path: Path, unit: str | None, per_mm: float) -> None:
    sizes = {"X": 0.2, "Y": 0.3, "Z": 0.5}
    metadata: dict[str, object] = {"axes": "ZYX"}
    for axis, mm in sizes.items():
        metadata[f"PhysicalSize{axis}"] = mm * per_mm
        if unit is not None:  # the unit of the schema is the micrometre
            metadata[f"PhysicalSize{axis}Unit"] = unit
    tifffile.imwrite(tmp_path / "a.ome.tif", VALUES, metadata=metadata)
    for volume in (read_volume(tmp_path / "a.ome.tif"), open_volume(tmp_path / "a.ome.tif")):
        np.testing.assert_allclose(volume.spacing_mm, [0.2, 0.3, 0.5])
        np.testing.assert_array_equal(volume.values[:], VALUES)


def test_ome_tiff_without_a_distance_of_slices_is_refused(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.ome.tif", VALUES, metadata={"axes": "ZYX", "PhysicalSizeX": 200.0, "PhysicalSizeY": 300.0})
    with pytest.raises(InputError, match=r"no voxel spacing along z \(along x, y: 0\.2, 0\.3 mm\)"):
        read_volume(tmp_path / "a.ome.tif")


def five_axes(path: Path, channels: int = 1) -> Path:
    group = zarr.open_group(str(path), mode="w", zarr_format=2)
    level = group.create_array("0", shape=(1, channels, *VALUES.shape), dtype=VALUES.dtype, chunks=(1, 1, *VALUES.shape))
    level[:] = np.broadcast_to(VALUES, level.shape)
    space = [{"name": axis, "type": "space", "unit": "micrometer"} for axis in "zyx"]
    steps = [{"type": "scale", "scale": [0.1, 1.0, 500.0, 300.0, 200.0]}, {"type": "translation", "translation": [0, 0, 3e3, 2e3, 1e3]}]
    axes = [{"name": "t", "type": "time", "unit": "second"}, {"name": "c", "type": "channel"}, *space]
    group.attrs["multiscales"] = [{"version": "0.4", "axes": axes, "datasets": [{"path": "0", "coordinateTransformations": steps}]}]
    return path


@pytest.mark.parametrize("name", STORES)
def test_one_time_point_and_channel_of_ome_zarr_are_read(tmp_path: Path, name: str) -> None:
    five_axes(tmp_path / name)
    for volume in (read_volume(tmp_path / name), open_volume(tmp_path / name)):
        np.testing.assert_allclose(volume.spacing_mm, [0.2, 0.3, 0.5])
        np.testing.assert_allclose(volume.origin_mm, [1.0, 2.0, 3.0])
        np.testing.assert_array_equal(volume.values[1:3, 2:4], VALUES[1:3, 2:4])


def test_two_channels_of_ome_zarr_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"axes tczyx of 1 x 2 x 4 x 5 x 6.*save one time point and channel"):
        read_volume(five_axes(tmp_path / "a.ome.zarr", channels=2))


def test_hdf5_with_the_size_of_a_voxel_needs_no_spacing(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("exported/ct", data=VALUES).attrs["element_size_um"] = np.array([500.0, 300.0, 200.0])  # z, y, x
    for volume in (read_volume(tmp_path / "a.h5"), open_volume(tmp_path / "a.h5")):
        np.testing.assert_allclose(volume.spacing_mm, [0.2, 0.3, 0.5])


def test_hdf5_with_two_volumes_names_them(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["volume"], file["mask"] = VALUES, VALUES > 7
    with pytest.raises(InputError, match=r"holds several volumes \('/mask', '/volume'\).*save one"):
        read_volume(tmp_path / "a.h5", spacing_mm=(1, 1, 1))


@pytest.mark.parametrize("name", ["case.img", "case.raw", "case.bin"])
def test_raw_values_are_read_by_the_header_that_the_message_asks_for(tmp_path: Path, name: str) -> None:
    VALUES.tofile(tmp_path / name)
    with pytest.raises(InputError, match=rf"text file case\.mhd beside it.*ElementDataFile = {name}"):
        read_volume(tmp_path / name)
    header = f"NDims = 3\nDimSize = 6 5 4\nElementSpacing = 0.2 0.3 0.5\nElementType = MET_USHORT\nElementDataFile = {name}\n"
    (tmp_path / "case.mhd").write_text(header)
    volume = read_volume(tmp_path / "case.mhd")
    np.testing.assert_array_equal(volume.values, VALUES)
    np.testing.assert_allclose(volume.spacing_mm, [0.2, 0.3, 0.5])


def test_a_folder_that_is_not_there_is_told_as_such(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file or folder"):
        read_volume(tmp_path / "dicom_series")
