"""Read clouds of points without labels: tables, Excel, MATLAB and NumPy files."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from naibu.core.arrays import LENGTHS_MM, AnyArray, FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.io.files.reading import guarded_reading, require_plausible, require_regular
from naibu.io.tables.point_tables import EXCEL, TEXT, read_point_table
from naibu.io.tables.table_cells import MM_PER_UNIT

ARRAYS = (".npy", ".npz", ".mat")
POINT_FILES = (*TEXT, *EXCEL, *ARRAYS)


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud:
    """Points (n, d) and, where the file states them, standard deviations of their coordinates (n, d), mm; rows in the file (n,), from 1.

    `copies` counts the points that were left out because another one has the same coordinates.
    """

    points: FloatArray
    sd: FloatArray | None
    rows: IntArray
    copies: int = 0

    def __len__(self) -> int:
        return len(self.points)


def read_point_cloud(
    path: str | os.PathLike[str], *, unit: str | None = None, spacing_mm: Sequence[float] | None = None, variable: str | None = None
) -> PointCloud:
    """Read the positions of particles in two or three dimensions.

    Parameters
    ----------
    path : path-like
        Table (``.csv``, ``.tsv``, ``.txt``, ``.xlsx``) with columns x, y and z, recognised by their names; ``.npy`` of shape (n, d); or
        ``.npz`` or ``.mat`` with such an array, or with one array for each of x, y, z. MATLAB's cells are called ``x{1}``.
    unit : str, optional
        Unit of the coordinates: mm, cm, m, um or inch. By default that in the names of columns, else mm.
    spacing_mm : sequence of float, optional
        Size of a voxel along x, y, z, mm, where coordinates are in voxels.
    variable : str, optional
        Which array of an ``.npz`` or ``.mat`` file; by default the only one that can be points.

    Returns
    -------
    PointCloud
        Points with finite coordinates; rows with blank cells or NaN are left out, and copies of a point.

    Raises
    ------
    InputError
        A file that cannot be read, without points, or with several arrays that may be points.
    """
    source = Path(path)
    ending = source.suffix.lower()
    if unit is not None and unit not in MM_PER_UNIT:
        raise InputError(f"unit = {unit!r} is not known; use one of {', '.join(dict.fromkeys(MM_PER_UNIT))}")
    if unit is not None and spacing_mm is not None:
        raise InputError("`unit` and spacing_mm both say what a coordinate is; give one of them")
    if ending not in POINT_FILES:
        raise InputError(f"{source.name}: is no file of points; supported are {', '.join(POINT_FILES)}")
    if variable is not None and ending not in (".npz", ".mat"):
        raise InputError(f"variable = {variable!r}, but {source.name} has no named arrays; leave it out")
    require_regular(source)
    with guarded_reading(source, "points"):
        if ending in ARRAYS:
            found, sd = _array(source, ending, variable) * MM_PER_UNIT[unit or "mm"], None
        else:
            table = read_point_table(source, unit=unit, displacements=False)
            found, sd = table.points, table.sd
            if table.in_voxels and spacing_mm is None:
                raise InputError(f"{source}: its positions are in voxels; give the size of a voxel as `spacing_mm`")
    if spacing_mm is not None:
        voxel = np.asarray(spacing_mm, dtype=float)[: found.shape[1]]
        found, sd = found * voxel, None if sd is None else sd * voxel
    known = np.isfinite(found).all(axis=1) & (True if sd is None else np.isfinite(sd).all(axis=1))
    if not known.any():
        raise InputError(f"{source}: has no point whose coordinates are all known")
    points = np.ascontiguousarray(found[known])
    if np.abs(points).max() > LENGTHS_MM[1]:
        raise InputError(f"{source}: has a coordinate of {np.abs(points).max():.3g} mm: no object is so large; give the `unit`")
    first = np.sort(np.unique(points, axis=0, return_index=True)[1])
    return PointCloud(points[first], None if sd is None else sd[known][first], np.flatnonzero(known)[first] + 1, len(points) - len(first))


def _array(source: Path, ending: str, variable: str | None) -> FloatArray:
    """Return the array of points of a file."""
    if ending == ".npy":
        require_plausible(source, _announced(source), source.stat().st_size, compressed=False)
        return _points(source, "the array", np.load(source, allow_pickle=False))
    arrays = dict(_npz(source) if ending == ".npz" else _mat(source))
    if variable is not None:
        if variable not in arrays:
            raise InputError(f"{source}: has no array {variable!r}; it has {', '.join(arrays) or 'none'}")
        return _points(source, variable, arrays[variable])
    axes = [arrays[name].ravel() for name in ("x", "y", "z") if name in arrays]
    if len(axes) > 1 and len({a.size for a in axes}) == 1 and all(max(arrays[n].shape) == arrays[n].size for n in ("x", "y")):
        return np.column_stack(axes).astype(float)
    fitting = [name for name, values in arrays.items() if _shaped(values)]
    if len(fitting) != 1:
        seen = ", ".join(f"{name} {values.shape}" for name, values in arrays.items()) or "no numeric array"
        several = (
            f"several that may be points ({', '.join(fitting)}): name one as `variable`" if fitting else "none of shape (n, 2) or (n, 3)"
        )
        raise InputError(f"{source}: has {seen[:300]}; {several}")
    return _points(source, fitting[0], arrays[fitting[0]])


def _shaped(values: AnyArray) -> bool:
    return values.ndim == 2 and values.shape[1] in (2, 3) and len(values) > 1 and values.dtype.kind in "fiu"


def _points(source: Path, name: str, values: AnyArray) -> FloatArray:
    if values.ndim == 2 and values.shape[0] in (2, 3) and values.shape[1] > 3:
        raise InputError(f"{source}: {name} has shape {values.shape}; points are rows of x, y, z: transpose it")
    if not _shaped(values):
        raise InputError(f"{source}: {name} has shape {values.shape} and type {values.dtype}; points are rows of two or three numbers")
    return np.asarray(values, dtype=float)


def _announced(source: Path) -> int:
    """Bytes of values that the header of an ``.npy`` file announces."""
    with source.open("rb") as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file)
    return int(np.prod(shape, dtype=float)) * dtype.itemsize


def _npz(source: Path) -> Iterator[tuple[str, AnyArray]]:
    with np.load(source, allow_pickle=False) as stored:
        for entry in stored.zip.infolist():
            require_plausible(source, entry.file_size, entry.compress_size, compressed=True)
        for name in stored.files:
            yield name, stored[name]


def _mat(source: Path) -> Iterator[tuple[str, AnyArray]]:
    """Numeric arrays of a MATLAB file, also those in cells and structures."""
    if h5py.is_hdf5(source):
        yield from _mat73(source)
        return
    from scipy.io import loadmat

    for name, values in loadmat(source).items():
        if not name.startswith("__"):
            yield from _numeric(name, values)


def _numeric(name: str, values: Any) -> Iterator[tuple[str, AnyArray]]:
    if not isinstance(values, np.ndarray):
        return
    if values.dtype.names is not None:
        for field in values.dtype.names:
            for k, entry in enumerate(values[field].ravel()):
                yield from _numeric(f"{name}.{field}" if values.size == 1 else f"{name}({k + 1}).{field}", entry)
    elif values.dtype == object:
        for k, entry in enumerate(values.ravel(order="F")):
            yield from _numeric(f"{name}{{{k + 1}}}", entry)
    elif values.dtype.kind in "fiu":
        yield name, values


def _mat73(source: Path) -> Iterator[tuple[str, AnyArray]]:
    """Numeric arrays of a MATLAB file of version 7.3, which is HDF5 with the axes reversed."""
    with h5py.File(source, "r") as root:
        for name, stored in root.items():
            if not isinstance(stored, h5py.Dataset) or name.startswith("#"):
                continue
            if stored.external or stored.is_virtual:
                raise InputError(f"{source}: {name} stands in another file; save it with its values")
            require_plausible(source, stored.nbytes, stored.id.get_storage_size(), compressed=stored.chunks is not None)
            if stored.dtype.kind in "fiu":
                yield name, np.asarray(stored[()]).T
            elif stored.dtype == h5py.ref_dtype:
                for k, reference in enumerate(np.asarray(stored[()]).T.ravel(order="F")):
                    entry = root[reference]
                    if isinstance(entry, h5py.Dataset) and entry.dtype.kind in "fiu":
                        require_plausible(source, entry.nbytes, entry.id.get_storage_size(), compressed=entry.chunks is not None)
                        yield f"{name}{{{k + 1}}}", np.asarray(entry[()]).T
