"""Kernels of the contact of the two sides of cuts; see `cut_lips` for what they compute."""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import njit

RAMP = 2e-4  # of the edge: penetration over which the pressure rises smoothly
FURTHEST = 2.0  # edges between the nodes of a pair across the normal
TANGENTIAL = 0.5  # stiffness of a pair before it slips, of that across the sides


@njit(cache=True, nogil=True)
def add_facets(at, faces, pairs, corner_pair, sides):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the vector areas of facets to the outward normals (2, p, 3) of the pairs at their corners."""
    e, f = np.empty(3), np.empty(3)
    for t in range(len(faces)):
        a, b, c = faces[t, 0], faces[t, 1], faces[t, 2]
        for i in range(3):
            e[i], f[i] = at[b, i] - at[a, i], at[c, i] - at[a, i]
        for k in range(3):
            p = corner_pair[t, k]
            if p >= 0:
                side = 0 if faces[t, k] == pairs[p, 0] else 1
                for i in range(3):
                    j, m = (i + 1) % 3, (i + 2) % 3
                    sides[side, p, i] += e[j] * f[m] - e[m] * f[j]


@njit(cache=True, nogil=True)
def add_carried(at, cells, side_of, carried, sides):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add to the outward normals (2, p, 3) of pairs what cells carry of them; `side_of` has twice the pair, and one more of the second."""
    for c in range(len(cells)):
        p, side, o = side_of[c] // 2, side_of[c] % 2, cells[c, 0]
        for k in range(3):
            a, b = cells[c, 1 + (k + 1) % 3], cells[c, 1 + (k + 2) % 3]
            for i in range(3):
                j, m = (i + 1) % 3, (i + 2) % 3
                area = (at[a, j] - at[o, j]) * (at[b, m] - at[o, m]) - (at[a, m] - at[o, m]) * (at[b, j] - at[o, j])
                sides[side, p, i] += carried[c, k] * area


@njit(cache=True, nogil=True)
def gaps_and_normals(at, pairs, edge, sides):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Gaps (p,) and unit normals (p, 3), from the first side to the second, of pairs with outward normals (2, p, 3)."""
    gap, normal = np.full(len(pairs), np.inf), np.zeros((len(pairs), 3))
    for p in range(len(pairs)):
        facing, size = 0.0, 0.0
        for i in range(3):
            facing += sides[0, p, i] * sides[1, p, i]
            normal[p, i] = sides[0, p, i] - sides[1, p, i]
            size += normal[p, i] ** 2
        if facing >= 0.0 or size == 0.0:
            continue
        size = np.sqrt(size)
        along, whole = 0.0, 0.0
        for i in range(3):
            normal[p, i] /= size
            d = at[pairs[p, 1], i] - at[pairs[p, 0], i]
            along += normal[p, i] * d
            whole += d * d
        if whole - along * along <= (FURTHEST * edge[p]) ** 2:
            gap[p] = along
    return gap, normal


@njit(cache=True, nogil=True)
def add_pressure(gap, normal, pairs, area, edge, stiffness, force, blocks):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the internal forces of pairs that overlap, and their stiffness; returns the energy."""
    energy = 0.0
    for p in range(len(pairs)):
        g = gap[p]
        if g >= 0.0:
            continue
        k, ramp = stiffness[p] * area[p], RAMP * edge[p]
        if g > -ramp:
            pressing, slope = 0.5 * k * g * g / ramp, -k * g / ramp
            energy -= k * g * g * g / (6.0 * ramp)
        else:
            pressing, slope = -k * (g + 0.5 * ramp), k
            energy += 0.5 * k * (g * g + g * ramp) + k * ramp * ramp / 6.0
        for i in range(3):
            force[pairs[p, 0], i] += pressing * normal[p, i]
            force[pairs[p, 1], i] -= pressing * normal[p, i]
            for j in range(3):
                blocks[p, i, j] += slope * normal[p, i] * normal[p, j]
    return energy


@njit(cache=True, nogil=True)
def pair_forces(relative, anchors, normals, overlaps, area, edge, stiffness, mu, force, blocks):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set the internal forces (p, 3) of pairs on their first nodes and their stiffnesses (p, 3, 3).

    That of friction is its secant along the slip and its growth with the pressure. Without this growth, iterations diverge where many pairs
    slide whose normals differ, as on the facets of an oblique cut: approach of one side changes the force along the other.
    It is what `CutLips.add` finds of pairs that have been given normals, from the positions of the second nodes relative to the first
    (p, 3), mm, without arrays in between: it is called many times in a step.
    """
    count = len(relative)
    gap, pressing, slope, tangential = np.full(count, np.inf), np.zeros(count), np.zeros(count), np.empty(count)
    own, both, shift = np.empty((count, 2), np.int64), np.zeros((2 * count, 3)), np.empty((count, 3))
    blocks[:] = 0.0
    for p in range(count):
        own[p, 0], own[p, 1] = 2 * p, 2 * p + 1
        g, faces = -overlaps[p], False
        for i in range(3):
            g += normals[p, i] * relative[p, i]
            faces = faces or normals[p, i] != 0.0
            shift[p, i] = relative[p, i] - anchors[p, i]
        k, ramp = stiffness[p] * area[p], RAMP * edge[p]
        tangential[p] = TANGENTIAL * k
        if not faces:
            continue
        gap[p], closed = g, min(g, 0.0)
        pressing[p] = 0.5 * k * closed * closed / ramp if closed > -ramp else -k * (closed + 0.5 * ramp)
        slope[p] = -g / ramp * k if g > -ramp else k
    add_pressure(gap, normals, own, area, edge, stiffness, both, blocks)
    if mu > 0.0:
        add_friction(pressing, slope, normals, own, shift, tangential, mu, True, True, both, blocks, np.zeros((count, 3)))
    for p in range(count):
        for i in range(3):
            force[p, i] = both[2 * p, i]


@njit(cache=True, nogil=True)
def add_friction(  # type: ignore[no-untyped-def]  # pragma: no cover
    pressing, slope, normal, pairs, shift, tangential, mu, secant, growing, force, blocks, traction
):
    """Add the friction of closed pairs and its stiffness; returns the energy of elastic slip.

    The stiffness is the derivative, or the secant along the slip; with or without the growth of friction with pressure, which is
    unsymmetric.
    """
    energy = 0.0
    e = np.empty(3)
    for p in range(len(pairs)):
        limit = mu * pressing[p]
        if limit <= 0.0:
            continue
        along = 0.0
        for i in range(3):
            along += normal[p, i] * shift[p, i]
        size = 0.0
        for i in range(3):
            e[i] = tangential[p] * (shift[p, i] - along * normal[p, i])
            size += e[i] * e[i]
        size = np.sqrt(size)
        slides = size > limit
        ratio = limit / size if slides else 1.0
        energy += 0.5 * (ratio * size) ** 2 / tangential[p]
        for i in range(3):
            traction[p, i] = ratio * e[i]
            force[pairs[p, 0], i] -= ratio * e[i]
            force[pairs[p, 1], i] += ratio * e[i]
            for j in range(3):
                held = ratio * tangential[p] * ((1.0 if i == j else 0.0) - normal[p, i] * normal[p, j])
                if slides and not secant:
                    held -= ratio * tangential[p] * e[i] * e[j] / size**2
                if slides and growing:
                    held -= mu * slope[p] * e[i] * normal[p, j] / size
                blocks[p, i, j] += held
    return energy
