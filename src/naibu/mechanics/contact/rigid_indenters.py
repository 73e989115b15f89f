"""Rigid indenters: geometry, position, Coulomb friction and pull-off (adhesion) :cite:p:`hirai2008` (chapter 4.3).

The friction is that of Amontons and Coulomb with a static and a kinetic coefficient; the pull-off is a spring and a dashpot between every
face that touched the indenter and its surface, while the face leaves it slowly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray, as_vector
from naibu.core.errors import InputError
from naibu.mechanics.contact.indenter_geometry import (
    IndenterGeometry,
    bar_geometry,
    box_geometry,
    capsule_geometry,
    cylinder_geometry,
    mesh_geometry,
    plane_geometry,
    sphere_geometry,
)


@dataclass(frozen=True, slots=True, eq=False)
class RigidIndenter:
    """A rigid body that touches a deformable object.

    Attributes
    ----------
    geometry : IndenterGeometry
        Shape, and its orientation at the start.
    centre : ndarray, shape (3,)
        Position of the shape's reference point at the start, mm: the centre, or a point of a plane.
    static_friction, kinetic_friction : float
        Friction coefficients, dimensionless.
    pull_stiffness, pull_damping, pull_speed : float
        K_r (mN/mm) and C_r (mN s/mm) of the pull-off force on the area of every face of a lattice, and the speed V_t
        (mm/s) from which on there is none.
    """

    geometry: IndenterGeometry
    centre: FloatArray
    static_friction: float = 0.0
    kinetic_friction: float = 0.0
    pull_stiffness: float = 0.0
    pull_damping: float = 0.0
    pull_speed: float = 0.0

    def __post_init__(self) -> None:
        as_vector(f"centre of the {self.geometry.name}", self.centre)
        if not 0.0 <= self.kinetic_friction <= self.static_friction < np.inf:
            raise InputError(
                f"friction of the {self.geometry.name} is {self.static_friction:g} (static) and {self.kinetic_friction:g} (kinetic); "
                "the kinetic one must not be negative nor above the static one"
            )
        if not min(self.pull_stiffness, self.pull_damping, self.pull_speed) >= 0.0:
            raise InputError(
                f"pull-off of the {self.geometry.name} has K_r {self.pull_stiffness:g}, C_r {self.pull_damping:g} and "
                f"V_t {self.pull_speed:g}; none may be negative"
            )

    def gap(self, points: ArrayLike) -> FloatArray:
        """Return the signed distances of points (n, 3) from the surface at the start, mm, negative inside."""
        return self.geometry.distance(np.asarray(points, dtype=float) - self.centre)


def plane_indenter(point: ArrayLike, normal: ArrayLike = (0.0, 0.0, 1.0), **surface: float) -> RigidIndenter:
    """Return a half space that ends at a plane through a point, mm, with an outward normal: a floor, or a plate without end.

    `surface` are friction and pull-off as in `RigidIndenter`.

    Raises
    ------
    InputError
        A normal without length, or friction or pull-off out of range.
    """
    return RigidIndenter(plane_geometry(normal), as_vector("point", point), **surface)


def bar_indenter(centre: ArrayLike, axis: str, width_mm: float, *, corner_radius_mm: float = 1.0, **surface: float) -> RigidIndenter:
    """Return a bar along ``"x"`` or ``"y"`` with its face downwards, through `centre`; see `plane_indenter` for `surface`.

    Raises
    ------
    InputError
        A corner radius that is not between 0 and half of the width.
    """
    return RigidIndenter(bar_geometry(axis, width_mm, corner_radius_mm=corner_radius_mm), as_vector("centre", centre), **surface)


def box_indenter(centre: ArrayLike, edges: ArrayLike, axes: ArrayLike | None = None, **surface: float) -> RigidIndenter:
    """Return a box with given edges, mm, along `axes` (rows; by default those of the frame); see `plane_indenter` for `surface`.

    Raises
    ------
    InputError
        Edges that are not positive, or axes that are not orthonormal.
    """
    return RigidIndenter(box_geometry(edges, axes), as_vector("centre", centre), **surface)


def cylindrical_indenter(
    centre: ArrayLike, radius: float, length: float, axis: ArrayLike = (0.0, 0.0, 1.0), **surface: float
) -> RigidIndenter:
    """Return a cylinder with flat ends, mm, about an axis; see `plane_indenter` for `surface`.

    Raises
    ------
    InputError
        A radius or length that is not positive, or an axis without length.
    """
    return RigidIndenter(cylinder_geometry(radius, length, axis), as_vector("centre", centre), **surface)


def spherical_indenter(centre: ArrayLike, radius: float, **surface: float) -> RigidIndenter:
    """Return a sphere, mm; see `plane_indenter` for `surface`.

    Raises
    ------
    InputError
        A radius that is not positive.
    """
    return RigidIndenter(sphere_geometry(radius), as_vector("centre", centre), **surface)


def capsule_indenter(centre: ArrayLike, radius: float, length: float, axis: ArrayLike = (0.0, 0.0, 1.0), **surface: float) -> RigidIndenter:
    """Return a cylinder with hemispherical ends, mm, whose centres are `length` apart; see `plane_indenter` for `surface`.

    Raises
    ------
    InputError
        A radius or length that is not positive, or an axis without length.
    """
    return RigidIndenter(capsule_geometry(radius, length, axis), as_vector("centre", centre), **surface)


def mesh_indenter(centre: ArrayLike, vertices: ArrayLike, triangles: ArrayLike, **surface: float) -> RigidIndenter:
    """Return a closed triangulated surface whose vertices (v, 3), mm, count from `centre`; see `plane_indenter` for `surface`.

    Raises
    ------
    InputError
        A surface that is not closed, or turned inside out.
    """
    return RigidIndenter(mesh_geometry(vertices, triangles), as_vector("centre", centre), **surface)
