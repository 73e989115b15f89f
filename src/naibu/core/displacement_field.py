"""Displacement field: vectors at points, at the voxels of a grid or at the nodes of a mesh, with their covariance and validity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import AnyFloatArray, BoolArray, FloatArray, require_shape
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.core.volume import Volume

CHUNKS = 16  # parts of a field in which what is derived from its covariance is computed


@dataclass(frozen=True, slots=True, eq=False)
class DisplacementField:
    """Displacement u of the material: what is at x in the reference configuration is found at x + u(x).

    Arrays have the shape of the support: ``(n,)`` at points and at the nodes of a mesh, ``(nz, ny, nx)`` at the voxels of a grid.

    Attributes
    ----------
    support : ndarray, shape (n, d), or Volume or Mesh
        Positions of the vectors, mm: listed, or as the voxels of a grid or the nodes of a mesh, which store no positions of their own.
    vectors : ndarray, shape (..., d), float64
        Displacement along x, y, z, mm; NaN where there is none.
    covariance : ndarray, shape (..., d, d), float64, on grids also float32, or None
        Covariance of each vector, mm^2: zero for exact data, None where it is not known.
    valid : ndarray, shape (...), bool
        Where the displacement was measured, not interpolated or filled in.
    quality : ndarray, shape (...), or None
        Quality of the match, in the units of the method that measured the field; NaN where there is none.
    """

    support: FloatArray | Volume | Mesh
    vectors: FloatArray
    covariance: AnyFloatArray | None
    valid: BoolArray
    quality: FloatArray | None = None

    @classmethod
    def from_arrays(
        cls,
        points: ArrayLike,
        vectors: ArrayLike,
        *,
        sd_mm: ArrayLike | None = None,
        covariance: ArrayLike | None = None,
        valid: ArrayLike | None = None,
    ) -> DisplacementField:
        """Return a field at points after checking the arrays.

        Parameters
        ----------
        points, vectors : array_like, shape (n, d)
            Positions and displacements, mm.
        sd_mm : float or array_like, shape (d,) or (n, d), optional
            Standard deviation of every component, mm, where no `covariance` is given.
        covariance : array_like, shape (n, d, d), optional
            Covariance of each vector, mm^2.
        valid : array_like, shape (n,), optional
            Where there is a measurement; by default where all components are finite.

        Raises
        ------
        InputError
            Shapes that do not fit, a valid vector that is not finite, or a covariance that is not positive semidefinite.
        """
        p, v = np.array(points, dtype=float), np.array(vectors, dtype=float)
        if p.ndim != 2 or p.shape != v.shape:
            raise InputError(f"points and vectors of a field must have one shape (n, d), not {p.shape} and {v.shape}")
        if not np.isfinite(p).all():
            raise InputError(f"point {int(np.flatnonzero(~np.isfinite(p).all(axis=1))[0])} of the field is not finite")
        mask = _valid(v, valid)
        v[~mask] = np.nan
        return cls(p, v, _covariance(sd_mm, covariance, p.shape, mask), mask)

    @classmethod
    def on_grid(
        cls,
        grid: Volume,
        vectors: ArrayLike,
        *,
        covariance: ArrayLike | None = None,
        valid: ArrayLike | None = None,
        quality: ArrayLike | None = None,
    ) -> DisplacementField:
        """Return a field at the voxels of a grid; the arrays are not copied, and the values of the volume are not kept.

        Parameters
        ----------
        grid : Volume
            Frame: shape, spacing, origin and direction of the voxels.
        vectors : array_like, shape (nz, ny, nx, 3)
            Displacement along x, y, z, mm; NaN where there is none.
        covariance : array_like, shape (nz, ny, nx, 3, 3), optional
            Covariance of each vector, mm^2.
        valid : array_like, shape (nz, ny, nx), optional
            Where the displacement was measured; by default where all components are finite.
        quality : array_like, shape (nz, ny, nx), optional
            Quality of the match.

        Raises
        ------
        InputError
            Shapes that do not fit the grid, or a valid vector that is not finite.
        """
        v = np.asarray(vectors, dtype=float)
        require_shape("vectors", v, (*grid.shape, 3))
        c = None if covariance is None else np.asarray(covariance)
        c = c if c is None or c.dtype == np.float32 else np.asarray(c, dtype=float)
        if c is not None:
            require_shape("covariance", c, (*grid.shape, 3, 3))
        q = None if quality is None else np.asarray(quality, dtype=float)
        if q is not None:
            require_shape("quality", q, grid.shape)
        return cls(grid.frame, v, c, _valid(v, valid), q)

    @classmethod
    def on_mesh(
        cls,
        mesh: Mesh,
        vectors: ArrayLike,
        *,
        sd_mm: ArrayLike | None = None,
        covariance: ArrayLike | None = None,
        valid: ArrayLike | None = None,
    ) -> DisplacementField:
        """Return a field at the nodes of a mesh; arguments as in `from_arrays`, with one row for each node."""
        v = np.array(vectors, dtype=float)
        require_shape("vectors", v, mesh.points.shape)
        mask = _valid(v, valid)
        v[~mask] = np.nan
        return cls(mesh, v, _covariance(sd_mm, covariance, v.shape, mask), mask)

    @property
    def points(self) -> FloatArray:
        """Positions of all vectors (n, d), mm; computed anew for a grid, voxel by voxel with x fastest."""
        if isinstance(self.support, Volume):
            return self.support.positions().reshape(-1, 3)
        return self.support.points if isinstance(self.support, Mesh) else self.support

    @property
    def grid(self) -> Volume:
        """Frame of the voxels.

        Raises
        ------
        InputError
            The field does not lie on a grid.
        """
        if not isinstance(self.support, Volume):
            raise InputError("the displacement field has no grid: its vectors lie at points; interpolate it to the voxels first")
        return self.support

    @property
    def standard_deviation(self) -> FloatArray | None:
        """Standard deviation of every component (..., d), mm; None where the covariance is not known."""
        return None if self.covariance is None else np.asarray(np.sqrt(np.einsum("...ii->...i", self.covariance)))

    @property
    def largest_sd_mm(self) -> FloatArray | None:
        """Standard deviation (...) along the least certain direction, mm; None where the covariance is not known."""
        if self.covariance is None:
            return None
        out = np.full(self.covariance.shape[:-2], np.nan)
        for some, each in zip(np.array_split(out, CHUNKS), np.array_split(self.covariance, CHUNKS), strict=True):  # which bounds the memory
            known = np.isfinite(each).all(axis=(-2, -1))
            some[known] = np.sqrt(_largest_eigenvalues(each[known].astype(float)))
        return out

    def at_points(self, *, step: int = 1) -> DisplacementField:
        """Return the field at listed points: the valid voxels of a grid, or all nodes of a mesh.

        Parameters
        ----------
        step : int
            On a grid, take every `step`-th voxel along each axis.

        Raises
        ------
        InputError
            A step below one, or another step than one for a field that is not on a grid.
        """
        if step < 1 or (step > 1 and not isinstance(self.support, Volume)):
            raise InputError(f"step must be a whole number of voxels, 1 or more, and 1 for a field that is not on a grid; it is {step}")
        if isinstance(self.support, Mesh):
            return DisplacementField(self.support.points, self.vectors, self.covariance, self.valid, self.quality)
        if not isinstance(self.support, Volume):
            return self
        some = np.zeros(self.valid.shape, dtype=bool)
        some[::step, ::step, ::step] = True
        some &= self.valid
        points = self.support.to_physical(np.argwhere(some)[:, ::-1])
        covariance = None if self.covariance is None else self.covariance[some].astype(float)
        quality = None if self.quality is None else self.quality[some]
        return DisplacementField(points, self.vectors[some], covariance, np.ones(len(points), dtype=bool), quality)


def _valid(vectors: FloatArray, valid: ArrayLike | None) -> BoolArray:
    """Return the mask of validity, which holds only finite vectors."""
    finite = np.asarray(np.isfinite(vectors).all(axis=-1))
    if valid is None:
        return finite
    mask = np.array(valid, dtype=bool)
    require_shape("valid", mask, vectors.shape[:-1])
    if (mask & ~finite).any():
        bad = tuple(int(i) for i in np.argwhere(mask & ~finite)[0])
        at = bad[0] if len(bad) == 1 else bad
        raise InputError(f"vector {at} of the field is {vectors[bad].tolist()}: mark points without data as not valid")
    return mask


def _covariance(sd_mm: ArrayLike | None, covariance: ArrayLike | None, shape: tuple[int, ...], valid: BoolArray) -> FloatArray | None:
    n, d = shape
    if covariance is None and sd_mm is None:
        return None
    if covariance is None:
        sd = np.broadcast_to(np.asarray(sd_mm, dtype=float), shape)
        if not (sd >= 0.0).all():
            raise InputError("sd_mm must hold standard deviations >= 0, mm")
        return np.asarray(np.einsum("ni,ij->nij", sd**2, np.eye(d)))
    c = np.array(covariance, dtype=float)
    if c.shape != (n, d, d):
        raise InputError(f"covariance of a field must have shape {(n, d, d)}, mm^2, not {c.shape}")
    if len(odd := np.flatnonzero(valid & ~np.isfinite(c).all(axis=(1, 2)))):
        raise InputError(
            f"covariance of a field is not finite at {len(odd)} of {n} points, first at index {odd[0]}; give it, or mark them as not valid"
        )
    if valid.any() and np.linalg.eigvalsh(c[valid]).min() < -1e-12 * np.abs(c[valid]).max():
        raise InputError("covariance of a field has a block that is not positive semidefinite")
    return c


def _largest_eigenvalues(matrices: FloatArray) -> FloatArray:
    """Return the largest eigenvalues (n,) of symmetric matrices (n, d, d), in closed form for three dimensions :cite:p:`smith1961`."""
    if matrices.shape[-1] != 3:
        return np.asarray(np.linalg.eigvalsh(matrices)[:, -1])
    mean = np.trace(matrices, axis1=1, axis2=2) / 3.0
    x, y, z = (matrices[:, i, i] - mean for i in range(3))
    a, b, c = matrices[:, 1, 2], matrices[:, 0, 2], matrices[:, 0, 1]
    size = np.sqrt((x * x + y * y + z * z + 2.0 * (a * a + b * b + c * c)) / 6.0)
    determinant = x * (y * z - a * a) - c * (c * z - a * b) + b * (c * a - y * b)
    angle = np.arccos(np.clip(0.5 * determinant / np.maximum(size**3, 1e-300), -1.0, 1.0)) / 3.0
    return np.asarray(mean + 2.0 * size * np.cos(angle))
