"""Linear-implicit steps :cite:p:`baraff1998` of a lattice, stable for every K, C1, C2, step length and solver tolerance.

With f the mean tension of an element while its length changes evenly (`implicit_coefficients`), the velocity after a step solves
``A v1 = M v0 - h G^T (b y0) + h f_ext``, ``A = M + h^2 G^T a G``. Were it solved exactly and lengths linear in the step, kinetic energy and
``sum K y^2 / 2`` could not grow by more than the work of what moves the lattice. Three things keep that true as the code runs:

- conjugate gradients stop early with a residual r; then the energy is raised by at most -v1 . r. Where this is positive, the part of v1
  that deforms is scaled so that v1 . r = 0;
- the free body's momenta are restored where the residual holds any;
- the extension follows the true length, which a rotation makes longer by the square of its angle. What that adds may not exceed what the
  step dissipates; if it would, the extension takes up a part of it, and the rest later, when there is more: nothing drifts.
"""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import njit
from naibu._numba.simd import WIDTH, inverse_root, load, single, splat, store, total
from naibu.mechanics.lattices.cpu._coarse_kernels import begin_with, follow
from naibu.mechanics.lattices.cpu._contact_operator import FACES, add_contact
from naibu.mechanics.lattices.cpu._pcg_kernels import dot, multiply, project, residual_norm, solve

_FAST = {"contract", "nsz"}


@njit(cache=True, fastmath=_FAST)
def prepare(first, second, rows, tables, x, y, v, axes, rough, r, step):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Store the directions of all elements (3, 8 nb), once more in single precision, and add to r what they exert at the new velocity v.

    Returns the sum of the squares of the impulses of their extensions.
    """
    pad = len(x) // 3
    tb, stiff = tables[1], tables[5]
    e0, e1, e2 = axes[0], axes[1], axes[2]
    g0, g1, g2 = rough[0], rough[1], rough[2]
    x0, x1, x2, v0, v1, v2 = x[:pad], x[pad : 2 * pad], x[2 * pad :], v[:pad], v[pad : 2 * pad], v[2 * pad :]
    f0, f1, f2 = r[:pad], r[pad : 2 * pad], r[2 * pad :]
    zero, dt = splat(x.dtype.type(0)), splat(step)
    strength = zero
    b, end = 0, len(first)
    while b < end:
        i = first[b]
        xi, yi, zi, ui, vi, wi = load(x0, i), load(x1, i), load(x2, i), load(v0, i), load(v1, i), load(v2, i)
        fx, fy, fz = zero, zero, zero
        while b < end and first[b] == i:
            j, at = second[b], WIDTH * b
            dx, dy, dz = load(x0, j) - xi, load(x1, j) - yi, load(x2, j) - zi
            inverse = inverse_root(dx * dx + dy * dy + dz * dz)
            dx, dy, dz = dx * inverse, dy * inverse, dz * inverse
            store(e0, at, dx)
            store(e1, at, dy)
            store(e2, at, dz)
            store(g0, at, single(dx))
            store(g1, at, single(dy))
            store(g2, at, single(dz))
            impulse = dt * (load(tb, rows[b]) * load(y, at))
            strength = strength + impulse * impulse
            change = (load(v0, j) - ui) * dx + (load(v1, j) - vi) * dy + (load(v2, j) - wi) * dz
            impulse = impulse + load(stiff, rows[b]) * change
            dx, dy, dz = dx * impulse, dy * impulse, dz * impulse
            fx, fy, fz = fx + dx, fy + dy, fz + dz
            store(f0, j, load(f0, j) - dx)
            store(f1, j, load(f1, j) - dy)
            store(f2, j, load(f2, j) - dz)
            b += 1
        store(f0, i, load(f0, i) + fx)
        store(f1, i, load(f1, i) + fy)
        store(f2, i, load(f2, i) + fz)
    return float(total(strength))


@njit(cache=True)
def rigid_part(x, mass, impulse, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set `out` to the rigid motion that has the momenta of an impulse (3 pad,)."""
    pad = len(mass)
    centre, p, spin, inertia = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros((3, 3))
    weight = 0.0
    for i in range(pad):
        weight += mass[i]
        for a in range(3):
            centre[a] += mass[i] * x[a * pad + i]
            p[a] += impulse[a * pad + i]
    centre /= weight
    for i in range(pad):
        if mass[i] > 0.0:
            d0, d1, d2 = x[i] - centre[0], x[pad + i] - centre[1], x[2 * pad + i] - centre[2]
            f0, f1, f2 = impulse[i], impulse[pad + i], impulse[2 * pad + i]
            spin[0] += d1 * f2 - d2 * f1
            spin[1] += d2 * f0 - d0 * f2
            spin[2] += d0 * f1 - d1 * f0
            inertia[0, 0] += mass[i] * (d1 * d1 + d2 * d2)
            inertia[1, 1] += mass[i] * (d0 * d0 + d2 * d2)
            inertia[2, 2] += mass[i] * (d0 * d0 + d1 * d1)
            inertia[0, 1] -= mass[i] * d0 * d1
            inertia[0, 2] -= mass[i] * d0 * d2
            inertia[1, 2] -= mass[i] * d1 * d2
    inertia[1, 0], inertia[2, 0], inertia[2, 1] = inertia[0, 1], inertia[0, 2], inertia[1, 2]
    values, vectors = np.linalg.eigh(inertia)
    w = np.zeros(3)
    for k in range(3):
        if values[k] > 1e-12 * values[2]:  # nodes in a line do not turn about it
            w += (vectors[:, k] * spin).sum() / values[k] * vectors[:, k]
    for i in range(pad):
        d0, d1, d2 = x[i] - centre[0], x[pad + i] - centre[1], x[2 * pad + i] - centre[2]
        alive = 1.0 if mass[i] > 0.0 else 0.0
        out[i] = alive * (p[0] / weight + w[1] * d2 - w[2] * d1)
        out[pad + i] = alive * (p[1] / weight + w[2] * d0 - w[0] * d2)
        out[2 * pad + i] = alive * (p[2] / weight + w[0] * d1 - w[1] * d0)


