"""Deformable transforms of ITK: ``.h5`` (also of ANTs and 3D Slicer, with linear transforms after them) and text (``.tfm``, ``.txt``).

The linear transform that ANTs writes beside its warp is in a MATLAB file (``.mat``, version 4).

A transform maps points of the fixed image to the moving one, in LPS and mm: x to x + d(x). Fixed parameters of a displacement field
transform are size, origin, spacing and direction (row by row); its parameters are the vectors, voxel by voxel, with x fastest. Those of a
B-spline transform describe its grid of control points in the same way; its parameters are all coefficients along x, then y, then z, of
cubic B-splines. A composite transform applies its last member first. The formats are described in the ITK Software Guide,
https://itk.org/ItkSoftwareGuide.pdf.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from scipy import ndimage

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.io.files.reading import guarded_reading, read_bytes, require_plausible, require_regular
from naibu.io.image_formats.geometry import volume_with_axes

GROUP = "TransformGroup"
_FIELD, _SPLINES = "DisplacementFieldTransform", "BSplineTransform"
_AT_KNOT = (1.0 / 6.0, 4.0 / 6.0, 1.0 / 6.0)  # cubic B-splines of a control point and its neighbours
_LINEAR = ("AffineTransform", "MatrixOffsetTransformBase")
_HEAD = "#Insight Transform File"
_TYPO = ("Transform", "Tranform")  # names of datasets before ITK 4.13 lack a letter


class _Transform(NamedTuple):
    kind: str
    parameters: FloatArray
    fixed: FloatArray


def is_transform(root: Any) -> bool:
    """Return whether an open HDF5 file holds ITK transforms."""
    return GROUP in root


def is_text(source: Path) -> bool:
    """Return whether a file ``.txt`` is no table, but holds ITK transforms.

    Raises
    ------
    InputError
        It is a parameter file of elastix.
    """
    if source.suffix.lower() != ".txt":
        return False
    require_regular(source)
    with source.open("rb") as file:
        begin = file.read(4096).decode("utf-8", "replace").lstrip()
    if begin.startswith("(") and "Parameters" in begin:
        raise InputError(
            f"{source.name}: is a parameter file of elastix; let transformix evaluate it (transformix -def all -tp {source.name}), and "
            "take its deformationField.mhd"
        )
    return begin.startswith(_HEAD)


def read_h5(source: Path, root: Any) -> tuple[FloatArray, Volume]:
    """Return vectors (nz, ny, nx, 3), mm, and their grid, of a file that is open.

    Raises
    ------
    InputError
        Transforms that are not one displacement field, or one of B-splines, followed by linear ones at most.
    """
    group = root[GROUP]
    found = []
    for number in sorted(group, key=lambda name: int(name) if name.isdigit() else -1):
        entry = group[number]
        kind = entry["TransformType"][()]
        kind = kind[0] if isinstance(kind, np.ndarray) else kind
        kind = kind.decode("utf-8", "replace") if isinstance(kind, bytes) else str(kind)
        if not kind.startswith("CompositeTransform"):
            found.append(_Transform(kind, _dataset(source, entry, "Parameters"), _dataset(source, entry, "FixedParameters")))
    return _field(source, found)


def read_tfm(source: Path) -> tuple[FloatArray, Volume]:
    """Return vectors (nz, ny, nx, 3), mm, and their grid, of a text file.

    Raises
    ------
    InputError
        No ITK transform, or transforms that are not one displacement field, or one of B-splines, followed by linear ones at most.
    """
    text = read_bytes(source).decode("utf-8", "replace")
    if not text.startswith(_HEAD):
        raise InputError(f"{source.name}: is no text file of ITK transforms: its first line is not '{_HEAD} V1.0'")
    found: list[_Transform] = []
    for line in text.splitlines():
        name, colon, value = line.partition(":")
        if not colon or line.startswith("#"):
            continue
        if name.strip() == "Transform":
            found.append(_Transform(value.strip(), np.zeros(0), np.zeros(0)))
        elif found and name.strip() in ("Parameters", "FixedParameters"):
            numbers = _numbers(source, name.strip(), value)
            last = found.pop()
            found.append(last._replace(parameters=numbers) if name.strip() == "Parameters" else last._replace(fixed=numbers))
    return _field(source, [t for t in found if not t.kind.startswith("CompositeTransform")])


def require_forward_warp(source: Path) -> None:
    """Refuse the inverse warp of ANTs, ``PREFIX1InverseWarp.nii.gz``.

    Raises
    ------
    InputError
        It is one: its vectors lead from the moving image back to the fixed one, after the inverse of the linear transform.
    """
    if "InverseWarp.nii" in source.name:
        forward = source.name.replace("InverseWarp", "Warp")
        raise InputError(
            f"{source.name}: leads from the moving image to the fixed one; the displacement of the fixed image's points is in {forward}. "
            "If the moving image was the reference, register the other way round"
        )


def ants_affine(source: Path) -> Path | None:
    """Return the linear transform of ANTs that belongs to a warp ``PREFIX1Warp.nii.gz``, ``PREFIX0GenericAffine.mat``, if it is there."""
    prefix, found, _ = source.name.partition("1Warp.nii")
    affine = source.with_name(f"{prefix}0GenericAffine.mat")
    return affine if found and affine.exists() else None


def followed_by(source: Path, vectors: FloatArray, grid: Volume) -> FloatArray:
    """Return vectors (nz, ny, nx, 3), mm, after which a linear transform is applied, of a file ``.mat`` as ITK and ANTs write it.

    Raises
    ------
    InputError
        No linear transform of three dimensions.
    """
    from scipy.io import loadmat

    require_regular(source)
    with guarded_reading(source, "linear transform"):
        stored = {name: np.asarray(values) for name, values in loadmat(source).items() if not name.startswith("__")}
    kind = next((name for name in stored if name.endswith("_3_3")), None)
    if kind is None or "fixed" not in stored or any(values.dtype.kind not in "fiu" for values in stored.values()):
        raise InputError(
            f"{source.name}: holds {', '.join(stored) or 'nothing'}, no linear transform of ITK in three dimensions with its 'fixed'; "
            "move it elsewhere if it does not belong to the warp beside it"
        )
    transform = _Transform(kind, stored[kind].astype(float).ravel(), stored["fixed"].astype(float).ravel())
    if not (np.isfinite(transform.parameters).all() and np.isfinite(transform.fixed).all()):
        raise InputError(f"{source.name}: {kind} holds numbers that are not finite; write the file again")
    places = grid.positions()
    return _linear(source, transform, places + vectors) - places


def _dataset(source: Path, entry: Any, name: str) -> FloatArray:
    stored = next((entry[f"{start}{name}"] for start in _TYPO if f"{start}{name}" in entry), None)
    if not isinstance(stored, h5py.Dataset) or stored.external or stored.is_virtual:
        raise InputError(f"{source.name}: a transform has no {name} of its own; write the file again")
    require_plausible(source.name, stored.nbytes, stored.id.get_storage_size(), compressed=stored.chunks is not None)
    return np.asarray(stored[()], dtype=float).ravel()


def _numbers(source: Path, name: str, text: str) -> FloatArray:
    try:
        return np.array(text.split(), dtype=float)
    except ValueError as error:
        raise InputError(f"{source.name}: {name} holds what is no number ({error}); write the file again") from error


def _field(source: Path, found: list[_Transform]) -> tuple[FloatArray, Volume]:
    kinds = [t.kind for t in found]
    fields = [t for t in found if t.kind.startswith((_FIELD, _SPLINES))]
    if len(fields) != 1 or found[-1] is not fields[0]:
        raise InputError(
            f"{source.name}: holds {', '.join(kinds) or 'no transform'}; naibu reads one {_FIELD} or {_SPLINES} that is applied first, "
            "with linear transforms after it: convert the whole to one displacement field (in 3D Slicer: Transforms, Convert; in "
            "SimpleITK: TransformToDisplacementField)"
        )
    vectors, grid = _of_field(source, fields[0]) if fields[0].kind.startswith(_FIELD) else _of_splines(source, fields[0])
    moved = grid.positions() + vectors
    for transform in reversed(found[:-1]):
        moved = _linear(source, transform, moved)
    return moved - grid.positions() if len(found) > 1 else vectors, grid


def _of_field(source: Path, transform: _Transform) -> tuple[FloatArray, Volume]:
    shape, origin, axes = _stated_grid(source, transform)
    grid = volume_with_axes(source.name, np.zeros(shape, dtype=bool), origin, axes)
    return transform.parameters.reshape(*shape, 3), grid


def _of_splines(source: Path, transform: _Transform) -> tuple[FloatArray, Volume]:
    """Return the displacement at the knots inside the domain: as many vectors as the transform is free to choose there."""
    shape, origin, axes = _stated_grid(source, transform)
    if min(shape) < 4:
        points = " x ".join(map(str, shape[::-1]))
        raise InputError(f"{source.name}: {transform.kind} has {points} control points; cubic ones need 4 along each axis")
    values = np.moveaxis(transform.parameters.reshape(3, *shape), 0, -1)
    for axis in range(3):
        values = ndimage.convolve1d(values, _AT_KNOT, axis=axis)
    inner = values[1:-1, 1:-1, 1:-1]
    grid = volume_with_axes(source.name, np.zeros(inner.shape[:3], dtype=bool), origin + axes.sum(axis=1), axes)
    return np.ascontiguousarray(inner), grid


def _stated_grid(source: Path, transform: _Transform) -> tuple[tuple[int, ...], FloatArray, FloatArray]:
    """Return shape (nz, ny, nx), origin, and the steps along x, y and z as columns (3, 3), mm."""
    fixed, values = transform.fixed, transform.parameters
    if "_3_3" not in transform.kind or len(fixed) != 18:
        raise InputError(f"{source.name}: {transform.kind} has {len(fixed)} fixed parameters; one of three dimensions has 18")
    size = fixed[:3]
    if not (np.isfinite(fixed).all() and (size >= 1).all() and (size == np.round(size)).all() and size.prod() * 3 == len(values)):
        raise InputError(f"{source.name}: states {size.tolist()} voxels, but has {len(values)} parameters, not three a voxel")
    return tuple(int(n) for n in size[::-1]), fixed[3:6], fixed[9:].reshape(3, 3) * fixed[6:9]


def _linear(source: Path, transform: _Transform, points: FloatArray) -> FloatArray:
    """Apply a linear transform: y = M (x - c) + c + t."""
    p, centre = transform.parameters, transform.fixed
    if transform.kind.startswith("IdentityTransform"):
        return points
    if transform.kind.startswith("TranslationTransform") and len(p) == 3:
        return np.asarray(points + p)
    if transform.kind.startswith("Euler3DTransform") and len(p) == 6 and len(centre) >= 3:
        p = np.concatenate([_euler(p[:3], zyx=len(centre) > 3 and centre[3] != 0.0).ravel(), p[3:]])
    elif not transform.kind.startswith(_LINEAR) or len(p) != 12 or len(centre) < 3:
        raise InputError(
            f"{source.name}: the field is followed by a {transform.kind}; naibu reads affine and Euler transforms, translations and "
            "identities there"
        )
    return np.asarray((points - centre[:3]) @ p[:9].reshape(3, 3).T + centre[:3] + p[9:])


def _euler(angles: FloatArray, *, zyx: bool) -> FloatArray:
    """Return the rotation of ITK's Euler angles about x, y and z, rad: Rz Rx Ry, or Rz Ry Rx."""
    (cx, cy, cz), (sx, sy, sz) = np.cos(angles), np.sin(angles)
    x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return np.asarray(z @ y @ x if zyx else z @ x @ y)
