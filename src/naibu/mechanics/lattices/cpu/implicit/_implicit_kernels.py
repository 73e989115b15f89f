"""Linear-implicit steps :cite:p:`baraff1998` of a lattice, stable for every K, C1, C2, step length and solver tolerance.

With f the mean tension of an element while its length changes evenly (`implicit_coefficients`), the velocity after a step solves
``A v1 = M v0 - h G^T (b y0) + h f_ext``, ``A = M + h^2 G^T a G``. Were it solved exactly and lengths linear in the step, kinetic energy and
``sum K y^2 / 2`` could not grow by more than the work of what moves the lattice. Three things keep that true as the code runs:

- conjugate gradients stop early with a residual r; then the energy is raised by at most -v1 . r. Where this is positive, the part of v1
  that deforms is scaled so that v1 . r = 0;
- the free body's momenta are restored where the residual holds any;
- the extension follows the true length, which a rotation makes longer by the square of its angle. What that adds may not exceed what the
  step dissipates; if it would, the extension takes up a part of it, and the rest later, when there is more: nothing drifts.

What `solver` is, says `_solver_parts`, and what `data` are `_step_parts`.
"""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import UNCOUNTED, njit
from naibu._numba.intrinsics.simd import WIDTH, load, splat, store
from naibu._numba.thread_pool import begin_step, end_step
from naibu.mechanics.lattices.cpu.contact._operator import FACES, ROOM, add_contact
from naibu.mechanics.lattices.cpu.implicit._coarse_kernels import begin_with, follow
from naibu.mechanics.lattices.cpu.implicit._pcg_kernels import dot, solve
from naibu.mechanics.lattices.cpu.implicit._solver_parts import ALIGN, CHANGE, FURTHER, MULTIPLY_FULL, NORM, OPERATOR, POOL, share, summed
from naibu.mechanics.lattices.cpu.implicit._step_parts import CONSTRAIN, EXTEND, LIMIT, MOVE, PREPARE, START, share_step

_FAST = {"contract", "nsz"}
SETUP = 6  # work of a step beside its iterations, in iterations


@njit(cache=True, **UNCOUNTED)
def angular_velocity(xx, yy, zz, xy, xz, yz, s0, s1, s2):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the angular velocity of a rigid body from its inertia tensor and angular momentum about its centre, by cofactors.

    Nodes in a line may turn about it as fast as they like, and have the same inertia about all that is normal to it.
    """
    a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    d, e, f = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    normal = 0.5 * (xx + yy + zz)
    determinant = xx * a + xy * b + xz * c
    if determinant > 1e-12 * normal * normal * normal:
        return (
            (a * s0 + b * s1 + c * s2) / determinant,
            (b * s0 + d * s1 + e * s2) / determinant,
            (c * s0 + e * s1 + f * s2) / determinant,
        )
    if normal > 0.0:
        return s0 / normal, s1 / normal, s2 / normal
    return 0.0, 0.0, 0.0


@njit(cache=True, **UNCOUNTED)
def rigid_part(x, mass, impulse, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set `out` to the rigid motion that has the momenta of an impulse (3 pad,)."""
    pad = len(mass)
    weight, c0, c1, c2, p0, p1, p2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(pad):
        m = mass[i]
        weight += m
        c0, c1, c2 = c0 + m * x[i], c1 + m * x[pad + i], c2 + m * x[2 * pad + i]
        p0, p1, p2 = p0 + impulse[i], p1 + impulse[pad + i], p2 + impulse[2 * pad + i]
    c0, c1, c2 = c0 / weight, c1 / weight, c2 / weight
    s0, s1, s2, xx, yy, zz, xy, xz, yz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(pad):
        m = mass[i]
        if m > 0.0:
            d0, d1, d2 = x[i] - c0, x[pad + i] - c1, x[2 * pad + i] - c2
            f0, f1, f2 = impulse[i], impulse[pad + i], impulse[2 * pad + i]
            s0, s1, s2 = s0 + d1 * f2 - d2 * f1, s1 + d2 * f0 - d0 * f2, s2 + d0 * f1 - d1 * f0
            xx, yy, zz = xx + m * (d1 * d1 + d2 * d2), yy + m * (d0 * d0 + d2 * d2), zz + m * (d0 * d0 + d1 * d1)
            xy, xz, yz = xy - m * d0 * d1, xz - m * d0 * d2, yz - m * d1 * d2
    w0, w1, w2 = angular_velocity(xx, yy, zz, xy, xz, yz, s0, s1, s2)
    for i in range(pad):
        d0, d1, d2 = x[i] - c0, x[pad + i] - c1, x[2 * pad + i] - c2
        alive = 1.0 if mass[i] > 0.0 else 0.0
        out[i] = alive * (p0 / weight + w1 * d2 - w2 * d1)
        out[pad + i] = alive * (p1 / weight + w2 * d0 - w0 * d2)
        out[2 * pad + i] = alive * (p2 / weight + w0 * d1 - w1 * d0)


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def settle(data):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Make v1 . r of free components not negative, so that the early end of the solver raises no energy; keep a free body's momenta.

    Returns the v1 . r that is left.
    """
    solver, x = data[0], data[1][0]
    _, _, mass, v, (_, r, p, q), inner, constrained = solver
    touched, (_, parts, full, _, _, numbers) = inner[OPERATOR], inner[POOL]
    pad = len(mass)
    free = len(constrained[0]) == 0 and touched[5][FACES] == 0
    if free:
        rigid_part(x, mass, r, p)
        for i in range(len(v)):
            v[i] += p[i]
            r[i] -= mass[i % pad] * p[i]
    lost = share(solver, ALIGN, 0.0)
    if lost >= 0.0:
        return lost
    if free:
        for i in range(len(v)):
            p[i] = mass[i % pad] * v[i]
        rigid_part(x, mass, p, q)
        for i in range(len(v)):
            p[i] = v[i] - q[i]
        lost = dot(p, r)
    curvature = share(solver, MULTIPLY_FULL, 0.0)
    curvature += add_contact(touched[0], touched[1], touched[5][FACES], 1.0, p, full, parts[1], touched[ROOM])
    fraction = lost / curvature if curvature > 0.0 else 0.0
    numbers[FURTHER] = fraction
    share(solver, CHANGE, fraction)
    return 0.0


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def add_momenta(mass, v, sign, right):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the momenta of v, times a sign, to `right`."""
    pad = len(mass)
    factor = splat(sign)
    for axis in range(3):
        va, ra = v[axis * pad : (axis + 1) * pad], right[axis * pad : (axis + 1) * pad]
        for i in range(0, pad, WIDTH):
            store(ra, i, load(ra, i) + factor * (load(mass, i) * load(va, i)))


