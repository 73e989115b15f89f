"""Implicit steps of a lattice in unilateral contact with Coulomb friction: an active-set iteration settles every step.

Nodes stick, slide or separate; the contact conditions :cite:p:`hirai2008` (chapter 4.3) hold for the solution at the end of the step.
Friction on a sliding node is ``mu_k N`` against its slip velocity v. In a pass it is taken as a viscous force ``-w v`` with
``w = mu_k N / |v|`` of the pass before, which adds to the matrix what keeps it positive: it can slow a node down, never turn it round, and
no force outside the friction cone is left behind whenever the passes end.
"""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import njit
from naibu.mechanics.contact._geometry_kernels import outward_normal_and_gap
from naibu.mechanics.lattices.cpu._coarse_kernels import begin
from naibu.mechanics.lattices.cpu._implicit_kernels import add_momenta, add_reactions, advance, new_velocity

FREE, STICK, SLIDE = range(3)
PASSES = 20
REFINED = 4  # times that the viscous coefficient of a node is updated within a step
AGREED = 0.01  # relative error of the friction at which a step is settled


@njit(cache=True)
def _look(shapes, centres, x, candidates, pad, near):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set near (c, bodies, 4) to normals and gaps of candidates at x from indenters at `centres`."""
    geometry, axes = shapes
    d = np.empty(3)
    for c in range(len(candidates)):
        for k in range(len(centres)):
            for a in range(3):
                d[a] = x[a * pad + candidates[c]] - centres[k, a]
            outward_normal_and_gap(geometry, k, axes[k], d, near[c, k])


@njit(cache=True)
def _constraints(candidates, mode, near, surface, step, constrained, fixed):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Write the constraints of touching nodes behind the first `fixed` entries, and return how many entries there are.

    `near` are normals and gaps of the nodes before, from the indenters after the step; `surface` (c, indenters, 3) the velocities of the
    indenters there. A node takes the normal of each indenter that it touches, made orthogonal to those before it, and what is left where
    it sticks.
    """
    node, direction, speed, body = constrained
    count = fixed
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
            count = _complete(candidates[c], sticks, surface[c, sticks], begin, count, constrained)
    return count


@njit(cache=True)
def _complete(mass, k, velocity, begin, count, constrained):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add to the directions begin to count the ones that are orthogonal to them, in which the node moves with body k."""
    node, direction, speed, body = constrained
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
def _forces(constrained, fixed, count, row, r, pad, step, near, force):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set force (c, indenters, 3) to what the indenters exert on touching nodes, mN, from the residual r."""
    node, direction, _, body = constrained
    force[:] = 0.0
    for h in range(fixed, count):
        i = node[h]
        along = -(direction[h, 0] * r[i] + direction[h, 1] * r[pad + i] + direction[h, 2] * r[2 * pad + i]) / step
        for a in range(3):
            force[row[i], body[h], a] += along * direction[h, a]


@njit(cache=True)
def _slip(v, velocity, normal, i, pad, slip):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set slip to the velocity at which node i slides over a body, mm/s, and return its size."""
    away = 0.0
    for a in range(3):
        slip[a] = v[a * pad + i] - velocity[a]
        away += slip[a] * normal[a]
    for a in range(3):
        slip[a] -= away * normal[a]
    return np.sqrt(slip[0] ** 2 + slip[1] ** 2 + slip[2] ** 2)


@njit(cache=True)
def _begin(mode, friction, near, sliding, drag, v, candidates, surface, pad, slow):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Let nodes that hardly slide stick, and give the others the drag that makes the friction of the step before."""
    slip = np.empty(3)
    drag[:] = 0.0
    for c in range(mode.shape[0]):
        for k in range(mode.shape[1]):
            if mode[c, k] != SLIDE or friction[k, 0] == 0.0:
                continue
            speed = _slip(v, surface[c, k], near[c, k], candidates[c], pad, slip)
            if speed < slow:
                mode[c, k] = STICK
            else:
                drag[c, k] = np.sqrt((sliding[c, k] ** 2).sum()) / speed
            sliding[c, k, :] = 0.0


