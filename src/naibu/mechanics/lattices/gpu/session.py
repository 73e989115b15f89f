"""Sessions on a device of Warp, where the state of a lattice stays between steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from types import TracebackType

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError, InputError
from naibu.mechanics.contact.indenter_motion import IndenterMotion
from naibu.mechanics.contact.rigid_indenters import RigidIndenter
from naibu.mechanics.contact.session_protocol import StepForces
from naibu.mechanics.lattices.gpu.device_arrays import (
    ConstrainedArrays,
    compiled,
    recorded,
    warp_package,
)
from naibu.mechanics.lattices.gpu.implicit_stepper import ImplicitSteps
from naibu.mechanics.lattices.gpu.prepared_lattice import PreparedLattice
from naibu.mechanics.lattices.gpu.warp_types import WarpArray
from naibu.mechanics.lattices.model.lattice import Lattice
from naibu.mechanics.lattices.model.state import (
    ConstrainedNodes,
    LatticeState,
    checked_velocity,
    explicit_step_limit,
    followed_lengths,
    require_constrained,
    require_no_contact,
    require_numbers,
)

_CHUNK = 256  # steps for which velocities and reactions have room on the device
_AT_ONCE = 16  # steps that the device is given at once


@dataclass(slots=True, eq=False)
class WarpLatticeSession:
    """A lattice in motion on a device of Warp, where its state stays between steps.

    Attributes
    ----------
    engine : PreparedLattice
        Lattice, parameters and method.
    constrained : ConstrainedArrays
        Constrained nodes.
    x, v, f, external : warp array
        Position (mm), velocity (mm/s), force and external force (mN) of the nodes; the last may be empty.
    y : warp array
        Extensions, mm, at both ends of the elements.
    path, parts, count : warp array
        Velocities of the bodies and forces of parts of constrained nodes in the coming steps, and the number of those taken.
    taken : int
        Steps so far.
    iterations : int
        Iterations of the solver so far.
    rotation_limited : int
        Steps in which the stretching by rotation was limited, see `Motion`.
    bodies : int
        Least number of bodies that `step` takes velocities of.
    """

    engine: PreparedLattice
    constrained: ConstrainedArrays
    x: WarpArray
    v: WarpArray
    f: WarpArray
    external: WarpArray
    y: WarpArray
    path: WarpArray
    parts: WarpArray
    count: WarpArray
    taken: int = 0
    iterations: int = 0
    rotation_limited: int = 0
    implicit: ImplicitSteps | None = None
    bodies: int = 0
    _forces: StepForces = field(default_factory=lambda: StepForces(np.zeros((0, 0, 3))))
    _many: Callable[[], None] | None = field(default=None, repr=False)

    @classmethod
    def of(
        cls, engine: PreparedLattice, state: LatticeState, constrained: ConstrainedNodes, external_force: ArrayLike | None
    ) -> WarpLatticeSession:
        """Put a state on the device of an engine; see `WarpLatticeEngine.session`.

        Raises
        ------
        InputError
            Shapes that do not fit, or NaN.
        """
        wp, device = warp_package(), engine.device
        lattice = engine.lattice
        _check_state(lattice, state)
        require_constrained(constrained, lattice.n_nodes)
        vector = wp.vec3f if engine.mass.dtype == wp.float32 else wp.vec3d
        force = np.zeros((0, 3))
        if external_force is not None:
            force = np.array(np.broadcast_to(np.asarray(external_force, dtype=float), lattice.points.shape))
            require_numbers(force, "external_force")
        x, v, external = (wp.array(a, dtype=vector, device=device, copy=True) for a in (state.position, state.velocity, force))
        real = np.float32 if vector is wp.vec3f else np.float64
        y = wp.array(engine.lists.at_both_ends(state.extension, real), dtype=engine.mass.dtype, device=device)
        entries = ConstrainedArrays.of(constrained, device)
        f = wp.zeros(lattice.n_nodes, dtype=vector, device=device)
        path = wp.zeros((_CHUNK, max(entries.bodies, 1)), dtype=wp.vec3d, device=device)
        parts = wp.zeros((_CHUNK, max(len(entries.part_body), 1)), dtype=wp.vec3d, device=device)
        session = cls(engine, entries, x, v, f, external, y, path, parts, wp.zeros(1, dtype=wp.int32, device=device))
        if engine.method == "implicit":
            session.implicit = ImplicitSteps.of(session, state)
        return session

    def constrain(self, constrained: ConstrainedNodes, bodies: int = 0) -> None:
        """Constrain these nodes, and no others, from the next step on.

        Parameters
        ----------
        constrained : ConstrainedNodes
            Nodes that bodies move.
        bodies : int
            Number of bodies, if some move no node at present.

        Raises
        ------
        InputError
            Nodes that are not there, or constrained twice in directions that are not orthogonal; the old constraints then stay.
        """
        require_constrained(constrained, self.engine.lattice.n_nodes)
        wp, device = warp_package(), self.engine.device
        self.constrained, self.bodies = ConstrainedArrays.of(constrained, device), bodies
        self.path = wp.zeros((_CHUNK, max(self.constrained.bodies, 1)), dtype=wp.vec3d, device=device)
        self.parts = wp.zeros((_CHUNK, max(len(self.constrained.part_body), 1)), dtype=wp.vec3d, device=device)
        self._many = None  # recorded with the old arrays
        if self.implicit is not None:
            self.implicit.follow_constraints()

    def press(self, indenters: Sequence[RigidIndenter]) -> None:
        """Refuse indenters: contact is computed by `LatticeEngine` only.

        Raises
        ------
        InputError
            There are some.
        """
        require_no_indenters(indenters)

    def step(self, velocity: ArrayLike = 0.0, motions: Sequence[IndenterMotion] = (), *, steps: int = 1) -> StepForces:
        """Take steps in place.

        Parameters
        ----------
        velocity : array_like
            Velocity of the bodies that move constrained nodes, mm/s, broadcast to (steps, bodies, 3).
        motions : sequence of IndenterMotion
            None: there are no indenters.
        steps : int
            How many, at least one.

        Returns
        -------
        StepForces
            Of the bodies on the lattice in every step, mN.

        Raises
        ------
        InputError
            Shapes that do not fit, NaN, motions, or no step.
        """
        if steps < 1:
            raise InputError(f"steps must be at least 1, not {steps}")
        if motions:
            raise InputError(f"motions has {len(motions)} entries for 0 indenters; give one for each")
        path = checked_velocity(velocity, steps, max(self.constrained.bodies, self.bodies))
        self._forces = StepForces(self.take_path(path), np.zeros((steps, 0, 3)))
        return self._forces

    def forces(self) -> StepForces:
        """Return the forces of the last call of `step`."""
        return self._forces

    def positions(self, nodes: ArrayLike | None = None) -> FloatArray:
        """Return positions of nodes, by default of all, mm, shape (k, 3)."""
        found = np.array(self.x.numpy(), dtype=np.float64).reshape(-1, 3)
        return found if nodes is None else found[np.asarray(nodes, dtype=np.int64)]

    def restore(self, state: LatticeState) -> None:
        """Go on from a state, with the same constraints.

        Raises
        ------
        InputError
            A state of another lattice, or in contact.
        """
        lattice, lists = self.engine.lattice, self.engine.lists
        _check_state(lattice, state)
        self.x.assign(state.position)
        self.v.assign(state.velocity)
        self.y.assign(lists.at_both_ends(state.extension, self.y.numpy().dtype.type))
        if self.implicit is not None:
            self.implicit.lengths.assign(lists.at_both_ends(followed_lengths(lattice, state), np.float64))

    def close(self) -> None:
        """Nothing is kept beside the arrays, which the garbage collector frees."""

    def __enter__(self) -> WarpLatticeSession:
        """Return the session."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Close it."""
        self.close()

    def take_path(self, path: FloatArray) -> FloatArray:
        """Take steps with velocities of the bodies (steps, bodies, 3), mm/s; return their forces, mN, of the same shape."""
        steps, reaction = len(path), np.zeros(path.shape)
        for begin in range(0, steps, _CHUNK):
            size = min(_CHUNK, steps - begin)
            if self.constrained.count:
                coming = np.zeros((_CHUNK, self.constrained.bodies, 3))
                coming[:size] = path[begin : begin + size, : self.constrained.bodies]
                self.path.assign(coming)
            self.count.zero_()
            self._take(size)
            if self.constrained.count:
                reaction[begin : begin + size] = self.constrained.reactions(self.parts.numpy()[:size], path.shape[1])
        self.taken += steps
        return reaction

    def state(self) -> LatticeState:
        """Return a copy of the state.

        Raises
        ------
        ConvergenceError
            The explicit method diverged.
        """
        position, velocity = (np.array(a.numpy(), dtype=np.float64).reshape(-1, 3) for a in (self.x, self.v))
        lists = self.engine.lists
        length = lists.of_elements(self.implicit.lengths) if self.implicit else None
        state = LatticeState(position, velocity, lists.of_elements(self.y), length)
        return state if self.implicit else self._checked(state)

    def _take(self, steps: int) -> None:
        if self.implicit:
            for _ in range(steps):
                iterations, rotation_limited = self.implicit.take()
                self.iterations += iterations
                self.rotation_limited += rotation_limited
            return
        if self._many is None and steps >= _AT_ONCE:
            self._many = recorded(lambda: self._explicit_steps(_AT_ONCE), self.engine.device)
        while self._many is not None and steps >= _AT_ONCE:
            self._many()
            steps -= _AT_ONCE
        self._explicit_steps(steps)

    def _explicit_steps(self, steps: int) -> None:
        for _ in range(steps):
            self._explicit_step()

    def _explicit_step(self) -> None:
        wp, kernels = warp_package(), compiled("_explicit_kernels")
        engine, lists, constrained, n = self.engine, self.engine.lists, self.constrained, self.engine.lattice.n_nodes
        device = engine.device
        elements = [lists.start, lists.degree, lists.neighbour, engine.row, engine.table]
        wp.launch(kernels.forces, n, inputs=[*elements, self.x, self.v, self.y, self.external, self.f], device=device)
        if constrained.count:
            entries = [constrained.first, constrained.node, constrained.direction, constrained.weight, constrained.body]
            motion = [self.path, self.count, engine.mass, self.v, wp.float64(engine.step), self.f, constrained.push]
            wp.launch(kernels.drive, constrained.masses, inputs=[*entries, *motion], device=device)
            self.collect()
        step, forward = engine.mass.dtype(engine.step), int(engine.method == "euler")
        wp.launch(kernels.move, n, inputs=[engine.inverse_mass, self.f, step, forward, self.count, self.x, self.v], device=device)

    def collect(self) -> None:
        """Add up what bodies exert in this step; meant for the steps."""
        constrained, kernels = self.constrained, compiled("_explicit_kernels")
        sums = [constrained.push, constrained.entry, constrained.part, self.count, self.parts]
        warp_package().launch(kernels.collect, len(constrained.part_body), inputs=sums, device=self.engine.device)

    def _checked(self, state: LatticeState) -> LatticeState:
        engine = self.engine
        reach = 1e3 * (np.ptp(engine.lattice.points, axis=0).max() + engine.lattice.spacing_mm)
        if not (np.isfinite(state.velocity).all() and np.abs(state.position - engine.lattice.points).max() < reach):
            limit = explicit_step_limit(engine.lattice, engine.parameters)
            raise ConvergenceError(
                f"the explicit steps of {engine.step:g} s diverged within {self.taken} steps; the springs and dashpots allow about "
                f"{limit:.2g} s: take shorter steps, or method='implicit', which is stable for all parameters"
            )
        return state


def require_no_indenters(indenters: Sequence[RigidIndenter]) -> None:
    """Refuse indenters.

    Raises
    ------
    InputError
        There are some.
    """
    if indenters:
        raise InputError(
            f"indenters has {len(indenters)} entries: contact is computed by LatticeEngine (device 'cpu') only; constrain the nodes "
            "that they touch instead, or use that engine"
        )


def _check_state(lattice: Lattice, state: LatticeState) -> None:
    require_no_contact(state)
    n, m = lattice.n_nodes, lattice.n_elements
    for name, array, shape in (
        ("position", state.position, (n, 3)),
        ("velocity", state.velocity, (n, 3)),
        ("extension", state.extension, (m,)),
        ("length", state.length, (m,)),
    ):
        if array is None:
            continue
        if np.shape(array) != shape:
            raise InputError(f"the {name} of the state has shape {np.shape(array)}, the lattice needs {shape}")
        require_numbers(np.asarray(array), f"the {name} of the state")
