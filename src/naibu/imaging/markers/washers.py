"""Localisation of washers thinner than the slices of a volume: the posterior mean of height and tilt.

A plate inside one slice may lie anywhere in it, and where it reaches into the next one a small fraction of the intensity means a large
fraction of its thickness: the intensity-weighted centroid is off by up to a third of a slice. Here every height and tilt on a grid is
weighted by its likelihood; the result is the posterior mean, with the posterior standard deviation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import erf

from naibu.core.arrays import AnyFloatArray, FloatArray, IntArray
from naibu.imaging.markers._washer_kernels import column_sums, weigh_plates

# Empirical values, judged by tests/imaging/markers/test_detection.py and benchmarks/sense_markers.py, unless said otherwise.
# prior of the tilt of a plate in the gel: standard deviation and largest value of its slope, and number of slopes that are tried
TILT_SD, STEEPEST, TILTS = 0.12, 0.32, 9
HEIGHTS, REACH_SLICES = 45, 0.85  # number of heights that are tried, and largest distance from the start, slices
# blur across the slices that is tried, slices; number of plates by which it is chosen
BLURS, CHOOSING = (0.0, 0.2, 0.35, 0.5), 20
# a blur is accepted if it lowers the mean squared residual below this fraction: a small gain may be due to model errors
BLURRED = 0.93
# standard deviation, in slices, of the bias of heights by what is not modelled: the hole, sampling, a bent plate
MODEL_SD = 0.04
# fraction of the strongest slice of a plate from which on a slice counts
SEEN = 0.15
TABLE_STEP = 0.01  # of the tabulated slice profile, slices
# columns of voxels are used where the plate covers at least this fraction of its best covered column
COVERED = 0.04
CENTRINGS = 4  # rounds in which the radial profile is estimated and fitted


@dataclass(frozen=True, slots=True, eq=False)
class PlacedPlates:
    """Positions of plates.

    Attributes
    ----------
    centres_mm, sd_mm : ndarray, shape (n, 3)
        Position (index times spacing along x, y, z) and its standard deviation, mm; NaN where a plate is too close to the edge of the
        volume.
    """

    centres_mm: FloatArray
    sd_mm: FloatArray


def placed_plates(
    values: AnyFloatArray,
    spacing_mm: FloatArray,
    centres_mm: FloatArray,
    *,
    axis: int,
    diameter_mm: float,
    thickness_mm: float,
    along: bool,
) -> PlacedPlates:
    """Return the centres of equal plates that are thin along an axis of the volume.

    Across that axis a radial profile, estimated from the plates themselves, is fitted; along it heights and tilts are weighted.

    Parameters
    ----------
    values : ndarray, shape (nz, ny, nx)
        Intensities, plates brighter than their surroundings.
    spacing_mm : ndarray, shape (3,)
        Spacing of voxels along x, y, z, mm.
    centres_mm : ndarray, shape (n, 3)
        Index times spacing, mm, accurate to about a voxel.
    axis : int
        The thin axis: 0, 1, 2 for x, y, z.
    diameter_mm, thickness_mm : float
        Of the plates, mm.
    along : bool
        Whether to locate them along the thin axis, too; else the given coordinate is kept, and its standard deviation is NaN.
    """
    order = [axis, *(a for a in (2, 1, 0) if a != axis)]  # k, j, i
    turned, spacing, centres = np.moveaxis(values, 2 - axis, 0), spacing_mm[order], centres_mm[:, order]
    thick = 0.5 * thickness_mm + STEEPEST * 0.5 * diameter_mm + 1.6 * spacing[0]
    half = np.ceil(np.array([thick, *([0.8 * diameter_mm] * 2)]) / spacing).astype(int)
    middle = np.round(centres / spacing).astype(int)
    inside = ((middle >= half) & (middle + half < turned.shape)).all(axis=1)
    out, sd = np.full_like(centres_mm, np.nan), np.full_like(centres_mm, np.nan)
    if not inside.any():
        return PlacedPlates(out, sd)
    middle = middle[inside]
    patches = _patches(turned, middle, half)
    off = centres[inside] - middle * spacing
    off[:, 1:], across_sd, fraction = _centred(patches, off[:, 1:], spacing, half, diameter_mm)
    deviation = np.full(len(middle), np.nan)
    if along:
        columns = _columns(fraction, off[:, 1:], spacing, half)
        mean, deviation = _weighed(patches, columns, off[:, 0] / spacing[0] + half[0], thickness_mm / spacing[0], spacing[0])
        off[:, 0] = (mean - half[0]) * spacing[0]
    rows = np.flatnonzero(inside)[:, None]
    out[rows, order] = middle * spacing + off
    sd[rows, order] = np.column_stack([deviation * spacing[0], across_sd * np.sqrt(_voxels_sharing_noise(patches))])
    return PlacedPlates(out, sd)


def slice_profile(thickness: float, blur: float) -> FloatArray:
    """Return the fraction of a plate inside a slice at distances of 0, `TABLE_STEP`, ...; thickness, blur and distances in slices."""
    at = np.arange(0.0, 0.5 + 0.5 * thickness + 4.0 * blur + 2.0 * TABLE_STEP, TABLE_STEP)
    if blur < TABLE_STEP:
        return np.asarray(np.maximum(np.minimum(at + 0.5 * thickness, 0.5) - np.maximum(at - 0.5 * thickness, -0.5), 0.0) / thickness)

    def twice_integrated(x: FloatArray) -> FloatArray:
        s = x / (np.sqrt(2.0) * blur)
        return np.asarray(0.5 * x * erf(s) + blur / np.sqrt(2.0 * np.pi) * np.exp(-(s**2)))

    a, b = 0.5 + 0.5 * thickness, 0.5 - 0.5 * thickness
    seen = twice_integrated(at + a) + twice_integrated(at - a) - twice_integrated(at + b) - twice_integrated(at - b)
    return np.asarray(np.maximum(seen, 0.0) / thickness)


def _patches(turned: AnyFloatArray, middle: IntArray, half: IntArray) -> FloatArray:
    offsets = [np.arange(-h, h + 1) for h in half]
    k, j, i = (middle[:, a, None] + offsets[a] for a in range(3))
    return np.asarray(turned[k[:, :, None, None], j[:, None, :, None], i[:, None, None, :]], dtype=float)


def _centred(
    patches: FloatArray, off: FloatArray, spacing: FloatArray, half: IntArray, diameter_mm: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Fit a radial profile to the sums along the thin axis.

    Returns the offsets (n, 2) of the centres from the middles of the patches along j and i, mm, their standard deviations, and the value of
    the profile at every column (n, nj, ni).
    """
    n, _, nj, ni = patches.shape
    dj, di = (np.arange(nj) - half[1]) * spacing[1], (np.arange(ni) - half[2]) * spacing[2]
    step, reach = 0.5 * float(spacing[1:].min()), 0.8 * diameter_mm
    sums = np.empty((n, nj, ni))
    background = _background(patches, off, dj, di, diameter_mm)
    inner = np.hypot(dj[:, None] - off[:, :1, None], di - off[:, 1:, None]) < 0.5 * diameter_mm
    shown = np.einsum("nkji,nji->nk", patches, inner) - background[:, None] * inner.sum(axis=(1, 2))[:, None]
    seen = shown > SEEN * shown.max(axis=1, keepdims=True)
    column_sums(patches, background, seen, sums)
    scale = np.maximum(np.percentile(sums.reshape(n, -1), 90, axis=1), 1e-12)
    sums /= scale[:, None, None]
    moved, sd = off.copy(), np.zeros((n, 2))
    for _ in range(CENTRINGS):
        at, typical = _radial(np.hypot(dj[:, None] - moved[:, :1, None], di - moved[:, 1:, None]), sums, step, reach)
        moved, sd = _fitted_centres(sums, moved, dj, di, at, typical)
    distance = np.hypot(dj[:, None] - moved[:, :1, None], di - moved[:, 1:, None])
    return moved, sd, np.maximum(np.interp(distance, at, typical), 0.0)


