"""Shape of an unloaded breast from a mask in a magnetic resonance volume."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.applications.mammography.breast_shape import BreastShape
from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.volume import Volume

_DEPTHS_MM = (15.0, 300.0)
_LEAST_PIXELS = 12  # of a section
_LEAST_SECTIONS = 8


@dataclass(frozen=True, slots=True, eq=False)
class ScannedBreast:
    """A breast in a scan.

    Attributes
    ----------
    shape : BreastShape
        Sections parallel to the chest wall as the ellipses of their areas and second moments.
    wall_mm : float
        y of the chest wall in the frame of the scan (LPS).
    nipple_mm : (float, float)
        x and z of the nipple there.
    left : bool
        Whether it is the left breast: laterally is towards greater x.
    """

    shape: BreastShape
    wall_mm: float
    nipple_mm: tuple[float, float]
    left: bool

    def from_scan(self, points: ArrayLike) -> FloatArray:
        """Return positions (..., 3) in the scan, LPS, mm, as lateral and upward from the nipple, and from the chest wall."""
        p = np.asarray(points, dtype=float)
        sign = 1.0 if self.left else -1.0
        return np.stack([sign * (p[..., 0] - self.nipple_mm[0]), p[..., 2] - self.nipple_mm[1], self.wall_mm - p[..., 1]], axis=-1)


def breast_in_scan(mask: Volume, *, left: bool, what: str = "mask") -> ScannedBreast:
    """Measure the breast in a mask.

    Parameters
    ----------
    mask : Volume
        Not 0 inside of one breast, in LPS (x to the left, y backwards, z upwards); its last plane backwards is the chest wall.
    left : bool
        Whether it is the left breast.
    what : str
        Name of the mask in messages.

    Raises
    ------
    InputError
        An empty mask, or no size of a breast in mm.
    """
    index = np.argwhere(mask.values != 0)[:, ::-1]
    if not len(index):
        raise InputError(f"{what}: has no voxel that is not 0; it needs one breast")
    points = mask.origin_mm + (index * mask.spacing_mm) @ mask.direction.T
    step = float(np.abs(mask.direction[1] * mask.spacing_mm).max())
    wall = float(points[:, 1].max()) + 0.5 * step
    depth = wall - points[:, 1]
    if not _DEPTHS_MM[0] <= depth.max() <= _DEPTHS_MM[1]:
        raise InputError(
            f"{what}: is {depth.max():.4g} mm deep from back to front (y); a breast is {_DEPTHS_MM[0]:g} to {_DEPTHS_MM[1]:g} mm deep. "
            "Is its spacing in mm, and its direction that of the patient?"
        )
    section = np.floor(depth / step).astype(int)
    volume = float(np.prod(mask.spacing_mm))
    sign = 1.0 if left else -1.0
    flat = np.column_stack([sign * points[:, 0], points[:, 2]])
    rows = [
        _ellipse(flat[section == k], volume / step) for k in range(section.max() + 1) if np.count_nonzero(section == k) >= _LEAST_PIXELS
    ]
    if len(rows) < _LEAST_SECTIONS:
        raise InputError(
            f"{what}: has {len(rows)} sections parallel to the chest wall; a breast needs {_LEAST_SECTIONS}: take smaller voxels"
        )
    found = np.array(rows)
    kept = np.array([k for k in range(section.max() + 1) if np.count_nonzero(section == k) >= _LEAST_PIXELS])
    depths = np.concatenate([[0.0], step * (kept + 0.5), [step * (section.max() + 1)]])
    nipple = found[-1, :2]
    centres = np.vstack([found[:1, :2], found[:, :2], found[-1:, :2]]) - nipple
    squares = np.vstack([found[:1, 2:], found[:, 2:], 1e-3 * found[-1:, 2:]])
    shape = BreastShape(depths, centres, squares)
    return ScannedBreast(shape, wall, (float(sign * nipple[0]), float(nipple[1])), left)


def _ellipse(points: FloatArray, pixel_mm2: float) -> FloatArray:
    """Return centre and S_xx, S_yy, S_xy of the ellipse with the area and the ratio of second moments of pixels (n, 2)."""
    covariance = np.cov(points.T) + 1e-6 * np.eye(2)
    area = len(points) * pixel_mm2
    square = covariance * area / (np.pi * np.sqrt(np.linalg.det(covariance)))
    return np.array([*points.mean(axis=0), square[0, 0], square[1, 1], square[0, 1]])
