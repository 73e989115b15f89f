"""The measured half ellipsoid with markers inside, between plates, and models that know its shape and the plates' distance only.

The gel's hardness is not stated, and weight over stiffness decides how far the body arches off the table. Moduli come from two sources
that know nothing of this experiment: the hardness of the report's two gels, if it is that of the durometer scale C (JIS K 7312) by
which such gels are sold, and the report's compression tests.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from naibu import datasets
from naibu.applications.mammography.breast_shape import BreastShape, half_ellipsoid_shape
from naibu.applications.mammography.mechanical_model import MechanicalParameters, mechanically_compressed
from naibu.core.arrays import FloatArray

DISTANCE_MM = 100.0  # of the plates
SIZE_MM = (110.0, 130.0, 49.0)  # of the half ellipsoid whose lattice points are the rows of markers
STRAIGHT_MM = 21.0  # the printed height of 70 mm less 49 mm
FIRST_LAYER_MM = STRAIGHT_MM + 7.0  # mean height of the first layer of markers above the table
PIXEL_SCALE = np.array([1.01024, 1.01024, 1.0])  # probable error of the printed x, y; see the folder's known problems
GEL = MechanicalParameters(tissue_kpa=125.0, poisson_ratio=0.49, skin_kpa=0.0, friction=0.5, density=1e-6)
TESTED_KPA = {0: 125.0, 5: 222.0}  # Table 3.4
EDGE = 0.14  # of elements in a half ball of radius 1
_LAYER_MM = 5.0  # half the distance of the layers
_TOUCHING = 0.9985  # of the body's width: plates that only just touch
_TURNS = 2


def hardness_modulus(hardness: float) -> float:
    """Return Young's modulus, kPa, of an incompressible neo-Hookean solid of a hardness on the durometer scale C of JIS K 7312.

    A sphere of radius 2.54 mm is pressed by 0.539 N, and 0.0784 N more for each degree, and penetrates by 2.54 mm, and 1 % less for each
    degree; its force at a penetration d is (16/9) E sqrt(R) d^1.5 (1 - 0.15 d/R) :cite:p:`zhang2014`.

    Parameters
    ----------
    hardness : float
        From 0 to below 100.
    """
    radius_mm = 2.54
    depth_mm = radius_mm * (1.0 - 0.01 * hardness)
    force_mn = 539.0 + 78.4 * hardness
    return float(force_mn * 9.0 / (16.0 * np.sqrt(radius_mm) * depth_mm**1.5 * (1.0 - 0.15 * depth_mm / radius_mm)))


def mechanical_model(young_kpa: float, *, edge: float = EDGE) -> Callable[[FloatArray], FloatArray]:
    """Return the map (n, 3) -> (n, 3), mm, from the body at rest on its table to the body between the plates.

    Parameters
    ----------
    young_kpa : float
        Young's modulus of the gel.
    edge : float
        Of the elements, in a half ball of radius 1.
    """

    def pressed(resting: FloatArray) -> FloatArray:
        gel, shape = replace(GEL, tissue_kpa=young_kpa), phantom_shape()
        rest = mechanically_compressed(shape, 0.0, _TOUCHING * SIZE_MM[1], gel, free_base=True, edge=edge)
        loaded = mechanically_compressed(shape, 0.0, DISTANCE_MM, gel, free_base=True, edge=edge)
        weightless = resting
        for _ in range(_TURNS):
            weightless = resting - (rest.compress(weightless) - weightless)
        return loaded.compress(weightless)

    return pressed


def phantom_shape() -> BreastShape:
    """Return the half ellipsoid on a straight part, which makes up the printed height of 70 mm."""
    cap = half_ellipsoid_shape(SIZE_MM)
    straight = np.linspace(0.0, STRAIGHT_MM, 20)[:-1]
    return BreastShape(
        np.append(straight, STRAIGHT_MM + cap.depths),
        np.zeros((len(straight) + len(cap.depths), 2)),
        np.vstack([np.repeat(cap.squares[:1], len(straight), axis=0), cap.squares]),
    )


def phantom_markers() -> tuple[FloatArray, FloatArray]:
    """Return markers (n, 3), mm, without load and at 100 mm, across and along the compression and above the table."""
    experiment = datasets.load("ct_half_ellipsoid")
    tables = [markers for name in ("initial", "width_100") if (markers := experiment.state(name).markers) is not None]
    before, after = (PIXEL_SCALE * table.points for table in tables)
    known = np.isfinite(before).all(axis=1)
    middle = before[known].mean(axis=0)
    _, _, axes = np.linalg.svd(before[known, :2] - middle[:2], full_matrices=False)
    long = axes[0] * np.sign(axes[0, 1])
    frame = np.array([[long[1], -long[0], 0.0], [long[0], long[1], 0.0], [0.0, 0.0, 1.0]])
    heights = before[known, 2]
    origin = np.array([middle[0], middle[1], heights[heights < heights.min() + _LAYER_MM].mean() - FIRST_LAYER_MM])
    both = known & np.isfinite(after).all(axis=1) & tables[0].trusted & tables[1].trusted
    resting, moved = (before[both] - origin) @ frame.T, (after[both] - [0.0, 0.0, origin[2]]) @ frame.T
    return resting, moved - [*(moved - resting)[:, :2].mean(axis=0), 0.0]


def rigidly_moved(points: FloatArray, onto: FloatArray) -> FloatArray:
    """Return the points (n, d) after the rotation and translation that bring them nearest to others."""
    a, b = points - points.mean(axis=0), onto - onto.mean(axis=0)
    u, _, v = np.linalg.svd(a.T @ b)
    sign = np.ones(len(v))
    sign[-1] = np.sign(np.linalg.det(u @ v))
    return np.asarray(a @ (u * sign) @ v + onto.mean(axis=0))


def distances_mm(predicted: FloatArray, measured: FloatArray) -> tuple[float, float, float]:
    """Return root mean square distances between points (n, 3), mm.

    After the best rigid motion; along the table only, after the best motion there; and on the table, in 3-D after that motion.
    """
    flat = rigidly_moved(predicted[:, :2], measured[:, :2]) - measured[:, :2]
    on_table = np.column_stack([flat, predicted[:, 2] - measured[:, 2]])
    return _rms(rigidly_moved(predicted, measured) - measured), _rms(flat), _rms(on_table)


def _rms(residuals: FloatArray) -> float:
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))
