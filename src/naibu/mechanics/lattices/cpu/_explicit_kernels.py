"""Explicit Euler steps of a mass-spring-dashpot lattice, many in one call :cite:p:`hirai2008` (chapter 4.3)."""

# arrays of nodes hold x, y and z one after the other, each with `pad` places; y is the extension of the Voigt parts, as blocks store it
from __future__ import annotations

from naibu._numba.compilation import UNCOUNTED, njit
from naibu._numba.intrinsics.simd import WIDTH, inverse_root, load, splat, store
from naibu._numba.intrinsics.subnormals import flush_subnormals, restore
from naibu._numba.thread_pool import JOB, begin_step, end_job, end_step, finish, first_part, following_part, next_part

_FAST = {"contract", "nsz"}
FORCES = 0  # the first job of a step; the second one moves the nodes


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def element_forces(first, second, rows, tables, x, v, y, f, pad, begin, end):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the forces of blocks to f and move their extensions on by a step of Euler's; tables are A, B, D dt and G dt."""
    ta, tb, td, tg = tables
    x0, x1, x2, v0, v1, v2 = x[:pad], x[pad : 2 * pad], x[2 * pad :], v[:pad], v[pad : 2 * pad], v[2 * pad :]
    f0, f1, f2 = f[:pad], f[pad : 2 * pad], f[2 * pad :]
    zero = splat(x.dtype.type(0))
    b = begin
    while b < end:
        i = first[b]
        xi, yi, zi, ui, vi, wi = load(x0, i), load(x1, i), load(x2, i), load(v0, i), load(v1, i), load(v2, i)
        fx, fy, fz = zero, zero, zero
        while b < end and first[b] == i:
            j, r = second[b], rows[b]
            dx, dy, dz = load(x0, j) - xi, load(x1, j) - yi, load(x2, j) - zi
            inverse = inverse_root(dx * dx + dy * dy + dz * dz)
            rate = ((load(v0, j) - ui) * dx + (load(v1, j) - vi) * dy + (load(v2, j) - wi) * dz) * inverse
            extension = load(y, WIDTH * b)
            tension = (load(ta, r) * rate + load(tb, r) * extension) * inverse
            store(y, WIDTH * b, extension + (load(td, r) * rate - load(tg, r) * extension))
            dx, dy, dz = dx * tension, dy * tension, dz * tension
            fx, fy, fz = fx + dx, fy + dy, fz + dz
            store(f0, j, load(f0, j) - dx)
            store(f1, j, load(f1, j) - dy)
            store(f2, j, load(f2, j) - dz)
            b += 1
        store(f0, i, load(f0, i) + fx)
        store(f1, i, load(f1, i) + fy)
        store(f2, i, load(f2, i) + fz)


