"""Files of displacement fields with covariance: HDF5, beside vector images and tables of other programs.

An HDF5 file has the datasets ``vectors`` (mm), ``valid``, and ``covariance`` (mm^2) and ``quality`` where these are known. At points,
``points`` (n, d) hold their positions; on a grid, arrays are (nz, ny, nx, ...), and the root has the attributes ``spacing_mm``,
``origin_mm`` (x, y, z) and ``direction``. ``format``, ``frame`` and ``provenance`` (JSON) are attributes as well.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from naibu.core.arrays import FloatArray, require_lengths
from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.io.field_formats import aldvc, field_tables, itk_transforms, spam_tiff
from naibu.io.files.atomic import new_aside, put_in_place
from naibu.io.files.hdf5_stream import Hdf5File
from naibu.io.files.reading import guarded_reading, read_bytes, require_plausible, require_regular
from naibu.io.images import read_displacement
from naibu.io.mesh_formats import vtu
from naibu.io.tables.point_tables import EXCEL, TEXT
from naibu.io.tables.table_cells import MM_PER_UNIT, unit_factor, without_unit

FORMAT = "naibu displacement field 1"
FRAME = "LPS, mm; the material at x in the reference configuration is found at x + vector"
FIELD_FILE = "field.h5"  # in the folders that naibu sense, track and predict write
TABLES = (*TEXT, *EXCEL, ".dat")
ENDINGS = (".h5", ".mha", ".mhd", ".nrrd", ".nii", ".nii.gz", ".tfm", ".vtu", ".mat", "-Xdisp.tif", *TABLES)
# what to do with files that are not read, by their ending
_INSTEAD = {
    ".vc7": "export the vectors in DaVis as Tecplot text (.dat)",
    ".im7": "it is an image of DaVis; export the vectors as Tecplot text (.dat)",
    ".odb": "write positions and U of the nodes as a table (.csv), or as .vtu",
    ".xfm": "write the transform as .tfm or .h5",
    **dict.fromkeys((".vtk", ".vtp", ".pvtu", ".vti", ".vts", ".xdmf", ".case"), "save it in ParaView as .vtu"),
}


def write_field(path: str | os.PathLike[str], field: DisplacementField, *, provenance: Mapping[str, Any] | None = None) -> Path:
    """Write a displacement field with its covariance as HDF5; the same field gives the same bytes.

    Parameters
    ----------
    path : path-like
        ``.h5``.
    field : DisplacementField
        At points or on a grid; that of a mesh is stored at its nodes.
    provenance : mapping, optional
        What the field came from; kept as JSON.

    Raises
    ------
    InputError
        Another ending, or a file that cannot be written.
    """
    target = Path(path)
    if target.suffix.lower() not in (".h5", ".hdf5"):
        raise InputError(f"{target.name}: displacement fields are written as .h5; for images of vectors use write_displacement")
    aside = new_aside(target)
    try:
        output = Hdf5File(aside)
        try:
            _store(output.file, field, json.dumps(dict(provenance or {}), sort_keys=True, ensure_ascii=False))
        finally:
            output.close()
        output.require_written()
        return put_in_place(aside, target)
    except OSError as error:
        raise InputError(f"{target}: cannot be written ({error}); free some space or choose another folder") from error
    finally:
        aside.unlink(missing_ok=True)


def _store(root: Any, field: DisplacementField, provenance: str) -> None:
    root.attrs["format"], root.attrs["frame"], root.attrs["provenance"] = FORMAT, FRAME, provenance
    arrays: dict[str, Any] = {"vectors": field.vectors, "valid": field.valid, "covariance": field.covariance, "quality": field.quality}
    if isinstance(field.support, Volume):
        grid = field.support
        root.attrs["spacing_mm"], root.attrs["origin_mm"], root.attrs["direction"] = grid.spacing_mm, grid.origin_mm, grid.direction
    else:
        arrays["points"] = field.points
    for name, values in arrays.items():
        if values is not None:
            root.create_dataset(name, data=values, compression="gzip", compression_opts=4, shuffle=True, track_times=False)


def read_field(
    path: str | os.PathLike[str],
    *,
    unit: str | None = None,
    spacing_mm: Sequence[float] | None = None,
    node_spacing: Sequence[float] | None = None,
) -> DisplacementField:
    """Read a displacement field; what other programs mean by their vectors is told in the page on displacement fields.

    Parameters
    ----------
    path : path-like
        ``.h5`` as `write_field`, ``naibu sense`` and ``naibu track`` write it, or a transform of ITK, ANTs or 3D Slicer (also ``.tfm``); an
        image of vectors (``.mha``, ``.mhd``, ``.nrrd``, ``.nii``, ``.nii.gz``; a ``PREFIX1Warp.nii.gz`` of ANTs with the
        ``PREFIX0GenericAffine.mat`` beside it, which is applied after it); a mesh with displacements at its points (``.vtu``); a
        result of ALDVC (``.mat``); one of the three components of SPAM in TIFF files (``-Xdisp.tif``); or a table (``.csv``,
        ``.tsv``, ``.txt``, ``.xlsx``, Tecplot ``.dat``) with columns such as x_mm, y_mm,
        z_mm, ux_mm, uy_mm, uz_mm and, where they are known, sd_x_mm, sd_y_mm, sd_z_mm.
    unit : str, optional
        Unit of tables and meshes, mm, cm, m, um or inch, where they do not state it; by default mm.
    spacing_mm : sequence of float, optional
        Size of a voxel along x, y, z, mm, where lengths are in voxels: in fields of SPAM and results of ALDVC.
    node_spacing : sequence of float, optional
        From node to node along x, y, z, in voxels, of TIFF files of SPAM.

    Raises
    ------
    InputError
        A file that cannot be read, is damaged, or holds no field.
    """
    source = Path(path)
    ending = source.suffix.lower()
    if source.is_dir() and (source / FIELD_FILE).is_file():
        raise InputError(f"{source} is a folder; give the displacement field in it, {source / FIELD_FILE}")
    require_lengths(spacing_mm=spacing_mm)
    _require_fitting(source, ending, unit, spacing_mm, node_spacing)
    with guarded_reading(path, "displacement field"):
        if ending in (".h5", ".hdf5"):
            return _stored(source)
        if ending in TABLES and not itk_transforms.is_text(source):
            require_regular(source)
            return field_tables.read(source, unit=unit, spacing_mm=spacing_mm)
        if ending in spam_tiff.ENDINGS:
            return spam_tiff.read(source, spacing_mm=spacing_mm, node_spacing=node_spacing)
        if ending == ".vtu":
            return _mesh(source, unit)
        if ending == ".mat":
            require_regular(source)
            return _in_voxels(source, *aldvc.read(source), spacing_mm)
        if ending in _INSTEAD:
            raise InputError(f"{source.name}: is not read; {_INSTEAD[ending]}. Displacement fields are read from {', '.join(ENDINGS)}")
        itk_transforms.require_forward_warp(source)
        vectors, grid = itk_transforms.read_tfm(source) if ending in (".tfm", ".txt") else read_displacement(source)
        if (affine := itk_transforms.ants_affine(source)) is not None:
            vectors = itk_transforms.followed_by(affine, vectors, grid)
        return DisplacementField.on_grid(grid, vectors)


def _require_fitting(
    source: Path, ending: str, unit: str | None, spacing_mm: Sequence[float] | None, node_spacing: Sequence[float] | None
) -> None:
    """Refuse a unit or a size of voxels where the file states its own."""
    if unit is not None and unit not in MM_PER_UNIT:
        raise InputError(f"unit = {unit!r} is not known; use one of {', '.join(dict.fromkeys(MM_PER_UNIT))}")
    if unit is not None and ending not in (*TABLES, ".vtu"):
        raise InputError(f"unit = {unit!r} goes with tables and meshes; {source.name} states its own: leave it out")
    if spacing_mm is not None and ending not in (*TABLES, *spam_tiff.ENDINGS, ".mat"):
        raise InputError(f"spacing_mm goes with fields in voxels; {source.name} states its own: leave it out")
    if unit is not None and spacing_mm is not None:
        raise InputError("`unit` and spacing_mm both say what a coordinate is; give one of them")
    if node_spacing is not None and ending not in spam_tiff.ENDINGS:
        raise InputError(f"node_spacing goes with TIFF files of SPAM; {source.name} states where its points lie: leave it out")


def _mesh(source: Path, unit: str | None) -> DisplacementField:
    """Return the field at the points of a mesh: that of its array of three components, or that whose name says displacement."""
    points, arrays = vtu.read_point_arrays(source.name, read_bytes(source))
    stated = [name for name in arrays if re.fullmatch(r"sd|standard[ _]deviation", without_unit(name.lower()))]
    fitting = {name: values for name, values in arrays.items() if values.shape[1] == 3 and name not in stated}
    named = {name: values for name, values in fitting.items() if re.match(r"disp|u$|deformation$", name.lower())}
    chosen = named or fitting
    if len(chosen) != 1:
        there = ", ".join(arrays) or "none"
        raise InputError(f"{source.name}: needs one array of three components at its points, called displacement; it has {there}")
    (name, values), sd = next(iter(chosen.items())), None
    vectors = unit_factor(source, name, unit) * values
    if stated:
        sd = unit_factor(source, stated[0], unit) * arrays[stated[0]]
        measured = np.asarray(np.isfinite(vectors).all(axis=1))
        if sd.shape[1] not in (1, 3) or not (sd[measured] >= 0.0).all():
            raise InputError(f"{source.name}: {stated[0]} must be one or three numbers a point, 0 or more where there is a displacement")
        sd = np.where(measured[:, None], np.broadcast_to(sd, vectors.shape), 0.0)
    return DisplacementField.from_arrays(MM_PER_UNIT[unit or "mm"] * points, vectors, sd_mm=sd)


def _in_voxels(source: Path, points: FloatArray, vectors: FloatArray, spacing_mm: Sequence[float] | None) -> DisplacementField:
    if spacing_mm is None:
        raise InputError(f"{source.name}: is a result of ALDVC, in voxels; give spacing_mm, the size of a voxel along x, y, z")
    return DisplacementField.from_arrays(points * np.asarray(spacing_mm), vectors * np.asarray(spacing_mm))


def _stored(source: Path) -> DisplacementField:
    require_regular(source)
    with h5py.File(source, "r") as root:
        if itk_transforms.is_transform(root):
            moved, frame = itk_transforms.read_h5(source, root)
            return DisplacementField.on_grid(frame, moved)
        if root.attrs.get("format") != FORMAT:
            raise InputError(f"{source.name}: contains no displacement field: its attribute 'format' is not {FORMAT!r}")
        vectors = _array(source, root, "vectors")
        if vectors is None:
            raise InputError(f"{source.name}: the field has no vectors; write it again")
        valid, covariance, quality, points = (_array(source, root, name) for name in ("valid", "covariance", "quality", "points"))
        mask = None if valid is None else valid > 0.5
        if points is not None:
            if quality is not None and quality.shape != (len(points),):
                raise InputError(f"{source.name}: quality has shape {quality.shape} for {len(points)} points")
            at = DisplacementField.from_arrays(points, vectors, covariance=covariance, valid=mask)
            return DisplacementField(at.support, at.vectors, at.covariance, at.valid, quality)
        axes = (np.asarray(root.attrs[name], dtype=float) for name in ("spacing_mm", "origin_mm", "direction"))
        spacing, origin, direction = axes
        grid = Volume.from_array(np.zeros(vectors.shape[:3], dtype=bool), spacing_mm=spacing, origin_mm=origin, direction=direction)
        return DisplacementField.on_grid(grid, vectors, covariance=covariance, valid=mask, quality=quality)


def _array(source: Path, root: Any, name: str) -> FloatArray | None:
    """Return a dataset of the file itself; None where there is none."""
    if name not in root:
        return None
    link = root.get(name, getlink=True)
    stored = None if isinstance(link, h5py.ExternalLink) else root[name]
    if not isinstance(stored, h5py.Dataset) or stored.external or stored.is_virtual:
        raise InputError(f"{source.name}: {name} stands in another file; copy it into this one")
    require_plausible(source.name, stored.nbytes, stored.id.get_storage_size(), compressed=stored.chunks is not None)
    return np.asarray(stored[()], dtype=float)
