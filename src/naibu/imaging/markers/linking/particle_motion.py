"""Motion of particles between two states: links, displacement with its covariance, and strain, from the particles around each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from naibu.core.arrays import BoolArray, FloatArray, IntArray, require_shape
from naibu.core.displacement_field import DisplacementField
from naibu.core.errors import InputError
from naibu.imaging.displacement.strain import green_lagrange_strain_of
from naibu.imaging.markers.linking.kriged_links import SUSPECT
from naibu.imaging.markers.linking.local_kriging import KRIGED, MEDIAN, LocalKriging, kriged_gradient
from naibu.imaging.markers.linking.point_clouds import local_spacing
from naibu.imaging.markers.linking.point_matching import Links, link_markers
from naibu.imaging.markers.settings import LinkSettings, require_between

# Empirical values, judged by tests/imaging/markers/linking/test_particle_motion.py.
FLAT = 0.05  # ratio of the extents of neighbours below which they lie in a plane or on a line, and tell no strain across it
ROUNDS = 3  # of the robust fit
CORE = 3.0  # medians within which residuals tell the noise
WHITENED = 1  # times that displacements are scaled to noise that is alike along all axes
LEAST_SD = 1e-6  # of the distance between neighbours: positions are written with as many digits


@dataclass(frozen=True, slots=True, eq=False)
class ParticleMotion:
    """Displacement and strain of linked particles.

    Attributes
    ----------
    field : DisplacementField
        At the reference positions of the k linked particles, with the covariance of each displacement, mm^2; valid where the link is
        trusted. ``quality`` is the probability that the link is right.
    links : Links
        Pairs of particles, in the order of the field.
    gradient : ndarray, shape (k, d, d)
        Displacement gradient ``du_a / dx_b`` of the motion of the particles around, by kriging; NaN along the normal of particles in
        a plane.
    gradient_sd : ndarray, shape (k, d, d)
        Its standard deviation, from the noise of the displacements around and what the motion varies between them.
    """

    field: DisplacementField
    links: Links
    gradient: FloatArray
    gradient_sd: FloatArray

    @property
    def strain(self) -> FloatArray:
        """Green-Lagrange strain (k, d, d)."""
        d = self.gradient.shape[1]
        full = np.zeros((len(self.gradient), 3, 3))
        full[:, :d, :d] = self.gradient
        return np.asarray(green_lagrange_strain_of(full)[:, :d, :d])


def particle_motion(
    reference_points: ArrayLike,
    deformed_points: ArrayLike,
    *,
    reference_sd_mm: ArrayLike | None = None,
    deformed_sd_mm: ArrayLike | None = None,
    min_confidence: float = 0.5,
    seed: int = 0,
    settings: LinkSettings | None = None,
) -> ParticleMotion:
    """Link the particles of two states, and return their displacement with its covariance, and the strain.

    Parameters
    ----------
    reference_points, deformed_points : array_like, shape (n, d), (m, d)
        Particles of the two states, mm, in any order, in two or three dimensions.
    reference_sd_mm, deformed_sd_mm : array_like, shape (n, d), (m, d), optional
        Standard deviations of their coordinates, mm. Without both, the covariance of the displacements follows from how far each is from
        what those around predict. With both, they are raised by a common factor where these residuals are larger.
    min_confidence : float
        Probability below which a link is not valid in the field, 0 to 1.
    seed, settings
        See `link_markers`.

    Returns
    -------
    ParticleMotion
        Field, links and gradients.

    Raises
    ------
    InputError
        Clouds that `link_markers` refuses, or fewer trusted links than a displacement gradient needs.
    """
    require_between("min_confidence", min_confidence, 0.0, 1.0)
    x, y = np.asarray(reference_points, dtype=float), np.asarray(deformed_points, dtype=float)
    links = link_markers(x, y, seed=seed, settings=settings)
    here, there = links.pairs.T
    at, moved = x[here], y[there] - x[here]
    d = x.shape[1]
    trusted = links.confidence >= min_confidence
    if trusted.sum() < d + 3:
        raise InputError(f"only {int(trusted.sum())} of {len(links)} links are trusted; a displacement gradient needs {d + 3} particles")
    neighbours = _neighbours(at, trusted)
    residual, gradient, unit_variance = _kriged(at, moved, trusted, neighbours)
    covariance = _noise(residual, trusted, neighbours, at)
    noise = np.einsum("naa->na", covariance)
    stated = _stated(x.shape, y.shape, reference_sd_mm, deformed_sd_mm)
    if stated is not None:
        covariance = _raised(stated[0][here] ** 2 + stated[1][there] ** 2, residual, trusted)
        noise = np.maximum(noise, np.einsum("naa->na", covariance))
    gradient_sd = np.sqrt(noise[:, :, None] * unit_variance[:, None, :])
    field = DisplacementField.from_arrays(at, moved, covariance=covariance, valid=trusted)
    field = DisplacementField(field.support, moved, covariance, trusted, links.confidence)
    return ParticleMotion(field, links, gradient, gradient_sd)


def _neighbours(at: FloatArray, trusted: BoolArray) -> IntArray:
    """Return the nearest trusted particles (k, c) of every one, itself left out."""
    known = np.flatnonzero(trusted)
    count = min(KRIGED[at.shape[1]], len(known) - 1)
    near = known[np.asarray(cKDTree(at[known]).query(at, k=count + 1, workers=-1)[1])]
    left_out = near == np.arange(len(at))[:, None]
    left_out[~left_out.any(axis=1), -1] = True
    return np.asarray(near[~left_out].reshape(len(at), count))


def _kriged(at: FloatArray, moved: FloatArray, trusted: BoolArray, neighbours: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Predict every displacement from those of its neighbours, and its gradient also from its own.

    Returns the difference (k, d) of each displacement from its prediction, scaled to the standard deviation of a displacement, the
    gradients (k, d, d), and the variance (k, d) of their columns for displacements of unit variance. The scale counts only what the noise
    of the neighbours carries into a prediction: the motion is often less rough, along some axis, than the process takes it for.
    """
    d, everyone, scale = at.shape[1], np.arange(len(at)), local_spacing(at)
    values, white, noise = moved, np.eye(d), np.ones(len(at))
    process, least = LocalKriging(at, scale), LEAST_SD * scale
    for _ in range(WHITENED):
        process.update(everyone, neighbours, values, trusted, noise)
        off = values - process.predicted
        noise = np.maximum(np.linalg.norm(off, axis=1) / (SUSPECT * np.sqrt(d) * np.maximum(process.sd, least)), 1.0) ** 4
        scaled = off / np.sqrt(1.0 + process.carried)[:, None]
        factor = np.linalg.cholesky(np.linalg.inv(_shape(scaled[trusted], at, neighbours)))
        values, white = values @ factor, white @ factor
    process.update(everyone, neighbours, values, trusted, noise)
    residual = (values - process.predicted) / np.sqrt(1.0 + process.carried)[:, None] @ np.linalg.inv(white)
    own = np.ascontiguousarray(np.column_stack([everyone, neighbours[:, :-1]]))
    gradient, variance = kriged_gradient(at, scale, own, values, noise, process.roughness)
    gradient = np.einsum("ca,ncb->nab", np.linalg.inv(white), gradient)
    offset = at[neighbours] - at[neighbours].mean(axis=1, keepdims=True)
    extents = np.linalg.svd(offset, compute_uv=False)
    gradient[extents[:, -1] < FLAT * extents[:, 0]] = np.nan
    return residual, gradient, variance


