"""Random residuals with the spatial autocorrelation of the measured ones, for the covariance of digital volume correlation."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray
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
        self.scale = scale
        self.shape = padded_shape(mask.shape)
        self.factors = np.float32(scale) * _factors(amplitude_of(*lagged_products(mask, weighted)), self.shape)
        self.places = np.ravel_multi_index(np.nonzero(mask), self.shape)

    def draw(self, rng: np.random.Generator) -> Float32Array:
        """Return random residuals (n,) of the voxels."""
        return self._residuals(_spectrum(self.factors, rng))

    def draws(self, rng: np.random.Generator, count: int) -> Iterator[Float32Array]:
        """Give `count` times what `draw` returns; numbers are drawn while those before are transformed in a second thread."""
        with ThreadPoolExecutor(1) as pool:
            before = None
            for _ in range(count):
                job = pool.submit(self._residuals, _spectrum(self.factors, rng))
                if before is not None:
                    yield before.result()
                before = job
            if before is not None:
                yield before.result()

    def _residuals(self, spectrum: NDArray[np.complex64]) -> Float32Array:
        return np.asarray(_transformed(spectrum, self.shape).ravel().take(self.places), dtype=np.float32)


def lost_to_robustness(weights: float, derivatives: float) -> float:
    """Return the factor by which the normal matrix is too large, from `IntensityComparison.robust_sums`."""
    return weights / max(derivatives, 0.2 * weights)


def padded_shape(shape: Sequence[int]) -> list[int]:
    """Return a size for Fourier transforms in which a box does not meet itself within four windows."""
    return [fft.next_fast_len(int(n + 4 * CORRELATED), real=True) for n in shape]


def lagged_products(mask: BoolArray, weighted: Float32Array) -> tuple[AnyFloatArray, AnyFloatArray]:
    """Return the sums of products of residuals (n,) in a box, by their distance along z, y, x, and the number of such pairs; periodic."""
    box = np.zeros(mask.shape, np.float32)
    box[mask] = weighted
    shape = padded_shape(mask.shape)
    spectra = (fft.rfftn(v, shape, workers=2) for v in (box, mask.astype(np.float32)))
    products, pairs = (fft.irfftn(np.abs(s) ** 2, shape, workers=2) for s in spectra)
    return products, pairs


def amplitude_of(products: AnyFloatArray, pairs: AnyFloatArray) -> Float32Array:
    """Return the amplitudes of a Fourier transform with the autocorrelation of `lagged_products`, whose size is that of the field."""
    # the numbers are as exact as the products, which are of single precision, too
    correlation = np.maximum(pairs, 0.05 * pairs[0, 0, 0])
    np.divide(products, correlation, out=correlation)
    for axis, n in enumerate(products.shape):
        lag = np.minimum(np.arange(n), n - np.arange(n))
        near = np.exp(-0.5 * (lag / CORRELATED) ** 2).astype(correlation.dtype)
        correlation *= near.reshape([-1 if a == axis else 1 for a in range(3)])
    return np.asarray(np.sqrt(np.maximum(fft.rfftn(correlation, workers=2).real, 0)), dtype=np.float32)


def coloured(amplitude: Float32Array, shape: Sequence[int], rng: np.random.Generator) -> Float32Array:
    """Return a random periodic field (nz, ny, nx) of the given amplitudes (nz, ny, nx // 2 + 1), drawn frequency by frequency."""
    return _transformed(_spectrum(_factors(amplitude, shape), rng), shape)


def _factors(amplitude: Float32Array, shape: Sequence[int]) -> Float32Array:
    """Return standard deviations of the random coefficients of a real Fourier transform with these amplitudes."""
    factors = np.asarray(amplitude * np.float32(np.sqrt(0.5 * np.prod(shape))), dtype=np.float32)
    # of two frequencies of opposite sign one is drawn; where both are in the array the transform takes their mean
    factors[..., 0] *= np.float32(np.sqrt(2.0))
    if shape[-1] % 2 == 0:
        factors[..., -1] *= np.float32(np.sqrt(2.0))
    return factors


def _spectrum(factors: Float32Array, rng: np.random.Generator) -> NDArray[np.complex64]:
    spectrum = rng.standard_normal((*factors.shape, 2), dtype=np.float32).view(np.complex64)[..., 0]
    spectrum *= factors
    return spectrum


def _transformed(spectrum: NDArray[np.complex64], shape: Sequence[int]) -> Float32Array:
    return np.asarray(fft.irfftn(spectrum, shape, workers=2, overwrite_x=True), dtype=np.float32)
