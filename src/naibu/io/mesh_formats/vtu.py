"""VTK XML unstructured grids (.vtu): ascii, inline base64 and appended data, raw or compressed.

The format is specified in "VTK File Formats", https://docs.vtk.org/en/latest/vtk_file_formats/vtkxml_file_format.html.
"""

from __future__ import annotations

import base64
import binascii
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.io.files.reading import inflated, require_plausible
from naibu.io.mesh_formats.assembly import Block, numbers, volume_mesh

_DTYPES = {f"{kind}{bits}": f"{kind[0].lower()}{bits // 8}" for kind in ("Int", "UInt", "Float") for bits in (8, 16, 32, 64)}
_KINDS = {
    1: "vertex", 2: "poly_vertex", 3: "line", 4: "poly_line", 5: "triangle", 6: "triangle_strip", 7: "polygon", 8: "pixel", 9: "quad",
    10: "tetra", 11: "voxel", 12: "hexahedron", 13: "wedge", 14: "pyramid", 21: "line3", 22: "triangle6", 23: "quad8", 24: "tetra10",
    25: "hexahedron20", 26: "wedge15", 27: "pyramid13", 28: "quad9", 29: "hexahedron27", 34: "triangle7", 35: "line4", 42: "polyhedron",
}  # fmt: skip
_NODES = {10: 4, 11: 8, 12: 8, 24: 10}
_VOXEL_TO_HEXAHEDRON = [0, 1, 3, 2, 4, 5, 7, 6]
# Names under which meshing programs store the material of a cell, the most specific first.
_REGION_ARRAYS = ("region", "regions", "material", "MaterialIds", "gmsh:physical", "PhysicalIds", "medit:ref", "CellEntityIds")
_DECOMPRESSORS = {"vtkZLibDataCompressor": "zlib", "vtkLZMADataCompressor": "lzma"}


@dataclass(frozen=True, slots=True)
class _File:
    """A parsed file: how its binary data are stored, and where."""

    source: str
    root: Element
    appended: bytes
    appended_raw: bool
    order: str
    header: np.dtype[np.unsignedinteger]
    compression: str | None


def read(source: str, data: bytes) -> Mesh:
    """Read the volume cells of a .vtu file; lengths stay in the file's unit.

    Parameters
    ----------
    source : str
        Name of the file, for errors.
    data : bytes
        Its content.

    Raises
    ------
    InputError
        Not an unstructured grid, a truncated file, or cells that naibu has no elements for.
    """
    file = _opened(source, data)
    points, blocks, n = [], [], 0
    for piece in file.root.iter("Piece"):
        own = _array(file, piece.find("Points/DataArray"), "Points").reshape(-1, 3).astype(np.float64)
        blocks += _blocks(file, piece, n)
        points.append(own)
        n += len(own)
    if not points:
        raise InputError(f"{source}: contains no piece of an unstructured grid; write it again")
    return volume_mesh(source, np.concatenate(points), blocks, _names(file))


