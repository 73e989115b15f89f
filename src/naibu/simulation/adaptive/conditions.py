"""Supports and loads that do not name nodes, so that they hold on every mesh of a body."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import BoolArray, FloatArray, as_vector
from naibu.core.errors import InputError
from naibu.core.mesh import Mesh
from naibu.meshing.surface import boundary_faces, node_areas

Selection = Callable[[FloatArray], BoolArray]  # from positions at rest (n, d), mm, to the chosen ones (n,)
Load = Callable[[Mesh, FloatArray], FloatArray]  # from a mesh and its nodal masses (n,), kg, to forces (n, d), mN


@dataclass(frozen=True, slots=True)
class Conditions:
    """Supports and loads of a body on any of its meshes.

    Attributes
    ----------
    fixed : callable
        From positions at rest (n, d), mm, to those (n,) that are fixed.
    moved : tuple of callable
        Of nodes that rigid bodies move, one for each body; the velocities are given with the steps.
    loads : tuple of callable
        From a mesh and its nodal masses, kg, to forces on the nodes (n, d), mN; such as `weight` and `face_force`.
    rollers : tuple of (callable, int)
        Nodes that are fixed along one axis only, as on planes of symmetry, each with the axis.
    """

    fixed: Selection
    moved: tuple[Selection, ...] = ()
    loads: tuple[Load, ...] = ()
    rollers: tuple[tuple[Selection, int], ...] = ()

    def constrained(self, points: FloatArray) -> BoolArray:
        """Return the components (n, d) that are fixed."""
        held = np.repeat(np.asarray(self.fixed(points))[:, None], points.shape[1], axis=1)
        for selected, axis in self.rollers:
            held[:, axis] |= selected(points)
        return held

    def force(self, mesh: Mesh, mass: FloatArray) -> FloatArray:
        """Return the sum of the loads (n, d), mN."""
        total = np.zeros_like(mesh.points)
        for load in self.loads:
            total += load(mesh, mass)
        return total


def weight(acceleration: ArrayLike) -> Load:
    """Return the load of gravity, of an acceleration (d,), mm/s^2."""
    vector = np.asarray(acceleration, dtype=float)
    return lambda mesh, mass: mass[:, None] * vector


def face_force(selected: Selection, total: ArrayLike) -> Load:
    """Return a total force (3,), mN, spread evenly over the boundary faces all of whose nodes are selected (see `Conditions`).

    Raises
    ------
    InputError
        A force that is no vector; when it is applied, a mesh without such a face.
    """
    force = as_vector("total", total)

    def load(mesh: Mesh, mass: FloatArray) -> FloatArray:
        faces = boundary_faces(mesh).faces
        chosen = faces[selected(mesh.points)[faces].all(axis=1)]
        if not len(chosen):
            raise InputError("no boundary face has all its nodes selected; select nodes of whole faces")
        area = node_areas(mesh, chosen)
        return np.asarray(area[:, None] * (force / area.sum()))

    return load
