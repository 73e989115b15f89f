"""Tangent-linear lattice steps: derivatives with respect to the parameters along with the motion :cite:p:`griewank2008`.

The derivative of an implicit step is one more solve with the step's matrix for every parameter: with w = e . (v_j - v_i) of an element and
its impulse T = h b y + h^2 a w along e, ``A v1' = M v0' + h f' + sum (+-) [q e + T e']`` where
``q = h b' y + h b y' + h^2 a' w + h^2 a e' . (v_j - v_i)``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from naibu._numba.compilation import UNCOUNTED, njit
from naibu._numba.intrinsics.packed_tuples import packed
from naibu._numba.intrinsics.simd import WIDTH, aligned, inverse_root, load, splat, store
from naibu.core.arrays import AnyFloatArray, FloatArray, IntArray
from naibu.core.errors import InputError
from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.cpu.implicit._coarse_kernels import begin_with
from naibu.mechanics.lattices.cpu.implicit._implicit_kernels import add_momenta, add_reactions, advance, new_velocity
from naibu.mechanics.lattices.cpu.implicit._pcg_kernels import multiply, residual_norm, solve
from naibu.mechanics.lattices.cpu.implicit._step_parts import constrain_part
from naibu.mechanics.lattices.cpu.scratch import PackedArguments, Scratch, solver_entries
from naibu.mechanics.lattices.model.coefficients import implicit_coefficients
from naibu.mechanics.lattices.model.lattice import LatticeParameters
from naibu.mechanics.lattices.model.state import ConstrainedNodes, LatticeState, checked_velocity, require_constrained, require_numbers

_FAST = {"contract", "nsz"}
_STEP = 1e-5  # fraction of a parameter, for the central differences of the coefficients of a step


@dataclass(frozen=True, slots=True, eq=False)
class ParameterChange:
    """A direction in which parameters change: the derivatives of K (mN/mm), C1 and C2 (mN s/mm) of all elements, (m,) each."""

    stiffness: FloatArray
    voigt_damping: FloatArray
    series_damping: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Loads:
    """Nodes that share the force of a body.

    Attributes
    ----------
    node : ndarray, shape (k,), int64
        Nodes.
    fraction : ndarray, shape (k,)
        Part of the body's force that each one takes; they sum to one for each body.
    body : ndarray, shape (k,), int64
        Number of the body.
    """

    node: IntArray
    fraction: FloatArray
    body: IntArray

    @classmethod
    def none(cls) -> Loads:
        """Load nothing."""
        return cls(np.zeros(0, np.int64), np.zeros(0), np.zeros(0, np.int64))


@dataclass(frozen=True, slots=True, eq=False)
class StateChange:
    """Derivatives of a state along p directions: position (p, n, 3), velocity (p, n, 3) and extension (p, m), per unit of each."""

    position: FloatArray
    velocity: FloatArray
    extension: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class DrivenMotion:
    """Result of driven steps, with derivatives.

    Attributes
    ----------
    state : LatticeState
        After the last step.
    reaction : ndarray, shape (steps, bodies, 3)
        Forces of the bodies on the lattice, mN; of a body that pushes by force what the lattice answers: its force less the inertia of
        the nodes that share it.
    state_change : StateChange
        Derivatives of the state along p directions.
    reaction_change : ndarray, shape (p, steps, bodies, 3)
        Derivatives of the reactions.
    """

    state: LatticeState
    reaction: FloatArray
    state_change: StateChange
    reaction_change: FloatArray


def rest_change(engine: LatticeEngine, count: int) -> StateChange:
    """Return the derivatives of a state that depends on no parameter, along `count` directions."""
    n, m = engine.lattice.n_nodes, engine.lattice.n_elements
    return StateChange(np.zeros((count, n, 3)), np.zeros((count, n, 3)), np.zeros((count, m)))


def driven_steps(
    engine: LatticeEngine,
    state: LatticeState,
    steps: int,
    constrained: ConstrainedNodes,
    velocity: ArrayLike,
    *,
    loads: Loads | None = None,
    force: ArrayLike = 0.0,
    changes: Sequence[ParameterChange] = (),
    state_change: StateChange | None = None,
    tolerance: float | None = None,
) -> DrivenMotion:
    """Take implicit steps under prescribed velocities and forces, and differentiate them along directions of the parameters.

    Parameters
    ----------
    engine : LatticeEngine
        Of the implicit method.
    state : LatticeState
        Where the steps begin; unchanged.
    steps : int
        How many.
    constrained : ConstrainedNodes
        Nodes that bodies move.
    velocity : array_like
        Velocities of the bodies, mm/s, broadcast to (steps, bodies, 3).
    loads : Loads
        Nodes that share the forces of bodies.
    force : array_like
        Forces of the bodies, mN, broadcast to (steps, bodies, 3).
    changes : sequence of ParameterChange
        Directions, p of them.
    state_change : StateChange
        Derivatives of the first state; zero by default.
    tolerance : float
        Of the solves for derivatives; by default the engine's.

    Raises
    ------
    InputError
        An engine of another method, shapes that do not fit, or NaN.
    """
    if engine.method != "implicit":
        raise InputError(
            f"derivatives are those of the implicit method; the engine's is {engine.method!r}: make one with method='implicit'"
        )
    loads, start = loads or Loads.none(), state_change or rest_change(engine, len(changes))
    if len(start.position) != len(changes):
        raise InputError(
            f"the state has derivatives along {len(start.position)} directions, and there are {len(changes)} changes of parameters"
        )
    bodies = int(max(constrained.body.max(initial=-1), loads.body.max(initial=-1))) + 1
    path, pushed = checked_velocity(velocity, steps, bodies), checked_velocity(force, steps, bodies)
    require_constrained(constrained, engine.lattice.n_nodes)
    x, v, y = engine.stored(state)
    lengths = engine.stored_lengths(state)
    tangents = _stored_change(engine, start)
    rows, tables = _changed_coefficients(engine, changes)
    reaction, reaction_change = np.zeros(path.shape), np.zeros((len(changes), *path.shape))
    limits = (engine.tolerance, engine.tolerance if tolerance is None else tolerance, 20_000)
    with engine.scratch() as scratch:
        data, follower = _arguments(engine, (x, v, y, lengths), constrained, scratch)
        _driven_steps(
            data, follower, np.zeros_like(lengths), rows, tables, tangents, (loads.node, loads.fraction, loads.body), pushed,
            constrained.weight, path, limits, reaction, reaction_change,
        )  # fmt: skip
    after = _read_change(engine, tangents)
    require_numbers(reaction, "the computed reaction")
    return DrivenMotion(replace(engine.read(x, v, y), length=lengths[engine.blocks.lane]), reaction, after, reaction_change)


def _arguments(
    engine: LatticeEngine, state: tuple[AnyFloatArray, ...], constrained: ConstrainedNodes, scratch: Scratch
) -> tuple[PackedArguments, PackedArguments]:
    """Return what the kernels of a step read, of the types that implicit steps have, and what those of the solver do for derivatives.

    The latter have a velocity of their own, and constrained nodes that stand still.
    """
    (blocks, tables), (work, inner), (x, v, y, lengths) = engine.kernel, scratch, state
    held = np.ascontiguousarray(constrained.node), np.ascontiguousarray(constrained.direction), np.ascontiguousarray(constrained.body)
    now, still = solver_entries(*held), solver_entries(*held)
    change, before, right = (aligned(v.shape, float) for _ in range(3))
    data = packed((blocks, tables, engine.mass, v, work, inner, now), (x, y, lengths, before, right, np.zeros(0), engine.step))
    return data, packed(blocks, tables, engine.mass, change, work, inner, still)


def _stored_change(engine: LatticeEngine, change: StateChange) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return derivatives as the kernels hold them: (p, 3 pad), (p, 3 pad), (p, 8 nb)."""
    count, pad, n = len(change.position), len(engine.mass), engine.lattice.n_nodes
    x, v = (aligned((count, 3 * pad), float) for _ in range(2))
    x.reshape(count, 3, pad)[:, :, :n] = change.position.transpose(0, 2, 1)
    v.reshape(count, 3, pad)[:, :, :n] = change.velocity.transpose(0, 2, 1)
    y = aligned((count, WIDTH * engine.blocks.n_blocks), float)
    y[:, engine.blocks.lane] = change.extension
    return x, v, y


