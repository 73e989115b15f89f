"""Polygon files (.ply) :cite:p:`turk1994`, ascii and binary of both byte orders."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.io.mesh_formats.assembly import fan_triangles, numbers

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
_WORDS = {"format": 2, "element": 3, "property": 3}  # of a line of the header, at least
_FACES = ("vertex_indices", "vertex_index")


class _Property(NamedTuple):
    """A column of an element; `length` is the type of a list's length, empty for one value."""

    name: str
    kind: str
    length: str


class _Element(NamedTuple):
    """A table of the file."""

    name: str
    rows: int
    properties: list[_Property]


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
        A header that cannot be read, or a truncated file.
    """
    order, elements, body = _header(source, data)
    points, triangles = np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    tokens = numbers(source, "the body", body) if order == "" else None
    at = 0
    try:
        for element in elements:
            columns, at = _text_rows(element, tokens, at) if tokens is not None else _binary_rows(element, body, at, order)
            if element.name == "vertex":
                points = np.stack([columns[axis] for axis in ("x", "y", "z")], axis=1).astype(np.float64)
            elif element.name == "face":
                name = next(name for name in _FACES if name in columns)
                triangles = fan_triangles(columns[name].astype(np.int64), columns[name + " count"].astype(np.int64))
    except (ValueError, IndexError) as error:
        raise InputError(f"{source}: is truncated inside its {element.name!r} data ({error}); write it again") from error
    except (KeyError, StopIteration) as error:
        raise InputError(f"{source}: element {element.name!r} lacks x, y, z or vertex_indices; export the surface again") from error
    return points, triangles


def _header(source: str, data: bytes) -> tuple[str, list[_Element], bytes]:
    """Return the byte order ("" for text), the tables announced, and what follows the header."""
    head, mark, body = data.partition(b"end_header")
    if not data.startswith(b"ply") or not mark:
        raise InputError(f"{source}: has no PLY header; it is not a PLY file, or is truncated")
    body = body[body.find(b"\n") + 1 :]
    order, elements = "?", list[_Element]()
    for line in head.decode("ascii", "replace").splitlines():
        words = line.split()
        if words[:1] and words[0] in _WORDS and len(words) < _WORDS[words[0]] + (words[1:2] == ["list"]) * 2:
            raise InputError(f"{source}: the line {line.strip()[:60]!r} of its header is truncated; write the file again")
        if words[:1] == ["format"]:
            order = _ORDERS.get(words[1], "?")
        elif words[:1] == ["element"]:
            elements.append(_Element(words[1], _rows(source, words[1], words[2], len(body)), []))
        elif words[:1] == ["property"]:
            if not elements:
                raise InputError(f"{source}: property {words[-1]!r} stands before any element; write the file again")
            kinds = words[2:4] if words[1] == "list" else words[1:2]
            if unknown := [kind for kind in kinds if kind not in _TYPES]:
                raise InputError(f"{source}: property {words[-1]!r} is of type {unknown[0]!r}; naibu reads {sorted(_TYPES)}")
            elements[-1].properties.append(_Property(words[-1], _TYPES[kinds[-1]], _TYPES[kinds[0]] if words[1] == "list" else ""))
    if order == "?":
        raise InputError(f"{source}: states no supported format; save it as one of {sorted(_ORDERS)}")
    return order, elements, body


def _rows(source: str, name: str, text: str, most: int) -> int:
    """Return the announced number of rows of an element, each of which takes at least a byte of the body."""
    if not text.isdecimal() or len(text) > 18 or int(text) > most:
        raise InputError(
            f"{source}: announces {text[:30]} rows of {name!r}, but {most} bytes follow the header; it is damaged or truncated"
        )
    return int(text)


def _binary_rows(element: _Element, body: bytes, at: int, order: str) -> tuple[dict[str, NDArray[np.generic]], int]:
    """Return the columns of a binary table that starts at byte `at`, and where it ends."""
    if element.rows == 0:
        return {name: np.zeros(0) for p in element.properties for name in (p.name, p.name + " count")}, at
    dtype = _row_type(element, body, at, order)
    if at + dtype.itemsize * element.rows > len(body):
        return _uneven_rows(element, body, at, order)
    table = np.frombuffer(body, dtype=dtype, count=element.rows, offset=at)
    lists = [p for p in element.properties if p.length]
    if all((table[p.name + " count"] == table[p.name].shape[1]).all() for p in lists):
        columns = {p.name: table[p.name].ravel() for p in element.properties}
        columns |= {p.name + " count": table[p.name + " count"] for p in lists}
        return columns, at + dtype.itemsize * element.rows
    return _uneven_rows(element, body, at, order)


def _row_type(element: _Element, body: bytes, at: int, order: str) -> np.dtype[np.void]:
    """Return the layout of the rows, if all have lists as long as those of the first."""
    fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
    for p in element.properties:
        if p.length:
            length = int(np.frombuffer(body, dtype=order + p.length, count=1, offset=at)[0])
            at += np.dtype(p.length).itemsize + length * np.dtype(p.kind).itemsize
            fields += [(p.name + " count", order + p.length), (p.name, order + p.kind, (length,))]
        else:
            at += np.dtype(p.kind).itemsize
            fields.append((p.name, order + p.kind))
    return np.dtype(fields)


def _uneven_rows(element: _Element, body: bytes, at: int, order: str) -> tuple[dict[str, NDArray[np.generic]], int]:
    """Return the columns of rows with lists of different lengths: each row can only be found from the one before."""
    parts: dict[str, list[NDArray[np.generic]]] = {name: [] for p in element.properties for name in (p.name, p.name + " count")}
    for _ in range(element.rows):
        for p in element.properties:
            length = 1
            if p.length:
                parts[p.name + " count"].append(np.frombuffer(body, dtype=order + p.length, count=1, offset=at))
                length = int(parts[p.name + " count"][-1][0])
                at += np.dtype(p.length).itemsize
            parts[p.name].append(np.frombuffer(body, dtype=order + p.kind, count=length, offset=at))
            at += length * np.dtype(p.kind).itemsize
    return {name: np.concatenate(values) for name, values in parts.items() if values}, at


def _text_rows(element: _Element, tokens: FloatArray, at: int) -> tuple[dict[str, NDArray[np.generic]], int]:
    """Return the columns of a text table that starts at token `at`, and where it ends."""
    if element.rows and (even := _even_rows(element, tokens, at)) is not None:
        return even
    parts: dict[str, list[NDArray[np.generic]]] = {n: [np.zeros(0)] for p in element.properties for n in (p.name, p.name + " count")}
    for _ in range(element.rows):
        for p in element.properties:
            length = int(tokens[at]) if p.length else 0
            if p.length:
                parts[p.name + " count"].append(tokens[at : at + 1])
                parts[p.name].append(tokens[at + 1 : at + 1 + length])
            at += 1 + length
    if at > len(tokens):
        raise ValueError(f"{at} numbers announced, {len(tokens)} found")
    return {name: np.concatenate(values) for name, values in parts.items()}, at


def _even_rows(element: _Element, tokens: FloatArray, at: int) -> tuple[dict[str, NDArray[np.generic]], int] | None:
    """Return the columns of a text table and where it ends, or None where its lists differ in length."""
    slices, width = dict[str, slice](), 0
    for p in element.properties:
        length = int(tokens[at + width]) if p.length else 1
        if p.length:
            slices[p.name + " count"] = slice(width, width + 1)
            width += 1
        slices[p.name] = slice(width, width + length)
        width += length
    stop = at + width * element.rows
    if stop > len(tokens):
        return None
    table = tokens[at:stop].reshape(element.rows, width)
    columns: dict[str, NDArray[np.generic]] = {name: table[:, part].ravel() for name, part in slices.items()}
    uneven = any((columns[p.name + " count"] != columns[p.name + " count"][0]).any() for p in element.properties if p.length)
    return None if uneven else (columns, stop)
