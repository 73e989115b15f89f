"""Resolution level of digital volume correlation: voxels of the object, intensity gradients, gain and offset between the volumes.

Cubic B-spline coefficients come from the prefilter of :cite:t:`unser1999`.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg, ndimage

from naibu.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from naibu.imaging.preprocessing.field_of_view import Box
from naibu.imaging.volume_correlation._warp_kernels import OUTSIDE, gain_normal_equations, gain_values, sample_spline

MARGIN = 12  # voxels about the object that are kept of the reference: the prefilter's response at its edge has died out
# empirical: bounds of the gain, and prior SD of the local gain (of itself) and offset (of the SD of the intensities)
GAIN_RANGE = (0.2, 5.0)
GAIN_SD = 0.1
ENOUGH = 30000  # voxels from which one gain is estimated: its error is then far below that of the intensities


class ImageLevel:
    """Both volumes smoothed and subsampled, with the voxels of the object in a list.

    Attributes
    ----------
    spacing : ndarray, shape (3,)
        Distance of voxels, mm.
    low, high : ndarray, shape (3,), int
        Box of the object along z, y, x.
    mask : ndarray, bool
        The object in its box.
    number : ndarray, int32
        Number of every voxel of the box in the list, -1 outside the object.
    index : ndarray, shape (n, 3), float32
        Indices x, y, z of the listed voxels.
    intensity : ndarray, shape (n,), float32
        Their intensities in the reference.
    gradient : ndarray, shape (n, 3), float32
        Image intensity gradient of the reference, per mm.
    deformed : ndarray, float32
        Spline coefficients of the field of view of the deformed volume, padded.
    first : ndarray, shape (3,), float64
        Index x, y, z of the first voxel of that field of view.
    runs : ndarray, shape (m, 5), int64
        Lines of voxels: z, y, first x, x after the last, all in the box, and number in the list.
    """

    def __init__(
        self,
        reference: Float32Array,
        deformed: Float32Array,
        mask: BoolArray,
        spacing: FloatArray,
        stride: ArrayLike,
        sigma: float | FloatArray,
        views: tuple[Box, Box] | None = None,
    ) -> None:
        every = np.asarray(stride, dtype=int)[::-1]
        thin = tuple(slice(None, None, int(s)) for s in every)
        coarse = mask[thin]
        where = np.argwhere(coarse)
        self.low, self.high = where.min(axis=0), where.max(axis=0) + 1
        self.spacing = spacing * every[::-1]
        box = tuple(slice(int(a), int(b)) for a, b in zip(self.low, self.high, strict=True))
        # nothing outside the fields of view is smoothed into what is compared
        before_view, after_view = (_corners(v, reference.shape, every) for v in views or (None, None))
        near_low = np.maximum((self.low - MARGIN) * every, before_view[0])
        near = tuple(slice(int(a), int(b)) for a, b in zip(near_low, np.minimum((self.high + MARGIN) * every, before_view[1]), strict=True))
        shown = tuple(slice(int(a), int(b)) for a, b in zip(*after_view, strict=True))
        self.first = (after_view[0] // every)[::-1].astype(float)
        with ThreadPoolExecutor(2) as pool:
            jobs = [pool.submit(_thinned, v, sigma * every, thin) for v in (reference[near], deformed[shown])]
            (before, before_spline), (_, self.deformed) = (job.result() for job in jobs)
        shift = near_low // every
        inner = tuple(slice(int(a), int(b)) for a, b in zip(self.low - shift, self.high - shift, strict=True))
        self.mask = coarse[box]
        self.number = np.full(self.mask.shape, -1, dtype=np.int32)
        at = np.argwhere(self.mask)
        self.number[self.mask] = np.arange(len(at))
        self.index = np.ascontiguousarray((at + self.low)[:, ::-1]).astype(np.float32)
        self.intensity = np.ascontiguousarray(before[inner][self.mask])
        value, gradient = np.empty(len(at), np.float32), np.empty((len(at), 3), np.float32)
        sample_spline(before_spline, self.index - shift[::-1].astype(np.float32), value, gradient)
        self.gradient = gradient / self.spacing.astype(np.float32)
        edges = np.diff(np.pad(self.mask.astype(np.int8), ((0, 0), (0, 0), (1, 1))), axis=2)
        first, last = np.argwhere(edges == 1), np.argwhere(edges == -1)
        self.runs = np.column_stack([first, last[:, 2], self.number[tuple(first.T)]]).astype(np.int64, order="C")

    def sample(self, positions_mm: FloatArray, value: Float32Array, gradient: Float32Array) -> None:
        """Fill value (n,) and gradient (n, 3), per voxel, of the deformed volume at positions (n, 3), mm; OUTSIDE beyond its view."""
        sample_spline(self.deformed, (positions_mm / self.spacing - self.first).astype(np.float32), value, gradient)

    def shows(self, positions_mm: FloatArray) -> BoolArray:
        """Return which positions (n, 3), mm, lie in a voxel of the field of view of the deformed volume, the outer halves included."""
        at = positions_mm / self.spacing - self.first
        return np.asarray(((at >= -0.5) & (at <= np.array(self.deformed.shape[::-1]) - 3 - 0.5)).all(axis=1))

    def depth_mm(self, mask: BoolArray) -> Float32Array:
        """Return the distance (n,), mm, of the listed voxels from the surface of a mask of all voxels; the ends of the volume are none."""
        low, high = np.maximum(self.low - 1, 0), self.high + 1
        box = tuple(slice(int(a), int(b)) for a, b in zip(low, high, strict=True))
        inner = tuple(slice(int(a), int(b)) for a, b in zip(self.low - low, self.high - low, strict=True))
        # SciPy's distances of a whole box take four times the memory of the places of its nearest voxels
        nearest = ndimage.distance_transform_edt(mask[box], sampling=self.spacing[::-1], return_distances=False, return_indices=True)
        squared = np.zeros(len(self.index), np.float32)
        for axis in range(3):
            own = self.index[:, 2 - axis] - np.float32(low[axis])
            squared += ((nearest[axis][inner][self.mask] - own) * np.float32(self.spacing[2 - axis])) ** 2
        return np.sqrt(squared)

    def listed(self, values: BoolArray) -> BoolArray:
        """Return the values (n,) of an image (nz, ny, nx), on the grid of this level, at the listed voxels."""
        z, y, x = self.index.astype(int).T[::-1]
        return np.asarray(values[z, y, x])

    @property
    def axes_mm(self) -> list[FloatArray]:
        """Coordinates of the voxels of the box along x, y, z, mm."""
        return [np.arange(self.low[2 - a], self.high[2 - a]) * self.spacing[a] for a in range(3)]


def _corners(view: Box | None, shape: tuple[int, ...], every: IntArray) -> tuple[IntArray, IntArray]:
    """Return the first voxel (3,) of a field of view that the strides meet, and the one after its last."""
    low = np.array([0 if view is None else view[a].start or 0 for a in range(3)])
    high = np.array([shape[a] if view is None or view[a].stop is None else view[a].stop for a in range(3)])
    return -(-low // every) * every, high


def _thinned(values: Float32Array, sigma: FloatArray, thin: tuple[slice, ...]) -> tuple[Float32Array, Float32Array]:
    smooth = ndimage.gaussian_filter(values, sigma, mode="nearest", truncate=3.0)[thin]
    spline = ndimage.spline_filter(smooth, 3, output=np.float32, mode="mirror")
    return smooth, np.pad(spline, ((1, 2),) * 3, mode="reflect")


class GainMap:
    """Gain and offset from intensities of the deformed volume to those of the reference, trilinear on a coarse lattice."""

    def __init__(self, level: ImageLevel, cell_mm: float) -> None:
        self.level = level
        size = (level.high - level.low)[::-1]
        self.n = np.maximum(2, np.round(size * level.spacing / cell_mm).astype(np.int64) + 1)
        self.low, self.step = level.low[::-1].astype(float), np.maximum(size - 1, 1) / (self.n - 1)

    def everywhere(self, value: Float32Array, weight: Float32Array) -> tuple[float, float, float]:
        """Return one gain and offset for all voxels, and the SD of the intensities."""
        some = slice(None, None, max(1, len(value) // ENOUGH))
        ok = value[some] > 0.9 * OUTSIDE
        f, g, w = (np.asarray(v[some][ok], dtype=float) for v in (self.level.intensity, value, weight))
        total = max(float(w.sum()), 1e-30)
        mean_f, mean_g = float(w @ f) / total, float(w @ g) / total
        spread, wanted = float(w @ (g - mean_g) ** 2), float(w @ (f - mean_f) ** 2)
        # the ratio of SDs: the gain of a regression is too small before the volumes are registered
        gain = float(np.clip(np.sqrt(wanted / max(spread, 1e-30)), *GAIN_RANGE))
        return gain, mean_f - gain * mean_g, float(np.sqrt(spread / total))

    def local(self, value: Float32Array, weight: Float32Array, variance: float) -> FloatArray:
        """Return the most probable gain and offset (2 k,) at the points of the lattice, given the residual's variance."""
        matrix, load = self.normal_equations(value, weight)
        return most_probable_gain(matrix, load, variance, self.everywhere(value, weight))

    def normal_equations(self, value: Float32Array, weight: Float32Array) -> tuple[FloatArray, FloatArray]:
        """Return the matrix (2 k, 2 k) of gain and offset at the k points of the lattice, and loads (k, 3): `most_probable_gain`."""
        n = int(np.prod(self.n))
        left, right = np.zeros((2, 2 * n, 2 * n)), np.zeros((2, n, 3))
        gain_normal_equations(self.level.intensity, value, weight, self.level.index, self.low, self.step, self.n, left, right)
        return left.sum(axis=0), right.sum(axis=0)

    def corners(self, at: FloatArray) -> tuple[IntArray, FloatArray]:
        """Return the points (n, 8) of the lattice about voxel indices x, y, z (n, 3), and their trilinear weights; clipped to it."""
        t = np.clip((at - self.low) / self.step, 0.0, self.n - 1.0)
        cell = np.minimum(t.astype(np.int64), self.n - 2)
        far = np.array([[q & 1, (q >> 1) & 1, q >> 2] for q in range(8)])
        point = (cell[:, None] + far) @ np.array([1, self.n[0], self.n[0] * self.n[1]])
        return point, np.prod(np.where(far == 1, (t - cell)[:, None], 1.0 - (t - cell)[:, None]), axis=2)

    def values(self, solution: FloatArray) -> tuple[Float32Array, Float32Array]:
        """Return gain and offset (n,) at the listed voxels from those of the lattice (2 k,)."""
        a, b = np.empty(len(self.level.index), np.float32), np.empty(len(self.level.index), np.float32)
        gain_values(solution, self.level.index, self.low, self.step, self.n, a, b)
        return a, b