def _read_change(engine: LatticeEngine, stored: tuple[FloatArray, FloatArray, FloatArray]) -> StateChange:
    count, n = len(stored[0]), engine.lattice.n_nodes
    x, v = (np.ascontiguousarray(a.reshape(count, 3, len(engine.mass))[:, :, :n].transpose(0, 2, 1)) for a in stored[:2])
    return StateChange(x, v, stored[2][:, engine.blocks.lane])


def _changed_coefficients(engine: LatticeEngine, changes: Sequence[ParameterChange]) -> tuple[IntArray, FloatArray]:
    """Return where the derivatives of h^2 a, b, E and g of every block start, and these, (p, 4, length)."""
    columns: list[FloatArray] = []
    for change in changes:
        ahead, behind = (implicit_coefficients(_moved(engine.parameters, change, sign * _STEP), engine.step) for sign in (1.0, -1.0))
        slopes = [(p - q) / (2.0 * _STEP) for p, q in zip(ahead, behind, strict=True)]
        columns += [engine.step**2 * slopes[0], *slopes[1:]]
    if not columns:
        return np.zeros(engine.blocks.n_blocks, dtype=np.int64), np.zeros((0, 4, WIDTH))
    rows, tables = engine.blocks.patterns(*columns)
    return rows, np.ascontiguousarray(np.stack(tables).reshape(len(changes), 4, -1))


