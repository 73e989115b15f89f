"""Strain, volume ratio and Poisson's ratio inside a body from local affine fits to markers in two states.

Around every marker an affine map is fitted to its neighbours. This needs neither a lattice nor a model, and the uncertainty of the
positions propagates in closed form. The volume ratio distinguishes Poisson's ratios close to 0.5, and it can be measured wherever there are
markers, whatever the end conditions: a ratio of two strains requires a bar that is free to expand laterally.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import ndtri

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.core.markers import Markers
from naibu.identification.material_testing.uniaxial import PoissonRatio

REACH = 1.8  # distances to the nearest neighbour: includes the 26 neighbours of a marker in a cubic lattice
FLAT = 0.1  # a neighbourhood whose thinnest extent is below this fraction of its widest does not determine strain across it


@dataclass(frozen=True, slots=True, eq=False)
class MarkerStrain:
    """Local affine maps around markers.

    Attributes
    ----------
    ids : ndarray, shape (k,), int64
        Markers around which a map could be fitted.
    points : ndarray, shape (k, 3)
        Centres of the neighbourhoods in the reference configuration, mm.
    gradients : ndarray, shape (k, 3, 3)
        Deformation gradients F.
    volume_ratio, volume_ratio_sd : ndarray, shape (k,)
        det F, and its standard deviation from that of the positions.
    stretches, stretch_sd : ndarray, shape (k, 3)
        Principal stretches, from the largest to the smallest, and their standard deviations.
    residual_sd : float
        Standard deviation of a coordinate about the affine maps, mm: what positions err, and how much the strain varies in a neighbourhood.
    sd_of_mean_log_volume : float
        Standard deviation of the mean of ln(volume_ratio); neighbourhoods overlap, so it is more than that of independent values.
    """

    ids: IntArray
    points: FloatArray
    gradients: FloatArray
    volume_ratio: FloatArray
    volume_ratio_sd: FloatArray
    stretches: FloatArray
    stretch_sd: FloatArray
    residual_sd: float
    sd_of_mean_log_volume: float


@dataclass(frozen=True, slots=True, eq=False)
class _Fits:
    """Neighbourhoods as sparse weights: ``F_i = sum_j y_j w_ij^T``."""

    ids: IntArray
    neighbours: list[IntArray]
    weights: list[FloatArray]
    centres: FloatArray
    gradients: FloatArray
    residual_sd: float
    n_markers: int


def marker_strain(initial: Markers, deformed: Markers, *, sd_mm: float = 0.15, reach_mm: float | None = None) -> MarkerStrain:
    """Fit affine maps to the neighbourhoods of all markers that are complete in both states.

    Parameters
    ----------
    initial, deformed : Markers
        Free and loaded state, mm; markers that are not trusted or lack a coordinate are left out.
    sd_mm : float
        Standard deviation of a coordinate in either state, mm.
    reach_mm : float, optional
        Radius of a neighbourhood in the reference configuration, mm; by default 1.8 times the median distance of nearest neighbours.

    Raises
    ------
    InputError
        Nowhere are there enough neighbours that span a volume, or a radius or standard deviation that is not positive.
    """
    fits = _fits(initial, deformed, sd_mm, reach_mm)
    f = fits.gradients
    volume = np.linalg.det(f)
    u, stretches, vt = np.linalg.svd(f)
    along = np.einsum("kia,kaj->kaij", u, vt)  # derivative of each principal stretch with respect to F
    inverse_transpose = np.asarray(np.linalg.inv(f).transpose(0, 2, 1), dtype=np.float64)
    sd = [np.sqrt(_variances(fits, direction, sd_mm)) for direction in (inverse_transpose, *along.transpose(1, 0, 2, 3))]
    mean_sd = float(np.sqrt(_variance_of_mean(fits, inverse_transpose, sd_mm)))
    return MarkerStrain(
        fits.ids, fits.centres, f, volume, volume * sd[0], stretches, np.stack(sd[1:], axis=1), fits.residual_sd, mean_sd
    )  # fmt: skip


def poisson_ratio_from_markers(
    initial: Markers,
    deformed: Markers,
    *,
    axis: int = 2,
    sd_mm: float = 0.15,
    reach_mm: float | None = None,
    scale_sd: float = 0.0,
    confidence: float = 0.95,
) -> PoissonRatio:
    """Compute Poisson's ratio from the change of volume inside a compressed body, averaged over all neighbourhoods.

    With J = det F and l the stretch of the material along `axis`, ``nu = (1 - mean ln J / mean ln l) / 2`` (Hencky strains). Where
    friction constrains the sides, the pressure is higher than in a free bar and the volume shrinks more at the same l: the true ratio
    is then a little closer to 0.5 than what is returned.

    Parameters
    ----------
    initial, deformed, sd_mm, reach_mm
        As for `marker_strain`.
    axis : int
        Direction of the load, 0, 1 or 2.
    scale_sd : float
        Relative standard deviation of the scale of lengths between the two scans, the same in all directions.
    confidence : float
        Of the interval.

    Raises
    ------
    InputError
        As `marker_strain`; or an inverted neighbourhood, or no strain along the axis.
    """
    if axis not in (0, 1, 2) or not 0.0 < confidence < 1.0 or not scale_sd >= 0.0:
        raise InputError(f"axis must be 0, 1 or 2, confidence within (0, 1), scale_sd >= 0, not {axis}, {confidence:g}, {scale_sd:g}")
    fits = _fits(initial, deformed, sd_mm, reach_mm)
    f = fits.gradients
    volume = np.linalg.det(f)
    if not volume.min() > 0.0:
        raise InputError(f"the markers around marker {fits.ids[np.argmin(volume)]} are turned inside out: check the labels in both states")
    line = f[:, :, axis]
    log_volume, log_stretch = float(np.log(volume).mean()), float(np.log(np.linalg.norm(line, axis=1)).mean())
    if abs(log_stretch) < 1e-12:
        raise InputError("the markers show no strain along the axis of the load; give the axis along which the body was pressed")
    of_volume = np.asarray(np.linalg.inv(f).transpose(0, 2, 1), dtype=np.float64)
    of_stretch = np.zeros_like(f)
    of_stretch[:, :, axis] = line / (line**2).sum(axis=1)[:, None]
    direction = -0.5 * (of_volume - (log_volume / log_stretch) * of_stretch) / log_stretch
    by_scale = -0.5 * (3.0 - log_volume / log_stretch) / log_stretch
    value = 0.5 * (1.0 - log_volume / log_stretch)
    error = float(np.sqrt(_variance_of_mean(fits, direction, sd_mm) + (by_scale * scale_sd) ** 2))
    volume_error = float(np.sqrt(_variance_of_mean(fits, of_volume, sd_mm) + (3.0 * scale_sd) ** 2))
    mean_volume = float(np.exp(log_volume))
    half = float(ndtri(0.5 + 0.5 * confidence)) * error
    return PoissonRatio(value, error, (value - half, value + half), mean_volume, mean_volume * volume_error, "hencky")


def _fits(initial: Markers, deformed: Markers, sd_mm: float, reach_mm: float | None) -> _Fits:
    if not 0.0 < sd_mm < np.inf or not (reach_mm is None or reach_mm > 0.0):
        raise InputError(f"sd_mm and reach_mm must be positive, not {sd_mm} and {reach_mm}")
    x = np.where(initial.trusted[:, None], initial.points, np.nan)
    y = deformed.aligned(initial.ids) if len(deformed) else np.full_like(x, np.nan)
    whole = np.isfinite(x).all(axis=1) & np.isfinite(y).all(axis=1)
    ids, x, y = initial.ids[whole], x[whole], y[whole]
    if len(x) < 5:
        raise InputError(f"only {len(x)} markers are complete in both states; at least 5, not in one plane, are needed")
    tree = cKDTree(x)
    nearest = np.asarray(tree.query(x, k=2)[0])[:, 1]
    reach = REACH * float(np.median(nearest)) if reach_mm is None else reach_mm
    members = [np.sort(np.array(tree.query_ball_point(point, reach), dtype=np.int64)) for point in x]
    kept, weights, gradients, centres = [], [], [], []
    squares, freedom = 0.0, 0
    for at, group in enumerate(members):
        local, moved = x[group] - x[group].mean(axis=0), y[group] - y[group].mean(axis=0)
        extent = np.linalg.svd(local, compute_uv=False)
        if len(group) < 5 or extent[-1] < FLAT * extent[0]:
            continue
        w = local @ np.linalg.inv(local.T @ local)
        f = moved.T @ w
        residual = moved - local @ f.T
        squares, freedom = squares + float((residual**2).sum()), freedom + 3 * (len(group) - 4)
        kept.append(at)
        weights.append(w)
        gradients.append(f)
        centres.append(x[group].mean(axis=0))
    if not kept:
        raise InputError(f"no marker has enough neighbours within {reach:.3g} mm that span a volume; give a larger reach_mm")
    neighbours = [members[at] for at in kept]
    return _Fits(ids[kept], neighbours, weights, np.array(centres), np.array(gradients), float(np.sqrt(squares / freedom)), len(x))


def _variances(fits: _Fits, direction: FloatArray, sd_mm: float) -> FloatArray:
    """Variance (k,) of ``direction_i : F_i`` (direction (k, 3, 3)).

    An error dx of a free position acts like an error -F dx of the loaded one, to first order in the strain's variation.
    """
    out = np.empty(len(fits.ids))
    for i, w in enumerate(fits.weights):
        out[i] = _noise(w @ direction[i].T, fits.gradients[i], sd_mm)
    return out


def _noise(sensitivity: FloatArray, gradient: FloatArray, sd_mm: float) -> float:
    """Variance of ``sum_j sensitivity_j . (dy_j - F dx_j)`` for sensitivities (m, 3)."""
    return sd_mm**2 * float((sensitivity**2).sum() + ((sensitivity @ gradient) ** 2).sum())


def _variance_of_mean(fits: _Fits, direction: FloatArray, sd_mm: float) -> float:
    """Variance of the mean of ``direction_i : F_i``; errors of a marker are shared by all neighbourhoods it belongs to."""
    of_loaded, of_free = np.zeros((fits.n_markers, 3)), np.zeros((fits.n_markers, 3))
    for group, w, g, f in zip(fits.neighbours, fits.weights, direction, fits.gradients, strict=True):
        sensitivity = w @ g.T
        of_loaded[group] += sensitivity
        of_free[group] -= sensitivity @ f
    return sd_mm**2 * float((of_loaded**2).sum() + (of_free**2).sum()) / len(fits.ids) ** 2
