"""Sensitivities of the states of all load cases, tangent linear and adjoint, and the Fisher information of the moduli.

The unknowns of the search are theta = (ln mu of all zones, ln(kappa / mu) of all zones) and the displacement b_t of the loaded components
of every load case. Every real theta is admissible. With the factorized tangent of a load case,

    du_F = -K_FF^-1 (C dtheta + K_FB db),    du_B = db,

where the columns of C are the nodal forces of a relative change of one modulus (forces are linear in the moduli, whatever the law). The
adjoint takes one solve with the same factor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sp

from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError
from naibu.core.mesh import Mesh
from naibu.core.progress import Progress, report_progress
from naibu.identification.from_fields.forward.field_laws import FieldElements, FieldLaw, LawName, computed_mesh, field_law
from naibu.identification.from_fields.forward.forward_model import Observed, Solvers, equilibrium, loaded_from_rest
from naibu.identification.from_fields.forward.load_cases import FieldLoadCase, Zones, is_surface_sought
from naibu.identification.from_fields.forward.loaded_components import (
    AN_ITERATION,
    BOUNDARY_TOLERANCE,
    REFRESHED,
    ROUGH_TOLERANCE,
    BoundaryPreconditioner,
    KeptPreconditioners,
    Solved,
    WithEquilibrium,
    alike,
    conjugate_gradients,
    in_blocks,
    local_preconditioner,
)
from naibu.identification.from_fields.forward.modulus_columns import modulus_columns
from naibu.identification.from_fields.forward.refinement import Refinement
from naibu.mechanics.linear_algebra.protocols import Factorization

FIRST_TOLERANCE = 1e-4  # of the motion of the surface with which a search at finite strain begins
TOLD = 10  # products of a linearisation from one report to the next: of thousands of cells and many columns, some seconds
Gradient = tuple[FloatArray, list[FloatArray]]  # with respect to theta, and to the sought displacements of every load case


def moduli_of(zones: Zones, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return lambda and mu of every cell (m,), kPa, from ln mu, then ln(kappa / mu), of all zones (2 count,); inf beyond all numbers."""
    with np.errstate(over="ignore", invalid="ignore"):
        shear, ratio = np.exp(theta.reshape(2, -1))
        return zones.per_cell(shear * (ratio - 2.0 / 3.0), shear)


def logarithms(lame: FloatArray, shear: FloatArray) -> FloatArray:
    """Return ln mu, then ln(kappa / mu) (2 k,), of Lame parameters (k,), kPa."""
    return np.asarray(np.log(np.concatenate([shear, lame / shear + 2.0 / 3.0])))


