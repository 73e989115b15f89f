"""HDF5 volumes of other programs: the only dataset with three axes, at the spacing that the user gives."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.io.images import open_volume, read_volume

VALUES = np.arange(4 * 5 * 6, dtype=np.uint16).reshape(4, 5, 6)


def written(path: Path, **datasets: np.ndarray) -> Path:
    with h5py.File(path, "w") as file:
        for name, values in datasets.items():
            file.create_dataset(f"exchange/{name}", data=values)
    return path


def test_the_only_volume_of_a_file_is_read_whole_and_in_parts(tmp_path: Path) -> None:
    path = written(tmp_path / "scan.h5", data=VALUES, theta=np.zeros(7))
    whole, opened = read_volume(path, spacing_mm=(0.1, 0.2, 0.3)), open_volume(path, spacing_mm=(0.1, 0.2, 0.3))
    assert np.array_equal(whole.values, VALUES) and whole.spacing_mm.tolist() == [0.1, 0.2, 0.3]
    assert isinstance(opened.values, h5py.Dataset)  # only what is sliced is read
    assert np.array_equal(opened.values[1:3, 2:4, 1:5], VALUES[1:3, 2:4, 1:5])
    assert opened.spacing_mm.tolist() == [0.1, 0.2, 0.3]


def test_a_file_that_leaves_it_open_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "scan.h5", data=VALUES)
    for read in (read_volume, open_volume):
        with pytest.raises(InputError, match="give it as spacing_mm"):
            read(path)
    for datasets, expected in (({"data": VALUES, "dark": VALUES}, "several volumes"), ({"data": VALUES[0]}, "contains no volume")):
        with pytest.raises(InputError, match=expected):
            open_volume(written(path, **datasets), spacing_mm=(1.0, 1.0, 1.0))
