"""Outline of a breast in one mammographic view, open at the chest wall."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import LENGTHS_MM, BoolArray, FloatArray
from naibu.core.errors import InputError
from naibu.meshing.surface import level_extents

_DEPTHS_MM = (15.0, 300.0)  # from the chest wall to the nipple; beyond, another unit is likelier
_WIDTHS_MM = (30.0, 500.0)
_ROUNDING = 32.0 * float(np.finfo(float).eps)  # of products of coordinates, over the square of the largest
_AT_WALL = 0.05  # part of the depth within which the ends of an outline must lie at the chest wall
_MOST_POINTS = 1000
_SECTIONS = 60


@dataclass(frozen=True, slots=True, eq=False)
class BreastOutline:
    """Extent of a breast along the chest wall, at distances from it, in one view.

    Attributes
    ----------
    depths : ndarray, shape (n,)
        Distances from the chest wall, mm, from 0 to the nipple.
    low, high : ndarray, shape (n,)
        Ends of the outline along the chest wall, mm, measured from the nipple; laterally in CC, upwards in MLO.
    polygon : ndarray, shape (m, 2)
        The outline as given: depth and position along the chest wall, mm, measured likewise.
    wall_mm, nipple_mm : float
        The chest wall's first coordinate and the nipple's second one in the image, mm.
    reversed : bool
        Whether the first coordinate of the image falls with depth.
    """

    depths: FloatArray
    low: FloatArray
    high: FloatArray
    polygon: FloatArray
    wall_mm: float
    nipple_mm: float
    reversed: bool

    @property
    def depth_mm(self) -> float:
        """Distance of the nipple from the chest wall."""
        return float(self.depths[-1])

    def from_image(self, points: ArrayLike) -> FloatArray:
        """Return image coordinates (..., 2), mm, as depth and position along the chest wall from the nipple."""
        p = np.asarray(points, dtype=float)
        sign = -1.0 if self.reversed else 1.0
        return np.stack([sign * (p[..., 0] - self.wall_mm), p[..., 1] - self.nipple_mm], axis=-1)

    def to_image(self, points: ArrayLike) -> FloatArray:
        """Return depths and positions along the chest wall (..., 2) as image coordinates, mm."""
        p = np.asarray(points, dtype=float)
        sign = -1.0 if self.reversed else 1.0
        return np.stack([self.wall_mm + sign * p[..., 0], p[..., 1] + self.nipple_mm], axis=-1)

    def contains(self, points: ArrayLike) -> BoolArray:
        """Return which points (..., 2), depth and position along the chest wall, lie inside."""
        return inside_polygon(self.polygon, points)


def breast_outline(points_mm: ArrayLike, *, what: str = "outline") -> BreastOutline:
    """Check the outline of a breast in one view, and measure its extent along the chest wall at each depth.

    Parameters
    ----------
    points_mm : array_like, shape (n, 2)
        Points in order along the skin, mm: perpendicular to the chest wall, then along it. The chest wall is where both ends lie; where the
        outline is closed, its straight side.
    what : str
        Name of the outline in messages.

    Returns
    -------
    BreastOutline
        Measured from the chest wall and from the nipple, its deepest point.

    Raises
    ------
    InputError
        Not points in a plane, too few of them, crossing itself, ends that do not lie at one chest wall, or no size of a breast in mm.
    """
    points = np.asarray(points_mm, dtype=float)
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < 5 or not np.isfinite(points).all():
        raise InputError(f"{what}: has shape {points.shape}; it needs at least 5 finite points of two coordinates, in mm, along the skin")
    farthest = float(np.abs(points).max())
    if farthest > LENGTHS_MM[1]:
        raise InputError(f"{what}: has a coordinate of {farthest:.4g} mm, more than {LENGTHS_MM[1]:g} mm. Are the coordinates in mm?")
    points = points[np.append(True, np.any(np.diff(points, axis=0) != 0.0, axis=1))]
    points = points[np.unique(np.linspace(0, len(points) - 1, min(len(points), _MOST_POINTS)).round().astype(int))]
    points, at_right = _opened(points, what)
    _require_no_crossing(points, what)
    wall = 0.5 * float(points[0, 0] + points[-1, 0])
    depth = (wall - points[:, 0]) if at_right else (points[:, 0] - wall)
    _require_size(depth, points[:, 1], what)
    base = abs(float(points[0, 1] - points[-1, 1]))
    if base < 0.3 * np.ptp(points[:, 1]):
        raise InputError(
            f"{what}: has {base:.4g} mm of chest wall between its ends and is {np.ptp(points[:, 1]):.4g} mm wide; a breast has more"
        )
    curve = np.column_stack([np.clip(depth, 0.0, None), points[:, 1]])
    curve[[0, -1], 0] = 0.0
    depths = float(depth.max()) * np.sin(0.5 * np.pi * np.linspace(0.0, 1.0, _SECTIONS))
    low, high = level_extents(curve[:-1], curve[1:], depths)
    nipple = 0.5 * float(low[-1] + high[-1])
    curve[:, 1] -= nipple
    return BreastOutline(depths, low - nipple, high - nipple, curve, wall, nipple, at_right)


def mask_outline(mask: ArrayLike, pixel_mm: float, *, what: str = "mask") -> BreastOutline:
    """Return the outline of the breast in a mask.

    Parameters
    ----------
    mask : array_like, shape (rows, columns)
        Non-zero inside of the breast, which reaches the left or the right side of the image: the chest wall.
    pixel_mm : float
        Size of a pixel. Image coordinates are columns to the right and rows upwards from the lower left corner.
    what : str
        Name of the mask in messages.

    Raises
    ------
    InputError
        No mask in a plane, empty, touching neither or both sides, a size of pixels that is not positive, or what `breast_outline` refuses.
    """
    filled = np.asarray(mask)
    if filled.ndim != 2 or not np.any(filled):
        raise InputError(
            f"{what}: has shape {filled.shape} and {np.count_nonzero(filled)} pixels that are not 0; it needs one plane, with a breast"
        )
    if not (np.isfinite(pixel_mm) and pixel_mm > 0.0):
        raise InputError(f"pixel_mm is {pixel_mm}: must be greater than 0, the size of a pixel in mm")
    inside = filled != 0
    sides = np.count_nonzero(inside[:, 0]), np.count_nonzero(inside[:, -1])
    if not any(sides) or all(sides):
        told = "both sides" if all(sides) else "neither side"
        raise InputError(f"{what}: the breast touches {told} of the image (left, right); it must touch the one that is the chest wall")
    columns = np.flatnonzero(inside.any(axis=0))
    columns = columns[::-1] if sides[1] else columns
    above = len(inside) - np.argmax(inside[:, columns], axis=0)
    below = np.argmax(inside[::-1, columns], axis=0)
    x = pixel_mm * (columns + 0.5)
    wall = pixel_mm * (inside.shape[1] if sides[1] else 0)
    upper, lower = np.column_stack([x, pixel_mm * above]), np.column_stack([x, pixel_mm * below])
    ends = np.array([[wall, lower[0, 1]]]), np.array([[wall, upper[0, 1]]])
    return breast_outline(np.vstack([ends[0], lower, upper[::-1], ends[1]]), what=what)


def inside_polygon(polygon: FloatArray, points: ArrayLike) -> BoolArray:
    """Return which points (..., 2) lie inside of a polygon (m, 2), closed from its last to its first point (even-odd rule)."""
    p = np.asarray(points, dtype=float)
    a, b = polygon, np.roll(polygon, -1, axis=0)
    x, y = p[..., None, 0], p[..., None, 1]
    across = (a[:, 1] > y) != (b[:, 1] > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = a[:, 0] + (y - a[:, 1]) * (b[:, 0] - a[:, 0]) / (b[:, 1] - a[:, 1])
    inside: BoolArray = np.count_nonzero(across & (x < at), axis=-1) % 2 == 1
    return inside


def _opened(points: FloatArray, what: str) -> tuple[FloatArray, bool]:
    """Return the outline from one end at the chest wall to the other, and whether the wall is at the greater coordinates."""
    x = points[:, 0]
    span = float(np.ptp(x))
    if np.hypot(*(points[0] - points[-1])) < 0.01 * np.hypot(*np.ptp(points, axis=0)):
        points = points[:-1]
        x = points[:, 0]
        sides = [np.flatnonzero(np.abs(x - end) <= 0.01 * span) for end in (x.min(), x.max())]
        lengths = [float(np.ptp(points[side, 1])) for side in sides]
        at_right = lengths[1] > lengths[0]
        wall = np.zeros(len(points), dtype=bool)
        wall[sides[int(at_right)]] = True
        if max(lengths) < 0.3 * np.ptp(points[:, 1]):
            raise InputError(f"{what}: is closed and has no straight side; leave it open, with both ends at the chest wall")
        free = np.roll(np.arange(len(points)), -int(np.argmax(np.roll(wall, 1) & ~wall)))
        kept = free[: np.count_nonzero(~wall)]
        if wall[kept].any():
            raise InputError(f"{what}: touches its straight side more than once; leave it open, with both ends at the chest wall")
        return points[np.r_[free[-1], kept, free[len(kept)]]], at_right
    at_right = bool(x[0] + x[-1] > x.min() + x.max())
    wall_x = x.max() if at_right else x.min()
    away = max(abs(float(x[i] - wall_x)) for i in (0, -1))
    if away > _AT_WALL * span:
        raise InputError(
            f"{what}: its ends lie at {x[0]:.1f} and {x[-1]:.1f} mm, up to {away:.3g} mm from the chest wall at "
            f"{wall_x:.1f} mm; both must lie "
            "at the chest wall, and the first coordinate must be perpendicular to it"
        )
    return points, at_right


def _require_no_crossing(points: FloatArray, what: str) -> None:
    a, b = points[:-1], points[1:]

    def side(p: FloatArray, q: FloatArray, r: FloatArray) -> FloatArray:
        found: FloatArray = (q[..., 0] - p[..., 0]) * (r[..., 1] - p[..., 1]) - (q[..., 1] - p[..., 1]) * (r[..., 0] - p[..., 0])
        return np.where(np.abs(found) > rounding, found, 0.0)

    # parts of a straight line do not cross, though rounding puts their ends on either side
    rounding = _ROUNDING * float(np.abs(points).max()) ** 2
    p, q, r, s = a[:, None], b[:, None], a[None], b[None]
    crossing = (side(p, q, r) * side(p, q, s) < 0.0) & (side(r, s, p) * side(r, s, q) < 0.0)
    if crossing.any():
        i, j = np.argwhere(crossing)[0]
        raise InputError(
            f"{what}: crosses itself: between points {i + 1} and {i + 2}, and {j + 1} and {j + 2}, near "
            f"({points[i, 0]:.4g}, {points[i, 1]:.4g}) mm; "
            "give the points in order along the skin"
        )


def _require_size(depth: FloatArray, along: FloatArray, what: str) -> None:
    for name, size, (least, most) in (("deep", float(depth.max()), _DEPTHS_MM), ("wide", float(np.ptp(along)), _WIDTHS_MM)):
        if not least <= size <= most:
            raise InputError(f"{what}: is {size:.4g} mm {name}; a breast is {least:g} to {most:g} mm {name}. Are the coordinates in mm?")
