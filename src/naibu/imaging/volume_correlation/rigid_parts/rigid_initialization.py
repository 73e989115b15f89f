"""Rigid initialization of digital volume correlation: Gauss-Newton on intensities from several initial guesses.

Initial shifts are those of the highest cross-correlation, by Fourier transforms, and of the centroids.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy import fft
from scipy.spatial.transform import Rotation

from naibu.core.arrays import BoolArray, Float32Array, FloatArray
from naibu.imaging.volume_correlation._warp_kernels import OUTSIDE
from naibu.imaging.volume_correlation.image_level import ImageLevel

# empirical: rotations about each axis of the initial guesses, rad, and longest step; steps of all guesses, and of the best so many
TURN = np.deg2rad(10.0)
FIRST_STEPS, LAST_STEPS = 6, 30
BEST = 3
ROBUST = 2.0  # residual, in robust residual SD, where the weight has fallen to a quarter
# empirical: springs to the initial shift, and to the initial affine motion, in fractions of the stiffness that the intensities give: along
# a limb they determine little
ANCHORING = 0.1
ANCHORING_SHAPE = 0.1
LEAST_GAIN = 0.1  # a negative gain would drive the motion away from where intensities agree
FEWEST = 10  # voxels in the deformed volume, below which a motion is rejected


class RigidInitialization:
    """Search for the rigid motion of the listed voxels of a level: x to ``R (x - middle) + middle + t``, mm along the volume's axes."""

    def __init__(self, level: ImageLevel) -> None:
        self.level = level
        self.points = level.index.astype(float) * level.spacing
        self.middle = self.points.mean(axis=0)
        self.value, self.gradient = np.empty(len(self.points), np.float32), np.empty((len(self.points), 3), np.float32)

    def found(self, shifts: list[FloatArray]) -> list[tuple[FloatArray, FloatArray, float]]:
        """Return rotations (3, 3), translations (3,), mm, about the first voxel, and correlations, from guesses of the shift (3,), mm.

        The motion of the highest correlation is the first; then come others, and the guessed shifts without rotation.
        """
        tried = []
        for rotation, shift in _guesses(shifts):
            motion = self._improved(rotation, shift, shift, FIRST_STEPS)
            tried.append((self.correlation(*motion), *motion, shift))
        tried.sort(key=lambda t: -t[0])
        ended = [self._improved(r, t, guess, LAST_STEPS) for _, r, t, guess in tried[:BEST]]
        ended.sort(key=lambda m: -self.correlation(*m))
        ended += [(np.eye(3), shift) for shift in shifts]
        return [(r, t + self.middle - r @ self.middle, self.correlation(r, t)) for r, t in ended]

    def stretched(self, linear: FloatArray, shift: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """Return matrix (3, 3) and translation (3,), mm, of the affine motion found from a first one, and its correlation."""
        level, arm = self.level, self.points - self.middle
        size, first = np.sqrt((arm**2).mean(axis=0)) + level.spacing, (linear, shift)
        for _ in range(LAST_STEPS):
            self._sample(linear, shift)
            seen, r, weight, gain = self._residual()
            if seen.sum() < 20:
                break
            g = 0.5 * (gain * self.gradient / level.spacing + level.gradient @ np.linalg.inv(linear))
            arms = (g[:, :, None] * np.concatenate([arm / size, np.ones((len(arm), 1))], axis=1)[:, None, :]).reshape(len(arm), 12)
            matrix, load = (arms * weight[:, None]).T @ arms, arms.T @ (weight * r)
            anchor = ANCHORING_SHAPE * np.trace(matrix) / 12 + 1e-30
            gone = np.concatenate([(linear - first[0]) * size, (shift - first[1])[:, None]], axis=1).ravel()
            d = np.linalg.solve(matrix + anchor * np.eye(12), load - anchor * gone)
            d = (d * min(1.0, level.spacing.mean() / max(float(np.abs(d).max()), 1e-30))).reshape(3, 4)
            linear, shift = linear + d[:, :3] / size, shift + d[:, 3]
            if np.abs(d).max() < 0.01 * level.spacing.mean():
                break
        return linear, shift + self.middle - linear @ self.middle, self.correlation(linear, shift)

    def _residual(self) -> tuple[BoolArray, FloatArray, FloatArray, float]:
        """Return which voxels are seen, their residuals (n,), robust weights (n,), and the gain."""
        seen = self.value > 0.9 * OUTSIDE
        f, g = self.level.intensity.astype(float), np.where(seen, self.value, 0.0).astype(float)
        if seen.sum() < FEWEST:
            return seen, f, np.zeros(len(f)), 1.0
        f, g = f - f[seen].mean(), g - g[seen].mean()
        gain = max(float(f[seen] @ g[seen]) / max(float(g[seen] @ g[seen]), 1e-30), LEAST_GAIN)
        r = np.where(seen, f - gain * g, 0.0)
        residual_sd = 1.4826 * float(np.median(np.abs(r[seen])))
        return seen, r, np.where(seen, 1 / (1 + (r / max(ROBUST * residual_sd, 1e-30)) ** 2) ** 2, 0.0), gain

    def correlation(self, rotation: FloatArray, shift: FloatArray) -> float:
        """Return the normalised cross-correlation of the intensities, times the fraction of voxels in the deformed volume."""
        self._sample(rotation, shift)
        seen = self.value > 0.9 * OUTSIDE
        if seen.sum() < FEWEST:
            return -1.0
        f, g = self.level.intensity[seen].astype(float), self.value[seen].astype(float)
        f, g = f - f.mean(), g - g.mean()
        return float(f @ g / np.sqrt(max(float((f @ f) * (g @ g)), 1e-30)) * seen.mean())

    def _sample(self, rotation: FloatArray, shift: FloatArray) -> FloatArray:
        arm = (self.points - self.middle) @ rotation.T
        self.level.sample(arm + self.middle + shift, self.value, self.gradient)
        return np.asarray(arm)

    def _improved(self, rotation: FloatArray, shift: FloatArray, guess: FloatArray, steps: int) -> tuple[FloatArray, FloatArray]:
        level = self.level
        for _ in range(steps):
            arm = self._sample(rotation, shift)
            seen, r, weight, gain = self._residual()
            if seen.sum() < FEWEST:
                break
            g = 0.5 * (gain * self.gradient / level.spacing + level.gradient @ rotation.T)
            arms = np.concatenate([np.cross(arm, g), g], axis=1)
            matrix, load = (arms * weight[:, None]).T @ arms, arms.T @ (weight * r)
            anchor = ANCHORING * np.trace(matrix[3:, 3:]) / 3
            matrix[3:, 3:] += anchor * np.eye(3)
            load[3:] -= anchor * (shift - guess)
            d = np.linalg.solve(matrix + 1e-6 * np.diag(np.diag(matrix)) + 1e-30 * np.eye(6), load)
            d *= min(1.0, 2 * level.spacing.mean() / max(float(np.abs(d[3:]).max()), 1e-30), TURN / max(float(np.abs(d[:3]).max()), 1e-30))
            rotation, shift = Rotation.from_rotvec(d[:3]).as_matrix() @ rotation, shift + d[3:]
            if np.abs(d[3:]).max() < 5e-3 * level.spacing.mean() and np.abs(d[:3]).max() < 1e-4:
                break
        return rotation, shift


def _guesses(shifts: list[FloatArray]) -> Iterator[tuple[FloatArray, FloatArray]]:
    for shift in shifts:
        yield np.eye(3), shift
        for axis in range(3):
            for sign in (-1.0, 1.0):
                yield Rotation.from_rotvec(sign * TURN * np.eye(3)[axis]).as_matrix(), shift


def correlated_shift(reference: Float32Array, deformed: Float32Array, spacing: FloatArray) -> FloatArray:
    """Return the shift (3,), mm along x, y, z, at which two volumes (nz, ny, nx) correlate best, by Fourier transform."""
    shape = [fft.next_fast_len(2 * n, real=True) for n in reference.shape]
    a, b = (fft.rfftn(v - v.mean(), shape) for v in (reference, deformed))
    correlation = fft.irfftn(np.conj(a) * b, shape)
    peak = np.unravel_index(int(np.argmax(correlation)), correlation.shape)
    return np.array([(p if p < n // 2 else p - n) * s for p, n, s in zip(peak[::-1], shape[::-1], spacing, strict=True)], dtype=float)
