"""VRML 2.0 surfaces (.wrl): the IndexedFaceSet nodes of a scene, merged.

The format is specified in ISO/IEC 14772-1:1997, "The Virtual Reality Modeling Language".
"""

from __future__ import annotations

import re

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.io.mesh_formats.assembly import fan_triangles, numbers

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
# Fields of a Transform and their identity values.
_IDENTITY = {"translation": [0.0, 0.0, 0.0], "scale": [1.0, 1.0, 1.0], "rotation": None}


def read(source: str, data: bytes) -> tuple[FloatArray, IntArray]:
    """Read points (n, 3), in the file's unit, and triangles (t, 3); polygons are triangulated as fans.

    Parameters
    ----------
    source : str
        Name of the file, for errors.
    data : bytes
        Its content.

    Raises
    ------
    InputError
        Another version, a scene that transforms its shapes, or one without an IndexedFaceSet.
    """
    text = data.decode("utf-8", "replace")
    if not text.startswith("#VRML V2.0"):
        raise InputError(f"{source}: starts with {text[:14]!r}, not '#VRML V2.0'; export the surface as VRML 2.0 (VRML97) or STL")
    # Commas are white space in VRML, and '#' starts a comment.
    text = re.sub(r"#[^\n]*", "", text).replace(",", " ")
    _refuse_moved(source, text)
    points, triangles, n = [np.zeros((0, 3))], [np.zeros((0, 3), dtype=np.int64)], 0
    for start in (match.start() for match in re.finditer(r"\bIndexedFaceSet\b", text)):
        own, faces = _face_set(source, text, start)
        points.append(own)
        triangles.append(faces + n)
        n += len(own)
    if n == 0:
        raise InputError(f"{source}: contains no IndexedFaceSet; export the surface as triangles")
    return np.concatenate(points), np.concatenate(triangles)


def _face_set(source: str, text: str, start: int) -> tuple[FloatArray, IntArray]:
    """Return points and triangles of the IndexedFaceSet that starts at a character."""
    end = text.find("IndexedFaceSet", start + 1)
    own = text[start : end if end > 0 else len(text)]
    # The word boundary keeps texCoordIndex, colorIndex and normalIndex out.
    point = re.search(r"\bpoint\s*\[([^\]]*)\]", own)
    index = re.search(r"\bcoordIndex\s*\[([^\]]*)\]", own)
    if point is None or index is None:
        raise InputError(f"{source}: an IndexedFaceSet has no points or no coordIndex (shared by USE, or truncated); export it again")
    flat = numbers(source, "coordIndex", index[1]).astype(np.int64)
    coordinates = numbers(source, "point", point[1])
    if len(coordinates) % 3:
        raise InputError(f"{source}: {len(coordinates)} coordinates are not whole points of three; the file is damaged")
    ends = np.flatnonzero(np.append(flat, -1) == -1)
    counts = np.diff(np.concatenate([[-1], ends])) - 1
    triangles = fan_triangles(flat[flat != -1], counts)
    # "ccw FALSE" says that the faces are listed clockwise seen from outside.
    clockwise = re.search(r"\bccw\s+FALSE\b", own) is not None
    return coordinates.reshape(-1, 3), triangles[:, ::-1] if clockwise else triangles


def _refuse_moved(source: str, text: str) -> None:
    """Raise an error if a Transform translates, rotates or scales shapes: ignoring it would misplace the surface."""
    for match in re.finditer(rf"\b(translation|scale|rotation)((?:\s+{_NUMBER}){{3,4}})", text):
        values = [float(word) for word in match[2].split()]
        still = values[3:4] == [0.0] if match[1] == "rotation" else values[:3] == _IDENTITY[match[1]]
        if not still:
            raise InputError(f"{source}: a Transform has {match[1]} {values}; bake it into the points (apply transforms) and export again")