@njit(cache=True, fastmath=_FAST, nogil=True, **UNCOUNTED)
def forces_of_elements(blocks, tables, state, external, f):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set f (3 pad,) to what all elements and external forces exert, and move the extensions on; state are x, v and y."""
    x, v, y = state
    f[:] = 0
    for place in range(len(external)):
        f[place] = external[place]
    element_forces(blocks[0], blocks[1], blocks[2], tables, x, v, y, f, len(x) // 3, 0, len(blocks[0]))


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def drive(constrained, velocity, v, f, mass, step, reaction):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Change the forces on constrained nodes so that they take on the velocity of their bodies (bodies, 3), mm/s, along the directions.

    `constrained` are node, direction (h, 3), weight and body of every constrained component; what the bodies exert, mN, is added to
    `reaction` (bodies, 3).
    """
    node, direction, weight, body = constrained
    pad = len(mass)
    for h in range(len(node)):
        i, k = node[h], body[h]
        lack = 0.0
        for a in range(3):
            lack += direction[h, a] * (mass[i] * (weight[h] * velocity[k, a] - v[a * pad + i]) / step - f[a * pad + i])
        for a in range(3):
            reaction[k, a] += lack * direction[h, a]
            f[a * pad + i] += lack * direction[h, a]


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def move(x, v, f, inverse_mass, step, forward, pad, begin, end):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Move nodes by a step: by the velocity before it if `forward` (Euler's method as in the report), by that after it if not."""
    dt = splat(step)
    for axis in range(3):
        xa, va, fa = x[axis * pad : (axis + 1) * pad], v[axis * pad : (axis + 1) * pad], f[axis * pad : (axis + 1) * pad]
        for i in range(begin, end, WIDTH):
            old = load(va, i)
            new = old + dt * (load(inverse_mass, i) * load(fa, i))
            store(va, i, new)
            store(xa, i, load(xa, i) + dt * (old if forward else new))


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def _gather(forces, external, low, high, begin, end, p, pad):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add to the forces of part p what other parts and external forces exert on the nodes begin to end."""
    f = forces[p]
    for axis in range(3):
        for q in range(len(low)):
            if q != p:
                g = forces[q]
                for place in range(axis * pad + max(begin, low[q]), axis * pad + min(end, high[q])):
                    f[place] += g[place]
        if len(external):
            for place in range(axis * pad + begin, axis * pad + end):
                f[place] += external[place]


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def _part(job, p, data):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Do part p of a step's first job, the forces of its blocks, or of the second, the motion of its nodes; see `explicit_steps`."""
    (
        (first, second, rows),
        parts,
        tables,
        (x, v, y),
        (mass, inverse_mass),
        external,
        constrained,
        (now, fractions),
        forces,
        (step, forward),
    ) = data
    cuts, nodes, low, high, mine = parts
    pad, f = len(mass), forces[p]
    if job == FORCES:
        for axis in range(3):
            f[axis * pad + low[p] : axis * pad + high[p]] = 0
        element_forces(first, second, rows, tables, x, v, y, f, pad, cuts[p], cuts[p + 1])
        return
    _gather(forces, external, low, high, nodes[p], nodes[p + 1], p, pad)
    begin, end = mine[p], mine[p + 1]
    own = (constrained[0][begin:end], constrained[1][begin:end], constrained[2][begin:end], constrained[3][begin:end])
    fractions[p] = 0.0
    drive(own, now, v, f, mass, step, fractions[p])
    move(x, v, f, inverse_mass, step, forward, pad, nodes[p], nodes[p + 1])


@njit(cache=True, **UNCOUNTED)
def _share(control, job, data):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Have all parts of a job done."""
    part = first_part(control, job)
    while part >= 0:
        _part(job, part, data)
        part = following_part(control, part)
    end_job(control)


@njit(cache=True, nogil=True, **UNCOUNTED)
def explicit_worker(control, data):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Take parts of the jobs of `explicit_steps` while there are some."""
    before = flush_subnormals()
    part = next_part(control)
    while part >= 0:
        _part(control[JOB], part, data)
        finish(control)
        part = next_part(control)
    restore(before)


@njit(cache=True, nogil=True, **UNCOUNTED)
def explicit_steps(control, data, velocity, reaction):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Take len(velocity) steps, alone or with workers, who change nothing in the result; reaction (steps, bodies, 3) is filled.

    `data` are blocks (first, second, rows), parts, tables, the state x, v, y, which is changed, nodal masses with their inverses, external
    forces or none, what is constrained as in `drive`, the velocities of bodies (bodies, 3) in a step and each part's reactions
    (parts, bodies, 3), each part's forces (parts, 3 pad), and the step with whether it is forward (Euler's).

    Part p has the blocks parts[0][p] to parts[0][p + 1], which touch the nodes parts[2][p] to parts[3][p] and have forces of their own;
    it moves the nodes parts[1][p] to parts[1][p + 1], among them the constrained ones parts[4][p] to parts[4][p + 1]. Sums are made in the
    same order each time.
    """
    now, fractions = data[7]
    before = flush_subnormals()
    for n in range(len(velocity)):
        for k in range(len(now)):
            for a in range(3):
                now[k, a] = velocity[n, k, a]
        begin_step(control)
        for job in range(2):
            _share(control, job, data)
        end_step(control, 1)
        for k in range(len(now)):
            for a in range(3):
                reaction[n, k, a] = 0.0
                for p in range(len(fractions)):
                    reaction[n, k, a] += fractions[p, k, a]
    restore(before)
