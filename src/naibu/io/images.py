"""Read and write image volumes and displacement fields; the file name extension selects the format.

Intensities are never rescaled: the stored values are returned in their stored type. Positions are in the LPS frame of DICOM and SimpleITK:
x increases towards the patient's left, y towards posterior and z towards superior.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray, require_positive
from naibu.core.chunked_volume import ChunkedVolume
from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.io.files.paths import require_usable_path
from naibu.io.files.reading import guarded_reading
from naibu.io.image_formats import dicom, hdf5, metaimage, nifti, nrrd, ome_zarr, png, tiff, tiff_stack, zarr_store
from naibu.io.image_formats.geometry import ReadOptions, without_header

_Handler = TypeVar("_Handler")
VOLUME_READERS: dict[str, Callable[[Path, ReadOptions], Volume]] = {
    **dict.fromkeys((".mha", ".mhd"), metaimage.read),
    **dict.fromkeys((".nii", ".nii.gz", ".hdr", ".img"), nifti.read),
    **dict.fromkeys((".nrrd", ".nhdr"), nrrd.read),
    **dict.fromkeys((".tif", ".tiff"), tiff.read),
    **dict.fromkeys((".h5", ".hdf5"), hdf5.read),
    ".png": png.read,
    ".zarr": zarr_store.read,
    ome_zarr.ENDING: ome_zarr.read,
    **dict.fromkeys((".dcm", ".dicom", ".ima"), dicom.read),
}
VOLUME_WRITERS: dict[str, Callable[..., Path]] = {
    **dict.fromkeys((".mha", ".mhd"), metaimage.write),
    **dict.fromkeys((".nii", ".nii.gz"), nifti.write),
    ".nrrd": nrrd.write,
    **dict.fromkeys((".tif", ".tiff"), tiff.write),
    **dict.fromkeys((".h5", ".hdf5"), hdf5.write),
    ".zarr": zarr_store.write,
    ome_zarr.ENDING: ome_zarr.write,
}
_VECTOR_READERS: dict[str, Callable[[Path, ReadOptions], tuple[FloatArray, Volume]]] = {
    **dict.fromkeys((".mha", ".mhd"), metaimage.read_vectors),
    **dict.fromkeys((".nii", ".nii.gz"), nifti.read_vectors),
    **dict.fromkeys((".nrrd", ".nhdr"), nrrd.read_vectors),
}
_BOX_READERS: dict[str, Callable[[Path, ArrayLike, ArrayLike, ReadOptions], Volume]] = {
    **dict.fromkeys((".h5", ".hdf5"), hdf5.read_box),
    ".zarr": zarr_store.read_box,
}
_STORES = (".zarr", ome_zarr.ENDING)  # folders that are one volume
_VECTOR_WRITERS = {".mha": metaimage.write, ".mhd": metaimage.write, ".nrrd": nrrd.write, ome_zarr.ENDING: ome_zarr.write}
_RAW = (".raw", ".bin", ".vol")
_HDF5 = (".h5", ".hdf5")
_OPENERS: dict[str, Callable[[Path], ChunkedVolume]] = {
    ".zarr": zarr_store.open_chunked,
    ome_zarr.ENDING: ome_zarr.open_levels,
    **dict.fromkeys(_HDF5, hdf5.open_chunked),
}


def read_volume(
    path: str | os.PathLike[str],
    *,
    series: str | None = None,
    spacing_mm: ArrayLike | None = None,
    unit_mm: float | None = None,
    rescaled: bool = False,
    missing: bool = False,
) -> Volume:
    """Read an image volume with its geometry.

    Parameters
    ----------
    path : path-like
        MetaImage (``.mha``, ``.mhd``), NIfTI (``.nii``, ``.nii.gz``), NRRD (``.nrrd``, ``.nhdr``), TIFF stack (``.tif``), HDF5 (``.h5``,
        see `naibu.io.image_formats.hdf5`), Zarr (``.zarr``, see `naibu.io.image_formats.zarr_store`), a DICOM file, or a folder with the
        slices of a DICOM series or of a TIFF stack.
    series : str, optional
        Series to read from a folder with several: its SeriesInstanceUID or its description.
    spacing_mm : array_like, shape (3,), optional
        Voxel spacing along x, y, z, mm, for files that do not state it (most TIFF stacks).
    unit_mm : float, optional
        Length of the file's unit, mm: 1000 for metres. By default the unit that the file states, else mm.
    rescaled : bool
        Whether to apply the rescale slope and intercept of DICOM and NIfTI files (to obtain CT numbers in HU, for example). By default the
        stored values are returned, but of slices that have different ones, as in PET, which are not comparable without.
    missing : bool
        Whether voxels may be NaN, as outside of a field of view.

    Returns
    -------
    Volume
        Intensities in the type of the file; a single plane gives a volume of one slice.

    Raises
    ------
    InputError
        No such file, an unsupported format, a damaged file, several time points or channels, a missing slice, mixed series, slices that are
        not orthogonal, or an unknown voxel spacing.
    MissingDependencyError
        The package that reads the format is not installed.
    """
    source = require_usable_path(path)
    reader = _reader(source)
    spacing = None if spacing_mm is None else np.asarray(spacing_mm, dtype=float)
    if spacing is not None and (spacing.shape != (3,) or not (np.isfinite(spacing).all() and (spacing > 0.0).all())):
        raise InputError(f"spacing_mm must be three positive numbers (x, y, z), not {spacing.tolist()}")
    if unit_mm is not None:
        require_positive("unit_mm, the length of the file's unit,", unit_mm, "mm (1000 for metres)")
    with guarded_reading(source):
        volume = reader(source, ReadOptions(unit_mm, spacing, series, rescaled))
    if not missing and volume.values.dtype.kind == "f" and np.isnan(volume.values).any():
        bad = tuple(int(i) for i in np.argwhere(np.isnan(volume.values))[0])
        raise InputError(f"{source}: voxel {bad} (z, y, x) is nan; mask or repair it")
    return volume


def write_volume(path: str | os.PathLike[str], volume: Volume, *, compressed: bool = True) -> Path:
    """Write an image volume with its geometry; an existing file is replaced only when the new one is complete.

    Parameters
    ----------
    path : path-like
        ``.mha``, ``.mhd``, ``.nii``, ``.nii.gz``, ``.nrrd``, ``.tif``, ``.h5``, ``.zarr`` or, for napari and neuroglancer, ``.ome.zarr``.
    volume : Volume
        Image to write; booleans are stored as 0 and 1.
    compressed : bool
        Whether to compress the values (lossless), where the format leaves the choice.

    Raises
    ------
    InputError
        An unsupported format, a value type that the format lacks, or a file that cannot be written.
    MissingDependencyError
        The package that writes the format is not installed.
    """
    return _of(VOLUME_WRITERS, Path(path), "write")(Path(path), volume.values, volume, compressed=compressed)


def read_displacement(path: str | os.PathLike[str]) -> tuple[FloatArray, Volume]:
    """Read a displacement field on the voxels of a volume.

    Parameters
    ----------
    path : path-like
        ``.mha``, ``.mhd`` or ``.nrrd`` with three components per voxel, as ITK, elastix and 3D Slicer write them, or ``.nii`` and
        ``.nii.gz`` of five axes, as ANTs writes them.

    Returns
    -------
    displacement : ndarray, shape (nz, ny, nx, 3), float64
        Displacement along x, y, z, mm; NaN where undefined.
    grid : Volume
        Grid of the field; its values are true where all components are finite.

    Raises
    ------
    InputError
        A file without three-component vectors, or one that cannot be read.
    """
    reader = _of(_VECTOR_READERS, Path(path), "read displacement fields from")
    with guarded_reading(path):
        return reader(Path(path), ReadOptions())


def write_displacement(path: str | os.PathLike[str], displacement: ArrayLike, grid: Volume, *, compressed: bool = True) -> Path:
    """Write a displacement field as a vector image that opens in 3D Slicer and ParaView, or in napari and neuroglancer.

    Parameters
    ----------
    path : path-like
        ``.mha``, ``.mhd`` or ``.nrrd``; ``.ome.zarr`` with the components as channels.
    displacement : array_like, shape (nz, ny, nx, 3)
        Displacement along x, y, z, mm; stored in single precision.
    grid : Volume
        Grid of the field.
    compressed : bool
        Whether to compress the values (lossless).

    Raises
    ------
    InputError
        Another shape, a format without vector images, or a file that cannot be written.
    """
    vectors = np.asarray(displacement, dtype=np.float32)
    if vectors.shape != (*grid.shape, 3):
        raise InputError(f"displacement must have shape {(*grid.shape, 3)} (z, y, x, component), mm, not {vectors.shape}")
    return _of(_VECTOR_WRITERS, Path(path), "write displacement fields to")(Path(path), vectors, grid, compressed=compressed)


def read_volume_box(path: str | os.PathLike[str], low: ArrayLike, high: ArrayLike) -> Volume:
    """Read a box of voxels from a volume stored as HDF5 or Zarr without reading the rest.

    Parameters
    ----------
    path : path-like
        ``.h5``, ``.hdf5`` or ``.zarr``.
    low, high : array_like, shape (3,)
        Index of the first voxel, and of the one after the last, along x, y, z.

    Raises
    ------
    InputError
        Another format, a box outside the volume, or a file that cannot be read.
    """
    source = Path(path)
    if _ending(source) not in _BOX_READERS:
        raise InputError(f"{source.name}: only HDF5 and Zarr volumes can be read in parts; convert it once with write_volume to .h5")
    with guarded_reading(source):
        return _BOX_READERS[_ending(source)](source, low, high, ReadOptions())


def open_volume(path: str | os.PathLike[str], *, spacing_mm: ArrayLike | None = None) -> ChunkedVolume:
    """Open an out-of-core volume: only the voxels that are sliced are read (see `naibu.imaging.out_of_core`).

    Parameters
    ----------
    path : path-like
        ``.zarr``, ``.ome.zarr``, ``.h5``, ``.hdf5``, ``.tif``, ``.tiff``, or a folder of TIFF slices. Volumes in HDF5 cannot be sent to the
        workers of a cluster; Zarr can.
    spacing_mm : array_like, shape (3,), optional
        Voxel spacing along x, y, z, mm, for TIFF and HDF5 files that do not state it.

    Raises
    ------
    InputError
        Another format, no such store, or one that is no volume.
    MissingDependencyError
        The package that reads the format is not installed.
    """
    source = Path(path)
    spacing = None if spacing_mm is None else np.asarray(spacing_mm, dtype=float)
    ending = _ending(source)
    if spacing is not None and (spacing.shape != (3,) or not (np.isfinite(spacing).all() and (spacing > 0.0).all())):
        raise InputError(f"spacing_mm must be three positive numbers (x, y, z), not {spacing.tolist()}")
    with guarded_reading(source):
        if ending in (".tif", ".tiff") or (source.is_dir() and ending not in _OPENERS):
            return tiff_stack.open_stack(source, spacing)
        if ending not in _OPENERS:
            raise InputError(
                f"{source.name}: only Zarr, HDF5 and TIFF volumes can be opened out of core; convert it once with write_volume to .zarr"
            )
        return hdf5.open_chunked(source, spacing) if ending in _HDF5 else _OPENERS[ending](source)


def can_be_opened(path: str | os.PathLike[str]) -> bool:
    """Return whether `open_volume` opens files of this kind, so that they need not be read whole."""
    source = Path(path)
    if source.is_dir() and _ending(source) not in _OPENERS:
        return not _is_dicom(source)
    return _ending(source) in (*_OPENERS, ".tif", ".tiff")


def _reader(source: Path) -> Callable[[Path, ReadOptions], Volume]:
    """Return the reader of a file or folder."""
    if source.is_dir() and _ending(source) not in _STORES:
        return dicom.read if _is_dicom(source) else tiff.read
    if _is_dicom(source):
        return dicom.read
    if not (source.suffix or source.exists()):
        raise InputError(f"{source}: there is no such file or folder; check the path")
    if source.suffix.lower() in _RAW:
        raise without_header(source)
    return _of(VOLUME_READERS, source, "read")


def _ending(path: Path) -> str:
    name = path.name.lower()
    return next((ending for ending in (".nii.gz", ome_zarr.ENDING) if name.endswith(ending)), path.suffix.lower())


def _of(formats: dict[str, _Handler], path: Path, what: str) -> _Handler:
    """Return the entry for the extension of a file name."""
    ending = _ending(path)
    if ending not in formats:
        raise InputError(f"{path.name}: naibu does not {what} files ending in {ending!r}; supported are {', '.join(sorted(formats))}")
    return formats[ending]


def _is_dicom(path: Path) -> bool:
    """Whether a folder contains DICOM files, or a file is one whatever its extension."""
    if path.is_dir() and _ending(path) not in _STORES:
        return any(dicom.is_dicom(file) for file in path.rglob("*") if file.is_file())
    return _ending(path) not in VOLUME_READERS and dicom.is_dicom(path)
