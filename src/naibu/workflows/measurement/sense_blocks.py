"""Measure the displacement between two scans larger than memory, block by block, from files to files."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from naibu.core.chunked_volume import ChunkedVolume
from naibu.core.errors import InputError
from naibu.core.memory import available_memory_mb
from naibu.core.progress import Progress, report_progress
from naibu.imaging.displacement.chunked_strain import COMPONENTS, ChunkedStrain
from naibu.imaging.large_volumes.correlate_blocks import EDGE, BlockwiseCorrelation, correlate_blocks
from naibu.imaging.large_volumes.field_blocks import VoxelField, boxes_of
from naibu.imaging.large_volumes.resampled_blocks import resampled_box
from naibu.imaging.large_volumes.thinning import BASE_MB, BYTES_PER_VOXEL, COARSE_VOXELS, needed_memory_mb, thinning_factor
from naibu.imaging.measure_displacement import measured_by
from naibu.imaging.preprocessing.field_of_view import Box
from naibu.imaging.preprocessing.volume_pair import other_grid
from naibu.io.files.provenance import input_record
from naibu.io.image_formats.ome_zarr import write_levels
from naibu.io.image_formats.zarr_store import create_chunked, open_array
from naibu.io.images import can_be_opened
from naibu.workflows.measurement.block_checkpoint import BlockCheckpoint, StoredVolume
from naibu.workflows.measurement.multiscale_results import FILES as LEVELS
from naibu.workflows.measurement.sense import FILES, Pair, SenseRun, common_points, recorded
from naibu.workflows.parallel.worker_count import Workers
from naibu.workflows.parallel.worker_pool import WorkerPool
from naibu.workflows.results.output_folder import no_empty_folders, output_folder

STORES = ("displacement.zarr", "standard_deviation.zarr", "mask.zarr")
CHECKPOINT = "sense.blocks"
SHARE = 0.5  # of the free memory, which is taken where none is stated
BLOCK_BYTES = 250.0  # a voxel of a block
LEAST_EDGE = 32
WRITTEN_EDGE = 128  # voxels along a box of results, a multiple of the edge of a chunk
FEWEST = 40**3  # coarse voxels
HALF = 0.5  # from which an interpolated voxel belongs to a mask


@dataclass(frozen=True, slots=True)
class MemoryPlan:
    """How a pair of volumes is measured within some memory.

    Attributes
    ----------
    needed_mb : float
        Estimate of what the measurement in memory takes, MB.
    memory_mb : float
        What it may take, MB.
    factor : int or None
        Voxels along an edge of the coarse voxels; None for as many as usual.
    edge : int
        Voxels along a block.
    """

    needed_mb: float
    memory_mb: float
    factor: int | None
    edge: int

    @property
    def by_blocks(self) -> bool:
        """Whether the measurement in memory would take too much."""
        return self.needed_mb > self.memory_mb

    @classmethod
    def of(cls, shape: tuple[int, int, int], memory_gb: float | None, processes: int = 1) -> MemoryPlan:
        """Return the plan for volumes of a shape.

        Parameters
        ----------
        shape : tuple of int
            Voxels along z, y, x.
        memory_gb : float, optional
            What the measurement may take, GB; by default half of what is free.
        processes : int
            That compute blocks at the same time.

        Raises
        ------
        InputError
            Less memory than any measurement takes.
        """
        memory = SHARE * available_memory_mb() if memory_gb is None else 1000.0 * memory_gb
        left = memory - BASE_MB * processes
        coarse, block = 0.4 * left * 2.0**20 / BYTES_PER_VOXEL, 0.4 * left / processes * 2.0**20 / BLOCK_BYTES
        if coarse < FEWEST or block < LEAST_EDGE**3:
            least = max(FEWEST * BYTES_PER_VOXEL, LEAST_EDGE**3 * BLOCK_BYTES * processes) / 2.0**20 / 0.4 + BASE_MB * processes
            number, fewer = ("1 process", "") if processes == 1 else (f"{processes} processes", ", or fewer `workers`")
            raise InputError(
                f"`memory_gb` allows {memory:.0f} MB, too little for {number}; give at least {math.ceil(least / 10.0) / 100.0:g}{fewer}"
            )
        factor = None if coarse >= COARSE_VOXELS else thinning_factor(shape, coarse)
        return cls(needed_memory_mb(shape), memory, factor, int(min(EDGE, block ** (1.0 / 3.0))))

    def told(self) -> str:
        """Return the sentence for the user."""
        return (
            f"In memory this pair would take some {self.needed_mb / 1000.0:.1f} GB, and {self.memory_mb / 1000.0:.1f} GB may be taken: it "
            "is measured block by block."
        )


def stored_shape(path: str | os.PathLike[str], spacing_mm: Sequence[float] | None = None) -> tuple[int, int, int] | None:
    """Return the number of voxels along z, y, x of a volume of a format that is read in parts, else None."""
    return _stored(path, spacing_mm).opened().shape if can_be_opened(path) else None


@no_empty_folders()
def sense_blocks(
    reference: str | os.PathLike[str],
    deformed: str | os.PathLike[str],
    *,
    mask: str | os.PathLike[str] | None = None,
    deformed_mask: str | os.PathLike[str] | None = None,
    check_points: tuple[str | os.PathLike[str], str | os.PathLike[str]] | None = None,
    spacing_mm: Sequence[float] | None = None,
    out: str | os.PathLike[str],
    plan: MemoryPlan | None = None,
    multiscale: bool = False,
    overwrite: bool = False,
    resume: bool = False,
    workers: int = 1,
    cluster: str | None = None,
    progress: Progress | None = None,
) -> SenseRun:
    """Measure the displacement between two scans by digital volume correlation, block by block, and write it.

    Parameters
    ----------
    reference, deformed : path-like
        Volumes before and after the deformation: Zarr, OME-Zarr, HDF5 and TIFF stacks are read in parts, others whole. A deformed volume
        on another grid is resampled to that of the reference first, on disk, and a warning says so.
    mask, deformed_mask, check_points, spacing_mm
        As `naibu.sense`.
    out : path-like
        Folder for ``displacement.zarr``, ``standard_deviation.zarr``, ``mask.zarr`` with all voxels, and for the files of `naibu.sense`
        with the coarse voxels of the page.
    plan : MemoryPlan, optional
        By default that of half of the free memory.
    multiscale : bool
        Whether scans, displacement and strain are also written at several resolutions, as OME-Zarr.
    overwrite : bool
        Whether results that `out` holds already are replaced.
    resume : bool
        Whether an interrupted measurement goes on from the last block that it had computed.
    workers, cluster
        See `naibu.workflows.parallel.worker_count.Workers`. Results do not depend on them.
    progress : Progress, optional
        Called at every block.

    Returns
    -------
    SenseRun
        Of the coarse voxels, with the files of all.

    Raises
    ------
    InputError
        As `naibu.sense`; also nothing to resume, or what could be resumed and is not.
    """
    where = Workers(workers, cluster)
    began = time.perf_counter()
    paths: dict[str, Any] = {"reference": reference, "deformed": deformed, "mask": mask, "deformed_mask": deformed_mask}
    stored = {role: None if path is None else _stored(path, spacing_mm) for role, path in paths.items()}
    opened = {role: None if volume is None else volume.opened() for role, volume in stored.items()}
    a, b = _required(opened["reference"]), _required(opened["deformed"])
    told = _told_grids(a, b, opened["deformed_mask"])
    plan = plan or MemoryPlan.of(a.shape, None, max(1, workers))
    points = None if check_points is None else common_points(*check_points)
    with WorkerPool() as pool:
        kept = BlockCheckpoint(
            Path(out) / CHECKPOINT, (_stored(reference, spacing_mm), _stored(deformed, spacing_mm), stored["mask"]), where, pool,
            BASE_MB + BLOCK_BYTES * plan.edge**3 / 2.0**20, progress,
        )  # fmt: skip
        folder = output_folder(out, () if resume else (*FILES, *STORES, *(LEVELS if multiscale else ())), overwrite=overwrite)
        of = {role: _identity(path, opened[role]) for role, path in paths.items() if path is not None}
        used = kept.begin(of, {"factor": plan.factor, "edge": plan.edge}, resume=resume, overwrite=overwrite)
        scans = b, opened["deformed_mask"]
        if told:
            kept, scans = _on_reference_grid(kept, a, *scans)
        try:
            found = correlate_blocks(a, scans[0], mask=opened["mask"], deformed_mask=scans[1], **used, runner=kept, progress=progress)
        except InputError as error:
            kept.forget("coarse")
            if not told:
                raise
            raise InputError(f"{error}. {told}") from error
        stores = _written(found, a, kept, folder)
    report_progress(progress, "page and figures")
    inputs = input_record({role: path for role, path in paths.items() if path is not None})
    notes = (told,) if told else ()
    pair = Pair(*found.coarse, found.frame.mask, inputs, (Path(reference).name, Path(deformed).name), None, points, notes=notes)
    measured = measured_by(found.result, found.coarse[0], found.frame.mask)
    facts = measured.facts | {"coarse_factor": found.frame.factor, "blocks": found.blocks, "passes": found.passes}
    run = recorded(pair, replace(measured, facts=facts, warnings=(*notes, *measured.warnings)), time.perf_counter() - began, folder)
    if multiscale:
        stores += _multiscale((a, scans[0]), folder)
    kept.remove()
    return replace(run, files=(*run.files, *stores))


def _told_grids(reference: ChunkedVolume, deformed: ChunkedVolume, deformed_mask: ChunkedVolume | None) -> str:
    """Say on what grid the deformed volume lies, if not on that of the reference; the mask must lie there, too."""
    if deformed_mask is not None and (different := deformed.grid.grid_difference(deformed_mask.grid)):
        raise InputError(f"deformed_mask does not lie on the grid of deformed: {different}; resample it to that grid")
    return other_grid(reference.grid, deformed.grid)


def write_resampled(reference: ChunkedVolume, deformed: ChunkedVolume, mask: ChunkedVolume | None, path: Path, box: Box) -> None:
    """Write the deformed volume at the voxels (z, y, x) of a box of the reference to a store."""
    del mask  # that of the reference
    open_array(path)[box] = resampled_box(deformed, reference, box)


def _on_reference_grid(
    kept: BlockCheckpoint, reference: ChunkedVolume, deformed: ChunkedVolume, deformed_mask: ChunkedVolume | None
) -> tuple[BlockCheckpoint, tuple[ChunkedVolume, ChunkedVolume | None]]:
    """Return the checkpoint with the deformed volume at the voxels of the reference, resampled on disk, that volume, and its mask."""
    volume, mask = kept.folder / "deformed.zarr", kept.folder / "deformed_mask.zarr"

    def created() -> bool:
        create_chunked(volume, reference)
        create_chunked(mask, reference, dtype=np.uint8)
        return True

    kept.kept("grid", created)
    boxes = boxes_of(reference.shape, WRITTEN_EDGE)
    kept.kept("resampled", lambda: sum(1 for _ in kept.each("resampled", write_resampled, (volume,), boxes)))
    moved = StoredVolume(str(volume))
    if deformed_mask is None:
        return kept.with_deformed(moved), (moved.opened(), None)

    def written() -> bool:
        for box in boxes:
            open_array(mask)[box] = resampled_box(deformed_mask, reference, box) > HALF  # false where it is not a number
        return True

    kept.kept("resampled mask", written)
    return kept.with_deformed(moved), (moved.opened(), StoredVolume(str(mask)).opened())


def write_box(
    reference: ChunkedVolume, deformed: ChunkedVolume, mask: ChunkedVolume | None, field: VoxelField, folder: Path, box: Box
) -> None:
    """Write the results of a box of voxels (z, y, x) to the stores in a folder."""
    for name, values in zip(STORES, field.in_box(box, (mask or reference).values), strict=True):
        open_array(folder / name)[box] = values


def _written(found: BlockwiseCorrelation, grid: ChunkedVolume, kept: BlockCheckpoint, folder: Path) -> tuple[Path, ...]:
    def created() -> bool:
        for name, components, dtype in zip(STORES, (3, None, None), (np.float32, np.float32, np.uint8), strict=True):
            create_chunked(folder / name, grid, dtype=dtype, components=components)
        return True

    kept.kept("stores", created)
    boxes = boxes_of(grid.shape, WRITTEN_EDGE)
    kept.kept("fields", lambda: sum(1 for _ in kept.each("fields", write_box, (VoxelField.of(found), folder), boxes)))
    return tuple(folder / name for name in STORES)


def _multiscale(scans: tuple[ChunkedVolume, ChunkedVolume], folder: Path) -> tuple[Path, ...]:
    grid, displacement = scans[0].grid, open_array(folder / STORES[0])
    return (
        *(write_levels(folder / name, scan.values, grid) for name, scan in zip(LEVELS, scans, strict=False)),
        write_levels(folder / LEVELS[2], displacement, grid, channels=("x", "y", "z")),
        write_levels(folder / LEVELS[3], ChunkedStrain.of(displacement, grid), grid, channels=COMPONENTS),
    )


def _stored(path: str | os.PathLike[str], spacing_mm: Sequence[float] | None) -> StoredVolume:
    return StoredVolume(str(Path(path).absolute()), None if spacing_mm is None else tuple(spacing_mm))


def _required(volume: ChunkedVolume | None) -> ChunkedVolume:
    if volume is None:
        raise InputError("reference and deformed are needed")
    return volume


def _identity(path: str | os.PathLike[str], volume: ChunkedVolume | None) -> list[Any]:
    """Return what tells a volume from another one, without reading it."""
    source = Path(path)
    files = [source, *(source.iterdir() if source.is_dir() else ())]
    shape = () if volume is None else volume.shape
    return [str(source.absolute()), list(shape), math.floor(max(file.stat().st_mtime for file in files))]
