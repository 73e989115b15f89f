"""Epipolar curve of a point of one view in the other view, and the place of a lesion that both views show."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from scipy.special import fdtri, stdtrit

from naibu.applications.mammography.breast_outline import BreastOutline, inside_polygon
from naibu.applications.mammography.pressed_view import PressedView
from naibu.applications.mammography.two_views import TwoViews
from naibu.core.arrays import BoolArray, FloatArray
from naibu.core.errors import InputError

Model = Literal["geometric", "mechanical"]
_COUNT = 101
_SMOOTH = 8.0  # points of a curve: its bends over a mesh's cells would fold the band
_TURN = np.linspace(0.0, 2.0 * np.pi, 61)


@dataclass(frozen=True, slots=True)
class ModelUncertainty:
    """Standard deviations of what the geometric model leaves open; those of the parameters hold for each view by itself.

    Attributes
    ----------
    volume_ratio, along_share, bending : float
        Of `CompressionParameters`.
    angle_deg, thickness_mm : float
        Of the positioner's angle and the plates' distance.
    unresolved_mm : float
        Displacements within a view that no parameter describes, in each direction: heterogeneous tissue, gravity, positioning. The default
        gives a mean distance from the curve as it was measured on 50 pairs of mammograms, 7 mm :cite:p:`kita2002`.
    unloaded_mm : float
        Of each coordinate in the unloaded breast against where both views put it: weight and roll move tissue along the curves, which no
        view shows. The default covers virtual breasts (``benchmarks/mammography_population.py``).
    """

    volume_ratio: float = 0.05
    along_share: float = 0.25
    bending: float = 0.3
    angle_deg: float = 2.0
    thickness_mm: float = 2.0
    unresolved_mm: float = 6.0
    unloaded_mm: float = 4.0

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0.0):
                raise InputError(f"{name} is {value}: a standard deviation must not be negative")


DEFAULT_UNCERTAINTY = ModelUncertainty()


@dataclass(frozen=True, slots=True, eq=False)
class EpipolarCurve:
    """Where a point of one view may lie in the other.

    Attributes
    ----------
    curve : ndarray, shape (n, 2)
        Depth and position along the chest wall, mm.
    points : ndarray, shape (n, 3)
        The same points in the unloaded breast: laterally, upwards, and away from the chest wall, mm.
    band : ndarray, shape (m, 2)
        Polygon around the curve.
    probability : float
        With which the band holds the true place, if the stated standard deviations are true.
    """

    curve: FloatArray
    points: FloatArray
    band: FloatArray
    probability: float

    @property
    def strips(self) -> FloatArray:
        """Pieces of the band between neighbouring points of the curve, (n - 1, 4, 2), mm, in one sense of rotation.

        Where the curve bends by more than the band is wide, the polygon lies over itself, and is empty there by the even-odd rule.
        """
        n = len(self.curve)
        upper, lower = self.band[:n], self.band[n:][::-1]
        strips = np.stack([upper[:-1], upper[1:], lower[1:], lower[:-1]], axis=1)
        x, y = np.moveaxis(strips, 2, 0)
        area = (x * np.roll(y, -1, axis=1) - np.roll(x, -1, axis=1) * y).sum(axis=1)
        return np.where((area < 0.0)[:, None, None], strips[:, ::-1], strips)

    def in_band(self, places: ArrayLike) -> BoolArray:
        """Return which places (..., 2) lie in the band."""
        inside: BoolArray = np.any([inside_polygon(strip, places) for strip in self.strips], axis=0)
        return inside

    def distance(self, place: ArrayLike) -> float:
        """Return the distance of a place (2,) from the curve, mm."""
        p = np.asarray(place, dtype=float)
        a, run = self.curve[:-1], np.diff(self.curve, axis=0)
        share = np.clip(((p - a) * run).sum(axis=1) / np.maximum((run**2).sum(axis=1), 1e-12), 0.0, 1.0)
        return float(np.hypot(*(a + share[:, None] * run - p).T).min())


@dataclass(frozen=True, slots=True, eq=False)
class LesionPosition:
    """Place of a lesion in the unloaded breast.

    Attributes
    ----------
    position : ndarray, shape (3,)
        Laterally and upwards from the nipple, and away from the chest wall, mm.
    low, high : ndarray, shape (3,)
        Ends of the intervals of each coordinate, mm.
    mismatch_mm : float
        Distance of the MLO point from the epipolar curve of the CC point.
    agrees : bool
        Whether the MLO point lies in the band around the curve; if not, the points may not show one lesion, and the position does not hold.
    """

    position: FloatArray
    low: FloatArray
    high: FloatArray
    mismatch_mm: float
    agrees: bool


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """Where a point of the unloaded breast appears in both views.

    Attributes
    ----------
    places : ndarray, shape (2, 2)
        In CC and MLO: depth and position along the chest wall, mm.
    regions : ndarray, shape (2, n, 2)
        Ellipses that hold the true places with the probability asked for, if the stated standard deviations are true.
    """

    places: FloatArray
    regions: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class MammographicPair:
    """Both views of a breast with models that are drawn from the stated uncertainty.

    Attributes
    ----------
    outlines : (BreastOutline, BreastOutline)
        CC and MLO.
    nominal : TwoViews
        The model with the parameters as stated.
    centre, drawn : TwoViews, tuple of TwoViews
        The geometric model with the parameters as stated and with others: by how much they differ makes bands and intervals.
    noise : ndarray, shape (k, 2, 2)
        Unresolved displacements of each: view, then depth and position along the chest wall, mm.
    refused : int
        How many draws gave no breast.
    unloaded_mm : float
        See `ModelUncertainty`.
    """

    outlines: tuple[BreastOutline, BreastOutline]
    nominal: TwoViews
    centre: TwoViews
    drawn: tuple[TwoViews, ...]
    noise: FloatArray
    refused: int
    unloaded_mm: float

    def epipolar_curve(self, point: ArrayLike, *, from_view: str = "CC", probability: float = 0.95) -> EpipolarCurve:
        """Return the curve in the other view of a point of one view.

        Back-projection, uncompression, rotation, compression and projection :cite:p:`kita2001`.

        Parameters
        ----------
        point : array_like, shape (2,)
            Depth and position along the chest wall, mm.
        from_view : {"CC", "MLO"}
            The view of the point.
        probability : float
            Of the band.

        Raises
        ------
        InputError
            A point outside of the breast, another view, or a probability that is none.
        """
        first = _index(from_view)
        if not 0.0 < probability < 1.0:
            raise InputError(f"probability is {probability:g}: must be between 0 and 1")
        p = self._inside(point, first)
        points, curve = _curve(_views(self.nominal), first, p)
        _, middle = _curve(_views(self.centre), first, p)
        offsets = []
        for views, noise in zip(self.drawn, self.noise, strict=True):
            try:
                _, other = _curve(_views(views), first, p + noise[first])
            except InputError:  # displaced out of this breast
                continue
            offsets.append(other + noise[1 - first] - middle)
        if not offsets:
            raise InputError(f"point ({p[0]:.4g}, {p[1]:.4g}) mm lies so near the skin that no drawn model holds it; no band can be given")
        return EpipolarCurve(curve, points, _band(curve, np.array(offsets), probability), probability)

    def lesion(self, point_cc: ArrayLike, point_mlo: ArrayLike, *, probability: float = 0.95) -> LesionPosition:
        """Return the place of a lesion that both views show.

        Parameters
        ----------
        point_cc, point_mlo : array_like, shape (2,)
            Depth and position along the chest wall in each view, mm.
        probability : float
            Of the interval of each coordinate.

        Raises
        ------
        InputError
            A point outside of the breast.
        """
        places = self._inside(point_cc, 0), self._inside(point_mlo, 1)
        curve = self.epipolar_curve(places[0], probability=probability)
        found = []
        for views, noise in zip(self.drawn, self.noise, strict=True):
            try:
                found.append(_nearest(_views(views), (places[0] + noise[0], places[1] + noise[1])))
            except InputError:
                continue
        if not found:
            raise InputError("the points lie so near the skin that no drawn model holds both; no interval can be given")
        tail = 0.5 * (1.0 - probability)
        position = _nearest(_views(self.nominal), places)
        middle = _nearest(_views(self.centre), places)
        half = float(stdtrit(len(found), 1.0 - tail)) * np.sqrt(((np.array(found) - middle) ** 2).mean(axis=0) + self.unloaded_mm**2)
        return LesionPosition(position, position - half, position + half, curve.distance(places[1]), bool(curve.in_band(places[1])))

    def project(self, position: ArrayLike, *, probability: float = 0.95) -> Projection:
        """Return where a point (3,) of the unloaded breast, from the nipple and from the chest wall, mm, appears in CC and MLO.

        Raises
        ------
        InputError
            A point outside of the unloaded breast, or a probability that is none.
        """
        p = np.asarray(position, dtype=float)
        if p.shape != (3,) or not np.isfinite(p).all():
            raise InputError(f"position has shape {p.shape}: needs three finite coordinates, mm")
        if not 0.0 < probability < 1.0:
            raise InputError(f"probability is {probability:g}: must be between 0 and 1")
        centre, square = self.nominal.shape.in_view(0.0, p[2])
        x, y = p[:2] - centre
        xx, yy, xy = square
        if not (0.0 <= p[2] <= self.nominal.shape.depth_mm and yy * x * x - 2 * xy * x * y + xx * y * y <= xx * yy - xy * xy):
            raise InputError(f"position ({p[0]:.4g}, {p[1]:.4g}, {p[2]:.4g}) mm lies outside of the unloaded breast")
        places = np.array([view.project(p) for view in _views(self.nominal)])
        middle = np.array([view.project(p) for view in _views(self.centre)])
        offsets = np.array([[view.project(p) for view in _views(model)] for model in self.drawn]) + self.noise - middle
        reach = np.sqrt(2.0 * float(fdtri(2, len(offsets), probability)))
        circle = reach * np.column_stack([np.cos(_TURN), np.sin(_TURN)])
        roots = [np.linalg.cholesky(o.T @ o / len(o) + 1e-9 * np.eye(2)) for o in np.moveaxis(offsets, 1, 0)]
        return Projection(places, np.array([place + circle @ root.T for place, root in zip(places, roots, strict=True)]))

    def _inside(self, point: ArrayLike, view: int) -> FloatArray:
        p = np.asarray(point, dtype=float)
        name = ("CC", "MLO")[view]
        if p.shape != (2,) or not np.isfinite(p).all():
            raise InputError(f"point_{name.lower()} has shape {p.shape}: needs two finite coordinates, mm")
        if not self.outlines[view].contains(p):
            shown = self.outlines[view].to_image(p)
            other = self.outlines[1 - view]
            swapped = other.contains(other.from_image(shown))
            hint = "; it lies inside of that of the other view: are the views swapped?" if swapped else ""
            raise InputError(f"point_{name.lower()} is ({shown[0]:.4g}, {shown[1]:.4g}) mm, outside of the outline of {name}{hint}")
        return p


def _index(view: str) -> int:
    if view not in ("CC", "MLO"):
        raise InputError(f"from_view is {view!r}: must be 'CC' or 'MLO'")
    return int(view == "MLO")


def _views(model: TwoViews) -> tuple[PressedView, PressedView]:
    return model.cc, model.mlo


def _ray(view: PressedView, place: FloatArray) -> FloatArray:
    """Return the part (n, 3) inside of the breast of the ray of a place, from the lower to the upper skin."""
    points, inside = view.on_ray(place, 4 * _COUNT)
    kept = np.flatnonzero(inside)
    if len(kept) < 2:
        raise InputError(f"the place ({place[0]:.4g}, {place[1]:.4g}) mm lies outside of the model of the breast: too near the skin")
    part = points[kept[0] : kept[-1] + 1]
    at = np.linspace(0.0, len(part) - 1.0, _COUNT)
    return np.column_stack([np.interp(at, np.arange(len(part)), column) for column in part.T])


def _curve(views: tuple[PressedView, PressedView], first: int, place: FloatArray) -> tuple[FloatArray, FloatArray]:
    ray = _ray(views[first], place)
    return ray, views[1 - first].project(ray)


def _nearest(views: tuple[PressedView, PressedView], places: tuple[FloatArray, FloatArray]) -> FloatArray:
    """Return the mean of the points of both rays that come nearest to the place in the other view."""
    found = []
    for first in (0, 1):
        ray, curve = _curve(views, first, places[first])
        a, run = curve[:-1], np.diff(curve, axis=0)
        share = np.clip(((places[1 - first] - a) * run).sum(axis=1) / np.maximum((run**2).sum(axis=1), 1e-12), 0.0, 1.0)
        at = int(np.argmin(np.hypot(*(a + share[:, None] * run - places[1 - first]).T)))
        found.append(ray[at] + share[at] * (ray[at + 1] - ray[at]))
    middle: FloatArray = 0.5 * (found[0] + found[1])
    return middle


def _band(curve: FloatArray, offsets: FloatArray, probability: float) -> FloatArray:
    """Return a polygon: Student quantiles times the root mean squares of offsets (k, n, 2) across the curve, and along it at its ends."""
    tangent = np.gradient(gaussian_filter1d(curve, _SMOOTH, axis=0, mode="nearest"), axis=0)
    tangent /= np.maximum(np.hypot(*tangent.T), 1e-12)[:, None]
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    tail = 0.5 * (1.0 - probability)
    across = np.einsum("kni,ni->kn", offsets, normal)
    reach = float(stdtrit(len(offsets), 1.0 - tail))
    half = reach * maximum_filter1d(np.sqrt((across**2).mean(axis=0)), 2 * int(_SMOOTH) + 1, mode="nearest")
    shift = np.zeros_like(curve)
    for end, sign in ((0, -1.0), (-1, 1.0)):
        shift[end] = sign * reach * np.sqrt(np.mean((offsets[:, end] @ tangent[end]) ** 2)) * tangent[end]
    upper = curve + shift + half[:, None] * normal
    lower = curve + shift - half[:, None] * normal
    return np.vstack([upper, lower[::-1]])
