"""Scans, displacement and strain of `naibu sense` at several resolutions, for napari and neuroglancer."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from naibu.imaging.displacement.chunked_strain import COMPONENTS
from naibu.imaging.displacement.strain import green_lagrange_strain_of
from naibu.io.image_formats.ome_zarr import write_levels
from naibu.workflows.measurement.sense import Pair, SenseRun
from naibu.workflows.results.output_folder import output_folder

FILES = ("reference.ome.zarr", "deformed.ome.zarr", "displacement.ome.zarr", "strain.ome.zarr")


def folder_for_multiscale(out: str | os.PathLike[str], *, overwrite: bool) -> Path:
    """Return the folder, after checking that it may get the stores; to be called before anything is computed.

    Raises
    ------
    InputError
        It holds one of them, or cannot be written to.
    """
    return output_folder(out, FILES, overwrite=overwrite)


def write_multiscale(pair: Pair, run: SenseRun, folder: Path) -> tuple[Path, ...]:
    """Write both scans, the displacement (channels x, y, z, mm) and the Green-Lagrange strain (six channels) as OME-Zarr.

    Where nothing was measured, displacement and strain are NaN.

    Parameters
    ----------
    pair : Pair
        The scans.
    run : SenseRun
        What was measured between them.
    folder : Path
        Where the stores are written.

    Raises
    ------
    InputError
        They cannot be written.
    MissingDependencyError
        The package zarr is not installed.
    """
    measured, grid = run.measured, pair.reference
    a, b = np.array([["xyz".index(axis) for axis in name] for name in COMPONENTS]).T
    strain = green_lagrange_strain_of(measured.gradient)[..., a, b].astype(np.float32)
    strain[~measured.mask] = np.nan
    return (
        write_levels(folder / FILES[0], pair.reference.values, grid),
        write_levels(folder / FILES[1], pair.deformed.values, pair.deformed),
        write_levels(folder / FILES[2], measured.displacement.vectors.astype(np.float32), grid, channels=("x", "y", "z")),
        write_levels(folder / FILES[3], strain, grid, channels=COMPONENTS),
    )
