"""Resampling of volumes: interpolated slices, other spacings and grids, warping by a displacement, cropping and masking.

Slices are interpolated as in :cite:t:`hirai2008` (chapter 3.6); cubic interpolation is by B-splines :cite:p:`unser1999`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from naibu.core.arrays import AnyArray, BoolArray, FloatArray
from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.imaging.preprocessing._interpolation_kernels import EDGE, sample, sample_affine
from naibu.imaging.preprocessing.filters import smoothed

Interpolation = Literal["linear", "cubic"]
AT_ONCE = 2**18  # voxels that are warped at once, about: what is known of each takes eight times its memory
COINCIDENT = 1e-3  # largest distance, in voxels, of voxels that are taken for the same: coordinates in headers are rounded


def with_slices_between(volume: Volume, count: int = 1) -> Volume:
    """Return a volume with slices interpolated linearly into every gap between slices (:cite:t:`hirai2008`, equation 3.37).

    Parameters
    ----------
    volume : Volume
        At least two slices.
    count : int
        Slices in every gap: 1 halves their distance, as the report does with slices 2 mm apart.

    Returns
    -------
    Volume
        ``(nz - 1) (count + 1) + 1`` slices of real numbers; every measured slice is among them unchanged.

    Raises
    ------
    InputError
        Less than two slices, or a count below one.

    Notes
    -----
    ``I_a = (1 - a) I_k + a I_{k+1}`` with ``a = d_k / (d_k + d_{k+1})``, the distances to the slices before and after.
    """
    if count < 1:
        raise InputError(f"count must be 1 slice or more, not {count}")
    return with_slices(volume, (volume.shape[0] - 1) * (count + 1) + 1)


def with_slices(volume: Volume, n: int) -> Volume:
    """Return a volume with `n` evenly spaced slices from the first to the last, interpolated linearly (:cite:t:`hirai2008`, equation 3.37).

    Raises
    ------
    InputError
        Less than two slices, before or after.
    """
    nz = volume.shape[0]
    if nz < 2 or n < 2:
        raise InputError(f"n must be 2 slices or more, interpolated between 2 or more; it is {n}, from {nz}")
    at = np.arange(n) * ((nz - 1) / (n - 1))
    below = np.minimum(at.astype(int), nz - 2)
    kind = _real(volume.values)
    weight = (at - below).astype(kind)[:, None, None]
    values = volume.values[below] * (1 - weight) + volume.values[below + 1] * weight
    spacing = volume.spacing_mm * [1.0, 1.0, (nz - 1) / (n - 1)]
    return replace(volume, values=values.astype(kind), spacing_mm=spacing)


def resampled_to_spacing(
    volume: Volume, spacing_mm: ArrayLike, *, interpolation: Interpolation = "linear", averaged: bool = True
) -> Volume:
    """Return a volume with another voxel spacing; the first voxel keeps its position.

    Parameters
    ----------
    volume : Volume
        Voxels.
    spacing_mm : float or array_like, shape (3,)
        Distance of voxels along x, y, z, mm.
    interpolation : {"linear", "cubic"}
        Linear, or by cubic B-splines.
    averaged : bool
        Whether a Gaussian removes first what would alias on a coarser grid.

    Raises
    ------
    InputError
        A spacing that is not positive.
    """
    step = np.broadcast_to(np.asarray(spacing_mm, dtype=float), 3).copy()
    if not (np.isfinite(step).all() and (step > 0.0).all()):
        raise InputError(f"spacing_mm must be positive, not {step.tolist()}")
    size = np.array(volume.shape[::-1])
    ratio = step / volume.spacing_mm
    n = np.floor((size - 1) / ratio + 1e-6).astype(int) + 1
    source = volume
    if averaged and (ratio > 1.0).any():
        blur = 0.5 * np.sqrt(np.maximum(ratio**2 - 1.0, 0.0))
        source = volume.with_values(smoothed(np.asarray(volume.values, dtype=np.float32), blur).astype(_real(volume.values)))
    grid = replace(volume, values=np.zeros(tuple(n[::-1]), dtype=bool), spacing_mm=step)
    return resampled_to_grid(source, grid, interpolation=interpolation)


def resampled_to_grid(
    volume: Volume,
    grid: Volume,
    *,
    through: Callable[[FloatArray], FloatArray] | None = None,
    interpolation: Interpolation = "linear",
    outside: float = np.nan,
) -> Volume:
    """Return the values of a volume at the voxels of another.

    Parameters
    ----------
    volume : Volume
        Intensities.
    grid : Volume
        Voxels of the result; its values do not matter.
    through : callable, optional
        Affine map of positions (n, 3) of the grid, mm, to positions in the volume: the `moved` of a rigid motion brings a deformed
        volume back to the frame of the reference.
    interpolation : {"linear", "cubic"}
        Linear, or by cubic B-splines.
    outside : float
        Value of voxels that lie outside the volume. NaN stands for unknown in block matching and optical flow, to which a zero would be an
        edge; files of integers cannot hold it.

    Returns
    -------
    Volume
        Floating-point values.

    Raises
    ------
    InputError
        No voxel of the grid lies inside the volume.
    """
    matrix, shift = _index_map(volume, grid, through)
    kind = _real(volume.values)
    out: AnyArray = np.empty(grid.shape, dtype=kind)
    if interpolation == "linear":
        sample_affine(np.ascontiguousarray(volume.values, dtype=kind), matrix, shift, out)
        inside = ~np.isnan(out)
    else:
        flip = [2, 1, 0]
        ndimage.affine_transform(
            np.asarray(volume.values, dtype=float),
            matrix[flip][:, flip],
            shift[flip],
            output_shape=grid.shape,
            order=3,
            mode="mirror",
            output=out,
        )
        inside = covered(volume, grid, through=through)
    if not inside.any():
        raise InputError("volume and grid do not overlap: no voxel of the grid lies inside the volume; check their origins and units")
    out[~inside] = outside
    return replace(grid, values=out)


def on_voxels_of(volume: Volume, grid: Volume) -> Volume:
    """Return the values of a volume at the voxels of another, NaN where they lie outside of it.

    Where the voxels of both coincide, as after a crop or with axes that are flipped or in another order, values are those that were stored;
    elsewhere they are interpolated by cubic B-splines, or linearly where some are unknown, after a Gaussian has removed what would alias.

    Raises
    ------
    InputError
        No voxel of the grid lies inside the volume.
    """
    matrix, shift = _index_map(volume, grid, None)
    if (matrix == np.rint(matrix)).all() and (shift == np.rint(shift)).all():
        return resampled_to_grid(volume, grid)
    values = np.asarray(volume.values, dtype=_real(volume.values))
    unknown = bool(np.isnan(values).any())
    ratio = np.abs(matrix).max(axis=1)
    if (ratio > 1.0).any() and not unknown:
        values = smoothed(values.astype(np.float32), 0.5 * np.sqrt(np.maximum(ratio**2 - 1.0, 0.0))).astype(values.dtype)
    return resampled_to_grid(volume.with_values(values), grid, interpolation="linear" if unknown else "cubic")


def covered(volume: Volume, grid: Volume, *, through: Callable[[FloatArray], FloatArray] | None = None) -> BoolArray:
    """Return which voxels (nz, ny, nx) of a grid lie inside a volume after the map `through` (see `resampled_to_grid`)."""
    matrix, shift = _index_map(volume, grid, through)
    axes = np.meshgrid(*(np.arange(n, dtype=float) for n in grid.shape), indexing="ij", sparse=True)
    inside = np.ones(grid.shape, dtype=bool)
    for row, offset, n in zip(matrix, shift, volume.shape[::-1], strict=True):
        at = row[0] * axes[2] + row[1] * axes[1] + row[2] * axes[0] + offset
        inside &= (at >= -EDGE) & (at <= n - 1 + EDGE)
    return inside


def sampled(volume: Volume, points_mm: ArrayLike, *, interpolation: Interpolation = "linear", outside: float = np.nan) -> FloatArray:
    """Return the values (...) of a volume at positions (..., 3), mm; `outside` where there are none."""
    index = volume.to_index(points_mm)
    flat = np.ascontiguousarray(index.reshape(-1, 3))
    if interpolation == "linear":
        out = np.empty(len(flat))
        sample(np.ascontiguousarray(volume.values, dtype=_real(volume.values)), flat, out)
        inside = np.isfinite(out)
    else:
        out = ndimage.map_coordinates(np.asarray(volume.values, dtype=float), flat.T[::-1], order=3, mode="mirror")
        inside = np.asarray(((flat >= -EDGE) & (flat <= np.array(volume.shape[::-1]) - 1 + EDGE)).all(axis=1))
    return np.where(inside, out, outside).reshape(index.shape[:-1])


def warped(
    volume: Volume, displacement: ArrayLike, grid: Volume, *, interpolation: Interpolation = "linear", outside: float = np.nan
) -> AnyArray:
    """Return the values (nz, ny, nx) of a volume at ``x + u(x)``, x the voxels of a grid.

    With the deformed volume and the displacement of the reference this is the deformed volume warped back, which equals the reference
    where the displacement is right.

    Parameters
    ----------
    volume : Volume
        Intensities.
    displacement : array_like, shape (nz, ny, nx, 3)
        Displacement u along x, y, z at the voxels of the grid, mm; NaN where there is none.
    grid : Volume
        Grid of the displacement.
    interpolation : {"linear", "cubic"}
        Linear, or by cubic B-splines.
    outside : float
        Value of voxels whose displaced position lies outside the volume, or that have no displacement.

    Raises
    ------
    InputError
        A displacement of another shape than the grid.
    """
    u = np.asarray(displacement, dtype=float)
    if u.shape != (*grid.shape, 3):
        raise InputError(f"displacement must have shape {(*grid.shape, 3)} (z, y, x, component), mm, not {u.shape}")
    nz, ny, nx = grid.shape
    # cubic interpolation finds the coefficients of its splines anew each time
    some = max(1, AT_ONCE // (ny * nx)) if interpolation == "linear" else nz
    ready = volume.with_values(np.ascontiguousarray(volume.values, dtype=_real(volume.values)))
    out = np.empty(grid.shape)
    for k in range(0, nz, some):
        ends = positions(grid.cropped((0, 0, k), (nx, ny, min(k + some, nz))))
        ends += u[k : k + some]
        out[k : k + some] = sampled(ready, ends, interpolation=interpolation, outside=outside)
    return out


def positions(grid: Volume) -> FloatArray:
    """Return the centres (nz, ny, nx, 3) of all voxels, mm."""
    return grid.positions()


def masked(volume: Volume, mask: ArrayLike, fill: float = 0.0) -> Volume:
    """Return a volume with `fill` where the mask (nz, ny, nx) is false.

    Raises
    ------
    InputError
        Mask of another shape, or empty.
    """
    inside = require_mask(mask, volume)
    return volume.with_values(np.where(inside, volume.values, np.asarray(fill, dtype=volume.values.dtype)))


def cropped_to_mask(volume: Volume, mask: ArrayLike, margin_mm: float = 0.0) -> Volume:
    """Return the smallest box of voxels around a mask (nz, ny, nx), with a margin, mm.

    Raises
    ------
    InputError
        Mask of another shape, or empty.
    """
    inside = np.argwhere(require_mask(mask, volume))[:, ::-1]
    margin = np.ceil(margin_mm / volume.spacing_mm - 1e-9).astype(int)
    low, high = inside.min(axis=0) - margin, inside.max(axis=0) + 1 + margin
    return volume.cropped(np.maximum(low, 0), np.minimum(high, volume.shape[::-1]))


def require_mask(mask: ArrayLike, volume: Volume, name: str = "mask") -> BoolArray:
    """Return a mask (nz, ny, nx) of a volume; `name` is the argument that messages name.

    Raises
    ------
    InputError
        Mask of another shape, or empty.
    """
    inside = np.asarray(mask, dtype=bool)
    if inside.shape != volume.shape:
        raise InputError(f"{name} must have shape {volume.shape} (z, y, x), not {inside.shape}")
    if not inside.any():
        raise InputError(f"{name} is empty: no voxel is set; check its threshold or its file")
    return inside


def _index_map(volume: Volume, grid: Volume, through: Callable[[FloatArray], FloatArray] | None) -> tuple[FloatArray, FloatArray]:
    """Return the affine map from indices of a grid to indices of a volume, both along x, y, z."""
    corners = grid.to_physical(np.vstack([np.zeros(3), np.eye(3)]))
    index = volume.to_index(corners if through is None else through(corners))
    matrix, shift = np.ascontiguousarray((index[1:] - index[0]).T), index[0]
    if through is None:
        whole, offset = np.rint(matrix), np.rint(shift)
        if np.abs(matrix - whole).max() * max(grid.shape) < COINCIDENT and np.abs(shift - offset).max() < COINCIDENT:
            return whole, offset
    return matrix, shift


def _real(values: AnyArray) -> type[np.floating]:
    """Return the floating-point type that holds intensities exactly."""
    single = values.dtype in (np.float32, np.float16) or (values.dtype.kind in "biu" and values.dtype.itemsize <= 2)
    return np.float32 if single else np.float64
