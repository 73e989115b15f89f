"""Out-of-core imaging: methods for volumes larger than memory, block by block, on one computer or on a Dask cluster :cite:p:`rocklin2015`.

A block is read with a margin of the voxels on which its result depends, so that results are those in memory for methods of finite support:
block matching and the Harris operator. The packages of the extra ``naibu[cluster]`` are needed. Results are computed lazily: `stored`
writes them block by block, on the workers of the open `distributed.Client`, if there is one.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import AnyArray, BoolArray, IntArray
from naibu.core.chunked_volume import ChunkedVolume
from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import InputError, MissingDependencyError
from naibu.core.optional_packages import optional_package
from naibu.core.volume import Volume
from naibu.imaging.dense_matching.block_matching import Measure, Search, intensity_range, matched
from naibu.imaging.dense_matching.optical_flow import horn_schunck
from naibu.imaging.feature_matching.harris import Response, default_sigmas, known_intensities, response_of
from naibu.imaging.preprocessing.filters import REACH
from naibu.imaging.preprocessing.volume_pair import shifted_intensity, to_millimetres

Box = tuple[slice, slice, slice]
Function = Callable[..., AnyArray]
# voxels along x, y, z: 4 MB in single precision, little memory even with margin and results
BLOCK = (128, 128, 64)
# compiled kernels use all cores: two blocks at a time in one process would compete for them
_ONE_AT_A_TIME = threading.Lock()


@dataclass(frozen=True, slots=True, eq=False)
class ChunkedDisplacement:
    """Displacement field on a grid that is computed lazily, block by block.

    Attributes
    ----------
    packed : dask array, shape (nz, ny, nx, 5)
        Displacement along x, y, z, mm; 1 where it is measured, else 0; quality of the match. One computation gives all.
    grid : Volume
        Frame of the voxels.
    """

    packed: Any
    grid: Volume

    def block(self, box: Box) -> DisplacementField:
        """Compute the voxels of a box of slices along z, y, x."""
        packed = np.asarray(self.packed[box].compute(**_scheduler()))
        low, high = np.array([s.indices(n)[:2] for s, n in zip(box[::-1], self.grid.shape[::-1], strict=True)]).T
        return unpacked(packed, self.grid.cropped(low, high))

    def computed(self) -> DisplacementField:
        """Compute all voxels, into memory."""
        return self.block((slice(None), slice(None), slice(None)))


def unpacked(packed: AnyArray, grid: Volume) -> DisplacementField:
    """Return the displacement field of packed arrays (nz, ny, nx, 5) on the grid of their voxels."""
    return DisplacementField.on_grid(grid, packed[..., :3], valid=packed[..., 3] > 0.0, quality=packed[..., 4])


def map_overlapping(
    function: Function,
    volumes: Sequence[Any],
    overlap: ArrayLike,
    *,
    block: ArrayLike = BLOCK,
    aligned: int = 1,
    components: int | None = None,
    dtype: Any = np.float32,
) -> Any:
    """Apply a function to blocks of volumes, each with the voxels around it.

    Parameters
    ----------
    function : callable
        Takes one array (mz, my, mx) a volume, all of one shape, and returns values at the same voxels, (mz, my, mx) or with `components`
        (mz, my, mx, components). For a cluster it must be importable by name, or a `functools.partial` of such a one.
    volumes : sequence of arrays with slicing, shape (nz, ny, nx)
        Zarr arrays, Dask arrays, `ChunkedVolume.values`: all of one shape.
    overlap : array_like, shape (3,)
        Voxels along x, y, z around a block on which its result depends. At the faces of the volume there are fewer, so that the function
        sees the same faces as in memory.
    block : array_like, shape (3,)
        Size of a block along x, y, z without overlap; memory is needed for one block a process.
    aligned : int
        First voxels of what a block reads are multiples of this: for methods that take every second, fourth, ... voxel.
    components : int, optional
        Length of a fourth axis of the result.
    dtype : dtype
        Of the result.

    Returns
    -------
    dask array, shape (nz, ny, nx) or (nz, ny, nx, components)
        Not computed yet.

    Raises
    ------
    InputError
        No volume, shapes that differ, or invalid sizes.
    MissingDependencyError
        Dask is not installed.
    """
    dask, arrays = _dask()
    size, margin = np.asarray(block), np.asarray(overlap)
    if size.shape != (3,) or margin.shape != (3,) or (size < 1).any() or (margin < 0).any() or aligned < 1:
        raise InputError(
            f"block and overlap must be three whole numbers of voxels along x, y, z, not {size.tolist()} and {margin.tolist()}"
        )
    shapes = {tuple(v.shape) for v in volumes}
    if len(shapes) != 1 or len(next(iter(shapes))) != 3:
        raise InputError(f"volumes must have one shape (nz, ny, nx), not {sorted(shapes)}")
    shape = shapes.pop()
    size = aligned * -(-size // aligned)
    extra = () if components is None else (components,)
    counts = [-(-n // int(s)) for n, s in zip(shape, size[::-1], strict=True)]
    blocks = np.empty((*counts, *(1,) * len(extra)), dtype=object)
    work, read = dask.delayed(_trimmed, pure=True), dask.delayed(_read, pure=True)
    sources = [v if _is_lazy(v) else dask.delayed(v, pure=False) for v in volumes]
    for number in product(*(range(n) for n in counts)):
        outer, inner, own = _boxes(number, shape, size[::-1], margin[::-1], aligned)
        pieces = [v[outer] if _is_lazy(v) else read(s, outer) for v, s in zip(volumes, sources, strict=True)]
        values = work(function, inner, (*own, *extra), np.dtype(dtype), *pieces)
        blocks[(*number, *(0,) * len(extra))] = arrays.from_delayed(values, (*own, *extra), dtype=dtype)
    return arrays.block(blocks.tolist())


def chunked_harris_response(
    volume: ChunkedVolume,
    *,
    response: Response = "ratio",
    k: float = 0.05,
    gradient_sigma_mm: float | None = None,
    window_sigma_mm: float | None = None,
    block: ArrayLike = BLOCK,
) -> Any:
    """Return the response of the Harris operator as `naibu.imaging.feature_matching.harris.harris_response` gives it, block by block.

    Parameters
    ----------
    volume : ChunkedVolume
        Voxels.
    response, k, gradient_sigma_mm, window_sigma_mm
        As there.
    block : array_like, shape (3,)
        Size of a block along x, y, z, voxels.

    Returns
    -------
    dask array, shape (nz, ny, nx), float32
        The same values as in memory: bit by bit for integer intensities, to rounding for others.

    Raises
    ------
    InputError
        Invalid options, a constant volume, or when computed: unknown voxels.
    """
    if response not in ("ratio", "harris") or k < 0.0:
        raise InputError(f"response must be 'ratio' or 'harris' with k >= 0, not {response!r} with {k}")
    sigmas = default_sigmas(volume.spacing_mm, volume.shape, gradient_sigma_mm, window_sigma_mm)
    known = _moments(volume, block)
    if not known.high > known.low:
        raise InputError("volume is constant: it has no interest points")
    reach = sum(np.maximum(np.ceil(REACH * s / volume.spacing_mm), 1).astype(int) for s in sigmas) + 1
    function = partial(_harris, shift=known.mean, spacing_mm=volume.spacing_mm, sigmas=sigmas, k=k if response == "harris" else None)
    return map_overlapping(function, [volume.values], reach, block=block)


def chunked_block_matching(
    reference: ChunkedVolume,
    deformed: ChunkedVolume,
    *,
    matched_block: ArrayLike = (3, 3, 3),
    search: ArrayLike = (15, 15, 1),
    measure: Measure = "sad",
    sub_voxel: bool = True,
    least_range: float = 0.0,
    block: ArrayLike = BLOCK,
) -> ChunkedDisplacement:
    """Return the displacement as `naibu.imaging.dense_matching.block_matching.block_matching` gives it, block by block.

    Parameters
    ----------
    reference, deformed : ChunkedVolume
        Volumes before and after the deformation, on one grid.
    matched_block : array_like, shape (3,)
        Size of the compared block, `block` there, voxels along x, y, z.
    search, measure, sub_voxel, least_range
        As there.
    block : array_like, shape (3,)
        Size of a block of the computation, along x, y, z, voxels.

    Returns
    -------
    ChunkedDisplacement
        The same values as in memory: bit by bit for integer intensities, to rounding for others.

    Raises
    ------
    InputError
        Volumes on different grids or without contrast, or invalid sizes.
    """
    known = _pair(reference, deformed, block)
    spread = known[0].spread
    chosen = Search.of(measure, matched_block, search, reference.shape, reference.spacing_mm, sub_voxel, spread)
    function = partial(
        _matched,
        search=chosen,
        shift=known[0].mean,
        least_range=least_range,
        sign=-1.0 if measure == "ncc" else 1.0,
        direction=reference.direction,
    )
    overlap = chosen.half + chosen.reach + 1
    volumes = [reference.values, deformed.values]
    packed = map_overlapping(function, volumes, overlap, block=block, components=5, dtype=np.float64)
    return ChunkedDisplacement(packed, reference.grid)


def chunked_horn_schunck(
    reference: ChunkedVolume,
    deformed: ChunkedVolume,
    *,
    full_scale: float | None = None,
    levels: int = 4,
    overlap: ArrayLike = (32, 32, 32),
    block: ArrayLike = BLOCK,
    **options: Any,
) -> ChunkedDisplacement:
    """Return the displacement by Horn and Schunck (`naibu.imaging.dense_matching.optical_flow.horn_schunck`), block by block.

    Parameters
    ----------
    reference, deformed : ChunkedVolume
        Volumes before and after the deformation, on one grid.
    full_scale : float, optional
        As there; by default from at most a million voxels spread over the volume.
    levels : int
        Number of grids. Blocks begin where all of them have voxels.
    overlap : array_like, shape (3,)
        Margin of a block, voxels along x, y, z.
    block : array_like, shape (3,)
        Size of a block along x, y, z, voxels.
    **options
        `data_weight`, `iterations`, `warps`, `median_filter`, `accelerated` as there.

    Returns
    -------
    ChunkedDisplacement
        Every voxel depends on all others, but less with their distance: the result differs from that in memory by the influence from beyond
        the overlap. A block without contrast, overlap included, is not measured.

    Raises
    ------
    InputError
        Volumes on different grids or without contrast, or invalid options.
    """
    _pair(reference, deformed, block)
    scale = _range(reference) if full_scale is None else full_scale
    function = partial(
        _flow, spacing_mm=reference.spacing_mm, direction=reference.direction, options={**options, "full_scale": scale, "levels": levels}
    )
    volumes = [reference.values, deformed.values]
    packed = map_overlapping(function, volumes, overlap, block=block, aligned=2 ** (levels - 1), components=5, dtype=np.float64)
    return ChunkedDisplacement(packed, reference.grid)


def stored(arrays: Sequence[Any], targets: Sequence[Any]) -> None:
    """Compute Dask arrays and write them into Zarr arrays, HDF5 datasets or memory maps, block by block.

    Runs on the workers of the open `distributed.Client`, else in this process, one block at a time: the compiled kernels use all cores.

    Parameters
    ----------
    arrays : sequence of dask arrays
        Arrays to compute; arrays that share work are best stored together.
    targets : sequence of arrays that can be assigned to by slices
        Of the same shapes; Zarr arrays where several processes write. Chunks that divide the blocks are written without waiting.
    """
    _, dask_arrays = _dask()
    for array, target in zip(arrays, targets, strict=True):
        # two workers must not write into one chunk of the target at the same time, or one is lost
        dask_arrays.store(array, target, lock=not _chunks_divide(array, target), **_scheduler())


def _trimmed(function: Function, inner: Box, shape: tuple[int, ...], dtype: Any, *pieces: AnyArray) -> AnyArray:
    """Return the values of a function of pieces, without the overlap."""
    with _ONE_AT_A_TIME:
        values = np.asarray(function(*pieces))
    if values.shape[:3] != pieces[0].shape:
        raise InputError(f"function must return the voxels that it gets, {pieces[0].shape}, not {values.shape[:3]}")
    return np.ascontiguousarray(values[inner].reshape(shape), dtype=dtype)


def _read(source: Any, box: Box) -> AnyArray:
    return np.asarray(source[box])


def _boxes(
    number: tuple[int, ...], shape: tuple[int, ...], size: IntArray, margin: IntArray, aligned: int
) -> tuple[Box, Box, tuple[int, ...]]:
    """Return the box that block `number` reads, its own part of that box, and the shape of that part; all along z, y, x."""
    outer, inner, own = [], [], []
    for n, total, step, more in zip(number, shape, size, margin, strict=True):
        start, stop = n * int(step), min((n + 1) * int(step), total)
        low, high = max(start - int(more), 0) // aligned * aligned, min(stop + int(more), total)
        outer.append(slice(low, high))
        inner.append(slice(start - low, stop - low))
        own.append(stop - start)
    return (outer[0], outer[1], outer[2]), (inner[0], inner[1], inner[2]), tuple(own)


@dataclass(frozen=True, slots=True)
class _Moments:
    """Mean, standard deviation, least and largest of the finite intensities of a volume."""

    mean: float
    spread: float
    low: float
    high: float


def _moments(volume: ChunkedVolume, block: ArrayLike) -> _Moments:
    dask, _ = _dask()
    size = np.asarray(block)[::-1]
    v = volume.values
    parts = []
    for number in product(*(range(-(-n // int(s))) for n, s in zip(volume.shape, size, strict=True))):
        box, _, _ = _boxes(number, volume.shape, size, np.zeros(3, dtype=np.int64), 1)
        parts.append(dask.delayed(_sums)(v[box] if _is_lazy(v) else dask.delayed(_read)(v, box)))
    found = np.array(dask.compute(*parts, **_scheduler()))
    count, total, low, high = found[:, 0].sum(), math.fsum(found[:, 1]), found[:, 3].min(), found[:, 4].max()
    if not count:
        raise InputError("the volume has no finite voxel")
    mean = total / count
    square = math.fsum(found[:, 2] + found[:, 1] * (found[:, 1] / np.maximum(found[:, 0], 1.0) - 2.0 * mean)) / count + mean**2
    return _Moments(float(mean), math.sqrt(max(square, 0.0)), float(low), float(high))


def _sums(values: AnyArray) -> tuple[float, float, float, float, float]:
    """Return number and sum of the known values, the sum of squares about their own mean, the least and the largest."""
    known = values[np.isfinite(values)]
    if not known.size:
        return 0.0, 0.0, 0.0, np.inf, -np.inf
    total = float(np.sum(known, dtype=np.float64))
    about = float(np.sum((known - total / known.size) ** 2, dtype=np.float64))
    return float(known.size), total, about, float(known.min()), float(known.max())


def _pair(reference: ChunkedVolume, deformed: ChunkedVolume, block: ArrayLike) -> tuple[_Moments, _Moments]:
    """Check two volumes that are compared."""
    if different := reference.grid.grid_difference(deformed.grid):
        raise InputError(f"reference and deformed lie on different grids: {different}; resample deformed to the grid of reference first")
    known = _moments(reference, block), _moments(deformed, block)
    for name, m in zip(("reference", "deformed"), known, strict=True):
        if not m.high > m.low:
            raise InputError(f"the {name} volume is constant (every voxel is {m.low:g}): there is nothing to match; check the file")
    return known


def _range(volume: ChunkedVolume) -> float:
    """Return the intensity range without the darkest and brightest 0.5 %, from at most some million voxels."""
    step = max(1, math.ceil((math.prod(volume.shape) / 1e6) ** (1.0 / 3.0)))
    slices = (volume.block((slice(k, k + 1), slice(None), slice(None))).values[:, ::step, ::step] for k in _every(volume.shape[0], step))
    values = np.concatenate([v.ravel() for v in slices])
    low, high = np.nanpercentile(values, [0.5, 99.5])
    return float(high - low) if high > low else float(np.nanmax(values) - np.nanmin(values))


def _every(n: int, step: int) -> Iterator[int]:
    return iter(range(0, n, step))


def _harris(values: AnyArray, *, shift: float, spacing_mm: AnyArray, sigmas: tuple[float, float], k: float | None) -> AnyArray:
    return response_of(known_intensities(values, shift), spacing_mm, sigmas[0], sigmas[1], k)


def _matched(a: AnyArray, b: AnyArray, *, search: Search, shift: float, least_range: float, sign: float, direction: AnyArray) -> AnyArray:
    frame = Volume(a, search.spacing_mm, np.zeros(3), direction)
    wanted = np.asarray(intensity_range(frame, 2 * search.half + 1) > least_range)
    move, cost = matched(shifted_intensity(a, shift, "reference"), shifted_intensity(b, shift, "deformed"), wanted, search)
    return _packed(to_millimetres(move, frame), np.isfinite(move[0]), sign * cost)


def _flow(a: AnyArray, b: AnyArray, *, spacing_mm: AnyArray, direction: AnyArray, options: dict[str, Any]) -> AnyArray:
    volumes = [Volume(v, spacing_mm, np.zeros(3), direction) for v in (a, b)]
    if not (np.isfinite(a) & np.isfinite(b)).any() or any(not np.nanmax(v) > np.nanmin(v) for v in (a, b)):
        return _packed(np.full((*a.shape, 3), np.nan), np.zeros(a.shape, dtype=bool), np.full(a.shape, np.nan))
    found = horn_schunck(volumes[0], volumes[1], **options)
    return _packed(found.vectors, found.valid, found.quality)


def _packed(vectors: AnyArray, valid: BoolArray, quality: AnyArray | None) -> AnyArray:
    last = np.full(valid.shape, np.nan) if quality is None else quality
    return np.concatenate([vectors, valid[..., None].astype(float), last[..., None]], axis=-1)


def _chunks_divide(array: Any, target: Any) -> bool:
    """Whether every chunk of the target lies in one block of the array."""
    chunks = getattr(target, "chunks", None)
    if chunks is None:
        return False
    return all(all(size % int(c) == 0 for size in sizes[:-1]) for sizes, c in zip(array.chunks, chunks, strict=True))


def _is_lazy(values: Any) -> bool:
    return hasattr(values, "__dask_graph__")


def _dask() -> tuple[Any, Any]:
    purpose, extra = "working on volumes block by block", "naibu[cluster]"
    return optional_package("dask", purpose, extra), optional_package("dask.array", purpose, extra)


def _scheduler() -> dict[str, Any]:
    """Return where Dask computes: on the open cluster or as configured, else here, one block at a time."""
    dask, _ = _dask()
    return {} if dask.config.get("scheduler", None) or _has_client() else {"scheduler": "synchronous"}


def _has_client() -> bool:
    """Whether a `distributed.Client` is open."""
    try:
        client = optional_package("distributed", "a cluster", "naibu[cluster]").default_client()
    except (MissingDependencyError, ValueError):
        return False
    return client is not None
