"""Image volumes in Zarr, chunked: for volumes larger than memory, and for several processes that read and write parts of one.

The store is a group with an array ``values`` (nz, ny, nx) and the attributes ``spacing_mm``, ``origin_mm`` (x, y, z) and ``direction``
(3 x 3, columns are the axes). Missing chunks are an error, unless the attribute
``every_chunk_is_stored`` is false or the fill value is NaN. Needs the package zarr (extra ``naibu[cluster]``).
"""

from __future__ import annotations

import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import AnyArray
from naibu.core.chunked_volume import ChunkedVolume
from naibu.core.errors import InputError
from naibu.core.optional_packages import optional_package
from naibu.core.volume import Volume
from naibu.io.files.paths import require_usable_path
from naibu.io.files.replaced_folder import replaced_folder
from naibu.io.image_formats import ome_zarr
from naibu.io.image_formats.geometry import ReadOptions, volume_with_axes

CHUNK = 64
ALL_CHUNKS = "every_chunk_is_stored"
_ATTRIBUTES = ("spacing_mm", "origin_mm", "direction")


def read(path: Path, options: ReadOptions) -> Volume:
    """Read a volume (see `naibu.io.images.read_volume`)."""
    stored = open_chunked(path, options)
    return _part(path, stored, np.zeros(3, dtype=int), np.array(stored.shape[::-1]))


def read_box(path: Path, low: ArrayLike, high: ArrayLike, options: ReadOptions) -> Volume:
    """Read the voxels with indices `low` <= index < `high` along x, y, z, without reading the other chunks.

    Raises
    ------
    InputError
        The box is not inside the volume, or the store contains no volume.
    """
    stored = open_chunked(path, options)
    a, b = np.asarray(low, dtype=int), np.asarray(high, dtype=int)
    size = np.array(stored.shape[::-1])
    if (a < 0).any() or (b > size).any() or (a >= b).any():
        raise InputError(f"{path.name}: cannot read {a.tolist()}..{b.tolist()}: the volume has {size.tolist()} voxels along x, y, z")
    return _part(path, stored, a, b)


def open_chunked(path: Path, options: ReadOptions | None = None) -> ChunkedVolume:
    """Open a volume without reading its voxels.

    Raises
    ------
    InputError
        No such store, one without a volume, or one with axes other than z, y, x.
    MissingDependencyError
        The package zarr is not installed.
    """
    zarr = _zarr()
    if not path.is_dir():
        raise InputError(f"{path}: there is no such Zarr store; a Zarr volume is a folder")
    try:
        group = zarr.open_group(str(path), mode="r")
        if "values" not in group and "multiscales" in group.attrs.get("ome", group.attrs):
            return ome_zarr.open_levels(path, options)  # whatever it is called
        stored = group["values"]
    except (KeyError, ValueError, OSError) as error:
        raise InputError(f"{path.name}: contains no volume: naibu expects a Zarr group with an array 'values' ({error})") from error
    missing = [name for name in _ATTRIBUTES if name not in group.attrs]
    if missing or not hasattr(stored, "chunks"):
        raise InputError(f"{path.name}: contains no volume: its group lacks the attributes {', '.join(missing) or 'of an array'}")
    if stored.ndim != 3:
        raise InputError(f"{path.name}: its values have {stored.ndim} axes {stored.shape}, not (z, y, x); save one time point or component")
    _require_all_chunks(path, group, stored)
    unit = (options.unit_mm if options else None) or 1.0
    origin, spacing = (unit * np.asarray(group.attrs[name], dtype=float) for name in ("origin_mm", "spacing_mm"))
    return ChunkedVolume.from_array(stored, spacing_mm=spacing, origin_mm=origin, direction=group.attrs["direction"])


