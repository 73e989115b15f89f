"""Implicit steps of a lattice in unilateral contact with Coulomb friction: a semismooth Newton iteration settles every step.

The contact conditions hold at the quadrature points of the faces (`_points`) for the solution at the end of the step. A pass solves
a step with the contact linearized about the solution of the pass before, until what the points exert agrees with what they ought to.
Where the tolerance is loose, the first passes are solved roughly, as inexact Newton methods do :cite:p:`eisenstat1996`; the last one is
solved to the tolerance.
"""

from __future__ import annotations

import numpy as np

from naibu._numba.compilation import UNCOUNTED, njit
from naibu._numba.thread_pool import begin_step, end_step
from naibu.mechanics.lattices.cpu._explicit_kernels import forces_of_elements
from naibu.mechanics.lattices.cpu.contact._history import keep, pull_off
from naibu.mechanics.lattices.cpu.contact._multipliers import settle_multipliers, update_multipliers
from naibu.mechanics.lattices.cpu.contact._operator import FACES, NODES, close_operator
from naibu.mechanics.lattices.cpu.contact._points import SLIDE, assemble, look, near_faces
from naibu.mechanics.lattices.cpu.contact._solver import (
    change_contacts,
    extrapolate,
    forget_impulses,
    plain_residual,
    settle_in_contact,
    solve_exactly,
    solve_roughly,
)
from naibu.mechanics.lattices.cpu.implicit._coarse_kernels import LATEST, begin_with, follow_contacts
from naibu.mechanics.lattices.cpu.implicit._implicit_kernels import SETUP, add_momenta, add_reactions, advance
from naibu.mechanics.lattices.cpu.implicit._pcg_kernels import residual_norm
from naibu.mechanics.lattices.cpu.implicit._solver_parts import OPERATOR, POOL

AGREED = 1e-4  # error of the pressures, as a fraction of their sum, at which a step is settled
AGREED_FRICTION = 2e-3  # likewise of the friction, of the sum of its limits
LOOSE = 5e-3  # tolerance from which on passes may be rough; with a tighter one, no early end is to decide which points slip
STRICT = 0.1  # by which contacts agree more closely with a tighter tolerance
PASS = 2  # work of a pass beside its iterations, in iterations
ROUGHLY, ROUGH_PASSES = 0.3, 2  # reduction of the residual of a pass whose contacts may be far from those of the solution, and how many


