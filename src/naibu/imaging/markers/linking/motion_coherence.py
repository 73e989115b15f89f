"""Coherence of a motion: whether labelled markers of two states can be those of one continuous body.

The motion of a continuum is nearly affine over a few spacings, so that every marker is found where the affine motion of its neighbours
predicts it. Where labels do not correspond, predictions hit other markers as often as their own; other units and mirror images show in the
local ratio of volumes, which a soft body keeps within a factor of some units.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from naibu.core.arrays import FloatArray, IntArray, as_points
from naibu.core.errors import InputError

# Empirical values, judged by tests/imaging/markers/linking/test_motion_coherence.py: measured motions find 97 % of their markers again,
# permuted labels less than 45 %
NEIGHBOURS = {2: 8, 3: 10}
FEWEST = {2: 6, 3: 8}  # markers from which on a motion is judged
FOUND_AGAIN = 0.5
VOLUMES, SPANS = (0.25, 4.0), (0.4, 2.5)  # local ratio of volumes, and ratio of the RMS extents, of a soft body
STRAY, BEYOND = 0.8, 6.0  # residual of a stray marker: in spacings, and in medians of all residuals
COHERENT = (0.3, 0.6)  # median residual up to which links are coherent, and from which on they are chance
ROUNDS = 4  # of the robust fit
ROUNDING = 1e-3  # of the distance to the neighbours: what a table rounds off says nothing about which of them to believe
FLAT = 0.02  # ratio of the extents of neighbours below which they lie in a plane or on a line
MOST = 3000  # markers that are judged at most, evenly chosen


@dataclass(frozen=True, slots=True, eq=False)
class MotionCoherence:
    """What the neighbours say about the motion of every marker.

    Attributes
    ----------
    residual : ndarray, shape (n,)
        Distance of every judged marker from the position that the affine motion of its neighbours predicts, in spacings.
    found_again : float
        Fraction of the markers that lie nearest to their own prediction; about 1 / n by chance.
    volume_ratio : float
        Median of the local ratio of volumes (of areas in two dimensions); negative in a mirror image, NaN where markers lie in a plane.
    span_ratio : float
        Ratio of the root mean square extents of the two states.
    judged : ndarray, shape (n,), int64
        Which markers were judged; none where there are too few.
    strays : ndarray, int64
        Markers that lie nearer to the prediction of others, and far from their own.
    """

    residual: FloatArray
    found_again: float
    volume_ratio: float
    span_ratio: float
    judged: IntArray
    strays: IntArray

    @property
    def typical_residual(self) -> float:
        """Median residual, spacings; 0 where no marker was judged."""
        return float(np.median(self.residual)) if len(self.residual) else 0.0

    @property
    def fault(self) -> str:
        """Why this is not the motion of one body, and what to do; empty where it may be one."""
        if not SPANS[0] <= self.span_ratio <= SPANS[1]:
            return f"lengths changed {_factor(self.span_ratio)}, which no soft body does: {_units(self.span_ratio)}"
        if len(self.judged) and self.found_again < FOUND_AGAIN:
            return (
                f"only {100.0 * self.found_again:.0f} % of {len(self.judged)} markers lie nearest to where the motion of their neighbours "
                "predicts "
                "them: the labels of the two states do not correspond (row numbers?); number the markers alike in all states, or let "
                "track or link_markers link them"
            )
        if self.volume_ratio < 0.0:
            return "the second state is a mirror image of the first: check the order of its axes and their signs"
        if np.isfinite(self.volume_ratio) and not VOLUMES[0] <= self.volume_ratio <= VOLUMES[1]:
            return f"volumes changed {_factor(self.volume_ratio)}, which no soft body does: {_units(self.span_ratio)}"
        return ""


def motion_coherence(reference_points: ArrayLike, deformed_points: ArrayLike) -> MotionCoherence:
    """Judge the motion of markers from one state to another.

    Parameters
    ----------
    reference_points, deformed_points : array_like, shape (n, d)
        The same markers in two states, mm, in two or three dimensions; rows with NaN are left out.

    Returns
    -------
    MotionCoherence
        Residuals, in the order of the complete rows.

    Raises
    ------
    InputError
        Shapes that do not match.
    """
    x, y = np.asarray(reference_points, dtype=float), np.asarray(deformed_points, dtype=float)
    if x.ndim != 2 or x.shape != y.shape or x.shape[1] not in NEIGHBOURS:
        raise InputError(f"points must be two arrays of one shape (n, 2) or (n, 3), not {x.shape} and {y.shape}")
    known = np.flatnonzero(np.isfinite(x).all(axis=1) & np.isfinite(y).all(axis=1))
    x, y = as_points("reference_points", x[known]), as_points("deformed_points", y[known])
    n, d = x.shape
    extent = [float(np.sqrt(np.mean((p - p.mean(axis=0)) ** 2))) if n else 0.0 for p in (x, y)]
    span = extent[1] / extent[0] if extent[0] > 0.0 and extent[1] > 0.0 else 1.0
    nothing = np.zeros(0, dtype=np.int64)
    if n < FEWEST[d] or min(extent) == 0.0:
        return MotionCoherence(np.zeros(0), 1.0, np.nan, span, nothing, nothing)
    judged = np.unique(np.linspace(0, n - 1, min(n, MOST)).astype(np.int64))
    predicted, volumes = _predicted(x, y, judged)
    tree = cKDTree(y)
    spacing = float(np.median(np.asarray(tree.query(y, k=2)[0])[:, 1])) or extent[1]
    residual = np.linalg.norm(predicted - y[judged], axis=1) / spacing
    again = np.asarray(tree.query(predicted)[0]) >= (1.0 - 1e-9) * residual * spacing
    stray = ~again & (residual > max(STRAY, BEYOND * float(np.median(residual))))
    volume = float(np.median(volumes[np.isfinite(volumes)])) if np.isfinite(volumes).mean() > 0.5 else np.nan
    return MotionCoherence(residual, float(again.mean()), volume, span, known[judged], known[judged[stray]])


def require_coherent(reference_points: ArrayLike, deformed_points: ArrayLike, what: str) -> MotionCoherence:
    """Refuse markers that cannot be those of one body in two states.

    Parameters
    ----------
    reference_points, deformed_points : array_like, shape (n, d)
        The same markers in two states, mm.
    what : str
        The two states, for the message.

    Raises
    ------
    InputError
        Labels that do not correspond, a mirror image, or lengths in other units.
    """
    found = motion_coherence(reference_points, deformed_points)
    if found.fault:
        raise InputError(f"{what}: {found.fault}")
    return found


def coherence_of_links(reference_points: FloatArray, deformed_points: FloatArray) -> float:
    """Return the probability, between 0 and 1, that links which somebody searched for are not chance, from the coherence of their motion.

    Raises
    ------
    InputError
        Lengths in other units, or a mirror image.
    """
    found = motion_coherence(reference_points, deformed_points)
    if found.fault:
        raise InputError(f"{len(reference_points)} markers could be linked, but {found.fault}")
    low, high = COHERENT
    return float(np.clip((high - found.typical_residual) / (high - low), 0.0, 1.0))


def strays_named(ids: Sequence[int] | IntArray, found: MotionCoherence, most: int = 5) -> str:
    """Return the labels of stray markers in words, empty where there are none."""
    names = [str(int(ids[i])) for i in found.strays]
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f"{', '.join(names[:most])}{more}"


def _predicted(x: FloatArray, y: FloatArray, judged: IntArray) -> tuple[FloatArray, FloatArray]:
    """Predict markers from their neighbours by robust affine fits; return that and the determinants of the local gradients."""
    n, d = x.shape
    near = np.asarray(cKDTree(x).query(x[judged], k=min(NEIGHBOURS[d], n - 1) + 1)[1])
    # of coincident markers another one may come first
    others = np.array([row[row != i][: near.shape[1] - 1] for row, i in zip(near, judged, strict=True)])
    a, b = x[others] - x[judged][:, None], y[others]
    scale = np.sqrt(np.mean(a**2, axis=(1, 2)))[:, None, None] + 1e-300
    rows = np.concatenate([np.ones((*a.shape[:2], 1)), a / scale], axis=2)
    weight = np.ones(a.shape[:2])
    ridge = 1e-9 * np.eye(d + 1)
    fit = np.zeros((len(judged), d + 1, d))
    for _ in range(ROUNDS):
        weighted = rows * weight[:, :, None]
        fit = np.linalg.solve(np.swapaxes(weighted, 1, 2) @ rows + ridge, np.swapaxes(weighted, 1, 2) @ b)
        off = np.linalg.norm(b - rows @ fit, axis=2)
        weight = 1.0 / (1.0 + (off / (2.0 * np.median(off, axis=1, keepdims=True) + ROUNDING * scale[:, :, 0])) ** 2)
    extents = np.linalg.svd(rows[:, :, 1:] - rows[:, :, 1:].mean(axis=1, keepdims=True), compute_uv=False)
    flat = extents[:, -1] < FLAT * extents[:, 0]
    volumes = np.linalg.det(fit[:, 1:] / scale)
    return fit[:, 0], np.where(flat, np.nan, volumes)


def _factor(ratio: float) -> str:
    return f"by a factor of {abs(ratio):.3g}"


def _units(span: float) -> str:
    power = np.log10(span)
    like = abs(power - round(power)) < 0.2 and round(power) != 0
    return "one of the states is in other units (cm, m or voxels for mm?)" if like else "check the units and scales of both states"
