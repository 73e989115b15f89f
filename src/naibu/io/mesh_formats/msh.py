"""Gmsh meshes (.msh) :cite:p:`geuzaine2009`: version 4.1, ascii and binary, and version 2.2, ascii.

The format is specified in the Gmsh reference manual, https://gmsh.info/doc/texinfo/gmsh.html#MSH-file-format.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.io.mesh_formats.assembly import Block, numbers, volume_mesh

_KINDS = {
    1: ("line", 2), 2: ("triangle", 3), 3: ("quad", 4), 4: ("tetra", 4), 5: ("hexahedron", 8), 6: ("wedge", 6), 7: ("pyramid", 5),
    8: ("line3", 3), 9: ("triangle6", 6), 10: ("quad9", 9), 11: ("tetra10", 10), 12: ("hexahedron27", 27), 13: ("wedge18", 18),
    14: ("pyramid14", 14), 15: ("vertex", 1), 16: ("quad8", 8), 17: ("hexahedron20", 20), 18: ("wedge15", 15), 19: ("pyramid13", 13),
}  # fmt: skip
# Gmsh numbers the last two mid-edge nodes of a quadratic tetrahedron the other way round than VTK.
_TETRA10_TO_VTK = [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]


@dataclass(slots=True)
class _Stream:
    """Sequential reader of the numbers of one section, text or binary.

    `position` counts tokens (text) or bytes (binary).
    """

    source: str
    section: str
    tokens: FloatArray | None
    data: bytes
    order: str
    position: int = 0

    def taken(self, code: str, count: int) -> NDArray[np.generic]:
        """Return the next `count` numbers of the numpy type `code` ("i4", "u8" or "f8")."""
        if self.tokens is not None:
            values = self.tokens[self.position : self.position + count]
            self.position += count
        else:
            width = int(code[1])
            values = np.frombuffer(self.data[self.position : self.position + count * width], dtype=self.order + code)
            self.position += count * width
        if len(values) < count:
            raise InputError(f"{self.source}: section ${self.section} is truncated; write the file again")
        return values

    def ints(self, count: int) -> IntArray:
        """Return the next `count` ints (4 bytes in binary)."""
        return self.taken("i4", count).astype(np.int64)

    def sizes(self, count: int) -> IntArray:
        """Return the next `count` sizes (8 bytes in binary)."""
        return self.taken("u8", count).astype(np.int64)

    def floats(self, count: int) -> FloatArray:
        """Return the next `count` doubles."""
        return self.taken("f8", count).astype(np.float64)


def read(source: str, data: bytes) -> Mesh:
    """Read the volume cells of a Gmsh file; physical volumes become regions, lengths stay in the file's unit.

    Parameters
    ----------
    source : str
        Name of the file, for errors.
    data : bytes
        Its content.

    Raises
    ------
    InputError
        Another version, a missing or truncated section, or cells that naibu has no elements for.
    """
    head = re.match(rb"\s*(?:\$Comments.*?\$EndComments\s*)?\$MeshFormat\s+(\S+)\s+(\d)\s+(\d+)[ \t]*\r?\n", data, re.DOTALL)
    if head is None:
        raise InputError(f"{source}: does not start with $MeshFormat; it is not a Gmsh .msh file")
    version, binary = head[1].decode("ascii", "replace"), head[2] == b"1"
    if version == "2.2" and not binary:
        return _read_2(source, data)
    if version != "4.1":
        form = f"version {version}, {'binary' if binary else 'ascii'}"
        raise InputError(f"{source}: is a Gmsh mesh of {form}; naibu reads 4.1 and ascii 2.2: save it with Mesh.MshFileVersion=4.1")
    order = ">" if binary and data[head.end() : head.end() + 4] == b"\0\0\0\1" else "<"
    return _read_41(source, data, binary, order)


def _read_41(source: str, data: bytes, binary: bool, order: str) -> Mesh:
    """Read version 4.1."""
    physical = _physical_of_volumes(_section(source, data, "Entities", binary, order)) if b"$Entities" in data else {}
    tags, points = _nodes_41(_section(source, data, "Nodes", binary, order))
    blocks = []
    elements = _section(source, data, "Elements", binary, order)
    for _ in range(int(elements.sizes(4)[0])):
        dimension, entity, code = elements.ints(3).tolist()
        count = int(elements.sizes(1)[0])
        kind, width = _kind(source, code)
        rows = elements.sizes(count * (width + 1)).reshape(count, width + 1)
        tag = physical.get(entity, -entity) if dimension == 3 else 0
        blocks.append(_block(kind, _indices(source, tags, rows[:, 1:]), np.full(count, tag, dtype=np.int64)))
    return volume_mesh(source, points, blocks, _physical_names(source, data))


def _section(source: str, data: bytes, name: str, binary: bool, order: str) -> _Stream:
    """Return the numbers of a section."""
    start = re.search(rb"(?:^|\n)\$" + name.encode() + rb"[ \t]*\r?\n", data)
    end = data.find(b"$End" + name.encode())
    if start is None or end < 0:
        what = "has no" if start is None else "is truncated inside"
        raise InputError(f"{source}: {what} section ${name}; write the file again")
    content = data[start.end() : end]
    if binary:
        return _Stream(source, name, None, content, order)
    return _Stream(source, name, numbers(source, f"section ${name}", content), b"", order)


def _physical_of_volumes(stream: _Stream) -> dict[int, int]:
    """Return the first physical tag of every volume entity that has one."""
    counts = stream.sizes(4).tolist()
    physical: dict[int, int] = {}
    for dimension, count in enumerate(counts):
        for _ in range(count):
            tag = int(stream.ints(1)[0])
            stream.floats(3 if dimension == 0 else 6)
            tags = stream.ints(int(stream.sizes(1)[0]))
            if dimension > 0:
                stream.ints(int(stream.sizes(1)[0]))
            if dimension == 3 and len(tags):
                # A negative tag only says that the group turns the volume round.
                physical[tag] = abs(int(tags[0]))
    return physical


def _nodes_41(stream: _Stream) -> tuple[IntArray, FloatArray]:
    """Return the tags (n,) and positions (n, 3) of the nodes."""
    tags, points = [np.zeros(0, dtype=np.int64)], [np.zeros((0, 3))]
    for _ in range(int(stream.sizes(4)[0])):
        dimension, _entity, parametric = stream.ints(3).tolist()
        count = int(stream.sizes(1)[0])
        tags.append(stream.sizes(count))
        width = 3 + (dimension if parametric else 0)
        points.append(stream.floats(count * width).reshape(count, width)[:, :3])
    return np.concatenate(tags), np.concatenate(points)


def _read_2(source: str, data: bytes) -> Mesh:
    """Read version 2.2 in ascii."""
    nodes = _section(source, data, "Nodes", False, "<")
    table = nodes.floats(4 * int(nodes.ints(1)[0])).reshape(-1, 4)
    elements = _section(source, data, "Elements", False, "<")
    assert elements.tokens is not None
    flat = elements.tokens.astype(np.int64)
    starts = _element_starts(source, flat)
    codes, n_tags = flat[starts + 1], flat[starts + 2]
    blocks = []
    for code, count in np.unique(np.stack([codes, n_tags], axis=1), axis=0).tolist():
        kind, width = _kind(source, code)
        rows = starts[(codes == code) & (n_tags == count)]
        indices = rows[:, None] + 3 + count + np.arange(width)
        if indices.max() >= len(flat):
            raise InputError(f"{source}: section $Elements is truncated; write the file again")
        cell_tags = flat[rows + 3] if count else np.zeros(len(rows), dtype=np.int64)
        if count > 1:
            # The first tag is the physical group, 0 for none; the second the volume itself.
            cell_tags = np.where(cell_tags == 0, -flat[rows + 4], np.abs(cell_tags))
        blocks.append(_block(kind, _indices(source, table[:, 0].astype(np.int64), flat[indices]), cell_tags))
    return volume_mesh(source, table[:, 1:], blocks, _physical_names(source, data))


def _element_starts(source: str, flat: IntArray) -> IntArray:
    """Return where every element starts: rows differ in length, so each can only be found from the one before."""
    tokens = flat.tolist()
    starts, at = [], 1
    try:
        for _ in range(tokens[0]):
            starts.append(at)
            at += 3 + tokens[at + 2] + _kind(source, tokens[at + 1])[1]
    except IndexError as error:
        raise InputError(f"{source}: section $Elements is truncated after {len(starts)} elements; write the file again") from error
    return np.array(starts, dtype=np.int64)


def _kind(source: str, code: int) -> tuple[str, int]:
    """Return the name and the number of nodes of a Gmsh element type."""
    if code not in _KINDS:
        raise InputError(f"{source}: holds elements of unknown Gmsh type {code}; mesh it with tetrahedra of order 1 or 2, or hexahedra")
    return _KINDS[code]


def _block(kind: str, cells: IntArray, tags: IntArray) -> Block:
    """Return a block of cells in VTK order."""
    return Block(kind, cells[:, _TETRA10_TO_VTK] if kind == "tetra10" else cells, tags)


def _indices(source: str, tags: IntArray, named: IntArray) -> IntArray:
    """Return the row of every named node tag."""
    order = np.argsort(tags, kind="stable")
    at = np.searchsorted(tags, named, sorter=order).clip(max=len(tags) - 1)
    rows: IntArray = order[at] if len(tags) else at
    if len(tags) == 0 or (tags[rows] != named).any():
        missing = named[tags[rows] != named] if len(tags) else named.ravel()
        raise InputError(f"{source}: elements refer to node {int(missing[0])}, which section $Nodes does not have; write the file again")
    return rows


def _physical_names(source: str, data: bytes) -> dict[int, str]:
    """Return the names of the physical volumes."""
    match = re.search(rb"\$PhysicalNames\s+\d+\s*\n(.*?)\$EndPhysicalNames", data, re.DOTALL)
    if match is None:
        return {}
    rows = re.findall(r'(\d+)\s+(\d+)\s+"([^"]*)"', match[1].decode("utf-8", "replace"))
    return {int(tag): name for dimension, tag, name in rows if dimension == "3"}
