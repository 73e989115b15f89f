"""Files of displacement fields with covariance: HDF5, beside vector images and tables of other programs.

An HDF5 file has the datasets ``vectors`` (mm), ``valid``, and ``covariance`` (mm^2) and ``quality`` where these are known. At points,
``points`` (n, d) hold their positions; on a grid, arrays are (nz, ny, nx, ...), and the root has the attributes ``spacing_mm``,
``origin_mm`` (x, y, z) and ``direction``. ``format``, ``frame`` and ``provenance`` (JSON) are attributes as well.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.io.files.atomic import new_aside, put_in_place
from naibu.io.files.hdf5_stream import Hdf5File
from naibu.io.files.reading import guarded_reading, require_plausible, require_regular
from naibu.io.images import read_displacement

FORMAT = "naibu displacement field 1"
FRAME = "LPS, mm; the material at x in the reference configuration is found at x + vector"
_COLUMNS = (("x_mm", "y_mm", "z_mm"), ("ux_mm", "uy_mm", "uz_mm"), ("sd_x_mm", "sd_y_mm", "sd_z_mm"))


def write_field(path: str | os.PathLike[str], field: DisplacementField, *, provenance: Mapping[str, Any] | None = None) -> Path:
    """Write a displacement field with its covariance as HDF5; the same field gives the same bytes.

    Parameters
    ----------
    path : path-like
        ``.h5``.
    field : DisplacementField
        At points or on a grid; that of a mesh is stored at its nodes.
    provenance : mapping, optional
        What the field came from; kept as JSON.

    Raises
    ------
    InputError
        Another ending, or a file that cannot be written.
    """
    target = Path(path)
    if target.suffix.lower() not in (".h5", ".hdf5"):
        raise InputError(f"{target.name}: displacement fields are written as .h5; for images of vectors use write_displacement")
    aside = new_aside(target)
    try:
        output = Hdf5File(aside)
        try:
            _store(output.file, field, json.dumps(dict(provenance or {}), sort_keys=True, ensure_ascii=False))
        finally:
            output.close()
        output.require_written()
        return put_in_place(aside, target)
    except OSError as error:
        raise InputError(f"{target}: cannot be written ({error}); free some space or choose another folder") from error
    finally:
        aside.unlink(missing_ok=True)


def _store(root: Any, field: DisplacementField, provenance: str) -> None:
    root.attrs["format"], root.attrs["frame"], root.attrs["provenance"] = FORMAT, FRAME, provenance
    arrays: dict[str, Any] = {"vectors": field.vectors, "valid": field.valid, "covariance": field.covariance, "quality": field.quality}
    if isinstance(field.support, Volume):
        grid = field.support
        root.attrs["spacing_mm"], root.attrs["origin_mm"], root.attrs["direction"] = grid.spacing_mm, grid.origin_mm, grid.direction
    else:
        arrays["points"] = field.points
    for name, values in arrays.items():
        if values is not None:
            root.create_dataset(name, data=values, compression="gzip", compression_opts=4, shuffle=True, track_times=False)


def read_field(path: str | os.PathLike[str]) -> DisplacementField:
    """Read a displacement field.

    Parameters
    ----------
    path : path-like
        ``.h5`` as `write_field` and ``naibu sense`` write it; an image of vectors (``.mha``, ``.mhd``, ``.nrrd``; no covariance); or a
        table (``.csv``) with the columns x_mm, y_mm, z_mm, ux_mm, uy_mm, uz_mm and, where they are known, sd_x_mm, sd_y_mm, sd_z_mm.

    Raises
    ------
    InputError
        A file that cannot be read, is damaged, or holds no field.
    """
    source = Path(path)
    ending = source.suffix.lower()
    with guarded_reading(path, "displacement field"):
        if ending in (".h5", ".hdf5"):
            return _stored(source)
        if ending == ".csv":
            return _table(source)
        vectors, grid = read_displacement(source)
        return DisplacementField.on_grid(grid, vectors)


def _stored(source: Path) -> DisplacementField:
    require_regular(source)
    with h5py.File(source, "r") as root:
        if root.attrs.get("format") != FORMAT:
            raise InputError(f"{source.name}: contains no displacement field: its attribute 'format' is not {FORMAT!r}")
        vectors = _array(source, root, "vectors")
        if vectors is None:
            raise InputError(f"{source.name}: the field has no vectors; write it again")
        valid, covariance, quality, points = (_array(source, root, name) for name in ("valid", "covariance", "quality", "points"))
        mask = None if valid is None else valid > 0.5
        if points is not None:
            if quality is not None and quality.shape != (len(points),):
                raise InputError(f"{source.name}: quality has shape {quality.shape} for {len(points)} points")
            at = DisplacementField.from_arrays(points, vectors, covariance=covariance, valid=mask)
            return DisplacementField(at.support, at.vectors, at.covariance, at.valid, quality)
        axes = (np.asarray(root.attrs[name], dtype=float) for name in ("spacing_mm", "origin_mm", "direction"))
        spacing, origin, direction = axes
        grid = Volume.from_array(np.zeros(vectors.shape[:3], dtype=bool), spacing_mm=spacing, origin_mm=origin, direction=direction)
        return DisplacementField.on_grid(grid, vectors, covariance=covariance, valid=mask, quality=quality)


def _array(source: Path, root: Any, name: str) -> FloatArray | None:
    """Return a dataset of the file itself; None where there is none."""
    if name not in root:
        return None
    link = root.get(name, getlink=True)
    stored = None if isinstance(link, h5py.ExternalLink) else root[name]
    if not isinstance(stored, h5py.Dataset) or stored.external or stored.is_virtual:
        raise InputError(f"{source.name}: {name} stands in another file; copy it into this one")
    require_plausible(source.name, stored.nbytes, stored.id.get_storage_size(), compressed=stored.chunks is not None)
    return np.asarray(stored[()], dtype=float)


def _table(source: Path) -> DisplacementField:
    require_regular(source)
    values = np.atleast_1d(np.genfromtxt(source, delimiter=",", names=True, deletechars="", dtype=float, encoding="utf-8"))
    names = values.dtype.names or ()
    missing = [name for part in _COLUMNS[:2] for name in part if name not in names]
    if missing or not len(values):
        needed = ", ".join((*_COLUMNS[0], *_COLUMNS[1]))
        raise InputError(f"{source.name}: a table of a field needs rows and the columns {needed}; it has {', '.join(names)}")
    points, vectors = (np.stack([values[name] for name in part], axis=1) for part in _COLUMNS[:2])
    known = all(name in names for name in _COLUMNS[2])
    sd = np.stack([values[name] for name in _COLUMNS[2]], axis=1) if known else None
    return DisplacementField.from_arrays(points, vectors, sd_mm=sd)
