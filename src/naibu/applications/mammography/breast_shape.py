"""Shape of an unloaded breast: an ellipse at each distance from the chest wall."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError

_TIP = 0.8  # part of the depth from which on the two outlines need not show one section: the deepest points of two views differ


@dataclass(frozen=True, slots=True, eq=False)
class BreastShape:
    """Ellipses parallel to the chest wall.

    A point (x, y) at depth d lies inside where (x - m)^T S^-1 (x - m) <= 1, with m and S interpolated linearly between the depths.

    Attributes
    ----------
    depths : ndarray, shape (n,)
        Distances from the chest wall, mm, from 0 to the nipple, growing.
    centres : ndarray, shape (n, 2)
        Centres m of the ellipses, mm: laterally and upwards.
    squares : ndarray, shape (n, 3)
        S_xx, S_yy and S_xy, mm^2: squares of the half widths laterally and upwards, and the tilt.
    """

    depths: FloatArray
    centres: FloatArray
    squares: FloatArray

    @property
    def depth_mm(self) -> float:
        """Distance of the nipple from the chest wall."""
        return float(self.depths[-1])

    @property
    def nipple(self) -> FloatArray:
        """Lateral and upward position (2,), mm, where the line of the centres ends; the deepest point of a blunt breast is less sure."""
        part = self.depths / self.depth_mm
        kept = (part > 0.6) & (part < 0.9)
        return np.asarray(np.polyfit(part[kept] - 1.0, self.centres[kept], 1)[1])

    @property
    def volume_mm3(self) -> float:
        """Volume between the chest wall and the nipple, with the areas of the ellipses interpolated linearly."""
        xx, yy, xy = self.squares.T
        return float(np.trapezoid(np.pi * np.sqrt(np.maximum(xx * yy - xy**2, 0.0)), self.depths))

    def in_view(self, angle_deg: float, depths: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return ellipses at depths in the axes of a view.

        Parameters
        ----------
        angle_deg : float
            Positioner angle: 0 of CC, where the detector's axis along the chest wall points laterally; 90 of a lateral view.
        depths : array_like, shape (k,)
            Distances from the chest wall, mm.

        Returns
        -------
        centres : ndarray, shape (k, 2)
            Along the detector, then along the compression, mm.
        squares : ndarray, shape (k, 3)
            Likewise, mm^2.
        """
        d = np.asarray(depths, dtype=float)
        m = np.stack([np.interp(d, self.depths, column) for column in self.centres.T], axis=-1)
        xx, yy, xy = (np.interp(d, self.depths, column) for column in self.squares.T)
        c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
        centres = np.stack([c * m[..., 0] + s * m[..., 1], c * m[..., 1] - s * m[..., 0]], axis=-1)
        along = c * c * xx + s * s * yy + 2 * c * s * xy
        across = s * s * xx + c * c * yy - 2 * c * s * xy
        mixed = c * s * (yy - xx) + (c * c - s * s) * xy
        return centres, np.stack([along, across, mixed], axis=-1)


def half_ellipsoid_shape(size_mm: ArrayLike, sections: int = 200) -> BreastShape:
    """Return a half ellipsoid.

    Parameters
    ----------
    size_mm : array_like, shape (3,)
        Diameters laterally and upwards, and depth.
    sections : int
        Number of ellipses.
    """
    x, y, depth = np.asarray(size_mm, dtype=float)
    d = depth * np.linspace(0.0, 1.0, sections)
    rest = 1.0 - (d / depth) ** 2
    return BreastShape(d, np.zeros((sections, 2)), np.column_stack([rest * (x / 2) ** 2, rest * (y / 2) ** 2, 0.0 * rest]))


def shape_from_widths(depths: FloatArray, first: FloatArray, second: FloatArray, angle_deg: float) -> BreastShape:
    """Return the roundest ellipses with given widths in two directions.

    With the half widths a and b in directions that enclose the angle, S has the mean (a^2 + b^2)/2 of its
    principal squares, and they differ
    as little as the widths allow, by abs(b^2 - a^2)/sin(angle).

    Parameters
    ----------
    depths : ndarray, shape (n,)
        Distances from the chest wall, mm.
    first, second : ndarray, shape (n, 2)
        Least and greatest positions laterally (CC), and in the direction of the angle (MLO), mm.
    angle_deg : float
        Angle between the two directions.

    Raises
    ------
    InputError
        The widths differ so much that no ellipse has both, farther from the nipple than its neighbourhood, where they are limited.
    """
    t = np.deg2rad(angle_deg)
    a2, b2 = (np.square(0.5 * (w[:, 1] - w[:, 0])) for w in (first, second))
    mean, difference = 0.5 * (a2 + b2), b2 - a2
    limit = 0.98 * 2.0 * mean * abs(np.sin(t))
    excess = np.abs(difference) - limit
    if np.any(excess[depths < _TIP * depths[-1]] > 0.0):
        at = int(np.argmax(np.where(depths < _TIP * depths[-1], excess / np.maximum(mean, 1e-12), -np.inf)))
        raise InputError(
            f"the outlines do not fit together: {depths[at]:.3g} mm from the chest wall the half widths are {np.sqrt(a2[at]):.3g} and "
            f"{np.sqrt(b2[at]):.3g} mm, which no section has in directions {angle_deg:g} degrees apart; check "
            f"angle_deg, the units, and that "
            "both outlines end at the same height of the chest wall"
        )
    difference = np.clip(difference, -limit, limit)
    p, r = -0.5 * difference, difference * np.sin(2 * t) / (4.0 * np.sin(t) ** 2)
    middles = [0.5 * (w[:, 0] + w[:, 1]) for w in (first, second)]
    upwards = (middles[1] - np.cos(t) * middles[0]) / np.sin(t)
    return BreastShape(depths, np.column_stack([middles[0], upwards]), np.column_stack([mean + p, mean - p, r]))


def opened_at(outline: FloatArray, hidden_mm: float) -> FloatArray:
    """Return an outline (m, 2), from wall to wall, without its part nearer to the chest wall than `hidden_mm`, measured from there."""
    if hidden_mm <= 0.0:
        return np.asarray(outline - np.array([hidden_mm, 0.0]))
    kept = np.flatnonzero(outline[:, 0] > hidden_mm)
    ends = []
    for inner, outer in ((kept[0], kept[0] - 1), (kept[-1], kept[-1] + 1)):
        a, b = outline[outer], outline[inner]
        ends.append(a + (hidden_mm - a[0]) / (b[0] - a[0]) * (b - a))
    return np.asarray(np.vstack([ends[0], outline[kept], ends[1]]) - np.array([hidden_mm, 0.0]))
