"""Lattices in motion on an NVIDIA GPU, through NVIDIA Warp: the steps of `naibu.mechanics.lattices.cpu.engine`, to rounding (spec L1).

Warp is an optional package (``pip install "naibu[gpu]"``). It also compiles for the processor, slower than `LatticeEngine`, which is how
the steps are tested where there is no GPU.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError, InputError
from naibu.mechanics.lattices.gpu.device_arrays import (
    ConstrainedArrays,
    NeighbourLists,
    alike_elements,
    chosen_device,
    compiled,
    recorded,
    warp_package,
)
from naibu.mechanics.lattices.gpu.implicit_stepper import ImplicitSteps
from naibu.mechanics.lattices.model.coefficients import explicit_coefficients, implicit_coefficients
from naibu.mechanics.lattices.model.lattice import Lattice, LatticeParameters, require_positive
from naibu.mechanics.lattices.model.state import (
    STEP_S,
    ConstrainedNodes,
    LatticeState,
    Method,
    Motion,
    checked_velocity,
    explicit_step_limit,
    require_constrained,
    require_numbers,
)

_CHUNK = 256  # steps for which velocities and reactions have room on the device
_AT_ONCE = 16  # steps that the device is given at once


@dataclass(frozen=True, slots=True, eq=False)
class WarpLatticeEngine:
    """A lattice on a device of Warp, prepared for steps of one length by one method.

    Attributes
    ----------
    lattice : Lattice
        Masses and elements.
    parameters : LatticeParameters
        Of the elements.
    step : float
        s.
    method : str
        As in `LatticeEngine`.
    tolerance : float
        Of the implicit solver, relative to the residual that the old velocity leaves.
    device : warp device
        Where it moves.
    lists : NeighbourLists
        Elements by mass.
    row, table, stiffness : warp array
        Numbers of the rows of coefficients of the elements, these rows, and K of each.
    mass, inverse_mass : warp array
        kg and 1/kg.
    """

    lattice: Lattice
    parameters: LatticeParameters
    step: float
    method: Method
    tolerance: float
    device: Any
    lists: NeighbourLists
    row: Any
    table: Any
    stiffness: Any
    mass: Any
    inverse_mass: Any

    @classmethod
    def of(
        cls,
        lattice: Lattice,
        parameters: LatticeParameters,
        *,
        step: float = STEP_S,
        method: Method = "implicit",
        precision: Literal["double", "single"] = "double",
        tolerance: float = 1e-2,
        device: str | None = None,
    ) -> WarpLatticeEngine:
        """Prepare a lattice.

        Parameters
        ----------
        lattice, parameters : Lattice, LatticeParameters
            What moves.
        step : float
            s.
        method, precision, tolerance
            As of `LatticeEngine`. The implicit solver works in double precision throughout.
        device : str
            ``"cuda:0"``, ``"cpu"``, ...; by default the current CUDA device, and the processor where there is none.

        Raises
        ------
        MissingDependencyError
            Warp is not installed.
        InputError
            A step or tolerance that is not positive, parameters of another lattice, an unknown method, precision or device, or single
            precision with the implicit method.
        """
        _check(lattice, parameters, step, method, precision, tolerance)
        place, wp = chosen_device(device), warp_package()
        real, row4 = (wp.float32, wp.vec4f) if precision == "single" else (wp.float64, wp.vec4d)
        lists = NeighbourLists.of(lattice, place)
        codes, rows = alike_elements(parameters)
        coefficients = implicit_coefficients(rows, step) if method == "implicit" else _explicit_rows(rows, step, method == "euler")
        mass = lattice.node_mass
        return cls(
            lattice,
            parameters,
            float(step),
            method,
            float(tolerance),
            place,
            lists,
            wp.array(lists.at_both_ends(codes, codes.dtype.type), device=place),
            wp.array(np.stack(coefficients, axis=1), dtype=row4, device=place),
            wp.array(rows.stiffness, dtype=real, device=place),
            wp.array(mass, dtype=real, device=place),
            wp.array(np.divide(1.0, mass, out=np.zeros_like(mass), where=mass > 0.0), dtype=real, device=place),
        )

    def rest(self) -> LatticeState:
        """Return the lattice at rest, without any force."""
        return LatticeState(self.lattice.points.copy(), np.zeros_like(self.lattice.points), np.zeros(self.lattice.n_elements))

    def session(
        self, state: LatticeState | None = None, constrained: ConstrainedNodes | None = None, external_force: ArrayLike | None = None
    ) -> LatticeSession:
        """Put a state on the device, from which it is moved on as often as wanted.

        Parameters
        ----------
        state : LatticeState
            Where it begins, by default at rest; unchanged.
        constrained : ConstrainedNodes
            Masses that bodies move.
        external_force : array_like
            Forces on the masses that do not change, mN, broadcast to (n, 3).

        Raises
        ------
        InputError
            Shapes that do not fit, or NaN.
        """
        return LatticeSession.of(self, state or self.rest(), constrained or ConstrainedNodes.none(), external_force)

    def run(
        self,
        state: LatticeState,
        steps: int,
        constrained: ConstrainedNodes | None = None,
        velocity: ArrayLike = 0.0,
        external_force: ArrayLike | None = None,
    ) -> Motion:
        """Take steps as `LatticeEngine.run` does; the state goes to the device and back.

        Raises
        ------
        InputError
            Shapes that do not fit, or NaN.
        ConvergenceError
            The explicit method blew up.
        """
        session = self.session(state, constrained, external_force)
        reaction = session.advance(steps, velocity)
        return Motion(session.state(), reaction, session.iterations / max(steps, 1), session.rotation_limited)

    def energy(self, state: LatticeState) -> float:
        """Return kinetic energy plus that of the springs, mN mm; free of supports and forces it never grows by implicit steps."""
        kinetic = 0.5 * float((self.lattice.node_mass * (state.velocity**2).sum(axis=1)).sum())
        return kinetic + 0.5 * float((self.parameters.stiffness * state.extension**2).sum())


@dataclass(slots=True, eq=False)
class LatticeSession:
    """A lattice that moves on a device, where its state stays.

    Attributes
    ----------
    engine : WarpLatticeEngine
        Lattice, parameters and method.
    constrained : ConstrainedArrays
        Held masses.
    x, v, f, external : warp array
        Position (mm), velocity (mm/s), force and external force (mN) of the masses; the last may be empty.
    y : warp array
        Extensions, mm, at both ends of the elements.
    path, parts, count : warp array
        Velocities of the bodies and forces of parts of held masses in the coming steps, and the number of those taken.
    taken : int
        Steps so far.
    iterations : int
        Iterations of the solver so far.
    held_back : int
        Steps in which the stretching by rotation was held back, see `Motion`.
    """

    engine: WarpLatticeEngine
    constrained: ConstrainedArrays
    x: Any
    v: Any
    f: Any
    external: Any
    y: Any
    path: Any
    parts: Any
    count: Any
    taken: int = 0
    iterations: int = 0
    rotation_limited: int = 0
    implicit: ImplicitSteps | None = None
    _many: Callable[[], None] | None = field(default=None, repr=False)

    @classmethod
    def of(
        cls, engine: WarpLatticeEngine, state: LatticeState, constrained: ConstrainedNodes, external_force: ArrayLike | None
    ) -> LatticeSession:
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

    def advance(self, steps: int, velocity: ArrayLike = 0.0) -> FloatArray:
        """Take steps in place and return the forces (steps, bodies, 3), mN, that the bodies exert.

        Parameters
        ----------
        steps : int
            How many.
        velocity : array_like
            Velocity of the bodies, mm/s, broadcast to (steps, bodies, 3).

        Raises
        ------
        InputError
            Shapes that do not fit, or NaN.
        """
        path = checked_velocity(velocity, steps, self.constrained.bodies)
        reaction = np.zeros(path.shape)
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
            The explicit method blew up.
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
                f"the explicit steps of {engine.step:g} s blew up within {self.taken} steps; the springs and dampers allow about "
                f"{limit:.2g} s: take shorter steps, or method='implicit', which is stable for all parameters"
            )
        return state


def _explicit_rows(parameters: LatticeParameters, step: float, forward: bool) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    a, b, d, g = explicit_coefficients(parameters)
    if not forward:  # the tension follows the extension after the step, as positions follow the velocity after it
        a, b = a + b * d * step, b * (1.0 - g * step)
    return a, b, d * step, g * step


def _check(lattice: Lattice, parameters: LatticeParameters, step: float, method: str, precision: str, tolerance: float) -> None:
    require_positive(step, "the step", "s")
    require_positive(tolerance, "the tolerance", "")
    if tolerance >= 1.0:
        raise InputError(f"the tolerance is a share of the residual and must be below 1, not {tolerance:g}")
    if len(parameters.stiffness) != lattice.n_elements:
        raise InputError(f"there are parameters for {len(parameters.stiffness)} elements, the lattice has {lattice.n_elements}")
    if method not in ("implicit", "euler", "symplectic_euler"):
        raise InputError(f"methods are 'implicit', 'euler' and 'symplectic_euler', not {method!r}")
    if precision not in ("double", "single"):
        raise InputError(f"precision is 'double' or 'single', not {precision!r}")
    if precision == "single" and method == "implicit":
        raise InputError("the implicit method needs precision='double' on a GPU; single precision is for the explicit methods")


def _check_state(lattice: Lattice, state: LatticeState) -> None:
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