@njit(cache=True, fastmath=_FAST)
def settle(first, second, rows, stiff, axes, mass, touched, constrained, x, v, r, p, q):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Make v1 . r of free components not negative, so that the early end of the solver raises no energy; keep a free body's momenta.

    Returns the v1 . r that is left.
    """
    pad = len(mass)
    free = len(constrained[0]) == 0 and touched[5][FACES] == 0
    if free:
        rigid_part(x, mass, r, p)
        for i in range(len(v)):
            v[i] += p[i]
            r[i] -= mass[i % pad] * p[i]
    for i in range(len(v)):
        p[i] = v[i]
    project(constrained, p, pad)
    lost = dot(p, r)
    if lost >= 0.0:
        return lost
    if free:
        for i in range(len(v)):
            p[i] = mass[i % pad] * v[i]
        rigid_part(x, mass, p, q)
        for i in range(len(v)):
            p[i] = v[i] - q[i]
    curvature = multiply(first, second, rows, stiff, axes, mass, p, q)
    curvature += add_contact(touched[0], touched[1], touched[5][FACES], 1.0, p, q)
    fraction = dot(p, r) / curvature if curvature > 0.0 else 0.0
    for i in range(len(v)):
        v[i] += fraction * p[i]
        r[i] -= fraction * q[i]
    return 0.0


@njit(cache=True, fastmath=_FAST)
def extend(first, second, rows, tables, axes, lengths, x, v, y, step):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Move on extensions y and the lengths they know of after the nodes moved to x with the velocity v.

    Leaves in axes[1] what the rotation of elements added to the lengths, and in axes[0] what that added to the extensions.
    Returns the energy that
    the elements dissipated, and the linear and the square part of the energy that the addition stored.
    """
    pad = len(x) // 3
    ta, tb, te, tg, tk = tables
    e0, e1, e2 = axes[0], axes[1], axes[2]
    x0, x1, x2, v0, v1, v2 = x[:pad], x[pad : 2 * pad], x[2 * pad :], v[:pad], v[pad : 2 * pad], v[2 * pad :]
    zero, half, dt = splat(x.dtype.type(0)), splat(x.dtype.type(0.5)), splat(step)
    dissipated, linear, square = zero, zero, zero
    b, end = 0, len(first)
    while b < end:
        i = first[b]
        xi, yi, zi, ui, vi, wi = load(x0, i), load(x1, i), load(x2, i), load(v0, i), load(v1, i), load(v2, i)
        while b < end and first[b] == i:
            j, r, at = second[b], rows[b], WIDTH * b
            dx, dy, dz = load(x0, j) - xi, load(x1, j) - yi, load(x2, j) - zi
            distance = dx * dx + dy * dy + dz * dz
            change = (load(v0, j) - ui) * load(e0, at) + (load(v1, j) - vi) * load(e1, at)
            change = dt * (change + (load(v2, j) - wi) * load(e2, at))
            old, k = load(y, at), load(tk, r)
            new = load(te, r) * old + load(tg, r) * change
            length = distance * inverse_root(distance)
            turned = length - load(lengths, at) - change
            added = load(tg, r) * turned
            store(lengths, at, length)
            dissipated = dissipated + (load(ta, r) * change + load(tb, r) * old) * change - half * (k * (new * new - old * old))
            linear = linear + k * (new * added)
            square = square + half * (k * (added * added))
            store(y, at, new + added)
            store(e0, at, added)
            store(e1, at, turned)
            b += 1
    return float(total(dissipated)), float(total(linear)), float(total(square))