def _moved(parameters: LatticeParameters, change: ParameterChange, step: float) -> LatticeParameters:
    values = (parameters.stiffness, parameters.voigt_damping, parameters.series_damping)
    slopes = (change.stiffness, change.voigt_damping, change.series_damping)
    for name, slope in zip(("K", "C1", "C2"), slopes, strict=True):
        if np.shape(slope) != np.shape(parameters.stiffness):
            raise InputError(f"the change of {name} has shape {np.shape(slope)}, the lattice has {len(parameters.stiffness)} elements")
    k, c1, c2 = (np.where(d == 0.0, p, p + step * d) for p, d in zip(values, slopes, strict=True))
    return LatticeParameters(k, c1, c2, parameters.voigt_fraction)


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def _changed_impulse(first, second, rows, tables, changed, change, axes, x, v, y, xd, yd, right, step):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add to `right` the derivative of the elements' impulses while v stands still, and move yd on by all but what the new lengths give.

    `tables` are b, E, g and h^2 a at `rows`, `change` (4, length) the derivatives of h^2 a, b, E and g at `changed`.
    """
    pad = len(v) // 3
    tb, te, tg, ts = tables
    cs, cb, ce = change[0], change[1], change[2]
    e0, e1, e2 = axes[0], axes[1], axes[2]
    v0, v1, v2, d0, d1, d2 = v[:pad], v[pad : 2 * pad], v[2 * pad :], xd[:pad], xd[pad : 2 * pad], xd[2 * pad :]
    x0, x1, x2 = x[:pad], x[pad : 2 * pad], x[2 * pad :]
    f0, f1, f2 = right[:pad], right[pad : 2 * pad], right[2 * pad :]
    dt = splat(step)
    for k in range(len(first)):
        i, j, r, c, at = first[k], second[k], rows[k], changed[k], WIDTH * k
        ex, ey, ez = load(e0, at), load(e1, at), load(e2, at)
        dx, dy, dz = load(x0, j) - load(x0, i), load(x1, j) - load(x1, i), load(x2, j) - load(x2, i)
        inverse = inverse_root(dx * dx + dy * dy + dz * dz)
        vx, vy, vz = load(v0, j) - load(v0, i), load(v1, j) - load(v1, i), load(v2, j) - load(v2, i)
        dx, dy, dz = load(d0, j) - load(d0, i), load(d1, j) - load(d1, i), load(d2, j) - load(d2, i)
        longer = ex * dx + ey * dy + ez * dz
        dx, dy, dz = (dx - ex * longer) * inverse, (dy - ey * longer) * inverse, (dz - ez * longer) * inverse  # e'
        rate, turned = ex * vx + ey * vy + ez * vz, dx * vx + dy * vy + dz * vz
        old, old_change, stiff, b = load(y, at), load(yd, at), load(ts, r), load(tb, r)
        impulse = dt * (b * old) + stiff * rate
        more = dt * (load(cb, c) * old + b * old_change) + load(cs, c) * rate + stiff * turned
        store(yd, at, load(ce, c) * old + load(te, r) * old_change - load(tg, r) * longer)
        dx, dy, dz = more * ex + impulse * dx, more * ey + impulse * dy, more * ez + impulse * dz
        store(f0, i, load(f0, i) + dx)
        store(f0, j, load(f0, j) - dx)
        store(f1, i, load(f1, i) + dy)
        store(f1, j, load(f1, j) - dy)
        store(f2, i, load(f2, i) + dz)
        store(f2, j, load(f2, j) - dz)


@njit(cache=True, fastmath=_FAST, **UNCOUNTED)
def _changed_extension(first, second, rows, gain, changed, change, lengths, x, xd, yd):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add to yd what the new lengths give; `lengths` are the old ones, `gain` the table of g, `change` that of its derivative."""
    pad = len(x) // 3
    x0, x1, x2, d0, d1, d2 = x[:pad], x[pad : 2 * pad], x[2 * pad :], xd[:pad], xd[pad : 2 * pad], xd[2 * pad :]
    for k in range(len(first)):
        i, j, at = first[k], second[k], WIDTH * k
        dx, dy, dz = load(x0, j) - load(x0, i), load(x1, j) - load(x1, i), load(x2, j) - load(x2, i)
        square = dx * dx + dy * dy + dz * dz
        inverse = inverse_root(square)
        longer = dx * (load(d0, j) - load(d0, i)) + dy * (load(d1, j) - load(d1, i)) + dz * (load(d2, j) - load(d2, i))
        stretched = square * inverse - load(lengths, at)
        store(yd, at, load(yd, at) + load(change, changed[k]) * stretched + load(gain, rows[k]) * (longer * inverse))


