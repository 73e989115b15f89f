"""Displacement gradients, strains and Jacobians of displacement fields."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.volume import Volume
from naibu.imaging.preprocessing.resampling import require_mask

AT_ONCE = 2**18  # voxels whose Jacobians are found at once, about: gradients take nine numbers a voxel


def displacement_gradient(displacement: ArrayLike, grid: Volume) -> FloatArray:
    """Return ``du_a / dx_b`` (nz, ny, nx, 3, 3), a before b, by central differences; zero along the normal of a single slice.

    Parameters
    ----------
    displacement : array_like, shape (nz, ny, nx, 3)
        Displacement along x, y, z, mm.
    grid : Volume
        Grid of the displacement; its axes may be rotated.
    """
    u = np.asarray(displacement, dtype=float)
    if u.shape != (*grid.shape, 3):
        raise InputError(f"displacement must have shape {(*grid.shape, 3)} (z, y, x, component), mm, not {u.shape}")
    along = np.zeros((*grid.shape, 3, 3))
    for c in range(3):
        if grid.shape[2 - c] > 1:
            along[..., c] = np.gradient(u, grid.spacing_mm[c], axis=2 - c)
    if np.array_equal(grid.direction, np.eye(3)):
        return along
    return np.asarray(along @ grid.direction.T)


def jacobian_determinant(displacement: ArrayLike, grid: Volume) -> FloatArray:
    """Return the volume ratio ``det(I + du/dx)`` (nz, ny, nx); the field folds where it is not positive."""
    u = np.asarray(displacement, dtype=float)
    if u.shape != (*grid.shape, 3):
        raise InputError(f"displacement must have shape {(*grid.shape, 3)} (z, y, x, component), mm, not {u.shape}")
    nz, ny, nx = grid.shape
    some, out = max(1, AT_ONCE // (ny * nx)), np.full(grid.shape, np.nan)
    for k in range(0, nz, some):
        low, high = max(k - 1, 0), min(k + some + 1, nz)  # differences reach a slice further
        gradient = displacement_gradient(u[low:high], grid.cropped((0, 0, low), (nx, ny, high)))[k - low : k - low + some]
        known = np.isfinite(gradient).all(axis=(-2, -1))
        out[k : k + some][known] = np.linalg.det(np.eye(3) + gradient[known])
    return out


def folded_fraction(displacement: ArrayLike, grid: Volume, mask: ArrayLike | None = None) -> float:
    """Return the fraction of the voxels with a known Jacobian, in a mask (nz, ny, nx) where given, at which the field folds."""
    determinant = jacobian_determinant(displacement, grid)
    inside = np.isfinite(determinant)
    if mask is not None:
        inside &= require_mask(mask, grid)
    if not inside.any():
        raise InputError("displacement is known at no voxel with known neighbours")
    return float(np.mean(determinant[inside] <= 0.0))


def small_strain(displacement: ArrayLike, grid: Volume) -> FloatArray:
    """Return the strain ``(G + G^T) / 2`` (nz, ny, nx, 3, 3) of small displacement gradients G; rotations count as strain."""
    g = displacement_gradient(displacement, grid)
    return np.asarray(0.5 * (g + np.swapaxes(g, -1, -2)))


def green_lagrange_strain(displacement: ArrayLike, grid: Volume) -> FloatArray:
    """Return the strain ``(F^T F - I) / 2`` (nz, ny, nx, 3, 3), ``F = I + du/dx``, which is zero for any rigid motion."""
    return green_lagrange_strain_of(displacement_gradient(displacement, grid))


def green_lagrange_strain_of(gradient: ArrayLike) -> FloatArray:
    """Return the strain ``(F^T F - I) / 2`` (..., 3, 3) of displacement gradients (..., 3, 3), a before b in ``du_a / dx_b``."""
    f = np.asarray(gradient, dtype=float) + np.eye(3)
    return np.asarray(0.5 * (np.swapaxes(f, -1, -2) @ f - np.eye(3)))