@njit(cache=True, fastmath=_FAST)
def constrain(constrained, v, pad):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Give constrained components of v (3 pad,) their speeds."""
    node, direction, speed = constrained[0], constrained[1], constrained[2]
    for h in range(len(node)):
        i = node[h]
        lack = speed[h]
        for a in range(3):
            lack -= direction[h, a] * v[a * pad + i]
        for a in range(3):
            v[a * pad + i] += lack * direction[h, a]


@njit(cache=True, fastmath=_FAST)
def add_momenta(mass, v, sign, right):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the momenta of v, times a sign, to `right`."""
    pad = len(mass)
    factor = splat(sign)
    for axis in range(3):
        va, ra = v[axis * pad : (axis + 1) * pad], right[axis * pad : (axis + 1) * pad]
        for i in range(0, pad, WIDTH):
            store(ra, i, load(ra, i) + factor * (load(mass, i) * load(va, i)))


@njit(cache=True, fastmath=_FAST)
def _first_residual(blocks, tables, x, v, y, mass, right, work, inner, constrained, step):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Constrain v and set r to its residual; return the square of the norm below which rounding rules."""
    first, second, rows = blocks
    axes, r = work[0], work[1]
    constrain(constrained, v, len(mass))
    follow(inner[8], inner[3], constrained, False)
    r[:] = right
    add_momenta(mass, v, -1.0, r)
    add_contact(inner[9][0], inner[9][1], inner[9][5][FACES], -1.0, v, r)
    return prepare(first, second, rows, tables, x, y, v, axes, inner[1], r, step) * 1e-20 / mass.max()


@njit(cache=True, fastmath=_FAST)
def new_velocity(blocks, tables, x, v, y, mass, right, work, inner, constrained, step, solver):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Improve v to the velocity after a step, `right` being the momenta with the impulses of external forces before.

    `tables` are a, b, E, g, K and h^2 a; `work` the arrays axes (3, 8 nb) and r, p, q (3 pad,); `inner` those of `conjugate_gradients`;
    `constrained` node, direction (h, 3), speed and body of every constrained component; `solver` the tolerance and the most iterations.
    Leaves in r minus the impulses that hold the nodes; returns the number of iterations, the energy that the early end of the solver
    dissipates, mN mm, and the square of the residual's norm at which it ended, for `improved_velocity`.
    """
    floor = _first_residual(blocks, tables, x, v, y, mass, right, work, inner, constrained, step)
    goal = max(solver[0] ** 2 * residual_norm(work[1], inner[3], constrained), floor)
    return *improved_velocity(blocks, tables, x, v, mass, work, inner, constrained, goal, solver[1]), goal


@njit(cache=True, fastmath=_FAST)
def extrapolated_velocity(blocks, tables, x, v, ahead, y, mass, right, work, inner, constrained, step, solver):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Do what `new_velocity` does for a v to which a share of a change (3 pad,) was added; `ahead` are the two.

    The residual goes down to the same size as from the v without it, for which extrapolated motion is often nearly enough
    :cite:p:`fischer1998`. The share becomes that which leaves the least energy norm of the error; it is returned last.
    """
    first, second, rows = blocks
    (axes, r, p, q), touched, (change, taken) = work, inner[9], ahead
    floor = _first_residual(blocks, tables, x, v, y, mass, right, work, inner, constrained, step)
    p[:] = change
    project(constrained, p, len(mass))
    curvature = multiply(first, second, rows, tables[5], axes, mass, p, q)
    curvature += add_contact(touched[0], touched[1], touched[5][FACES], 1.0, p, q)
    for i in range(len(r)):
        r[i] += taken * q[i]
    goal = max(solver[0] ** 2 * residual_norm(r, inner[3], constrained), floor)
    share = dot(p, r) / curvature if curvature > 0.0 else 0.0
    for i in range(len(r)):
        v[i] += (share - taken) * p[i]
        r[i] -= share * q[i]
    return *improved_velocity(blocks, tables, x, v, mass, work, inner, constrained, goal, solver[1]), goal, share


@njit(cache=True, fastmath=_FAST)
def improved_velocity(blocks, tables, x, v, mass, work, inner, constrained, goal, limit):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Improve v, whose residual is r, until the square of the residual's norm is below `goal`; see `new_velocity`."""
    first, second, rows = blocks
    axes, r, p, q = work
    count = solve(first, second, rows, tables[5], axes, mass, v, r, p, q, inner, constrained, goal, limit)
    return count, settle(first, second, rows, tables[5], axes, mass, inner[9], constrained, x, v, r, p, q)