@njit(cache=True, **UNCOUNTED)
def _slid_before(count, surface, history, lists, slid):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Set which points of the listed faces slid at the end of the step before."""
    first, rule = surface[5], surface[6]
    for entry in range(count):
        k = lists[0][entry]
        each = rule[k + 1] - rule[k]
        for p in range(first[k] + lists[1][entry] * each, first[k] + (lists[1][entry] + 1) * each):
            slid[p] = history[0][p] == SLIDE


@njit(cache=True, **UNCOUNTED)
def _settle(engine, contact, vectors, ahead, smoother, most):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Solve a step until its contacts agree with the solution; return iterations, passes, what the solver lost, and whether they agree.

    A pass whose contacts may be far from those of the solution reduces the residual by `ROUGHLY` only, with a tolerance from `LOOSE` on;
    the last one by the tolerance of the solver, from the velocity of the step before.

    `engine` are the data of the step and the limits of the solver; `contact` what `look` takes behind the step, and what is scratch;
    `vectors` room for impulses of contact, zero, and two more (3 pad,); `ahead` what the velocity changed by in the step before
    (3 pad,), and the share of it that was added to v. Returns last the share that was right.
    """
    data, (tolerance, limit) = engine
    v, (_, r, _, _), inner = data[0][3], data[0][4], data[0][5]
    x, step = data[1][0], data[1][6]
    count, indenters, motion, surface, history, lists, slid, points, slot, diagonal, room, (nodal, covered, together) = contact
    given, plain, origin = vectors
    operator = inner[OPERATOR]
    exact = tolerance < LOOSE
    strict = STRICT if exact else 1.0
    iterations, lost, goal, share, ended, ended_before = 0, 0.0, 0.0, 0.0, False, False
    for attempt in range(-1, most):  # before the first solution, points are linearized about the velocity as it is
        if attempt >= 0:
            floor = 0.0
            if attempt:  # the residual of the same solution with other contacts
                change_contacts(data, given, -1.0)
            forget_impulses(operator, given)
            if not attempt:
                floor = plain_residual(data, plain, origin, exact)
            assemble(count, step, surface, lists, points[0], given, operator, room[4])
            close_operator(operator, smoother, slot, diagonal)
            follow_contacts(inner[8], smoother, data[0][6], (operator[0], operator[1], operator[5][FACES]), iterations)
            change_contacts(data, given, 1.0)
            if not attempt:
                goal, share = extrapolate(data, ahead, tolerance, floor)
            rough = ROUGHLY**2 * residual_norm(r, smoother, data[0][6])
            ended = exact or rough <= goal or attempt >= min(ROUGH_PASSES, most - 1)
            if exact:
                iterations += solve_exactly(data, goal, limit, given, plain, origin)
            else:
                iterations += solve_roughly(data[0], goal if ended else rough, limit)
            if ended:
                lost = settle_in_contact(data)
        if attempt > 0 and not ended_before:  # what begins to slip is not decided by a rough solution
            _slid_before(count, surface, history, lists, slid)
        begins, ended_before = attempt < 0, ended
        if together and not begins:
            inertia = (data[0][2], step)
            settle_multipliers(count, v, indenters[4], surface, history, lists, points, nodal, covered, inertia, room[2][1], attempt == 0)
        wrong, wrong_friction, total, limits = look(
            count, x, v, step, indenters, motion, surface, history, lists, slid, points, begins, room
        )
        if ended and wrong <= strict * AGREED * total and wrong_friction <= strict * AGREED_FRICTION * limits + 1e-300:
            return iterations, attempt + 1, lost, True, share
    return iterations, most, lost, False, share


@njit(cache=True, **UNCOUNTED)
def _move_indenters(axes, centres, velocity, spin, step, traction, first, room):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Move and turn indenters by a step, and the friction at their points with them."""
    _, _, (unit, old, _, _, _, _), _, turn = room
    for q in range(len(centres)):
        rate = np.sqrt(spin[q, 0] ** 2 + spin[q, 1] ** 2 + spin[q, 2] ** 2)
        for a in range(3):
            centres[q, a] += step * velocity[q, a]
            unit[a] = spin[q, a] / rate if rate > 0.0 else 0.0
        if rate == 0.0:
            continue
        sine, versine = np.sin(step * rate), 1.0 - np.cos(step * rate)
        for a in range(3):  # Rodrigues' rotation
            b, c = (a + 1) % 3, (a + 2) % 3
            turn[a, a] = 1.0 - versine * (unit[b] ** 2 + unit[c] ** 2)
            turn[c, b] = versine * unit[b] * unit[c] + sine * unit[a]
            turn[b, c] = versine * unit[b] * unit[c] - sine * unit[a]
        for a in range(3):
            _turn(turn, axes[q, a], old)
        for p in range(first[q], first[q + 1]):
            if traction[p, 0] != 0.0 or traction[p, 1] != 0.0 or traction[p, 2] != 0.0:
                _turn(turn, traction[p], old)


@njit(cache=True, **UNCOUNTED)
def _turn(turn, vector, old):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Turn a vector (3,) by a rotation (3, 3); `old` is scratch."""
    for a in range(3):
        old[a] = vector[a]
    for a in range(3):
        vector[a] = turn[a, 0] * old[0] + turn[a, 1] * old[1] + turn[a, 2] * old[2]


