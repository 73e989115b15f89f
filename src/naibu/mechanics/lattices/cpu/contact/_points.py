"""Contact at the quadrature points of faces: pressure of the foundation, friction, their linearization, and what a step leaves behind.

A point stands for a cell of its face, over which the gap changes by its slope; W(d) is the mean depth of the part of the cell that the
indenter covers where it is d deep in its middle. The foundation of the cell is compressed by ``dw = W - w0`` in a step. With the
multiplier p' of the nodes at the end of the step before the pressure is ``p = max(0, a (W(d + p' / a) - w0) + b y0)``, which is
``a dw + b y0 + p'`` where all of the cell is covered, and falls steadily to nothing as the indenter leaves: an augmented Lagrangian
:cite:p:`simo1992` whose multiplier lives at the nodes, as far as the indenter covers what lies around them. An indenter that is large
beside the faces thus leaves hardly any penetration; to a small one the foundation yields, as the solid does between the nodes. Friction
follows by a return mapping of ``t0 - k_t h (slip velocity)`` to ``|t| <= mu p``. In a pass, points in contact have the pressure and the
friction that are linear in the velocity: the latter with the ratio of the return mapping of the pass before, and where a point goes on
sliding the way it slid, with the derivative of the return mapping at that pressure, which does not resist along the slip. The matrix
stays symmetric and positive; where friction turns a point round, it is taken as viscous for the rest of the step.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from naibu._numba.compilation import UNCOUNTED, njit
from naibu.mechanics.contact._geometry_kernels import (
    BOX,
    CYLINDER,
    MESH,
    PLANE,
    SPHERE,
    distance_from_primitive,
    distance_from_turned_block,
    gap_of_sphere,
    mesh_of,
    signed_distance,
)
from naibu.mechanics.lattices.cpu.contact._cells import covered_within, facing, is_far, near_flat, opposite_side, pressed, pressed_by_edge
from naibu.mechanics.lattices.cpu.contact._operator import FACES

FREE, STICK, SLIDE = range(3)
TANGENTIAL = 16.7  # stiffness of a point before it slips, of a foundation one element thick: the area in contact does not matter to it
MARGIN = 0.25  # of the radius of a face, by which it may be off what was foreseen
HARD = 20.0  # how many times the foundation is stiffer where an indenter is deep in it
STEEP, FLAT = -0.7, -0.3  # cosines of the angle between the normals of an indenter and of a face, between which the latter takes over
UPRIGHT = 0.7  # slope above which the side of an indenter that is nearest may not be the one that a face looks at
STRAIGHT = 0.5  # cosine of the angle between the frictions of two passes below which a point turns
# columns of what is kept of a linearized point: normal, pressure and friction at no slip, drags along the normal (kPa s/mm) and across,
# velocity of the indenter, covered fraction of the cell, unit vector of friction that slides, drag missing along it, whether that turned
NORMAL, PRESSURE, FRICTION, STIFF, DRAG, SURFACE, ACTIVE, ALIGNED, SLACK, TURNED, COLUMNS = 0, 3, 4, 7, 8, 9, 12, 13, 16, 17, 18
# columns of what it exerts: force, friction, pressure, covered fraction, pressure besides the multiplier, fraction that a flat indenter
# has near, and what it would bear of its multiplier if that touched it
FORCE, TANGENT, ALONG, TOUCHING, OWN, UNDER, BORNE, RESULTS = 0, 3, 6, 7, 8, 9, 10, 11


@njit(cache=True, **UNCOUNTED)
def near_faces(x, v, step, indenters, motion, surface, lists, room):  # type: ignore[no-untyped-def]  # pragma: no cover
    """List the faces that indenters may touch in this step, or that still hold what they left there; return how many there are.

    `x` are the positions before the step, from where nodes go on with v; `lists` indenter and face of every entry, clearances (k, f), how
    far things moved since these were found (k,), and which faces hold something (k, f); `room` is that of `new_room`.
    """
    (geometry, axes), centres, _, _, _ = indenters
    velocity, spin = motion
    corners = surface[0]
    body, face, clear, moved, live = lists
    _, _, (c, _, d, q, _, n), none, _ = room
    pad, count = len(x) // 3, 0
    fastest = 0.0
    for i in range(pad):
        fastest = max(fastest, v[i] ** 2 + v[pad + i] ** 2 + v[2 * pad + i] ** 2)
    for k in range(len(centres)):
        fastest = max(fastest, velocity[k, 0] ** 2 + velocity[k, 1] ** 2 + velocity[k, 2] ** 2)
    for k in range(len(centres)):
        turns = spin[k, 0] != 0.0 or spin[k, 1] != 0.0 or spin[k, 2] != 0.0
        moved[k] = 0.0 if turns else moved[k] + 2.0 * step * np.sqrt(fastest)
        kind, size, mesh = geometry[0][k], geometry[1][k], mesh_of(geometry, k)
        for f in range(len(corners)):
            if not turns and clear[k, f] > moved[k] and not live[k, f]:
                continue
            for a in range(3):
                c[a] = 0.0
                for m in range(4):
                    c[a] += 0.25 * (x[a * pad + corners[f, m]] + step * v[a * pad + corners[f, m]])
                d[a] = c[a] - centres[k, a]
            radius = 0.0
            for m in range(4):
                away = 0.0
                for a in range(3):
                    away += (x[a * pad + corners[f, m]] + step * v[a * pad + corners[f, m]] - c[a]) ** 2
                radius = max(radius, away)
            for a in range(3):
                q[a] = axes[k, a, 0] * d[0] + axes[k, a, 1] * d[1] + axes[k, a, 2] * d[2]
            gap = signed_distance(kind, size, mesh, q, n, none) if kind == MESH else distance_from_primitive(kind, size, q, n, none)
            free = gap - (1.0 + MARGIN) * np.sqrt(radius)
            clear[k, f] = free + moved[k]
            if free <= 0.0 or live[k, f]:
                body[count], face[count] = k, f
                count += 1
    return count


@njit(cache=True, **UNCOUNTED)
def gap_of(geometry, mesh, axes, k, d, q, m, n, none):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the gap of a point at d (3,) from the reference point of indenter k, and set its outward normal n; q and m are scratch."""
    kind, size, own = geometry[0][k], geometry[1][k], axes[k]
    if kind != MESH:
        return _primitive_gap(kind, size, own, d, q, m, n, none)
    for a in range(3):
        q[a] = own[a, 0] * d[0] + own[a, 1] * d[1] + own[a, 2] * d[2]
    gap = signed_distance(kind, size, mesh, q, m, none)
    for a in range(3):
        n[a] = own[0, a] * m[0] + own[1, a] * m[1] + own[2, a] * m[2]
    return gap


