"""NRRD (``.nrrd``, ``.nhdr``), read and written with pynrrd: scalar and vector images.

The format is specified in "Definition of NRRD File Format", https://teem.sourceforge.net/nrrd/format.html.
"""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any

import numpy as np

from naibu.core.arrays import AnyArray, FloatArray
from naibu.core.errors import InputError
from naibu.core.optional_packages import optional_package
from naibu.core.volume import Volume
from naibu.io.files.atomic import write_atomically
from naibu.io.files.reading import file_beside, guarded_reading, inflated, read_bytes, require_plausible, require_regular
from naibu.io.image_formats.geometry import FLIP_RAS, ReadOptions, three_axes, unit_length, volume_with_axes

_TO_LPS = {
    **dict.fromkeys(("left-posterior-superior", "lps", "scanner-xyz", "3d-right-handed", ""), np.eye(3)),
    **dict.fromkeys(("right-anterior-superior", "ras"), FLIP_RAS),
    **dict.fromkeys(("left-anterior-superior", "las"), np.diag([1.0, -1.0, 1.0])),
}
_PACKED = {"gzip": "gzip", "gz": "gzip", "bzip2": "bz2", "bz2": "bz2"}
_COLOURS = ("rgb", "rgba", "hsv", "xyz-color")


def read(path: Path, options: ReadOptions) -> Volume:
    """Read a scalar volume (see `naibu.io.images.read_volume`)."""
    values, header = _loaded(path)
    spatial = _spatial_axes(path.name, header, values.ndim)
    if len(spatial) < values.ndim and any(values.shape[a] != 1 for a in range(values.ndim) if a not in spatial):
        raise InputError(
            f"{path.name}: has several samples per voxel or several time points (axes {list(values.shape)}, kinds {header.get('kinds')}); "
            "save one of them as a volume of its own"
        )
    keep = values.reshape([values.shape[a] for a in spatial])
    return _with_geometry(path, header, three_axes(path.name, keep.T), spatial, options)


def read_vectors(path: Path, options: ReadOptions) -> tuple[FloatArray, Volume]:
    """Read vectors (nz, ny, nx, 3) and their grid, whose values are true where all components are finite."""
    values, header = _loaded(path)
    spatial = _spatial_axes(path.name, header, values.ndim)
    if values.ndim != 4 or len(spatial) != 3 or values.shape[({0, 1, 2, 3} - set(spatial)).pop()] != 3:
        raise InputError(f"{path.name}: holds no vectors of three components, hence no displacement; give a file of displacements")
    vectors = np.asarray(np.moveaxis(values, spatial, (2, 1, 0)), dtype=float)
    grid = _with_geometry(path, header, np.isfinite(vectors).all(axis=3), spatial, options)
    to_lps = _TO_LPS[str(header.get("space", "")).lower()]
    return vectors @ to_lps.T, grid


def write(path: Path, values: AnyArray, grid: Volume, *, compressed: bool) -> Path:
    """Write intensities (nz, ny, nx), or vectors (nz, ny, nx, 3), on the grid of a volume."""
    nrrd = optional_package("nrrd", f"{path.name}: writing NRRD files", "pynrrd")
    if path.suffix.lower() != ".nrrd":
        raise InputError(f"{path.name}: NRRD is written as one file; give a name that ends in .nrrd")
    stored = values.astype(np.uint8) if values.dtype == bool else values
    steps = (grid.direction * grid.spacing_mm).T
    vectors = values.ndim == 4
    header = {
        "space": "left-posterior-superior",
        "space directions": np.vstack([np.full((1, 3), np.nan), steps]) if vectors else steps,
        "space origin": grid.origin_mm,
        "space units": ["mm", "mm", "mm"],
        "kinds": (["vector"] if vectors else []) + ["domain"] * 3,
        "encoding": "gzip" if compressed else "raw",
    }
    buffer = io.BytesIO()
    nrrd.write(buffer, np.ascontiguousarray(stored).T, header, compression_level=1)
    return write_atomically(path, buffer.getvalue())


