"""Random residuals of blocks, correlated as the measured ones: windows at random places of a few periodic fields, drawn once a process."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from scipy import fft

from naibu.core.arrays import AnyFloatArray, BoolArray, Float32Array
from naibu.imaging.large_volumes._window_kernels import fill_window
from naibu.imaging.volume_correlation.residual_noise import amplitude_of, coloured

FIELDS = 4  # periodic fields; a window has one of them, a place, an orientation and a sign
REACH = 15  # largest distance of correlated residuals, voxels
LEAST_EDGE = 48
_KEPT: OrderedDict[tuple[object, ...], list[Float32Array]] = OrderedDict()


@dataclass(frozen=True, slots=True, eq=False)
class NoiseTiles:
    """Periodic random fields with the autocorrelation of residuals.

    Attributes
    ----------
    shape : tuple of int
        Size, not less than that of any block.
    seed : int
        Of the fields and of the places of windows.
    products, pairs : ndarray
        Sums of products of residuals, and their numbers, by distance (see `lags`).
    """

    shape: tuple[int, int, int]
    seed: int
    products: AnyFloatArray
    pairs: AnyFloatArray

    @classmethod
    def for_blocks(cls, edges: tuple[int, ...], seed: int, products: AnyFloatArray, pairs: AnyFloatArray) -> NoiseTiles:
        """Return tiles that cover blocks with these edges."""
        z, y, x = (fft.next_fast_len(max(n, LEAST_EDGE), real=True) for n in edges)
        return cls((z, y, x), seed, products, pairs)

    def window(self, mask: BoolArray, block: int, number: int) -> Float32Array:
        """Return random residuals of the voxels of a block's mask; `number` is that of the random field."""
        rng = np.random.default_rng((self.seed, block, number))
        field = self._fields()[int(rng.integers(FIELDS))]
        axes = ((rng.integers(n), rng.choice([-1, 1]), m) for n, m in zip(field.shape, mask.shape, strict=True))
        z, y, x = ((first + sign * np.arange(m)) % n for (first, sign, m), n in zip(axes, field.shape, strict=True))
        out = np.empty(int(mask.sum()), np.float32)
        fill_window(field, mask, z, y, x, np.float32(rng.choice([-1, 1])), out)
        return out

    def _fields(self) -> list[Float32Array]:
        key = (self.shape, self.seed, self.products.tobytes())
        if key not in _KEPT:
            while len(_KEPT) > 1:
                _KEPT.popitem(last=False)
            _KEPT[key] = [self._drawn(np.random.default_rng((self.seed, k))) for k in range(FIELDS)]
        return _KEPT[key]

    def _drawn(self, rng: np.random.Generator) -> Float32Array:
        full = np.zeros(self.shape), np.zeros(self.shape)
        at = np.ix_(*(np.arange(-REACH, REACH + 1) % n for n in self.shape))
        for values, lagged in zip(full, (self.products, self.pairs), strict=True):
            values[at] = lagged
        return coloured(amplitude_of(*full), self.shape, rng)


def lags(periodic: AnyFloatArray) -> AnyFloatArray:
    """Return the part (2 r + 1, 2 r + 1, 2 r + 1) of periodic sums by distance at distances of at most r = REACH voxels."""
    return np.asarray(periodic[np.ix_(*(np.arange(-REACH, REACH + 1) % n for n in periodic.shape))])
