"""Numba kernels of rigid indenter geometry: signed distance of a point, its gradient and its second derivative, in closed form.

`q` is the point in the frame of the shape. Kernels return the signed distance (positive outside), set the gradient `n` (3,), which is the
outward normal at the closest point, and, if `h` is not empty, the second derivative `h` (3, 3). Distances to triangle meshes are exact, by
the closest triangle :cite:p:`ericson2005`.
"""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import COUNTED, UNCOUNTED, njit
from naibu.mechanics.contact._triangle_kernels import STACK, closest_point

PLANE, BOX, CYLINDER, SPHERE, CAPSULE, BAR, MESH = range(7)


@njit(cache=True, **COUNTED)
def signed_distance(kind, size, mesh, q, n, h):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the signed distance of q from a shape; see the module for n and h, `packed_geometries` for `size` and `mesh`."""
    if kind == MESH:
        n[:] = 0.0
        h[:] = 0.0
        return _from_mesh(q, mesh, n, h)
    return distance_from_primitive(kind, size, q, n, h)


@njit(cache=True, **UNCOUNTED)
def distance_from_primitive(kind, size, q, n, h):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the signed distance of q from a shape without a mesh, as `signed_distance` does."""
    n[0], n[1], n[2] = 0.0, 0.0, 0.0
    if len(h):
        h[:] = 0.0
    if kind == PLANE:
        n[2] = 1.0
        return q[2]
    if kind == SPHERE:
        return _from_centre(q[0], q[1], q[2], size[0], n, h)
    if kind == BOX:
        return _from_box(q, size, n, h)
    if kind == CYLINDER:
        return _from_cylinder(q, size, n, h)
    if kind == CAPSULE:
        if abs(q[2]) > size[1]:
            return _from_centre(q[0], q[1], q[2] - (size[1] if q[2] > 0.0 else -size[1]), size[0], n, h)
        return _from_axis(q, size[0], n, h)
    return _from_bar(q, size, n, h)


@njit(cache=True, **UNCOUNTED)
def _from_centre(x, y, z, radius, n, h):  # type: ignore[no-untyped-def]  # pragma: no cover
    r = np.sqrt(x**2 + y**2 + z**2)
    n[0], n[1], n[2] = x, y, z
    for a in range(3):
        n[a] = n[a] / r if r > 0.0 else (1.0 if a == 2 else 0.0)
    if len(h) and r > 0.0:
        for a in range(3):
            for b in range(3):
                h[a, b] = ((1.0 if a == b else 0.0) - n[a] * n[b]) / r
    return r - radius


@njit(cache=True, **UNCOUNTED)
def _from_axis(q, radius, n, h):  # type: ignore[no-untyped-def]  # pragma: no cover
    r = np.sqrt(q[0] ** 2 + q[1] ** 2)
    n[0], n[1] = (q[0] / r, q[1] / r) if r > 0.0 else (1.0, 0.0)
    _add_hoop(n[0], n[1], 1.0, r, h)
    return r - radius


@njit(cache=True, **UNCOUNTED)
def _add_hoop(x, y, slope, r, h):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the second derivative around an axis: `slope` is the radial component of the gradient, (x, y) the radial direction."""
    if len(h) and r > 0.0:
        h[0, 0] += slope * y * y / r
        h[1, 1] += slope * x * x / r
        h[0, 1] -= slope * x * y / r
        h[1, 0] -= slope * x * y / r


@njit(cache=True, **UNCOUNTED)
def box_distance(q, size, n):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the distance of q from a box of half edges `size`, and set its normal n."""
    gap, n[0], n[1], n[2] = distance_and_normal_of_box(q[0], q[1], q[2], size[0], size[1], size[2])
    return gap