def young_and_poisson(theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return Young's modulus (k,), kPa, and Poisson's ratio (k,) from ln mu, then ln(kappa / mu) (2 k,)."""
    shear, ratio = np.exp(theta.reshape(2, -1))
    return 9.0 * ratio * shear / (3.0 * ratio + 1.0), (3.0 * ratio - 2.0) / (6.0 * ratio + 2.0)


@dataclass(frozen=True, slots=True, eq=False)
class Point:
    """A point of the search with its states.

    Attributes
    ----------
    theta : ndarray, shape (2 count,)
        ln mu, then ln(kappa / mu), of all zones; moduli in kPa.
    states : tuple of ndarray, shape (n, d)
        Displacement of every load case in equilibrium, mm; those of the loaded components are unknowns of the search.
    factors : tuple of Factorization
        Factorized tangent of every load case; valid until the next evaluation.
    misfit : float
        Sum of squares of the whitened differences from the measurements.
    prior : float
        Sum of squares of the weak prior on the loaded components.
    """

    theta: FloatArray
    states: tuple[FloatArray, ...]
    factors: tuple[Factorization, ...]
    misfit: float
    prior: float


class FieldModel:
    """All load cases of a body, evaluated and linearised at points of the search."""

    def __init__(
        self,
        mesh: Mesh,
        load_cases: Sequence[FieldLoadCase],
        zones: Zones,
        law: LawName = "linear",
        elements: FieldElements = "accurate",
        progress: Progress | None = None,
    ) -> None:
        self.mesh, self.zones, self.progress = mesh, zones, progress
        self.computed, self.averaged = computed_mesh(mesh, elements)
        self.law: FieldLaw = field_law(self.computed, law, averaged=self.averaged)
        self.observed = tuple(Observed.of(mesh, self.computed, load_case) for load_case in load_cases)
        self.solvers = Solvers(self.law, self.computed.points)
        self.boundary = KeptPreconditioners.none(self.observed)

    @property
    def points(self) -> FloatArray:
        """Nodes (n, d), mm, on which equilibrium is computed."""
        return self.computed.points

    @property
    def surface_sought(self) -> bool:
        """Whether forces may act on the whole surface of a body in space, whose motion is sought, in a load case."""
        return is_surface_sought(self.mesh, [o.load_case for o in self.observed])

    @property
    def n_data(self) -> int:
        """Number of measured components."""
        return sum(len(o.data) for o in self.observed)

    def on_all_nodes(self, u: FloatArray) -> FloatArray:
        """Return the displacement of all nodes (n, d), mm, from that of the given ones: mid-edge nodes lie half-way."""
        if self.computed is self.mesh:
            return u
        return Refinement.of(self.mesh).displacement(u)

    def with_zones(self, zones: Zones) -> FieldModel:
        """Return the model of the same load cases with other zones; solvers and preconditioners are shared."""
        out = object.__new__(FieldModel)
        out.__dict__.update(self.__dict__)
        out.zones = zones
        return out

    def with_law(self, law: LawName) -> FieldModel:
        """Return the model of the same load cases under the law of that name."""
        return self.under(field_law(self.computed, law, averaged=self.averaged))

    def under(self, law: FieldLaw) -> FieldModel:
        """Return the model of the same load cases under another law on the mesh on which equilibrium is computed."""
        out = object.__new__(FieldModel)
        out.__dict__.update(self.__dict__)
        out.law = law
        out.solvers = Solvers(out.law, self.points)
        out.boundary = KeptPreconditioners.none(self.observed)
        return out

    @property
    def n_free(self) -> float:
        """Number of measured components less the number of loaded ones that they determine: what remains to determine moduli.

        Before a first point was found, as if all loaded components were determined.
        """
        return self.n_data - sum(len(o.unknown) if i is None else i for o, i in zip(self.observed, self.boundary.informed, strict=True))

    def evaluate(self, theta: FloatArray, guesses: Sequence[FloatArray]) -> Point:
        """Find the equilibrium of all load cases; `guesses` (n, d), mm, hold the displacement of the loaded components, and help elsewhere.

        Raises
        ------
        ConvergenceError
            A load case finds no equilibrium.
        """
        lame, shear = moduli_of(self.zones, theta)
        if not (np.isfinite(lame).all() and np.isfinite(shear).all()):
            raise ConvergenceError("moduli are beyond all bounds")
        states, factors = self._states(lame, shear, guesses)
        misfit = sum(float(np.sum(o.residual(u) ** 2)) for o, u in zip(self.observed, states, strict=True))
        loaded = [o.sought(u) for o, u in zip(self.observed, states, strict=True)]
        prior = sum(float(b @ (o.prior @ b)) for o, b in zip(self.observed, loaded, strict=True))
        return Point(theta, tuple(states), tuple(factors), misfit, prior)

    def _states(self, lame: FloatArray, shear: FloatArray, guesses: Sequence[FloatArray]) -> tuple[list[FloatArray], list[Factorization]]:
        states, factors = [], []
        shared: dict[bytes, Factorization] = {}
        for t, (o, guess) in enumerate(zip(self.observed, guesses, strict=True)):
            key = np.packbits(o.load_case.loaded).tobytes()
            if self.law.linear and key in shared:  # one matrix for all load cases that are loaded at the same nodes
                residual = self.law.forces(lame, shear, guess) - o.load_case.external_force
                residual[o.load_case.loaded] = 0.0
                u, factor = guess - shared[key].solve(residual.ravel()).reshape(guess.shape), shared[key]
            else:
                u, factor = equilibrium(self.law, self.solvers, lame, shear, o.load_case, guess, b"" if self.law.linear else b"%d" % t)
                shared[key] = factor
            states.append(u)
            factors.append(factor)
        return states, factors

    def from_rest(self, theta: FloatArray, moved: Sequence[FloatArray], *, at_length: bool = True) -> list[FloatArray]:
        """Return states (n, d), mm, reached in load steps, for displacements of the loaded components (n, d); see `loaded_from_rest`."""
        lame, shear = moduli_of(self.zones, theta)
        pairs = zip(self.observed, moved, strict=True)
        return [loaded_from_rest(self.law, self.points, lame, shear, o.load_case, u, at_length=at_length) for o, u in pairs]

    def linearised(self, point: Point) -> Linearised:
        """Linearise all load cases at a point."""
        lame, shear = moduli_of(self.zones, point.theta)
        for t, o in enumerate(self.observed):
            if len(o.unknown) <= REFRESHED:
                self.boundary.made[t] = None
        columns = [modulus_columns(self.law, self.zones, lame, shear, u) for u in point.states]
        stiffness: list[sp.bsr_matrix] = []
        for u in point.states:
            stiffness.append(stiffness[0] if self.law.linear and stiffness else self.law.stiffness(lame, shear, u))
        return Linearised(self, point, columns, stiffness)


@dataclass(slots=True, eq=False)
class Linearised:
    """The load cases' displacement as a linear function of changes of the unknowns, at one point of the search."""

    model: FieldModel
    point: Point
    columns: list[sp.csc_matrix]
    stiffness: list[sp.bsr_matrix]
    _transposed: list[sp.csr_matrix] = field(default_factory=list)
    _border: list[sp.csr_matrix] = field(default_factory=list)
    _gradient: Gradient | None = None
    _fresh: bool = False
    _own: dict[int, BoundaryPreconditioner] = field(default_factory=dict)  # made of the tangents at this very point
    _products: int = 0

    def __post_init__(self) -> None:
        self._transposed = [c.T for c in self.columns]
        rows: dict[tuple[int, bytes], sp.csr_matrix] = {}
        for o, matrix in zip(self.model.observed, self.stiffness, strict=True):
            key = id(matrix), o.loaded.tobytes()
            if key not in rows:
                rows[key] = (o.basis.T @ matrix.tocsr()[o.loaded]).tocsr()
            self._border.append(rows[key])

    def border(self, t: int) -> sp.csr_matrix:
        """Return the forces (n_b, n d), mN/mm, of load case `t` on all nodes for a unit of each of its sought displacements."""
        return self._border[t]

    def solved(self, right: list[FloatArray]) -> list[FloatArray]:
        """Solve with the tangents of all load cases, right-hand sides (n d, r) of load cases that share a factor together."""
        groups: dict[int, list[int]] = {}
        for t, factor in enumerate(self.point.factors):
            groups.setdefault(id(factor), []).append(t)
        out: list[FloatArray] = [np.empty(0)] * len(right)
        for members in groups.values():
            factor = self.point.factors[members[0]]
            widths = np.cumsum([0] + [right[t].shape[1] for t in members])
            x = in_blocks(factor, np.concatenate([right[t] for t in members], axis=1))
            for t, a, b in zip(members, widths[:-1], widths[1:], strict=True):
                out[t] = x[:, a:b]
        return out

    def forward(self, theta: FloatArray | None, loaded: Sequence[FloatArray] | None) -> list[FloatArray]:
        """Return the change of every load case's displacement (n d, r), mm, for changes of theta (2 count, r) and of b_t (n_b, r)."""
        right = []
        for t, o in enumerate(self.model.observed):
            b = None if loaded is None else loaded[t]
            force = 0.0 if b is None else self._border[t].T @ b
            if theta is not None:
                force = force + self.columns[t] @ theta
            force = -np.asarray(force)
            force[o.loaded] = 0.0
            right.append(force)
        moved = self.solved(right)
        for t, o in enumerate(self.model.observed):
            moved[t][o.loaded] = 0.0 if loaded is None else o.basis @ loaded[t]
        return moved

    def adjoint(self, gradients: list[FloatArray]) -> tuple[FloatArray, list[FloatArray]]:
        """Return what `forward` transposed makes of (n d, r) of every load case: (2 count, r) and a list of (n_b, r)."""
        right = [g.copy() for g in gradients]
        for o, g in zip(self.model.observed, right, strict=True):
            g[o.loaded] = 0.0
        theta, loaded = np.zeros((2 * self.model.zones.count, gradients[0].shape[1])), []
        for t, w in enumerate(self.solved(right)):
            o = self.model.observed[t]
            w[o.loaded] = 0.0
            theta -= self._transposed[t] @ w
            loaded.append(o.basis.T @ gradients[t][o.loaded] - self._border[t] @ w)
        return theta, loaded

    def gradient(self) -> Gradient:
        """Return the gradient of half the misfit and prior: (2 count,) and a list of (n_b,)."""
        if self._gradient is None:
            self._gradient = self.gradient_of([o.residual(u) for o, u in zip(self.model.observed, self.point.states, strict=True)])
        return self._gradient

    def gradient_of(self, residuals: Sequence[FloatArray]) -> Gradient:
        """Return the gradient if the whitened residuals (q,) of the load cases were these."""
        observed = self.model.observed
        theta, loaded = self.adjoint([(o.operator.T @ r)[:, None] for o, r in zip(observed, residuals, strict=True)])
        prior = [o.prior @ o.sought(u) for o, u in zip(observed, self.point.states, strict=True)]
        return theta[:, 0], [b[:, 0] + p for b, p in zip(loaded, prior, strict=True)]

    def product(self, theta: FloatArray, loaded: Sequence[FloatArray]) -> tuple[FloatArray, list[FloatArray]]:
        """Return the Gauss-Newton Hessian of half the misfit and prior times a vector; parts (2 count, r) and (n_b, r) as in `forward`."""
        self._tell()
        moved = self.forward(theta, loaded)
        out, at_loaded = self.adjoint([o.information @ u for o, u in zip(self.model.observed, moved, strict=True)])
        return out, [a + o.prior @ b for a, o, b in zip(at_loaded, self.model.observed, loaded, strict=True)]

    def preconditioned(self, loaded: Sequence[FloatArray]) -> list[FloatArray]:
        """Return about what the inverse of the Hessian of the loaded components makes of (n_b, r) of every load case."""
        made = [self.boundary(t) for t in range(len(loaded))]
        if not self._fresh:
            self.model.boundary.spent += sum(b.shape[1] + AN_ITERATION for b in loaded)
        groups: dict[int, list[int]] = {}
        for t, one in enumerate(made):
            groups.setdefault(id(one.factor), []).append(t)
        out: list[FloatArray] = [np.empty(0)] * len(loaded)
        for members in groups.values():
            solved = made[members[0]].factor.solve(np.concatenate([loaded[t] for t in members], axis=1))
            for t, x in zip(members, np.split(solved, np.cumsum([loaded[t].shape[1] for t in members])[:-1], axis=1), strict=True):
                out[t] = x / made[t].scale
        return out

    def boundary(self, t: int) -> BoundaryPreconditioner:
        """Return the preconditioner of the loaded components of load case `t`, made on first use and kept."""
        kept = self.model.boundary
        made, found = kept.made, kept.made[t]
        if found is None:
            twin = next((s for s in range(t) if made[s] is not None and alike(self.model.observed[s], self.model.observed[t])), None)
            shared = None if twin is None else made[twin]
            found = BoundaryPreconditioner.of(self, t) if shared is None or twin is None else shared.scaled(self.model.observed, twin, t)
            kept.keep(t, found)
            self._fresh = True
            if shared is None:
                self._own[t] = found
        return found

    def loaded_solved(self, right: Sequence[FloatArray]) -> list[FloatArray]:
        """Solve with the Hessian of the loaded components: (n_b, r) of every load case, by preconditioned conjugate gradients."""
        return self._loaded_solved(right, BOUNDARY_TOLERANCE).solution

    def loaded_solved_once(self, right: Sequence[FloatArray]) -> list[FloatArray]:
        """Solve as `loaded_solved`, roughly, for a few columns at a point at which nothing else is solved."""
        if all(len(o.unknown) <= REFRESHED for o in self.model.observed):
            return self.loaded_solved(right)
        try:
            local = [local_preconditioner(o) for o in self.model.observed]
            return conjugate_gradients(
                self._loaded_product, lambda r: [f.solve(b) for f, b in zip(local, r, strict=True)], list(right), FIRST_TOLERANCE
            ).solution
        except ConvergenceError:  # measurements far from the surface
            return self.loaded_solved(right)

    def renew_if_due(self, columns: int, tolerance: float = ROUGH_TOLERANCE) -> None:
        """Have preconditioners made at this point before systems of so many columns, where others have cost or would cost more."""
        if not self._fresh and self.model.boundary.is_due(columns, tolerance):
            self.model.boundary.forget()

    def _tell(self) -> None:
        self._products += 1
        if self._products % TOLD == 0:
            report_progress(self.model.progress, "solving for the motion of the surface, iteration", done=self._products)

    def _loaded_product(self, loaded: list[FloatArray]) -> list[FloatArray]:
        self._tell()
        moved = self.forward(None, loaded)
        pulled = [o.information @ u for o, u in zip(self.model.observed, moved, strict=True)]
        return [a + o.prior @ b for a, o, b in zip(self.adjoint(pulled)[1], self.model.observed, loaded, strict=True)]

    def _loaded_solved(self, right: Sequence[FloatArray], tolerance: float, near: Sequence[FloatArray] | None = None) -> Solved:
        self.renew_if_due(sum(b.shape[1] for b in right), tolerance)
        begin, kept = near, self.model.boundary
        anew = np.inf if self._fresh or None in kept.made else kept.anew
        try:
            solved = conjugate_gradients(self._loaded_product, self.preconditioned, list(right), tolerance, near, anew)
            if solved.complete:
                kept.pace = 0.0 if self._fresh else solved.pace
                return solved
            begin = solved.solution
        except ConvergenceError:  # the preconditioner is that of other moduli, too far from these
            begin = None
        kept.forget()
        return conjugate_gradients(self._loaded_product, self.preconditioned, list(right), tolerance, begin)

    def concentrated(
        self, basis: FloatArray, tolerance: float = BOUNDARY_TOLERANCE, near: Sequence[FloatArray] | None = None
    ) -> Concentrated:
        """Return half the misfit as a quadratic in changes of theta along `basis` (2 count, k), minimised over the loaded components.

        Hessian and gradient err by the square of what `tolerance`, a relative residual, leaves of the loaded components. `near` (n_b, k)
        is how these respond at a point near by. Systems of this point with equilibrium as a constraint tell the response at once.
        """
        self.renew_if_due(len(self.model.observed) * (basis.shape[1] + 1), tolerance)
        return self._with_equilibrium(basis, tolerance) or self._by_gradients(basis, tolerance, near)

    def _by_gradients(self, basis: FloatArray, tolerance: float, near: Sequence[FloatArray] | None) -> Concentrated:
        """Return what `concentrated` does, by conjugate gradients."""
        moved = self.forward(basis, None)
        pulls = [o.information @ u for o, u in zip(self.model.observed, moved, strict=True)]
        theta, loaded = self.gradient()
        cross = self.adjoint(pulls)[1]
        begin = near and [np.column_stack([x, np.zeros(len(x))]) for x in near]
        solved = self._loaded_solved([np.column_stack([c, g]) for c, g in zip(cross, loaded, strict=True)], tolerance, begin)
        response, offset = [x[:, :-1] for x in solved.solution], [x[:, -1] for x in solved.solution]
        # with the inverse A^-1 and the residual R = C - A X of a solution X: C' A^-1 C = C' X + X' R + R' A^-1 R
        left = [r[:, :-1] for r in solved.residual]
        parts = zip(moved, pulls, cross, response, left, strict=True)
        hessian = sum(u.T @ p - c.T @ x - x.T @ r for u, p, c, x, r in parts)
        gradient = basis.T @ theta - sum(x.T @ g + r.T @ y for x, g, r, y in zip(response, loaded, left, offset, strict=True))
        return Concentrated(np.asarray(0.5 * (hessian + hessian.T)), np.asarray(gradient), response, offset)

    def _with_equilibrium(self, basis: FloatArray, tolerance: float) -> Concentrated | None:
        """Return what `concentrated` does, by the systems of this point; None where there are none, or they are not exact."""
        made = [(t, self.boundary(t)) for t in range(len(self.columns))]
        own = [one.factor for t, one in made if one is self._own.get(t) and isinstance(one.factor, WithEquilibrium)]
        of_cases = zip(own, self.model.observed, self.columns, strict=True) if len(own) == len(made) else ()
        parts = [part for f, o, c in of_cases if (part := f.followed(o, c @ basis)) is not None]
        if len(parts) < len(made):
            return None
        theta, loaded = self.gradient()
        offset = [x[:, 0] for x in self._loaded_solved([g[:, None] for g in loaded], tolerance).solution]
        response = [x for _, x in parts]
        gradient = basis.T @ theta - sum(x.T @ g for x, g in zip(response, loaded, strict=True))
        return Concentrated(np.asarray(sum(h for h, _ in parts)), np.asarray(gradient), response, offset)

    def jacobians(self, quadratic: Concentrated) -> list[FloatArray]:
        """Return the derivatives (q, 2 count) of the whitened residuals of every load case, the loaded components following theta."""
        moved = self.forward(np.eye(2 * self.model.zones.count), [-x for x in quadratic.response])
        return [np.asarray(o.operator @ u) for o, u in zip(self.model.observed, moved, strict=True)]


@dataclass(frozen=True, slots=True, eq=False)
class Concentrated:
    """Half the misfit as a quadratic in k directions of the moduli, minimised over the displacement of the loaded components.

    Attributes
    ----------
    hessian : ndarray, shape (k, k)
        The Fisher information of the moduli, what the unknown forces cost taken off.
    gradient : ndarray, shape (k,)
        Gradient.
    response : list of ndarray, shape (n_b, k)
        By how much the loaded components follow, with a minus sign, mm.
    offset : list of ndarray, shape (n_b,)
        Distance from their present optimum, mm.
    """

    hessian: FloatArray
    gradient: FloatArray
    response: list[FloatArray]
    offset: list[FloatArray]

    def loaded(self, step: FloatArray) -> list[FloatArray]:
        """Return the change of the loaded components (n_b,) of every load case, mm, that goes with a step (k,)."""
        return [-(x @ step) - r for x, r in zip(self.response, self.offset, strict=True)]
