"""Block matching: the displacement of every voxel by full search :cite:p:`hirai2008` (chapter 3.5, equations 3.38 to 3.40)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from naibu.core.arrays import BoolArray, Float32Array, FloatArray, Int32Array, IntArray
from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.imaging.dense_matching._block_kernels import NCC, SAD, SSD, between_voxels, full_search
from naibu.imaging.preprocessing.resampling import require_mask
from naibu.imaging.preprocessing.volume_pair import intensity_pair, to_millimetres

Measure = Literal["sad", "ssd", "ncc"]
MEASURES: dict[Measure, int] = {"sad": SAD, "ssd": SSD, "ncc": NCC}
# intensities per task of a thread, few enough to stay in the first-level cache: 12 kB of single precision
VALUES_AT_ONCE = 3000


def block_matching(
    reference: Volume,
    deformed: Volume,
    *,
    block: ArrayLike = (3, 3, 3),
    search: ArrayLike = (15, 15, 1),
    measure: Measure = "sad",
    sub_voxel: bool = True,
    least_range: float = 0.0,
    unmeasured: Literal["nan", "zero"] = "nan",
    mask: ArrayLike | None = None,
) -> DisplacementField:
    """Return the displacement of every voxel by block matching: full search for the most similar block.

    Parameters
    ----------
    reference, deformed : Volume
        The image pair, on one grid; a volume of one slice is an image.
    block : array_like, shape (3,)
        Size of the block along x, y, z, voxels, odd. The report: 3 x 3 x 3, or 5 x 5 in images.
    search : array_like, shape (3,)
        Largest displacement along x, y, z, voxels, 0 or more. The report: 15, 15, 1, or 30, 35 in images.
    measure : {"sad", "ssd", "ncc"}
        Sum of absolute (3.38) or squared (3.39) differences, or normalised cross-correlation (3.40), which is invariant to gain and offset.
    sub_voxel : bool
        Whether the minimum of a quadratic function through the costs of neighbouring displacements is taken; through their squares for
        absolute differences, which grow linearly with distance.
    least_range : float
        Intensity range that a block must exceed to be measured.
    unmeasured : {"nan", "zero"}
        Displacement of voxels that are not measured; the report takes zero.
    mask : array_like, shape (nz, ny, nx), optional
        Voxels to measure; by default all.

    Returns
    -------
    DisplacementField
        Displacement, mm; its quality is the mean absolute or squared intensity difference, or the correlation. Voxels whose block leaves
        the volume are not measured.

    Raises
    ------
    InputError
        Volumes on different grids or without contrast, sizes that are not odd whole numbers or too large, an unknown measure, an empty
        mask, or no block with enough contrast.
    """
    if measure not in MEASURES or unmeasured not in ("nan", "zero"):
        raise InputError(f"measure must be one of {', '.join(MEASURES)} and unmeasured 'nan' or 'zero', not {measure!r} and {unmeasured!r}")
    a, b = intensity_pair(reference, deformed)
    chosen = Search.of(measure, block, search, reference.shape, reference.spacing_mm, sub_voxel)
    half = chosen.half
    # a range with unknown voxels in it is unknown
    wanted = np.asarray(intensity_range(reference, 2 * half + 1) > least_range)
    if mask is not None:
        wanted &= require_mask(mask, reference)
    if not wanted.any():
        raise InputError(
            f"no block of {(2 * half + 1).tolist()} voxels in the mask has an intensity range above {least_range:g}: lower least_range"
        )
    move, cost = matched(a, b, wanted, chosen)
    vectors, valid = to_millimetres(move, reference), np.isfinite(move[0])
    if unmeasured == "zero":
        vectors[~valid] = 0.0
    return DisplacementField.on_grid(reference, vectors, valid=valid, quality=-cost if measure == "ncc" else cost)


@dataclass(frozen=True, slots=True, eq=False)
class Search:
    """Parameters of a full search.

    Attributes
    ----------
    kind : int
        Measure: `SAD`, `SSD` or `NCC`.
    half, reach : ndarray, shape (3,), int64
        Half the block and largest displacement along x, y, z, voxels.
    spacing_mm : ndarray, shape (3,)
        Of the voxels, mm.
    sub_voxel : bool
        Whether the displacement is refined between voxels.
    spread : float, optional
        Standard deviation of all intensities, relative to which a block counts as uniform; by default that of the voxels given.
    """

    kind: int
    half: IntArray
    reach: IntArray
    spacing_mm: FloatArray
    sub_voxel: bool
    spread: float | None = None

    @classmethod
    def of(
        cls,
        measure: Measure,
        block: ArrayLike,
        search: ArrayLike,
        shape: tuple[int, int, int],
        spacing_mm: FloatArray,
        sub_voxel: bool,
        spread: float | None = None,
    ) -> Search:
        """Return the parameters, checked for a volume of shape (nz, ny, nx); see `block_matching`."""
        half, reach = _sizes(block, search, shape)
        return cls(MEASURES[measure], half, reach, spacing_mm, sub_voxel, spread)


def matched(a: Float32Array, b: Float32Array, wanted: BoolArray, search: Search) -> tuple[FloatArray, FloatArray]:
    """Return displacement (3, nz, ny, nx), voxels along x, y, z, and cost (nz, ny, nx) of wanted voxels; NaN elsewhere."""
    kind, half, reach = search.kind, search.half, search.reach
    move, cost = np.full((3, *a.shape), np.nan), np.full(a.shape, np.nan)
    if not wanted.any():
        return move, cost
    offsets = _offsets(reach, search.spacing_mm)
    which = np.full(a.shape, -1, dtype=np.int32)
    box = _reached(wanted, half + reach)
    which[box] = _search(search, a[box], b[box], offsets, wanted[box])
    which[~wanted] = -1
    between_voxels(kind, a, b, half, offsets, which, search.sub_voxel, move, cost)
    return move, cost


def intensity_range(volume: Volume, block: ArrayLike) -> FloatArray:
    """Return the intensity range (nz, ny, nx) of the block about every voxel.

    Parameters
    ----------
    volume : Volume
        Intensities.
    block : array_like, shape (3,)
        Size of the block along x, y, z, voxels.
    """
    size = tuple(int(n) for n in np.asarray(block)[::-1])
    values = np.asarray(volume.values, dtype=np.float64)
    return np.asarray(ndimage.maximum_filter(values, size) - ndimage.minimum_filter(values, size))


def _sizes(block: ArrayLike, search: ArrayLike, shape: tuple[int, int, int]) -> tuple[IntArray, IntArray]:
    size, reach = np.asarray(block), np.asarray(search)
    for values, name, least in ((size, "block", 1), (reach, "search", 0)):
        if values.shape != (3,) or values.dtype.kind not in "iu" or (values < least).any():
            raise InputError(f"{name} must be three whole numbers of voxels along x, y, z, at least {least}, not {values.tolist()}")
    if (size % 2 == 0).any():
        raise InputError(f"block must be odd along every axis, as a voxel is its centre, not {size.tolist()}")
    active = np.array(shape[::-1]) > 1
    size, reach = np.where(active, size, 1), np.where(active, reach, 0)
    if (size > shape[::-1]).any():
        raise InputError(f"block is {size.tolist()} voxels; it must fit into the volume of {list(shape[::-1])}")
    return (size // 2).astype(np.int64), reach.astype(np.int64)


def _offsets(reach: IntArray, spacing_mm: FloatArray) -> IntArray:
    """Return all displacements (m, 3), voxels, the shortest first, so that it wins among equal costs."""
    axes = np.meshgrid(*(np.arange(-r, r + 1) for r in reach), indexing="ij")
    offsets = np.stack(axes, axis=-1).reshape(-1, 3)
    return np.ascontiguousarray(offsets[np.argsort(np.linalg.norm(offsets * spacing_mm, axis=1), kind="stable")])


def _reached(wanted: BoolArray, margin: IntArray) -> tuple[slice, slice, slice]:
    """Return the box of all voxels that the wanted ones are compared with."""
    where = [np.flatnonzero(np.any(wanted, axis=tuple(a for a in range(3) if a != axis))) for axis in range(3)]
    first, second, third = (slice(max(int(w[0] - m), 0), int(w[-1] + m + 1)) for w, m in zip(where, margin[::-1], strict=True))
    return first, second, third


def _search(search: Search, a: Float32Array, b: Float32Array, offsets: IntArray, wanted: BoolArray) -> Int32Array:
    """Return the index (nz, ny, nx) of the best offset, -1 where there is none."""
    kind, half, reach = search.kind, search.half, search.reach
    nz, ny, nx = a.shape
    spare = int(reach[0] + half[0])
    width, guard = nx + spare, (ny + 1) * (nx + spare)
    flat = [_flat(v, spare, guard, np.nan) for v in (a, b)]
    if kind == NCC:
        statistics = [np.stack([_flat(s, spare, guard, np.nan) for s in _statistics(v, half, search.spread)]) for v in (a, b)]
    else:
        statistics = [np.zeros((2, 1), dtype=np.float32)] * 2
    chunks = -(-ny // int(np.clip(VALUES_AT_ONCE // width, 8, 64)))
    rows = -(-ny // chunks)
    some = np.zeros((nz, chunks * rows), dtype=bool)
    some[:, :ny] = np.any(wanted, axis=2)
    best, which = np.full(flat[0].size, np.inf, dtype=np.float32), np.full(flat[0].size, -1, dtype=np.int32)
    layout = np.array([nz, ny, width, guard])
    busy = np.any(some.reshape(nz, chunks, rows), axis=2)
    full_search(kind, flat[0], flat[1], layout, half, offsets, busy, statistics[0], statistics[1], best, which)
    return which[guard : guard + nz * ny * width].reshape(nz, ny, width)[:, :, :nx]


def _flat(values: Float32Array, spare: int, guard: int, fill: float) -> Float32Array:
    """Return a volume as one long row, padded after every row and at both ends."""
    nz, ny, nx = values.shape
    out = np.full(2 * guard + nz * ny * (nx + spare), fill, dtype=np.float32)
    out[guard : len(out) - guard].reshape(nz, ny, nx + spare)[:, :, :nx] = values
    return out


def _statistics(values: Float32Array, half: IntArray, spread: float | None) -> Float32Array:
    """Return the mean of every block and the inverse of its standard deviation, zero for uniform blocks (2, nz, ny, nx).

    Both are NaN where a block holds unknown voxels.
    """
    size = tuple(int(n) for n in 2 * half[::-1] + 1)
    known = np.isfinite(values)
    v = np.where(known, values, 0.0).astype(float)
    mean = ndimage.uniform_filter(v, size)
    variance = ndimage.uniform_filter(v * v, size) - mean**2
    flat = variance <= 1e-10 * (float(np.var(v)) if spread is None else spread**2)
    found = np.stack([mean, np.where(flat, 0.0, 1.0 / np.sqrt(np.where(flat, 1.0, variance)))]).astype(np.float32)
    found[:, ~ndimage.minimum_filter(known, size)] = np.nan
    return found
