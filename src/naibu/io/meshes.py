"""Read volume meshes and triangulated surfaces; the file name extension selects the format."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from naibu.core.arrays import LENGTHS_MM, FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.io.files.reading import guarded_reading, read_bytes
from naibu.io.mesh_formats import msh, obj, ply, stl, vrml, vtu

_Reader = TypeVar("_Reader")
_SurfaceArrays = tuple[FloatArray, IntArray]

MESH_READERS: dict[str, Callable[[str, bytes], Mesh]] = {".vtu": vtu.read, ".msh": msh.read}
SURFACE_READERS: dict[str, Callable[[str, bytes], _SurfaceArrays]] = {
    ".stl": stl.read,
    ".ply": ply.read,
    ".obj": obj.read,
    ".wrl": vrml.read,
    ".vrml": vrml.read,
}


class Surface(NamedTuple):
    """A triangulated surface.

    Attributes
    ----------
    points : ndarray, shape (n, 3)
        Positions, mm.
    triangles : ndarray, shape (t, 3), int64
    Point indices, counterclockwise seen from outside if the file follows that convention.
    """

    points: FloatArray
    triangles: IntArray


def read_mesh(path: str | os.PathLike[str], *, unit_mm: float = 1.0) -> Mesh:
    """Read a volume mesh.

    Parameters
    ----------
    path : path-like
        VTK unstructured grid (``.vtu``: ascii, base64 or appended; plain, zlib or lzma) or Gmsh mesh (``.msh``: 4.1 ascii or binary, 2.2
        ascii).
    unit_mm : float
        Length of the file's unit, mm: 1000 if the file is in metres.

    Returns
    -------
    Mesh
        Linear or quadratic tetrahedra, or hexahedra, in mm. Regions are the physical volumes (Gmsh), or the cell array ``region`` or one of
        its usual alternatives (VTK). Points that no volume cell uses, and cells of lower dimension, are dropped.

    Raises
    ------
    InputError
        No such file, an unsupported format, a damaged or truncated file, or cell types that naibu has no elements for.
    """
    reader = _reader(path, MESH_READERS, SURFACE_READERS, "read_surface")
    with guarded_reading(path):
        mesh = reader(Path(path).name, read_bytes(path))
    return Mesh(_in_mm(Path(path).name, mesh.points, unit_mm), mesh.cells, mesh.cell_type, mesh.regions, mesh.region_names)


def read_surface(path: str | os.PathLike[str], *, unit_mm: float = 1.0) -> Surface:
    """Read a triangulated surface.

    Parameters
    ----------
    path : path-like
        ``.stl`` (ascii or binary), ``.ply`` (ascii or binary), ``.obj`` or VRML 2.0 (``.wrl``, ``.vrml``).
    unit_mm : float
        Length of the file's unit, mm: 1000 if the file is in metres.

    Returns
    -------
    Surface
        Points (mm) and triangles; polygons are triangulated as fans.

    Raises
    ------
    InputError
        No such file, an unsupported format, or a damaged or truncated file.
    """
    reader = _reader(path, SURFACE_READERS, MESH_READERS, "read_mesh")
    name = Path(path).name
    with guarded_reading(path):
        points, triangles = reader(name, read_bytes(path))
    if len(triangles) == 0:
        raise InputError(f"{name}: contains no faces, only {len(points)} points; export the surface as triangles")
    if triangles.min() < 0 or triangles.max() >= len(points):
        bad = triangles.max() if triangles.max() >= len(points) else triangles.min()
        raise InputError(f"{name}: a face refers to point {bad}, but the file has points 0 to {len(points) - 1}; export it again")
    if not np.isfinite(points).all():
        bad = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
        raise InputError(f"{name}: point {bad} is {points[bad].tolist()}; every coordinate must be finite")
    return Surface(_in_mm(name, points, unit_mm), triangles)


def _reader(path: str | os.PathLike[str], readers: dict[str, _Reader], others: dict[str, object] | object, instead: str) -> _Reader:
    """Return the reader for the ending of the file name."""
    ending = Path(path).suffix.lower()
    if ending not in readers:
        hint = (
            f"use {instead}" if isinstance(others, dict) and ending in others else f"supported extensions are {', '.join(sorted(readers))}"
        )
        raise InputError(f"{Path(path).name}: the extension {ending!r} is not supported by this function; {hint}")
    return readers[ending]


def _in_mm(name: str, points: FloatArray, unit_mm: float) -> FloatArray:
    """Return points in mm, or raise an error where the unit is no length, or a point lies farther away than anything that is scanned."""
    if not LENGTHS_MM[0] <= unit_mm <= LENGTHS_MM[1]:
        raise InputError(f"unit_mm is {unit_mm!r}; give the length of the file's unit in mm, 1 for mm or 1000 for metres")
    farthest = float(np.abs(points).max(initial=0.0)) * unit_mm
    if farthest > LENGTHS_MM[1]:
        raise InputError(
            f"{name}: has a coordinate of {farthest:g} mm, more than {LENGTHS_MM[1]:g} mm; is unit_mm, {unit_mm:g} mm, that of the file?"
        )
    return points * float(unit_mm)
