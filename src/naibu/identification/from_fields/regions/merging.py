"""Merging of clusters of cells into regions, by a quadratic approximation of half of chi squared."""

from __future__ import annotations

import numpy as np

from naibu.core.arrays import BoolArray, FloatArray, IntArray
from naibu.identification.from_fields.forward.sensitivities import Concentrated
from naibu.identification.from_fields.inversion.regularization import BULK_WEIGHT
from naibu.identification.from_fields.regions.contrast_prior import PRIOR_SD

CLEAR = 0.25  # jump of logarithms beyond which a border counts no more when regions are merged: noise and errors of models seldom make such


def merged(
    quadratic: Concentrated,
    theta: FloatArray,
    area: FloatArray,
    weight: float,
    charge: float,
    most: int | None = None,
    apart: BoolArray | None = None,
) -> tuple[IntArray, FloatArray]:
    """Merge clusters while that lowers the objective, all other moduli adapting at once.

    Parameters
    ----------
    quadratic : Concentrated
        Half of chi squared about `theta`.
    theta : ndarray, shape (2 k,)
        Logarithms of the clusters' moduli there.
    area : ndarray, shape (k, k)
        Of the faces between clusters, mm^2.
    weight : float
        Of total variation, 1/mm^2.
    charge : float
        What a region costs.
    most : int, optional
        How many times two are merged at most.
    apart : ndarray, shape (k, k), bool, optional
        Clusters that are not to be merged.

    Returns
    -------
    labels : ndarray, shape (k,), int64
        Region of every cluster.
    theta : ndarray, shape (2 regions,)
        Logarithms of the regions' moduli.
    """
    k = len(theta) // 2
    hessian = quadratic.hessian + np.eye(2 * k) / PRIOR_SD**2
    right = hessian @ theta - quadratic.gradient
    gather, forbidden = np.eye(k), np.zeros((k, k)) if apart is None else apart.astype(float)
    while True:
        both = np.kron(np.eye(2), gather)
        covariance = np.linalg.inv(both.T @ hessian @ both)
        best = covariance @ (both.T @ right)
        gains = _gains_of_merging(best, covariance, gather.T @ area @ gather, weight) + charge
        gains = np.where(gather.T @ forbidden @ gather > 0.0, -np.inf, gains)
        if gains.size == 1 or not gains.max() > 0.0 or k - gains.shape[0] == most:
            return gather.argmax(axis=1).astype(np.int64), best
        i, j = sorted(np.unravel_index(int(np.argmax(gains)), gains.shape))
        gather[:, i] += gather[:, j]
        gather = np.delete(gather, j, axis=1)


def _gains_of_merging(theta: FloatArray, covariance: FloatArray, area: FloatArray, weight: float) -> FloatArray:
    """Return by how much the objective falls when two regions become one (r, r); minus infinity on the diagonal."""
    r = len(area)
    jump = theta.reshape(2, r)[:, :, None] - theta.reshape(2, r)[:, None, :]
    blocks = covariance.reshape(2, r, 2, r).transpose(1, 3, 0, 2)  # (r, r, 2, 2)
    own = blocks[np.arange(r), np.arange(r)]
    of_jump = own[:, None] + own[None, :] - blocks - np.swapaxes(blocks, 2, 3)
    of_jump[np.arange(r), np.arange(r)] = np.eye(2)
    loss = 0.5 * np.einsum("aij,ijab,bij->ij", jump, np.linalg.inv(of_jump), jump)
    gains = weight * area * jump_costs(jump) - loss
    gains[np.arange(r), np.arange(r)] = -np.inf
    return np.asarray(gains)


def jump_costs(jump: FloatArray) -> FloatArray:
    """Return what jumps (2, ...) of the logarithms cost an area: their length, up to that of a clear one."""
    return np.asarray(np.minimum(np.hypot(jump[0], BULK_WEIGHT * jump[1]), CLEAR))
