"""Random residuals with the spatial autocorrelation of the measured ones, for the covariance of digital volume correlation."""

from __future__ import annotations

import numpy as np
from scipy import fft

from naibu.core.arrays import AnyFloatArray, BoolArray, Float32Array

CORRELATED = 4.0  # empirical: SD, voxels, of the window on the autocorrelation, whose estimate at larger lags is chance


class ResidualNoise:
    """Noise with the autocorrelation of weighted residuals.

    Parameters
    ----------
    mask : ndarray, shape (nz, ny, nx), bool
        Voxels of the residuals in their box.
    weighted : ndarray, shape (n,)
        Residuals times the square roots of their weights.
    scale : float
        Factor on the noise.

    Notes
    -----
    The covariance of a fit whose weights take residuals for independent is ``A^-1 B A^-1`` :cite:p:`huber1967`, with B from the residuals
    as they are: smoothing, interpolation and model errors correlate neighbours, and B is larger than A.
    """

    def __init__(self, mask: BoolArray, weighted: Float32Array, scale: float = 1.0) -> None:
        self.mask, self.scale = mask, scale
        self.shape = [fft.next_fast_len(n + int(4 * CORRELATED), real=True) for n in mask.shape]
        box = np.zeros(mask.shape, np.float32)
        box[mask] = weighted
        inside = self._correlation(mask.astype(np.float32))
        lag = [np.minimum(np.arange(n), n - np.arange(n)) for n in self.shape]
        near = np.exp(-0.5 * sum(np.meshgrid(*[(g / CORRELATED) ** 2 for g in lag], indexing="ij")))
        correlation = self._correlation(box) / np.maximum(inside, 0.05 * inside[0, 0, 0]) * near
        power = np.maximum(fft.rfftn(correlation, workers=2).real, 0)
        self.amplitude = np.sqrt(power).astype(np.float32)

    def _correlation(self, box: Float32Array) -> AnyFloatArray:
        spectrum = fft.rfftn(box, self.shape, workers=2)
        return np.asarray(fft.irfftn(np.abs(spectrum) ** 2, self.shape, workers=2))

    def draw(self, rng: np.random.Generator) -> Float32Array:
        """Return random residuals (n,) of the voxels."""
        white = rng.standard_normal(self.shape, dtype=np.float32)
        coloured = fft.irfftn(fft.rfftn(white, workers=2) * self.amplitude, self.shape, workers=2)
        nz, ny, nx = self.mask.shape
        return np.asarray(self.scale * coloured[:nz, :ny, :nx][self.mask], dtype=np.float32)
