"""Engine of mass-spring-dashpot lattices on the processor: explicit :cite:p:`hirai2008` and linear-implicit steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numba
import numpy as np
from numpy.typing import ArrayLike

from naibu._numba.intrinsics.simd import WIDTH, aligned
from naibu._numba.thread_pool import MOST_PARTS
from naibu.core.arrays import AnyFloatArray, FloatArray
from naibu.core.errors import ConvergenceError, InputError
from naibu.mechanics.contact.rigid_indenters import RigidIndenter
from naibu.mechanics.lattices.cpu.contact.explicit import element_forces_of
from naibu.mechanics.lattices.cpu.contact.stepper import PASSES, ContactStepper
from naibu.mechanics.lattices.cpu.element_blocks import Blocks, explicit_kernel, implicit_kernel
from naibu.mechanics.lattices.cpu.scratch import KernelTuple, Scratch, ScratchPool
from naibu.mechanics.lattices.cpu.session import LatticeSession
from naibu.mechanics.lattices.cpu.stepper import ExplicitStepper, ImplicitStepper, Stepper
from naibu.mechanics.lattices.model.contact_state import ContactState
from naibu.mechanics.lattices.model.contact_surface import ContactSurface
from naibu.mechanics.lattices.model.lattice import Lattice, LatticeParameters, require_positive
from naibu.mechanics.lattices.model.state import (
    STEP_S,
    ConstrainedNodes,
    LatticeState,
    Method,
    Motion,
    checked_velocity,
    explicit_step_limit,
    followed_lengths,
    require_constrained,
    require_no_contact,
    require_numbers,
)

THREADED_FROM = 20_000  # elements; below, one thread is faster than two that wait for each other
MOST_THREADS = 4  # by default; on 16 cores, 8 and 16 threads took 2.5 and 3.5 times as long as 4 (benchmarks/lattice_gpu.py, 65^3 nodes)


@dataclass(frozen=True, slots=True, eq=False)
class LatticeEngine:
    """Engine of a mass-spring-dashpot lattice on the processor, for steps of one length by one method.

    Attributes
    ----------
    lattice : Lattice
        Masses and elements.
    parameters : LatticeParameters
        Of the elements.
    step : float
        s.
    method : str
        ``"implicit"`` (default, stable for all parameters), ``"euler"`` (the report's explicit method) or ``"symplectic_euler"``
        (explicit; positions move by the new velocity, and the tension follows the extension that the old one leads to).
    blocks : Blocks
        Where elements are stored.
    tolerance : float
        Of the implicit solver, relative to the residual that the old velocity leaves.
    threads : int
        Threads of a step.
    kernel : tuple
        What the kernels read: blocks and tables of coefficients; of explicit methods also the masses and the parts of the threads.
    mass : ndarray, shape (pad,)
        Nodal masses, kg.
    scratch : ScratchPool
        Scratch arrays of the implicit method, a set for each thread that steps at a time.
    """

    lattice: Lattice
    parameters: LatticeParameters
    step: float
    method: Method
    blocks: Blocks
    tolerance: float
    threads: int
    kernel: KernelTuple
    mass: AnyFloatArray
    scratch: ScratchPool
    _surface: list[ContactSurface] = field(default_factory=list, repr=False)

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
        threads: int | None = None,
    ) -> LatticeEngine:
        """Prepare a lattice.

        Parameters
        ----------
        lattice, parameters : Lattice, LatticeParameters
            What moves.
        step : float
            s.
        method, precision : str
            See the attributes; explicit steps in single precision take half the time.
        tolerance : float
            Of the implicit solver: 0.01 changes displacements by some 1e-5, forces by 2e-5 of their size. Stability does not depend on it.
        threads : int
            Of a step; by default those of Numba, four at most, from 20 000 elements, else one. Results depend on them by rounding.

        Raises
        ------
        InputError
            A step, tolerance or number of threads that is not positive, parameters of another lattice, an unknown method or precision, or
            single precision with the implicit method.
        """
        _check(lattice, parameters, step, method, precision, tolerance, threads)
        kind = np.float32 if precision == "single" else np.float64
        blocks = Blocks.of(lattice)
        if threads is None:
            threads = min(numba.get_num_threads(), MOST_THREADS) if lattice.n_elements >= THREADED_FROM else 1
        pad = -(-lattice.n_nodes // WIDTH) * WIDTH + WIDTH
        mass = aligned((pad,), kind)
        mass[: lattice.n_nodes] = lattice.node_mass
        kernel, scratch = _kernel(lattice, parameters, step, method, blocks, mass, threads)
        return cls(lattice, parameters, float(step), method, blocks, float(tolerance), threads, kernel, mass, scratch)

    def rest(self) -> LatticeState:
        """Return the lattice at rest, without any force."""
        return LatticeState.at_rest(self.lattice)

    def session(
        self,
        state: LatticeState | None = None,
        constrained: ConstrainedNodes | None = None,
        external_force: ArrayLike | None = None,
        indenters: Sequence[RigidIndenter] = (),
    ) -> LatticeSession:
        """Begin a session, for loops that ask for a few steps at a time.

        Parameters
        ----------
        state : LatticeState
            Where it begins, by default in the reference configuration; copied.
        constrained : ConstrainedNodes
            Nodes that bodies move; see `LatticeSession.constrain`.
        external_force : array_like
            Forces on the nodes that do not change, mN, broadcast to (n, 3).
        indenters : sequence of RigidIndenter
            In contact with the lattice; see `LatticeSession.press`. Of a state in contact, the same ones again.

        Raises
        ------
        InputError
            Shapes that do not fit, NaN, constrained nodes that are not there, an indenter inside the object, other indenters than those of
            the state, or contact by ``"euler"`` or in single precision.
        """
        return LatticeSession.of(self, state, constrained, external_force, indenters)

    def run(
        self,
        state: LatticeState,
        steps: int,
        constrained: ConstrainedNodes | None = None,
        velocity: ArrayLike = 0.0,
        external_force: ArrayLike | None = None,
    ) -> Motion:
        """Take steps, and return the state at their end and all reactions.

        Parameters
        ----------
        state : LatticeState
            Where they begin; unchanged.
        steps : int
            How many.
        constrained : ConstrainedNodes
            Nodes that bodies move.
        velocity : array_like
            Velocity of the bodies, mm/s, broadcast to (steps, bodies, 3).
        external_force : array_like
            Forces on the nodes that do not change, mN, broadcast to (n, 3).

        Raises
        ------
        InputError
            Shapes that do not fit, or NaN.
        ConvergenceError
            The explicit method diverged.
        """
        constrained = constrained or ConstrainedNodes.none()
        bodies = int(constrained.body.max(initial=-1)) + 1
        path = checked_velocity(velocity, steps, bodies)
        require_no_contact(state)
        require_constrained(constrained, self.lattice.n_nodes)
        reaction = np.zeros(path.shape)
        with self.scratch() as scratch:
            stepper = self.stepper(state, external_force, scratch)
            stepper.constrain((constrained.node, constrained.direction, constrained.weight, constrained.body), path.shape[1])
            iterations, rotation_limited = stepper.advance(path, reaction)
            stepper.close()
        self.check(stepper, steps)
        return Motion(self.state(stepper), reaction, iterations / max(steps, 1), rotation_limited)

    def stepper(self, state: LatticeState, external_force: ArrayLike | None = None, scratch: Scratch | None = None) -> Stepper:
        """Return a stepper that begins at a state, with scratch arrays of its own unless some are lent.

        Raises
        ------
        InputError
            Arrays of other shapes, or NaN.
        """
        x, v, y = self.stored(state)
        external = aligned((0,), x.dtype)
        if external_force is not None:
            force = np.broadcast_to(np.asarray(external_force, dtype=float), self.lattice.points.shape)
            require_numbers(force, "external_force")
            external = self.by_component(force, x.dtype)
        if self.method != "implicit":
            return ExplicitStepper(x, v, y, None, self.kernel, external, self.step, self.method == "euler")
        own, division = scratch or self.scratch.made(), self.blocks.parts(min(self.threads, MOST_PARTS), len(self.mass))
        return ImplicitStepper(
            x, v, y, self.stored_lengths(state), self.kernel, own, external, self.step, self.mass, self.tolerance, division
        )

    def surface(self) -> ContactSurface:
        """Return the faces that indenters may touch; found when they are first asked for."""
        if not self._surface:
            self._surface.append(ContactSurface.of(self.lattice, self.parameters))
        return self._surface[0]

    def in_contact(
        self, stepper: Stepper, indenters: Sequence[RigidIndenter], contact: ContactState, passes: int = PASSES
    ) -> ContactStepper:
        """Return what takes the steps of a stepper with indenters beside the lattice; the contact state is copied.

        Raises
        ------
        InputError
            Explicit steps that move nodes by the velocity before them, or single precision.
        """
        if isinstance(stepper, ImplicitStepper):
            return ContactStepper.of(stepper, indenters, contact, self.surface(), self.divided, passes)
        assert isinstance(stepper, ExplicitStepper)
        if self.method == "euler":
            raise InputError(
                "contact needs method='implicit' or 'symplectic_euler', which move nodes by the velocity with which they stop at an "
                "indenter, not 'euler'"
            )
        if self.mass.dtype != np.float64:
            raise InputError("contact needs precision='double', not 'single'")
        forces = element_forces_of(stepper, self.parameters, self.blocks)
        masses = forces.masses(1)
        masses.constrain(stepper.constrained, stepper.bodies)
        return ContactStepper.of(masses, indenters, contact, self.surface(), lambda _, parts: forces.masses(parts), passes, forces)

    def divided(self, stepper: ImplicitStepper, parts: int) -> ImplicitStepper:
        """Return a stepper of the same arrays whose steps are shorter by a whole number."""
        kernel, scratch = implicit_kernel(self.lattice, self.parameters, self.step / parts, self.blocks, self.mass, 1)
        return replace(stepper, kernel=kernel, scratch=scratch.made(), step=self.step / parts)

    def energy(self, state: LatticeState) -> float:
        """Return kinetic energy plus that of the springs, mN mm; free of supports and forces it never grows."""
        kinetic = 0.5 * float((self.lattice.node_mass * (state.velocity**2).sum(axis=1)).sum())
        return kinetic + 0.5 * float((self.parameters.stiffness * state.extension**2).sum())

    def stored(self, state: LatticeState) -> tuple[AnyFloatArray, AnyFloatArray, AnyFloatArray]:
        """Return position, velocity (3 pad,) and extension (8 nb,) as the kernels hold them, copied.

        Raises
        ------
        InputError
            Arrays of other shapes, or NaN.
        """
        n, m = self.lattice.n_nodes, self.lattice.n_elements
        for name, array, shape in (
            ("position", state.position, (n, 3)),
            ("velocity", state.velocity, (n, 3)),
            ("extension", state.extension, (m,)),
        ):
            if np.shape(array) != shape:
                raise InputError(f"the {name} of the state has shape {np.shape(array)}, the lattice needs {shape}")
            require_numbers(np.asarray(array), f"the {name} of the state")
        kind = self.mass.dtype
        y = aligned((WIDTH * self.blocks.n_blocks,), kind)
        y[self.blocks.lane] = state.extension
        return self.by_component(state.position, kind), self.by_component(state.velocity, kind), y

    def stored_lengths(self, state: LatticeState) -> FloatArray:
        """Return the lengths that the extensions followed (8 nb,), as kernels hold them."""
        known = followed_lengths(self.lattice, state)
        if np.shape(known) != (self.lattice.n_elements,):
            raise InputError(f"the length of the state has shape {np.shape(known)}, the lattice has {self.lattice.n_elements} elements")
        lengths: FloatArray = aligned((WIDTH * self.blocks.n_blocks,), float)
        lengths[self.blocks.lane] = known
        return lengths

    def read(self, x: AnyFloatArray, v: AnyFloatArray, y: AnyFloatArray) -> LatticeState:
        """Return the state that arrays of the kernels hold."""
        n = self.lattice.n_nodes
        position, velocity = (np.ascontiguousarray(a.reshape(3, -1)[:, :n].T, dtype=np.float64) for a in (x, v))
        return LatticeState(position, velocity, y[self.blocks.lane].astype(np.float64))

    def by_component(self, values: FloatArray, kind: np.dtype[np.floating] | type[float]) -> AnyFloatArray:
        """Return values of the nodes (n, 3) as kernels hold them, (3 pad,)."""
        result: AnyFloatArray = aligned((3 * len(self.mass),), kind)
        result.reshape(3, -1)[:, : len(values)] = values.T
        return result

    def state(self, stepper: Stepper) -> LatticeState:
        """Return a copy of the state that a stepper has reached."""
        found = self.read(stepper.position, stepper.velocity, stepper.extension)
        return found if stepper.length is None else replace(found, length=stepper.length[self.blocks.lane])

    def check(self, stepper: Stepper, steps: int) -> None:
        """Check that explicit steps did not diverge; the implicit ones cannot.

        Raises
        ------
        ConvergenceError
            They did.
        """
        if self.method == "implicit":
            return
        n, points = self.lattice.n_nodes, self.lattice.points
        reach = 1e3 * (np.ptp(points, axis=0).max() + self.lattice.spacing_mm)
        moved = np.abs(stepper.position.reshape(3, -1)[:, :n] - points.T).max()
        if not (np.isfinite(stepper.velocity).all() and moved < reach):
            limit = explicit_step_limit(self.lattice, self.parameters)
            raise ConvergenceError(
                f"the explicit steps of {self.step:g} s diverged within {steps} steps; the springs and dashpots allow about {limit:.2g} s: "
                "take shorter steps, or method='implicit', which is stable for all parameters"
            )


def _kernel(
    lattice: Lattice, parameters: LatticeParameters, step: float, method: Method, blocks: Blocks, mass: AnyFloatArray, threads: int
) -> tuple[KernelTuple, ScratchPool]:
    if method == "implicit":
        return implicit_kernel(lattice, parameters, step, blocks, mass, min(threads, MOST_PARTS))
    return explicit_kernel(parameters, step, blocks, mass, min(threads, MOST_PARTS), method == "euler"), ScratchPool.empty()


def _check(
    lattice: Lattice, parameters: LatticeParameters, step: float, method: str, precision: str, tolerance: float, threads: int | None
) -> None:
    require_positive(step, "the step", "s")
    require_positive(tolerance, "the tolerance", "")
    if tolerance >= 1.0:
        raise InputError(f"the tolerance is a fraction of the residual and must be below 1, not {tolerance:g}")
    if len(parameters.stiffness) != lattice.n_elements:
        raise InputError(f"there are parameters for {len(parameters.stiffness)} elements, the lattice has {lattice.n_elements}")
    if method not in ("implicit", "euler", "symplectic_euler"):
        raise InputError(f"methods are 'implicit', 'euler' and 'symplectic_euler', not {method!r}")
    if precision not in ("double", "single"):
        raise InputError(f"precision is 'double' or 'single', not {precision!r}")
    if precision == "single" and method == "implicit":
        raise InputError("the implicit method solves in single precision already; give precision='double', or an explicit method")
    if threads is not None and threads < 1:
        raise InputError(f"the number of threads must be positive, not {threads}")


def with_parameters(engine: LatticeEngine, parameters: LatticeParameters) -> LatticeEngine:
    """Return the engine for other parameters of the same lattice.

    Raises
    ------
    InputError
        Parameters of another lattice.
    """
    precision: Literal["double", "single"] = "single" if engine.mass.dtype == np.float32 else "double"
    _check(engine.lattice, parameters, engine.step, engine.method, precision, engine.tolerance, engine.threads)
    kernel, scratch = _kernel(engine.lattice, parameters, engine.step, engine.method, engine.blocks, engine.mass, engine.threads)
    return replace(engine, parameters=parameters, kernel=kernel, scratch=scratch, _surface=[])
