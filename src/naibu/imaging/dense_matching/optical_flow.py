"""Optical flow: the displacement of every voxel from image intensity gradients, coarse to fine.

The methods of :cite:t:`horn1981` and :cite:t:`lucas1981` in two and three dimensions, with warping and median filtering
:cite:p:`sun2010`; chapter 3.5 of :cite:t:`hirai2008` uses them on one grid.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numba
import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import BoolArray, Float32Array, IntArray
from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import InputError
from naibu.core.progress import Progress, report_progress
from naibu.core.volume import Volume
from naibu.imaging.dense_matching._optical_flow_kernels import horn_schunck_step, linearize, lucas_kanade_step
from naibu.imaging.preprocessing._filter_kernels import median, products
from naibu.imaging.preprocessing._interpolation_kernels import warp
from naibu.imaging.preprocessing.filters import box_mean
from naibu.imaging.preprocessing.pyramid import Level, coarsened, pyramid, refined
from naibu.imaging.preprocessing.resampling import require_mask
from naibu.imaging.preprocessing.volume_pair import intensity_pair, to_millimetres, to_voxels

REPORT_LEVELS = 256.0  # intensity levels of the report's images, to which its lambda refers
# Horn-Schunck as in chapter 3.5 of the report: one grid, 40 plain steps, lambda = 4
AS_REPORTED: dict[str, Any] = {"data_weight": 4.0, "iterations": 40, "warps": 1, "levels": 1, "median_filter": False, "accelerated": False}
SLOWEST = 0.99  # spectral radius that the Chebyshev acceleration assumes of the Jacobi iteration; empirical
# voxels below which starting threads costs more than they save; empirical
WORTH_SHARING = 200_000


def horn_schunck(
    reference: Volume,
    deformed: Volume,
    *,
    data_weight: float = 0.002,
    full_scale: float | None = None,
    iterations: int = 25,
    warps: int = 5,
    levels: int | None = None,
    median_filter: bool = True,
    accelerated: bool = True,
    mask: ArrayLike | None = None,
    start: ArrayLike | None = None,
    progress: Progress | None = None,
) -> DisplacementField:
    """Return the displacement by Horn-Schunck optical flow: brightness constancy with a smoothness penalty :cite:p:`horn1981`.

    Parameters
    ----------
    reference, deformed : Volume
        The image pair, on one grid; a volume of one slice is an image.
    data_weight : float
        lambda, the weight of the intensities against smoothness, for images of 256 intensity levels and lengths in voxels; above 0. The
        report's 4 suits images without noise.
    full_scale : float, optional
        Intensity range that stands for the 256 levels; above 0. By default that of the reference without its 0.5 % darkest and brightest
        voxels.
    iterations : int
        Steps of (3.56), (3.57) between two warps, 1 or more; the report takes 40 plain ones.
    warps : int
        How often, on every grid, the deformed volume is warped by the present displacement and differentiated again; 1 or more.
    levels : int, optional
        Number of grids, each twice as coarse as the next, 1 or more; by default as many as fit.
    median_filter : bool
        Whether the displacement is replaced by the median over neighbours after every warp, which removes outliers :cite:p:`sun2010`.
    accelerated : bool
        Whether the steps are accelerated by the Chebyshev semi-iterative method :cite:p:`golub1961`, which needs several times fewer.
    mask : array_like, shape (nz, ny, nx), optional
        Voxels of the reference whose intensities count; the field is continued smoothly outside.
    start : array_like, shape (nz, ny, nx, 3), optional
        Initial displacement, mm; zero by default.
    progress : callable, optional
        Called with a `naibu.core.progress.ProgressReport` before every grid, and at the end.

    Returns
    -------
    DisplacementField
        Displacement, mm; valid where the displaced voxel lies inside the deformed volume, and in the mask. Its quality is the absolute
        intensity residual.

    Raises
    ------
    InputError
        Volumes on different grids or without contrast, an empty mask, a start that is not finite, weights or numbers that are not positive.

    Notes
    -----
    ``u <- ubar - lambda grad I (grad I . ubar + I_t) / (1 + lambda |grad I|^2)``, ubar the weighted mean of the neighbours. Lengths are in
    units of the smallest spacing of the grid, and weights of neighbours are inverse to the square of their distance. In the report, the
    printed (3.52), (3.53) lack the derivative in time on the right, and (3.54) to (3.57) the factor ``lambda I_x``. The method of the
    report, for motions of up to about a voxel, is ``horn_schunck(reference, deformed, **AS_REPORTED)``.
    """
    _require_counts(iterations=iterations, warps=warps, levels=1 if levels is None else levels)
    if not (data_weight > 0.0 and (full_scale is None or full_scale > 0.0)):
        raise InputError(f"data_weight and full_scale must be positive, not {data_weight} and {full_scale}")
    a, b = intensity_pair(reference, deformed)
    scale = _range(a) if full_scale is None else full_scale
    weight = data_weight * (REPORT_LEVELS / scale) ** 2
    wanted = _wanted(mask, reference)
    grids = pyramid(a, b, wanted, reference.spacing_mm, levels)
    u = _start(start, reference, grids)
    for number, grid in enumerate(grids):
        report_progress(progress, "optical flow (Horn-Schunck)", done=number, total=len(grids))
        with _threads_worth(grid):
            if number:
                u = refined(u, grids[number - 1], grid)
            for _ in range(warps):
                u = _relaxed(u, grid, weight, iterations, accelerated)
                u = _median(u) if median_filter else u
    report_progress(progress, "optical flow (Horn-Schunck)", done=len(grids), total=len(grids))
    return _result(u, reference, a, b, wanted)


def lucas_kanade(
    reference: Volume,
    deformed: Volume,
    *,
    window: ArrayLike = (5, 5, 5),
    least_eigenvalue: float = 0.0,
    damping: float = 1.0,
    warps: int = 3,
    levels: int | None = None,
    median_filter: bool = True,
    mask: ArrayLike | None = None,
    start: ArrayLike | None = None,
    progress: Progress | None = None,
) -> DisplacementField:
    """Return the displacement by Lucas-Kanade optical flow: least squares in a window about every voxel :cite:p:`lucas1981`.

    Parameters
    ----------
    reference, deformed : Volume
        The image pair, on one grid; a volume of one slice is an image.
    window : array_like, shape (3,)
        Size of the window along x, y, z, voxels, odd.
    least_eigenvalue : float
        Windows whose structure tensor ``mean(grad I grad I^T)`` has a smaller eigenvalue than this, (intensity/mm)^2, are not measured;
        they keep the displacement of the coarser grid.
    damping : float
        Levenberg-Marquardt damping, as a fraction of the mean eigenvalue, 0 or more: directions of smaller eigenvalues stay nearer to the
        initial displacement than to the solution. The report has none.
    warps : int
        How often, on every grid, the deformed volume is warped by the present displacement and differentiated again; 1 or more.
    levels : int, optional
        Number of grids, each twice as coarse as the next, 1 or more; by default as many as fit. With ``levels=1, warps=1, damping=0,
        median_filter=False`` this is the method of the report (3.58 to 3.60).
    median_filter : bool
        As in `horn_schunck`.
    mask : array_like, shape (nz, ny, nx), optional
        Voxels of the reference whose intensities count.
    start : array_like, shape (nz, ny, nx, 3), optional
        Initial displacement, mm; zero by default.
    progress : callable, optional
        Called with a `naibu.core.progress.ProgressReport` before every grid, and at the end.

    Returns
    -------
    DisplacementField
        Displacement, mm; its quality is the smallest eigenvalue, (intensity/mm)^2.

    Raises
    ------
    InputError
        Volumes on different grids or without contrast, an empty mask, a window that is not odd, or numbers that are not positive.
    """
    _require_counts(warps=warps, levels=1 if levels is None else levels)
    size = np.asarray(window)
    if not damping >= 0.0:
        raise InputError(f"damping must be 0 or more, not {damping}")
    if size.shape != (3,) or size.dtype.kind not in "iu" or (size < 1).any() or (size % 2 == 0).any():
        raise InputError(f"window must be three odd numbers of voxels along x, y, z, not {size.tolist()}")
    a, b = intensity_pair(reference, deformed)
    wanted = _wanted(mask, reference)
    grids = pyramid(a, b, wanted, reference.spacing_mm, levels)
    u = _start(start, reference, grids)
    eigenvalue = np.zeros(reference.shape, dtype=np.float32)
    for number, grid in enumerate(grids):
        report_progress(progress, "optical flow (Lucas-Kanade)", done=number, total=len(grids))
        with _threads_worth(grid):
            if number:
                u = refined(u, grids[number - 1], grid)
            eigenvalue = np.zeros(grid.reference.shape, dtype=np.float32)
            for _ in range(warps):
                _solve_windows(u, grid, size // 2, least_eigenvalue, damping, eigenvalue)
                u = _median(u) if median_filter else u
    report_progress(progress, "optical flow (Lucas-Kanade)", done=len(grids), total=len(grids))
    found = _result(u, reference, a, b, wanted)
    # a window with gradients along one direction only has an eigenvalue of rounding error
    fixed = eigenvalue > max(least_eigenvalue, 1e-6 * float(eigenvalue.max()))
    return DisplacementField.on_grid(reference, found.vectors, valid=found.valid & fixed, quality=eigenvalue)


@contextmanager
def _threads_worth(grid: Level) -> Iterator[None]:
    """Use a single thread while the grid is small."""
    before = numba.get_num_threads()
    numba.set_num_threads(before if grid.reference.size >= WORTH_SHARING else 1)
    try:
        yield
    finally:
        numba.set_num_threads(before)


def _relaxed(u: Float32Array, grid: Level, weight: float, iterations: int, accelerated: bool) -> Float32Array:
    """Return the displacement after some Horn-Schunck steps about the present one."""
    active = np.array(grid.reference.shape[::-1]) > 1
    gradients, rest = _linearized(u, grid)
    inverse = np.where(active, 1.0 / grid.spacing_mm**2, 0.0)
    weights = (0.5 * inverse / inverse.sum()).astype(np.float32)
    in_millimetres = weight * float(grid.spacing_mm[active].min()) ** 2
    now, before = u.copy(), u.copy()
    stride = 1.0
    for number in range(iterations):
        horn_schunck_step(now, gradients, rest, in_millimetres, weights, stride, before)
        now, before = before, now
        if accelerated:
            # Chebyshev sequence for eigenvalues up to SLOWEST; errors of larger ones decrease, too
            stride = 1.0 / (1.0 - SLOWEST**2 * stride / (2.0 if number == 0 else 4.0))
    return now


def _median(u: Float32Array) -> Float32Array:
    out = np.empty_like(u)
    for component, result in zip(u, out, strict=True):
        median(component, result)
    return out


def _solve_windows(u: Float32Array, grid: Level, half: IntArray, least: float, damping: float, eigenvalue: Float32Array) -> None:
    """Update the displacement in place by one least-squares solve in every window."""
    gradients, rest = _linearized(u, grid)
    tensor = np.empty((6, *grid.reference.shape), dtype=np.float32)
    products(gradients, tensor)
    # the whole displacement is the unknown of a window, though each of its voxels was linearised about its own
    right = np.stack([box_mean(s * rest, half) for s in gradients])
    tensor = np.stack([box_mean(t, half) for t in tensor])
    plane = grid.reference.shape[0] == 1
    active = np.array(grid.reference.shape[::-1]) > 1
    mean = float(np.mean(tensor[: int(active.sum())], dtype=float, where=grid.wanted))
    lucas_kanade_step(tensor, right, least, damping * mean, plane, float(grid.spacing_mm[active].min()), u, eigenvalue)


def _linearized(u: Float32Array, grid: Level) -> tuple[Float32Array, Float32Array]:
    gradients, rest = np.empty_like(u), np.empty_like(grid.reference)
    per_step = (1.0 / grid.spacing_mm).astype(np.float32)
    linearize(grid.reference, grid.deformed, per_step, u, grid.wanted, gradients, rest)
    return gradients, rest


def _start(start: ArrayLike | None, reference: Volume, grids: list[Level]) -> Float32Array:
    """Return the initial displacement (3, nz, ny, nx), mm along the axes of the grid, on the coarsest level."""
    if start is None:
        return np.zeros((3, *grids[0].reference.shape), dtype=np.float32)
    given = np.asarray(start, dtype=float)
    if given.shape == (*reference.shape, 3) and not np.isfinite(given).all():
        raise InputError("start has voxels without displacement; fill them, for example with dense_from_sparse(outside='nearest')")
    along = to_voxels(given, reference) * reference.spacing_mm[:, None, None, None]
    return coarsened(along.astype(np.float32), grids)


def _result(u: Float32Array, reference: Volume, a: Float32Array, b: Float32Array, wanted: BoolArray) -> DisplacementField:
    voxels = u / reference.spacing_mm.astype(np.float32)[:, None, None, None]
    warped = np.empty_like(a)
    warp(b, voxels, warped)
    valid, residual = np.isfinite(warped) & wanted, np.abs(warped - a)
    return DisplacementField.on_grid(reference, to_millimetres(voxels, reference), valid=valid, quality=residual)


def _wanted(mask: ArrayLike | None, reference: Volume) -> BoolArray:
    return np.ones(reference.shape, dtype=bool) if mask is None else require_mask(mask, reference)


def _range(values: Float32Array) -> float:
    low, high = np.nanpercentile(values, [0.5, 99.5])
    return float(high - low) if high > low else float(np.nanmax(values) - np.nanmin(values))


def _require_counts(**counts: int) -> None:
    for name, value in counts.items():
        if value < 1:
            raise InputError(f"{name} must be 1 or more, not {value}")
