"""Scan alignment: pose of the object in the scan of its reference configuration, from the markers and the design of their lattice."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError
from naibu.core.experiment import Experiment
from naibu.core.rigid_transform import RigidTransform


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """Pose of the object in the scan of its reference configuration, and the scale of the scan's coordinates.

    Attributes
    ----------
    pose : RigidTransform
        From the object's frame (base at z = 0, centre at x = y = 0) to the scan, true mm: a rotation about the vertical, and the position
        of the centre of the base.
    scale : ndarray, shape (3,)
        True mm per printed mm along x, y, z.
    """

    pose: RigidTransform
    scale: FloatArray

    def to_object(self, printed: FloatArray) -> FloatArray:
        """Return positions (n, 3) in the object's frame, mm, of printed coordinates."""
        return self.pose.inverse().applied(printed * self.scale)


def placement(experiment: Experiment) -> Placement:
    """Find the pose of the object in the scan of its reference configuration.

    The turn about the vertical is that of the marker lattice where it has a nominal spacing; x and y are centred on the markers (the
    lattice is taken to be centred in the object); the base is the one stated in the file, else the lattice's nominal heights, else the
    height that leaves the outermost markers the same clearance.

    Raises
    ------
    InputError
        Fewer than four complete markers in the reference configuration.
    """
    scale = np.array([experiment.xy_scale, experiment.xy_scale, 1.0])
    known = experiment.initial.points[experiment.initial.trusted]
    points = known[np.isfinite(known).all(axis=1)] * scale
    if len(points) < 4:
        raise InputError(
            f"experiment {experiment.name!r}: only {len(points)} complete markers in the reference configuration; at least 4 are needed"
        )
    turn = _lattice_turn(points, experiment.nominal_spacing_mm) if experiment.nominal_spacing_mm else 0.0
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
    turned = points @ rotation
    centre = _lattice_centre(turned[:, :2], experiment.nominal_spacing_mm)
    base = _base(experiment, turned - [*centre, 0.0])
    return Placement(RigidTransform(rotation, np.zeros(3), rotation @ np.array([*centre, base])), scale)


def _lattice_turn(points: FloatArray, spacing: float) -> float:
    """Angle of a square lattice in (-45, 45] degrees: circular mean, modulo 90 degrees, of the directions between neighbours."""
    difference = points[:, None, :] - points[None, :, :]
    flat = np.hypot(difference[..., 0], difference[..., 1])
    near = (np.abs(flat - spacing) < 0.25 * spacing) & (np.abs(difference[..., 2]) < 0.4 * spacing)
    if near.sum() < 8:
        return 0.0
    angle = np.arctan2(difference[..., 1][near], difference[..., 0][near])
    return float(np.angle(np.exp(4j * angle).mean()) / 4.0)


def _lattice_centre(flat: FloatArray, spacing: float | None) -> FloatArray:
    """Centre of the markers' extent; for a lattice, the middle of its outermost columns and rows (means over each)."""
    centre: FloatArray = 0.5 * (flat.min(axis=0) + flat.max(axis=0))
    if spacing is None:
        return centre
    for axis in range(2):
        column = np.round((flat[:, axis] - np.median(flat[:, axis])) / spacing)
        index = np.arange(column.min(), column.max() + 1)
        offset = np.mean(flat[:, axis] - column * spacing)
        centre[axis] = offset + 0.5 * (index[0] + index[-1]) * spacing
    return centre


def _base(experiment: Experiment, centred: FloatArray) -> float:
    """Height of the base in the scan, mm, of markers centred in x and y."""
    heights = np.array(experiment.nominal_heights_mm)
    if experiment.base_z_mm is not None:
        return experiment.base_z_mm
    z = centred[:, 2]
    if len(heights) > 1:
        rough = z.min() - heights.min()
        nearest = heights[np.argmin(np.abs((z - rough)[:, None] - heights), axis=1)]
        return float(np.mean(z - nearest))
    candidates = np.arange(z.max() - experiment.height_mm, z.min(), 0.1)
    if len(candidates) == 0:
        return float(z.min())
    return float(candidates[np.argmax([_clearance(experiment, centred - [0.0, 0.0, b]) for b in candidates])])


def _clearance(experiment: Experiment, points: FloatArray) -> float:
    """Smallest distance, mm, of points (n, 3) in the object's frame to its surface; negative outside (approximate for curved shapes)."""
    half = np.array(experiment.shape.size_mm[:2]) / 2.0
    height = experiment.height_mm
    if experiment.shape.kind in ("half_ellipsoid", "hemisphere"):
        axes = np.array([*half, height])
        level = np.sqrt(((points / axes) ** 2).sum(axis=1))
        slope = np.linalg.norm(points / axes**2, axis=1) / np.maximum(level, 1e-9)
        return float(min(((1.0 - level) / np.maximum(slope, 1e-9)).min(), points[:, 2].min()))
    side = (half - np.abs(points[:, :2])).min() if experiment.shape.kind == "box" else half[0] - np.hypot(*points[:, :2].T).max()
    return float(min(side, points[:, 2].min(), (height - points[:, 2]).min()))
