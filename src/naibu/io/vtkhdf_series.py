"""Time series on a fixed mesh as a VTKHDF file that is extended while a computation runs.

The format is specified in "VTK File Formats", section "VTKHDF File Format".
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from naibu.core.arrays import AnyArray, FloatArray
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.io.files.atomic import new_aside, put_in_place
from naibu.io.files.hdf5_stream import Hdf5File
from naibu.io.files.rollback_journal import roll_back

VTK_TYPES = {"line": 3, "triangle": 5, "tetra": 10, "hexahedron": 12, "tetra10": 24}
_ROWS = "naibu"  # group of our own tables beside VTK's
_CHUNK = 512  # rows of short tables
_CHUNK_BYTES = 16_384


@dataclass(eq=False)
class SeriesFile:
    """A VTKHDF time series that is written under a temporary name and replaces an existing file only when finished.

    As a context manager it removes an unfinished file on exit, unless there was a checkpoint: `continued` takes that up.
    """

    target: Path
    aside: Path
    mesh: Mesh
    output: Hdf5File
    recoverable: bool = False

    @classmethod
    def begun(cls, path: str | os.PathLike[str], mesh: Mesh, origin: str = "") -> SeriesFile:
        """Begin a new series on a mesh.

        Parameters
        ----------
        path : path-like
            The file when it is finished.
        mesh : Mesh
            Common to all steps.
        origin : str
            Mark of what the series belongs to, which `continued` compares.

        Raises
        ------
        InputError
            The folder cannot be written.
        """
        target = Path(path)
        aside = new_aside(target)
        series = cls(target, aside, mesh, Hdf5File(aside))
        try:
            root = series.file.create_group("VTKHDF")
            _write_static(root, mesh)
            _begin_steps(root)
            if origin:
                series.file.create_group(_ROWS).attrs["origin"] = origin
            series._require_written()
        except BaseException:
            series.discard()
            raise
        return series

    @classmethod
    def continued(cls, path: str | os.PathLike[str], mesh: Mesh, steps: int, origin: str = "", aside: Path | None = None) -> SeriesFile:
        """Continue a series after its first `steps` steps; the old file stays until the new one is finished.

        Parameters
        ----------
        path : path-like
            The file, finished or to be.
        mesh : Mesh
            As before.
        steps : int
            Number of steps to keep.
        origin : str
            As for `begun`.
        aside : Path, optional
            The unfinished file that a killed process left at its last checkpoint, if there is one.

        Raises
        ------
        InputError
            There is no such file, it is damaged, has fewer steps, or contains another series or mesh.
        """
        target = Path(path)
        source = target if aside is None else aside
        copy = new_aside(target)
        try:
            shutil.copyfile(source, copy)
        except OSError as error:
            copy.unlink(missing_ok=True)
            raise InputError(f"{source}: cannot be read ({error.strerror or error}); begin a new series") from error
        try:
            if aside is not None and _journal(source).exists():
                roll_back(copy, _journal(source))
            series = cls(target, copy, mesh, Hdf5File(copy, keep=True))
        except (OSError, InputError) as error:
            copy.unlink(missing_ok=True)
            raise InputError(f"{source}: is damaged ({error}); begin a new series") from error
        try:
            series._require(source, steps, origin)
            series.truncate(steps)
        except BaseException:
            series.discard()
            raise
        return series

    def _require(self, source: Path, steps: int, origin: str) -> None:
        """Refuse a file that is damaged, of other content or with fewer steps."""
        try:
            root = self.file["VTKHDF"]
            known, same = int(root["Steps"].attrs["NSteps"]), np.array_equal(root["Connectivity"][:], self.mesh.cells.ravel())
            marked = self.file[_ROWS].attrs.get("origin", "") if _ROWS in self.file else ""
        except (OSError, KeyError) as error:
            raise InputError(f"{source}: is damaged ({error}); begin a new series") from error
        if known < steps or not same:
            raise InputError(
                f"{source}: contains {known} steps{'' if same else ' on another mesh'}, not the {steps} needed; begin a new series"
            )
        if marked != origin:
            raise InputError(f"{source}: contains the steps of another computation; begin a new series")

    @property
    def file(self) -> h5py.File:
        """The open HDF5 file."""
        return self.output.file

    @property
    def steps(self) -> int:
        """Number of complete steps."""
        return int(self.file["VTKHDF/Steps"].attrs["NSteps"])

    def append(
        self, time: float, point_data: Mapping[str, ArrayLike] | None = None, cell_data: Mapping[str, ArrayLike] | None = None
    ) -> None:
        """Append a time step; array names and shapes must be the same in every step.

        Parameters
        ----------
        time : float
            Time of the step, s.
        point_data : mapping of str to array_like, shape (n,), (n, d) or (n, d, d), optional
            Values at the points; state the unit in the name.
        cell_data : mapping of str to array_like, shape (m,), (m, d) or (m, d, d), optional
            Values of the cells.

        Raises
        ------
        InputError
            Names or shapes that VTK does not support or that differ from those of the first step, or a full disk.
        """
        root = self.file["VTKHDF"]
        steps, count = root["Steps"], self.steps
        for where, data in (("PointData", point_data or {}), ("CellData", cell_data or {})):
            for name, values in data.items():
                self._append_values(where, name, values, count)
                _put(steps[f"{where}Offsets"], name, count, np.int64(count * self._length(where)))
        for name in ("PartOffsets", "PointOffsets", "NumberOfParts"):
            _put(steps, name, count, np.int64(name == "NumberOfParts"))
        for name in ("CellOffsets", "ConnectivityIdOffsets"):
            _put(steps, name, count, np.zeros(1, np.int64))
        _put(steps["CellDataOffsets"], "region", count, np.int64(0))
        _put(steps, "Values", count, np.float64(time))
        steps.attrs["NSteps"] = np.int64(count + 1)  # last: a step counts when all of it is there
        self._require_written()

    def append_rows(self, name: str, rows: ArrayLike, first: int) -> None:
        """Write rows (k, ...) of a table of our own, beside VTK's data, from row `first` on."""
        values = np.asarray(rows)
        group = self.file.require_group(_ROWS)
        if name not in group:
            chunk = (_CHUNK, *values.shape[1:])
            group.create_dataset(name, (0, *values.shape[1:]), values.dtype, maxshape=(None, *values.shape[1:]), chunks=chunk)
        group[name].resize(first + len(values), axis=0)
        group[name][first:] = values

    def rows(self, name: str) -> AnyArray:
        """Return a table that `append_rows` wrote, shape (rows, ...)."""
        return np.asarray(self.file[f"{_ROWS}/{name}"][:])

    def values(self, name: str, step: int) -> AnyArray:
        """Return the point data `name` of a step, shape (n,) or (n, d)."""
        n = self.mesh.n_points
        return np.asarray(self.file[f"VTKHDF/PointData/{name}"][step * n : (step + 1) * n])

    def times(self) -> FloatArray:
        """Return the times of all steps, shape (s,), s."""
        return np.asarray(self.file["VTKHDF/Steps/Values"][: self.steps])

    def truncate(self, steps: int) -> None:
        """Remove all but the first `steps` steps."""
        root = self.file["VTKHDF"]
        root["Steps"].attrs["NSteps"] = np.int64(steps)
        for name in ("PartOffsets", "PointOffsets", "NumberOfParts", "CellOffsets", "ConnectivityIdOffsets", "Values"):
            root[f"Steps/{name}"].resize(steps, axis=0)
        for where in ("PointData", "CellData"):
            for name, offsets in root[f"Steps/{where}Offsets"].items():
                offsets.resize(steps, axis=0)
                if (where, name) != ("CellData", "region"):
                    root[where][name].resize(steps * self._length(where), axis=0)

    def finish(self) -> Path:
        """Close the file and rename it to its final name.

        Raises
        ------
        InputError
            It cannot be written.
        """
        self.output.close()
        self._require_written()
        put_in_place(self.aside, self.target)
        _journal(self.aside).unlink(missing_ok=True)
        return self.target

    def checkpoint(self) -> Path:
        """Make the steps so far survive the end of this process at any later moment; return the file that `continued` takes then.

        Raises
        ------
        InputError
            The disk is full.
        """
        try:
            self.output.checkpoint(_journal(self.aside))
        except OSError:
            self._require_written()
            raise
        self.recoverable = True
        return self.aside

    def discard(self) -> None:
        """Close and remove the unfinished file."""
        self.output.close()
        self.aside.unlink(missing_ok=True)
        _journal(self.aside).unlink(missing_ok=True)

    def __enter__(self) -> SeriesFile:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self.recoverable:
            self.output.close()
        else:
            self.discard()

    def _require_written(self) -> None:
        try:
            self.output.require_written()
        except OSError as error:
            reason = error.strerror or str(error)
            raise InputError(f"{self.target}: cannot be written ({reason}); free some space or choose another folder") from error

    def _length(self, where: str) -> int:
        return self.mesh.n_points if where == "PointData" else self.mesh.n_cells

    def _append_values(self, where: str, name: str, values: ArrayLike, step: int) -> None:
        if not name or "/" in name or (where == "CellData" and name == "region"):
            raise InputError(f"array name {name!r} cannot be used in a VTKHDF file; take another one without '/'")
        group, n = self.file["VTKHDF"][where], self._length(where)
        own = in_space(self.mesh, numbers(name, values, n, "points" if where == "PointData" else "cells"))
        if name not in group:
            if step:
                raise InputError(f"{name!r} is not in the earlier steps; give the same arrays in all steps")
            rows = n * max(1, _CHUNK_BYTES // own.nbytes)  # small steps share a chunk
            group.create_dataset(name, (0, *own.shape[1:]), own.dtype, maxshape=(None, *own.shape[1:]), chunks=(rows, *own.shape[1:]))
        known = group[name].shape[1:]
        if own.shape[1:] != known:
            raise InputError(f"{name!r} has shape {own.shape} in step {step}, but {(n, *known)} in step 0; shapes must not change")
        group[name].resize((step + 1) * n, axis=0)
        group[name][step * n :] = own


def _journal(aside: Path) -> Path:
    return aside.with_suffix(".undo")


def numbers(name: str, values: ArrayLike, n: int, what: str) -> NDArray[np.generic]:
    """Return values as an array (n,) or (n, d) of a type that VTK supports.

    Raises
    ------
    InputError
        Another number of rows, or values that are not real numbers.
    """
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


def in_space(mesh: Mesh, vectors: NDArray[np.generic]) -> NDArray[np.generic]:
    """Return vectors of a plane or a line padded with zeros to the three components that VTK needs."""
    missing = 3 - mesh.dimension
    if missing == 0 or vectors.ndim != 2 or vectors.shape[1] != mesh.dimension:
        return vectors
    return np.pad(vectors, ((0, 0), (0, missing)))


def _write_static(root: h5py.Group, mesh: Mesh) -> None:
    """Write the mesh, which is common to all steps."""
    n, k = mesh.cells.shape
    root.attrs["Version"] = np.array([2, 0], dtype=np.int64)
    # VTK's reader needs a fixed-length string here, not h5py's default.
    root.attrs["Type"] = np.bytes_("UnstructuredGrid")
    root["NumberOfPoints"] = np.array([mesh.n_points], dtype=np.int64)
    root["NumberOfCells"] = np.array([n], dtype=np.int64)
    root["NumberOfConnectivityIds"] = np.array([n * k], dtype=np.int64)
    root["Points"] = in_space(mesh, mesh.points)
    root["Connectivity"] = mesh.cells.ravel()
    root["Offsets"] = np.arange(0, n * k + 1, k, dtype=np.int64)
    root["Types"] = np.full(n, VTK_TYPES[mesh.cell_type], dtype=np.uint8)
    root.create_group("PointData")
    root.create_group("CellData")["region"] = mesh.regions
    # An attribute, not field data: VTK 9.7's reader crashed on UTF-8 strings there.
    root.attrs["region_names"] = list(mesh.region_names)


def _begin_steps(root: h5py.Group) -> None:
    """Create the empty tables of times, and of offsets that refer every step to the one mesh."""
    group = root.create_group("Steps")
    group.attrs["NSteps"] = np.int64(0)
    group.create_group("PointDataOffsets")
    group.create_group("CellDataOffsets")


def _put(group: h5py.Group, name: str, at: int, value: Any) -> None:
    """Write a row of an extensible table."""
    row = np.asarray(value)
    if name not in group:
        group.create_dataset(name, (0, *row.shape), row.dtype, maxshape=(None, *row.shape), chunks=(_CHUNK, *row.shape))
    group[name].resize(at + 1, axis=0)
    group[name][at] = row
