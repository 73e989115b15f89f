"""MetaImage (``.mha``, ``.mhd``), the format of ITK, 3D Slicer and ParaView: scalar and vector images.

The format is specified in "MetaIO Documentation", https://docs.itk.org/en/latest/learn/metaio.html.
"""

from __future__ import annotations

import math
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from naibu.core.arrays import AnyArray, FloatArray
from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.io.files.atomic import write_atomically
from naibu.io.files.reading import file_beside, inflated, read_bytes, require_plausible
from naibu.io.image_formats.geometry import ReadOptions, no_colours, three_axes, unit_length, volume_with_axes

_TYPES = {
    "MET_CHAR": "i1",
    "MET_UCHAR": "u1",
    "MET_SHORT": "i2",
    "MET_USHORT": "u2",
    "MET_INT": "i4",
    "MET_UINT": "u4",
    # a "long" has 4 bytes in this format on every platform
    "MET_LONG": "i4",
    "MET_ULONG": "u4",
    "MET_LONG_LONG": "i8",
    "MET_ULONG_LONG": "u8",
    "MET_FLOAT": "f4",
    "MET_DOUBLE": "f8",
}
_NAMES = {code: name for name, code in _TYPES.items() if name not in ("MET_LONG", "MET_ULONG")}


def read(path: Path, options: ReadOptions) -> Volume:
    """Read a scalar volume (see `naibu.io.images.read_volume`)."""
    header, values = _parts(path)
    no_colours(path.name, _channels(path.name, header), "channels per voxel")
    return _with_geometry(path, header, values, options)


def read_vectors(path: Path, options: ReadOptions) -> tuple[FloatArray, Volume]:
    """Read vectors (nz, ny, nx, 3) and their grid, whose values are true where all components are finite."""
    header, values = _parts(path)
    if _channels(path.name, header) != 3 or values.ndim != 4:
        raise InputError(f"{path.name}: holds no vectors of three components, hence no displacement; give a file of displacements")
    vectors = np.asarray(values, dtype=float)
    grid = _with_geometry(path, header, np.isfinite(vectors).all(axis=3), options)
    return vectors, grid


def write(path: Path, values: AnyArray, grid: Volume, *, compressed: bool) -> Path:
    """Write intensities (nz, ny, nx), or vectors (nz, ny, nx, 3), on the grid of a volume."""
    stored = values.astype(np.uint8) if values.dtype == bool else values
    stored = stored.astype(np.float32) if stored.dtype == np.float16 else stored
    code = f"{stored.dtype.kind}{stored.dtype.itemsize}"
    if code not in _NAMES:
        raise InputError(f"{path.name}: MetaImage has no type for values of {values.dtype}; convert them first")
    data = np.ascontiguousarray(stored, dtype=stored.dtype.newbyteorder("<")).tobytes()
    data = zlib.compress(data, 1) if compressed else data
    header = {
        "ObjectType": "Image",
        "NDims": "3",
        "BinaryData": "True",
        "BinaryDataByteOrderMSB": "False",
        "CompressedData": str(compressed),
        **({"CompressedDataSize": str(len(data))} if compressed else {}),
        "TransformMatrix": _numbers(grid.direction.T.ravel()),
        "Offset": _numbers(grid.origin_mm),
        "CenterOfRotation": "0 0 0",
        "ElementSpacing": _numbers(grid.spacing_mm),
        "DimSize": " ".join(str(n) for n in values.shape[2::-1]),
        **({"ElementNumberOfChannels": str(values.shape[3])} if values.ndim == 4 else {}),
        "ElementType": _NAMES[code],
    }
    apart = path.suffix.lower() == ".mhd"
    beside = path.with_suffix(".zraw" if compressed else ".raw")
    text = "".join(f"{key} = {value}\n" for key, value in header.items())
    text += f"ElementDataFile = {beside.name if apart else 'LOCAL'}\n"
    if apart:
        write_atomically(beside, data)
        return write_atomically(path, text)
    return write_atomically(path, text.encode() + data)


def _numbers(values: FloatArray) -> str:
    return " ".join(repr(float(v)) for v in values)


def _parts(path: Path) -> tuple[dict[str, str], AnyArray]:
    """Return the header of a file and its values, (nz, ny, nx) or (nz, ny, nx, channels)."""
    raw = read_bytes(path)
    header, end = _header(path.name, raw)
    missing = [key for key in ("NDims", "DimSize", "ElementType", "ElementDataFile") if key not in header]
    if missing:
        raise InputError(f"{path.name}: is not a MetaImage file, or is damaged: its header lacks {', '.join(missing)}")
    kind = header["ElementType"].upper().removesuffix("_ARRAY")
    if kind not in _TYPES:
        raise InputError(f"{path.name}: its values are of type {header['ElementType']}; supported are {sorted(_TYPES)}")
    size = _whole_numbers(path.name, header, "DimSize", least=1)
    dimensions = _whole_numbers(path.name, header, "NDims", least=2)
    if dimensions != [len(size)]:
        raise InputError(
            f"{path.name}: NDims = {header['NDims']!r} but DimSize = {header['DimSize']!r}; one number per dimension is needed"
        )
    channels = _channels(path.name, header)
    shape = (*size[::-1], *((channels,) if channels > 1 else ()))
    return header, _values(path, header, raw[end:], np.dtype(_TYPES[kind]), shape)


