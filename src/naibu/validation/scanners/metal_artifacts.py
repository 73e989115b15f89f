"""Metal artefacts in CT slices: beam hardening in a filtered back projection :cite:p:`kak1988`.

Metal absorbs the soft part of the beam, so that twice as much of it attenuates a ray less than twice. Rays through two markers are
therefore too bright, and the reconstruction shows dark bands between them and bright streaks around.
"""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import Float32Array, FloatArray
from naibu.core.errors import InputError
from naibu.validation.scanners._render_kernels import back_projected, projected

VIEWS = 180  # one a degree


def streaks(metal: Float32Array, spacing_mm: FloatArray, loss_per_mm: float, *, views: int = VIEWS) -> Float32Array:
    """Return the streaks of metal in reconstructed slices.

    Parameters
    ----------
    metal : ndarray, shape (nz, ny, nx)
        Fraction of every voxel that metal fills.
    spacing_mm : ndarray, shape (3,)
        Spacing of the voxels along x, y, z, mm; the rays lie in slices.
    loss_per_mm : float
        A ray that crosses p mm of metal is measured as ``p (1 - loss_per_mm p)``.
    views : int
        Directions of parallel rays over half a turn.

    Returns
    -------
    ndarray, shape (nz, ny, nx)
        Error of the reconstructed fraction of metal: the filtered back projection of ``-loss_per_mm p^2``. In and around one round disc of
        radius r it is ``-loss_per_mm (8 / pi) sqrt(r^2 - s^2)`` at distance s from the middle, and zero outside.

    Raises
    ------
    InputError
        Fewer than two views.
    """
    if views < 2:
        raise InputError(f"views is {views}; at least two are needed")
    out = np.zeros(metal.shape, dtype=np.float32)
    filled = np.flatnonzero(metal.reshape(len(metal), -1).any(axis=1))
    if not len(filled):
        return out
    step = float(spacing_mm[:2].max())
    half = int(np.ceil(0.5 * float(np.hypot(metal.shape[2] * spacing_mm[0], metal.shape[1] * spacing_mm[1])) / step)) + 2
    angles = np.pi * np.arange(views) / views
    for k in filled:
        path = np.zeros((views, 2 * half + 1))
        projected(metal[k], spacing_mm[0], spacing_mm[1], angles, step, path)
        filtered = ramp_filtered(-loss_per_mm * path**2, step)
        back_projected(filtered, spacing_mm[0], spacing_mm[1], angles, step, out[k])
    return out


def ramp_filtered(projections: FloatArray, step_mm: float) -> FloatArray:
    """Return projections (views, n) convolved with the ramp (Ram-Lak) filter, per mm: equation (61) of chapter 3 of :cite:t:`kak1988`."""
    n = projections.shape[1]
    size = 1 << int(np.ceil(np.log2(2 * n)))
    at = np.fft.fftfreq(size, 1.0 / size).round()
    odd = np.abs(at) % 2 == 1
    kernel = np.zeros(size)
    kernel[odd] = -1.0 / (np.pi * at[odd] * step_mm) ** 2
    kernel[0] = 0.25 / step_mm**2
    spectrum = np.fft.rfft(projections, size, axis=1) * np.fft.rfft(kernel)
    return np.asarray(step_mm * np.fft.irfft(spectrum, size, axis=1)[:, :n])
