"""The linear-implicit step of a lattice on a device of Warp.

The safeguards are those of `naibu.mechanics.lattices.cpu.implicit._implicit_kernels`.
Sums and scalars of the solver stay on the device, which is given several iterations at once; those beyond the end change nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Protocol

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.mechanics.lattices.gpu.coarse_levels import CoarseCorrection
from naibu.mechanics.lattices.gpu.device_arrays import ConstrainedArrays, compiled, recorded, warp_package
from naibu.mechanics.lattices.gpu.prepared_lattice import PreparedLattice
from naibu.mechanics.lattices.gpu.warp_types import WarpArray
from naibu.mechanics.lattices.model.state import LatticeState, followed_lengths

_BATCH = 8  # iterations between two looks at the residual
_LIMIT = 20_000


class DeviceSums:
    """Sums over the nodes in an order that depends on their number only.

    Parameters
    ----------
    n : int
        Number of nodes.
    dtype : warp type
        Of what is added up.
    device : warp device
        Where.
    """

    def __init__(self, n: int, dtype: object, device: object) -> None:
        wp, fold = warp_package(), compiled("_explicit_kernels").FOLD
        sizes = [-(-n // fold)]
        while sizes[-1] > 1:
            sizes.append(-(-sizes[-1] // fold))
        self.levels = [wp.zeros(size, dtype=dtype, device=device) for size in sizes]
        self.device = device
        self.kernel = compiled("_implicit_kernels").fold_norms if dtype is wp.vec2d else compiled("_explicit_kernels").fold

    def of(self, values: WarpArray) -> FloatArray:
        """Return the sum of values of the nodes."""
        self._fold(values, self.levels[0])
        return self._folded(self.levels[-1])

    def dot(self, into: WarpArray, *arrays: WarpArray) -> None:
        """Set `into` (1,) to a . b of two arrays, or to a . b and a . c of three."""
        levels, kernels = [*self.levels[:-1], into], compiled("_implicit_kernels")
        kernel = kernels.products if len(arrays) == 2 else kernels.norms
        warp_package().launch(kernel, levels[0].shape[0], inputs=[*arrays, levels[0]], device=self.device)
        self._folded(into, read=False)

    def _folded(self, into: WarpArray, *, read: bool = True) -> FloatArray:
        levels = [*self.levels[:-1], into]
        for values, sums in pairwise(levels):
            self._fold(values, sums)
        return np.array(into.numpy()[0], dtype=float) if read else np.zeros(0)

    def _fold(self, values: WarpArray, sums: WarpArray) -> None:
        warp_package().launch(self.kernel, sums.shape[0], inputs=[values, sums], device=self.device)


class SteppedSession(Protocol):
    """What implicit steps need of a session: `naibu.mechanics.lattices.gpu.session.WarpLatticeSession`."""

    engine: PreparedLattice
    constrained: ConstrainedArrays
    x: WarpArray
    v: WarpArray
    y: WarpArray
    external: WarpArray
    path: WarpArray
    count: WarpArray

    def collect(self) -> None:
        """Add up what bodies exert in this step."""


@dataclass(slots=True, eq=False)
class ImplicitSteps:
    """Implicit steps of a session, and the arrays that they need.

    Attributes
    ----------
    session : SteppedSession
        What moves.
    lengths : warp array
        Lengths that the extensions followed, mm, at both ends of the elements.
    smoother : warp array (n,)
        Inverse diagonal of the matrix, its mean over the axes, 1/kg.
    before, r, z, p, q : warp array (n,), vec3d
        Velocity before the step, residual, and directions of the solver.
    smoothed : warp array (n,), vec3d
        Residual times the smoother; z itself where there is no coarse correction.
    coarse : CoarseCorrection, optional
        Coarse levels of the preconditioner.
    norm, new : warp array (1,), vec2d
        Squares of the residual's norms in the smoother and in the preconditioner, and those of the next iteration.
    goal, curvature : warp array (1,)
        Scalars of the solver.
    turns : warp array (1,), int32
        Its iterations.
    scalar : warp array (1,)
        For other sums.
    node_scalar, node_vector, node_moments : warp array (n,)
        What is added up over the nodes.
    scalars, pairs, vectors, moments : DeviceSums
        Which add it up.
    """

    session: SteppedSession
    lengths: WarpArray
    smoother: WarpArray
    before: WarpArray
    r: WarpArray
    z: WarpArray
    smoothed: WarpArray
    p: WarpArray
    q: WarpArray
    coarse: CoarseCorrection | None
    norm: WarpArray
    goal: WarpArray
    curvature: WarpArray
    new: WarpArray
    turns: WarpArray
    scalar: WarpArray
    node_scalar: WarpArray
    node_vector: WarpArray
    node_moments: WarpArray
    scalars: DeviceSums
    pairs: DeviceSums
    vectors: DeviceSums
    moments: DeviceSums
    _batch: Callable[[], None] | None = field(default=None, repr=False)

    @classmethod
    def of(cls, session: SteppedSession, state: LatticeState) -> ImplicitSteps:
        """Prepare the steps of a session that begins with a state."""
        wp, kernels = warp_package(), compiled("_implicit_kernels")
        engine = session.engine
        lattice, device = engine.lattice, engine.device
        n = lattice.n_nodes
        known = followed_lengths(lattice, state)

        def zeros(dtype: object, size: int = n) -> WarpArray:
            made: WarpArray = wp.zeros(size, dtype=dtype, device=device)
            return made

        before, r, z, p, q, node_vector = (zeros(wp.vec3d) for _ in range(6))
        levels = engine.coarse
        goal, curvature, scalar = (zeros(wp.float64, 1) for _ in range(3))
        return cls(
            session=session,
            lengths=wp.array(engine.lists.at_both_ends(known, np.float64), dtype=wp.float64, device=device),
            smoother=wp.array(1.0 / engine.diagonal, dtype=wp.float64, device=device),
            before=before,
            r=r,
            z=z,
            smoothed=zeros(wp.vec3d) if levels else z,
            p=p,
            q=q,
            coarse=CoarseCorrection.of(levels, session.constrained, device) if levels else None,
            norm=zeros(wp.vec2d, 1),
            goal=goal,
            curvature=curvature,
            new=zeros(wp.vec2d, 1),
            scalar=scalar,
            turns=zeros(wp.int32, 1),
            node_scalar=zeros(wp.float64),
            node_vector=node_vector,
            node_moments=zeros(kernels.Vector12),
            scalars=DeviceSums(n, wp.float64, device),
            pairs=DeviceSums(n, wp.vec2d, device),
            vectors=DeviceSums(n, wp.vec3d, device),
            moments=DeviceSums(n, kernels.Vector12, device),
        )

    def follow_constraints(self) -> None:
        """Prepare the solver for the constraints that the session has now."""
        self._batch = None  # recorded with the old ones
        if self.coarse is not None:
            self.coarse = CoarseCorrection.of(self.coarse.levels, self.session.constrained, self.session.engine.device)

    def take(self) -> tuple[int, bool]:
        """Take a step; return the iterations of the solver, and whether rotation had to be limited."""
        session = self.session
        constrained = session.constrained
        warp_package().copy(self.before, session.v)
        if constrained.count:
            entries = [
                constrained.first,
                constrained.node,
                constrained.direction,
                constrained.weight,
                constrained.body,
                session.path,
                session.count,
                session.v,
            ]
            self._launch("constrain", constrained.masses, *entries)
        iterations = self._solve()
        lost = self._settled()
        if constrained.count:
            self._launch(
                "support",
                constrained.masses,
                constrained.first,
                constrained.node,
                constrained.direction,
                self.r,
                self._number(session.engine.step),
                constrained.push,
            )
            session.collect()
        return iterations, self._advance(lost)

    def _launch(self, name: str, size: int, *inputs: object) -> None:
        kernel = getattr(compiled("_implicit_kernels"), name)
        warp_package().launch(kernel, size, inputs=list(inputs), device=self.session.engine.device)

    def _on_masses(self, name: str, *inputs: object) -> None:
        self._launch(name, self.session.engine.lattice.n_nodes, *inputs)

    def _on_lists(self, name: str, *inputs: object) -> None:
        engine = self.session.engine
        self._on_masses(name, engine.lists.start, engine.lists.degree, engine.lists.neighbour, engine.row, engine.table, *inputs)

    def _number(self, value: float) -> object:
        return warp_package().float64(value)

    def _release(self, values: WarpArray) -> None:
        constrained = self.session.constrained
        if constrained.count:
            self._launch("release", constrained.masses, constrained.first, constrained.node, constrained.direction, values)

    def _dot(self, a: WarpArray, b: WarpArray) -> float:
        self.scalars.dot(self.scalar, a, b)
        return float(self.scalar.numpy()[0])

    def _multiply(self, *, always: bool) -> None:
        engine = self.session.engine
        scalars = [self.norm, self.goal, self.curvature]
        self._on_lists("multiply", engine.mass, self.session.x, self.p, self._number(engine.step), self.q, always, *scalars)

    def _solve(self) -> int:
        """Improve the velocity by conjugate gradients and leave the residual in r; return the number of iterations."""
        session, engine = self.session, self.session.engine
        moving = [engine.mass, session.x, session.y, session.v, self.before, session.external, self._number(engine.step)]
        self._on_lists("residual", *moving, self.r, self.node_scalar)
        floor = float(self.scalars.of(self.node_scalar)) * 1e-20 / float(engine.lattice.node_mass.max())
        self._on_masses("scaled", self.smoother, self.r, self.smoothed)
        self._precondition(self.norm)
        warp_package().copy(self.p, self.z)
        norm = self._norm()
        goal = max(engine.tolerance**2 * norm, floor)
        self.goal.fill_(goal)
        self.curvature.fill_(1.0)
        self.turns.zero_()
        if self._batch is None:
            self._batch = recorded(self._iterations, engine.device)
        asked = 0
        while norm > goal and asked < _LIMIT:
            self._batch()
            asked += _BATCH
            norm = self._norm()
            if not float(self.curvature.numpy()[0]) > 0.0:
                break
        return int(self.turns.numpy()[0])

    def _norm(self) -> float:
        """Return the square of the residual's norm by which the solver ends, zero where the other one is no longer positive."""
        ending, preconditioned = self.norm.numpy()[0]
        return float(ending) if preconditioned > 0.0 else 0.0

    def _precondition(self, norm: WarpArray) -> None:
        """Set z to the preconditioned residual, from what the smoother gave, and the norms of the residual."""
        self._release(self.smoothed)
        if self.coarse is not None:
            self.coarse.apply(self.smoothed, self.z)
            self._release(self.z)
        self.pairs.dot(norm, self.r, self.smoothed, self.z)

    def _iterations(self) -> None:
        for _ in range(_BATCH):
            self._iteration()

    def _iteration(self) -> None:
        scalars = [self.norm, self.goal, self.curvature]
        self._multiply(always=False)
        self.scalars.dot(self.curvature, self.p, self.q)
        self._on_masses("descend", *scalars, self.smoother, self.p, self.q, self.session.v, self.r, self.smoothed)
        self._precondition(self.new)
        self._on_masses("turn", *scalars, self.new, self.z, self.p)
        self._launch("accept", 1, *scalars, self.new, self.turns)

    def _rigid(self, impulse: WarpArray) -> tuple[object, object, object]:
        """Return centre, speed and spin of the rigid motion that has the momenta of an impulse on the masses."""
        wp, engine, x = warp_package(), self.session.engine, self.session.x
        self._on_masses("weighted", engine.mass, x, self.node_vector)
        weight = engine.lattice.total_mass
        centre = wp.vec3d(*(self.vectors.of(self.node_vector) / weight))
        self._on_masses("moments", engine.mass, x, centre, impulse, self.node_moments)
        s = self.moments.of(self.node_moments)
        inertia = np.array(
            [[s[7] + s[8], -s[11], -s[10]], [-s[11], s[6] + s[8], -s[9]], [-s[10], -s[9], s[6] + s[7]]],
        )
        values, vectors = np.linalg.eigh(inertia)
        turns = values > 1e-12 * values[2]  # nodes in a line do not turn about it
        spin = vectors[:, turns] @ ((vectors[:, turns].T @ s[3:6]) / values[turns])
        return centre, wp.vec3d(*(s[:3] / weight)), wp.vec3d(*spin)

    def _settled(self) -> float:
        """Keep v1 . r of free components from being negative, and a free body's momenta; return the v1 . r that is left."""
        session, engine = self.session, self.session.engine
        wp, free = warp_package(), not self.session.constrained.count
        if free:
            rigid = self._rigid(self.r)
            self._on_masses("add_rigid", session.x, *rigid, self._number(1.0), session.v)
            self._on_masses("balance", session.x, *rigid, engine.mass, self.r)
        wp.copy(self.p, session.v)
        self._release(self.p)
        lost = self._dot(self.p, self.r)
        if lost >= 0.0:
            return lost
        if free:
            self._on_masses("weighted", engine.mass, session.v, self.z)
            self._on_masses("add_rigid", session.x, *self._rigid(self.z), self._number(-1.0), self.p)
        self._multiply(always=True)
        curvature = self._dot(self.p, self.q)
        fraction = self._dot(self.p, self.r) / curvature if curvature > 0.0 else 0.0
        self._on_masses("correct", self._number(fraction), self.p, session.v)
        self._on_masses("correct", self._number(-fraction), self.q, self.r)
        return 0.0

    def _advance(self, lost: float) -> bool:
        """Move nodes and extensions on; return whether rotation had to be limited."""
        session, engine = self.session, self.session.engine
        step = self._number(engine.step)
        moving = [engine.stiffness, engine.mass, session.x, session.v, self.before, session.y, self.lengths, step]
        self._on_lists("weigh", *moving, self.node_vector)
        dissipated, linear, square = self.vectors.of(self.node_vector)
        allowed = max(float(dissipated) + lost, 0.0)
        fraction = 1.0
        if linear + square > allowed:
            root = np.sqrt(linear * linear + 4.0 * square * allowed)  # linear s + square s^2 = allowed
            fraction = 2.0 * allowed / (linear + root) if linear + root > 0.0 else 0.0
        self._on_lists("extend", session.x, session.v, step, self._number(fraction), session.y, self.lengths)
        self._on_masses("shift", step, session.v, session.count, session.x)
        return bool(linear + square > allowed)