@njit(cache=True)
def _load(candidates, mass, smoother, drag, sliding, surface, step, pad, heavy, light, smooth, right):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add drags and friction that is given as a force to the masses of the matrix, its smoother and the right side."""
    for c in range(len(candidates)):
        i = candidates[c]
        added = 0.0
        for k in range(drag.shape[1]):
            added += step * drag[c, k]
            for a in range(3):
                right[a * pad + i] += step * (drag[c, k] * surface[c, k, a] + sliding[c, k, a])
        heavy[i] = mass[i] + added
        light[i] = heavy[i]
        smooth[i] = 1.0 / (1.0 / smoother[i] + added)


@njit(cache=True)
def _dragged(candidates, mode, drag, sliding, near, surface, v, pad, force, applied):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set applied (c, bodies, 3) to the friction on sliding nodes, and give the normal part of the drag to `force`."""
    slip = np.empty(3)
    for c in range(mode.shape[0]):
        i = candidates[c]
        for k in range(mode.shape[1]):
            applied[c, k, :] = sliding[c, k]
            if drag[c, k] == 0.0:
                continue
            _slip(v, surface[c, k], near[c, k], i, pad, slip)
            for a in range(3):
                applied[c, k, a] -= drag[c, k] * slip[a]
                force[c, k, a] += drag[c, k] * (surface[c, k, a] - v[a * pad + i] + slip[a])


@njit(cache=True)
def _judge(modes, seen, friction, v, candidates, surface, pad, bounds):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Change modes that the solution contradicts, and the drag of sliding nodes; return how many changed.

    `modes` are mode, friction that is given as a force, drag, the limits mu_k N (the mean of passes: alone they swing), and how often a
    mass began to touch in this step and had its drag changed, which ends circles; `seen` are `near`, gaps after the step, forces and
    friction; `bounds` the depth that counts as none, mm, and the speed, mm/s, below which friction is a drag.
    """
    mode, sliding, drag, limits, switched = modes
    near, after, force, applied = seen
    deep, slow = bounds
    changed = 0
    slip = np.empty(3)
    for c in range(mode.shape[0]):
        i = candidates[c]
        for k in range(mode.shape[1]):
            if mode[c, k] == FREE:
                if after[c, k, 3] < -deep and switched[c, k, 0] < 3:
                    moving = _slip(v, surface[c, k], after[c, k], i, pad, slip) > slow
                    mode[c, k] = SLIDE if moving or friction[k, 0] == 0.0 else STICK
                    switched[c, k, 0] += 1
                    changed += 1
                continue
            press = 0.0
            for a in range(3):
                press += force[c, k, a] * near[c, k, a]
            if press < 0.0:
                mode[c, k] = FREE
                sliding[c, k, :], drag[c, k], limits[c, k] = 0.0, 0.0, 0.0
                changed += 1
                continue
            if friction[k, 0] == 0.0:
                continue
            if mode[c, k] == STICK:
                tangential = 0.0
                for a in range(3):
                    tangential += (force[c, k, a] - press * near[c, k, a]) ** 2
                tangential = np.sqrt(tangential)
                if tangential > friction[k, 0] * press * (1.0 + AGREED):
                    mode[c, k] = SLIDE
                    changed += 1
                    for a in range(3):
                        sliding[c, k, a] = friction[k, 1] * press * (force[c, k, a] - press * near[c, k, a]) / tangential
                continue
            limits[c, k] = friction[k, 1] * press if limits[c, k] == 0.0 else 0.5 * (limits[c, k] + friction[k, 1] * press)
            speed, limit = _slip(v, surface[c, k], near[c, k], i, pad, slip), limits[c, k]
            new = limit / max(speed, slow)
            size = np.sqrt((applied[c, k] ** 2).sum())
            wrong = abs(new * speed - size) > AGREED * limit
            if (wrong or (sliding[c, k] != 0.0).any()) and switched[c, k, 1] < REFINED:
                sliding[c, k, :], drag[c, k] = 0.0, new
                switched[c, k, 1] += 1
                changed += 1
    return changed


@njit(cache=True)
def _pull_off(touched, mode, pull, near, surface, v, mass, candidates, step, pad, right, reaction):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the impulses of pull-off to `right`: on nodes that touched a body and leave it slowly, never more than stops them."""
    for c in range(mode.shape[0]):
        i = candidates[c]
        for k in range(mode.shape[1]):
            if not touched[c, k] or mode[c, k] != FREE or near[c, k, 3] < 0.0:
                continue
            rate = 0.0
            for a in range(3):
                rate += near[c, k, a] * (v[a * pad + i] - surface[c, k, a])
            if 0.0 < rate < pull[k, 2]:
                force = min(pull[k, 0] * near[c, k, 3] + pull[k, 1] * rate, mass[i] * rate / step)
                for a in range(3):
                    right[a * pad + i] -= step * force * near[c, k, a]
                    reaction[k, a] -= force * near[c, k, a]


