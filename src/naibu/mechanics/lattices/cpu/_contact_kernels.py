"""Implicit steps of a lattice in unilateral contact with Coulomb friction: a semismooth Newton iteration settles every step.

The contact conditions hold at the quadrature points of the faces (`_contact_points`) for the solution at the end of the step. A pass solves
a step with the contact linearized about the solution of the pass before, until what the points exert agrees with what they ought to.
"""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import njit
from naibu.mechanics.lattices.cpu._coarse_kernels import begin_with
from naibu.mechanics.lattices.cpu._contact_history import keep, pull_off, update_multipliers
from naibu.mechanics.lattices.cpu._contact_operator import FACES, NODES, add_contact, close_operator
from naibu.mechanics.lattices.cpu._contact_points import SLIDE, assemble, look, near_faces
from naibu.mechanics.lattices.cpu._implicit_kernels import (
    add_momenta,
    add_reactions,
    advance,
    extrapolated_velocity,
    improved_velocity,
)

AGREED = 1e-4  # error of the pressures, as a fraction of their sum, at which a step is settled
AGREED_FRICTION = 2e-3  # likewise of the friction, of the sum of its limits


@njit(cache=True)
def _settle(engine, held, contact, base, right, ahead, smoother, most):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Solve a step until its contacts agree with the solution; return iterations, passes, what the solver lost, and whether they agree.

    The first pass reduces the residual by the tolerance; those that follow, whose contacts differ little, reduce theirs to the same size.

    `engine` are what `extrapolated_velocity` takes; `contact` what `look` takes behind the step, and what is scratch; `base` the right side
    without contact (3 pad,); `ahead` what the velocity changed by in the step before
    (3 pad,), and the share of it that was added to v. Returns last the share that was right.
    """
    blocks, tables, x, v, y, mass, work, inner, step, solver = engine
    count, indenters, motion, surface, history, lists, slid, points, slot, diagonal = contact
    operator, r = inner[9], work[1]
    iterations, lost, goal, share = 0, 0.0, 0.0, 0.0
    look(count, x, v, step, indenters, motion, surface, history, lists, slid, points, True)
    for attempt in range(most):
        if attempt:  # the residual of the same solution with other contacts
            add_contact(operator[0], operator[1], operator[5][FACES], 1.0, v, r)
            for i in range(len(r)):
                r[i] -= right[i]
        right[:] = base
        assemble(count, step, surface, lists, points[0], right, operator)
        close_operator(operator, smoother, slot, diagonal)
        if attempt:
            for i in range(len(r)):
                r[i] += right[i]
            add_contact(operator[0], operator[1], operator[5][FACES], -1.0, v, r)
            done, lost = improved_velocity(blocks, tables, x, v, mass, work, inner, held, goal, solver[1])
        else:
            done, lost, goal, share = extrapolated_velocity(blocks, tables, x, v, ahead, y, mass, right, work, inner, held, step, solver)
        iterations += done
        wrong, wrong_friction, total, limits = look(count, x, v, step, indenters, motion, surface, history, lists, slid, points, False)
        if wrong <= AGREED * total and wrong_friction <= AGREED_FRICTION * limits + 1e-300:
            return iterations, attempt + 1, lost, True, share
    return iterations, most, lost, False, share


@njit(cache=True)
def _move_indenters(axes, centres, velocity, spin, step, traction, first):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Move and turn indenters by a step, and the friction at their points with them."""
    centres += step * velocity
    k = np.empty((3, 3))
    for q in range(len(centres)):
        angle = step * np.sqrt(spin[q, 0] ** 2 + spin[q, 1] ** 2 + spin[q, 2] ** 2)
        if angle > 0.0:  # Rodrigues' rotation of the axes, which are rows
            k[:] = 0.0
            k[2, 1], k[0, 2], k[1, 0] = spin[q, 0] * step / angle, spin[q, 1] * step / angle, spin[q, 2] * step / angle
            turn = k - k.T
            turned = (np.eye(3) + np.sin(angle) * turn + (1.0 - np.cos(angle)) * (turn @ turn)).T
            axes[q] = axes[q] @ turned
            for p in range(first[q], first[q + 1]):
                if traction[p, 0] != 0.0 or traction[p, 1] != 0.0 or traction[p, 2] != 0.0:
                    traction[p] = traction[p] @ turned


