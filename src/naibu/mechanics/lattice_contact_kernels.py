"""Implicit steps of a lattice in contact with rigid bodies: which masses stick, slide or leave is settled within every step (spec L5)."""

from __future__ import annotations

import numpy as np
from numba import njit

from naibu.mechanics.lattice_implicit import add_momenta, advance, new_velocity
from naibu.mechanics.rigid_pushers import surface_gap

FREE, STICK, SLIDE = range(3)
PASSES = 8


@njit(cache=True)
def _look(shapes, places, x, candidates, pad, near):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set near (c, bodies, 4) to normals and gaps of candidates at x from bodies at `places`."""
    kinds, axes, sizes = shapes
    d = np.empty(3)
    for c in range(len(candidates)):
        for k in range(len(kinds)):
            for a in range(3):
                d[a] = x[a * pad + candidates[c]] - places[k, a]
            surface_gap(kinds[k], axes[k], sizes[k], d, near[c, k])


@njit(cache=True)
def _constraints(candidates, mode, near, velocity, step, held):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Write what holds the touching masses to held and return how many entries there are.

    `near` are normals and gaps of the masses before, from the bodies after the step. A mass
    takes the normal of each body that it touches, made orthogonal to those before it, and what is left where it sticks.
    """
    node, direction, speed, body = held
    count = 0
    t = np.empty(3)
    for c in range(len(candidates)):
        begin, sticks = count, -1
        for k in range(mode.shape[1]):
            if mode[c, k] == FREE:
                continue
            if mode[c, k] == STICK and sticks < 0:
                sticks = k
            if count - begin == 3:
                continue
            goal = -near[c, k, 3] / step
            for a in range(3):
                t[a] = near[c, k, a]
            for h in range(begin, count):
                along = direction[h, 0] * t[0] + direction[h, 1] * t[1] + direction[h, 2] * t[2]
                goal -= along * speed[h]
                for a in range(3):
                    t[a] -= along * direction[h, a]
            length = np.sqrt(t[0] ** 2 + t[1] ** 2 + t[2] ** 2)
            if length > 0.1:
                node[count], speed[count], body[count] = candidates[c], goal / length, k
                for a in range(3):
                    direction[count, a] = t[a] / length
                count += 1
        if sticks >= 0:
            count = _complete(candidates[c], sticks, velocity[sticks], begin, count, held)
    return count


@njit(cache=True)
def _complete(mass, k, velocity, begin, count, held):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add to the directions begin to count the ones that are orthogonal to them, in which the mass moves with body k."""
    node, direction, speed, body = held
    t = np.empty(3)
    while count - begin < 3:
        best = 0.0
        for axis in range(3):
            left = 1.0
            for h in range(begin, count):
                left -= direction[h, axis] ** 2
            if left > best:
                best, chosen = left, axis
        for a in range(3):
            t[a] = 1.0 if a == chosen else 0.0
        for h in range(begin, count):
            along = direction[h, chosen]
            for a in range(3):
                t[a] -= along * direction[h, a]
        length = np.sqrt(t[0] ** 2 + t[1] ** 2 + t[2] ** 2)
        node[count], body[count], speed[count] = mass, k, 0.0
        for a in range(3):
            direction[count, a] = t[a] / length
            speed[count] += direction[count, a] * velocity[a]
        count += 1
    return count


@njit(cache=True)
def _forces(held, count, candidates, row, r, pad, step, near, force):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set force (c, bodies, 3) to what the bodies exert on held masses, mN, from the residual r."""
    node, direction, _, body = held
    force[:] = 0.0
    for h in range(count):
        i = node[h]
        along = -(direction[h, 0] * r[i] + direction[h, 1] * r[pad + i] + direction[h, 2] * r[2 * pad + i]) / step
        for a in range(3):
            force[row[i], body[h], a] += along * direction[h, a]


@njit(cache=True)
def _oppose(sliding, v, velocity, normal, i, pad, size):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set the friction on a sliding mass to a size, mN, against the velocity at which it slides; along its old direction where it rests."""
    slip = np.empty(3)
    away, fast, old = 0.0, 0.0, 0.0
    for a in range(3):
        slip[a] = v[a * pad + i] - velocity[a]
        away += slip[a] * normal[a]
        old += sliding[a] ** 2
    for a in range(3):
        slip[a] -= away * normal[a]
        fast += slip[a] ** 2
    for a in range(3):
        sliding[a] = -size * slip[a] / np.sqrt(fast) if fast > 0.0 else size * sliding[a] / np.sqrt(old)


@njit(cache=True)
def _judge(mode, friction, near, after, force, sliding, v, candidates, velocity, pad, tolerance, rough, switched):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Change modes that the solution contradicts, and the friction of sliding masses; return how many changed.

    `sliding` (c, bodies, 3) is the friction on sliding masses, mN; `switched` counts how often a mass began to touch
    or to slide in this step: in circles it ends sticking, or apart.
    """
    changed = 0
    for c in range(mode.shape[0]):
        i = candidates[c]
        for k in range(mode.shape[1]):
            if mode[c, k] == FREE:
                if after[c, k, 3] < -tolerance and switched[c, k] < 3:
                    mode[c, k] = STICK if friction[k, 0] > 0.0 else SLIDE
                    switched[c, k] += 1
                    changed += 1
                continue
            press = 0.0
            for a in range(3):
                press += force[c, k, a] * near[c, k, a]
            if press < 0.0:
                mode[c, k] = FREE
                sliding[c, k, :] = 0.0
                changed += 1
                continue
            if friction[k, 0] == 0.0:
                continue
            tangential, along, size = 0.0, 0.0, 0.0
            for a in range(3):
                tangential += (force[c, k, a] - press * near[c, k, a]) ** 2
                along += sliding[c, k, a] * (v[a * pad + i] - velocity[k, a])
                size += sliding[c, k, a] ** 2
            tangential, size = np.sqrt(tangential), np.sqrt(size)
            if mode[c, k] == STICK:
                if tangential > friction[k, 0] * press and switched[c, k] < 2:
                    mode[c, k] = SLIDE
                    switched[c, k] += 1
                    changed += 1
                    for a in range(3):
                        sliding[c, k, a] = friction[k, 1] * press * (force[c, k, a] - press * near[c, k, a]) / tangential
            elif along > 0.0 or size == 0.0:
                mode[c, k] = STICK
                sliding[c, k, :] = 0.0
                changed += 1
            else:
                if rough and abs(friction[k, 1] * press - size) > 0.02 * size:
                    changed += 1
                _oppose(sliding[c, k], v, velocity[k], near[c, k], i, pad, friction[k, 1] * press)
    return changed


