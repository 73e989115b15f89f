"""Volumes and fields at several resolutions as OME-Zarr (version 0.4, :cite:p:`moore2023`), which napari and neuroglancer open.

Level 0 is the volume itself, each further level the mean of 2 x 2 x 2 voxels of the one before (unknown voxels, NaN, left out), until a
level fits into one chunk. Components of a field are channels. The format states spacing and position along its axes but no rotation: the
directions of the axes are kept in the attribute ``naibu``, where `naibu.io.open_volume` finds them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from naibu._version import __version__
from naibu.core.arrays import AnyArray, FloatArray
from naibu.core.chunked_volume import ChunkedVolume
from naibu.core.errors import InputError
from naibu.core.optional_packages import optional_package
from naibu.core.volume import Volume
from naibu.io.files.replaced_folder import replaced_folder
from naibu.io.image_formats.geometry import ReadOptions

ENDING = ".ome.zarr"
CHUNK = 64
VERSION = "0.4"
_COLOURS = ("FF0000", "00FF00", "0000FF", "00FFFF", "FF00FF", "FFFF00")
_BOX = 128  # voxels an edge that are read at once: a multiple of two chunks
_SAMPLED = 1_000_000  # values from which the shown range of intensities is taken


def write_levels(path: Path, values: Any, grid: Volume | ChunkedVolume, *, channels: Sequence[str] = ()) -> Path:
    """Write a volume at several resolutions, block by block; an existing store is replaced when the new one is complete.

    Parameters
    ----------
    path : Path
        Folder, ``NAME.ome.zarr``.
    values : array with ``shape``, ``dtype`` and slicing, shape (nz, ny, nx) or (nz, ny, nx, c)
        Intensities, or components; only what is written at a time is read.
    grid : Volume or ChunkedVolume
        Grid of the voxels.
    channels : sequence of str
        Names of the components.

    Raises
    ------
    InputError
        Another shape, or a folder that cannot be written.
    MissingDependencyError
        The package zarr is not installed.
    """
    zarr = optional_package("zarr", "writing OME-Zarr", "naibu[cluster]")
    shape = tuple(int(n) for n in values.shape)
    if shape[:3] != tuple(grid.shape) or len(shape) != (4 if channels else 3) or (channels and shape[3] != len(channels)):
        wanted = (*grid.shape, len(channels)) if channels else tuple(grid.shape)
        raise InputError(f"values must have shape {wanted} (z, y, x{', component' if channels else ''}), not {shape}")
    with replaced_folder(path) as folder:
        group = zarr.create_group(str(folder), zarr_format=2)
        shapes = _shapes(grid.shape)
        _fill(group, values, shapes, len(channels))
        group.attrs.update(_metadata(path.name.removesuffix(ENDING), grid, len(shapes), channels, _shown(values)))
    return path


def write(path: Path, values: AnyArray, grid: Volume, *, compressed: bool) -> Path:
    """Write a volume, or a displacement field (nz, ny, nx, 3); chunks are always compressed (lossless)."""
    return write_levels(path, values, grid, channels=("x", "y", "z") if values.ndim == 4 else ())


def open_levels(path: Path, options: ReadOptions | None = None) -> ChunkedVolume:
    """Open the finest level of a volume without reading its voxels.

    Raises
    ------
    InputError
        No such store, or one that is no volume with the axes z, y, x.
    MissingDependencyError
        The package zarr is not installed.
    """
    zarr = optional_package("zarr", "reading OME-Zarr", "naibu[cluster]")
    if not path.is_dir():
        raise InputError(f"{path}: there is no such Zarr store; an OME-Zarr volume is a folder")
    try:
        group = zarr.open_group(str(path), mode="r")
        told = group.attrs.get("ome", group.attrs)  # version 0.5 keeps all below "ome"
        image = told["multiscales"][0]
        axes = image["axes"]
        level = image["datasets"][0]
        stored = group[level["path"]]
        steps = [*image.get("coordinateTransformations", ()), *level["coordinateTransformations"]]
        kept = group.attrs.get("naibu", {})
    except (KeyError, ValueError, OSError, TypeError, IndexError) as error:
        raise InputError(
            f"{path.name}: is no OME-Zarr image ({type(error).__name__}: {error}); write it with naibu.io.write_volume"
        ) from error
    names = "".join(str(axis.get("name", "?")) for axis in axes)
    if names[-3:] != "zyx" or stored.ndim != len(names) or any(n != 1 for n in stored.shape[:-3]):
        size = " x ".join(str(n) for n in stored.shape)
        raise InputError(f"{path.name}: has the axes {names} of {size}, not zyx; save one time point and channel")
    unit = _unit(path, axes[-3:], options)
    scale, shift = np.ones(3), np.zeros(3)
    for step in steps:
        if step.get("type") == "scale":
            scale, shift = scale * step["scale"][-3:], shift * step["scale"][-3:]
        elif step.get("type") == "translation":
            shift = shift + step["translation"][-3:]
    direction = np.asarray(kept.get("direction", np.eye(3)), dtype=float)
    origin = np.asarray(kept["origin_mm"], dtype=float) if "origin_mm" in kept else unit * shift[::-1]
    values = stored if stored.ndim == 3 else _OneVolume(stored)
    return ChunkedVolume.from_array(values, spacing_mm=unit * scale[::-1], origin_mm=origin, direction=direction)


class _OneVolume:
    """The only time point and channel of an array (t, c, z, y, x), of which only what is sliced is read."""

    def __init__(self, stored: Any) -> None:
        self._stored, self._first = stored, (0,) * (stored.ndim - 3)
        self.shape, self.dtype = tuple(stored.shape[-3:]), stored.dtype

    def __getitem__(self, box: Any) -> AnyArray:
        """Return a part; indices are along z, y, x."""
        return np.asarray(self._stored[(*self._first, *(box if isinstance(box, tuple) else (box,)))])


def read(path: Path, options: ReadOptions) -> Volume:
    """Read the finest level (see `naibu.io.images.read_volume`)."""
    stored = open_levels(path, options)
    values = np.asarray(stored.values[:, :, :])
    return Volume.from_array(values, spacing_mm=stored.spacing_mm, origin_mm=stored.origin_mm, direction=stored.direction, missing=True)


_MM = {"millimeter": 1.0, "micrometer": 1e-3, "nanometer": 1e-6, "centimeter": 10.0, "meter": 1e3}


def _unit(path: Path, axes: Sequence[dict[str, Any]], options: ReadOptions | None) -> float:
    if options is not None and options.unit_mm is not None:
        return options.unit_mm
    units = {str(axis.get("unit", "")) for axis in axes}
    if len(units) != 1 or (units & set(_MM)) == set():
        raise InputError(
            f"{path.name}: states its lengths in {', '.join(sorted(units)) or 'nothing'}; give unit_mm, the unit's length in mm"
        )
    return _MM[units.pop()]


def _shapes(shape: tuple[int, int, int]) -> list[tuple[int, int, int]]:
    """Return the sizes of the levels."""
    shapes = [shape]
    while max(shapes[-1]) > CHUNK:
        nz, ny, nx = (-(-n // 2) for n in shapes[-1])
        shapes.append((nz, ny, nx))
    return shapes


def _fill(group: Any, values: Any, shapes: Sequence[tuple[int, int, int]], channels: int) -> None:
    """Write all levels, each from the one before; of the volume only boxes are in memory."""
    dtype = np.dtype(np.uint8) if np.dtype(values.dtype) == bool else np.dtype(values.dtype)
    before = None
    for k, shape in enumerate(shapes):
        whole = (channels, *shape) if channels else shape
        chunks = (*((1,) if channels else ()), *(min(n, CHUNK) for n in shape))
        level = group.create_array(str(k), shape=whole, chunks=chunks, dtype=dtype, chunk_key_encoding={"name": "v2", "separator": "/"})
        for box in _boxes(shape):
            if before is None:
                part = np.asarray(values[box])
                level[(..., *box)] = np.moveaxis(part, 3, 0) if channels else part
            else:
                wider = tuple(slice(2 * s.start, min(2 * s.stop, n)) for s, n in zip(box, shapes[k - 1], strict=True))
                level[(..., *box)] = halved(np.asarray(before[(..., *wider)])).astype(dtype)
        before = level


def _boxes(shape: tuple[int, int, int]) -> Iterator[tuple[slice, slice, slice]]:
    for z, y, x in product(*(range(0, n, _BOX) for n in shape)):
        yield slice(z, min(z + _BOX, shape[0])), slice(y, min(y + _BOX, shape[1])), slice(x, min(x + _BOX, shape[2]))


def halved(values: AnyArray) -> FloatArray:
    """Return means of 2 x 2 x 2 voxels over the last three axes, of fewer at odd ends; NaN only where all are; whole numbers rounded."""
    known = np.isfinite(values).astype(float)
    sums = np.where(known > 0.0, values, 0.0).astype(float)
    for axis in range(values.ndim - 3, values.ndim):
        sums, known = (np.add.reduceat(part, np.arange(0, part.shape[axis], 2), axis=axis) for part in (sums, known))
    means = np.divide(sums, known, out=np.full(sums.shape, np.nan), where=known > 0.0)
    return np.asarray(np.rint(means) if values.dtype.kind in "bui" else means)


def _shown(values: Any) -> tuple[float, float]:
    """Return the range of intensities that a viewer shows at first: without the darkest and brightest 0.5 % of a sample."""
    step = max(1, round((np.prod([float(n) for n in values.shape]) / _SAMPLED) ** (1.0 / 3.0)))
    planes = [np.asarray(values[k])[::step, ::step] for k in range(0, values.shape[0], step)]
    sample = np.concatenate([plane.ravel() for plane in planes]).astype(float)
    sample = sample[np.isfinite(sample)]
    if not sample.size:
        return 0.0, 1.0
    low, high = np.percentile(sample, [0.5, 99.5])
    return float(low), float(high if high > low else low + 1.0)


def _metadata(name: str, grid: Volume | ChunkedVolume, levels: int, channels: Sequence[str], shown: tuple[float, float]) -> dict[str, Any]:
    spacing, origin = np.asarray(grid.spacing_mm)[::-1], np.asarray(grid.origin_mm)[::-1]
    first = [1.0] if channels else []
    datasets = []
    for k in range(levels):
        # the centre of the first voxel of a coarser level lies between those that it is the mean of
        scale, shift = spacing * 2**k, origin + 0.5 * (2**k - 1) * spacing
        steps = [
            {"type": "scale", "scale": [*first, *scale.tolist()]},
            {"type": "translation", "translation": [*(0.0 for _ in first), *shift.tolist()]},
        ]
        datasets.append({"path": str(k), "coordinateTransformations": steps})
    axes = [{"name": axis, "type": "space", "unit": "millimeter"} for axis in "zyx"]
    lead = [{"name": "c", "type": "channel"}] if channels else []
    window = {"start": shown[0], "end": shown[1], "min": shown[0], "max": shown[1]}
    names = channels or (name,)
    colours = ["FFFFFF"] if len(names) == 1 else [_COLOURS[k % len(_COLOURS)] for k in range(len(names))]
    return {
        "multiscales": [
            {"version": VERSION, "name": name, "axes": [*lead, *axes], "datasets": datasets, "type": "mean of 2 x 2 x 2 voxels"}
        ],
        "omero": {
            "name": name,
            "channels": [
                {"label": label, "color": colour, "window": window, "active": k == 0}
                for k, (label, colour) in enumerate(zip(names, colours, strict=True))
            ],
        },
        "naibu": {
            "version": __version__,
            "origin_mm": np.asarray(grid.origin_mm).tolist(),
            "direction": np.asarray(grid.direction).tolist(),
        },
    }