def read_point_arrays(source: str, data: bytes) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Return the points (n, 3) of a .vtu file in its unit, and its point data (n, components) by name.

    Parameters
    ----------
    source : str
        Name of the file, for errors.
    data : bytes
        Its content.

    Raises
    ------
    InputError
        Not an unstructured grid, a truncated file, or arrays that do not fit the points.
    """
    file = _opened(source, data)
    points: list[FloatArray] = []
    parts: dict[str, list[FloatArray]] = {}
    for piece in file.root.iter("Piece"):
        points.append(_array(file, piece.find("Points/DataArray"), "Points").reshape(-1, 3).astype(np.float64))
        for element in piece.iterfind("PointData/DataArray"):
            name, components = element.get("Name", ""), int(element.get("NumberOfComponents", "1"))
            values = _array(file, element, f"PointData/{name}")
            if components < 1 or values.size != components * len(points[-1]):
                raise InputError(f"{source}: PointData/{name} has {values.size} values for {len(points[-1])} points; write the file again")
            parts.setdefault(name, []).append(values.reshape(-1, components).astype(np.float64))
    if not points:
        raise InputError(f"{source}: contains no piece of an unstructured grid; write it again")
    whole = {name: values for name, values in parts.items() if len(values) == len(points)}
    return np.concatenate(points), {name: np.concatenate(values) for name, values in whole.items()}


def _opened(source: str, data: bytes) -> _File:
    """Split off the appended bytes, which are not XML, and parse the rest."""
    appended, raw = b"", False
    if match := re.search(rb"<AppendedData([^>]*)>\s*_", data):
        raw = b'"raw"' in match[1]
        end = data.rfind(b"</AppendedData>")
        if end < 0:
            raise InputError(f"{source}: is truncated inside its appended data; copy or write it again")
        appended, data = data[match.end() : end], data[: match.start()] + b"</VTKFile>"
    try:
        root = ElementTree.fromstring(data)
    except ElementTree.ParseError as error:
        raise InputError(f"{source}: is not complete XML ({error}); it is damaged or truncated: write it again") from error
    if root.tag != "VTKFile" or root.get("type") != "UnstructuredGrid":
        raise InputError(f"{source}: is a {root.get('type') or root.tag}, not a VTK UnstructuredGrid; save it as .vtu")
    order = ">" if root.get("byte_order") == "BigEndian" else "<"
    header = np.dtype(order + _DTYPES[root.get("header_type", "UInt32")])
    name = root.get("compressor", "")
    if name and name not in _DECOMPRESSORS:
        raise InputError(f"{source}: is compressed by {name}; naibu reads {sorted(_DECOMPRESSORS)}: save it with one of them or without")
    return _File(source, root, appended, raw, order, header, _DECOMPRESSORS.get(name))


def _blocks(file: _File, piece: Element, shift: int) -> list[Block]:
    """Return the cells of one piece, one block per type, with `shift` added to their point indices."""
    own = {element.get("Name"): element for element in piece.iterfind("Cells/DataArray")}
    connectivity, offsets, types = (
        _array(file, own.get(name), f"Cells/{name}").astype(np.int64) for name in ("connectivity", "offsets", "types")
    )
    starts = np.concatenate([[0], offsets])[: len(types)]
    tags = _tags(file, piece, len(types))
    if len(offsets) != len(types) or (len(offsets) and offsets[-1] > len(connectivity)):
        sizes = f"{len(types)} types and {len(connectivity)} indices"
        raise InputError(f"{file.source}: the cell offsets do not match the {sizes}; write the file again")
    blocks = []
    for code in np.unique(types).tolist():
        of_type = np.flatnonzero(types == code)
        kind = _KINDS.get(code, f"VTK type {code}")
        cells = np.zeros((len(of_type), 0), dtype=np.int64)
        if code in _NODES:
            cells = connectivity[starts[of_type][:, None] + np.arange(_NODES[code])] + shift
        if kind == "voxel":
            kind, cells = "hexahedron", cells[:, _VOXEL_TO_HEXAHEDRON]
        blocks.append(Block(kind, cells, tags[of_type]))
    return blocks


def _tags(file: _File, piece: Element, n: int) -> IntArray:
    """Return the region tag of every cell of a piece, zero where the file has none."""
    own = {element.get("Name"): element for element in piece.iterfind("CellData/DataArray")}
    name = next((name for name in _REGION_ARRAYS if name in own), None)
    if name is None:
        return np.zeros(n, dtype=np.int64)
    tags = _array(file, own[name], f"CellData/{name}")
    if len(tags) != n:
        raise InputError(f"{file.source}: CellData/{name} has {len(tags)} values for {n} cells; one per cell is needed")
    return tags.astype(np.int64)


def _names(file: _File) -> dict[int, str]:
    """Return the region names of the field data: zero-terminated character codes, as an array or as VTK strings."""
    for element in file.root.iterfind("UnstructuredGrid/FieldData/*"):
        if element.get("Name") == "region_names":
            codes = _bytes_of(file, element, np.dtype("u1"), "FieldData/region_names").tobytes()
            return {i: name.decode("utf-8", "replace") for i, name in enumerate(codes.split(b"\0")[:-1])}
    return {}


def _array(file: _File, element: Element | None, what: str) -> FloatArray | IntArray:
    """Return the values of one DataArray, flattened."""
    if element is None:
        raise InputError(f"{file.source}: has no array {what}; write it again")
    kind = element.get("type", "")
    if kind not in _DTYPES:
        raise InputError(f"{file.source}: array {what} is of type {kind!r}; naibu reads {sorted(_DTYPES)}")
    return _bytes_of(file, element, np.dtype(file.order + _DTYPES[kind]), what)


def _bytes_of(file: _File, element: Element, dtype: np.dtype[np.generic], what: str) -> FloatArray:
    """Return the values of an array in any of VTK's encodings."""
    form = element.get("format", "ascii")
    if form == "ascii":
        return numbers(file.source, f"array {what}", element.text or "").astype(dtype)
    if form == "appended":
        stored, raw = file.appended[int(element.get("offset", "0")) :], file.appended_raw
    else:
        stored, raw = "".join((element.text or "").split()).encode(), False
    try:
        content = _content(file, stored, raw)
        return np.frombuffer(content, dtype=dtype)
    except (ValueError, IndexError, binascii.Error) as error:
        raise InputError(f"{file.source}: array {what} is damaged or truncated ({error}); copy or write the file again") from error