@njit(cache=True)
def _settle(engine, constrained, fixed, modes, seen, shapes, centres, friction, candidates, base, masses, surface, most, slow):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Solve a step until its contacts agree with the solution; return iterations, passes, what the solver lost, and whether they agree.

    `engine` are what `new_velocity` takes; `base` the right side without friction (3 pad,); `masses` those of the lattice, its smoother
    and, for the matrix, all of them with drags.
    """
    blocks, tables, x, v, y, right, work, inner, step, solver = engine
    node, direction, speed, body = constrained
    mode, sliding, drag, _, _ = modes
    near, after, force, applied = seen
    mass, smoother, heavy = masses
    pad, iterations, lost = len(mass), 0, 0.0
    moved, row = np.empty_like(x), np.zeros(pad, np.int64)
    for m in range(len(candidates)):
        row[candidates[m]] = m
    for attempt in range(most):
        right[:] = base
        _load(candidates, mass, smoother, drag, sliding, surface, step, pad, heavy, inner[2], inner[3], right)
        count = _constraints(candidates, mode, near, surface, step, constrained, fixed)
        now = (node[:count], direction[:count], speed[:count], body[:count])
        done, lost = new_velocity(blocks, tables, x, v, y, heavy, right, work, inner, now, step, solver)
        iterations += done
        _forces(now, fixed, count, row, work[1], pad, step, near, force)
        _dragged(candidates, mode, drag, sliding, near, surface, v, pad, force, applied)
        for i in range(len(x)):
            moved[i] = x[i] + step * v[i]
        _look(shapes, centres, moved, candidates, pad, after)
        if _judge(modes, seen, friction, v, candidates, surface, pad, (1e-9, slow)) == 0:
            return iterations, attempt + 1, lost, True
    return iterations, most, lost, False


@njit(cache=True)
def _move_indenters(axes, centres, velocity, spin, step, x, candidates, pad, surface):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Move and turn indenters by a step, and set surface (c, indenters, 3) to their velocities at the candidates, mm/s."""
    centres += step * velocity
    k, d = np.empty((3, 3)), np.empty(3)
    for q in range(len(centres)):
        angle = step * np.sqrt(spin[q, 0] ** 2 + spin[q, 1] ** 2 + spin[q, 2] ** 2)
        if angle > 0.0:  # Rodrigues' rotation of the axes, which are rows
            k[:] = 0.0
            k[2, 1], k[0, 2], k[1, 0] = spin[q, 0] * step / angle, spin[q, 1] * step / angle, spin[q, 2] * step / angle
            turn = k - k.T
            axes[q] = axes[q] @ (np.eye(3) + np.sin(angle) * turn + (1.0 - np.cos(angle)) * (turn @ turn)).T
        for c in range(len(candidates)):
            for a in range(3):
                d[a] = x[a * pad + candidates[c]] - centres[q, a]
            for a in range(3):
                b, e = (a + 1) % 3, (a + 2) % 3
                surface[c, q, a] = velocity[q, a] + (spin[q, b] * d[e] - spin[q, e] * d[b])


