"""Kernels of finite elements whose mean dilatations have pressures of their own; see `pressure_elements` for the formulation."""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import njit
from naibu.mechanics.finite_elements.hyperelasticity import NEO_HOOKEAN, inverse_transpose, stress_and_tangent


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc"})
def forces_with_pressures(  # type: ignore[no-untyped-def]  # pragma: no cover
    start, connectivity, local, gradients, weights, cells, codes, parameters, bulk, u, pressure, force, mismatch
):
    """Add the nodal forces to `force` (n, 3), and put ``bulk log(theta) - pressure`` into `mismatch` (m,); returns the smallest det F."""
    most, kk = 0, local.shape[1]
    for e in range(len(start) - 1):
        most = max(most, start[e + 1] - start[e])
    f, g, stress = np.empty((most, 3, 3)), np.empty((most, 3, 3)), np.empty((most, 3, 3))
    det, s, x = np.empty(most), np.empty(most), np.empty((3, kk))
    fbar, gbar, c, d, none = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty(9), np.empty((0, 0))
    smallest = np.inf
    for e in range(len(start) - 1):
        nodes, first, count = connectivity[e], start[e], start[e + 1] - start[e]
        theta, volume = 0.0, 0.0
        for q in range(count):
            _gather(nodes, local[first + q], u, x)
            det[q] = _gradient(gradients[first + q], x, f[q], g[q])
            smallest = min(smallest, det[q])
            theta += weights[first + q] * det[q]
            volume += weights[first + q]
        if not smallest > 0.0:
            return smallest
        theta /= volume
        log_theta = np.log(theta)
        mismatch[e] = bulk[e] * log_theta - pressure[e]
        total = 0.0
        for q in range(count):
            scale, w, cell = np.cbrt(theta / det[q]), weights[first + q], cells[first + q]
            if codes[cell] == NEO_HOOKEAN:  # P = mu F + (lambda log(theta) - mu) F^-T, without another logarithm
                s[q] = w * _neo_hookean(parameters[cell, 0], parameters[cell, 1], log_theta, scale, w, f[q], g[q], stress[q])
                total += s[q]
                continue
            for i in range(3):
                for j in range(3):
                    fbar[i, j] = scale * f[q, i, j]
                    gbar[i, j] = g[q, i, j] / scale
            stress_and_tangent(codes[cell], parameters[cell], fbar, gbar, theta, d, c, stress[q], none, False)
            s[q] = 0.0
            for i in range(3):
                for j in range(3):
                    stress[q, i, j] *= w * scale
                    s[q] += stress[q, i, j] * f[q, i, j] / 3.0
            total += s[q]
        for q in range(count):
            extra = (total / volume - mismatch[e]) * weights[first + q] * det[q] / theta - s[q]
            _scatter(nodes, local[first + q], gradients[first + q], stress[q], extra, g[q], x, force)
    return smallest


@njit(cache=True, nogil=True, error_model="numpy")
def dilatation_derivatives(start, connectivity, local, gradients, weights, u, log_theta, derivative):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Put log(theta) of all groups and its derivatives (m, k, 3) by the positions of their nodes, times the volume, in place."""
    kk = local.shape[1]
    f, g, x = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, kk))
    derivative[:] = 0.0
    for e in range(len(start) - 1):
        theta, volume = 0.0, 0.0
        for at in range(start[e], start[e + 1]):
            _gather(connectivity[e], local[at], u, x)
            det = _gradient(gradients[at], x, f, g)
            theta += weights[at] * det
            volume += weights[at]
            for a in range(kk):
                for i in range(3):
                    v = g[i, 0] * gradients[at, 0, a] + g[i, 1] * gradients[at, 1, a] + g[i, 2] * gradients[at, 2, a]
                    derivative[e, local[at, a], i] += weights[at] * det * v
        log_theta[e] = np.log(theta / volume)
        for a in range(connectivity.shape[1]):
            for i in range(3):
                derivative[e, a, i] *= volume / theta


@njit(cache=True, nogil=True)
def add_group_forces(connectivity, derivative, amount, force):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add ``amount[e] derivative[e]`` of all groups e to the forces (n, 3)."""
    for e in range(len(connectivity)):
        for a in range(connectivity.shape[1]):
            for i in range(3):
                force[connectivity[e, a], i] += amount[e] * derivative[e, a, i]


@njit(cache=True, nogil=True)
def along_group_derivatives(connectivity, derivative, step, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Put the products of the derivatives of all groups with a change of the positions (n, 3) into `out` (m,)."""
    for e in range(len(connectivity)):
        v = 0.0
        for a in range(connectivity.shape[1]):
            for i in range(3):
                v += derivative[e, a, i] * step[connectivity[e, a], i]
        out[e] = v


@njit(cache=True, inline="always", fastmath={"contract", "reassoc"})
def _neo_hookean(mu, lame_lambda, log_theta, scale, weight, f, g, stress):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Put the stress of ``scale f``, times scale and weight, in place; returns a third of its product with f, by weight."""
    a, b, norm = mu * scale * scale, lame_lambda * log_theta - mu, 0.0
    for i in range(3):
        for j in range(3):
            stress[i, j] = weight * (a * f[i, j] + b * g[i, j])
            norm += f[i, j] * f[i, j]
    return a * norm / 3.0 + b


@njit(cache=True, inline="always")
def _gather(nodes, local, u, x):  # type: ignore[no-untyped-def]  # pragma: no cover
    for a in range(len(local)):
        node = nodes[local[a]]
        x[0, a], x[1, a], x[2, a] = u[node, 0], u[node, 1], u[node, 2]


@njit(cache=True, inline="always", fastmath=True)
def _gradient(gradients, x, f, g):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Put F and F^-T of a point in place; returns det F."""
    for i in range(3):
        v0, v1, v2 = 0.0, 0.0, 0.0
        for a in range(x.shape[1]):
            v0 += x[i, a] * gradients[0, a]
            v1 += x[i, a] * gradients[1, a]
            v2 += x[i, a] * gradients[2, a]
        f[i, 0], f[i, 1], f[i, 2] = v0, v1, v2
        f[i, i] += 1.0
    return inverse_transpose(f, g)


@njit(cache=True, inline="always", fastmath=True)
def _scatter(nodes, local, gradients, stress, extra, g, x, force):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the forces of a point to its nodes; `x` is scratch."""
    for i in range(3):
        p0, p1, p2 = stress[i, 0] + extra * g[i, 0], stress[i, 1] + extra * g[i, 1], stress[i, 2] + extra * g[i, 2]
        for a in range(x.shape[1]):
            x[i, a] = p0 * gradients[0, a] + p1 * gradients[1, a] + p2 * gradients[2, a]
    for a in range(len(local)):
        node = nodes[local[a]]
        force[node, 0] += x[0, a]
        force[node, 1] += x[1, a]
        force[node, 2] += x[2, a]