@njit(cache=True, **UNCOUNTED)
def distance_and_normal_of_box(x, y, z, a, b, c):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the distance of a point from a box of half edges a, b and c, and its normal: numbers are handed over faster than arrays."""
    over_x, over_y, over_z = abs(x) - a, abs(y) - b, abs(z) - c
    sx, sy, sz = 1.0 if x >= 0.0 else -1.0, 1.0 if y >= 0.0 else -1.0, 1.0 if z >= 0.0 else -1.0
    if over_x > 0.0 or over_y > 0.0 or over_z > 0.0:
        nx, ny, nz = max(over_x, 0.0), max(over_y, 0.0), max(over_z, 0.0)
        gap = np.sqrt(nx * nx + ny * ny + nz * nz)
        return gap, sx * nx / gap, sy * ny / gap, sz * nz / gap
    if over_x >= over_y and over_x >= over_z:
        return over_x, sx, 0.0, 0.0
    if over_y >= over_z:
        return over_y, 0.0, sy, 0.0
    return over_z, 0.0, 0.0, sz


@njit(cache=True, **UNCOUNTED)
def _from_box(q, size, n, h):  # type: ignore[no-untyped-def]  # pragma: no cover
    gap = box_distance(q, size, n)
    if len(h) and gap > 0.0:
        for a in range(3):
            for b in range(3):
                h[a, b] = ((1.0 if a == b and abs(q[a]) > size[a] else 0.0) - n[a] * n[b]) / gap
    return gap


@njit(cache=True, **UNCOUNTED)
def distance_from_turned_block(kind, half, axes, x, y, z):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the signed distance of a point from a plane or a box, and its outward normal.

    `half` are the half edges of the box, `axes` the nine components of the axes of the shape, row by row. Kernels that look at many points
    need no arrays for it, which take longer to hand over than to compute with.
    """
    a, b, c, d, e, f, g, h, i = axes
    if kind == PLANE:
        return g * x + h * y + i * z, g, h, i
    gap, u, v, w = distance_and_normal_of_box(
        a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z, half[0], half[1], half[2]
    )
    return gap, a * u + d * v + g * w, b * u + e * v + h * w, c * u + f * v + i * w


@njit(cache=True, **UNCOUNTED)
def gap_of_sphere(radius, d, n):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the signed distance of a point at d (3,) from the centre of a sphere, and set its outward normal n (3,)."""
    r = np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
    n[0], n[1], n[2] = (d[0] / r, d[1] / r, d[2] / r) if r > 0.0 else (0.0, 0.0, 1.0)
    return r - radius


@njit(cache=True, **UNCOUNTED)
def _from_cylinder(q, size, n, h):  # type: ignore[no-untyped-def]  # pragma: no cover
    r = np.sqrt(q[0] ** 2 + q[1] ** 2)
    outward, upward = r - size[0], abs(q[2]) - size[1]
    if outward > 0.0 and upward > 0.0:
        gap = np.sqrt(outward * outward + upward * upward)
        radial, axial = outward / gap, upward / gap
    elif upward > outward:
        gap, radial, axial = upward, 0.0, 1.0
    else:
        gap, radial, axial = outward, 1.0, 0.0
    x, y = (q[0] / r, q[1] / r) if r > 0.0 else (1.0, 0.0)
    n[0] = radial * x
    n[1] = radial * y
    n[2] = axial if q[2] >= 0.0 else -axial
    if len(h):
        if gap > 0.0 and radial != 0.0 and axial != 0.0:  # the rim: a circle, seen in the plane of the axis
            e = (x, y, 0.0)
            for a in range(3):
                for b in range(3):
                    h[a, b] = (e[a] * e[b] + (1.0 if a == 2 and b == 2 else 0.0) - n[a] * n[b]) / gap
        _add_hoop(x, y, radial, r, h)
    return gap


@njit(cache=True, **UNCOUNTED)
def _from_bar(q, size, n, h):  # type: ignore[no-untyped-def]  # pragma: no cover
    """A bar without end along y, its face at z = 0, of half width size[0], with edges rounded by size[1]; it fills z < 0."""
    radius = size[1]
    side = 1.0 if q[0] >= 0.0 else -1.0
    d1, d2 = side * q[0] - (size[0] - radius), q[2] + radius
    if d1 > 0.0 and d2 > 0.0:
        distance = np.sqrt(d1 * d1 + d2 * d2)
        n[0], n[2] = d1 * side / distance, d2 / distance
        if len(h):
            h[0, 0], h[2, 2] = (1.0 - n[0] * n[0]) / distance, (1.0 - n[2] * n[2]) / distance
            h[0, 2] = h[2, 0] = -n[0] * n[2] / distance
        return distance - radius
    if d1 > d2:
        n[0] = side
        return d1 - radius
    n[2] = 1.0
    return d2 - radius


@njit(cache=True, **COUNTED)
def _from_mesh(q, mesh, n, h):  # type: ignore[no-untyped-def]  # pragma: no cover
    vertices, triangles, order, start, boxes = mesh
    stack = np.empty(STACK, dtype=np.int64)
    gap, triangle, weights = closest_point((q[0], q[1], q[2]), vertices, triangles, order, start, boxes, stack, n)
    if len(h) == 0 or abs(gap) < 1e-12:
        return gap
    corner = triangles[triangle]
    count = 0
    e = np.zeros(3)
    for k in range(3):  # e: along an edge, if that is closest
        if weights[k] > 1e-12:
            count += 1
            for a in range(3):
                e[a] = vertices[corner[k], a] - e[a]
    if count == 3:
        return gap
    length = np.sqrt(e[0] ** 2 + e[1] ** 2 + e[2] ** 2)
    for a in range(3):
        for b in range(3):
            along = e[a] * e[b] / length**2 if count == 2 else 0.0
            h[a, b] = ((1.0 if a == b else 0.0) - along - n[a] * n[b]) / gap
    return gap


@njit(cache=True)
def mesh_of(geometry, k):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the mesh of shape k, which is empty where it has none."""
    _, _, (vertices, triangles, order, start, boxes, first) = geometry
    node, end, face, last, point, behind = first[k, 0], first[k + 1, 0], first[k, 1], first[k + 1, 1], first[k, 2], first[k + 1, 2]
    return vertices[point:behind], triangles[face:last], order[face:last], start[node:end], boxes[node:end]


