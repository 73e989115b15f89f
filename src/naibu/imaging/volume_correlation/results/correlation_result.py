"""Result of digital volume correlation: displacement field, gradient, covariance, convergence."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import AnyFloatArray, BoolArray, Float32Array, FloatArray, Int32Array
from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import InputError
from naibu.core.memory import return_freed_memory
from naibu.core.volume import Volume
from naibu.imaging.preprocessing.resampling import positions
from naibu.imaging.volume_correlation.common_content import CommonContent
from naibu.imaging.volume_correlation.gauss_newton import CorrelationFit
from naibu.imaging.volume_correlation.results.cell_errors import (
    BENDING_BIAS,
    DILATATION_BIAS,
    REMAINING,
    bias_covariance,
    biases,
    misplacement_variance,
    per_cell,
    sampled_covariance,
    strain_variance,
    variance_of_one_line,
)
from naibu.imaging.volume_correlation.results.weight_contrasts import WeightContrast, contrast_errors
from naibu.imaging.volume_correlation.rigid_parts.rigid_inclusions import InclusionMotion
from naibu.imaging.volume_correlation.splines.spline_grid import SplineGrid, separable_slice

LEAST_KNOWN = 1e-4  # weight of the known cells about a voxel, from which it is interpolated among all voxels at once


@dataclass(frozen=True, slots=True, eq=False)
class CorrelationResult:
    """Displacement field between two volumes by digital volume correlation, with its splines, covariance and intensity model.

    Attributes
    ----------
    displacement : DisplacementField
        At the voxels of the reference; valid in the object, where it lies in the deformed volume after its motion and both volumes show
        the same, NaN elsewhere. Its covariance is not stored for all voxels: see `covariance`, `covariance_at` and `at_points`.
    grid : SplineGrid
        Spline grid, along the axes of the volume.
    coefficients : ndarray, shape (NZ, NY, NX, 3)
        Coefficients of the splines, mm along the axes of the volume.
    cell_covariance : ndarray, shape (CZ, CY, CX, 3, 3)
        Covariance of the displacement in every cell of the grid, mm^2 along x, y, z; NaN where there is no object.
    cell_strain_sd : ndarray, shape (CZ, CY, CX)
        Standard deviation of a component of the Green-Lagrange strain in the middle of every cell, root mean square over the components;
        NaN where there is no object.
    cell_bias : ndarray, shape (CZ, CY, CX)
        Variance, mm^2, along an axis, in the mean over three, of the bias by the penalties and of the errors that edges or parts of the
        object share, a part of the covariance; NaN where there is no object.
    cell_misplacement : ndarray, shape (CZ, CY, CX)
        Variance along every axis, mm^2, of displacements that would explain residuals far above the noise, a part of the covariance: 0
        where structures lie on one another after registration, NaN where there is no object.
    bending, dilatation : ndarray, shape (CZ, CY, CX, 3) and (CZ, CY, CX)
        Weights of the penalties: of squared second derivatives, for each component along the axes of the volume, 1/mm, and of the squared
        dilatation, 1/mm^3, less where volume changes by more than elsewhere; NaN where there is no object.
    residual_sd : float
        Standard deviation of the intensity residual, in intensities of the reference.
    gain, offset : ndarray, shape (nz, ny, nx)
        Which map intensities of the deformed volume to those of the reference; NaN where the field is not valid.
    converged : ndarray, shape (CZ, CY, CX), bool
        Whether the last step moved a cell of the grid by less than a tenth of a voxel; true where there is no object.
    inclusions : ndarray, shape (nz, ny, nx), int32
        Label of the rigid inclusion of a voxel, 0 outside of all.
    motions : tuple of InclusionMotion
        Motions of the rigid inclusions: their voxels have this displacement, gradient and covariance, not those of the splines.
    status : str
        How the iterations ended, and where they did not.
    blocks : DisplacementField or None
        Displacement of small blocks of voxels with independent errors, without the penalties' bias: what models are fitted to.
    """

    displacement: DisplacementField
    grid: SplineGrid
    coefficients: FloatArray
    cell_covariance: FloatArray
    cell_strain_sd: FloatArray
    cell_bias: FloatArray
    cell_misplacement: FloatArray
    bending: FloatArray
    dilatation: FloatArray
    residual_sd: float
    gain: Float32Array
    offset: Float32Array
    converged: BoolArray
    inclusions: Int32Array
    motions: tuple[InclusionMotion, ...]
    status: str
    blocks: DisplacementField | None = None

    @property
    def volume(self) -> Volume:
        """Frame of the voxels of the reference."""
        return self.displacement.grid

    @property
    def valid(self) -> BoolArray:
        """Where the displacement was measured (nz, ny, nx)."""
        return self.displacement.valid

    @property
    def unconverged_mm(self) -> FloatArray:
        """Centres (n, 3), mm, of the cells that have not converged."""
        return _middles_mm(self.grid, self.volume, ~self.converged)

    def gradient(self, dtype: type[np.floating[Any]] = np.float64) -> AnyFloatArray:
        """Return du_i/dx_j (nz, ny, nx, 3, 3) at the voxels, from the splines, along the axes of space; NaN where it is not valid.

        Parameters
        ----------
        dtype : type
            ``np.float64`` or, for half the memory, ``np.float32``.
        """
        plain = [self.grid.matrix(a, axis) for a, axis in enumerate(self._axes)]
        along = [self.grid.matrix(a, axis, 1) for a, axis in enumerate(self._axes)]
        out = np.empty((*self.volume.shape, 3, 3), dtype)
        r = self.volume.direction
        for z in range(len(out)):  # a slice at a time, which bounds the memory
            for j in range(3):
                x, y, deep = (along[a] if a == j else plain[a] for a in range(3))
                out[z, ..., j] = separable_slice(x, y, deep[z], self.coefficients)
            if not np.array_equal(r, np.eye(3)):
                out[z] = r @ out[z] @ r.T
        for motion in self.motions:
            out[self.inclusions == motion.number] = r @ (motion.transform.rotation - np.eye(3)) @ r.T
        out[~self.valid] = np.nan
        return out

    @property
    def _axes(self) -> list[FloatArray]:
        """Coordinates of the voxels along x, y, z, mm from the first voxel."""
        return [np.arange(n) * s for n, s in zip(self.volume.shape[::-1], self.volume.spacing_mm, strict=True)]

    def displacement_at(self, points_mm: ArrayLike) -> FloatArray:
        """Return the displacement (n, 3), mm, at positions (n, 3), mm; NaN further than a cell from the object."""
        local = self._local(points_mm)
        out = self.grid.values(self.coefficients, local)
        out[~np.isfinite(self._cells_at(local)[:, 0, 0])] = np.nan
        for motion, here in self._in_inclusions(local):
            out[here] = motion.displacement(local[here])
        return np.asarray(out @ self.volume.direction.T)

    def covariance_at(self, points_mm: ArrayLike) -> FloatArray:
        """Return the covariance (n, 3, 3), mm^2, at positions (n, 3), mm: linear between the middles of cells; NaN away from the object.

        Errors of points less than about two cells apart are correlated.
        """
        return self._covariance(self._local(points_mm))

    def covariance(self) -> Float32Array:
        """Return the covariance (nz, ny, nx, 3, 3), mm^2, at the voxels; NaN where it is not valid."""
        out = self._at_voxels(self.cell_covariance)
        for motion in self.motions:
            here = (self.inclusions == motion.number) & self.valid
            out[here] = self._covariance(np.argwhere(here)[:, ::-1] * self.volume.spacing_mm)
        return out

    @property
    def misplaced_fraction(self) -> float:
        """Fraction of the cells in the object where structures stay more than a voxel apart after registration."""
        return self.apart_fraction(1.0)

    def apart_fraction(self, voxels: float) -> float:
        """Return the fraction of the cells in the object where structures stay further apart than some voxels after registration."""
        known = self.cell_misplacement[np.isfinite(self.cell_misplacement)]
        return float((known > voxels**2 * float(np.prod(self.volume.spacing_mm)) ** (2.0 / 3.0)).mean())

    def misplacement_at(self, points_mm: ArrayLike) -> FloatArray:
        """Return `cell_misplacement` (n,), mm^2, at positions (n, 3), mm; NaN away from the object."""
        return self._between_cells(self.cell_misplacement, self._local(points_mm))

    def bias_at(self, points_mm: ArrayLike) -> FloatArray:
        """Return `cell_bias` (n,), mm^2, at positions (n, 3), mm; NaN away from the object."""
        return self._between_cells(self.cell_bias, self._local(points_mm))

    def strain_sd(self) -> Float32Array:
        """Return the standard deviation of a component of strain (nz, ny, nx) at the voxels; NaN where it is not valid, 0 in inclusions."""
        out = np.sqrt(self._at_voxels(self.cell_strain_sd**2))
        out[self.valid & (self.inclusions > 0)] = 0.0
        return out

    def at_points(self, *, step: int | tuple[int, int, int] | None = None) -> DisplacementField:
        """Return the displacement field at listed voxels, with covariance, as identification takes it.

        Parameters
        ----------
        step : int or tuple of int, optional
            Every `step`-th voxel along x, y, z; by default about one in each cell of the grid, so that errors of neighbours are hardly
            correlated.

        Raises
        ------
        InputError
            A step below one, or steps that leave no point.
        """
        if step is None:
            every = np.maximum(np.round(self.grid.step_mm / self.volume.spacing_mm), 1).astype(int)
        else:
            every = np.broadcast_to(np.asarray(step, dtype=int), 3)
        if (every < 1).any():
            raise InputError(f"step must be 1 voxel or more, not {step}")
        # start in the middle of the first step, so that both ends are treated alike
        some = np.zeros(self.valid.shape, dtype=bool)
        some[tuple(slice(int(e) // 2, None, int(e)) for e in every[::-1])] = True
        some &= self.valid
        if not some.any():
            raise InputError(f"step = {every.tolist()} voxels leaves no voxel of the object; give a smaller step")
        points = positions(self.volume)[some]
        return DisplacementField.from_arrays(points, self.displacement.vectors[some], covariance=self.covariance_at(points))

    def _local(self, points_mm: ArrayLike) -> FloatArray:
        return self.volume.to_index(points_mm) * self.volume.spacing_mm

    def _in_inclusions(self, local_mm: FloatArray) -> Iterator[tuple[InclusionMotion, BoolArray]]:
        if not self.motions:
            return
        at = np.rint(local_mm / self.volume.spacing_mm).astype(int)
        size = np.array(self.volume.shape[::-1])
        x, y, z = np.clip(at, 0, size - 1).T
        number = np.where(((at >= 0) & (at < size)).all(axis=1), self.inclusions[z, y, x], 0)
        for motion in self.motions:
            yield motion, number == motion.number

    def _covariance(self, local_mm: FloatArray) -> FloatArray:
        out, r = self._cells_at(local_mm), self.volume.direction
        for motion, here in self._in_inclusions(local_mm):
            out[here] = r @ motion.displacement_covariance(local_mm[here]) @ r.T
        return out

    def _cells_at(self, local_mm: FloatArray) -> FloatArray:
        return self._between_cells(self.cell_covariance, local_mm)

    def _at_voxels(self, values: FloatArray) -> Float32Array:
        """Interpolate values (CZ, CY, CX, ...) of cells at all valid voxels, as `_between_cells` does; NaN at others."""
        parts = values.reshape(*values.shape[:3], -1)
        known: BoolArray = np.asarray(np.isfinite(parts).all(axis=-1))
        filled = np.concatenate([np.where(known[..., None], parts, 0.0), known[..., None]], axis=-1)
        x, y, z = (_linear(self.grid, a, axis) for a, axis in enumerate(self._axes))
        out = np.full((*self.volume.shape, parts.shape[-1]), np.nan, np.float32)
        doubtful = np.zeros(self.volume.shape, dtype=bool)
        for k in np.flatnonzero(self.valid.any(axis=(1, 2))):
            sums = separable_slice(x, y, z[k], filled)
            here = self.valid[k] & (sums[..., -1] > LEAST_KNOWN)
            out[k, here] = sums[here, :-1] / sums[here, -1:]
            doubtful[k] = self.valid[k] & ~here
        if doubtful.any():  # hardly a cell about them is known
            out[doubtful] = self._between_cells(parts, np.argwhere(doubtful)[:, ::-1] * self.volume.spacing_mm)
        return out.reshape(*self.volume.shape, *values.shape[3:])

    def _between_cells(self, values: FloatArray, local_mm: FloatArray) -> FloatArray:
        """Interpolate values (CZ, CY, CX, ...) of cells, among those that have one."""
        n = np.array(values.shape[2::-1])
        t = (local_mm - self.grid.origin_mm) / self.grid.step_mm - 0.5
        low = np.floor(t).astype(int)
        further = (1,) * (values.ndim - 3)
        out, total = np.zeros((len(t), *values.shape[3:])), np.zeros(len(t))
        known: BoolArray = np.asarray(np.isfinite(values).reshape(*values.shape[:3], -1).all(axis=-1))
        filled = np.where(known.reshape(*known.shape, *further), values, 0.0)
        for q in range(8):
            bit = np.array([q & 1, (q >> 1) & 1, q >> 2])
            at = low + bit
            inside = ((at >= 0) & (at < n)).all(axis=1)
            x, y, z = np.clip(at, 0, n - 1).T
            w = np.where(inside & known[z, y, x], np.maximum(np.prod(np.where(bit, t - low, 1 - (t - low)), axis=1), 1e-9), 0.0)
            out += w.reshape(-1, *further) * filled[z, y, x]
            total += w
        out[total > 0] /= total[total > 0].reshape(-1, *further)
        out[total == 0] = np.nan
        return out


def _linear(grid: SplineGrid, axis: int, at_mm: FloatArray) -> FloatArray:
    """Return the matrix (n, c) of linear interpolation between the middles of cells along an axis, at coordinates (n,), mm."""
    t = (at_mm - grid.origin_mm[axis]) / grid.step_mm[axis] - 0.5
    return np.asarray(np.maximum(1.0 - np.abs(t[:, None] - np.arange(grid.cells[axis])), 0.0))


def collected(
    volume: Volume,
    fit: CorrelationFit,
    c: FloatArray,
    samples: Float32Array,
    bending: FloatArray,
    dilatation: FloatArray,
    content: CommonContent,
    misfit: FloatArray,
    hidden: tuple[FloatArray, FloatArray],
    contrasts: Callable[[Float32Array], Sequence[WeightContrast]] = lambda _: (),
) -> CorrelationResult:
    """Return the result of a fit at full resolution.

    `samples` (n, 3, s) are random coefficients about c. Soft cells whose content is not in both volumes are not answered. `misfit` (m, 3)
    is that of `CorrelationFit.cell_misfit` at full resolution, and `hidden` two variances (m,): those of `hidden_dilatation`. `contrasts`
    gives those of `weight_contrasts`, given what penalising the field once more takes away, when the assembled equations are needed no
    more.

    Notes
    -----
    The samples hold the error of fields as rough, and as far from constant volume, as the penalties assume. That of others is a bias, whose
    size is estimated by smoothing the field once more, as in Tukey's twicing :cite:p:`tukey1977`, and by penalising its dilatation once
    more. Its direction is known only in part: what a penalty took from the true field was not parallel to what it takes from its estimate,
    but is large where the samples are, too, in the directions that the intensities leave open: see `bias_covariance`. What a part may have
    swollen by while noise hides it, and what large residuals tell of structures that no smooth field brings together, such as those on
    either side of organs that slide on each other, are added as variances along every axis. Errors that edges, or the parts of an object,
    have in common lie along what other weights of their voxels would move the field by: see
    `naibu.imaging.volume_correlation.results.weight_contrasts`.
    """
    system, level = fit.system, fit.level
    # the errors first: they take memory for every voxel of the object, and the fields below stay
    bias = biases(fit, c, bending, dilatation)
    remaining = np.where(fit.moving, (REMAINING * fit.last_steps_mm) ** 2, 0.0)
    misplaced = misplacement_variance(fit, misfit, content.unlike)
    sampled = sampled_covariance(fit, samples)
    taken = bias_covariance(fit, bias, sampled)
    shared, strained = contrast_errors(fit, c, contrasts(bias[0] / BENDING_BIAS + bias[1] / DILATATION_BIAS))
    taken += shared
    others = sampled + taken + (remaining + misplaced)[:, None, None] * np.eye(3)
    lost = variance_of_one_line(hidden[0], np.trace(others, axis1=1, axis2=2) / 3.0)
    biased = np.trace(taken, axis1=1, axis2=2) / 3.0 + lost
    covariance = per_cell(system.grid, fit, others + lost[:, None, None] * np.eye(3))
    strain_sd = np.sqrt(
        strain_variance(fit, c, samples, bias) + hidden[1] + strained + (remaining + misplaced) / float(system.grid.step_mm.min()) ** 2
    )
    fit.forget_equations()
    return_freed_memory()
    box = tuple(slice(int(a), int(b)) for a, b in zip(level.low, level.high, strict=True))
    valid = np.zeros(volume.shape, dtype=bool)
    valid[box] = _answered(fit, content)
    vectors, inclusions = _displacements(volume, fit, c, valid)
    maps = [np.full(volume.shape, np.nan, np.float32) for _ in range(2)]
    for full, listed in zip(maps, (fit.gain, fit.offset), strict=True):
        full[box][level.mask] = listed
        np.putmask(full, ~valid, np.nan)
    converged = np.ones(tuple(int(n) for n in system.grid.cells[::-1]), dtype=bool)
    converged[tuple(system.cells[:, 2:].T)] = ~fit.moving | ~system.inner
    of_strain, of_bias, of_place, bent, dilated = (
        per_cell(system.grid, fit, v) for v in (strain_sd, biased, misplaced, bending, dilatation)
    )
    return CorrelationResult(
        DisplacementField.on_grid(volume, vectors, valid=valid), system.grid, c, volume.direction @ covariance @ volume.direction.T,
        of_strain, of_bias, of_place, bent, dilated, fit.residual_sd,
        maps[0], maps[1], converged, inclusions, tuple(inclusion.motion for inclusion in fit.inclusions),
        _status(system.grid, volume, converged),
    )  # fmt: skip


def _displacements(volume: Volume, fit: CorrelationFit, c: FloatArray, valid: BoolArray) -> tuple[FloatArray, Int32Array]:
    """Return the displacement of every voxel that is answered, mm, not a number elsewhere, and the numbers of rigid inclusions."""
    axes = [np.arange(n) * s for n, s in zip(volume.shape[::-1], volume.spacing_mm, strict=True)]
    along = [fit.system.grid.matrix(a, axes[a]) for a in range(3)]
    vectors = np.full((*volume.shape, 3), np.nan)
    some = np.flatnonzero(valid.any(axis=(1, 2)))
    for k in some:
        vectors[k] = separable_slice(along[0], along[1], along[2][k], c)
    inclusions = np.zeros(volume.shape, np.int32)
    for inclusion in fit.inclusions:
        x, y, z = fit.level.index[inclusion.voxels].astype(int).T
        inclusions[z, y, x] = inclusion.number
        vectors[z, y, x] = inclusion.motion.displacement(inclusion.points)
    if not np.array_equal(volume.direction, np.eye(3)):
        vectors = vectors @ volume.direction.T
    for k in some:  # the places of all slices at once would take as much memory as the vectors
        vectors[k][~valid[k]] = np.nan
    return vectors, inclusions


def _answered(fit: CorrelationFit, content: CommonContent) -> BoolArray:
    """Return the voxels in the box around the object that have a displacement: content that both scans show, and rigid inclusions."""
    level = fit.level
    inside = level.mask.copy()
    answered = (content.matched & ~content.unlike)[fit.cell_of_voxel]
    for inclusion in fit.inclusions:
        answered[inclusion.voxels] = True
    inside[level.mask] = answered & level.shows(level.index * level.spacing + fit.displacement)
    return inside


def _middles_mm(grid: SplineGrid, volume: Volume, which: BoolArray) -> FloatArray:
    """Return the middles (n, 3), mm, of some cells."""
    local = grid.origin_mm + (np.argwhere(which)[:, ::-1] + 0.5) * grid.step_mm
    return volume.to_physical(local / volume.spacing_mm)


def _status(grid: SplineGrid, volume: Volume, converged: BoolArray) -> str:
    if converged.all():
        return "converged: no cell moved by more than a tenth of a voxel in the last step"
    at = _middles_mm(grid, volume, ~converged)
    low, high = np.round(at.min(axis=0), 1).tolist(), np.round(at.max(axis=0), 1).tolist()
    return f"not converged in {len(at)} cells, between {low} and {high} mm: see unconverged_mm"