def _noise(residual: FloatArray, trusted: BoolArray, neighbours: IntArray, at: FloatArray) -> FloatArray:
    """Return the covariance (k, d, d) of displacements: one ellipsoid, scaled by the residuals around each."""
    d = residual.shape[1]
    shape = _shape(residual[trusted], at, neighbours)
    length = np.sqrt(np.einsum("na,ab,nb->n", residual, np.linalg.inv(shape), residual))
    level = np.maximum(np.median(length[neighbours], axis=1) / MEDIAN[d], 0.1) ** 2
    # where residuals are larger in some places than in others, most of them are below their root mean square, and so are their medians
    core = trusted & (length <= CORE * np.median(length[trusted]))
    level /= min(float(level[core].mean()), 1.0)
    return np.asarray(level[:, None, None] * shape)


def _shape(known: FloatArray, at: FloatArray, neighbours: IntArray) -> FloatArray:
    """Return the covariance (d, d) of the core of residuals (m, d), mm^2."""
    d = known.shape[1]
    least = (LEAST_SD * float(np.sqrt(np.median(np.sum((at[neighbours[:, 0]] - at) ** 2, axis=1))))) ** 2
    shape = np.eye(d) * max(float(np.median(np.linalg.norm(known, axis=1))) ** 2, least)
    for _ in range(2 * ROUNDS):
        length = np.sqrt(np.einsum("na,ab,nb->n", known, np.linalg.inv(shape), known))
        core = known[length <= CORE * np.median(length)]
        shape = core.T @ core / len(core) + least * np.eye(d)
    return np.asarray(shape)


def _stated(
    n: tuple[int, ...], m: tuple[int, ...], reference: ArrayLike | None, deformed: ArrayLike | None
) -> tuple[FloatArray, FloatArray] | None:
    """Return the stated standard deviations of both states, or None unless both are there."""
    if reference is None or deformed is None:
        return None
    sd = np.asarray(reference, dtype=float), np.asarray(deformed, dtype=float)
    for name, values, shape in zip(("reference_sd_mm", "deformed_sd_mm"), sd, (n, m), strict=True):
        require_shape(name, values, shape)
        if not (values >= 0.0).all():
            raise InputError(f"{name} must hold standard deviations >= 0, mm")
    return sd


def _raised(variance: FloatArray, residual: FloatArray, trusted: BoolArray) -> FloatArray:
    """Return stated variances (k, d) as covariances (k, d, d), raised where residuals are larger."""
    d = variance.shape[1]
    ratio = np.sqrt(np.sum(residual[trusted] ** 2 / np.maximum(variance[trusted], 1e-300), axis=1))
    factor = max(float(np.median(ratio)) / MEDIAN[d], 1.0) ** 2
    return np.asarray(factor * variance[:, :, None] * np.eye(d))
