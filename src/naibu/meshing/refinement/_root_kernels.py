"""Kernels: determinants of triangles and tetrahedra, which of them share faces, and the order of their edges."""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import njit


@njit(cache=True)
def determinant(points, cell):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the determinant of the edges from the first vertex of a triangle or tetrahedron: two or six times its size, signed."""
    p, q, r = points[cell[0]], points[cell[1]], points[cell[2]]
    ux, uy, vx, vy = q[0] - p[0], q[1] - p[1], r[0] - p[0], r[1] - p[1]
    if len(cell) == 3:
        return ux * vy - uy * vx
    s = points[cell[3]]
    uz, vz, wx, wy, wz = q[2] - p[2], r[2] - p[2], s[0] - p[0], s[1] - p[1], s[2] - p[2]
    return ux * (vy * wz - vz * wy) + uy * (vz * wx - vx * wz) + uz * (vx * wy - vy * wx)


@njit(cache=True)
def determinants(points, cells, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Fill in the determinants (m,) of cells (m, 3 or 4)."""
    for c in range(len(cells)):
        out[c] = determinant(points, cells[c])


@njit(cache=True)
def faces_of(cells, k, faces):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Fill in the faces (m k, k - 1) of cells (m, ...), face i opposite to vertex i, each with its vertices in ascending order."""
    for c in range(len(cells)):
        for i in range(k):
            n = 0
            for j in range(k):
                if j == i:
                    continue
                v, at = cells[c, j], n
                while at > 0 and faces[c * k + i, at - 1] > v:
                    faces[c * k + i, at] = faces[c * k + i, at - 1]
                    at -= 1
                faces[c * k + i, at] = v
                n += 1


@njit(cache=True)
def neighbours_by_faces(cells, faces, first, bucket):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set the neighbours, -1 before, of cells (m, ...) from their faces (m k, k - 1), each with its vertices in ascending order.

    Faces are looked for among those of the same smallest vertex. The arrays `first` (n + 1,), 0, and `bucket` (m k,) are workspace.

    Returns
    -------
    int
        A face of three cells, or -1.
    """
    k = faces.shape[1] + 1
    for f in range(len(faces)):
        first[faces[f, 0] + 1] += 1
    for v in range(1, len(first)):
        first[v] += first[v - 1]
    for f in range(len(faces)):  # from then on, first[v] is where the bucket of v ends
        v = faces[f, 0]
        bucket[first[v]] = f
        first[v] += 1
    for v in range(len(first) - 1):
        for i in range(first[v - 1] if v else 0, first[v]):
            f = bucket[i]
            for j in range(i + 1, first[v]):
                g = bucket[j]
                same = faces[f, 1] == faces[g, 1]
                for a in range(2, k - 1):
                    same = same and faces[f, a] == faces[g, a]
                if same:
                    if cells[f // k, 4 + f % k] >= 0:
                        return f
                    cells[f // k, 4 + f % k], cells[g // k, 4 + g % k] = g // k, f // k
    return -1


@njit(cache=True)
def overlapping(points, cells, k, vertices):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return a cell, and the neighbour that lies on the same side of the face that they share; -1 twice where there is none.

    The array `vertices` (k,) is workspace.
    """
    for place in range(k):
        for c in range(len(cells)):
            across = cells[c, 4 + place]
            if across <= c:
                continue
            back = 0
            while cells[across, 4 + back] != c:
                back += 1
            vertices[:] = cells[c, :k]
            here = determinant(points, vertices)
            vertices[place] = cells[across, back]
            there = determinant(points, vertices)
            if np.sign(here) == np.sign(there):
                return c, across
    return -1, -1


@njit(cache=True)
def edge_ranks(points, cells, edges, tie, lengths, ranks):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Fill in the place of every edge among those of its cell (m, e), the longest first.

    Of edges whose lengths are the same, to a fraction `tie` of the longest one in the mesh, that of the lower vertex numbers comes first.
    The array `lengths` (m, e) is workspace.
    """
    longest = 0.0
    for c in range(len(cells)):
        for e in range(len(edges)):
            square = 0.0
            for x in range(points.shape[1]):
                square += (points[cells[c, edges[e, 1]], x] - points[cells[c, edges[e, 0]], x]) ** 2
            lengths[c, e] = np.sqrt(square)
            longest = max(longest, lengths[c, e])
    for c in range(len(cells)):
        for e in range(len(edges)):
            lengths[c, e] = np.round(lengths[c, e] / (tie * longest))
            ranks[c, e] = 0
        for e in range(len(edges)):
            a, b = cells[c, edges[e, 0]], cells[c, edges[e, 1]]
            for f in range(e):
                p, q = cells[c, edges[f, 0]], cells[c, edges[f, 1]]
                one, two = min(a, b) * len(points) + max(a, b), min(p, q) * len(points) + max(p, q)
                before = lengths[c, e] > lengths[c, f] or (lengths[c, e] == lengths[c, f] and one < two)
                ranks[c, f if before else e] += 1