@njit(cache=True, **UNCOUNTED)
def _answer(loads, force, share, v, before, mass, step, reaction):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add to `reaction` (bodies, 3) a share of the force of bodies less the inertia of the nodes that share it."""
    node, fraction, body = loads
    pad = len(mass)
    for k in range(len(node)):
        for a in range(3):
            at = a * pad + node[k]
            reaction[body[k], a] += share * (fraction[k] * force[body[k], a]) - mass[node[k]] * (v[at] - before[at]) / step


@njit(cache=True, nogil=True, **UNCOUNTED)
def _driven_steps(  # type: ignore[no-untyped-def]  # pragma: no cover
    data, follower, old_lengths, changed, changes, tangents, loads, force, weight, velocity, limits, reaction, reaction_change
):
    """Take len(velocity) steps; the state and its derivatives (p, ...) are changed, the reactions and their derivatives filled.

    `data` and `follower` are those of `_arguments`, `limits` the tolerances of velocities and derivatives, and the most iterations.
    """
    xd, vd, yd = tangents
    solver, (x, y, lengths, before, right, _, step) = data[0], data[1]
    blocks, tables, mass, v, work, inner, now = solver
    change, still = follower[3], follower[6]
    first, second, rows = blocks
    axes, r, _, q = work
    own, pad = (tables[1], tables[2], tables[3], tables[5]), len(mass)
    _, direction, speed, constrained_by, _ = now
    begin_with(inner, now)
    for n in range(len(velocity)):
        _begin(v, loads, force[n], pad, step, before, right)
        add_momenta(mass, v, 1.0, right)
        for h in range(len(speed)):
            along = 0.0
            for a in range(3):
                along += direction[h, a] * velocity[n, constrained_by[h], a]
            speed[h] = weight[h] * along
        _, lost, _ = new_velocity(data, (limits[0], limits[2]))
        add_reactions(now, r, pad, step, reaction[n])
        _answer(loads, force[n], 1.0, v, before, mass, step, reaction[n])
        for p in range(len(xd)):
            _copy(vd[p], change)
            for i in range(len(right)):
                right[i] = 0.0
            add_momenta(mass, change, 1.0, right)
            _changed_impulse(first, second, rows, own, changed, changes[p], axes, x, v, y, xd[p], yd[p], right, step)
            constrain_part(still, change, pad, 0, len(speed))
            _copy(change, vd[p])
            multiply(blocks, tables[5], axes, mass, change, q)
            for i in range(len(r)):
                r[i] = right[i] - q[i]
            goal = max(limits[1] ** 2 * residual_norm(r, inner[3], still), 1e-300)
            solve(follower, goal, limits[2])
            add_reactions(still, r, pad, step, reaction_change[p, n])
            _answer(loads, force[n], 0.0, change, vd[p], mass, step, reaction_change[p, n])
            _copy(change, vd[p])
            for i in range(len(change)):
                xd[p, i] += step * change[i]
        _copy(lengths, old_lengths)
        advance(data, lost)
        for p in range(len(xd)):
            _changed_extension(first, second, rows, tables[3], changed, changes[p, 3], old_lengths, x, xd[p], yd[p])


@njit(cache=True, **UNCOUNTED)
def _copy(one, other):  # type: ignore[no-untyped-def]  # pragma: no cover
    for i in range(len(one)):
        other[i] = one[i]


@njit(cache=True, **UNCOUNTED)
def _begin(v, loads, force, pad, step, before, right):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Keep the velocity before a step, and set `right` to the impulses of the loads."""
    node, fraction, body = loads
    for i in range(len(v)):
        before[i], right[i] = v[i], 0.0
    for k in range(len(node)):
        for a in range(3):
            right[a * pad + node[k]] += step * fraction[k] * force[body[k], a]
