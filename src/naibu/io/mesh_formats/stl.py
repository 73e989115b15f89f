"""Stereolithography surfaces (.stl), ascii and binary."""

from __future__ import annotations

import re

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.io.mesh_formats.assembly import numbers

_HEADER = 84
_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read(source: str, data: bytes) -> tuple[FloatArray, IntArray]:
    """Read points (n, 3), in the file's unit, and triangles (t, 3); coincident corners become one point.

    Parameters
    ----------
    source : str
        Name of the file, for errors.
    data : bytes
        Its content.

    Raises
    ------
    InputError
        The file is truncated or contains no facet.
    """
    announced = int.from_bytes(data[80:_HEADER], "little") if len(data) >= _HEADER else -1
    # Binary files may also start with "solid"; only their length identifies them.
    if len(data) == _HEADER + announced * _FACET.itemsize:
        corners = np.frombuffer(data, dtype=_FACET, offset=_HEADER)["corners"].reshape(-1, 3).astype(np.float64)
    elif data.lstrip()[:5].lower() == b"solid" and b"facet" in data:
        corners = _ascii_corners(source, data)
    else:
        found = max(0, (len(data) - _HEADER) // _FACET.itemsize)
        raise InputError(
            f"{source}: announces {announced} facets but contains {found}; it is truncated, or not an STL file: export it again"
        )
    if len(corners) == 0:
        raise InputError(f"{source}: contains no facet; export the surface again")
    points, index = np.unique(corners, axis=0, return_inverse=True)
    return points, index.reshape(-1, 3).astype(np.int64)


def _ascii_corners(source: str, data: bytes) -> FloatArray:
    """Return the corners (3 t, 3) of an ascii file."""
    rows = re.findall(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", data)
    corners = numbers(source, "a vertex", b" ".join(token for row in rows for token in row)).reshape(-1, 3)
    if len(corners) % 3 or b"endsolid" not in data:
        raise InputError(f"{source}: ends after {len(corners)} vertices without 'endsolid'; it is truncated: write it again")
    return corners
