"""What a step of contact leaves behind: pull-off, the compression of foundations, friction, and reactions."""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import UNCOUNTED, njit
from naibu.mechanics.contact._geometry_kernels import mesh_of
from naibu.mechanics.lattices.cpu.contact._points import ALONG, FORCE, FREE, HARD, OWN, SLIDE, STICK, TANGENT, TOUCHING, gap_of

GONE = 1e-9  # compression of a foundation that counts as none, mm


@njit(cache=True, **UNCOUNTED)
def pull_off(count, x, v, step, mass, indenters, motion, surface, history, lists, base, reaction, room):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the impulses of pull-off to `base`: on points that touched an indenter and leave it slowly, never more than stops them."""
    (geometry, axes), centres, _, pull, _ = indenters
    velocity, spin = motion
    corners, _, _, shapes, weights, first, rule = surface
    mode, touched = history[0], history[1]
    body, face = lists[0], lists[1]
    pad = len(mass)
    _, _, (_, slip, d, q, m, n), none, _ = room
    for entry in range(count):
        k, f = body[entry], face[entry]
        if pull[k, 2] <= 0.0:
            continue
        mesh, each = mesh_of(geometry, k), rule[k + 1] - rule[k]
        area = 0.0
        for g in range(each):
            area += weights[first[k] + f * each + g]
        for g in range(each):
            p, shape = first[k] + f * each + g, shapes[rule[k] + g]
            if not touched[p] or mode[p] != FREE:
                continue
            own = 0.0
            for a in range(3):
                slip[a], d[a] = -velocity[k, a], -centres[k, a]
                for c in range(4):
                    slip[a] += shape[c] * v[a * pad + corners[f, c]]
                    d[a] += shape[c] * x[a * pad + corners[f, c]]
            for c in range(4):
                own += shape[c] * mass[corners[f, c]]
            for a in range(3):
                b, e = (a + 1) % 3, (a + 2) % 3
                slip[a] -= spin[k, b] * d[e] - spin[k, e] * d[b]
            gap = gap_of(geometry, mesh, axes, k, d, q, m, n, none)
            rate = slip[0] * n[0] + slip[1] * n[1] + slip[2] * n[2]
            if gap >= 0.0 and 0.0 < rate < pull[k, 2]:
                force = min(pull[k, 0] * gap + pull[k, 1] * rate, own * rate / step) * weights[p] / area
                for a in range(3):
                    reaction[k, a] -= force * n[a]
                    for c in range(4):
                        base[a * pad + corners[f, c]] -= step * force * n[a] * shape[c]


@njit(cache=True, **UNCOUNTED)
def keep(count, indenters, surface, history, lists, slid, found, reaction):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add up the forces of the indenters, mN, and leave the history of the contact as it is at the end of the step."""
    _, _, friction, pull, form = indenters
    corners, _, foundation, shapes, weights, first, rule = surface
    mode, touched, compression, extension, _, multiplier, thickness = history
    for entry in range(count):
        k, f = lists[0][entry], lists[1][entry]
        each, left = rule[k + 1] - rule[k], False
        stiff, spring = foundation[f, 0] / thickness[k, f], foundation[f, 1] / thickness[k, f]
        decay, growth = foundation[f, 2], foundation[f, 3]
        for g in range(each):
            p, shape = first[k] + f * each + g, shapes[rule[k] + g]
            before = compression[p]
            if found[p, TOUCHING] == 0.0 and before == 0.0 and extension[p] == 0.0 and mode[p] == FREE:
                left |= touched[p] and pull[k, 2] > 0.0
                continue
            compression[p] -= spring / stiff * extension[p]
            if found[p, TOUCHING] > 0.0:
                carried = 0.0
                for c in range(4):
                    carried += shape[c] * multiplier[k, corners[f, c]]
                found[p, OWN] = found[p, ALONG] - found[p, TOUCHING] * carried
                compression[p] += found[p, OWN] / stiff
                over = compression[p] - form[k, 1]
                if over > 0.0:
                    compression[p] -= over * HARD / (1.0 + HARD)
            extension[p] = decay * extension[p] + growth * (compression[p] - before)
            _keep_friction(p, k, found[p], weights[p], friction, slid, history, reaction)
            if found[p, TOUCHING] == 0.0 and abs(compression[p]) < GONE:
                compression[p], extension[p] = 0.0, 0.0
            left |= found[p, TOUCHING] > 0.0 or compression[p] != 0.0 or (touched[p] and pull[k, 2] > 0.0)
        lists[4][k, f] = left


@njit(cache=True, **UNCOUNTED)
def _keep_friction(p, k, result, weight, friction, slid, history, reaction):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Keep friction and mode of a point, and add what it exerts to the reaction of its indenter k."""
    mode, touched, _, _, traction, _, _ = history
    size = 0.0
    for a in range(3):
        reaction[k, a] += weight * result[FORCE + a]
        traction[p, a] = result[TANGENT + a]
        size += traction[p, a] ** 2
    mode[p] = FREE
    if result[TOUCHING] > 0.0:
        touched[p] = True
        slides = friction[k, 0] == 0.0 or (slid[p] and np.sqrt(size) > 0.98 * friction[k, 1] * result[ALONG])
        mode[p] = SLIDE if slides else STICK
