"""Discrete adjoint of explicit lattice steps: gradients with respect to the parameters :cite:p:`griewank2008`.

The steps are run once and kept at a few of them; the adjoint goes backwards, running each stretch between two of these again.
Its gradient is that of the numbers that the steps computed, to rounding, not an approximation of that of the continuous motion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from naibu._numba.compilation import njit
from naibu._numba.intrinsics.simd import WIDTH, aligned, inverse_root, load, splat, store
from naibu.core.arrays import AnyFloatArray, FloatArray, IntArray
from naibu.core.errors import ConvergenceError, InputError
from naibu.mechanics.lattices.cpu._explicit_kernels import drive, element_forces, move
from naibu.mechanics.lattices.cpu.element_blocks import explicit_tables
from naibu.mechanics.lattices.cpu.engine import LatticeEngine
from naibu.mechanics.lattices.cpu.scratch import KernelTuple
from naibu.mechanics.lattices.model.lattice import LatticeParameters
from naibu.mechanics.lattices.model.state import ConstrainedNodes, LatticeState, checked_velocity, require_constrained, require_numbers

_FAST = {"contract", "nsz"}


@dataclass(frozen=True, slots=True, eq=False)
class RecordedPush:
    """A run of explicit steps from which gradients can be taken.

    Attributes
    ----------
    engine : LatticeEngine
        Of an explicit method, in double precision.
    observed : ndarray, shape (k,), int64
        After how many steps positions were observed.
    positions : ndarray, shape (k, n, 3)
        Then, mm.
    reaction : ndarray, shape (steps, bodies, 3)
        Forces of the bodies on the lattice, mN.
    """

    engine: LatticeEngine
    observed: IntArray
    positions: FloatArray
    reaction: FloatArray
    constrained: tuple[IntArray, FloatArray, FloatArray, IntArray]
    velocity: FloatArray
    external: AnyFloatArray
    stretch: int
    kept: tuple[FloatArray, FloatArray, FloatArray]

    @property
    def memory_mb(self) -> float:
        """Memory of the kept states and those of one stretch, MB."""
        states = sum(array.nbytes for array in self.kept)
        return float(states) * (1.0 + self.stretch / len(self.kept[0])) / 1e6


def recorded_push(
    engine: LatticeEngine,
    state: LatticeState,
    observed: ArrayLike,
    constrained: ConstrainedNodes,
    velocity: ArrayLike,
    external_force: ArrayLike | None = None,
) -> RecordedPush:
    """Run explicit steps and keep what their gradients need: about ``2 sqrt(steps)`` states.

    Parameters
    ----------
    engine : LatticeEngine
        Of the method ``"euler"`` or ``"symplectic_euler"``, in double precision.
    state : LatticeState
        Where the steps begin.
    observed : array_like, shape (k,)
        Numbers of steps after which positions are wanted, growing.
    constrained : ConstrainedNodes
        Nodes that bodies move.
    velocity : array_like, shape (steps, bodies, 3)
        Of the bodies, mm/s.
    external_force : array_like
        Constant forces on the nodes, mN, broadcast to (n, 3).

    Raises
    ------
    InputError
        An engine of another method or precision, shapes that do not fit, NaN, or observations that are not within the steps.
    ConvergenceError
        The steps diverged.
    """
    if engine.method == "implicit" or engine.mass.dtype != np.float64:
        raise InputError("gradients need explicit steps in double precision: an engine with method='symplectic_euler' or 'euler'")
    given = np.asarray(velocity, dtype=float)
    if given.ndim != 3:
        raise InputError(f"velocities must have shape (steps, bodies, 3), not {given.shape}")
    path = checked_velocity(given, len(given), int(constrained.body.max(initial=-1)) + 1)
    steps = len(path)
    times = np.atleast_1d(np.asarray(observed, dtype=np.int64))
    if len(times) and (times.min() < 0 or times.max() > steps or (np.diff(times) <= 0).any()):
        raise InputError(f"observations must grow and lie within 0 to {steps} steps, and are {times.tolist()}")
    require_constrained(constrained, engine.lattice.n_nodes)
    external = aligned((0,), float)
    if external_force is not None:
        force = np.broadcast_to(np.asarray(external_force, dtype=float), engine.lattice.points.shape)
        require_numbers(force, "external_force")
        external = engine.by_component(force, float)
    stretch = max(1, int(np.sqrt(steps)))
    count = -(-steps // stretch)
    x, v, y = engine.stored(state)
    kept = (np.empty((count, len(x))), np.empty((count, len(v))), np.empty((count, len(y))))
    entries = (constrained.node, constrained.direction, constrained.weight, constrained.body)
    seen, reaction = np.zeros((len(times), len(x))), np.zeros(path.shape)
    blocks, tables, masses, _ = engine.kernel
    _record(
        blocks,
        tables,
        x,
        v,
        y,
        masses,
        external,
        entries,
        path,
        engine.step,
        engine.method == "euler",
        times,
        stretch,
        kept,
        seen,
        reaction,
    )
    if not (np.isfinite(x).all() and np.isfinite(reaction).all()):
        raise ConvergenceError(f"the explicit steps of {engine.step:g} s diverged; take shorter ones (see explicit_step_limit)")
    pad = len(engine.mass)
    positions = seen.reshape(len(times), 3, pad)[:, :, : engine.lattice.n_nodes].transpose(0, 2, 1)
    return RecordedPush(engine, times, np.ascontiguousarray(positions), reaction, entries, path, external, stretch, kept)


@dataclass(frozen=True, slots=True, eq=False)
class ParameterGradient:
    """Derivatives of a number with respect to the parameters of groups of elements, each changed together.

    Attributes
    ----------
    stiffness, voigt_damping, series_damping : ndarray, shape (g,)
        For K, in 1/(mN/mm), and C1 and C2, in 1/(mN s/mm).
    start_position, start_velocity : ndarray, shape (n, 3)
        For the state that the push began with, 1/mm and s/mm.
    """

    stiffness: FloatArray
    voigt_damping: FloatArray
    series_damping: FloatArray
    start_position: FloatArray
    start_velocity: FloatArray


def push_gradient(
    push: RecordedPush, by_position: ArrayLike, by_reaction: ArrayLike | None = None, groups: NDArray[np.integer] | None = None
) -> ParameterGradient:
    """Return the gradient of a number from its derivatives with respect to observed positions and reactions.

    Parameters
    ----------
    push : RecordedPush
        The run.
    by_position : array_like, shape (k, n, 3)
        Derivatives with respect to the observed positions, 1/mm.
    by_reaction : array_like, shape (steps, bodies, 3)
        Derivatives with respect to the forces of the bodies, 1/mN; zero by default.
    groups : ndarray, shape (m,)
        Group of every element, from 0; by default the classes of the lattice. The parameters of a group may differ: the gradient is that of
        a common addition to them. With one group an element, it is that of every element.

    Raises
    ------
    InputError
        Shapes that do not fit, NaN, or series dashpots that are infinite.
    """
    engine = push.engine
    lattice, pad = engine.lattice, len(engine.mass)
    seen, forces = np.asarray(by_position, dtype=float), np.zeros(push.reaction.shape)
    if by_reaction is not None:
        forces = np.array(by_reaction, dtype=float)
    labels = np.asarray(lattice.element_class if groups is None else groups, dtype=np.int64)
    for what, array, shape in (
        ("by_position", seen, push.positions.shape),
        ("by_reaction", forces, push.reaction.shape),
        ("groups", labels, (lattice.n_elements,)),
    ):
        if array.shape != shape:
            raise InputError(f"{what} has shape {array.shape}, the push needs {shape}")
        require_numbers(array.astype(float), what)
    if not np.isfinite(engine.parameters.series_damping).all():
        raise InputError("a series dashpot is infinite, so that nothing can be said of its change; give C2 a large number instead")
    blocks = engine.blocks
    # equal elements of one group share their coefficients and the sums over them; the label keeps groups apart
    rows, tables = blocks.patterns(
        *explicit_tables(engine.parameters, engine.step, engine.method == "euler"), np.asarray(labels + 1.0, dtype=np.float64)
    )
    sums = tuple(np.zeros_like(table) for table in tables[:4])
    marks = np.zeros((len(push.observed), 3, pad))
    marks[:, :, : lattice.n_nodes] = seen.transpose(0, 2, 1)
    adjoint = tuple(aligned((size,), float) for size in (3 * pad, 3 * pad, WIDTH * blocks.n_blocks))
    masses = engine.kernel[2]
    _backward(
        (blocks.first, blocks.second, rows), tuple(tables[:4]), masses, push.external, push.constrained, push.velocity, engine.step,
        engine.method == "euler", push.observed, push.stretch, push.kept, marks.reshape(len(marks), -1), forces, adjoint, sums,
    )  # fmt: skip
    count = int(labels.max()) + 1
    by_parameter = _by_parameter(engine, labels, rows, sums, count)
    start = (np.ascontiguousarray(a.reshape(3, pad)[:, : lattice.n_nodes].T) for a in adjoint[:2])
    return ParameterGradient(*by_parameter, *start)


def _by_parameter(engine: LatticeEngine, labels: IntArray, rows: IntArray, sums: KernelTuple, count: int) -> list[FloatArray]:
    """Return the derivatives with respect to K, C1 and C2 of all groups, from those with respect to the tables."""
    lane = engine.blocks.lane
    place = rows[lane // WIDTH] + lane % WIDTH
    _, example = np.unique(place, return_index=True)  # one element of every place in the tables
    spots, group = place[example], labels[example]
    p = engine.parameters
    found: list[FloatArray] = []
    tiny = 1e-30  # the derivative by a complex step :cite:p:`squire1998` is exact to rounding
    for shift in range(3):
        moved = [v[example].astype(complex) for v in (p.stiffness, p.voigt_damping, p.series_damping)]
        moved[shift] += 1j * tiny
        perturbed = LatticeParameters(moved[0], moved[1], moved[2], p.voigt_fraction[example])  # a complex step
        changed = explicit_tables(perturbed, engine.step, engine.method == "euler")
        total = sum(sums[c][spots] * changed[c].imag / tiny for c in range(4))
        found.append(np.asarray(np.bincount(group, total, minlength=count), dtype=np.float64))
    return found


@njit(cache=True, fastmath=_FAST)
def _step(blocks, tables, x, v, y, f, masses, external, constrained, velocity, step, forward, reaction):  # type: ignore[no-untyped-def]  # pragma: no cover
    first, second, rows = blocks
    mass, inverse_mass = masses
    pad = len(mass)
    for i in range(len(f)):
        f[i] = external[i] if len(external) else 0.0
    element_forces(first, second, rows, tables, x, v, y, f, pad, 0, len(first))
    drive(constrained, velocity, v, f, mass, step, reaction)
    move(x, v, f, inverse_mass, step, forward, pad, 0, pad - WIDTH)


@njit(cache=True)
def _record(blocks, tables, x, v, y, masses, external, constrained, velocity, step, forward, observed, stretch, kept, seen, reaction):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Run steps; keep the states at the beginning of every stretch and the positions at observed times."""
    f = np.zeros_like(x)
    at = 0
    for n in range(len(velocity) + 1):
        if at < len(observed) and observed[at] == n:
            seen[at] = x
            at += 1
        if n == len(velocity):
            return
        if n % stretch == 0:
            kept[0][n // stretch], kept[1][n // stretch], kept[2][n // stretch] = x, v, y
        _step(blocks, tables, x, v, y, f, masses, external, constrained, velocity[n], step, forward, reaction[n])


@njit(cache=True)
def _backward(  # type: ignore[no-untyped-def]  # pragma: no cover
    blocks, tables, masses, external, constrained, velocity, step, forward, observed, stretch, kept, marks, forces, adjoint, sums
):
    """Go backwards through all steps; `adjoint` are the derivatives with respect to x, v, y and become those of the start."""
    steps = len(velocity)
    places, lanes = kept[0].shape[1], kept[2].shape[1]
    xs, vs, ys = np.empty((stretch, places)), np.empty((stretch, places)), np.empty((stretch, lanes))
    x, v, y = np.empty(places), np.empty(places), np.empty(lanes)
    f, unused = np.zeros(places), np.zeros((velocity.shape[1], 3))
    at = len(observed) - 1
    for part in range(len(kept[0]) - 1, -1, -1):
        begin, end = part * stretch, min((part + 1) * stretch, steps)
        x[:], v[:], y[:] = kept[0][part], kept[1][part], kept[2][part]
        for n in range(begin, end):
            xs[n - begin], vs[n - begin], ys[n - begin] = x, v, y
            if n + 1 < end:
                _step(blocks, tables, x, v, y, f, masses, external, constrained, velocity[n], step, forward, unused)
        for n in range(end - 1, begin - 1, -1):
            if at >= 0 and observed[at] == n + 1:
                adjoint[0][:] += marks[at]
                at -= 1
            k = n - begin
            _masses_back(masses, constrained, step, forward, forces[n], adjoint[0], adjoint[1], f)
            _elements_back(blocks, tables, xs[k], vs[k], ys[k], f, adjoint, sums)
    if at >= 0 and observed[at] == 0:
        adjoint[0][:] += marks[at]


@njit(cache=True, fastmath=_FAST)
def _masses_back(masses, constrained, step, forward, forces, ax, av, f):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Take the derivatives ax, av after the motion of the nodes to those before it, and set f to those with respect to forces."""
    mass, inverse_mass = masses
    pad = len(mass)
    node, direction, _, body = constrained
    for axis in range(3):
        for i in range(pad):
            c = axis * pad + i
            if not forward:
                av[c] += step * ax[c]
            f[c] = step * inverse_mass[i] * av[c]
    for h in range(len(node)):
        i = node[h]
        speed, reaction = 0.0, 0.0
        for a in range(3):
            speed += direction[h, a] * av[a * pad + i]
            reaction += direction[h, a] * forces[body[h], a]
        for a in range(3):  # constrained components do not depend on the forces, but the reaction does
            av[a * pad + i] -= direction[h, a] * (speed + mass[i] / step * reaction)
            f[a * pad + i] -= direction[h, a] * (step * inverse_mass[i] * speed + reaction)
    if forward:
        for c in range(len(ax)):
            av[c] += step * ax[c]


@njit(cache=True, fastmath=_FAST)
def _elements_back(blocks, tables, x, v, y, f, adjoint, sums):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add what elements do: f are derivatives with respect to the forces, `sums` become those with respect to the tables."""
    first, second, rows = blocks
    ta, tb, td, tg = tables
    sa, sb, sd, sg = sums
    ax, av, ay = adjoint
    pad = len(x) // 3
    x0, x1, x2, v0, v1, v2 = x[:pad], x[pad : 2 * pad], x[2 * pad :], v[:pad], v[pad : 2 * pad], v[2 * pad :]
    f0, f1, f2 = f[:pad], f[pad : 2 * pad], f[2 * pad :]
    p0, p1, p2, q0, q1, q2 = ax[:pad], ax[pad : 2 * pad], ax[2 * pad :], av[:pad], av[pad : 2 * pad], av[2 * pad :]
    zero = splat(0.0)
    b, end = 0, len(first)
    while b < end:
        i = first[b]
        xi, yi, zi, ui, vi, wi = load(x0, i), load(x1, i), load(x2, i), load(v0, i), load(v1, i), load(v2, i)
        fi, gi, hi = load(f0, i), load(f1, i), load(f2, i)
        px, py, pz, qx, qy, qz = zero, zero, zero, zero, zero, zero
        while b < end and first[b] == i:
            j, r, at = second[b], rows[b], WIDTH * b
            ex, ey, ez = load(x0, j) - xi, load(x1, j) - yi, load(x2, j) - zi
            inverse = inverse_root(ex * ex + ey * ey + ez * ez)
            ex, ey, ez = ex * inverse, ey * inverse, ez * inverse
            wx, wy, wz = load(v0, j) - ui, load(v1, j) - vi, load(v2, j) - wi
            rate = wx * ex + wy * ey + wz * ez
            old, after = load(y, at), load(ay, at)
            gx, gy, gz = fi - load(f0, j), gi - load(f1, j), hi - load(f2, j)
            a, c = load(ta, r), load(tb, r)
            tension = a * rate + c * old
            by_tension = gx * ex + gy * ey + gz * ez
            by_rate = a * by_tension + load(td, r) * after
            store(ay, at, c * by_tension + (after - load(tg, r) * after))
            store(sa, r, load(sa, r) + by_tension * rate)
            store(sb, r, load(sb, r) + by_tension * old)
            store(sd, r, load(sd, r) + after * rate)
            store(sg, r, load(sg, r) - after * old)
            gx, gy, gz = tension * gx + by_rate * wx, tension * gy + by_rate * wy, tension * gz + by_rate * wz
            along = gx * ex + gy * ey + gz * ez
            gx, gy, gz = (gx - along * ex) * inverse, (gy - along * ey) * inverse, (gz - along * ez) * inverse
            ex, ey, ez = by_rate * ex, by_rate * ey, by_rate * ez
            px, py, pz, qx, qy, qz = px + gx, py + gy, pz + gz, qx + ex, qy + ey, qz + ez
            store(p0, j, load(p0, j) + gx)
            store(p1, j, load(p1, j) + gy)
            store(p2, j, load(p2, j) + gz)
            store(q0, j, load(q0, j) + ex)
            store(q1, j, load(q1, j) + ey)
            store(q2, j, load(q2, j) + ez)
            b += 1
        store(p0, i, load(p0, i) - px)
        store(p1, i, load(p1, i) - py)
        store(p2, i, load(p2, i) - pz)
        store(q0, i, load(q0, i) - qx)
        store(q1, i, load(q1, i) - qy)
        store(q2, i, load(q2, i) - qz)
