"""Explicit steps of a lattice in contact with rigid indenters: elements as at the beginning of a step, contact as at its end.

The springs and dashpots give forces at the beginning of a step, and the contact is that of the implicit method with them as external
forces: unilateral, with friction, found together with the velocity at the end. The matrix is that of the masses and of what is touched;
elsewhere a step is the explicit one. For a linear lattice in contact that does not change, symplectic Euler steps are stable where
``h^2 K`` stays below ``4 M + 3 h^2 K_c``: contact K_c, however stiff, does not shorten the steps that the lattice itself allows, as it
would by a penalty at the beginning of the step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from naibu._numba.intrinsics.simd import WIDTH, aligned
from naibu.core.arrays import AnyFloatArray, FloatArray
from naibu.mechanics.lattices.cpu.element_blocks import Blocks, explicit_kernel
from naibu.mechanics.lattices.cpu.implicit.coarse_space import no_coarse_space
from naibu.mechanics.lattices.cpu.scratch import KernelTuple, ScratchPool
from naibu.mechanics.lattices.cpu.stepper import ExplicitStepper, ImplicitStepper
from naibu.mechanics.lattices.model.lattice import LatticeParameters

TOLERANCE = 1e-6  # of the solver: masses and touched faces are solved in few iterations


@dataclass(slots=True, eq=False)
class ElementForces:
    """Forces of the elements of a lattice that is stepped explicitly, as external forces of steps of its masses alone.

    Attributes
    ----------
    stepper : ExplicitStepper
        State of the lattice.
    parameters : LatticeParameters
        Of the elements.
    blocks : Blocks
        Their storage.
    force : ndarray, shape (3 pad,)
        At the beginning of the step, external ones included, mN; set by the steps.
    """

    stepper: ExplicitStepper
    parameters: LatticeParameters
    blocks: Blocks
    force: FloatArray

    def arguments(self, parts: int) -> KernelTuple:
        """Return what `contact_steps` takes of the elements for steps shorter by `parts` than those of the stepper."""
        own = self.stepper
        blocks, tables, _, _ = explicit_kernel(self.parameters, own.step / parts, self.blocks, own.kernel[2][0], 1, own.forward)
        return blocks, tables, own.extension, own.external

    def masses(self, parts: int) -> ImplicitStepper:
        """Return a stepper of the masses, without elements, under these forces; it shares position and velocity with the lattice."""
        own, mass = self.stepper, self.stepper.kernel[2][0]
        kernel, pool = _kernel_of_masses(mass)
        none, step = np.zeros(0), own.step / parts
        cuts, nodes = np.zeros(2, dtype=np.int64), np.array([0, len(mass)])
        division = (cuts, nodes, nodes[1:])
        return ImplicitStepper(
            own.position, own.velocity, none, none.copy(), kernel, pool.made(), self.force, step, mass, TOLERANCE, division
        )


def element_forces_of(stepper: ExplicitStepper, parameters: LatticeParameters, blocks: Blocks) -> ElementForces:
    """Return the forces of the elements of an explicit stepper."""
    return ElementForces(stepper, parameters, blocks, aligned(stepper.position.shape, float))


def no_elements() -> KernelTuple:
    """Return what `contact_steps` takes of the elements where steps are implicit."""
    none, empty = np.zeros(0, dtype=np.int64), aligned((0,), float)
    return (none, none, none), (empty, empty, empty, empty), empty, empty


def _kernel_of_masses(mass: AnyFloatArray) -> tuple[KernelTuple, ScratchPool]:
    """Return what implicit steps of masses without elements need."""
    single, none = np.float32, np.zeros(0, dtype=np.int64)
    smoother, light = aligned(mass.shape, single), aligned(mass.shape, single)
    smoother[:] = np.divide(1.0, mass, out=np.zeros_like(mass), where=mass > 0.0)
    light[:] = mass
    tables = tuple(aligned((WIDTH,), float) for _ in range(6))
    return ((none, none.copy(), none.copy()), tables), ScratchPool(aligned((WIDTH,), single), light, smoother, no_coarse_space(), 0)
