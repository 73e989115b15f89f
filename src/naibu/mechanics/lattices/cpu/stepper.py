"""Steppers of lattices, explicit and implicit, with the state in the layout of the kernels; used by engines and sessions."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from naibu._numba.intrinsics.packed_tuples import packed
from naibu._numba.intrinsics.simd import aligned
from naibu._numba.thread_pool import IDLE, PARTS, STOP, new_control, start_workers, stop_workers
from naibu.core.arrays import AnyFloatArray, FloatArray, IntArray
from naibu.mechanics.lattices.cpu._explicit_kernels import explicit_steps, explicit_worker
from naibu.mechanics.lattices.cpu.implicit._implicit_kernels import implicit_steps
from naibu.mechanics.lattices.cpu.implicit._solver_parts import OPERATOR, POOL
from naibu.mechanics.lattices.cpu.implicit._step_parts import implicit_worker
from naibu.mechanics.lattices.cpu.scratch import KernelTuple, PackedArguments, Scratch, new_sums, solver_entries

MOST_ITERATIONS = 20_000
_EXPLICIT_CALL, IMPLICIT_CALL = 64, 8  # steps of a call of a kernel with workers


@dataclass(slots=True, eq=False)
class Stepper(ABC):
    """Base of steppers: a state in the layout of the kernels, and how it is advanced.

    Attributes
    ----------
    position, velocity : ndarray, shape (3 pad,)
        x, y and z of all nodes one after the other, mm and mm/s.
    extension, length : ndarray, shape (8 nb,)
        Of the elements, as blocks store them, mm; explicit methods leave the lengths alone.
    """

    position: AnyFloatArray
    velocity: AnyFloatArray
    extension: AnyFloatArray
    length: FloatArray | None

    @abstractmethod
    def constrain(self, entries: KernelTuple, bodies: int) -> None:
        """Constrain nodes from now on: node, direction, weight and body of every constrained component."""

    @abstractmethod
    def advance(self, velocity: FloatArray, reaction: FloatArray, *, alone: bool = False) -> tuple[int, int]:
        """Take steps and fill the reactions, (steps, bodies, 3) both; return iterations and how often rotation was limited.

        If `alone`, no worker is asked.
        """

    @abstractmethod
    def close(self) -> None:
        """Stop the workers, if there are any."""


@dataclass(slots=True, eq=False)
class ExplicitStepper(Stepper):
    """Explicit steps, in parts that workers can take."""

    kernel: KernelTuple
    external: AnyFloatArray
    step: float
    forward: bool
    control: IntArray = field(default_factory=lambda: new_control(1))
    data: PackedArguments = ()
    constrained: KernelTuple = ()
    bodies: int = 0

    def constrain(self, entries: KernelTuple, bodies: int) -> None:
        """Constrain nodes from now on."""
        self.close()
        self.constrained, self.bodies = entries, bodies
        blocks, tables, masses, parts = self.kernel
        count = len(parts[0]) - 1
        order = np.argsort(entries[0], kind="stable")
        constrained = tuple(np.ascontiguousarray(values[order]) for values in entries)
        mine = np.searchsorted(constrained[0], parts[1])
        kind = self.position.dtype.type
        driven = (np.zeros((bodies, 3)), np.zeros((count, bodies, 3)))
        state, how = (self.position, self.velocity, self.extension), (kind(self.step), self.forward)
        forces = np.zeros((count, len(self.position)), kind)
        self.data = packed(blocks, (*parts, mine), tables, state, masses, self.external, constrained, driven, forces, how)
        self.control = new_control(count)
        if count > 1:  # returns at once, compiled, lest workers compile while steps wait
            stop_workers(self.control)
            explicit_worker(self.control, self.data)

    def advance(self, velocity: FloatArray, reaction: FloatArray, *, alone: bool = False) -> tuple[int, int]:
        """Take steps and fill the reactions."""
        if self.control[STOP]:  # closed in between; workers may still be on their way out
            self.control = new_control(int(self.control[PARTS]))
        for own in calls(self.control, alone, len(velocity), _EXPLICIT_CALL):
            start_workers(explicit_worker, self.control, self.data)
            explicit_steps(self.control, self.data, velocity[own], reaction[own])
        return 0, 0

    def close(self) -> None:
        """Stop the workers."""
        stop_workers(self.control)


@dataclass(slots=True, eq=False)
class ImplicitStepper(Stepper):
    """Implicit steps with scratch arrays of their own, in parts that workers can take.

    Attributes
    ----------
    division : tuple of ndarray
        Blocks, nodes and reached nodes of the parts, of `Blocks.parts`.
    """

    kernel: KernelTuple
    scratch: Scratch
    external: AnyFloatArray
    step: float
    mass: AnyFloatArray
    tolerance: float
    division: KernelTuple
    constrained: KernelTuple = ()
    control: IntArray = field(default_factory=lambda: new_control(1))
    data: PackedArguments = ()
    _weight: FloatArray = field(default_factory=lambda: np.zeros(0))
    _pool: KernelTuple = ()
    _entries: KernelTuple = ()

    def constrain(self, entries: KernelTuple, bodies: int) -> None:
        """Constrain nodes from now on."""
        self.close()
        self.constrained = entries = tuple(np.ascontiguousarray(values) for values in entries)
        inner, (cuts, nodes, high) = self.scratch[1], self.division
        count, own, pool = len(high), entries, inner[POOL]
        if count > 1:
            order = np.argsort(entries[0], kind="stable")
            own = tuple(np.ascontiguousarray(values[order]) for values in entries)
            rows = tuple(aligned((count, len(self.position)), kind) for kind in (np.float64, np.float32))
            pool = (new_control(count), (cuts, nodes, high, np.searchsorted(own[0], nodes)), *rows, *new_sums(count))
        self.control, self._pool, self._weight = pool[0], pool, own[2]
        self._entries = solver_entries(own[0], own[1], own[3])
        self.data = self.arguments(pool, inner[OPERATOR], self._entries)
        if count > 1:  # returns at once, compiled, lest workers compile while steps wait
            stop_workers(self.control)
            implicit_worker(self.control, self.data)

    def arguments(self, pool: KernelTuple, operator: KernelTuple, entries: KernelTuple) -> PackedArguments:
        """Return what the kernels of a step read, with a pool of threads, what contact adds, and what is constrained with its speeds."""
        (blocks, tables), (work, inner) = self.kernel, self.scratch
        before, right = (aligned(self.position.shape, float) for _ in range(2))
        solver = (blocks, tables, self.mass, self.velocity, work, (*inner[:OPERATOR], operator, pool), entries)
        return packed(solver, (self.position, self.extension, self.length, before, right, self.external, self.step))

    def contact_arguments(self, operator: KernelTuple) -> tuple[PackedArguments, FloatArray, IntArray]:
        """Return what kernels of steps in contact read, the weights of what is constrained, and the control of workers of their own."""
        control = new_control(int(self.control[PARTS]))
        return self.arguments((control, *self._pool[1:]), operator, self._entries), self._weight, control

    def advance(self, velocity: FloatArray, reaction: FloatArray, *, alone: bool = False) -> tuple[int, int]:
        """Take steps and fill the reactions."""
        reaction[:] = 0.0
        limits, found = (self.tolerance, MOST_ITERATIONS), np.zeros(2, dtype=np.int64)
        if self.control[STOP]:  # closed in between; workers may still be on their way out
            self.control = new_control(int(self.control[PARTS]))
            self._pool = (self.control, *self._pool[1:])
            self.data = self.arguments(self._pool, self.scratch[1][OPERATOR], self._entries)
        for own in calls(self.control, alone, len(velocity), IMPLICIT_CALL):
            start_workers(implicit_worker, self.control, self.data)
            found += implicit_steps(self.data, self._weight, velocity[own], limits, reaction[own])
        return int(found[0]), int(found[1])

    def close(self) -> None:
        """Stop the workers."""
        stop_workers(self.control)


def calls(control: IntArray, alone: bool, steps: int, most: int) -> Iterator[slice]:
    """Divide steps into calls of a kernel, between which workers can begin."""
    control[IDLE] = alone
    size = steps if alone or control[PARTS] == 1 else most
    for begin in range(0, max(steps, 1), max(size, 1)):
        yield slice(begin, min(begin + size, steps))
