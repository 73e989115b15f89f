"""Archives of objects give back what was put in, and execute nothing that somebody else wrote into them."""

from __future__ import annotations

import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.imaging.volume_correlation.splines.spline_grid import SplineGrid
from naibu.io.files.object_archive import packed, unpacked


def back(value: Any, folder: Path) -> Any:
    path = folder / "kept.npz"
    path.write_bytes(packed(value))
    return unpacked(path)


def test_what_is_packed_comes_back(tmp_path: Path) -> None:
    grid = SplineGrid(np.array([1.0, 2.0, 3.0]), np.full(3, 0.5), np.array([2, 3, 4]))
    wide = np.broadcast_to(np.float32(3.0), (1000, 1000, 1000))  # would take gigabytes
    value = {"a": (1, 2.5, None, True, "x", float("inf")), "b": [slice(1, None), Path("p")], "grid": grid, "again": grid, "wide": wide}
    found = back(value, tmp_path)
    assert found["a"] == value["a"] and found["b"] == value["b"]
    assert found["grid"] is found["again"]
    assert type(found["grid"]) is SplineGrid and np.array_equal(found["grid"].origin_mm, grid.origin_mm)
    assert found["wide"].shape == wide.shape and found["wide"][5, 6, 7] == 3.0
    assert (tmp_path / "kept.npz").stat().st_size < 10_000
    for array in (np.zeros((0, 3), np.float32), np.array(2), np.arange(6).reshape(2, 3).T):
        again = back(array, tmp_path)
        assert again.dtype == array.dtype and np.array_equal(again, array) and again.shape == array.shape
    volume = Volume.from_array(np.arange(24.0).reshape(2, 3, 4), spacing_mm=(1.0, 2.0, 3.0))
    assert np.array_equal(back((volume, np.float64(2.0)), tmp_path)[0].values, volume.values)


class Evil:
    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (Path("executed"),)


def test_nothing_in_a_file_is_executed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "kept.npz"
    path.write_bytes(pickle.dumps(Evil()))
    with pytest.raises(InputError, match="damaged"):
        unpacked(path)
    np.savez(path, tree=np.array([Evil()], dtype=object))
    with pytest.raises(InputError, match="damaged"):
        unpacked(path)
    for told in (["os", "system"], ["pathlib", "Path"], ["naibu.core.errors", "InputError"], ["naibu.core.volume", "np"]):
        tree = {"objects": [{"class": told, "state": {}}], "root": {"object": 0}}
        np.savez(path, tree=np.frombuffer(json.dumps(tree).encode(), np.uint8))
        with pytest.raises(InputError, match="no class"):
            unpacked(path)
    assert not (tmp_path / "executed").exists()
    with pytest.raises(TypeError):
        packed(Evil())


def test_a_damaged_file_is_told_of(tmp_path: Path) -> None:
    path = tmp_path / "kept.npz"
    whole = packed((np.arange(1000),))
    for data in (b"", whole[: len(whole) // 2], b"x" * 100):
        path.write_bytes(data)
        with pytest.raises(InputError, match="damaged"):
            unpacked(path)
