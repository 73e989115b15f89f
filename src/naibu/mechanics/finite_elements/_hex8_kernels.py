"""Numba kernels for hexahedra with mean dilatation, of laws that depend on the invariants I1 and J alone.

Their stresses and tangents are combinations of F and F^-T. Contracted with the gradients g of the shape functions, they need the vectors
``f = F g`` and ``h = F^-T g`` of every node and integration point only, and the stiffness is a product of small matrices. The formulation,
and that of other laws, is that of `assembly`.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from naibu._numba.compilation import njit
from naibu.core.arrays import IntArray
from naibu.mechanics.finite_elements.elements import Elements
from naibu.mechanics.finite_elements.hyperelasticity import OF_FIRST_INVARIANT, invariant_derivatives, inverse_transpose

CHUNK = 64
F_FORCE, G_FORCE, FF, FG, GG, CROSSED, IDENTITY, F_COUPLING, G_COUPLING, RATIO = range(10)  # of the coefficients of a point


def are_hexahedra_of_first_invariant(elements: Elements, law_codes: IntArray) -> bool:
    """Tell whether all groups are hexahedra with averaged dilatation, and all laws (m,) are of I1 and J alone."""
    eights = elements.shared_dilatation and elements.gradients.shape[1:3] == (8, 8)
    return eights and bool(np.isin(law_codes, OF_FIRST_INVARIANT).all())


def _assemble(  # type: ignore[no-untyped-def]  # pragma: no cover
    order, colour_start, connectivity, gradients, weights, cells, codes, parameters, u, positions, force, blocks
):
    """Add the forces, and the tangent if there are `blocks`; return the energy and the smallest det F. Colours as in `assembly`."""
    energy, smallest = 0.0, np.inf
    for colour in range(len(colour_start) - 1):
        start, stop = colour_start[colour], colour_start[colour + 1]
        n_chunks = (stop - start + CHUNK - 1) // CHUNK
        energies = np.zeros(n_chunks)
        determinants = np.full(n_chunks, np.inf)
        for chunk in prange(n_chunks):
            f, g, det = np.empty((8, 3, 3)), np.empty((8, 3, 3)), np.empty(8)
            c, d, products, k_local = np.empty((8, 10)), np.empty(9), np.empty((5, 8, 24)), np.empty((24, 24))
            crossed, alike, t, m = np.empty((24, 24)), np.empty((8, 8)), np.empty(24), np.empty(24)
            for at in range(start + chunk * CHUNK, min(stop, start + (chunk + 1) * CHUNK)):
                e = order[at]
                lowest = _deformation(connectivity[e], gradients[e], u, f, g, det)
                determinants[chunk] = min(determinants[chunk], lowest)
                if lowest > 0.0:
                    found, kappa = _coefficients(cells[e], codes, parameters, weights[e], f, det, d, c)
                    energies[chunk] += found
                    _add_forces(connectivity[e], gradients[e], f, g, c, force)
                    if len(blocks) > 0:
                        _stiffness(gradients[e], f, g, c, kappa, products, crossed, alike, t, m, k_local)
                        _scatter(positions[e], k_local, crossed, alike, blocks)
        for chunk in range(n_chunks):
            energy += energies[chunk]
            smallest = min(smallest, determinants[chunk])
    return energy, smallest


assemble_small = njit(cache=True, nogil=True)(_assemble)
assemble_large = njit(cache=True, parallel=True)(_assemble)


@njit(cache=True, fastmath={"contract"})
def _deformation(nodes, gradients, u, f, g, det):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Deformation gradients f, their inverse transposes g and determinants at the points; returns the smallest determinant."""
    lowest = np.inf
    for q in range(8):
        for i in range(3):
            x, y, z = 0.0, 0.0, 0.0
            for a in range(8):
                v = u[nodes[a], i]
                x += v * gradients[q, a, 0]
                y += v * gradients[q, a, 1]
                z += v * gradients[q, a, 2]
            f[q, i, 0], f[q, i, 1], f[q, i, 2] = x, y, z
            f[q, i, i] += 1.0
        det[q] = inverse_transpose(f[q], g[q])
        lowest = min(lowest, det[q])
    return lowest


