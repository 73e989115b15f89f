"""Global digital volume correlation of volumes larger than memory: the method of `naibu.imaging.correlate_volumes`, from blocks of voxels.

The unknowns of that method, the coefficients of splines on a grid with some twelve cells along the object, do not grow with the number of
voxels. Only what the voxels contribute to their normal equations is computed block by block, each from its own part of the volumes, and
added: this is a domain decomposition of the data, and the equations are solved for the whole object at once, so that there are no borders
between blocks whose displacement has to be matched. The start is the solution for every so many voxels of the smoothed volumes, in memory.
Weights of penalties follow from the normal equations of all voxels, between the passes through the volumes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.chunked_volume import ChunkedVolume
from naibu.core.errors import InputError
from naibu.core.progress import Progress, report_progress
from naibu.core.volume import Volume
from naibu.imaging.large_volumes.block_frame import Block, BlockFrame, blocks_of
from naibu.imaging.large_volumes.block_sums import ComparedBlock, Stage, compared_block
from naibu.imaging.large_volumes.summed_equations import Model, SummedEquations
from naibu.imaging.large_volumes.thinning import (
    COARSE_VOXELS,
    SMOOTHING,
    slabs_of,
    thinned,
    thinned_slab_of_pair,
    thinning_factor,
    with_thinned_values,
)
from naibu.imaging.preprocessing.field_of_view import fields_of_view
from naibu.imaging.preprocessing.volume_pair import require_known
from naibu.imaging.volume_correlation.correlate import DEFAULT, Correlation
from naibu.imaging.volume_correlation.image_level import ImageLevel
from naibu.imaging.volume_correlation.results.correlation_result import CorrelationResult
from naibu.imaging.volume_correlation.settings import CorrelationSettings

EDGE = 128  # voxels along a block, which take some 500 MB
LEAST_VOXELS = 2.0  # coarse voxels along a cell of the grid
TOUCHED = 0.05  # of a coarse voxel, in the object, from which it is in the coarse mask: no cell of the object is left out
PROBED = 6  # blocks from which the residual SD is estimated before the first
T = TypeVar("T")


class Runner(Protocol):
    """Computes what is done for every block, and may keep what was computed."""

    def kept(self, name: str, compute: Callable[[], T]) -> T:
        """Return what `compute` returns, or what it returned in an interrupted run."""

    def each(self, name: str, function: Callable[..., T], shared: Sequence[Any], items: Sequence[Any]) -> Iterable[T]:
        """Yield ``function(reference, deformed, mask, *shared, item)`` for all items, in their order."""


class InProcess:
    """Computes one block after the other, in this process.

    Parameters
    ----------
    reference, deformed : ChunkedVolume
        Volumes.
    mask : ChunkedVolume, optional
        Of the object.
    """

    def __init__(self, reference: ChunkedVolume, deformed: ChunkedVolume, mask: ChunkedVolume | None = None) -> None:
        self._volumes = reference, deformed, mask

    def kept(self, name: str, compute: Callable[[], T]) -> T:
        """Compute it."""
        return compute()

    def each(self, name: str, function: Callable[..., T], shared: Sequence[Any], items: Sequence[Any]) -> Iterator[T]:
        """Compute one item after the other."""
        for item in items:
            yield function(*self._volumes, *shared, item)


@dataclass(frozen=True, slots=True, eq=False)
class BlockwiseCorrelation:
    """Displacement field of a volume larger than memory.

    Attributes
    ----------
    result : CorrelationResult
        Splines, covariance and convergence, and the displacement at the voxels of the coarse volume.
    frame : BlockFrame
        How the voxels of the volume lie in it: what `naibu.imaging.large_volumes.field_blocks.field_block` needs.
    coarse : tuple of Volume
        Every `frame.factor` voxels of both volumes, smoothed.
    passes : int
        Passes through the volumes.
    blocks : int
        Number of blocks.
    """

    result: CorrelationResult
    frame: BlockFrame
    coarse: tuple[Volume, Volume]
    passes: int
    blocks: int


def correlate_blocks(
    reference: ChunkedVolume,
    deformed: ChunkedVolume,
    *,
    mask: ChunkedVolume | None = None,
    deformed_mask: ChunkedVolume | None = None,
    settings: CorrelationSettings = DEFAULT,
    factor: int | None = None,
    edge: int = EDGE,
    runner: Runner | None = None,
    progress: Progress | None = None,
) -> BlockwiseCorrelation:
    """Measure the displacement of an object by global digital volume correlation (DVC), block by block.

    Parameters
    ----------
    reference, deformed : ChunkedVolume
        Volumes before and after the deformation, on one grid.
    mask, deformed_mask : ChunkedVolume, optional
        Not zero in the object; by default it is found in the coarse volumes. A coarse voxel belongs to it where any of it does.
    settings : CorrelationSettings
        As of `naibu.imaging.correlate_volumes`.
    factor : int, optional
        Voxels along the edge of a voxel of the coarse volume; by default so many that it has some 2.5 million, or fewer where cells of the
        default grid would else be too small for it.
    edge : int
        Voxels along a block. A block of 128 takes some 500 MB.
    runner : Runner, optional
        Where blocks are computed; by default here, one after the other.
    progress : Progress, optional
        Called at every step.

    Raises
    ------
    InputError
        As `naibu.imaging.correlate_volumes`.

    Notes
    -----
    Rigid inclusions have the motion that is found in the coarse volume. Results do not depend on the order in which blocks are computed.
    """
    if edge < 1 or (factor is not None and factor < 1):
        raise InputError(f"edge and factor must be 1 or more voxels, not {edge} and {factor}")
    for name, other in (("deformed", deformed), ("mask", mask), ("deformed_mask", deformed_mask)):
        if other is not None and (different := reference.grid.grid_difference(other.grid)):
            raise InputError(f"reference and {name} lie on different grids: {different}; resample {name} to the grid of reference first")
    run = runner or InProcess(reference, deformed, mask)

    def start() -> tuple[Correlation, int]:
        return _coarsely((reference, deformed), (mask, deformed_mask), settings, factor, run, progress)

    coarse, used = run.kept("coarse", start)
    equations = SummedEquations(coarse, reference, used)
    result, passes, blocks = _refine(equations, edge, run, progress)
    return BlockwiseCorrelation(result, equations.frame, (coarse.volume, coarse.deformed_volume), passes, blocks)


def _refine(equations: SummedEquations, edge: int, run: Runner, progress: Progress | None) -> tuple[CorrelationResult, int, int]:
    """Pass through the volumes until the steps are short, and once more for the covariance; return result, passes and blocks."""
    frames = equations.frames
    blocks: list[Block] = []

    def compared(name: str, stage: Stage, frame: BlockFrame, some: list[Block]) -> Iterable[ComparedBlock | None]:
        edges = tuple(max(b.high[a] - b.low[a] for b in blocks) for a in range(3))
        return run.each(name, compared_block, (frame, equations.state(stage, edges)), some)

    for done, frame in enumerate(frames):
        if done == 0 or frame is not frames[done - 1]:
            blocks = blocks_of(frame, edge)
            probed = blocks[:: max(1, len(blocks) // PROBED)]
            # the residual SD is that of the resolution
            equations.model = run.kept(
                f"noise {done + 1}", partial(_with_noise, equations, partial(compared, f"noise {done + 1}", "noise", frame, probed))
            )
        name = f"pass {done + 1}"
        report_progress(progress, f"{name} through the volumes")
        equations.model = run.kept(name, partial(_stepped, equations, partial(compared, name, "step", frame, blocks)))
        if equations.model.settled:
            break
    report_progress(progress, "pass for the covariance")
    found = run.kept("covariance", lambda: equations.result(compared("covariance", "covariance", equations.frame, blocks)))
    return found, equations.model.passes + 1, len(blocks)


def _with_noise(equations: SummedEquations, compared: Callable[[], Iterable[ComparedBlock | None]]) -> Model:
    return equations.with_noise_of(compared())


def _stepped(equations: SummedEquations, compared: Callable[[], Iterable[ComparedBlock | None]]) -> Model:
    return equations.stepped(compared())


def _coarsely(
    volumes: tuple[ChunkedVolume, ChunkedVolume],
    masks: tuple[ChunkedVolume | None, ChunkedVolume | None],
    settings: CorrelationSettings,
    factor: int | None,
    run: Runner,
    progress: Progress | None,
) -> tuple[Correlation, int]:
    """Return the correlation of the coarse volumes, all but its covariance, and the factor by which they are coarser."""
    used = thinning_factor(volumes[0].shape) if factor is None else factor
    report_progress(progress, f"coarse volumes, every {used} voxels")
    correlation = _correlation(volumes, masks, settings, used, run, progress)
    if factor is None and used > 1:
        # the cells of the grid must not be larger than those in memory would be, where a larger coarse volume can be afforded
        affordable = thinning_factor(volumes[0].shape, 4 * COARSE_VOXELS)
        wanted = max(int(used * _voxels_in_cells(correlation)), affordable, 1)
        if wanted < used:
            used = wanted
            correlation = _correlation(volumes, masks, settings, used, run, progress)
    _require_cells(correlation, used)
    correlation.initialize()
    correlation.refine()
    correlation.find_inclusions(None)
    correlation.follow_inclusions()
    correlation.progress = None
    return correlation, used


def _correlation(
    volumes: tuple[ChunkedVolume, ChunkedVolume],
    masks: tuple[ChunkedVolume | None, ChunkedVolume | None],
    settings: CorrelationSettings,
    factor: int,
    run: Runner,
    progress: Progress | None,
) -> Correlation:
    small = _thinned_pair(volumes, factor, run)
    for name, volume, view in zip(("reference", "deformed"), small, fields_of_view(small[0], small[1]), strict=True):
        require_known(volume, view, name, factor)
    shown: list[ArrayLike | None] = [None if m is None else thinned(m, factor, filled=True).values > TOUCHED for m in masks]
    kind = Correlation if factor == 1 else _ThinnedCorrelation
    return kind(small[0], small[1], (shown[0], shown[1]), settings, progress)


def _thinned_pair(volumes: tuple[ChunkedVolume, ChunkedVolume], factor: int, run: Runner) -> tuple[Volume, Volume]:
    slabs = slabs_of(volumes[0].shape, factor)
    items = [(which, slab) for which in range(2) for slab in slabs]
    name = f"every {factor} voxels"
    parts = run.kept(f"{name}, volumes", lambda: list(run.each(name, thinned_slab_of_pair, (factor,), items)))
    first, second = parts[: len(slabs)], parts[len(slabs) :]
    return with_thinned_values(volumes[0], factor, first), with_thinned_values(volumes[1], factor, second)


class _ThinnedCorrelation(Correlation):
    """Correlation of volumes that were smoothed before they were thinned out."""

    def level(self, stride: tuple[int, ...], smoothing: float) -> ImageLevel:
        """Return the voxels at a resolution, smoothed by what they are not yet."""
        every = np.asarray(stride, dtype=float)[::-1]
        left = np.sqrt(np.maximum((smoothing * every) ** 2 - SMOOTHING**2, 0.0)) / every
        return ImageLevel(self.reference, self.deformed, self.mask, self.spacing, stride, left, self.views)


def _voxels_in_cells(correlation: Correlation) -> float:
    """Return the size of the cells that the settings want, over that which the voxels of the coarse volume allow."""
    s, voxel = correlation.settings, float(np.prod(correlation.spacing)) ** (1.0 / 3.0)
    wanted = s.node_spacing_mm or voxel * float(correlation.mask.sum()) ** (1.0 / 3.0) / s.cells_along
    return float(wanted / (s.voxels_per_cell * voxel))


def _require_cells(correlation: Correlation, factor: int) -> None:
    """Refuse a spacing of nodes that the coarse volume cannot have.

    Raises
    ------
    InputError
        Cells of less than two coarse voxels.
    """
    least = LEAST_VOXELS * float(np.prod(correlation.spacing)) ** (1.0 / 3.0)
    if correlation.settings.node_spacing_mm is not None and correlation.settings.node_spacing_mm < least:
        raise InputError(
            f"node_spacing_mm = {correlation.settings.node_spacing_mm:g} is too small for coarse voxels of {factor} voxels; give at least "
            f"{least:.3g} mm, or a smaller factor, which takes more memory"
        )
