"""VTK result files for ParaView and other programs: one time step as .vtu, a time series as one VTKHDF file.

Both formats are specified in "VTK File Formats", https://docs.vtk.org/en/latest/vtk_file_formats/index.html.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import ArrayLike, NDArray

from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.io.files.atomic import write_atomically
from naibu.io.vtkhdf_series import VTK_TYPES, SeriesFile, in_space, numbers

_NAMES = {"i": "Int", "u": "UInt", "f": "Float"}


def write_vtu(
    path: str | os.PathLike[str],
    mesh: Mesh,
    point_data: Mapping[str, ArrayLike] | None = None,
    cell_data: Mapping[str, ArrayLike] | None = None,
) -> None:
    """Write a mesh with point and cell data as a VTK unstructured grid (``.vtu``, appended raw data).

    The regions are stored as cell array ``region`` and field data ``region_names``, from which `naibu.io.meshes.read_mesh` restores them.

    Parameters
    ----------
    path : path-like
        File to write, ``.vtu``; an existing one is replaced only when the new one is complete.
    mesh : Mesh
        Mesh with n points and m cells, mm.
    point_data : mapping of str to array_like, shape (n,) or (n, d) or (n, d, d), optional
        Values at the points. State the unit in the name: ``"displacement_mm"``.
    cell_data : mapping of str to array_like, shape (m,) or (m, d) or (m, d, d), optional
        Values of the cells.

    Raises
    ------
    InputError
        Arrays of the wrong length or not of real numbers, or a file that cannot be written.
    """
    points = {name: in_space(mesh, numbers(name, values, mesh.n_points, "points")) for name, values in (point_data or {}).items()}
    cells = {name: numbers(name, values, mesh.n_cells, "cells") for name, values in (cell_data or {}).items()}
    cells.setdefault("region", mesh.regions)
    appended = _Appended()
    n, k = mesh.cells.shape
    topology = {
        "connectivity": mesh.cells.ravel(),
        "offsets": np.arange(k, n * k + 1, k, dtype=np.int64),
        "types": np.full(n, VTK_TYPES[mesh.cell_type], dtype=np.uint8),
    }
    head = "\n".join(
        [
            '<?xml version="1.0"?>',
            '<VTKFile type="UnstructuredGrid" version="1.0" byte_order="LittleEndian" header_type="UInt64">',
            f"<UnstructuredGrid>{_names_field(mesh)}",
            f'<Piece NumberOfPoints="{mesh.n_points}" NumberOfCells="{n}">',
            f"<Points>{appended.element('Points', in_space(mesh, mesh.points))}</Points>",
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
    """Write time-dependent data on a fixed mesh as one VTKHDF file (opens in ParaView 5.12 and later).

    Parameters
    ----------
    path : path-like
        File to write, ``.vtkhdf``; an existing one is replaced only when the new one is complete.
    mesh : Mesh
        Mesh with n points and m cells, mm; stored once.
    times : array_like, shape (s,)
        Strictly increasing times, s, or numbers of the states.
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
        raise InputError(f"times are {steps.tolist()}; give a one-dimensional array of at least one, strictly increasing")
    for data in (point_data_steps or {}, cell_data_steps or {}):
        for name, values in data.items():
            if len(values) != len(steps):
                raise InputError(f"{name!r} has {len(values)} steps, but there are {len(steps)} times; give one array for each time")
    with SeriesFile.begun(path, mesh) as series:
        for step, time in enumerate(steps.tolist()):
            points, cells = ({name: v[step] for name, v in (data or {}).items()} for data in (point_data_steps, cell_data_steps))
            series.append(time, points, cells)
        series.finish()


class _Appended:
    """Appended data section: arrays in sequence, each preceded by its length in bytes."""

    def __init__(self) -> None:
        self.pieces: list[bytes] = []
        self.offset = 0

    def element(self, name: str, values: NDArray[np.generic]) -> str:
        """Append an array (n,) or (n, d) and return the XML element that refers to it."""
        stored = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<"))
        kind = f"{_NAMES[stored.dtype.kind]}{8 * stored.dtype.itemsize}"
        # Omitted for one component: meshio would read a column instead of a row.
        components = f' NumberOfComponents="{stored.shape[1]}"' if stored.ndim == 2 else ""
        self.pieces += [np.uint64(stored.nbytes).astype("<u8").tobytes(), stored.tobytes()]
        at, self.offset = self.offset, self.offset + 8 + stored.nbytes
        return f'<DataArray type="{kind}" Name={quoteattr(name)}{components} format="appended" offset="{at}"/>'

    def section(self, tag: str, arrays: Mapping[str, NDArray[np.generic]]) -> str:
        """Append several arrays and return the XML section that refers to them."""
        return f"<{tag}>\n" + "\n".join(self.element(name, values) for name, values in arrays.items()) + f"\n</{tag}>"


def _names_field(mesh: Mesh) -> str:
    """Return the region names as field data: zero-terminated UTF-8 codes, because meshio rejects VTK's own strings."""
    codes = b"".join(name.encode() + b"\0" for name in mesh.region_names)
    head = f'<DataArray type="UInt8" Name="region_names" NumberOfTuples="{len(codes)}" format="ascii">'
    return f"<FieldData>\n{head}{' '.join(map(str, codes))}</DataArray>\n</FieldData>"