def _header(source: str, raw: bytes) -> tuple[dict[str, str], int]:
    """Return the fields of the header and where it ends."""
    header: dict[str, str] = {}
    at = 0
    while at < len(raw) and "ElementDataFile" not in header:
        end = raw.find(b"\n", at)
        end = len(raw) if end < 0 else end
        try:
            key, found, value = raw[at:end].decode("utf-8").partition("=")
        except UnicodeDecodeError as error:
            raise InputError(f"{source}: is not a MetaImage file: its header is not text") from error
        if found:
            header[key.strip()] = value.strip()
        at = end + 1
    return header, at


def _values(path: Path, header: dict[str, str], rest: bytes, dtype: np.dtype[Any], shape: tuple[int, ...]) -> AnyArray:
    """Return the values that follow the header, or those of the data files that it names."""
    named = header["ElementDataFile"]
    if "%" in named:
        raise InputError(f"{path.name}: stores its slices in separate files {named!r}, which is not supported; save it as one .mha file")
    if named.split()[:1] == ["LIST"]:
        listed = [name.strip() for name in rest.decode("utf-8", "replace").splitlines() if name.strip()]
        data = b"".join(read_bytes(file_beside(path, name)) for name in listed)
    else:
        data = rest if named == "LOCAL" else read_bytes(file_beside(path, named))
    skip = _whole_numbers(path.name, header, "HeaderSize", least=-1)[0] if "HeaderSize" in header else 0
    n = math.prod(shape)
    packed, text = _true(header.get("CompressedData")), not _true(header.get("BinaryData", "True"))
    require_plausible(path.name, n if text else n * dtype.itemsize, len(data), compressed=packed)
    if packed:
        try:
            data = inflated(data, (32 if text else 1) * n * dtype.itemsize + max(skip, 0))
        except InputError as error:
            raise InputError(f"{path.name}: its {error}") from error
    if text:
        return _counted(path.name, np.array(data.split()[:n]).astype(dtype), n).reshape(shape)
    data = data[-n * dtype.itemsize :] if skip < 0 else data[skip:]
    msb = header.get("BinaryDataByteOrderMSB", header.get("ElementByteOrderMSB"))
    order = dtype.newbyteorder(">" if _true(msb) else "<")
    there = np.frombuffer(data, dtype=order, count=min(n, len(data) // order.itemsize))
    return _counted(path.name, there.astype(dtype), n).reshape(shape)


def _counted(source: str, values: AnyArray, n: int) -> AnyArray:
    if len(values) != n:
        raise InputError(f"{source}: contains {len(values)} of {n} values: the file is truncated; copy it again")
    return values


def _whole_numbers(source: str, header: dict[str, str], key: str, least: int) -> list[int]:
    """Return the whole numbers of a field of the header."""
    try:
        found = [int(word) for word in header[key].split()]
    except ValueError as error:
        raise InputError(f"{source}: {key} = {header[key][:60]!r} must be whole numbers; the header is damaged") from error
    if not found or min(found) < least:
        raise InputError(f"{source}: {key} = {header[key][:60]!r} must be whole numbers of at least {least}; the header is damaged")
    return found


def _channels(source: str, header: dict[str, str]) -> int:
    return _whole_numbers(source, header, "ElementNumberOfChannels", least=1)[0] if "ElementNumberOfChannels" in header else 1


def _numbers_in(source: str, key: str, text: str, count: int) -> FloatArray:
    """Return the numbers of a field of the header, of which there must be `count`."""
    try:
        found = np.array(text.split(), dtype=float)
    except ValueError as error:
        raise InputError(f"{source}: {key} = {text[:60]!r} must be numbers; the header is damaged") from error
    if found.shape != (count,) or not np.isfinite(found).all():
        raise InputError(f"{source}: {key} = {text[:60]!r} must be {count} finite numbers; the header is damaged")
    return found


def _true(text: str | None) -> bool:
    return text is not None and text.strip().lower() in ("true", "1", "t")


def _with_geometry(path: Path, header: dict[str, str], values: AnyArray, options: ReadOptions) -> Volume:
    n = int(header["NDims"])
    position = next((header[key] for key in ("Offset", "Origin", "Position") if key in header), None)
    orientation = next((header[key] for key in ("TransformMatrix", "Rotation", "Orientation") if key in header), None)
    length = header.get("ElementSpacing", header.get("ElementSize"))
    if length is None and options.spacing_mm is None:
        raise InputError(f"{path.name}: does not state its voxel spacing; give spacing_mm")
    name = path.name
    spacing = _numbers_in(name, "ElementSpacing", length, n) if length is not None else np.asarray(options.spacing_mm, dtype=float)[:n]
    origin = _numbers_in(name, "Offset", position, n) if position is not None else np.zeros(n)
    direction = _numbers_in(name, "TransformMatrix", orientation, n * n).reshape(n, n).T if orientation is not None else np.eye(n)
    if n == 2:
        spacing, origin = np.append(spacing, 1.0), np.append(origin, 0.0)
        direction = np.block([[direction, np.zeros((2, 1))], [np.zeros((1, 2)), np.ones((1, 1))]])
    values = three_axes(path.name, values)
    unit = options.unit_mm or (unit_length(path.name, header["DistanceUnits"]) if "DistanceUnits" in header else 1.0)
    return volume_with_axes(path.name, values, origin[:3], direction[:3, :3] * spacing[:3], unit)
