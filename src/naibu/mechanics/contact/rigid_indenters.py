"""Rigid boxes, cylinders, spheres and planes that touch a lattice: shapes, friction and pull-off (spec L5)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from naibu._numba.compilation import njit
from naibu.core.arrays import FloatArray
from naibu.core.errors import InputError

PLANE, BOX, CYLINDER, SPHERE = range(4)
KINDS = ("plane", "box", "cylinder", "sphere")


@dataclass(frozen=True, slots=True, eq=False)
class RigidIndenter:
    """A rigid body that touches a lattice.

    Attributes
    ----------
    kind : int
        `PLANE`, `BOX`, `CYLINDER` or `SPHERE`.
    centre : ndarray, shape (3,)
        mm; a point of the plane.
    axes : ndarray, shape (3, 3)
        Rows are the body's axes; the third is the plane's outward normal and the cylinder's axis.
    size : ndarray, shape (3,)
        Half edges of the box; radius and half length of the cylinder; radius of the sphere, mm.
    static_friction, kinetic_friction : float
        Coefficients of Amontons and Coulomb.
    pull_stiffness, pull_damping, pull_speed : float
        K_r (mN/mm) and C_r (mN s/mm) of the pull-off force of every mass, and the speed V_t (mm/s) from which on there is none.
    """

    kind: int
    centre: FloatArray
    axes: FloatArray = field(default_factory=lambda: np.eye(3))
    size: FloatArray = field(default_factory=lambda: np.zeros(3))
    static_friction: float = 0.0
    kinetic_friction: float = 0.0
    pull_stiffness: float = 0.0
    pull_damping: float = 0.0
    pull_speed: float = 0.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.centre).all() and np.isfinite(self.size).all() and np.isfinite(self.axes).all()):
            raise InputError(f"the {KINDS[self.kind]} has NaN or infinite numbers; give its place and size in mm")
        if not 0.0 <= self.kinetic_friction <= self.static_friction < np.inf:
            raise InputError(
                f"friction of the {KINDS[self.kind]} is {self.static_friction:g} (static) and {self.kinetic_friction:g} (kinetic); "
                "the kinetic one must not be negative nor above the static one"
            )
        if not min(self.pull_stiffness, self.pull_damping, self.pull_speed) >= 0.0:
            raise InputError(
                f"pull-off of the {KINDS[self.kind]} has K_r {self.pull_stiffness:g}, C_r {self.pull_damping:g} and "
                f"V_t {self.pull_speed:g}; none may be negative"
            )

    def gap(self, points: ArrayLike) -> FloatArray:
        """Return the distance of points (n, 3) from the surface, mm, negative inside."""
        at = np.ascontiguousarray(points, dtype=float)
        out = np.empty((len(at), 4))
        _gaps(self.kind, np.asarray(self.centre, dtype=float), self.axes, self.size, at, out)
        return out[:, 3]


def plane(point: ArrayLike, normal: ArrayLike = (0.0, 0.0, 1.0), **surface: float) -> RigidIndenter:
    """Return a half space that ends at a plane through a point, mm; the normal points out of it. A floor, or a plate without end.

    `surface` are friction and pull-off as in `Indenter`.

    Raises
    ------
    InputError
        A normal without length, or friction or pull-off that cannot be.
    """
    return RigidIndenter(PLANE, _vector(point), _frame(normal), np.zeros(3), **surface)


def box_indenter(centre: ArrayLike, edges: ArrayLike, axes: ArrayLike | None = None, **surface: float) -> RigidIndenter:
    """Return a box with given edges, mm, along `axes` (rows, by default the frame's); see `plane` for `surface`.

    Raises
    ------
    InputError
        Edges that are not positive, or axes that are not orthonormal.
    """
    return RigidIndenter(BOX, _vector(centre), _orthonormal(axes), 0.5 * _positive(edges, "edges of a box"), **surface)


def cylindrical_indenter(
    centre: ArrayLike, radius: float, length: float, axis: ArrayLike = (0.0, 0.0, 1.0), **surface: float
) -> RigidIndenter:
    """Return a cylinder, mm, about an axis; see `plane` for `surface`.

    Raises
    ------
    InputError
        A radius or length that is not positive, or an axis without length.
    """
    sizes = _positive([radius, length, 1.0], "radius and length of a cylinder")
    return RigidIndenter(CYLINDER, _vector(centre), _frame(axis), sizes * (1.0, 0.5, 0.0), **surface)


def spherical_indenter(centre: ArrayLike, radius: float, **surface: float) -> RigidIndenter:
    """Return a sphere, mm; see `plane` for `surface`.

    Raises
    ------
    InputError
        A radius that is not positive.
    """
    return RigidIndenter(
        SPHERE, _vector(centre), np.eye(3), _positive([radius, 1.0, 1.0], "radius of a sphere") * (1.0, 0.0, 0.0), **surface
    )


def _vector(values: ArrayLike) -> FloatArray:
    vector = np.array(values, dtype=float)
    if vector.shape != (3,):
        raise InputError(f"a place or direction has three numbers, not the shape {vector.shape}")
    return vector


def _positive(values: ArrayLike, what: str) -> FloatArray:
    sizes = _vector(values)
    if not (np.isfinite(sizes) & (sizes > 0.0)).all():
        raise InputError(f"the {what} must be positive, and are {', '.join(f'{v:g}' for v in sizes)} mm")
    return sizes


def _frame(direction: ArrayLike) -> FloatArray:
    """Return orthonormal axes (rows) whose third one has a direction."""
    third = _vector(direction)
    length = float(np.linalg.norm(third))
    if not (np.isfinite(length) and length > 0.0):
        raise InputError(f"a direction must have a length, and ({', '.join(f'{v:g}' for v in third)}) has none")
    third = third / length
    first = np.cross(np.eye(3)[int(np.argmin(np.abs(third)))], third)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(third, first), third])


def _orthonormal(axes: ArrayLike | None) -> FloatArray:
    rows = np.eye(3) if axes is None else np.array(axes, dtype=float)
    if rows.shape != (3, 3) or np.abs(rows @ rows.T - np.eye(3)).max() > 1e-9:
        raise InputError("the axes of a box are three orthonormal rows; normalize them")
    return rows


@njit(cache=True)
def surface_gap(kind, axes, size, d, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set out (4,) to the outward normal at the nearest point of the surface and the gap, for a place d (3,) from the body's centre."""
    q = np.empty(3)
    n = np.zeros(3)
    for a in range(3):
        q[a] = axes[a, 0] * d[0] + axes[a, 1] * d[1] + axes[a, 2] * d[2]
    if kind == PLANE:
        gap = q[2]
        n[2] = 1.0
    elif kind == SPHERE:
        r = np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2)
        gap = r - size[0]
        for a in range(3):
            n[a] = q[a] / r if r > 0.0 else (1.0 if a == 2 else 0.0)
    elif kind == BOX:
        gap = _box_gap(q, size, n)
    else:
        r = np.sqrt(q[0] ** 2 + q[1] ** 2)
        flat = np.array([r, 0.0, q[2]])
        m = np.zeros(3)
        gap = _box_gap(flat, np.array([size[0], 1e300, size[1]]), m)
        n[0] = m[0] * (q[0] / r if r > 0.0 else 1.0)
        n[1] = m[0] * (q[1] / r if r > 0.0 else 0.0)
        n[2] = m[2]
    for a in range(3):
        out[a] = axes[0, a] * n[0] + axes[1, a] * n[1] + axes[2, a] * n[2]
    out[3] = gap


@njit(cache=True)
def _box_gap(q, size, n):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the distance of q from a box of half edges `size`, and set its normal n."""
    outside, deepest, side = 0.0, -1e300, 0
    for a in range(3):
        over = abs(q[a]) - size[a]
        if over > 0.0:
            outside += over * over
            n[a] = over if q[a] > 0.0 else -over
        if over > deepest:
            deepest, side = over, a
    if outside > 0.0:
        gap = np.sqrt(outside)
        for a in range(3):
            n[a] /= gap
        return gap
    n[side] = 1.0 if q[side] >= 0.0 else -1.0
    return deepest


@njit(cache=True)
def _gaps(kind, centre, axes, size, points, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    for i in range(len(points)):
        surface_gap(kind, axes, size, points[i] - centre, out[i])