@njit(cache=True, fastmath={"contract"})
def _coefficients(cells, codes, parameters, weights, f, det, d, c):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set the coefficients c (8, 10) of F, F^-T and their products at the points; returns energy and curvature by dilatation.

    With Fbar = c F and the stress Pbar = s1 Fbar + s2 Fbar^-T. See `assembly` for the variations of the mean dilatation theta.
    """
    theta, volume = 0.0, 0.0
    for q in range(8):
        theta += weights[q] * det[q]
        volume += weights[q]
    theta /= volume
    energy, total, kappa = 0.0, 0.0, 0.0
    for q in range(8):
        squares = 0.0
        for i in range(3):
            for j in range(3):
                squares += f[q, i, j] * f[q, i, j]
        w, c2 = weights[q], (theta / det[q]) ** (2.0 / 3.0)
        energy += w * invariant_derivatives(codes[cells[q]], parameters[cells[q]], c2 * squares, 0.0, theta, d)
        s1, s2, mixed, ww = 2.0 * d[0], d[2] * theta, 2.0 * d[6] * theta, d[8] * theta * theta + d[2] * theta
        trace = w * (s1 * c2 * squares / 3.0 + s2)
        total += trace
        left_f = 4.0 * d[3] * c2 * squares + 3.0 * mixed + s1
        left_g = mixed * squares + (3.0 * ww - s2) / c2
        twice = w * c2 * (left_f * squares + 3.0 * left_g) / 9.0 + trace / 3.0
        c[q, F_FORCE], c[q, G_FORCE] = w * c2 * s1, w * s2 - trace
        c[q, FF] = 4.0 * w * c2 * c2 * d[3]
        c[q, FG] = w * c2 * (mixed - left_f / 3.0 - s1 / 3.0)
        c[q, GG] = w * (ww - 2.0 / 3.0 * c2 * left_g - 2.0 / 3.0 * s2) + twice
        c[q, CROSSED] = trace - w * s2
        c[q, IDENTITY] = w * c2 * s1
        c[q, F_COUPLING] = w * c2 * (left_f + s1) / 3.0
        c[q, G_COUPLING] = w * (c2 * left_g + s2) / 3.0 - twice
        c[q, RATIO] = w * det[q] / (theta * volume)
        kappa += twice - trace
    for q in range(8):
        shared = total * c[q, RATIO]
        c[q, G_FORCE] += shared
        c[q, GG] += shared
        c[q, CROSSED] -= shared
    return energy, kappa


@njit(cache=True, fastmath={"contract"})
def _add_forces(nodes, gradients, f, g, c, force):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the nodal forces: combinations of F and F^-T, contracted with the gradients."""
    for q in range(8):
        a, b = c[q, F_FORCE], c[q, G_FORCE]
        for i in range(3):
            p0, p1, p2 = a * f[q, i, 0] + b * g[q, i, 0], a * f[q, i, 1] + b * g[q, i, 1], a * f[q, i, 2] + b * g[q, i, 2]
            for n in range(8):
                force[nodes[n], i] += p0 * gradients[q, n, 0] + p1 * gradients[q, n, 1] + p2 * gradients[q, n, 2]


@njit(cache=True, fastmath={"contract"})
def _stiffness(gradients, f, g, c, kappa, products, crossed, alike, t, m, k_local):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set the parts of the stiffness of nodes a, b, directions i, k: in `k_local`, of (a, k), (b, i) in `crossed`, of a, b in `alike`."""
    fg, gg, by_f, by_g, by_c = products[0], products[1], products[2], products[3], products[4]
    t[:] = 0.0
    m[:] = 0.0
    for q in range(8):
        for a in range(8):
            x, y, z = gradients[q, a, 0], gradients[q, a, 1], gradients[q, a, 2]
            for i in range(3):
                fg[q, 3 * a + i] = f[q, i, 0] * x + f[q, i, 1] * y + f[q, i, 2] * z
                gg[q, 3 * a + i] = g[q, i, 0] * x + g[q, i, 1] * y + g[q, i, 2] * z
        c_ff, c_fg, c_gg, c_crossed, c_f, c_g, ratio = (
            c[q, FF], c[q, FG], c[q, GG], c[q, CROSSED], c[q, F_COUPLING], c[q, G_COUPLING], c[q, RATIO],
        )  # fmt: skip
        for r in range(24):
            v, w = fg[q, r], gg[q, r]
            by_f[q, r] = c_ff * v + c_fg * w
            by_g[q, r] = c_fg * v + c_gg * w
            by_c[q, r] = c_crossed * w
            t[r] += ratio * w
            m[r] += c_f * v + c_g * w
    for r in range(24):
        tr, mr = t[r], m[r] + kappa * t[r]
        for s in range(24):
            k_local[r, s] = mr * t[s] + tr * m[s]
            crossed[r, s] = 0.0
        for q in range(8):
            v, w, x = by_f[q, r], by_g[q, r], by_c[q, r]
            for s in range(24):
                k_local[r, s] += v * fg[q, s] + w * gg[q, s]
                crossed[r, s] += x * gg[q, s]
    alike[:] = 0.0
    for q in range(8):
        w = c[q, IDENTITY]
        for a in range(8):
            x, y, z = w * gradients[q, a, 0], w * gradients[q, a, 1], w * gradients[q, a, 2]
            for b in range(8):
                alike[a, b] += x * gradients[q, b, 0] + y * gradients[q, b, 1] + z * gradients[q, b, 2]


@njit(cache=True)
def _scatter(positions, k_local, crossed, alike, blocks):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the parts of the stiffness of an element to its blocks."""
    for a in range(8):
        for b in range(8):
            block = blocks[positions[a, b]]
            for i in range(3):
                for k in range(3):
                    block[i, k] += k_local[3 * a + i, 3 * b + k] + crossed[3 * a + k, 3 * b + i]
                block[i, i] += alike[a, b]