def most_probable_gain(matrix: FloatArray, load: FloatArray, variance: float, everywhere: tuple[float, float, float]) -> FloatArray:
    """Return gain and offset (2 k,) on a lattice by regression of the reference on the deformed volume, the most probable ones.

    Parameters
    ----------
    matrix : ndarray, shape (2 k, 2 k)
        Sums of products of the intensities of the deformed volume and ones: the matrix of least squares.
    load : ndarray, shape (k, 3)
        Sums of products of intensities of both volumes, of intensities of the reference, and of their squares.
    variance : float
        Of the residual.
    everywhere : tuple of float
        Gain and offset of all voxels, and SD of the intensities of the deformed volume.

    Notes
    -----
    Noise of the deformed volume makes the slope of a regression too small :cite:p:`fuller1987`. What is left of the texture would pull at
    edges, where it is largest: an object that moves rigidly swelled by up to a per cent in much noise. The part of the equations due to
    noise, as large in both volumes, has the gain of all voxels instead: a ratio of standard deviations, which is not diluted.
    """
    gain, offset, _ = everywhere
    first = np.tile([gain, offset], len(load))
    root = np.sqrt(np.minimum(_noise_variance(matrix, load), variance / (2.0 * gain**2)))
    both = load[:, :2].ravel() - matrix @ first
    both[::2] += gain * root * (matrix[1::2, 1::2] @ root)
    return np.asarray(first + linalg.solve(gain_curvature(matrix, variance, everywhere), both / variance, assume_a="pos"))


def gain_curvature(matrix: FloatArray, variance: float, everywhere: tuple[float, float, float]) -> FloatArray:
    """Return the matrix (2 k, 2 k) of gain and offset with their prior; arguments as of `most_probable_gain`."""
    gain, _, spread = everywhere
    prior = np.tile([(GAIN_SD * gain) ** -2, (GAIN_SD * gain * max(spread, 1e-30)) ** -2], len(matrix) // 2)
    return np.asarray(matrix / variance + np.diag(prior))


def _noise_variance(matrix: FloatArray, load: FloatArray) -> FloatArray:
    """Return the variance (k,) of the deformed volume's intensities about every point that does not correlate with the reference."""
    product, f, ff = load.T
    gg, g, count = matrix[::2, ::2].sum(axis=1), matrix[::2, 1::2].sum(axis=1), np.maximum(matrix[1::2, 1::2].sum(axis=1), 1e-30)
    of_f, of_g = (np.maximum(v / count - (u / count) ** 2, 0.0) for u, v in ((f, ff), (g, gg)))
    correlation = (product / count - f * g / count**2) / np.maximum(np.sqrt(of_f * of_g), 1e-30)
    return np.asarray(of_g * (1.0 - np.clip(correlation, 0.0, 1.0)))
