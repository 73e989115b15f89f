"""Kernels of the contact points near a rigid body: forces without their derivatives, and positions."""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import njit
from naibu.mechanics.contact._geometry_kernels import (
    BOX,
    MESH,
    PLANE,
    distance_and_normal_of_box,
    distance_from_primitive,
    distance_with_derivatives,
    mesh_of,
    signed_distance,
)
from naibu.mechanics.contact.penalty_contact import friction_derivative, normal_pressure, trial_friction


@njit(cache=True, nogil=True, error_model="numpy")
def add_forces(  # type: ignore[no-untyped-def]  # pragma: no cover
    geometry, axes, nodes, shape, rest, area, k_n, k_t, mu, tied, u, centre, orientation, anchors, gap, force
):
    """Put the gaps of all points in place, and add the forces of those that touch to `force` (n, 3)."""
    kinds, sizes, _ = geometry
    kind, size, mesh = kinds[0], sizes[0], mesh_of(geometry, 0)
    d, y, q, m, n, e, none = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty((0, 0))
    for p in range(len(nodes)):
        _place(p, nodes, shape, rest, u, centre, orientation, axes, d, y, q)
        if kind == PLANE:
            gap[p], m[0], m[1], m[2] = q[2], 0.0, 0.0, 1.0
        elif kind == BOX:
            gap[p], m[0], m[1], m[2] = distance_and_normal_of_box(q[0], q[1], q[2], size[0], size[1], size[2])
        else:
            gap[p] = distance_from_primitive(kind, size, q, m, none) if kind != MESH else signed_distance(kind, size, mesh, q, m, none)
        pressure, slope = normal_pressure(gap[p], k_n[p], tied)
        if slope == 0.0:
            continue
        along = 0.0
        for i in range(3):
            n[i] = axes[0, i] * m[0] + axes[1, i] * m[1] + axes[2, i] * m[2]
            along += n[i] * (y[i] - anchors[p, i])
        slip = 0.0
        for i in range(3):
            e[i] = k_t[p] * (y[i] - anchors[p, i] - along * n[i])
            slip += e[i] * e[i]
        slip = np.sqrt(slip)
        ratio = mu[p] * pressure / slip if not tied and slip > mu[p] * pressure else 1.0
        for i in range(3):
            d[i] = area[p] * (pressure * n[i] - ratio * e[i])
        for i in range(3):
            f = orientation[i, 0] * d[0] + orientation[i, 1] * d[1] + orientation[i, 2] * d[2]
            for a in range(shape.shape[1]):
                force[nodes[p, a], i] += shape[p, a] * f


@njit(cache=True, nogil=True, error_model="numpy")
def add_stiffness(  # type: ignore[no-untyped-def]  # pragma: no cover
    geometry, axes, nodes, shape, rest, area, k_n, k_t, mu, tied, u, centre, orientation, anchors, gap, points, positions, secant, blocks
):
    """Add the stiffness of the points with negative gaps to blocks, that of friction with its secant along the slip or without."""
    kind, size = geometry[0][0], geometry[1][0]
    d, y, q, n, e, h = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty((3, 3))
    d_trial, friction, own, world = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for p in range(len(nodes)):
        if gap[p] >= 0.0:
            continue
        _place(p, nodes, shape, rest, u, centre, orientation, axes, d, y, q)
        flat = True
        if kind == PLANE:
            n[0], n[1], n[2] = axes[2, 0], axes[2, 1], axes[2, 2]
            distance = q[2]
        elif kind == BOX and abs(q[0]) < size[0] and abs(q[1]) < size[1] and abs(q[2]) < size[2]:
            distance, d[0], d[1], d[2] = distance_and_normal_of_box(q[0], q[1], q[2], size[0], size[1], size[2])
            for i in range(3):
                n[i] = axes[0, i] * d[0] + axes[1, i] * d[1] + axes[2, i] * d[2]
        else:
            flat = False
            distance = distance_with_derivatives(geometry, axes, y, n, h)
        pressure, slope = normal_pressure(distance, k_n[p], tied)
        if flat:
            _of_flat_point(p, y, anchors, n, k_t[p], mu[p], pressure, slope, tied, secant, e, own)
        else:
            slip, limit = trial_friction(y, anchors[p], n, h, k_t[p], e, d_trial), mu[p] * pressure
            slides, along = not tied and slip > limit, 0.0
            friction_derivative(e, slip, n, d_trial, limit, mu[p] * slope, slides, friction)
            if secant and slides and limit > 0.0:  # that across it, the trace of the derivative where the surface is flat
                along = max(friction[0, 0] + friction[1, 1] + friction[2, 2], 0.0) / (slip * slip)
            for i in range(3):
                for j in range(3):
                    own[i, j] = friction[i, j] - slope * n[i] * n[j] + along * e[i] * e[j]
        for i in range(3):
            for j in range(3):
                d[j] = orientation[i, 0] * own[0, j] + orientation[i, 1] * own[1, j] + orientation[i, 2] * own[2, j]
            for j in range(3):
                world[i, j] = area[p] * (d[0] * orientation[j, 0] + d[1] * orientation[j, 1] + d[2] * orientation[j, 2])
        _spread(p, points[p], positions, shape, world, blocks)


