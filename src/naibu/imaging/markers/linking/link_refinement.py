"""Refinement of links that have grown: every point is predicted by the linked points around it, in the metric of the residuals.

Noise may differ between axes (a microscope's along its optical axis) and from place to place. Residuals are therefore measured in
a metric in which they scatter equally along all axes, and compared with those around them, not with those of the whole cloud.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import gammaln

from naibu.core.arrays import FloatArray, IntArray
from naibu.imaging.markers.linking._point_matching_kernels import settle
from naibu.imaging.markers.linking.kriged_links import LEAST, fraction_around, kriged_links, linked_neighbours
from naibu.imaging.markers.linking.local_kriging import MEDIAN
from naibu.imaging.markers.linking.point_clouds import Cloud, State, grid_of, local_spacing, proposed
from naibu.imaging.markers.settings import LinkSettings

# Empirical values, judged by tests/imaging/markers/test_point_matching.py and benchmarks/particle_gels.py.
REFINEMENTS = 3  # rounds in each metric, at most
SETTLED = 0.005  # fraction of the points whose links change, from which on a round is the last
METRICS = 2  # times that the metric is estimated, beside the first rounds without one
MOST_ANISOTROPIC = 8.0  # ratio of standard deviations along two axes
ENOUGH = {2: 60, 3: 100}  # links from which on a metric is estimated
LOCAL = (0.5, 8.0)  # bounds of the local noise, as multiples of that of all
ALIKE = 1.2  # ratio of standard deviations up to which axes are alike
CORE = 3.0  # medians within which residuals tell the metric
CAUTION = 6.0  # how much more often chance is assumed to link than the densities say
WITNESSES, CREDIBLE = 16, 0.9  # links around, and their mean probability below which a link is less likely for it


@dataclass(frozen=True, slots=True, eq=False)
class RefinedLinks:
    """Deformed point of every reference point (-1: none), its residual, and what the links around say, all (n,).

    Attributes
    ----------
    link : ndarray, int64
        Index of the deformed point.
    vectors : ndarray, shape (n, d)
        Deformed point less its prediction, in the frame of the deformed points; NaN where there is no link.
    ratio : ndarray
        Length of the residual in standard deviations of the residuals around.
    volume : ndarray
        Product of these standard deviations along all axes, mm^d.
    tails : float
        Degrees of freedom of Student's distribution of the residuals: the fewer, the longer its tails.
    """

    link: IntArray
    vectors: FloatArray
    ratio: FloatArray
    volume: FloatArray
    tails: float = 12.0


def refined(cloud: Cloud, state: State, how: LinkSettings) -> RefinedLinks:
    """Predict every point from its linked neighbours, drop links of large residual and add those that fit, in turn.

    Parameters
    ----------
    cloud, state : Cloud, State
        Points and links that have grown; the links are changed in place.
    how : LinkSettings
        Limits of the residual.
    """
    d = cloud.dimensions
    metric = np.eye(d)
    here, predicted = cloud, _settled(cloud, state, how)
    for _ in range(METRICS if state.count >= ENOUGH[d] else 0):
        step = _whitening(_residuals(here, state, predicted))
        if step is None:
            break
        metric = step @ metric
        state.gradients = np.ascontiguousarray(np.einsum("ab,nbc->nac", step, state.gradients))
        here = _in_metric(cloud, metric)
        predicted = _settled(here, state, how)
    if state.count < ENOUGH[d]:
        length = np.linalg.norm(_residuals(here, state, predicted), axis=1)
        sd = np.maximum(_local_median(linked_neighbours(here, state), length) / MEDIAN[d], LEAST * here.growth * here.reference_scale)
    else:
        predicted, sd = kriged_links(here, state, how)
        length = np.linalg.norm(_residuals(here, state, predicted), axis=1)
    vectors = _residuals(here, state, predicted)
    return RefinedLinks(state.link, vectors @ np.linalg.inv(metric).T, length / sd, sd**d)


def _settled(cloud: Cloud, state: State, how: LinkSettings) -> FloatArray:
    """Drop and add links until nothing changes; return the predictions."""
    everyone = np.arange(len(cloud.reference))
    least, limit = (bound * cloud.growth * cloud.reference_scale for bound in how.residual_bounds)
    most, predicted = limit, np.full_like(cloud.reference, np.nan)
    for _ in range(REFINEMENTS):
        near = replace(cloud, neighbours=linked_neighbours(cloud, state))
        predicted, proposal, distance, fitted = proposed(near, state, everyone, limit, robust=True)
        residual = np.linalg.norm(_residuals(cloud, state, predicted), axis=1)
        limit = np.clip(how.residual_factor * _local_median(near.neighbours, residual), least, most)
        wrong = (state.link >= 0) & ~(residual <= limit)
        state.owner[state.link[wrong]] = -1
        state.link[wrong], state.residual[wrong] = -1, np.inf
        state.residual[state.link >= 0] = residual[state.link >= 0]
        proposal[~(distance <= limit)] = -1
        changed = settle(everyone, proposal, distance, state.link, state.owner, state.residual, fitted, state.gradients)
        if changed + int(wrong.sum()) <= SETTLED * len(everyone):
            break
    return predicted


def _residuals(cloud: Cloud, state: State, predicted: FloatArray) -> FloatArray:
    """Return deformed points less their predictions (n, d), NaN where there is no link."""
    out = cloud.deformed[np.maximum(state.link, 0)] - predicted
    out[state.link < 0] = np.nan
    return out


def _local_median(neighbours: IntArray, residual: FloatArray) -> FloatArray:
    """Return the median residual among the neighbours of every point (n,), within bounds of that of all; 0 where none is known."""
    known = np.isfinite(residual)
    if not known.any():
        return np.zeros(len(residual))
    overall = float(np.median(residual[known]))
    around = np.where(known, residual, overall)[neighbours]
    return np.asarray(np.clip(np.median(around, axis=1), LOCAL[0] * overall, LOCAL[1] * overall))


def _whitening(vectors: FloatArray) -> FloatArray | None:
    """Return the matrix (d, d) of determinant 1 after which residuals (n, d) scatter alike along all axes; None where they do already."""
    d = vectors.shape[1]
    known = vectors[np.isfinite(vectors).all(axis=1)]
    length = np.linalg.norm(known, axis=1)
    core = known[length <= CORE * np.median(length)] if len(known) >= ENOUGH[d] else known[:0]
    if len(core) < ENOUGH[d]:
        return None
    values, axes = np.linalg.eigh(core.T @ core / len(core))
    sd = np.sqrt(np.maximum(values, values[-1] / MOST_ANISOTROPIC**2))
    if not sd[0] > 0.0 or sd[-1] < ALIKE * sd[0]:
        return None
    return np.asarray((axes * (np.exp(np.mean(np.log(sd))) / sd)) @ axes.T)


def _in_metric(cloud: Cloud, metric: FloatArray) -> Cloud:
    """Return the clouds with the deformed points in a metric of determinant 1."""
    deformed = np.ascontiguousarray(cloud.deformed @ metric.T)
    scale = local_spacing(deformed)
    growth = float(np.mean(scale) / np.mean(cloud.reference_scale))
    return replace(cloud, deformed=deformed, deformed_scale=scale, grid=grid_of(deformed, scale), growth=growth)


def probability(found: RefinedLinks, reference: FloatArray, deformed: FloatArray) -> FloatArray:
    """Return the probability (n,) that each link is right, from its residual and the density of unlinked points; 0 where there is no link.

    Parameters
    ----------
    found : RefinedLinks
        Links and their residuals.
    reference, deformed : ndarray, shape (n, d), (m, d)
        Points, mm.
    """
    d = deformed.shape[1]
    linked = np.flatnonzero(found.link >= 0)
    at = found.link[linked]
    lost, free = found.link < 0, np.ones(len(deformed), dtype=bool)
    free[at] = False
    missing = fraction_around(reference, lost, reference[linked])
    # a point has a volume of about (spacing / 0.63)^d
    density = (0.63 / local_spacing(deformed)[at]) ** d
    by_chance = fraction_around(deformed, free, deformed[at]) * density * np.maximum(missing / (1.0 - missing), 1.0)
    freedom = found.tails
    t = np.exp(gammaln(0.5 * (freedom + d)) - gammaln(0.5 * freedom)) / (np.pi * freedom) ** (0.5 * d)
    right = t * (1.0 + found.ratio[linked] ** 2 / freedom) ** (-0.5 * (freedom + d)) / np.maximum(found.volume[linked], 1e-300)
    likely = right / np.maximum(right + CAUTION * by_chance, 1e-300)
    out = np.zeros(len(found.link))
    if len(linked):
        # where those around are wrong, so is what they predict
        near = np.asarray(cKDTree(reference[linked]).query(reference[linked], k=min(WITNESSES, len(linked)), workers=-1)[1])
        out[linked] = likely * np.minimum(likely[near.reshape(len(linked), -1)].mean(axis=1) / CREDIBLE, 1.0)
    return out
