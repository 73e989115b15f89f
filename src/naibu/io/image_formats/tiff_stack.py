"""TIFF stacks larger than memory: one slice is decoded at a time, or none where the file is not compressed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from naibu.core.arrays import AnyArray, FloatArray
from naibu.core.chunked_volume import ChunkedVolume
from naibu.core.errors import InputError
from naibu.core.optional_packages import optional_package
from naibu.io.files.reading import require_regular
from naibu.io.image_formats.geometry import no_colours
from naibu.io.image_formats.tiff import no_spacing, require_all_strips, slices_of_folder, stated_geometry


class Slices:
    """The slices of a stack as an array (nz, ny, nx) of which only what is sliced is read."""

    def __init__(self, files: list[Path], pages: list[int], shape: tuple[int, int], dtype: Any) -> None:
        self._files, self._pages = files, pages
        self.shape = (len(files), *shape)
        self.dtype = np.dtype(dtype)

    def __getitem__(self, box: Any) -> AnyArray:
        """Return a part; its first index is along z."""
        tifffile = optional_package("tifffile", "reading TIFF files")
        first, *rest = box if isinstance(box, tuple) else (box,)
        single = isinstance(first, int | np.integer)
        chosen = [int(first)] if single else list(range(*first.indices(self.shape[0])))
        planes = []
        for k in chosen:
            plane = tifffile.imread(self._files[k], key=self._pages[k])
            if plane.shape != self.shape[1:] or plane.dtype != self.dtype:
                raise InputError(
                    f"{self._files[k].name}: slice {k} is {plane.shape} of {plane.dtype}, the others {self.shape[1:]} of {self.dtype}"
                )
            planes.append(plane[tuple(rest)])
        if single:
            return np.asarray(planes[0])
        return np.stack(planes) if planes else np.empty((0, *self.shape[1:]), self.dtype)[(slice(None), *rest)]


def open_stack(path: Path, spacing_mm: FloatArray | None = None) -> ChunkedVolume:
    """Open a stack, one file or a folder of slices, without reading its voxels.

    Parameters
    ----------
    path : Path
        File or folder.
    spacing_mm : ndarray, shape (3,), optional
        Voxel spacing along x, y, z, mm, where the file states none.

    Raises
    ------
    InputError
        No stack of one channel, or no spacing.
    """
    tifffile = optional_package("tifffile", f"{path.name}: reading TIFF files")
    files = slices_of_folder(path) if path.is_dir() else [path]
    for file in files:
        require_regular(file)
    try:
        with tifffile.TiffFile(files[0]) as file:
            if not len(file.pages):
                raise InputError(f"{path.name}: contains no image; copy the file again")
            page, count = file.pages[0], len(file.pages)
            no_colours(path.name, int(page.samplesperpixel))
            require_all_strips(path.name, page)
            shape, dtype, stated = tuple(page.shape), page.dtype, stated_geometry(path.name, file, page)
            series = file.series[0]
            whole = tuple(series.shape)
            mapped = len(files) == 1 and bool(series.dataoffset) and len(whole) == 3
    except InputError:
        raise
    # tifffile's decoders raise exceptions of many types
    except Exception as error:
        raise InputError(f"{path.name}: cannot be read as TIFF ({error}); copy the file again") from error
    if len(shape) != 2:
        raise InputError(f"{path.name}: its slices have the shape {shape}, not (y, x); save one channel as a stack")
    if spacing_mm is not None:
        steps, origin = np.diag(spacing_mm), np.zeros(3)
    else:
        steps, origin = np.asarray(stated["steps"], dtype=float), np.asarray(stated["origin"], dtype=float)
    if not np.isfinite(steps).all():
        raise no_spacing(path.name, stated)
    lengths = np.linalg.norm(steps, axis=0)
    values: Any
    if mapped:
        values = tifffile.memmap(path, mode="r")
    elif len(files) > 1:
        values = Slices(files, [0] * len(files), (int(shape[0]), int(shape[1])), dtype)
    else:
        values = Slices(files * count, list(range(count)), (int(shape[0]), int(shape[1])), dtype)
    return ChunkedVolume.from_array(values, spacing_mm=lengths, origin_mm=origin, direction=steps / lengths)
