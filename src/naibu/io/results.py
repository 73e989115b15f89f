"""Results for ParaView and other programs: one step as .vtu, a series as one VTKHDF file.

Both formats are described in "VTK File Formats", https://docs.vtk.org/en/latest/vtk_file_formats/index.html.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.sax.saxutils import quoteattr

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.io.atomic import write_atomically

_VTK_TYPES = {"line": 3, "triangle": 5, "tetra": 10, "hexahedron": 12, "tetra10": 24}
_NAMES = {"i": "Int", "u": "UInt", "f": "Float"}


def write_vtu(
    path: str | os.PathLike[str],
    mesh: Mesh,
    point_data: Mapping[str, ArrayLike] | None = None,
    cell_data: Mapping[str, ArrayLike] | None = None,
) -> None:
    """Write a mesh and values on it as a VTK unstructured grid (appended raw data; opens in ParaView).

    The regions go along as cell array ``region`` and field data ``region_names``, so that `naibu.io.meshes.read_mesh` restores them.

    Parameters
    ----------
    path : path-like
        File to write, ``.vtu``; an old one is replaced only when the new one is complete.
    mesh : Mesh
        Mesh with n points and m cells, mm.
    point_data : mapping of str to array_like, shape (n,) or (n, d) or (n, d, d), optional
        Values at the points. State the unit in the name: ``"displacement_mm"``.
    cell_data : mapping of str to array_like, shape (m,) or (m, d) or (m, d, d), optional
        Values of the cells.

    Raises
    ------
    InputError
        Arrays whose length does not fit, that are not numbers, or a file that cannot be written.
    """
    points = {name: _in_space(mesh, _values(name, values, mesh.n_points, "points")) for name, values in (point_data or {}).items()}
    cells = {name: _values(name, values, mesh.n_cells, "cells") for name, values in (cell_data or {}).items()}
    cells.setdefault("region", mesh.regions)
    appended = _Appended()
    n, k = mesh.cells.shape
    topology = {
        "connectivity": mesh.cells.ravel(),
        "offsets": np.arange(k, n * k + 1, k, dtype=np.int64),
        "types": np.full(n, _VTK_TYPES[mesh.cell_type], dtype=np.uint8),
    }
    head = "\n".join(
        [
            '<?xml version="1.0"?>',
            '<VTKFile type="UnstructuredGrid" version="1.0" byte_order="LittleEndian" header_type="UInt64">',
            f"<UnstructuredGrid>{_names_field(mesh)}",
            f'<Piece NumberOfPoints="{mesh.n_points}" NumberOfCells="{n}">',
            f"<Points>{appended.element('Points', _in_space(mesh, mesh.points))}</Points>",
            appended.section("Cells", topology),
            appended.section("PointData", points),
            appended.section("CellData", cells),
            '</Piece></UnstructuredGrid>\n<AppendedData encoding="raw">\n_',
        ]
    )
    write_atomically(Path(path), b"".join([head.encode(), *appended.pieces, b"\n</AppendedData>\n</VTKFile>\n"]))


def write_vtkhdf_series(
    path: str | os.PathLike[str],
    mesh: Mesh,
    times: ArrayLike,
    point_data_steps: Mapping[str, Sequence[ArrayLike] | NDArray[np.generic]] | None = None,
    cell_data_steps: Mapping[str, Sequence[ArrayLike] | NDArray[np.generic]] | None = None,
) -> None:
    """Write values on a mesh that does not change, at several times, as one VTKHDF file (opens in ParaView 5.12 and later).

    Parameters
    ----------
    path : path-like
        File to write, ``.vtkhdf``; an old one is replaced only when the new one is complete.
    mesh : Mesh
        Mesh with n points and m cells, mm; stored once.
    times : array_like, shape (s,)
        Increasing times (s), or numbers of the states.
    point_data_steps : mapping of str to s arrays of shape (n,) or (n, d) or (n, d, d), optional
        Values at the points in every step: an array (s, n, ...) or a sequence of arrays.
    cell_data_steps : mapping of str to s arrays of shape (m,) or (m, d) or (m, d, d), optional
        Values of the cells in every step.

    Raises
    ------
    InputError
        Times that do not increase, a wrong number of steps or values, or a file that cannot be written.
    """
    steps = np.asarray(times, dtype=np.float64)
    if steps.ndim != 1 or len(steps) == 0 or not np.isfinite(steps).all() or (np.diff(steps) <= 0).any():
        raise InputError(f"times are {steps.tolist()}; give at least one, in one row, each greater than the one before")
    target = Path(path)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        handle, aside = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.", suffix=".part")
        os.close(handle)
    except OSError as error:
        raise InputError(f"{target}: cannot be written ({error.strerror or error}); choose a folder you may write to") from error
    try:
        with h5py.File(aside, "w") as file:
            root = file.create_group("VTKHDF")
            _write_static(root, mesh)
            group = _write_steps(root, steps)
            _write_series(root, group, "PointData", point_data_steps or {}, len(steps), mesh)
            _write_series(root, group, "CellData", cell_data_steps or {}, len(steps), mesh)
        # The temporary file is private; the result gets the rights of any new file.
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(aside, 0o666 & ~mask)
        os.replace(aside, target)
    except OSError as error:
        raise InputError(f"{target}: cannot be written ({error}); free some space or choose another folder") from error
    finally:
        Path(aside).unlink(missing_ok=True)


class _Appended:
    """Arrays that follow the XML one after the other, each led by its length in bytes."""

    def __init__(self) -> None:
        self.pieces: list[bytes] = []
        self.offset = 0

    def element(self, name: str, values: NDArray[np.generic]) -> str:
        """Append an array (n,) or (n, d) and return the XML element that points at it."""
        stored = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<"))
        kind = f"{_NAMES[stored.dtype.kind]}{8 * stored.dtype.itemsize}"
        # Left out for one component: meshio would read one column instead of a row.
        components = f' NumberOfComponents="{stored.shape[1]}"' if stored.ndim == 2 else ""
        self.pieces += [np.uint64(stored.nbytes).astype("<u8").tobytes(), stored.tobytes()]
        at, self.offset = self.offset, self.offset + 8 + stored.nbytes
        return f'<DataArray type="{kind}" Name={quoteattr(name)}{components} format="appended" offset="{at}"/>'

    def section(self, tag: str, arrays: Mapping[str, NDArray[np.generic]]) -> str:
        """Append several arrays and return the XML section that points at them."""
        return f"<{tag}>\n" + "\n".join(self.element(name, values) for name, values in arrays.items()) + f"\n</{tag}>"


def _names_field(mesh: Mesh) -> str:
    """Return the region names as field data: their UTF-8 codes, each name ended by a zero, because meshio refuses VTK's own strings."""
    codes = b"".join(name.encode() + b"\0" for name in mesh.region_names)
    head = f'<DataArray type="UInt8" Name="region_names" NumberOfTuples="{len(codes)}" format="ascii">'
    return f"<FieldData>\n{head}{' '.join(map(str, codes))}</DataArray>\n</FieldData>"