def _require_all_chunks(path: Path, group: Any, stored: Any) -> None:
    """Refuse a store that lacks chunks, which would be read as its fill value, unless it says that these are meant.

    Raises
    ------
    InputError
        Chunks are missing; a fill value of NaN stands for unknown and is not refused.
    """
    meant = group.attrs.get(ALL_CHUNKS)
    if meant is False or (meant is None and stored.dtype.kind == "f" and np.isnan(stored.fill_value)):
        return
    edges = stored.shards or stored.chunks
    files = math.prod(-(-n // edge) for n, edge in zip(stored.shape, edges, strict=True))
    most = sum(file.is_file() for file in path.rglob("*"))
    there = most  # where even these are too few, looking for every chunk may take for ever
    if files <= most:
        there = stored.nchunks_initialized // math.prod(edge // inner for edge, inner in zip(edges, stored.chunks, strict=True))
    if there >= files:
        return
    lost = f"{files - there} of its {files} chunks are missing, or were not written yet"
    if meant:
        raise InputError(f"{path.name}: {lost}; copy the store again")
    raise InputError(
        f"{path.name}: {lost}, and would be read as {stored.fill_value}; copy the store again, or where they are meant to be "
        f"{stored.fill_value} set the attribute {ALL_CHUNKS} = false of its group"
    )


def create_chunked(
    path: Path, grid: Volume | ChunkedVolume, *, dtype: Any = np.float32, components: int | None = None, chunk: int = CHUNK
) -> Any:
    """Create an empty scalar or vector volume that can be written part by part; an existing one is removed.

    Parameters
    ----------
    path : Path
        Folder of the store, ``NAME.zarr``.
    grid : Volume or ChunkedVolume
        Grid of the voxels.
    dtype : dtype
        Type of the values.
    components : int, optional
        Number of components of a vector volume, shape (nz, ny, nx, components); by default a scalar volume.
    chunk : int
        Edge length of a chunk, voxels.

    Returns
    -------
    zarr.Array
        Array to be assigned to by slices, for example by `naibu.imaging.out_of_core.stored`.
    """
    zarr = _zarr()
    require_usable_path(path, written=True)
    try:
        if path.exists():
            shutil.rmtree(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        group = zarr.create_group(str(path))
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error}); choose a folder you may write to") from error
    frame = {"spacing_mm": grid.spacing_mm.tolist(), "origin_mm": grid.origin_mm.tolist(), "direction": grid.direction.tolist()}
    group.attrs.update({ALL_CHUNKS: True, **frame})
    shape = (*grid.shape, *(() if components is None else (components,)))
    chunks = (*(min(n, chunk) for n in grid.shape), *shape[3:])
    # every chunk becomes a file, so that a lost one is noticed and not taken for zeros
    return group.create_array("values", shape=shape, chunks=chunks, dtype=np.dtype(dtype), config={"write_empty_chunks": True})


def open_array(path: Path) -> Any:
    """Open the array of a volume from `create_chunked`, to be assigned to by slices."""
    # the configuration is not kept in the store: a chunk of zeros would not be written
    return _zarr().open_group(str(path), mode="r+")["values"].with_config({"write_empty_chunks": True})


def write(path: Path, values: AnyArray, grid: Volume, *, compressed: bool) -> Path:
    """Write intensities (nz, ny, nx), or vectors (nz, ny, nx, 3); chunks are always compressed (lossless).

    An existing store is replaced when the new one is complete.
    """
    _zarr()
    with replaced_folder(path) as folder:
        stored = create_chunked(folder, grid, dtype=values.dtype, components=values.shape[3] if values.ndim == 4 else None)
        stored[...] = values
    return path


def _part(path: Path, stored: ChunkedVolume, low: AnyArray, high: AnyArray) -> Volume:
    box = tuple(slice(int(a), int(b)) for a, b in zip(low[::-1], high[::-1], strict=True))
    axes = stored.direction * stored.spacing_mm
    return volume_with_axes(path.name, np.asarray(stored.values[box]), stored.origin_mm + axes @ low.astype(float), axes, 1.0)


def _zarr() -> Any:
    return optional_package("zarr", "reading and writing Zarr volumes", "naibu[cluster]")
