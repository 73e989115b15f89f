"""Mass-spring model of a triangulated surface, weighted by areas, and the opening of a cut under tension :cite:p:`hirai2008`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize

from naibu.core.arrays import FloatArray, IntArray, require_positive, require_within
from naibu.core.errors import ConvergenceError, InputError
from naibu.mechanics.lattices.model.tetrahedral_springs import DampingRule, edge_damping
from naibu.meshing.cutting.surface_result import SurfaceCut, triangle_areas

ITERATIONS = 20_000
BALANCED = 1e-5  # of the largest force of a spring at the start


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceSprings:
    """Springs on the edges of triangles.

    Attributes
    ----------
    edges : ndarray, shape (e, 2), int64
        Ends of the springs.
    length : ndarray, shape (e,)
        At rest, mm.
    stiffness : ndarray, shape (e,)
        ``E sum S / l^2`` with the areas S of the triangles at the edge, mN/mm.
    damping : ndarray, shape (e,)
        mN s/mm.
    mass : ndarray, shape (n,)
        ``rho sum S / 3``, kg.
    """

    edges: IntArray
    length: FloatArray
    stiffness: FloatArray
    damping: FloatArray
    mass: FloatArray


def surface_springs(
    points: FloatArray,
    triangles: IntArray,
    *,
    membrane_modulus: float,
    area_density: float,
    damping: DampingRule = "ratio",
    damping_ratio: float = 1.0,
) -> SurfaceSprings:
    """Return the springs of a surface, in one piece or several.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        At rest, mm.
    triangles : ndarray, shape (t, 3), int64
        Point numbers.
    membrane_modulus : float
        E, Young's modulus times thickness, mN/mm.
    area_density : float
        kg/mm^2.
    damping, damping_ratio
        See `naibu.mechanics.volumetric_lattice`.

    Raises
    ------
    InputError
        Values that are not positive, or an unknown rule of damping.
    """
    require_positive("membrane_modulus", membrane_modulus, "mN/mm")
    require_positive("area_density", area_density, "kg/mm^2")
    areas = triangle_areas(points, triangles)
    ends = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    keys, number = np.unique(ends[:, 0] * len(points) + ends[:, 1], return_inverse=True)
    edges = np.stack([keys // len(points), keys % len(points)], axis=1)
    around = np.bincount(number.ravel(), np.repeat(areas, 3), minlength=len(edges))
    mass = np.asarray(area_density / 3.0 * np.bincount(triangles.ravel(), np.repeat(areas, 3), minlength=len(points)), dtype=np.float64)
    length = np.linalg.norm(points[edges[:, 1]] - points[edges[:, 0]], axis=1)
    stiffness = membrane_modulus * around / length**2
    return SurfaceSprings(edges, length, stiffness, edge_damping(stiffness, mass[edges].sum(axis=1), length, damping, damping_ratio), mass)


def opened(cut: SurfaceCut, springs: SurfaceSprings, tension: float, held: ArrayLike) -> FloatArray:
    """Return where the points (n, 3), mm, of a cut surface under tension come to rest.

    Parameters
    ----------
    cut : SurfaceCut
        The surface, which the tension held as it is until it was cut.
    springs : SurfaceSprings
        Of its points and triangles.
    tension : float
        Strain by which all springs are stretched before the cut: their length at rest is shorter by this share.
    held : array_like of bool, shape (n,) or (n, 3)
        Points, or single coordinates of them, that do not move. There is no bending stiffness and no inside that resists.

    Raises
    ------
    InputError
        A tension outside 0 to 0.9, a mask of another shape, or a piece with nothing held.
    ConvergenceError
        The springs do not come to balance.
    """
    require_within("tension", tension, 0.0, 0.9)
    mask = np.asarray(held, dtype=bool)
    if mask.shape not in ((len(cut.points),), cut.points.shape):
        raise InputError(f"held must have shape {(len(cut.points),)} or {cut.points.shape}, not {mask.shape}")
    fixed = np.broadcast_to(mask if mask.ndim == 2 else mask[:, None], cut.points.shape)
    loose = set(range(cut.n_pieces)) - set(cut.piece[np.isin(cut.triangles, np.flatnonzero(np.sum(fixed, axis=1))).any(axis=1)].tolist())
    if loose:
        raise InputError(f"held leaves piece {min(loose)} free to drift; hold one of its points")
    i, j = springs.edges.T
    rest, free = (1.0 - tension) * springs.length, ~fixed
    scale = float(springs.stiffness.mean() * springs.length.mean() ** 2)

    def energy(unknown: FloatArray) -> tuple[float, FloatArray]:
        x = cut.points.copy()
        x[free] = unknown
        gap = x[j] - x[i]
        now = np.maximum(np.linalg.norm(gap, axis=1), 1e-300)
        pull = (springs.stiffness * (now - rest) / now)[:, None] * gap
        gradient = np.stack([np.bincount(j, pull[:, k], len(x)) - np.bincount(i, pull[:, k], len(x)) for k in range(3)], axis=1)
        return 0.5 * float((springs.stiffness * (now - rest) ** 2).sum()) / scale, gradient[free] / scale

    least = BALANCED * max(float((springs.stiffness * springs.length).max()) * tension, 1e-300) / scale
    options: Any = {"maxiter": ITERATIONS, "maxfun": 2 * ITERATIONS, "gtol": least, "ftol": 0.0, "maxcor": 30}
    found = minimize(energy, cut.points[free], jac=True, method="L-BFGS-B", options=options)
    left = float(np.abs(found.jac).max(initial=0.0))
    if left > 100.0 * least:
        raise ConvergenceError(f"the springs are out of balance by {left * scale:.2g} mN after {found.nit} iterations; hold more points")
    out = cut.points.copy()
    out[free] = found.x
    return out