@njit(cache=True, **UNCOUNTED)
def first_residual(data):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Constrain v and set r to its residual; return the square of the norm below which rounding rules."""
    solver = data[0]
    v, r, inner, constrained = solver[3], solver[4][1], solver[5], solver[6]
    touched, (_, parts, _, _, sums, _) = inner[OPERATOR], inner[POOL]
    follow(inner[8], inner[3], constrained, False)
    share_step(data, CONSTRAIN, 0.0)
    heaviest = 0.0
    for c in range(len(sums)):
        heaviest = max(heaviest, sums[c, 0])
    add_contact(touched[0], touched[1], touched[5][FACES], -1.0, v, r.reshape(1, len(r)), parts[1], touched[ROOM])
    share_step(data, PREPARE, 0.0)
    strength = summed(sums, 0)
    inner[POOL][5][FURTHER] = 0.0
    share(solver, CHANGE, 1.0)
    return strength * 1e-20 / heaviest


@njit(cache=True, **UNCOUNTED)
def new_velocity(data, limits):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Improve v to the velocity after a step; `limits` are the tolerance and the most iterations.

    Leaves in r minus the impulses that hold the nodes; returns the number of iterations, the energy that the early end of the solver
    dissipates, mN mm, and the square of the residual's norm at which it ended, for `improved_velocity`.
    """
    floor = first_residual(data)
    goal = max(limits[0] ** 2 * share(data[0], NORM, 0.0), floor)
    return *improved_velocity(data, goal, limits[1]), goal


@njit(cache=True, **UNCOUNTED)
def improved_velocity(data, goal, limit):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Improve v, whose residual is r, until the square of the residual's norm is below `goal`; see `new_velocity`."""
    count = solve(data[0], goal, limit)
    return count, settle(data)


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def add_reactions(constrained, r, pad, step, reaction):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add to `reaction` (bodies, 3) the forces, mN, by which bodies constrain nodes, from the residual r of a step."""
    node, direction, _, body, _ = constrained
    for h in range(len(node)):
        i = node[h]
        along = (direction[h, 0] * r[i] + direction[h, 1] * r[pad + i] + direction[h, 2] * r[2 * pad + i]) / step
        for a in range(3):
            reaction[body[h], a] -= along * direction[h, a]


@njit(cache=True, **UNCOUNTED)
def advance(data, lost):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Move nodes, extensions and the lengths these know of on by the new velocity v.

    Returns whether rotation had to be limited; then the lengths lag behind, and the next steps catch up.
    """
    sums = data[0][5][POOL][4]
    share_step(data, MOVE, 0.0)
    slowed = summed(sums, 0)
    share_step(data, EXTEND, 0.0)
    dissipated, linear, square = summed(sums, 0), summed(sums, 1), summed(sums, 2)
    dissipated = max(dissipated + slowed + lost, 0.0)
    if linear + square <= dissipated:
        return False
    root = np.sqrt(linear * linear + 4.0 * square * dissipated)  # share s of the addition: linear s + square s^2 = dissipated
    fraction = 2.0 * dissipated / (linear + root) if linear + root > 0.0 else 0.0
    share_step(data, LIMIT, 1.0 - fraction)
    return True


@njit(cache=True, nogil=True, **UNCOUNTED)
def implicit_steps(data, weight, velocity, limits, reaction):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Take len(velocity) steps, alone or with workers, who change nothing in the result.

    The state in `data` is changed, reaction (steps, bodies, 3), zero before, is filled. Constrained components of `data` move by their
    weights times the velocity (steps, bodies, 3) of their bodies. `limits` are those of `new_velocity`. Returns the number of iterations,
    and in how many steps rotation had to be limited.
    """
    solver, step = data[0], data[1][6]
    mass, r, inner, now = solver[2], solver[4][1], solver[5], solver[6]
    _, direction, speed, body, _ = now
    control = inner[POOL][0]
    iterations, checked = 0, 0
    begin_with(inner, now)
    for n in range(len(velocity)):
        begin_step(control)
        for h in range(len(speed)):
            speed[h] = 0.0
            for a in range(3):
                speed[h] += weight[h] * direction[h, a] * velocity[n, body[h], a]
        share_step(data, START, 0.0)
        count, lost, _ = new_velocity(data, limits)
        add_reactions(now, r, len(mass), step, reaction[n])
        checked += advance(data, lost)
        iterations += count
        end_step(control, count + SETUP)
    return iterations, checked
