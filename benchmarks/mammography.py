"""Models of mammography on the measured half ellipsoid between plates: ``python benchmarks/mammography.py``.

Interior markers at a plate distance of 100 mm are predicted from the shape and the distance, with stated parameters; no displacement of
a marker is
used. Only the body's frame comes from the markers: its axes in the unloaded state, and its position on the table. The shape is a half
ellipsoid of
110 x 130 x 50 mm, as the rows of markers show, on a straight part of 20 mm, which makes up the printed height of 70 mm. Distances are
root mean
squares in 3-D. ``--record`` writes ``results/mammography.json``.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from records import ResultTable, write_record

from naibu import datasets
from naibu.applications.mammography.breast_shape import BreastShape, half_ellipsoid_shape
from naibu.applications.mammography.geometric_model import CompressionParameters, compressed
from naibu.applications.mammography.mechanical_model import MechanicalParameters, mechanically_compressed
from naibu.core.arrays import FloatArray

SIZE_MM = (110.0, 130.0, 50.0)
DISTANCE_MM = 100.0
PIXEL_SCALE = np.array([1.01024, 1.01024, 1.0])  # probable error of the printed x, y; see the folder's known problems
FIRST_LAYER_MM = 7.0  # height of the first layer of markers above the base; see there
STRAIGHT_MM = 20.0  # printed height 70 mm less the 50 mm of the half ellipsoid
GEL = MechanicalParameters(
    tissue_kpa=125.0, poisson_ratio=0.49, skin_kpa=0.0, friction=0.5, density=1e-6
)  # the softer of the two gels tested
MODELS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "geometric, base free to arch": lambda p: compressed(phantom_shape(), 0.0, DISTANCE_MM, free_base=True).compress(p),
    "geometric, base held": lambda p: compressed(phantom_shape(), 0.0, DISTANCE_MM).compress(p),
    "geometric, base free, no bending": lambda p: compressed(
        phantom_shape(), 0.0, DISTANCE_MM, CompressionParameters(bending=0.0), free_base=True
    ).compress(p),
    "mechanical, on a table": lambda p: mechanically_compressed(phantom_shape(), 0.0, DISTANCE_MM, GEL, free_base=True).compress(p),
    "mechanical, modulus of the stiffer gel": lambda p: mechanically_compressed(
        phantom_shape(), 0.0, DISTANCE_MM, replace(GEL, tissue_kpa=222.0), free_base=True
    ).compress(p),
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
        On the table: a motion in its plane is removed only.
    without_model_mm : float
        Between unloaded and loaded markers, after the best rigid motion.
    """

    markers: int
    rigid_rms_mm: float
    in_plane_rms_mm: float
    fixed_base_rms_mm: float
    without_model_mm: float


def phantom_shape() -> BreastShape:
    """Return the half ellipsoid on its straight part."""
    cap = half_ellipsoid_shape(SIZE_MM)
    straight = np.linspace(0.0, STRAIGHT_MM, 20)[:-1]
    return BreastShape(
        np.append(straight, STRAIGHT_MM + cap.depths),
        np.zeros((len(straight) + len(cap.depths), 2)),
        np.vstack([np.repeat(cap.squares[:1], len(straight), axis=0), cap.squares]),
    )


def phantom_errors(model: str = "geometric, base free to arch") -> PhantomErrors:
    """Return the distances between predicted and measured markers at 100 mm."""
    experiment = datasets.load("ct_half_ellipsoid")
    tables = [experiment.state(name).markers for name in ("initial", "width_100")]
    before, after = (PIXEL_SCALE * t.points for t in tables)
    known = np.isfinite(before).all(axis=1)
    middle = before[known].mean(axis=0)
    _, _, axes = np.linalg.svd(before[known, :2] - middle[:2], full_matrices=False)
    long = axes[0] * np.sign(axes[0, 1])
    base = before[known, 2].min() - FIRST_LAYER_MM - STRAIGHT_MM
    both = known & np.isfinite(after).all(axis=1) & tables[0].trusted & tables[1].trusted
    frame = np.array([[long[1], -long[0], 0.0], [long[0], long[1], 0.0], [0.0, 0.0, 1.0]])
    own = (before[both] - [middle[0], middle[1], base]) @ frame.T
    measured = after[both] - [0.0, 0.0, base]
    predicted = MODELS[model](own)
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
    """Print one line for each model."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--record", action="store_true", help="write results/mammography.json")
    record = parser.parse_args().record
    columns = ("model", "markers", "rigid motion removed, mm", "along x and y, mm", "on the table, mm", "without a model, mm")
    print("  ".join(columns))
    rows = []
    for name in MODELS:
        e = phantom_errors(name)
        distances = (e.rigid_rms_mm, e.in_plane_rms_mm, e.fixed_base_rms_mm, e.without_model_mm)
        rows.append((name, e.markers, *(round(value, 2) for value in distances)))
        print(f"{name:40s}{e.markers:7d}" + "".join(f"{value:14.2f}" for value in distances), flush=True)
    if record:
        write_record("mammography", (ResultTable("phantom", columns, tuple(rows)),))


if __name__ == "__main__":
    main()
