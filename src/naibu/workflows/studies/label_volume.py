"""Volumes of labels that studies name."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.io.files.reading import guarded_reading, require_regular
from naibu.io.images import read_volume
from naibu.io.study_schemas.lattice_study_schema import ObjectTable


def label_volume(path: Path, file: Path, table: ObjectTable) -> Volume:
    """Read labels; an array of NumPy has the axes x, y, z. `path` is only named in errors.

    Raises
    ------
    InputError
        A file that cannot be read, or an array without the size of its voxels.
    """
    place = f"{path}: [object] labels = {table.labels!r}"
    if file.suffix != ".npy":
        try:
            return read_volume(file, spacing_mm=table.voxel_mm)
        except InputError as error:
            raise InputError(f"{place}: {error}") from error
    if table.voxel_mm is None:
        raise InputError(f"{place}: an array does not state its voxel size; add voxel_mm = [1.0, 1.0, 1.0]")
    try:
        require_regular(file)
        with guarded_reading(file, "an array of NumPy"):
            # of a memory map the announced size is checked against that of the file
            values = np.load(file, mmap_mode="r", allow_pickle=False)
            return Volume.from_array(np.array(values).T, spacing_mm=table.voxel_mm)
    except InputError as error:
        raise InputError(f"{place}: {error}; save the labels by numpy.save, with the axes x, y, z") from error
