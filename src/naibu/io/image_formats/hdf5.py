"""Volumes in HDF5, in blocks, so that parts of one larger than memory can be read.

The file holds a dataset ``values`` (nz, ny, nx) with the attributes ``spacing_mm``, ``origin_mm`` (x, y, z) and ``direction`` (3, 3).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import AnyArray
from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.io.files.atomic import new_aside, put_in_place
from naibu.io.image_formats.geometry import ReadOptions, content, volume_with_axes

BLOCK = 64
_ATTRIBUTES = ("spacing_mm", "origin_mm", "direction")


def read(path: Path, options: ReadOptions) -> Volume:
    """Read grey values (see `naibu.io.images.read_volume`)."""
    with _dataset(path) as stored:
        return _volume(path, stored, (0, 0, 0), stored.shape[::-1], options)


def read_box(path: Path, low: ArrayLike, high: ArrayLike, options: ReadOptions) -> Volume:
    """Read the voxels with indices from `low` up to, not including, `high`, in the order x, y, z; the rest of the file stays unread.

    Raises
    ------
    InputError
        A box that is not inside the volume, or a file that is no volume.
    """
    with _dataset(path) as stored:
        a, b = np.asarray(low, dtype=int), np.asarray(high, dtype=int)
        size = np.array(stored.shape[::-1])
        if (a < 0).any() or (b > size).any() or (a >= b).any():
            raise InputError(f"{path.name}: cannot read {a.tolist()}..{b.tolist()}: it has {size.tolist()} voxels along x, y, z")
        return _volume(path, stored, tuple(a.tolist()), tuple(b.tolist()), options)


def write(path: Path, values: AnyArray, grid: Volume, *, compressed: bool) -> Path:
    """Write grey values (nz, ny, nx), or vectors (nz, ny, nx, 3), that stand on the grid of a volume, in blocks of 64 voxels an edge."""
    aside = new_aside(path)
    try:
        with h5py.File(aside, "w") as file:
            chunks = tuple(min(n, BLOCK) for n in values.shape[:3]) + values.shape[3:]
            packed = {"compression": "gzip", "compression_opts": 1, "shuffle": True} if compressed else {}
            stored = file.create_dataset("values", data=values, chunks=chunks, **packed)
            stored.attrs["spacing_mm"], stored.attrs["origin_mm"] = grid.spacing_mm, grid.origin_mm
            stored.attrs["direction"] = grid.direction
        return put_in_place(aside, path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error}); free some space or choose another folder") from error
    finally:
        aside.unlink(missing_ok=True)


@contextmanager
def _dataset(path: Path) -> Iterator[Any]:
    """Open the dataset with the values of a file."""
    if not path.is_file():
        content(path)
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise InputError(f"{path.name}: cannot be read as HDF5 ({error}); copy the file again") from error
    with file:
        stored = file.get("values")
        if not isinstance(stored, h5py.Dataset) or any(name not in stored.attrs for name in _ATTRIBUTES):
            told = f"a dataset 'values' with the attributes {', '.join(_ATTRIBUTES)}"
            raise InputError(f"{path.name}: holds no volume: naibu looks for {told}; it has {sorted(file)}")
        if stored.ndim != 3:
            raise InputError(f"{path.name}: its values have {stored.ndim} axes {stored.shape}, not z, y, x; choose one time or component")
        yield stored


def _volume(path: Path, stored: Any, low: tuple[int, ...], high: tuple[int, ...], options: ReadOptions) -> Volume:
    box = tuple(slice(a, b) for a, b in zip(low[::-1], high[::-1], strict=True))
    axes = np.asarray(stored.attrs["direction"], dtype=float) * np.asarray(stored.attrs["spacing_mm"], dtype=float)
    origin = np.asarray(stored.attrs["origin_mm"], dtype=float) + axes @ np.asarray(low, dtype=float)
    return volume_with_axes(path.name, stored[box], origin, axes, options.unit_mm or 1.0)