def _loaded(path: Path) -> tuple[AnyArray, dict[str, Any]]:
    nrrd = optional_package("nrrd", f"{path.name}: reading NRRD files", "pynrrd")
    require_regular(path)
    with guarded_reading(path.name, "NRRD"), path.open("rb") as stream:
        header = dict(nrrd.read_header(stream))
        holder = _data_file(path, header)
        count = math.prod(int(n) for n in header["sizes"])
        method = _PACKED.get(str(header.get("encoding", "raw")).lower())
        # a value takes a byte at least, and eight at most
        require_plausible(path.name, count, holder.stat().st_size, compressed=method is not None)
        if method is None or header.get("line skip") or header.get("byte skip"):
            return np.asarray(nrrd.read_data(header, stream, str(path))), header
        content = inflated(stream.read() if holder == path else read_bytes(holder), 8 * count, method)
        plain = {key: value for key, value in header.items() if key not in ("data file", "datafile")} | {"encoding": "raw"}
        return np.asarray(nrrd.read_data(plain, io.BytesIO(content))), header


def _data_file(path: Path, header: dict[str, Any]) -> Path:
    """Return the file with the values: that of the header, or one beside it."""
    apart = header.get("data file", header.get("datafile"))
    if apart is None:
        return path
    if not isinstance(apart, str) or "%" in apart or apart.split()[:1] == ["LIST"]:
        raise InputError(f"{path.name}: stores its values in several files ({apart!r}), which is not supported; save it as one .nrrd")
    holder = file_beside(path, apart)
    require_regular(holder)
    return holder


def _spatial_axes(source: str, header: dict[str, Any], n: int) -> list[int]:
    """Return the spatial axes: those with a space direction, or, if the file has none, those of kind domain or space."""
    kinds = [str(kind).lower() for kind in header.get("kinds") or ["domain"] * n]
    if any(kind in _COLOURS or kind.endswith("-color") for kind in kinds):
        raise InputError(f"{source}: contains colours ({kinds}), not intensities; convert it to greyscale first")
    directions = header.get("space directions")
    if directions is not None:
        return [a for a, row in enumerate(directions) if row is not None and np.isfinite(np.asarray(row, dtype=float)).all()]
    return [a for a, kind in enumerate(kinds) if kind in ("domain", "space", "???", "none")]


def _with_geometry(path: Path, header: dict[str, Any], values: AnyArray, spatial: list[int], options: ReadOptions) -> Volume:
    n = len(spatial)
    space = str(header.get("space", "")).lower()
    if space not in _TO_LPS:
        raise InputError(
            f"{path.name}: is in the space {header['space']!r}; supported are left-posterior-superior, RAS and LAS: save it in one of these"
        )
    if header.get("space directions") is not None:
        axes = np.array([np.asarray(header["space directions"][a], dtype=float) for a in spatial]).T
    else:
        spacings = np.asarray(header.get("spacings", np.full(values.ndim, np.nan)), dtype=float)
        length = spacings[spatial] if spacings.shape[0] > max(spatial) else np.full(n, np.nan)
        if not np.isfinite(length).all():
            if options.spacing_mm is None:
                raise InputError(f"{path.name}: does not state its voxel spacing; give spacing_mm")
            length = np.asarray(options.spacing_mm, dtype=float)[:n]
        axes = np.diag(length)
    origin = np.asarray(header.get("space origin", np.zeros(n)), dtype=float)
    if n == 2 or len(axes) == 2:
        axes = np.block([[axes, np.zeros((2, 1))], [np.zeros((1, 2)), np.ones((1, 1))]])
        origin = np.append(origin[:2], 0.0)
    units = header.get("space units") or header.get("units")
    unit = options.unit_mm or (unit_length(path.name, str(units[-1])) if units is not None and str(units[-1]).strip('"') else 1.0)
    to_lps = _TO_LPS[space]
    return volume_with_axes(path.name, values, to_lps @ origin, to_lps @ axes, unit)
