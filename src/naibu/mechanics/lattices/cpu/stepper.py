"""Steppers of lattices, explicit and implicit, with the state in the layout of the kernels; used by engines and sessions."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import numpy as np

from naibu._numba.thread_pool import ALONE, PARTS, STOP, new_control, start_workers, stop_workers
from naibu.core.arrays import AnyFloatArray, FloatArray, IntArray
from naibu.mechanics.lattices.cpu._explicit_kernels import explicit_steps, explicit_worker
from naibu.mechanics.lattices.cpu._implicit_kernels import implicit_steps
from naibu.mechanics.lattices.cpu.scratch import KernelTuple, Scratch

MOST_ITERATIONS = 20_000


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
    data: KernelTuple = ()

    def constrain(self, entries: KernelTuple, bodies: int) -> None:
        """Constrain nodes from now on."""
        self.close()
        blocks, tables, masses, parts = self.kernel
        count = len(parts[0]) - 1
        order = np.argsort(entries[0], kind="stable")
        constrained = tuple(np.ascontiguousarray(values[order]) for values in entries)
        mine = np.searchsorted(constrained[0], parts[1])
        kind = self.position.dtype.type
        driven = (np.zeros((bodies, 3)), np.zeros((count, bodies, 3)))
        state, how = (self.position, self.velocity, self.extension), (kind(self.step), self.forward)
        forces = np.zeros((count, len(self.position)), kind)
        self.data = (blocks, (*parts, mine), tables, state, masses, self.external, constrained, driven, forces, how)
        self.control = new_control(count)
        if count > 1:  # returns at once, compiled, lest workers compile while steps wait
            stop_workers(self.control)
            explicit_worker(self.control, self.data)

    def advance(self, velocity: FloatArray, reaction: FloatArray, *, alone: bool = False) -> tuple[int, int]:
        """Take steps and fill the reactions."""
        if self.control[STOP]:  # closed in between; workers may still be on their way out
            self.control = new_control(int(self.control[PARTS]))
        if alone:
            self.control[ALONE] = max(self.control[ALONE], len(velocity))
        start_workers(explicit_worker, self.control, self.data)
        explicit_steps(self.control, self.data, velocity, reaction)
        return 0, 0

    def close(self) -> None:
        """Stop the workers."""
        stop_workers(self.control)


@dataclass(slots=True, eq=False)
class ImplicitStepper(Stepper):
    """Implicit steps with scratch arrays of their own."""

    kernel: KernelTuple
    scratch: Scratch
    external: AnyFloatArray
    step: float
    mass: AnyFloatArray
    tolerance: float
    constrained: KernelTuple = ()

    def constrain(self, entries: KernelTuple, bodies: int) -> None:
        """Constrain nodes from now on."""
        self.constrained = entries

    def advance(self, velocity: FloatArray, reaction: FloatArray, *, alone: bool = False) -> tuple[int, int]:
        """Take steps and fill the reactions."""
        (blocks, tables), (work, inner) = self.kernel, self.scratch
        state, solver = (self.position, self.velocity, self.extension, self.length), (self.tolerance, MOST_ITERATIONS)
        reaction[:] = 0.0
        found: tuple[int, int] = implicit_steps(
            blocks, tables, state, self.mass, self.external, work, inner, self.constrained, velocity, self.step, solver, reaction
        )
        return found

    def close(self) -> None:
        """There are no workers to send away."""