@njit(cache=True, fastmath=_FAST)
def add_reactions(constrained, r, pad, step, reaction):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add to `reaction` (bodies, 3) the forces, mN, by which bodies constrain nodes, from the residual r of a step."""
    node, direction, _, body = constrained
    for h in range(len(node)):
        i = node[h]
        along = (direction[h, 0] * r[i] + direction[h, 1] * r[pad + i] + direction[h, 2] * r[2 * pad + i]) / step
        for a in range(3):
            reaction[body[h], a] -= along * direction[h, a]


@njit(cache=True, fastmath=_FAST)
def advance(blocks, tables, x, v, before, y, lengths, mass, axes, step, lost):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Move nodes, extensions and the lengths these know of on by the new velocity v; `before` is the old one.

    Returns whether rotation had to be limited; then the lengths lag behind, and the next steps catch up.
    """
    first, second, rows = blocks
    pad = len(mass)
    dt = splat(step)
    for i in range(0, len(x), WIDTH):
        store(x, i, load(x, i) + dt * load(v, i))
    dissipated, linear, square = extend(first, second, rows, tables[:5], axes, lengths, x, v, y, step)
    slowed, half = splat(0.0), splat(0.5)
    for axis in range(3):
        old, new = before[axis * pad : (axis + 1) * pad], v[axis * pad : (axis + 1) * pad]
        for i in range(0, pad, WIDTH):
            change = load(old, i) - load(new, i)
            slowed = slowed + half * (load(mass, i) * (change * change))
    dissipated += float(total(slowed))
    dissipated = max(dissipated + lost, 0.0)
    if linear + square <= dissipated:
        return False
    root = np.sqrt(linear * linear + 4.0 * square * dissipated)  # share s of the addition: linear s + square s^2 = dissipated
    fraction = 2.0 * dissipated / (linear + root) if linear + root > 0.0 else 0.0
    left = splat(y.dtype.type(1.0 - fraction))
    e0, e1 = axes[0], axes[1]
    for i in range(0, len(y), WIDTH):
        store(y, i, load(y, i) - left * load(e0, i))
        store(lengths, i, load(lengths, i) - left * load(e1, i))
    return True


@njit(cache=True, fastmath=_FAST, nogil=True)
def implicit_steps(blocks, tables, state, mass, external, work, inner, constrained, velocity, step, solver, reaction):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Take len(velocity) steps with constant external forces (3 pad,), mN, or none.

    The state x, v, y and lengths is changed, reaction (steps, bodies, 3), zero before, is filled.

    `constrained` are node, direction, weight and body of constrained components, which move by their weights times the velocity (steps,
    bodies, 3) of their bodies. Returns the number of iterations, and in how many steps rotation had to be limited.
    """
    x, v, y, lengths = state
    iterations, checked = 0, 0
    right, before = np.zeros_like(x), np.zeros_like(x)
    node, direction, weight, body = constrained
    speed = np.zeros(len(node))
    now = (node, direction, speed, body)
    begin_with(inner, now)
    for n in range(len(velocity)):
        for i in range(len(v)):
            before[i] = v[i]
            right[i] = step * external[i] if len(external) else 0.0
        for h in range(len(node)):
            speed[h] = 0.0
            for a in range(3):
                speed[h] += weight[h] * direction[h, a] * velocity[n, body[h], a]
        add_momenta(mass, v, 1.0, right)
        count, lost, _ = new_velocity(blocks, tables, x, v, y, mass, right, work, inner, now, step, solver)
        add_reactions(now, work[1], len(mass), step, reaction[n])
        checked += advance(blocks, tables, x, v, before, y, lengths, mass, work[0], step, lost)
        iterations += count
    return iterations, checked
