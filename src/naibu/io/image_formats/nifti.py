"""NIfTI (``.nii``, ``.nii.gz``) :cite:p:`cox2004`, read with nibabel; its frame is RAS and is converted to the LPS frame of naibu."""

from __future__ import annotations

import gzip
import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from naibu.core.arrays import AnyArray, FloatArray
from naibu.core.errors import InputError, NaibuWarning
from naibu.core.optional_packages import optional_package
from naibu.core.volume import Volume
from naibu.io.files.atomic import write_atomically
from naibu.io.files.reading import require_plausible, require_regular
from naibu.io.image_formats.geometry import FLIP_RAS, ReadOptions, three_axes, unit_length, volume_with_axes, without_header

# codes of the header: vectors, and displacement vectors, whose components are along the axes of the file (nifti1.h)
_VECTOR, _DISPLACEMENT = 1007, 1006
_FSL = range(2006, 2019)  # codes that FSL gives to its warps
_ALIKE, _HALF_VOXEL = 0.01, 0.5  # of sizes of voxels; of one of them, where two forms of the same place put the corners of a volume
_STORED = ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8")


class ContradictingFormsWarning(NaibuWarning):
    """The two forms of a header place or scale the voxels differently."""


def read(path: Path, options: ReadOptions) -> Volume:
    """Read a scalar volume (see `naibu.io.images.read_volume`); the stored values, unless `options.rescaled`."""
    nibabel = optional_package("nibabel", f"{path.name}: reading NIfTI files")
    require_regular(path)
    try:
        image = nibabel.load(path)
        packed = path.name.lower().endswith(".gz")
        announced = math.prod(image.shape) * image.header.get_data_dtype().itemsize
        require_plausible(path.name, announced, _stored_bytes(path), compressed=packed)
        stored = np.asarray(image.dataobj) if options.rescaled else image.dataobj.get_unscaled()
    except InputError:
        raise
    # nibabel's readers raise exceptions of many types
    except Exception as error:
        if path.suffix.lower() == ".img" and not path.with_suffix(".hdr").exists():
            raise without_header(path) from error
        raise InputError(f"{path.name}: cannot be read as NIfTI ({error}); copy the file again") from error
    if stored.dtype.kind not in "biuf":
        raise InputError(
            f"{path.name}: contains colours or complex numbers ({stored.dtype}), not intensities; convert it to greyscale first"
        )
    values = three_axes(path.name, np.asarray(stored).T)
    _warn_of_contradicting_forms(path, image)
    affine = np.asarray(image.affine, dtype=float)
    named = image.header.get_xyzt_units()[0] if hasattr(image.header, "get_xyzt_units") else "unknown"
    unit = options.unit_mm or (1.0 if named == "unknown" else unit_length(path.name, named))
    return volume_with_axes(path.name, values, FLIP_RAS @ affine[:3, 3], FLIP_RAS @ affine[:3, :3], unit)


def read_vectors(path: Path, options: ReadOptions) -> tuple[FloatArray, Volume]:
    """Read vectors (nz, ny, nx, 3), LPS, and their grid, whose values are true where all components are finite.

    Vectors of the intent "vector" are in LPS, as ITK and ANTs write them; those of "displacement vector" in RAS, as the standard has it.

    Raises
    ------
    InputError
        No vectors of three components along the fifth axis, or a warp whose vectors mean something else.
    """
    nibabel = optional_package("nibabel", f"{path.name}: reading NIfTI files")
    require_regular(path)
    image = nibabel.load(path)
    announced = math.prod(image.shape) * image.header.get_data_dtype().itemsize
    require_plausible(path.name, announced, _stored_bytes(path), compressed=path.name.lower().endswith(".gz"))
    intent, name = int(image.header["intent_code"]), bytes(image.header["intent_name"].item()).decode("latin-1").strip("\0 ")
    if intent in _FSL or name.startswith(("NREG", "FSL")):
        raise InputError(
            f"{path.name}: is a warp of {'NiftyReg' if name.startswith('NREG') else 'FSL'} (intent {intent} {name!r}), whose vectors are "
            "not displacements in mm along the axes of the scan; convert it to an ITK displacement field first"
        )
    if len(image.shape) != 5 or image.shape[3:] != (1, 3) or intent not in (_VECTOR, _DISPLACEMENT):
        raise InputError(
            f"{path.name}: has shape {image.shape} and intent {intent}; a displacement field has (nx, ny, nz, 1, 3) and the intent 1007 "
            "(vector, LPS, as ANTs writes it) or 1006 (displacement vector, RAS)"
        )
    vectors = np.asarray(image.dataobj, dtype=float)[:, :, :, 0].transpose(2, 1, 0, 3)
    _warn_of_contradicting_forms(path, image)
    affine = np.asarray(image.affine, dtype=float)
    named = image.header.get_xyzt_units()[0]
    unit = options.unit_mm or (1.0 if named == "unknown" else unit_length(path.name, named))
    vectors = unit * (vectors @ FLIP_RAS if intent == _DISPLACEMENT else vectors)
    known = np.isfinite(vectors).all(axis=3)
    return vectors, volume_with_axes(path.name, known, FLIP_RAS @ affine[:3, 3], FLIP_RAS @ affine[:3, :3], unit)