@njit(cache=True)
def outward_normal_and_gap(geometry, k, axes, d, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set out (4,) to outward normal and signed distance of a point d (3,) from the reference point of body k, whose axes are rows."""
    kinds, sizes, _ = geometry
    q, n, none = np.empty(3), np.empty(3), np.empty((0, 0))
    for a in range(3):
        q[a] = axes[a, 0] * d[0] + axes[a, 1] * d[1] + axes[a, 2] * d[2]
    gap = signed_distance(kinds[k], sizes[k], mesh_of(geometry, k), q, n, none)
    for a in range(3):
        out[a] = axes[0, a] * n[0] + axes[1, a] * n[1] + axes[2, a] * n[2]
    out[3] = gap


@njit(cache=True)
def distance_with_derivatives(geometry, axes, y, n, h):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the signed distance of a point y (3,) from the first shape of `geometry`, whose axes are rows; set gradient n and h (3, 3)."""
    kinds, sizes, _ = geometry
    q, m, k = np.empty(3), np.empty(3), np.empty((3, 3))
    for a in range(3):
        q[a] = y[0] * axes[a, 0] + y[1] * axes[a, 1] + y[2] * axes[a, 2]
    gap = signed_distance(kinds[0], sizes[0], mesh_of(geometry, 0), q, m, k)
    for a in range(3):
        n[a] = axes[0, a] * m[0] + axes[1, a] * m[1] + axes[2, a] * m[2]
        for b in range(3):
            h[a, b] = 0.0
            for i in range(3):
                for j in range(3):
                    h[a, b] += axes[i, a] * k[i, j] * axes[j, b]
    return gap


@njit(cache=True, nogil=True)
def distances(geometry, axes, points, gap, gradient, second):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Fill signed distances (p,), gradients (p, 3) and second derivatives (p, 3, 3) of points from the first shape of `geometry`."""
    for i in range(len(points)):
        gap[i] = distance_with_derivatives(geometry, axes, points[i], gradient[i], second[i])
