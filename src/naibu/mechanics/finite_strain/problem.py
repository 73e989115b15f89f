"""A static boundary value problem at finite strain, and the settings of its solution."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from naibu.core.arrays import FloatArray, Int32Array, require_shape
from naibu.mechanics.contact.penalty_contact import Contact
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_elements.boundary_conditions import PrescribedDisplacement
from naibu.mechanics.linear_algebra.solver_selection import SolverName


@dataclass(frozen=True, slots=True)
class SolverSettings:
    """Settings of incremental loading and of Newton's method.

    Attributes
    ----------
    first_step, largest_step, smallest_step : float
        Fractions of the whole load.
    tolerance : float
        Newton's method has converged when the residual is below this fraction of the contact and support forces.
    path_tolerance : float, optional
        The same before the full load, where a looser one suffices: only friction remembers these states. `tolerance` by default.
    max_iterations : int
        Most Newton iterations of one load step before it is halved.
    max_total_iterations : int, optional
        Newton iterations after which no further load step is begun; with a warm start also when those of 30 % more load than is reached are
        spent. None for no limit.
    pseudo_transient : bool
        Whether pseudo-transient continuation, which costs as much as many load steps, is tried where Newton's method fails even for small
        load steps: the body may snap through to another equilibrium.
    anchor_stiffness : float
        Stiffness of weak springs between every node and the ground, as a fraction of the mean diagonal of the tangent: they suppress
        rigid-body motions of a body that is not in contact yet.
    penetration : float
        Most that a rigid body may penetrate an element, as a fraction of the edge of its face; contact becomes stiffer until it holds.
    linear_solver : {"automatic", "superlu", "pardiso", "recycled_cholesky", "recycled_lu", "multigrid", "petsc"}
        See `naibu.mechanics.linear_algebra.solver_selection`.
    """

    first_step: float = 0.05
    largest_step: float = 0.12
    smallest_step: float = 1e-3
    tolerance: float = 1e-7
    path_tolerance: float | None = None
    max_iterations: int = 16
    max_total_iterations: int | None = None
    pseudo_transient: bool = True
    anchor_stiffness: float = 1e-9
    penetration: float = 0.01
    linear_solver: SolverName = "automatic"

    def tolerance_at(self, load: float) -> float:
        """Return the tolerance at a fraction of the load."""
        return self.tolerance if self.path_tolerance is None or load >= 1.0 - 1e-12 else self.path_tolerance


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """A static boundary value problem: mesh, materials, boundary conditions and loads.

    Attributes
    ----------
    points : ndarray, shape (n, 3)
        Nodes in the reference configuration, mm.
    assembler : Assembler
        Elements and materials; its pattern must include the contacts' couplings (`block_pattern` with their nodes).
    contacts : tuple of Contact
        Contacts with rigid bodies, and interfaces.
    prescribed : PrescribedDisplacement
        Dirichlet boundary conditions.
    external_force : ndarray, shape (n, 3)
        Dead load, mN, applied in full from the beginning (weight).

    Raises
    ------
    InputError
        Forces or boundary conditions for another number of nodes.
    """

    points: FloatArray
    assembler: Assembler
    contacts: tuple[Contact, ...]
    prescribed: PrescribedDisplacement
    external_force: FloatArray
    _positions: tuple[Int32Array, ...] = field(default=())

    def __post_init__(self) -> None:
        require_shape("external_force", self.external_force, self.points.shape)
        require_shape("prescribed.constrained", self.prescribed.constrained, self.points.shape)
        if not self._positions and self.contacts:
            object.__setattr__(self, "_positions", tuple(self.assembler.pattern.positions(c.nodes) for c in self.contacts))

    @property
    def unsymmetric(self) -> bool:
        """Whether Coulomb friction makes the tangent unsymmetric."""
        curved = any(not c.surface.flat for c in self.contacts)  # friction turns with the normal
        return (
            self.assembler.unsymmetric or curved or any(not c.tied and float(c.friction_coefficient.min()) < 100.0 for c in self.contacts)
        )

    def with_changes(self, *, assembler: Assembler | None = None, contacts: tuple[Contact, ...] | None = None) -> Problem:
        """Return the problem with other parameters or bodies (same nodes)."""
        return replace(self, assembler=assembler or self.assembler, contacts=contacts if contacts is not None else self.contacts)