@njit(cache=True, **UNCOUNTED)
def _primitive_gap(kind, size, axes, d, q, m, n, none):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Do what `gap_of` does for an indenter without a mesh: meshes are many arrays, which take time to hand over."""
    if kind == SPHERE:
        return gap_of_sphere(size[0], d, n)
    for a in range(3):
        q[a] = axes[a, 0] * d[0] + axes[a, 1] * d[1] + axes[a, 2] * d[2]
    gap = distance_from_primitive(kind, size, q, m, none)
    for a in range(3):
        n[a] = axes[0, a] * m[0] + axes[1, a] * m[1] + axes[2, a] * m[2]
    return gap


@njit(cache=True, **UNCOUNTED)
def _gather(x, v, step, nodes, at, speed):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set at and speed (4, 3) to the positions after the step and the velocities of the nodes (4,) of a face."""
    pad = len(x) // 3
    for c in range(4):
        for a in range(3):
            speed[c, a] = v[a * pad + nodes[c]]
            at[c, a] = x[a * pad + nodes[c]] + step * speed[c, a]


@njit(cache=True, **UNCOUNTED)
def _relate(at, centre):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Make positions (4, 3) relative to a centre; here as below one by one, since arithmetic of arrays takes Numba long to compile."""
    for c in range(4):
        for a in range(3):
            at[c, a] -= centre[a]


@njit(cache=True, **UNCOUNTED)
def _clear(values, begin):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set values (n,) to zero from a place on."""
    for k in range(begin, len(values)):
        values[k] = 0.0


