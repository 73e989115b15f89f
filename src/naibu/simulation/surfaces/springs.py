"""Mass-spring model of a triangulated surface, weighted by areas :cite:p:`hirai2008`, also while it is cut."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray, IntArray, require_positive
from naibu.mechanics.lattices.model.tetrahedral_springs import DampingRule, edge_damping
from naibu.meshing.cutting.surfaces._surface_kernels import MOST_AROUND
from naibu.meshing.cutting.surfaces.surface_cut import SurfaceCutter
from naibu.meshing.cutting.surfaces.surface_result import triangle_areas
from naibu.simulation.surfaces._spring_kernels import SpringArrays, update


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


class CutSprings:
    """The springs of a surface while a tool cuts it: what a step of the cut changes is updated, at a cost that is local too.

    Parameters
    ----------
    cutter : SurfaceCutter
        The surface and its tool.
    membrane_modulus, area_density, damping, damping_ratio
        See `surface_springs`.

    Raises
    ------
    InputError
        See `surface_springs`.
    """

    def __init__(
        self,
        cutter: SurfaceCutter,
        *,
        membrane_modulus: float,
        area_density: float,
        damping: DampingRule = "ratio",
        damping_ratio: float = 1.0,
    ) -> None:
        s, n, t = cutter.arrays, int(cutter.arrays.n[0]), int(cutter.arrays.n[1])
        found = surface_springs(
            s.rest[:n], s.triangles[:t], membrane_modulus=membrane_modulus, area_density=area_density, damping=damping,
            damping_ratio=damping_ratio,
        )  # fmt: skip
        self.cutter = cutter
        self._settings = (float(membrane_modulus), float(area_density), float(damping_ratio), damping == "printed")
        ends = np.zeros((int(s.n[3]), 2), dtype=np.int64)
        ends[s.sides[:t].ravel()] = np.sort(s.triangles[:t][:, [1, 2, 2, 0, 0, 1]].reshape(-1, 2), axis=1)
        order = np.lexsort(ends.T[::-1])
        place = np.argsort(order)  # of each edge among those of `found`, which are sorted
        room = (len(ends) // 2 + 60_000, n // 2 + 20_000)
        rows = (ends, found.length[place], found.stiffness[place], found.damping[place])
        stamps = np.zeros(len(ends), dtype=np.int64), np.zeros(n, dtype=np.int64)
        arrays: list[Any] = [_grown(a, room[0]) for a in rows]
        arrays += [_grown(found.mass, room[1]), _grown(stamps[0], room[0]), _grown(stamps[1], room[1])]
        self._arrays = SpringArrays(*[*arrays, np.zeros(MOST_AROUND, dtype=np.int64), np.zeros(1, dtype=np.int64)])
        self.update()

    def move(self, tip: ArrayLike) -> None:
        """Move the tip of the tool, see `SurfaceCutter.move`, and update the springs that the cut has changed."""
        self.cutter.move(tip)
        self.update()

    def lift(self) -> None:
        """Take the tool off, see `SurfaceCutter.lift`, and update the springs."""
        self.cutter.lift()
        self.update()

    def update(self) -> None:
        """Update the springs where the surface has changed since this was last called."""
        s, k = self.cutter.arrays, self._arrays
        room = len(k.length), len(k.mass)
        if s.n[3] > room[0] or s.n[0] > room[1]:
            more = [int(s.n[3])] * 4 + [int(s.n[0]), int(s.n[3]), int(s.n[0])]
            arrays: list[Any] = [_grown(a, m) for a, m in zip(k[:7], more, strict=True)]
            self._arrays = k = SpringArrays(*[*arrays, *k[7:]])
        update(s, k, *self._settings)

    def springs(self) -> SurfaceSprings:
        """Return the springs as they are now."""
        n, _, _, e, _ = self.cutter.arrays.n.tolist()
        k = self._arrays
        return SurfaceSprings(k.ends[:e].copy(), k.length[:e].copy(), k.stiffness[:e].copy(), k.damping[:e].copy(), k.mass[:n].copy())


def _grown(array: Any, more: int) -> Any:
    return np.concatenate([array, np.zeros((more, *array.shape[1:]), dtype=array.dtype)])