def _values(name: str, values: ArrayLike, n: int, what: str) -> NDArray[np.generic]:
    """Return values as (n,) or (n, d) numbers that VTK knows."""
    array = np.asarray(values)
    if array.ndim not in (1, 2, 3) or len(array) != n:
        raise InputError(f"{name!r} has shape {array.shape}, but the mesh has {n} {what}; give one row for each")
    if array.dtype == bool:
        array = array.astype(np.uint8)
    if array.dtype.kind not in "iuf":
        raise InputError(f"{name!r} is of type {array.dtype}; give real numbers")
    if array.dtype.kind == "f" and array.dtype.itemsize not in (4, 8):
        array = array.astype(np.float64)
    return array.reshape(n, -1) if array.ndim == 3 else array


def _in_space(mesh: Mesh, vectors: NDArray[np.generic]) -> NDArray[np.generic]:
    """Return vectors of a plane or a line with the components that VTK, which knows only space, wants besides."""
    missing = 3 - mesh.dimension
    if missing == 0 or vectors.ndim != 2 or vectors.shape[1] != mesh.dimension:
        return vectors
    return np.pad(vectors, ((0, 0), (0, missing)))


def _write_static(root: h5py.Group, mesh: Mesh) -> None:
    """Write the grid, which all steps share."""
    n, k = mesh.cells.shape
    root.attrs["Version"] = np.array([2, 0], dtype=np.int64)
    # VTK's reader wants a string of fixed length here, not h5py's default.
    root.attrs["Type"] = np.bytes_("UnstructuredGrid")
    root["NumberOfPoints"] = np.array([mesh.n_points], dtype=np.int64)
    root["NumberOfCells"] = np.array([n], dtype=np.int64)
    root["NumberOfConnectivityIds"] = np.array([n * k], dtype=np.int64)
    root["Points"] = _in_space(mesh, mesh.points)
    root["Connectivity"] = mesh.cells.ravel()
    root["Offsets"] = np.arange(0, n * k + 1, k, dtype=np.int64)
    root["Types"] = np.full(n, _VTK_TYPES[mesh.cell_type], dtype=np.uint8)
    root.create_group("PointData")
    root.create_group("CellData")["region"] = mesh.regions
    # An attribute, not field data: VTK 9.7's reader crashed on UTF-8 strings there.
    root.attrs["region_names"] = list(mesh.region_names)


def _write_steps(root: h5py.Group, times: NDArray[np.float64]) -> h5py.Group:
    """Write the times, and offsets that send every step to the one grid."""
    n = len(times)
    group = root.create_group("Steps")
    group.attrs["NSteps"] = np.int64(n)
    group["Values"] = times
    zeros = np.zeros(n, dtype=np.int64)
    group["NumberOfParts"] = zeros + 1
    for name in ("PartOffsets", "PointOffsets"):
        group[name] = zeros
    for name in ("CellOffsets", "ConnectivityIdOffsets"):
        group[name] = zeros[:, None]
    group.create_group("PointDataOffsets")
    group.create_group("CellDataOffsets")["region"] = zeros
    return group


def _write_series(
    root: h5py.Group, steps: h5py.Group, where: str, data: Mapping[str, Sequence[ArrayLike] | NDArray[np.generic]], n_steps: int, mesh: Mesh
) -> None:
    """Write the values of all steps of every array, one step below the other, and where each starts."""
    n = mesh.n_points if where == "PointData" else mesh.n_cells
    for name, values in data.items():
        if not name or "/" in name or (where == "CellData" and name == "region"):
            raise InputError(f"array name {name!r} cannot be used in a VTKHDF file; take another one without '/'")
        if len(values) != n_steps:
            raise InputError(f"{name!r} has {len(values)} steps, but there are {n_steps} times; give one array for each time")
        what = "points" if where == "PointData" else "cells"
        first = _in_space(mesh, _values(name, values[0], n, what))
        dataset = root[where].create_dataset(name, shape=(n_steps * n, *first.shape[1:]), dtype=first.dtype)
        for step in range(n_steps):
            own = _in_space(mesh, _values(name, values[step], n, what))
            if own.shape != first.shape:
                raise InputError(f"{name!r} has shape {own.shape} in step {step}, but {first.shape} in step 0; give the same shape in all")
            dataset[step * n : (step + 1) * n] = own
        steps[f"{where}Offsets"][name] = n * np.arange(n_steps, dtype=np.int64)