@njit(cache=True, nogil=True, **UNCOUNTED)
def contact_steps(data, contact, weight, motion, solver, reactions, most):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Take len(velocity) steps in contact; state, `history`, axes and centres are changed, reactions filled.

    `data` are those of an implicit step, with the operator of the contact; `contact` are indenters, surface, history, scratch, vectors and
    elements: shapes (geometry, axes), centres (k, 3), friction (k, 2), pull-off (k, 3), curvature and depth from which the foundation is
    stiffer (k, 2) of the indenters; nodes of the faces (f, 4), inverse areas (f, 4), foundation (f, 4), shape functions (q, 4) and weights
    (p,) at the points, and where points (k + 1,) and shape functions (k + 1,) of each indenter begin; the arrays of `ContactState`; what
    `near_faces` lists, linearizations and what they exert, which points slide, slots of the nodes, their diagonal blocks, numbers of the
    nodes (COLUMNS, k, n), room for what is small, how far they are covered (k, n), whether multipliers are found with the end of the step,
    the mean acceleration in the step before (3, n) and how much of it lasted (1,), which are changed; room for four vectors (3 pad,); and,
    of explicit steps, whose `data` are those of the masses alone under external forces that are set in every step, what
    `forces_of_elements` takes: blocks, tables, extensions and external forces; else empty. Constrained components of `data` move by their
    weights times the velocities of their bodies; `motion` are these (steps, bodies, 3), and velocities and angular velocities of the
    indenters (steps, k, 3); `solver` the limits of the solver; `reactions` those of the bodies and of the indenters; `most` the most
    passes.
    Returns iterations, passes and the steps whose contacts did not settle.
    """
    (_, _, mass, v, work, inner, now), (x, _, _, before, base, external, step) = data
    indenters, surface, history, scratch, (change, given, plain, origin), (blocks, tables, extension, applied) = contact
    (_, axes), centres, _, _, _ = indenters
    held_velocity, velocity, spin = motion
    lists, points, slid, slot, diagonal, nodal, room, covered, together, trend, trust = scratch
    operator, first = inner[OPERATOR], surface[5]
    change[:], given[:] = 0.0, 0.0
    pad = len(mass)
    iterations, passes, unsettled = 0, 0, 0
    begin_with(inner, now)
    control = inner[POOL][0]
    for n in range(len(velocity)):
        begin_step(control)
        if len(extension):
            forces_of_elements(blocks, tables, (x, v, extension), applied, external)
        for i in range(len(v)):
            before[i] = v[i]
            base[i] = step * external[i] if i < len(external) else 0.0
        for h in range(len(weight)):
            along = 0.0
            for a in range(now[1].shape[1]):
                along += now[1][h, a] * held_velocity[n, now[3][h], a]
            now[2][h] = weight[h] * along
        moving = (velocity[n], spin[n])
        _move_indenters(axes, centres, velocity[n], spin[n], step, history[4], first, room)
        count = near_faces(x, v, step, indenters, moving, surface, lists, room)
        pull_off(count, x, v, step, mass, indenters, moving, surface, history, lists, base, reactions[1][n], room)
        add_momenta(mass, v, 1.0, base)
        _slid_before(count, surface, history, lists, slid)
        found = (count, indenters, moving, surface, history, lists, slid, points, slot, diagonal, room, (nodal, covered, together))
        for a in range(3):
            for i in range(trend.shape[1]):
                change[a * pad + i] = step * trend[a, i]
                v[a * pad + i] += trust[0] * change[a * pad + i]
        done, tries, lost, agreed, share = _settle((data, solver), found, (given, plain, origin), (change, trust[0]), inner[3], most)
        trust[0] = min(max(share, 0.0), 1.0)
        if len(inner[8][5][2]):
            inner[8][5][2][LATEST] = done
        for a in range(3):
            for i in range(trend.shape[1]):
                trend[a, i] = (v[a * pad + i] - before[a * pad + i]) / step
        iterations, passes, unsettled = iterations + done, passes + tries, unsettled + (not agreed)
        add_reactions(now, work[1], len(mass), step, reactions[0][n])
        keep(count, indenters, surface, history, lists, slid, points[1], reactions[1][n])
        update_multipliers(count, indenters[4], surface, history, lists, points[1], nodal, covered, together)
        advance(data, lost)
        end_step(control, done + PASS * tries + SETUP)
    operator[5][FACES], operator[5][NODES] = 0, 0
    return iterations, passes, unsettled
