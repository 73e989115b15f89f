"""Wavefront surfaces (.obj): vertices and faces; everything else is ignored."""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.io.mesh_formats.assembly import fan_triangles, numbers


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
        A vertex or a face that cannot be read.
    """
    vertices: list[bytes] = []
    corners: list[int] = []
    counts: list[int] = []
    # A backslash at the end of a line continues it.
    for number, line in enumerate(data.replace(b"\\\n", b" ").splitlines(), start=1):
        words = line.split()
        if words[:1] == [b"v"] and len(words) >= 4:
            vertices += words[1:4]
        elif words[:1] == [b"v"]:
            raise InputError(f"{source}: line {number} is a vertex with fewer than three coordinates; the file is truncated or damaged")
        elif words[:1] == [b"f"]:
            corners += _corners(source, number, words[1:], len(vertices) // 3)
            counts.append(len(words) - 1)
    points = numbers(source, "a vertex", b" ".join(vertices)).reshape(-1, 3)
    return points, fan_triangles(np.array(corners, dtype=np.int64), np.array(counts, dtype=np.int64))


def _corners(source: str, number: int, words: list[bytes], known: int) -> list[int]:
    """Return the point indices of a face written as ``point/texture/normal``, counted from 1, or backwards from the last if negative."""
    try:
        written = [int(word.split(b"/")[0]) for word in words]
    except ValueError as error:
        raise InputError(f"{source}: line {number} is a face that cannot be read ({error}); write the file again") from error
    if 0 in written:
        raise InputError(f"{source}: line {number} refers to point 0, but points are numbered from 1; write the file again")
    return [index - 1 if index > 0 else known + index for index in written]
