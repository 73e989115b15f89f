"""Tables of points with displacements: text, Excel, Tecplot, and those of SPAM :cite:p:`stamati2020`, which are in voxels."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import InputError
from naibu.io.experiment_folder.reader import META_FILE
from naibu.io.field_formats import tecplot
from naibu.io.field_formats.spam_tiff import require_converged
from naibu.io.tables.point_tables import PointTable, assembled, columns_of, read_point_table
from naibu.io.tables.table_cells import unit_factor

FARTHEST_MM = 1e5  # of a point from the origin, as in tables of markers
_VOXEL = re.compile(r"\s*[\[(]\s*(?:voxels?|vox|vx|pixels?|px)\s*[\])]$", re.IGNORECASE)  # after the name of a column
NEEDED = "x_mm, y_mm, z_mm, ux_mm, uy_mm, uz_mm"


def read(source: Path, *, unit: str | None = None, spacing_mm: Sequence[float] | None = None) -> DisplacementField:
    """Return the field of a table.

    Parameters
    ----------
    source : Path
        ``.csv``, ``.tsv``, ``.txt``, ``.xlsx`` or ``.dat``.
    unit : str, optional
        Unit of lengths where the names of columns state none.
    spacing_mm : sequence of float, optional
        Size of a voxel along x, y, z, mm, where lengths are in voxels.

    Raises
    ------
    InputError
        A table without positions or displacements, or in voxels of unknown size.
    """
    table = _tecplot(source, unit) if source.suffix.lower() == ".dat" else read_point_table(source, unit=unit)
    if table.vectors is None:
        folder = f"; of an experiment with markers give the folder, {source.parent}" if (source.parent / META_FILE).exists() else ""
        raise InputError(f"{source.name}: has no columns of displacements; it needs {NEEDED}, or names like them{folder}")
    d = table.points.shape[1]
    if table.in_voxels and spacing_mm is None:
        whose = "" if source.suffix.lower() == ".dat" else "a table of SPAM, "
        raise InputError(f"{source.name}: is {whose}in voxels; give spacing_mm, the size of a voxel along x, y, z")
    scale = np.ones(d) if spacing_mm is None else np.asarray(spacing_mm, dtype=float)[:d]
    known = np.asarray(np.isfinite(table.points).all(axis=1))
    if not known.any():
        raise InputError(f"{source.name}: has no point whose coordinates are all known")
    points, vectors = table.points[known] * scale, table.vectors[known] * scale
    if (far := float(np.abs(points).max())) > FARTHEST_MM:
        raise InputError(f"{source.name}: a point lies {far:.3g} mm from the origin, {FARTHEST_MM:g} mm are possible; check the unit")
    valid = np.asarray(np.isfinite(vectors).all(axis=1) & (True if table.valid is None else table.valid[known]))
    if table.in_voxels and table.valid is not None and source.suffix.lower() != ".dat":
        require_converged(source, valid)
    return DisplacementField.from_arrays(points, vectors, sd_mm=_sd(source, table, known, scale, valid), valid=valid)


def _sd(source: Path, table: PointTable, known: BoolArray, scale: FloatArray, valid: BoolArray) -> FloatArray | None:
    if table.sd is None:
        return None
    sd = table.sd[known] * scale
    wrong = valid & ~(sd >= 0.0).all(axis=1)
    if wrong.any():
        row = int(np.flatnonzero(known)[np.flatnonzero(wrong)[0]]) + 1
        raise InputError(f"{source.name}: row {row} of the points has standard deviations {sd[wrong][0].tolist()}; they must be 0 or more")
    return np.where(valid[:, None], sd, 0.0)


def _tecplot(source: Path, unit: str | None) -> PointTable:
    """Return the points of a Tecplot text, whose names may say that lengths are in voxels; coordinate 0 is then the middle of voxel 0."""
    as_named, values = tecplot.read_columns(source)
    names = [_VOXEL.sub("", name) for name in as_named]
    where = columns_of(names, source.name)
    if len(where["points"]) not in (2, 3):
        raise InputError(f"{source.name}: cannot recognise x, y and z among its variables {', '.join(as_named)[:200]}")
    lengths = {as_named[at]: names[at] != as_named[at] for some in where.values() for at in some}
    if any(lengths.values()) and not all(lengths.values()):
        other = ", ".join(repr(name) for name, in_voxels in lengths.items() if not in_voxels)
        raise InputError(f"{source.name}: some variables are in voxels, and {other} not; export all lengths in one unit")
    if any(lengths.values()) and unit is not None:
        raise InputError(f"{source.name}: its variables are in voxels, but unit = {unit!r}; give spacing_mm, the size of a voxel, instead")

    def column(at: int, unit: str | None) -> FloatArray:
        return np.asarray(values[:, at] * unit_factor(source, names[at], unit))

    table = assembled(source, names, where, column, unit)
    return replace(table, in_voxels=table.in_voxels or any(lengths.values()))