def _warn_of_contradicting_forms(path: Path, image: Any) -> None:
    """Warn where sform, which is used, and qform state other sizes of voxels, or another place in the same space.

    Forms of unequal codes may differ in place, as those of the scanner and of an atlas do, but a voxel has one size.
    """
    header = image.header
    if not hasattr(header, "get_qform"):
        return
    (sform, code), (qform, other) = header.get_sform(coded=True), header.get_qform(coded=True)
    if not code or not other:
        return
    sizes, others = (np.linalg.norm(form[:3, :3], axis=0) for form in (sform, qform))
    corners = np.array([[i, j, k, 1] for i in (0, 1) for j in (0, 1) for k in (0, 1)]) * [*np.maximum(np.array(image.shape[:3]) - 1, 1), 1]
    apart = float(np.linalg.norm(corners @ (sform - qform).T, axis=1).max())
    scaled = np.abs(sizes / np.maximum(others, 1e-300) - 1.0).max() > _ALIKE
    if scaled or (code == other and apart > _HALF_VOXEL * float(others.min())):
        told, qform_told = (" x ".join(f"{size:.4g}" for size in each) for each in (sizes, others))
        what = f"voxels of {told} and of {qform_told}" if scaled else f"places that are up to {apart:.3g} (unit of the file) apart"
        warnings.warn(
            f"{path.name}: its sform (code {int(code)}) and its qform (code {int(other)}) contradict each other: {what}; the sform was "
            "used. Where it is that of an atlas, or was left from before resampling, set its code to 0, so that the qform is used",
            ContradictingFormsWarning,
            stacklevel=4,
        )


def _stored_bytes(path: Path) -> int:
    """Return the size of the file with the values: that of the header, or the image of a pair."""
    image = path.with_suffix(".img")
    return (image if path.suffix.lower() == ".hdr" and image.is_file() else path).stat().st_size


def write(path: Path, values: AnyArray, grid: Volume, *, compressed: bool) -> Path:
    """Write intensities (nz, ny, nx) on the grid of a volume; ``.nii.gz`` is compressed, ``.nii`` is not."""
    nibabel = optional_package("nibabel", f"{path.name}: writing NIfTI files")
    stored = values.astype(np.uint8) if values.dtype == bool else values
    stored = stored.astype(np.float32) if stored.dtype == np.float16 else stored
    if stored.ndim != 3 or stored.dtype.str[1:] not in _STORED:
        raise InputError(f"{path.name}: NIfTI is written for scalar volumes, not for {values.ndim}-dimensional {values.dtype}; use .mha")
    affine = np.eye(4)
    affine[:3, :3] = FLIP_RAS @ (grid.direction * grid.spacing_mm)
    affine[:3, 3] = FLIP_RAS @ grid.origin_mm
    image = nibabel.Nifti1Image(np.ascontiguousarray(stored).T, affine, dtype=stored.dtype)
    image.header.set_xyzt_units("mm")
    image.header.set_slope_inter(1.0, 0.0)
    image.set_qform(affine, code="scanner")
    image.set_sform(affine, code="scanner")
    data = image.to_bytes()
    if path.name.lower().endswith(".gz"):
        data = gzip.compress(data, compresslevel=1, mtime=0)
    return write_atomically(path, data)
