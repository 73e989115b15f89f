"""Displacement of small blocks of voxels, each from its own intensities alone, so that errors of neighbours are independent.

The splines of volume correlation are smooth because of their penalties, which bias the field where the truth is not smooth, and correlate
errors over several cells. Who fits a model to the displacement wants neither. One Gauss-Newton step about the splines, for every block by
itself and without penalty, gives the displacement ``u + A^-1 f`` with the normal matrix A and the force f of the voxels of the block
:cite:p:`lucas1981`. What a model that lies near the splines makes of the intensities follows from it to first order, as in integrated
volume correlation :cite:p:`leclerc2011`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields

import numpy as np
from scipy import ndimage

from naibu.core.arrays import AnyFloatArray, BoolArray, Float32Array, FloatArray, IntArray
from naibu.core.displacement_field import DisplacementField
from naibu.core.volume import Volume
from naibu.imaging.volume_correlation._warp_kernels import add_to_cells
from naibu.imaging.volume_correlation.gauss_newton import CorrelationFit
from naibu.imaging.volume_correlation.residual_noise import ResidualNoise
from naibu.imaging.volume_correlation.splines.normal_equations import SplineSystem

BLOCKS = 8000  # about as many are made
LEAST_VOXELS, LEAST_EDGE = 8, 2  # of a block, and along its edges
MOST_SD = 2.0  # voxels, along the least certain direction: linear gradients reach no further
RIM = 2  # voxels from the surface, where air is mixed in, that are left out
FAR = 9.0  # mean square of a step, in variances, from which the splines are too far off for one step
LEFT = 0.5  # empirical: of the bias of the splines, what a step leaves: 0.5 to 0.8 in vessels and bone of legs, less elsewhere
DRAWS = 4  # of correlated noise: one factor for all blocks follows from them, to half a per cent
UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


@dataclass(frozen=True, slots=True, eq=False)
class BlockSums:
    """Sums over the voxels of small blocks, from which the displacement of each follows.

    Attributes
    ----------
    matrix : ndarray, shape (k, 3, 3)
        Normal matrices.
    force : ndarray, shape (k, 3)
        Forces of the residuals.
    drawn : ndarray, shape (k, 3, d)
        Forces of random residuals.
    count : ndarray, shape (k,)
        Voxels.
    middle : ndarray, shape (k, 3)
        Mean index x, y, z of the voxels, weighted by their information.
    displacement : ndarray, shape (k, 3)
        Mean displacement by the splines, weighted likewise, mm.
    """

    matrix: FloatArray
    force: FloatArray
    drawn: FloatArray
    count: FloatArray
    middle: FloatArray
    displacement: FloatArray

    @classmethod
    def joined(cls, parts: Sequence[BlockSums]) -> BlockSums:
        """Return the blocks of all parts."""
        return cls(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)))


def block_displacements(volume: Volume, fit: CorrelationFit, noise: ResidualNoise, seed: int, unlike: BoolArray) -> DisplacementField:
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
    unlike : ndarray, shape (m,), bool
        Cells whose content is not in both volumes: blocks there are left out.
    """
    inner = below_surface(np.pad(fit.level.mask, RIM))[fit.level.mask] & fit.seen
    rng = np.random.default_rng(seed)
    sums = sums_of_blocks(fit, inner, block_edge(int(inner.sum())), noise.draws(rng, DRAWS))
    alike = blocks_alike(fit.system, sums, sums.middle * fit.level.spacing, unlike)
    return displacement_of_blocks(volume, alike, fit.level.spacing, noise.scale)


def below_surface(mask: BoolArray) -> BoolArray:
    """Return which voxels are far enough from the surface; the mask is given with two more voxels at every face, the result without."""
    inside = (slice(RIM, -RIM),) * 3
    return np.asarray(ndimage.binary_erosion(mask, iterations=RIM)[inside])


