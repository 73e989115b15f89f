"""HDF5 files and 16-bit TIFF stacks that are opened without being read give the same voxels as those that are read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile

from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.io.images import open_volume, read_volume, write_volume

BOX = (slice(2, 5), slice(1, 8, 2), slice(None, 4))


def volume() -> Volume:
    values = np.random.default_rng(0).integers(0, 60000, (7, 9, 8)).astype(np.uint16)
    return Volume.from_array(values, spacing_mm=(0.5, 0.6, 2.0), origin_mm=(3, -4, 5))


@pytest.mark.parametrize("name", ["a.h5", "a.tif"])
@pytest.mark.parametrize("compressed", [True, False])
def test_parts_are_those_of_the_whole(tmp_path: Path, name: str, compressed: bool) -> None:
    before = volume()
    write_volume(tmp_path / name, before, compressed=compressed)
    opened, whole = open_volume(tmp_path / name), read_volume(tmp_path / name)
    assert opened.shape == before.shape and opened.values.dtype == np.uint16 and opened.grid.same_grid(whole)
    np.testing.assert_array_equal(opened.block(BOX).values, before.values[BOX])
    np.testing.assert_array_equal(opened.values[3], before.values[3])
    np.testing.assert_array_equal(opened.values[:, 2, 1], before.values[:, 2, 1])
    np.testing.assert_array_equal(opened.volume().values, before.values)


def test_slices_in_a_folder_are_decoded_one_by_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = volume().values
    for k, plane in enumerate(before):
        tifffile.imwrite(tmp_path / f"slice_{k + 1:03d}.tif", plane)
    opened = open_volume(tmp_path, spacing_mm=(0.5, 0.6, 2.0))
    assert opened.spacing_mm.tolist() == [0.5, 0.6, 2.0]
    decoded: list[str] = []
    read = tifffile.imread
    monkeypatch.setattr(tifffile, "imread", lambda file, **options: decoded.append(Path(file).name) or read(file, **options))
    np.testing.assert_array_equal(opened.block(BOX).values, before[BOX])
    assert decoded == ["slice_003.tif", "slice_004.tif", "slice_005.tif"]
    with pytest.raises(InputError, match="spacing_mm"):
        open_volume(tmp_path)
    tifffile.imwrite(tmp_path / "slice_004.tif", before[3, :-1])
    with pytest.raises(InputError, match=r"slice_004\.tif"):
        opened.volume()


def test_what_is_no_stack_is_refused(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "colours.tif", np.zeros((4, 5, 3), dtype=np.uint8), photometric="rgb")
    (tmp_path / "torn.tif").write_bytes(b"II*\x00\x08\x00")
    (tmp_path / "torn.h5").write_bytes(b"\x89HDF")
    for name in ("colours.tif", "torn.tif", "torn.h5", "absent.tif", "absent.h5", "a.mha"):
        with pytest.raises(InputError, match=name.split(".")[0]):
            open_volume(tmp_path / name)
    with pytest.raises(InputError, match="three positive numbers"):
        open_volume(tmp_path / "a.tif", spacing_mm=(1.0, -1.0, 1.0))
