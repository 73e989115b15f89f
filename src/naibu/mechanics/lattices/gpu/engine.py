"""Engine of lattices on an NVIDIA GPU through NVIDIA Warp: the steps of `LatticeEngine`, to rounding.

Warp is an optional package (``pip install "naibu[gpu]"``). It also compiles for the processor, slower than `LatticeEngine`, which is how
the steps are tested where there is no GPU.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from numpy.typing import ArrayLike

from naibu.mechanics.contact.rigid_indenters import RigidIndenter
from naibu.mechanics.lattices.gpu.prepared_lattice import PreparedLattice
from naibu.mechanics.lattices.gpu.session import WarpLatticeSession, require_no_indenters
from naibu.mechanics.lattices.model.state import (
    ConstrainedNodes,
    LatticeState,
    Motion,
    checked_velocity,
)


@dataclass(frozen=True, slots=True, eq=False)
class WarpLatticeEngine(PreparedLattice):
    """Engine of a lattice on a device of Warp; see `PreparedLattice` for its attributes, and `of` for how it is made."""

    def rest(self) -> LatticeState:
        """Return the lattice at rest, without any force."""
        return LatticeState.at_rest(self.lattice)

    def session(
        self,
        state: LatticeState | None = None,
        constrained: ConstrainedNodes | None = None,
        external_force: ArrayLike | None = None,
        indenters: Sequence[RigidIndenter] = (),
    ) -> WarpLatticeSession:
        """Put a state on the device, where a loop steps it.

        Parameters
        ----------
        state : LatticeState
            Where it begins, by default in the reference configuration; unchanged.
        constrained : ConstrainedNodes
            Nodes that bodies move.
        external_force : array_like
            Forces on the nodes that do not change, mN, broadcast to (n, 3).
        indenters : sequence of RigidIndenter
            None: contact is computed by `LatticeEngine` only.

        Raises
        ------
        InputError
            Shapes that do not fit, NaN, or indenters.
        """
        require_no_indenters(indenters)
        start = state or self.rest()
        return WarpLatticeSession.of(self, start, constrained or ConstrainedNodes.none(), external_force)

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
            The explicit method diverged.
        """
        session = self.session(state, constrained, external_force)
        reaction = session.take_path(checked_velocity(velocity, steps, session.constrained.bodies))
        return Motion(session.state(), reaction, session.iterations / max(steps, 1), session.rotation_limited)

    def energy(self, state: LatticeState) -> float:
        """Return kinetic energy plus that of the springs, mN mm; free of supports and forces it never grows by implicit steps."""
        kinetic = 0.5 * float((self.lattice.node_mass * (state.velocity**2).sum(axis=1)).sum())
        return kinetic + 0.5 * float((self.parameters.stiffness * state.extension**2).sum())