@njit(cache=True, inline="always")
def _of_flat_point(p, y, anchors, n, k_t, mu, pressure, slope, tied, secant, e, own):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set the stiffness (3, 3) of a point of unit area on a flat face, which needs no derivative of the normal; e (3,) is scratch."""
    along, slip = 0.0, 0.0
    for i in range(3):
        along += n[i] * (y[i] - anchors[p, i])
    for i in range(3):
        e[i] = k_t * (y[i] - anchors[p, i] - along * n[i])
        slip += e[i] * e[i]
    slip, limit = np.sqrt(slip), mu * pressure
    slides = not tied and slip > limit
    across = limit / slip * k_t if slides else k_t
    rise = mu * slope / slip if slides else 0.0
    lengthwise = (0.0 if secant else -across) / (slip * slip) if slides else 0.0
    for i in range(3):
        for j in range(3):
            own[i, j] = (rise * e[i] - (across + slope) * n[i]) * n[j] + lengthwise * e[i] * e[j]
        own[i, i] += across


@njit(cache=True, inline="always")
def _spread(p, point, positions, shape, world, blocks):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the stiffness (3, 3) of point p to the blocks of its nodes."""
    w00, w01, w02 = world[0, 0], world[0, 1], world[0, 2]
    w10, w11, w12 = world[1, 0], world[1, 1], world[1, 2]
    w20, w21, w22 = world[2, 0], world[2, 1], world[2, 2]
    for a in range(shape.shape[1]):
        for b in range(shape.shape[1]):
            weight, block = shape[p, a] * shape[p, b], blocks[positions[point, a, b]]
            block[0, 0] += weight * w00
            block[0, 1] += weight * w01
            block[0, 2] += weight * w02
            block[1, 0] += weight * w10
            block[1, 1] += weight * w11
            block[1, 2] += weight * w12
            block[2, 0] += weight * w20
            block[2, 1] += weight * w21
            block[2, 2] += weight * w22


@njit(cache=True, nogil=True)
def local(geometry, axes, nodes, shape, rest, u, centre, orientation, y, gap):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Put the positions (p, 3) of all points in the frame of the body, and their gaps (p,), in place."""
    kinds, sizes, _ = geometry
    kind, size, mesh = kinds[0], sizes[0], mesh_of(geometry, 0)
    d, at, q, n, none = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty((0, 0))
    for p in range(len(nodes)):
        _place(p, nodes, shape, rest, u, centre, orientation, axes, d, at, q)
        y[p, 0], y[p, 1], y[p, 2] = at[0], at[1], at[2]
        if kind == PLANE:
            gap[p] = q[2]
        elif kind == BOX:
            gap[p] = distance_and_normal_of_box(q[0], q[1], q[2], size[0], size[1], size[2])[0]
        else:
            gap[p] = distance_from_primitive(kind, size, q, n, none) if kind != MESH else signed_distance(kind, size, mesh, q, n, none)


@njit(cache=True, inline="always")
def _place(p, nodes, shape, rest, u, centre, orientation, axes, d, y, q):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Put the position of point p in the frame of the body, y (3,), and in that of its shape, q (3,), in place; d (3,) is scratch."""
    for i in range(3):
        d[i] = rest[p, i] - centre[i]
    for a in range(shape.shape[1]):
        part, node = shape[p, a], nodes[p, a]
        for i in range(3):
            d[i] += part * u[node, i]
    for i in range(3):
        y[i] = d[0] * orientation[0, i] + d[1] * orientation[1, i] + d[2] * orientation[2, i]
    for i in range(3):
        q[i] = y[0] * axes[i, 0] + y[1] * axes[i, 1] + y[2] * axes[i, 2]