def block_edge(voxels: int) -> int:
    """Return the edge of the blocks, voxels, for so many voxels in all."""
    return max(LEAST_EDGE, int(np.ceil((max(voxels, 1) / BLOCKS) ** (1.0 / 3.0))))


def sums_of_blocks(fit: CorrelationFit, inner: BoolArray, edge: int, draws: Iterable[Float32Array]) -> BlockSums:
    """Return the sums over blocks of `edge` voxels, of the listed voxels that are `inner` (n,), with those of random residuals (n,)."""
    block = _numbers(fit.level.mask, edge)[inner]
    count = np.bincount(block).astype(float)

    def sums(values: AnyFloatArray) -> FloatArray:
        out = np.zeros((len(count), int(np.prod(values.shape[1:]))))
        add_to_cells(block, np.ascontiguousarray(values.reshape(len(values), -1)[inner]), out)
        return out

    matrix = np.empty((len(count), 3, 3))
    for (i, j), total in zip(UPPER, sums(fit.products).T, strict=True):
        matrix[:, i, j] = matrix[:, j, i] = total
    weight = fit.products[:, [0, 3, 5]].sum(axis=1, dtype=float)
    total_weight = np.ones(len(inner))  # voxels outside of the blocks are not summed
    total_weight[inner] = np.maximum(sums(weight)[block, 0], 1e-300)
    share = (weight / total_weight)[:, None]
    root = np.sqrt(fit.weight)
    drawn = np.stack([sums((root * draw)[:, None] * fit.gradient) for draw in draws], axis=2)
    kept = count >= LEAST_VOXELS
    found = matrix, sums(fit.force), drawn, count, sums(share * fit.level.index), sums(share * fit.displacement)
    return BlockSums(*(values[kept] for values in found))


def _numbers(mask: BoolArray, edge: int) -> IntArray:
    """Return the number of the block of `edge` voxels in which every voxel (n,) of a mask lies."""
    nz, ny, _ = (-(-n // edge) for n in mask.shape)
    z, y, x = np.ogrid[tuple(slice(n) for n in mask.shape)]
    return np.asarray((((x // edge) * ny + y // edge) * nz + z // edge)[mask])


def blocks_alike(system: SplineSystem, sums: BlockSums, middle_mm: FloatArray, unlike: BoolArray) -> BlockSums:
    """Return the blocks whose middles (k, 3), mm, do not lie in cells (m,) that are `unlike` in both volumes."""
    dense = np.zeros(tuple(int(n) for n in system.grid.cells[::-1]), dtype=bool)
    dense[tuple(system.cells[unlike, 2:].T)] = True
    x, y, z = (system.grid.table(a, middle_mm[:, a])[0] for a in range(3))
    return BlockSums(*(getattr(sums, f.name)[~dense[z, y, x]] for f in fields(sums)))


def displacement_of_blocks(volume: Volume, sums: BlockSums, spacing: FloatArray, scale: float) -> DisplacementField:
    """Return the displacement of blocks with information in all directions; `scale` is that of `ResidualNoise`."""
    values, vectors = np.linalg.eigh(sums.matrix)
    longest = MOST_SD * float(np.prod(spacing) ** (1.0 / 3.0))
    good = values[:, 0] > longest**-2.0
    inverse = np.einsum("nik,nk,njk->nij", vectors[good], 1.0 / values[good], vectors[good])
    total, drawn = sums.force[good], sums.drawn[good]
    step = scale * np.einsum("nij,nj->ni", inverse, total)  # robust weights fall as residuals grow: forces rise less than A says
    variance = float(np.einsum("nid,nij,njd->nd", drawn, inverse, drawn).mean()) / 3.0 if good.any() else 0.0
    near, r = np.einsum("ni,ni->n", step, total) < 3.0 * FAR * variance, volume.direction
    covariance = r @ (variance * inverse[near]) @ r.T
    moved = (sums.displacement[good] + step)[near] @ r.T
    return DisplacementField.from_arrays(volume.to_physical(sums.middle[good][near]), moved, covariance=covariance)
