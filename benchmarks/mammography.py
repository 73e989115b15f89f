"""Geometric model of mammography on the measured half ellipsoid between plates: ``python benchmarks/mammography.py``.

Interior markers at a plate distance of 100 mm are predicted from the shape (half ellipsoid 110 x 130 x 50 mm)
and the distance, with the stated
default parameters. Only the body's frame comes from the markers: its axes in the unloaded state, and its rigid motion between the scans
(it arches off the table), which neither outlines nor distance tell. Distances are root mean squares in 3-D.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu import datasets
from naibu.applications.mammography.breast_shape import half_ellipsoid_shape
from naibu.applications.mammography.geometric_model import DEFAULT_PARAMETERS, CompressionParameters, compressed
from naibu.core.arrays import FloatArray

SIZE_MM = (110.0, 130.0, 50.0)
DISTANCE_MM = 100.0
PIXEL_SCALE = np.array([1.01024, 1.01024, 1.0])  # probable error of the printed x, y; see the folder's known problems
FIRST_LAYER_MM = 7.0  # height of the first layer of markers above the base; see there
PARAMETERS = {
    "default": DEFAULT_PARAMETERS,
    "no bending": CompressionParameters(bending=0.0),
    "elongation along the chest wall only": CompressionParameters(along_share=1.0),
    "growth away from the chest wall only": CompressionParameters(along_share=0.0),
}


@dataclass(frozen=True, slots=True)
class PhantomErrors:
    """Root mean square distances of interior markers, mm.

    Attributes
    ----------
    markers : int
        How many were measured completely in both states.
    rigid_rms_mm : float
        After the best rigid motion.
    in_plane_rms_mm : float
        Along the compression and along the base only, after a motion in the plane of the base.
    fixed_base_rms_mm : float
        With the base held where it was, as a chest wall is: a motion in its plane is removed only.
    without_model_mm : float
        Between unloaded and loaded markers, after the best rigid motion.
    """

    markers: int
    rigid_rms_mm: float
    in_plane_rms_mm: float
    fixed_base_rms_mm: float
    without_model_mm: float


def phantom_errors(parameters: CompressionParameters = DEFAULT_PARAMETERS) -> PhantomErrors:
    """Return the distances between predicted and measured markers at 100 mm."""
    experiment = datasets.load("ct_half_ellipsoid")
    tables = [experiment.state(name).markers for name in ("initial", "width_100")]
    before, after = (PIXEL_SCALE * t.points for t in tables)
    known = np.isfinite(before).all(axis=1)
    middle = before[known].mean(axis=0)
    _, _, axes = np.linalg.svd(before[known, :2] - middle[:2], full_matrices=False)
    long = axes[0] * np.sign(axes[0, 1])
    base = before[known, 2].min() - FIRST_LAYER_MM
    both = known & np.isfinite(after).all(axis=1) & tables[0].trusted & tables[1].trusted
    frame = np.array([[long[1], -long[0], 0.0], [long[0], long[1], 0.0], [0.0, 0.0, 1.0]])
    own = (before[both] - [middle[0], middle[1], base]) @ frame.T
    measured = after[both] - [0.0, 0.0, base]
    predicted = compressed(half_ellipsoid_shape(SIZE_MM), 0.0, DISTANCE_MM, parameters).compress(own)
    flat = _moved(predicted[:, :2], measured[:, :2]) - measured[:, :2]
    height = (predicted - measured)[:, 2]
    return PhantomErrors(
        len(own),
        _rms(_moved(predicted, measured) - measured),
        _rms(flat),
        _rms(np.column_stack([flat, height])),
        _rms(_moved(own, measured) - measured),
    )


def _moved(points: FloatArray, onto: FloatArray) -> FloatArray:
    """Return the points (n, d) after the rotation and translation that bring them nearest to others."""
    a, b = points - points.mean(axis=0), onto - onto.mean(axis=0)
    u, _, v = np.linalg.svd(a.T @ b)
    sign = np.ones(len(v))
    sign[-1] = np.sign(np.linalg.det(u @ v))
    return a @ (u * sign) @ v + onto.mean(axis=0)


def _rms(residuals: FloatArray) -> float:
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))


def main() -> None:
    """Print one line for each set of parameters."""
    print("parameters                              markers  3-D mm  along x, y mm  base held, mm  without a model, mm")
    for name, parameters in PARAMETERS.items():
        e = phantom_errors(parameters)
        print(
            f"{name:40s}{e.markers:7d}{e.rigid_rms_mm:8.2f}{e.in_plane_rms_mm:15.2f}{e.fixed_base_rms_mm:15.2f}{e.without_model_mm:20.2f}"
        )


if __name__ == "__main__":
    main()