@njit(cache=True, nogil=True)
def contact_steps(  # type: ignore[no-untyped-def]  # pragma: no cover
    blocks, tables, state, mass, external, work, inner, indenters, surface, history, scratch, held, motion, step, solver, reactions, most
):
    """Take len(velocity) steps in contact; state, `history`, axes and centres are changed, reactions filled.

    `state` are x, v, y and lengths; `inner` those of the solver, with the operator of the contact; `indenters` shapes (geometry, axes),
    centres (k, 3), friction (k, 2), pull-off (k, 3), curvature and depth from which the foundation is stiffer (k, 2); `surface` nodes of
    the faces (f, 4), inverse areas (f, 4), foundation (f, 4), shape functions with inverse thickness (q, 5) and weights (p,) at the
    points, and where points (k + 1,) and shape functions (k + 1,) of each indenter begin; `history` the arrays of `ContactState`;
    `scratch` what `near_faces` lists, linearizations and what they exert, which points slide, slots of the nodes, their diagonal blocks,
    four numbers a node (4, k, n), the mean acceleration in the step before (3, n) and how much of it lasted (1,), which are changed;
    `held` node, direction, weight and body of constrained components; `motion` velocities of the bodies that move these (steps, bodies, 3),
    velocities and angular velocities of the indenters (steps, k, 3); `reactions` those of the bodies and of the indenters; `most` the most
    passes. Returns iterations, passes and the steps whose contacts did not settle.
    """
    x, v, y, lengths = state
    (_, axes), centres, _, _, _ = indenters
    held_velocity, velocity, spin = motion
    lists, points, slid, slot, diagonal, nodal, trend, trust = scratch
    operator, first = inner[9], surface[5]
    now = (held[0], held[1], np.zeros(len(held[0])), held[3])
    right, before, base, change = np.empty_like(x), np.empty_like(x), np.empty_like(x), np.zeros_like(x)
    pad = len(mass)
    iterations, passes, unsettled = 0, 0, 0
    begin_with(inner, now)
    for n in range(len(velocity)):
        before[:] = v
        base[:] = 0.0
        for i in range(len(external)):
            base[i] = step * external[i]
        for h in range(len(held[0])):
            now[2][h] = held[2][h] * (held[1][h] * held_velocity[n, held[3][h]]).sum()
        moving = (velocity[n], spin[n])
        _move_indenters(axes, centres, velocity[n], spin[n], step, history[4], first)
        count = near_faces(x, v, step, indenters, moving, surface, lists)
        pull_off(count, x, v, step, mass, indenters, moving, surface, history, lists, base, reactions[1][n])
        add_momenta(mass, v, 1.0, base)
        for entry in range(count):
            k, each = lists[0][entry], surface[6][lists[0][entry] + 1] - surface[6][lists[0][entry]]
            for p in range(first[k] + lists[1][entry] * each, first[k] + (lists[1][entry] + 1) * each):
                slid[p] = history[0][p] == SLIDE
        contact = (count, indenters, moving, surface, history, lists, slid, points, slot, diagonal)
        engine = (blocks, tables, x, v, y, mass, work, inner, step, solver)
        for a in range(3):
            for i in range(trend.shape[1]):
                change[a * pad + i] = step * trend[a, i]
                v[a * pad + i] += trust[0] * change[a * pad + i]
        done, tries, lost, agreed, share = _settle(engine, now, contact, base, right, (change, trust[0]), inner[3], most)
        trust[0] = min(max(share, 0.0), 1.0)
        for a in range(3):
            for i in range(trend.shape[1]):
                trend[a, i] = (v[a * pad + i] - before[a * pad + i]) / step
        iterations, passes, unsettled = iterations + done, passes + tries, unsettled + (not agreed)
        add_reactions(now, work[1], len(mass), step, reactions[0][n])
        keep(count, indenters, surface, history, lists, slid, points[1], reactions[1][n])
        update_multipliers(count, surface, history[5], lists, points[1], nodal)
        advance(blocks, tables, x, v, before, y, lengths, mass, work[0], step, lost)
    operator[5][FACES], operator[5][NODES] = 0, 0
    return iterations, passes, unsettled
