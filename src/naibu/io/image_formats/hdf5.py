"""Image volumes in HDF5, chunked, so that parts of a volume larger than memory can be read.

The file contains a dataset ``values`` (nz, ny, nx) with the attributes ``spacing_mm``, ``origin_mm`` (x, y, z) and ``direction`` (3, 3).
The only dataset with three axes of numbers of another program's file is read, too, where the spacing of voxels is given, or stands in its
attribute ``element_size_um`` (z, y, x, in micrometres), as Fiji and ilastik write it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import AnyArray, FloatArray
from naibu.core.chunked_volume import ChunkedVolume
from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.io.files.atomic import new_aside, put_in_place
from naibu.io.files.hdf5_stream import Hdf5File
from naibu.io.files.reading import require_plausible, require_regular
from naibu.io.image_formats.geometry import ReadOptions, volume_with_axes

BLOCK = 64
_ELEMENT_SIZE = "element_size_um"
_ATTRIBUTES = ("spacing_mm", "origin_mm", "direction")


def read(path: Path, options: ReadOptions) -> Volume:
    """Read a volume (see `naibu.io.images.read_volume`)."""
    with _dataset(path, options.spacing_mm) as stored:
        return _volume(path, stored, (0, 0, 0), stored.shape[::-1], options)


def read_box(path: Path, low: ArrayLike, high: ArrayLike, options: ReadOptions) -> Volume:
    """Read the voxels with indices `low` <= index < `high` along x, y, z, without reading the rest of the file.

    Raises
    ------
    InputError
        The box is not inside the volume, or the file contains no volume.
    """
    with _dataset(path, options.spacing_mm) as stored:
        a, b = np.asarray(low, dtype=int), np.asarray(high, dtype=int)
        size = np.array(stored.shape[::-1])
        if (a < 0).any() or (b > size).any() or (a >= b).any():
            raise InputError(f"{path.name}: cannot read {a.tolist()}..{b.tolist()}: the volume has {size.tolist()} voxels along x, y, z")
        return _volume(path, stored, tuple(a.tolist()), tuple(b.tolist()), options)


def open_chunked(path: Path, spacing_mm: FloatArray | None = None) -> ChunkedVolume:
    """Open a volume without reading its voxels; the file stays open as long as the volume exists.

    Parameters
    ----------
    path : Path
        File.
    spacing_mm : ndarray, shape (3,), optional
        Distance of voxels along x, y, z, mm, for files that do not state it.

    Raises
    ------
    InputError
        No such file, or one without a volume.
    """
    with _dataset(path, spacing_mm) as checked:
        name, frame = checked.name, _frame(checked, spacing_mm)
    return ChunkedVolume.from_array(h5py.File(path, "r")[name], **frame)


def write(path: Path, values: AnyArray, grid: Volume, *, compressed: bool) -> Path:
    """Write intensities (nz, ny, nx), or vectors (nz, ny, nx, 3), on the grid of a volume, in chunks of 64 voxels per edge."""
    aside = new_aside(path)
    try:
        output = Hdf5File(aside)
        try:
            chunks = tuple(min(n, BLOCK) for n in values.shape[:3]) + values.shape[3:]
            packed = {"compression": "gzip", "compression_opts": 1, "shuffle": True} if compressed else {}
            stored = output.file.create_dataset("values", data=values, chunks=chunks, **packed)
            stored.attrs["spacing_mm"], stored.attrs["origin_mm"] = grid.spacing_mm, grid.origin_mm
            stored.attrs["direction"] = grid.direction
        finally:
            output.close()
        output.require_written()
        return put_in_place(aside, path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error}); free some space or choose another folder") from error
    finally:
        aside.unlink(missing_ok=True)


@contextmanager
def _dataset(path: Path, spacing_mm: FloatArray | None) -> Iterator[Any]:
    """Open the dataset with the values of a file."""
    require_regular(path)
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise InputError(f"{path.name}: cannot be read as HDF5 ({error}); copy the file again") from error
    with file:
        link = file.get("values", getlink=True) if "values" in file else None
        if isinstance(link, h5py.ExternalLink):
            raise InputError(f"{path.name}: its values are a link to {link.filename!r}; copy them into the file")
        stored = file.get("values")
        if not isinstance(stored, h5py.Dataset) or any(name not in stored.attrs for name in _ATTRIBUTES):
            stored = _foreign(path, file, spacing_mm)
        if stored.file.filename != file.filename:
            raise InputError(f"{path.name}: its values stand in {stored.file.filename!r}, to which a link leads; copy them into the file")
        if stored.ndim != 3:
            raise InputError(f"{path.name}: its values have {stored.ndim} axes {stored.shape}, not (z, y, x); save one of its components")
        if stored.external or stored.is_virtual:
            raise InputError(f"{path.name}: its values stand in other files (external or virtual storage); copy them into one file")
        require_plausible(path.name, stored.nbytes, stored.id.get_storage_size(), compressed=stored.chunks is not None)
        yield stored


def _foreign(path: Path, file: h5py.File, spacing_mm: FloatArray | None) -> h5py.Dataset:
    """Return the only dataset with three axes of numbers of another program's file, for which the spacing has to be given."""
    found: list[h5py.Dataset] = []
    file.visititems(lambda _, item: found.append(item) if isinstance(item, h5py.Dataset) and _is_volume(item) else None)
    names = ", ".join(repr(item.name) for item in found) or str(sorted(file))
    if len(found) > 1:
        raise InputError(
            f"{path.name}: holds several volumes ({names}), and does not tell which is the scan; save one as a file of its own"
        )
    if not found:
        expected = "one dataset of numbers with three axes (z, y, x)"
        raise InputError(f"{path.name}: contains no volume: naibu expects {expected}; the file has {names}")
    if spacing_mm is None and _ELEMENT_SIZE not in found[0].attrs:
        raise InputError(f"{path.name}: does not state the distance of the voxels of {names}; give it as spacing_mm")
    return found[0]


def _is_volume(item: h5py.Dataset) -> bool:
    return item.ndim == 3 and item.dtype.kind in "biuf"


def _frame(stored: Any, spacing_mm: FloatArray | None) -> dict[str, FloatArray]:
    """Return spacing and position of the voxels, as the file states them or as they were given."""
    if all(name in stored.attrs for name in _ATTRIBUTES):
        return {name: np.asarray(stored.attrs[name], dtype=float) for name in _ATTRIBUTES}
    if spacing_mm is None:
        spacing_mm = np.asarray(stored.attrs[_ELEMENT_SIZE], dtype=float)[::-1] / 1000.0
    return {"spacing_mm": np.asarray(spacing_mm, dtype=float), "origin_mm": np.zeros(3), "direction": np.eye(3)}


def _volume(path: Path, stored: Any, low: tuple[int, ...], high: tuple[int, ...], options: ReadOptions) -> Volume:
    box = tuple(slice(a, b) for a, b in zip(low[::-1], high[::-1], strict=True))
    frame = _frame(stored, options.spacing_mm)
    axes = frame["direction"] * frame["spacing_mm"]
    origin = frame["origin_mm"] + axes @ np.asarray(low, dtype=float)
    return volume_with_axes(path.name, stored[box], origin, axes, options.unit_mm or 1.0)
