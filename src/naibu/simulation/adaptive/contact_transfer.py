"""The contact of a lattice whose mesh has changed: what the points of the old faces hold goes to those of the new ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from naibu.core.arrays import FloatArray, IntArray
from naibu.mechanics.contact.rigid_indenters import RigidIndenter
from naibu.mechanics.lattices.model.contact_state import ContactState
from naibu.mechanics.lattices.model.contact_surface import ContactSurface


def transferred_contact(
    contact: ContactState, before: ContactSurface, after: ContactSurface, indenters: Sequence[RigidIndenter], multiplier: FloatArray
) -> ContactState:
    """Return the contact on the faces of another mesh of the same body.

    Every quadrature point takes what the nearest one before held, of faces that look the same way at rest, so that the two sides of a cut
    stay apart. The pressure at the nodes is given, as a mesh hands nodal values over.

    Parameters
    ----------
    contact : ContactState
        On the mesh before.
    before, after : ContactSurface
        Faces of both meshes.
    indenters : sequence of RigidIndenter
        In contact.
    multiplier : ndarray, shape (indenters, n)
        Pressure at the nodes of the mesh after, kPa.
    """
    order = np.array([after.order(i.geometry) for i in indenters], dtype=np.int64)
    sources = [
        low + nearest_points(surface_points(before, int(old)), surface_points(after, int(new)))
        for low, old, new in zip(contact.first, contact.order, order, strict=False)
    ]
    source = np.concatenate([*sources, np.zeros(0, np.int64)])
    first = np.cumsum([0, *(len(s) for s in sources)]).astype(np.int64)
    held = ("mode", "touched", "compression", "extension", "friction", "begun")
    return replace(
        contact, order=order, first=first, multiplier=np.ascontiguousarray(multiplier), covered=np.zeros(np.shape(multiplier)),
        thickness=_transferred_thickness(contact.thickness, before, after),
        acceleration=np.zeros((3, len(after.points))), lasting=np.zeros(1),
        **{name: getattr(contact, name)[source] for name in held},
    )  # fmt: skip


def _transferred_thickness(thickness: FloatArray, before: ContactSurface, after: ContactSurface) -> FloatArray:
    """Return the thickness (k, f) of the foundations after, as thick in mm as those of the nearest faces before."""
    nearest = nearest_points(_middles(before), _middles(after))
    edges = _edges(before)[nearest] / _edges(after)
    return np.ascontiguousarray(thickness[:, nearest] * edges)


def _middles(surface: ContactSurface) -> FloatArray:
    return points_with_normals(surface.points[surface.faces].mean(axis=1)[:, None], surface.points, surface.faces)


def _edges(surface: ContactSurface) -> FloatArray:
    corners = surface.points[surface.faces]
    return np.asarray(np.sqrt(np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, -1] - corners[:, 0]), axis=1)))


def surface_points(surface: ContactSurface, order: int) -> FloatArray:
    """Return the quadrature points (p, 6) of all faces at rest: places, mm, and outward normals times the edge of a typical face, mm."""
    shape, _ = surface.quadrature(order)
    at = np.einsum("qk,fki->fqi", shape, surface.points[surface.nodes])
    return points_with_normals(at, surface.points, surface.faces)


def points_with_normals(at: FloatArray, points: FloatArray, faces: IntArray) -> FloatArray:
    """Return places (f, q, 3) on faces (f, k) as rows (f q, 6), with the normals of the faces times the edge of a typical one, mm."""
    corners = points[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, -1] - corners[:, 0])
    size = np.linalg.norm(normal, axis=1, keepdims=True)
    along = normal / size * np.sqrt(np.median(size))
    return np.concatenate([at.reshape(-1, 3), np.repeat(along, at.shape[1], axis=0)], axis=1)


def nearest_points(before: FloatArray, after: FloatArray) -> IntArray:
    """Return for every point after (q,) the number of the nearest before; see `surface_points`."""
    return np.asarray(cKDTree(before).query(after)[1], dtype=np.int64)
