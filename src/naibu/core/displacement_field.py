"""A measured displacement field: vectors at points, how sure they are, and where there are none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.errors import InputError


@dataclass(frozen=True, slots=True, eq=False)
class DisplacementField:
    """Displacement at points.

    Attributes
    ----------
    points : ndarray, shape (n, d), float64
        Where, in the undeformed body, mm.
    vectors : ndarray, shape (n, d), float64
        Displacement, mm; NaN where `valid` is false.
    covariance : ndarray, shape (n, d, d), float64
        Covariance of each vector, mm^2; zero for exact data.
    valid : ndarray, shape (n,), bool
        Where there is a measurement.
    """

    points: FloatArray
    vectors: FloatArray
    covariance: FloatArray
    valid: BoolArray

    @classmethod
    def from_arrays(
        cls,
        points: ArrayLike,
        vectors: ArrayLike,
        *,
        sd_mm: ArrayLike = 0.0,
        covariance: ArrayLike | None = None,
        valid: ArrayLike | None = None,
    ) -> DisplacementField:
        """Check the arrays and make a field of them.

        Parameters
        ----------
        points, vectors : array_like, shape (n, d)
            Positions and displacements, mm.
        sd_mm : float or array_like, shape (d,) or (n, d)
            Standard deviation of every component, mm, where no `covariance` is given.
        covariance : array_like, shape (n, d, d), optional
            Covariance of each vector, mm^2.
        valid : array_like, shape (n,), optional
            Where there is a measurement; by default where all components are finite.

        Raises
        ------
        InputError
            Shapes that do not fit, a vector called valid that is not finite, or a covariance that is no covariance.
        """
        p, v = np.array(points, dtype=float), np.array(vectors, dtype=float)
        if p.ndim != 2 or p.shape != v.shape:
            raise InputError(f"points and vectors of a field must have one shape (n, d), not {p.shape} and {v.shape}")
        if not np.isfinite(p).all():
            raise InputError(f"point {int(np.flatnonzero(~np.isfinite(p).all(axis=1))[0])} of the field is not finite")
        finite = np.isfinite(v).all(axis=1)
        mask = finite if valid is None else np.array(valid, dtype=bool)
        if mask.shape != (len(p),):
            raise InputError(f"valid must have shape ({len(p)},), not {mask.shape}")
        if (mask & ~finite).any():
            bad = int(np.flatnonzero(mask & ~finite)[0])
            raise InputError(f"vector {bad} of the field is {v[bad].tolist()}: mark points without data as not valid")
        v[~mask] = np.nan
        return cls(p, v, _covariance(sd_mm, covariance, p.shape, mask), mask)

    @property
    def standard_deviation(self) -> FloatArray:
        """Standard deviation of every component (n, d), mm."""
        return np.asarray(np.sqrt(np.einsum("nii->ni", self.covariance)))


def _covariance(sd_mm: ArrayLike, covariance: ArrayLike | None, shape: tuple[int, ...], valid: BoolArray) -> FloatArray:
    n, d = shape
    if covariance is None:
        sd = np.broadcast_to(np.asarray(sd_mm, dtype=float), shape)
        if not (sd >= 0.0).all():
            raise InputError("standard deviations of a field must be numbers >= 0, mm")
        return np.asarray(np.einsum("ni,ij->nij", sd**2, np.eye(d)))
    c = np.array(covariance, dtype=float)
    if c.shape != (n, d, d):
        raise InputError(f"covariance of a field must have shape {(n, d, d)}, mm^2, not {c.shape}")
    if valid.any() and not (np.isfinite(c[valid]).all() and np.linalg.eigvalsh(c[valid]).min() >= -1e-12 * np.abs(c[valid]).max()):
        raise InputError("covariance of a field has a block that is not positive semidefinite")
    return c