def _background(patches: FloatArray, off: FloatArray, dj: FloatArray, di: FloatArray, diameter_mm: float) -> FloatArray:
    far = np.hypot(dj[:, None] - off[:, :1, None], di - off[:, 1:, None]) > 0.75 * diameter_mm
    return np.array([np.median(patch[:, away]) if away.any() else np.median(patch) for patch, away in zip(patches, far, strict=True)])


def _radial(distance: FloatArray, sums: FloatArray, step: float, reach: float) -> tuple[FloatArray, FloatArray]:
    """Return the median of column sums (n, nj, ni) in rings: distances from the centre, and the profile there, zero at the reach."""
    edges = np.arange(0.0, reach, step)
    which = np.digitize(distance.ravel(), edges) - 1
    order = np.argsort(which, kind="stable")
    parts = np.split(sums.ravel()[order], np.searchsorted(which[order], np.arange(1, len(edges))))
    typical = np.array([np.median(part) if len(part) else np.nan for part in parts])
    known = np.isfinite(typical)
    return np.append(edges[known] + 0.5 * step, reach + step), np.append(typical[known], 0.0)


def _fitted_centres(
    sums: FloatArray, centres: FloatArray, dj: FloatArray, di: FloatArray, at: FloatArray, typical: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Fit height, background and position of the profile to the sums of every plate, one Gauss-Newton step: centres, SD (n, 2)."""
    small = 1e-3 * float(at[-1])
    moved, sd = centres.copy(), np.zeros_like(centres)
    for p, (c, seen) in enumerate(zip(centres, sums, strict=True)):
        j, i = dj[:, None] - c[0], di[None, :] - c[1]
        r = np.hypot(j, i)
        value = np.interp(r, at, typical)
        slope = (np.interp(r + small, at, typical) - np.interp(np.abs(r - small), at, typical)) / (2.0 * small)
        inward = -slope / np.maximum(r, small)
        design = np.stack([value.ravel(), np.ones(value.size), (inward * j).ravel(), (inward * i).ravel()], axis=1)
        normal = design.T @ design
        if np.linalg.cond(normal) > 1e12:
            continue
        fit = np.linalg.solve(normal, design.T @ seen.ravel())
        if fit[0] <= 0.0:
            continue
        moved[p] += np.clip(fit[2:] / fit[0], -0.25 * at[-1], 0.25 * at[-1])
        left = float(((seen.ravel() - design @ fit) ** 2).sum()) / (value.size - 4)
        sd[p] = np.sqrt(left * np.diag(np.linalg.inv(normal))[2:]) / fit[0]
    return moved, sd


def _columns(fraction: FloatArray, off: FloatArray, spacing: FloatArray, half: IntArray) -> FloatArray:
    """Return the columns that every plate covers: j, i, fraction, and distances from its centre along j and i, mm (n, c, 5)."""
    n, nj, ni = fraction.shape
    dj, di = (np.arange(nj) - half[1]) * spacing[1] - off[:, :1], (np.arange(ni) - half[2]) * spacing[2] - off[:, 1:]
    covering = np.argsort(-fraction.reshape(n, -1), axis=1)[
        :, : int((fraction > COVERED * fraction.max()).reshape(n, -1).sum(axis=1).max())
    ]
    j, i, rows = covering // ni, covering % ni, np.arange(n)[:, None]
    return np.stack([j.astype(float), i.astype(float), fraction[rows, j, i], dj[rows, j], di[rows, i]], axis=2)


def _weighed(patches: FloatArray, columns: FloatArray, start: FloatArray, thickness: float, pitch: float) -> tuple[FloatArray, FloatArray]:
    """Return the posterior mean height and its standard deviation (n,), slices, with the blur and noise of least residual."""
    some = np.linspace(0, len(patches) - 1, min(len(patches), CHOOSING)).astype(int)
    noise = _noise(patches)
    tried = []
    for blur in BLURS:
        _, _, residual = _run(patches[some], columns[some], start[some], slice_profile(thickness, blur), pitch, noise)
        tried.append((float(np.mean(residual**2)), blur))
    left, blur = min(tried)
    left, blur = (left, blur) if left < BLURRED * tried[0][0] else tried[0]
    shared = _voxels_sharing_noise(patches)
    mean, sd, _ = _run(patches, columns, start, slice_profile(thickness, blur), pitch, left * shared)
    return mean, np.hypot(sd, MODEL_SD)


def _run(
    patches: FloatArray, columns: FloatArray, start: FloatArray, profile: FloatArray, pitch: float, variance: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    n = len(patches)
    mean, sd, residual = np.empty(n), np.empty(n), np.empty((n, patches.shape[1], columns.shape[1]))
    heights = start[:, None] + np.linspace(-REACH_SLICES, REACH_SLICES, HEIGHTS)
    slopes = np.linspace(-STEEPEST, STEEPEST, TILTS) / pitch
    weigh_plates(patches, columns, profile, TABLE_STEP, heights, slopes, np.array([TILT_SD / pitch]), variance, mean, sd, residual)
    return mean, sd, residual


def _noise(patches: FloatArray) -> float:
    """Return the variance of the noise from the corners of the patches."""
    corners = np.concatenate([patches[:, :, j, i].ravel() - np.median(patches[:, :, j, i]) for j in (0, -1) for i in (0, -1)])
    return float(max((1.4826 * np.median(np.abs(corners))) ** 2, 1e-12 * float(np.ptp(patches)) ** 2, 1e-300))


def _voxels_sharing_noise(patches: FloatArray) -> float:
    """Return the number of voxels with common noise, from the correlation of neighbours on the rims of patches (n, nk, nj, ni)."""
    shared = 1.0
    for rims in (patches[:, :, (0, -1), :], np.swapaxes(patches[:, :, :, (0, -1)], 2, 3)):
        away = rims - rims.mean(axis=3, keepdims=True)
        correlation = float((away[..., 1:] * away[..., :-1]).mean() / max(float((away**2).mean()), 1e-300))
        correlation = float(np.clip(correlation, 0.0, 0.7))
        shared *= (1.0 + correlation) / (1.0 - correlation)
    return shared