@njit(cache=True)
def _pull_off(touched, mode, pull, near, velocity, v, mass, candidates, step, pad, right, reaction):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the impulses of pull-off to `right`: on masses that touched a body and leave it slowly, never more than stops them."""
    for c in range(mode.shape[0]):
        i = candidates[c]
        for k in range(mode.shape[1]):
            if not touched[c, k] or mode[c, k] != FREE or near[c, k, 3] < 0.0:
                continue
            rate = 0.0
            for a in range(3):
                rate += near[c, k, a] * (v[a * pad + i] - velocity[k, a])
            if 0.0 < rate < pull[k, 2]:
                force = min(pull[k, 0] * near[c, k, 3] + pull[k, 1] * rate, mass[i] * rate / step)
                for a in range(3):
                    right[a * pad + i] -= step * force * near[c, k, a]
                    reaction[k, a] -= force * near[c, k, a]


@njit(cache=True)
def contact_steps(blocks, tables, x, v, y, lengths, mass, external, work, inner, bodies, memory, velocity, step, solver, reaction, most):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Take len(velocity) steps in contact; x, v, y, lengths, `memory` and places are changed, reaction (steps, bodies, 3) is filled.

    `bodies` are shapes (kinds, axes, sizes), places (bodies, 3), friction (bodies, 2), pull-off (bodies, 3) and the masses that may touch;
    `memory` mode (c, bodies), friction of sliding masses (c, bodies, 3) and whether they ever touched (c, bodies). Returns iterations,
    passes and the steps whose contacts did not settle.
    """
    shapes, places, friction, pull, candidates = bodies
    mode, sliding, touched = memory
    pad, c, k = len(mass), len(candidates), len(places)
    near, after, force, applied = np.zeros((c, k, 4)), np.zeros((c, k, 4)), np.zeros((c, k, 3)), np.zeros((c, k, 3))
    node, direction, speed, body = np.zeros(3 * c, np.int64), np.zeros((3 * c, 3)), np.zeros(3 * c), np.zeros(3 * c, np.int64)
    row = np.zeros(pad, np.int64)
    for m in range(c):
        row[candidates[m]] = m
    right, before, moved, base = np.zeros_like(x), np.zeros_like(x), np.zeros_like(x), np.zeros_like(x)
    iterations, passes, unsettled = 0, 0, 0
    for n in range(len(velocity)):
        for i in range(len(v)):
            before[i] = v[i]
            base[i] = step * external[i] if len(external) else 0.0
        places += step * velocity[n]
        _look(shapes, places, x, candidates, pad, near)  # gaps of the old masses from the new bodies
        _pull_off(touched, mode, pull, near, velocity[n], v, mass, candidates, step, pad, base, reaction[n])
        add_momenta(mass, v, 1.0, base)
        lost = 0.0
        switched = np.zeros((c, k), np.int64)
        settled = False
        for attempt in range(most):
            for i in range(len(v)):
                right[i] = base[i]
            for m in range(c):
                for q in range(k):
                    for a in range(3):
                        applied[m, q, a] = sliding[m, q, a] if mode[m, q] == SLIDE else 0.0
                        right[a * pad + candidates[m]] += step * applied[m, q, a]
            count = _constraints(candidates, mode, near, velocity[n], step, (node, direction, speed, body))
            held = (node[:count], direction[:count], speed[:count], body[:count])
            done, lost = new_velocity(blocks, tables, x, v, y, mass, right, work, inner, held, step, solver)
            iterations += done
            passes += 1
            _forces(held, count, candidates, row, work[1], pad, step, near, force)
            for i in range(len(x)):
                moved[i] = x[i] + step * v[i]
            _look(shapes, places, moved, candidates, pad, after)
            if _judge(mode, friction, near, after, force, sliding, v, candidates, velocity[n], pad, 1e-9, attempt < 3, switched) == 0:
                settled = True
                break
        unsettled += not settled
        for m in range(c):
            for q in range(k):
                for a in range(3):
                    reaction[n, q, a] += force[m, q, a] + applied[m, q, a]
                if mode[m, q] != FREE:
                    touched[m, q] = True
        advance(blocks, tables, x, v, before, y, lengths, mass, work[0], step, lost)
    return iterations, passes, unsettled