@njit(cache=True, **UNCOUNTED)
def _combine(shape, values, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set out (3,) to the values (4, 3) of the nodes of a face at a point with these shape functions (4,)."""
    for a in range(3):
        out[a] = shape[0] * values[0, a] + shape[1] * values[1, a] + shape[2] * values[2, a] + shape[3] * values[3, a]


def new_room() -> tuple[Any, ...]:
    """Return small arrays for the kernels of a step: nodes of a face, shares of these, vectors, no matrix, and a matrix."""
    nodes, vectors = np.empty((2, 4, 3)), np.empty((6, 3))
    across = (vectors[0], vectors[1], vectors[2], vectors[3], vectors[4], vectors[5])
    return (nodes[0], nodes[1]), np.empty(4), across, np.empty((0, 0)), np.empty((3, 3))


@njit(cache=True, **UNCOUNTED)
def look(count, x, v, step, indenters, motion, surface, history, lists, slid, points, begins, room):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Linearize all points of the listed faces about the velocity v, having found what the linearization before gave at it.

    `slid` (p,) says which points slide; `points` are the linearizations (p, COLUMNS) and what they exert (p, RESULTS). Returns how much
    what they exert differs from what it ought to be, pressure and friction, and the sum of the pressures and of the limits of friction,
    mN; if the step `begins`, nothing was exerted yet.
    """
    (geometry, axes), centres, friction, _, form = indenters
    corners, _, foundation, shapes, weights, first, rule = surface
    _, _, compression, extension, traction, multiplier, thickness = history
    (linear, found), ((at, speed), share, (across, slip, d, q, m, n), none, _) = points, room
    wrong, wrong_friction, total, limits = 0.0, 0.0, 0.0, 0.0
    for entry in range(count):
        k, f = lists[0][entry], lists[1][entry]
        kind, size, turn, mesh, each = geometry[0][k], geometry[1][k], axes[k], mesh_of(geometry, k), rule[k + 1] - rule[k]
        rows = turn[0, 0], turn[0, 1], turn[0, 2], turn[1, 0], turn[1, 1], turn[1, 2], turn[2, 0], turn[2, 1], turn[2, 2]
        _gather(x, v, step, corners[f], at, speed)
        _relate(at, centres[k])
        for c in range(4):
            share[c] = multiplier[k, corners[f, c]]
        _face_normal(at, across)
        stiff, spring, drag = foundation[f, 0] / thickness[k, f], foundation[f, 1] / thickness[k, f], step * TANGENTIAL * foundation[f, 0]
        for g in range(each):
            p, shape = first[k] + f * each + g, shapes[rule[k] + g]
            own, result, weight = linear[p], found[p], weights[p]
            _combine(shape, at, d)
            if kind in (PLANE, BOX):
                gap, n[0], n[1], n[2] = distance_from_turned_block(kind, (size[0], size[1], size[2]), rows, d[0], d[1], d[2])
            elif kind == SPHERE:
                gap = gap_of_sphere(size[0], d, n)
            elif kind == MESH:
                gap = gap_of(geometry, mesh, axes, k, d, q, m, n, none)
            else:
                gap = _primitive_gap(kind, size, turn, d, q, m, n, none)
            if begins:
                _clear(own, ACTIVE)
            carried = shape[0] * share[0] + shape[1] * share[1] + shape[2] * share[2] + shape[3] * share[3]
            if linear[p, ACTIVE] == 0.0:
                if found[p, TOUCHING] != 0.0:
                    _clear(result, 0)
                if is_far(gap - carried / stiff, np.sqrt(weight), form[k, 0]):
                    found[p, UNDER], found[p, BORNE] = 0.0, 0.0
                    continue
            _combine(shape, speed, slip)
            exerted(own, slip, result)
            slope = _slope(n, across)
            _towards_face(n, across)
            width, reach = np.sqrt(weight), carried / stiff
            depth, kept, steep = _pressed_at(kind, (size[0], size[1], size[2]), rows, d, across, gap, slope, width, form[k, 0], reach)
            if form[k, 0] == 0.0:
                found[p, UNDER], found[p, BORNE] = near_flat(gap, slope, width)
            hard = HARD * stiff if depth > form[k, 1] else 0.0
            own_pressure = stiff * (depth - compression[p]) + spring * extension[p] + kept * carried
            pressure = own_pressure + hard * max(depth - form[k, 1], 0.0) if kept > 0.0 else 0.0
            wrong += weight * abs(max(pressure, 0.0) - result[ALONG])
            own[ACTIVE] = kept if pressure > 0.0 else 0.0
            if pressure <= 0.0:
                continue
            total += weight * pressure
            away = _open(own, n, motion, k, d, slip)
            own[STIFF] = step * (stiff * steep + hard)
            own[PRESSURE] = pressure + own[STIFF] * away
            if friction[k, 0] > 0.0:
                wrong_friction += weight * _return_mapping(own, traction[p], slip, drag, pressure, friction[k], slid, p, result)
                limits += weight * friction[k, 1] * pressure
    return wrong, wrong_friction, total, limits


@njit(cache=True, **UNCOUNTED)
def _pressed_at(kind, size, rows, d, across, gap, slope, width, curvature, reach):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Do what `pressed` does, or `pressed_by_edge` where the nearest side of an indenter may not be the one that the face looks at."""
    if kind in (BOX, CYLINDER) and (gap > 0.0 or slope > UPRIGHT):
        other, other_slope = opposite_side(kind, size, rows, d, across)
        return pressed_by_edge(-gap, slope, width, curvature, reach, other, other_slope)
    return pressed(-gap, slope, width, curvature, reach)


@njit(cache=True, **UNCOUNTED)
def _face_normal(at, across):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set across (3,) to the normal of a face with nodes at (4, 3); zero of a single node."""
    size = 0.0
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        across[a] = (at[2, b] - at[0, b]) * (at[3, c] - at[1, c]) - (at[2, c] - at[0, c]) * (at[3, b] - at[1, b])
        size += across[a] ** 2
    for a in range(3):
        across[a] /= np.sqrt(size) if size > 0.0 else 1.0


@njit(cache=True)
def _slope(n, across):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the slope of the gap along a face with the normal `across`; zero of a single node."""
    along = n[0] * across[0] + n[1] * across[1] + n[2] * across[2]
    single = across[0] == 0.0 and across[1] == 0.0 and across[2] == 0.0
    return 0.0 if single else np.sqrt(max(1.0 - along * along, 0.0))


@njit(cache=True)
def _towards_face(n, across):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Turn the normal of an indenter against that of the face where it lies nearly along the face: a deep one is to push, not to spread.

    Otherwise an indenter smaller than a face would fall through it once its widest part has come to the face.
    """
    if across[0] == 0.0 and across[1] == 0.0 and across[2] == 0.0:
        return
    along = n[0] * across[0] + n[1] * across[1] + n[2] * across[2]
    part = min(max((along - STEEP) / (FLAT - STEEP), 0.0), 1.0)
    if part > 0.0 and along < -FLAT:
        size = 0.0
        for a in range(3):
            n[a] = (1.0 - part) * n[a] - part * across[a]
            size += n[a] ** 2
        for a in range(3):
            n[a] /= np.sqrt(size)


@njit(cache=True)
def rest_at(x, indenters, surface, begun, history):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set the compression of the foundations at points (p,) that have not `begun` so that they exert nothing at the positions x.

    It is what indenters cover there, and what cancels the pressure that nodes carry for other faces.
    """
    (geometry, axes), centres, _, _, form = indenters
    corners, _, foundation, shapes, weights, first, rule = surface
    compression, multiplier, thickness = history[2], history[5], history[6]
    at, speed, across = np.empty((4, 3)), np.empty((4, 3)), np.empty(3)
    d, q, m, n, none = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty((0, 0))
    for k in range(len(centres)):
        mesh, each = mesh_of(geometry, k), rule[k + 1] - rule[k]
        for f in range(len(corners)):
            _gather(x, x, 0.0, corners[f], at, speed)
            _relate(at, centres[k])
            _face_normal(at, across)
            for g in range(each):
                p = first[k] + f * each + g
                if begun[p]:
                    continue
                _combine(shapes[rule[k] + g], at, d)
                gap = gap_of(geometry, mesh, axes, k, d, q, m, n, none)
                reach = 0.0
                for c in range(4):
                    reach += shapes[rule[k] + g, c] * multiplier[k, corners[f, c]] * thickness[k, f] / foundation[f, 0]
                slope, width = _slope(n, across), np.sqrt(weights[p])
                other, other_slope = opposite_side(geometry[0][k], geometry[1][k], axes[k].ravel(), d, across)
                near, beyond = facing(slope, form[k, 0]) * reach - gap, other + facing(other_slope, form[k, 0]) * reach
                compression[p] = covered_within(near, slope, width, form[k, 0], beyond, other_slope)[0]


@njit(cache=True)
def _open(own, n, motion, k, d, slip):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set normal and velocity of the indenter at a point, without friction; make `slip` its slip, and return how fast it opens."""
    velocity, spin = motion
    away = 0.0
    for a in range(3):
        b, e = (a + 1) % 3, (a + 2) % 3
        own[NORMAL + a] = n[a]
        own[SURFACE + a] = velocity[k, a] + (spin[k, b] * d[e] - spin[k, e] * d[b])
        slip[a] -= own[SURFACE + a]
        away += slip[a] * n[a]
        own[FRICTION + a] = 0.0
    own[DRAG], own[SLACK] = 0.0, 0.0
    for a in range(3):
        slip[a] -= away * n[a]
    return away


@njit(cache=True)
def exerted(own, slip, result):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set what a linearized point exerts while it moves with the velocity `slip`; nothing, as before, where it is not in contact."""
    if own[ACTIVE] == 0.0:
        return
    away = 0.0
    for a in range(3):
        away += own[NORMAL + a] * (slip[a] - own[SURFACE + a])
    pressure, along = own[PRESSURE] - own[STIFF] * away, 0.0
    for a in range(3):
        along += own[ALIGNED + a] * (slip[a] - own[SURFACE + a])
    for a in range(3):
        tangential = slip[a] - own[SURFACE + a] - away * own[NORMAL + a]
        result[TANGENT + a] = own[FRICTION + a] - own[DRAG] * tangential + own[SLACK] * along * own[ALIGNED + a]
        result[FORCE + a] = pressure * own[NORMAL + a] + result[TANGENT + a]
    result[ALONG], result[TOUCHING] = pressure, own[ACTIVE]


@njit(cache=True)
def _return_mapping(own, traction, slip, stiff, pressure, friction, slid, p, result):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set the linear friction of a point that slips with the velocity `slip`; return how much it differs from that exerted, kPa."""
    along = traction[0] * own[NORMAL] + traction[1] * own[NORMAL + 1] + traction[2] * own[NORMAL + 2]
    size, same, known, moved = 0.0, 0.0, 0.0, 0.0
    for a in range(3):
        own[FRICTION + a] = traction[a] - along * own[NORMAL + a]
        trial = own[FRICTION + a] - stiff * slip[a]
        size, same, moved = size + trial**2, same + trial * own[ALIGNED + a], moved + trial * slip[a]
        known += own[ALIGNED + a] ** 2
    size = np.sqrt(size)
    if not slid[p] and size > friction[0] * pressure:
        slid[p] = True
    limit = (friction[1] if slid[p] else friction[0]) * pressure
    ratio = limit / size if size > limit else 1.0
    own[DRAG] = ratio * stiff
    own[TURNED] = 1.0 if known > 0.0 and same < STRAIGHT * size else own[TURNED]
    own[SLACK] = own[DRAG] if known > 0.0 and ratio < 1.0 and own[TURNED] == 0.0 else 0.0
    wrong = 0.0
    for a in range(3):
        own[ALIGNED + a] = (own[FRICTION + a] - stiff * slip[a]) / size if ratio < 1.0 else 0.0
        own[FRICTION + a] *= ratio
        wrong += (own[FRICTION + a] - own[DRAG] * slip[a] - result[TANGENT + a]) ** 2
        own[FRICTION + a] -= own[SLACK] * moved / max(size, 1e-300) * own[ALIGNED + a]
    return np.sqrt(wrong)


@njit(cache=True, fastmath={"contract", "nsz", "reassoc"}, **UNCOUNTED)
def assemble(count, step, surface, lists, linear, right, operator, d):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Write the blocks of the faces with points in contact into the operator, and add their impulses to `right` (3 pad,).

    `d` (3, 3) is scratch.
    """
    corners, _, _, shapes, weights, first, rule = surface
    body, face = lists[0], lists[1]
    nodes, blocks, counts = operator[0], operator[1], operator[5]
    pad, used = len(right) // 3, 0
    for entry in range(count):
        k, f = body[entry], face[entry]
        each, touched = rule[k + 1] - rule[k], False
        block = blocks[used]
        for g in range(each):
            p, shape = first[k] + f * each + g, shapes[rule[k] + g]
            own = linear[p]
            if own[ACTIVE] == 0.0:
                continue
            if not touched:
                touched = True
                block[:] = 0.0
            normal, drag, slack, impulse = own[STIFF], own[DRAG], own[SLACK], step * weights[p]
            along = own[NORMAL] * own[SURFACE] + own[NORMAL + 1] * own[SURFACE + 1] + own[NORMAL + 2] * own[SURFACE + 2]
            moved = slack * (own[ALIGNED] * own[SURFACE] + own[ALIGNED + 1] * own[SURFACE + 1] + own[ALIGNED + 2] * own[SURFACE + 2])
            pressure = own[PRESSURE] + (normal - drag) * along
            for a in range(3):
                given = pressure * own[NORMAL + a] + own[FRICTION + a] + drag * own[SURFACE + a] - moved * own[ALIGNED + a]
                for c in range(4):
                    right[a * pad + corners[f, c]] += impulse * shape[c] * given
                for b in range(3):
                    d[a, b] = impulse * ((normal - drag) * own[NORMAL + a] * own[NORMAL + b] + (drag if a == b else 0.0))
                    d[a, b] -= impulse * slack * own[ALIGNED + a] * own[ALIGNED + b]
            for c in range(4):
                for e in range(c + 1):
                    both = shape[c] * shape[e]
                    for a in range(3):
                        for b in range(3):
                            block[3 * c + a, 3 * e + b] += both * d[a, b]
        if touched:
            for c in range(4):  # one by one: the first assignment of arrays takes Numba a second to compile
                nodes[used, c] = corners[f, c]
                for e in range(c):
                    for a in range(3):
                        for b in range(3):
                            block[3 * e + b, 3 * c + a] = block[3 * c + a, 3 * e + b]
            used += 1
    counts[FACES] = used