def _content(file: _File, stored: bytes, raw: bool) -> bytes:
    """Return the decoded bytes of an array that starts at the beginning of `stored`."""
    if file.compression is None:
        size = int(_taken(file, stored, 1, raw)[0])
        return _after(file, stored, 1, size, raw)
    n_blocks = int(_taken(file, stored, 1, raw)[0])
    if n_blocks == 0:
        return b""
    if n_blocks > len(stored):
        raise ValueError(f"{n_blocks} blocks announced in {len(stored)} bytes")
    head = _taken(file, stored, 3 + n_blocks, raw).astype(np.int64)
    sizes, largest = head[3:], int(head[1])
    packed = _after(file, stored, 3 + n_blocks, int(sizes.sum()), raw)
    ends = np.cumsum(sizes)
    require_plausible(file.source, largest * n_blocks, len(packed), compressed=True)
    parts = (packed[end - size : end] for size, end in zip(sizes.tolist(), ends.tolist(), strict=True))
    return b"".join(inflated(part, largest, file.compression) for part in parts)


def _taken(file: _File, stored: bytes, count: int, raw: bool) -> NDArray[np.unsignedinteger]:
    """Return the first `count` header numbers."""
    size = count * file.header.itemsize
    head = stored[:size] if raw else base64.b64decode(stored[: _encoded(size)])
    return np.frombuffer(head[:size], dtype=file.header, count=count)


def _after(file: _File, stored: bytes, count: int, size: int, raw: bool) -> bytes:
    """Return the `size` bytes that follow a header of `count` numbers."""
    skip = count * file.header.itemsize
    if raw:
        content = stored[skip : skip + size]
    # Some writers encode header and data separately, which shows in the padding; others encode both together.
    elif b"=" in stored[: _encoded(skip)]:
        content = base64.b64decode(stored[_encoded(skip) : _encoded(skip) + _encoded(size)])[:size]
    else:
        content = base64.b64decode(stored[: _encoded(skip + size)])[skip : skip + size]
    if len(content) < size:
        raise ValueError(f"{size} bytes announced, {len(content)} found")
    return content


def _encoded(size: int) -> int:
    """Return the length of `size` bytes in base64."""
    return (size + 2) // 3 * 4