@njit(cache=True)
def _keep(force, applied, mode, sliding, touched, reaction):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add up the forces of the indenters, mN, and keep friction and contact for the next step."""
    for m in range(mode.shape[0]):
        for q in range(mode.shape[1]):
            for a in range(3):
                reaction[q, a] += force[m, q, a] + applied[m, q, a]
                sliding[m, q, a] = applied[m, q, a] if mode[m, q] == SLIDE else 0.0
            touched[m, q] |= mode[m, q] != FREE


@njit(cache=True, nogil=True)
def contact_steps(  # type: ignore[no-untyped-def]  # pragma: no cover
    blocks, tables, state, mass, external, work, inner, indenters, history, held, motion, step, solver, reactions, limit
):
    """Take len(velocity) steps in contact; state, `history`, axes and centres are changed, reactions filled.

    `state` are x, v, y and lengths; `indenters` shapes (geometry, axes), centres (k, 3), friction (k, 2), pull-off (k, 3) and the nodes
    that may touch (c,); `history` mode (c, k), friction of sliding nodes (c, k, 3) and whether they ever touched (c, k); `held` node,
    direction, weight and body of constrained components; `motion` velocities of the bodies that move these (steps, bodies, 3), velocities
    and angular velocities of the indenters (steps, k, 3); `reactions` those of the bodies and of the indenters; `limit` the most passes
    and the speed, mm/s, below which nodes stick. Returns iterations, passes and the steps whose contacts did not settle.
    """
    x, v, y, lengths = state
    shapes, centres, friction, pull, candidates = indenters
    mode, sliding, touched = history
    held_velocity, velocity, spin = motion
    most, slow = limit
    pad, c, k, fixed = len(mass), len(candidates), len(centres), len(held[0])
    near, force, applied, surface = np.zeros((c, k, 4)), np.zeros((c, k, 3)), np.zeros((c, k, 3)), np.zeros((c, k, 3))
    size = fixed + 3 * c
    constrained = (np.zeros(size, np.int64), np.zeros((size, 3)), np.zeros(size), np.zeros(size, np.int64))
    support = (constrained[0][:fixed], constrained[1][:fixed], constrained[2][:fixed], constrained[3][:fixed])
    right, before, base, drag = np.zeros_like(x), np.zeros_like(x), np.zeros_like(x), np.zeros((c, k))
    heavy, smoother = mass.copy(), inner[3].copy()
    iterations, passes, unsettled = 0, 0, 0
    begin(inner[8])
    for h in range(fixed):
        support[0][h], support[1][h], support[3][h] = held[0][h], held[1][h], held[3][h]
    for n in range(len(velocity)):
        before[:] = v
        base[:] = 0.0
        for i in range(len(external)):
            base[i] = step * external[i]
        for h in range(fixed):
            support[2][h] = held[2][h] * (held[1][h] * held_velocity[n, held[3][h]]).sum()
        _move_indenters(shapes[1], centres, velocity[n], spin[n], step, x, candidates, pad, surface)
        _look(shapes, centres, x, candidates, pad, near)  # gaps of the nodes before the step from the indenters after it
        _pull_off(touched, mode, pull, near, surface, v, mass, candidates, step, pad, base, reactions[1][n])
        add_momenta(mass, v, 1.0, base)
        _begin(mode, friction, near, sliding, drag, v, candidates, surface, pad, slow)
        modes = (mode, sliding, drag, np.zeros((c, k)), np.zeros((c, k, 2), np.int64))
        seen, solved = (near, np.zeros_like(near), force, applied), (blocks, tables, x, v, y, right, work, inner, step, solver)
        masses = (mass, smoother, heavy)
        done, tries, lost, agreed = _settle(
            solved, constrained, fixed, modes, seen, shapes, centres, friction, candidates, base, masses, surface, most, slow
        )
        iterations, passes, unsettled = iterations + done, passes + tries, unsettled + (not agreed)
        add_reactions(support, work[1], pad, step, reactions[0][n])
        _keep(force, applied, mode, sliding, touched, reactions[1][n])
        advance(blocks, tables, x, v, before, y, lengths, mass, work[0], step, lost)
    for m in candidates:  # the scratch arrays as they were
        inner[2][m], inner[3][m] = mass[m], smoother[m]
    return iterations, passes, unsettled
