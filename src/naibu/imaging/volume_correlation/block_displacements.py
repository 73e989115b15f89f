"""Displacement of small blocks of voxels, each from its own intensities alone, so that errors of neighbours are independent.

The splines of volume correlation are smooth because of their penalties, which bias the field where the truth is not smooth, and correlate
errors over several cells. Who fits a model to the displacement wants neither. One Gauss-Newton step about the splines, for every block by
itself and without penalty, gives the displacement ``u + A^-1 f`` with the normal matrix A and the force f of the voxels of the block
:cite:p:`lucas1981`. What a model that lies near the splines makes of the intensities follows from it to first order, as in integrated
volume correlation :cite:p:`leclerc2011`.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from naibu.core.arrays import AnyFloatArray, FloatArray
from naibu.core.displacement_field import DisplacementField
from naibu.core.volume import Volume
from naibu.imaging.volume_correlation.gauss_newton import CorrelationFit
from naibu.imaging.volume_correlation.residual_noise import ResidualNoise

BLOCKS = 8000  # about as many are made
LEAST_VOXELS, LEAST_EDGE = 8, 2  # of a block, and along its edges
MOST_SD = 2.0  # voxels, along the least certain direction: linear gradients reach no further
RIM = 2  # voxels from the surface, where air is mixed in, that are left out
FAR = 9.0  # mean square of a step, in variances, from which the splines are too far off for one step
DRAWS = 8  # of correlated noise: one factor for all blocks follows from them
UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def block_displacements(volume: Volume, fit: CorrelationFit, noise: ResidualNoise, seed: int) -> DisplacementField:
    """Return the displacement of blocks of voxels, with covariance; errors of different blocks are independent.

    Parameters
    ----------
    volume : Volume
        Frame of the voxels.
    fit : CorrelationFit
        Residuals, gradients and weights at full resolution, at the splines that were found.
    noise : ResidualNoise
        Draws residuals that are correlated like those measured, by which the covariance of independent ones is scaled.
    seed : int
        Of these draws.
    """
    inner = ndimage.binary_erosion(np.pad(fit.level.mask, 1), iterations=RIM)[1:-1, 1:-1, 1:-1][fit.level.mask] & fit.seen
    edge = max(LEAST_EDGE, int(np.ceil((max(int(inner.sum()), 1) / BLOCKS) ** (1.0 / 3.0))))
    index = fit.level.index.astype(np.int64)
    _, block = np.unique((index - index.min(axis=0)) // edge, axis=0, return_inverse=True)
    block = block.ravel()
    count = np.bincount(block, inner).astype(float)

    def sums(values: AnyFloatArray) -> FloatArray:
        columns = (np.asarray(values, dtype=float).reshape(len(block), -1) * inner[:, None]).T
        return np.stack([np.bincount(block, c, minlength=len(count)) for c in columns], axis=1)

    matrix = np.empty((len(count), 3, 3))
    for (i, j), total in zip(UPPER, sums(fit.products).T, strict=True):
        matrix[:, i, j] = matrix[:, j, i] = total
    values, vectors = np.linalg.eigh(matrix)
    longest = MOST_SD * float(np.prod(fit.level.spacing) ** (1.0 / 3.0))
    good = (count >= LEAST_VOXELS) & (values[:, 0] > longest**-2.0)
    inverse = np.einsum("nik,nk,njk->nij", vectors[good], 1.0 / values[good], vectors[good])
    weight = fit.products[:, [0, 3, 5]].sum(axis=1, dtype=float)
    share = (weight / np.maximum(sums(weight)[:, 0], 1e-300)[block])[:, None]
    middle, mean = sums(share * fit.level.index)[good], sums(share * fit.displacement)[good]
    total = sums(fit.force)[good]
    step = noise.scale * np.einsum("nij,nj->ni", inverse, total)  # robust weights fall as residuals grow: forces rise less than A says
    rng, drawn = np.random.default_rng(seed), 0.0
    for _ in range(DRAWS):
        force = sums((np.sqrt(fit.weight) * noise.draw(rng))[:, None] * fit.gradient)[good]
        drawn += float(np.einsum("ni,nij,nj->n", force, inverse, force).mean()) / (3.0 * DRAWS)
    near, r = np.einsum("ni,ni->n", step, total) < 3.0 * FAR * drawn, volume.direction
    covariance = r @ (drawn * inverse[near]) @ r.T
    return DisplacementField.from_arrays(volume.to_physical(middle[near]), (mean + step)[near] @ r.T, covariance=covariance)
