"""Sensitivities of a quasi-static solution to parameters, by direct differentiation along the load path :cite:p:`michaleris1994`.

At every converged state the residual ``r(u, a, p) = 0`` is differentiated once: one factorization of the consistent tangent and one solve
for each parameter. Friction depends on history through the anchors `a` of the contact points, whose derivatives are propagated from step
to step.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from naibu.core.arrays import FloatArray, IntArray
from naibu.core.rigid_transform import left_jacobian, rotation_matrix
from naibu.mechanics.contact.penalty_contact import Contact, ContactResponse
from naibu.mechanics.finite_elements.assembly import Assembler
from naibu.mechanics.finite_strain.nearby_contact import at_points, local_positions
from naibu.mechanics.finite_strain.newton import Newton
from naibu.mechanics.finite_strain.penalties import with_normal_stiffness
from naibu.mechanics.finite_strain.problem import Problem, SolverSettings
from naibu.mechanics.finite_strain.statics import LoadState
from naibu.mechanics.linear_algebra.direct import usable_threads, use_one_thread
from naibu.mechanics.linear_algebra.protocols import Factorization
from naibu.mechanics.linear_algebra.recycled_factors import RecycledFactors

MOST_AHEAD = 4  # states whose tangents are factorized at once: every one takes the memory of its factors


@dataclass(frozen=True, slots=True, eq=False)
class Direction:
    """A direction in the space of the data of a problem, along which its solution is differentiated; unset parts are zero.

    Attributes
    ----------
    materials : ndarray, shape (cells, 4), optional
        Change of the cells' parameters, kPa.
    law : int, optional
        Code of the law to which `materials` belong where that is not the cells' own: a strain energy that is added to theirs.
    contact : int
        Index of the contact to which the following belong.
    friction : ndarray, shape (p,), optional
        Change of the friction coefficient of every contact point.
    tangential_stiffness : ndarray, shape (p,), optional
        Change of the tangential stiffness, kPa/mm.
    start, stop : ndarray, shape (3,), optional
        Change of the ends of the body's path, mm.
    rotation : ndarray, shape (3,), optional
        Rotation of the body about its reference point, rad, before any tilt.
    tilt : ndarray, shape (3,), optional
        Change of the rotation that grows with the load, rad at full load.
    points : ndarray, shape (n, 3), optional
        Change of the nodes' positions in the reference configuration, mm.
    """

    materials: FloatArray | None = None
    law: int | None = None
    contact: int = -1
    friction: FloatArray | None = None
    tangential_stiffness: FloatArray | None = None
    start: FloatArray | None = None
    stop: FloatArray | None = None
    rotation: FloatArray | None = None
    tilt: FloatArray | None = None
    points: FloatArray | None = None


def sensitivities(
    problem: Problem, states: tuple[LoadState, ...], directions: list[Direction], *, newton: Newton | None = None
) -> list[FloatArray]:
    """Return, for every state of the path, the derivatives (n, 3, k) of the displacement along the k directions.

    Parameters
    ----------
    problem : Problem
        The problem solved.
    states : tuple of LoadState
        Its states along the load path, the reference configuration first.
    directions : list of Direction
        Directions of differentiation.
    newton : Newton, optional
        Solver of the load path, whose analysed linear solver is reused.

    Raises
    ------
    ConvergenceError
        The tangent at a state is singular.
    """
    solver = newton or Newton(problem, SolverSettings())
    count = len(directions)
    out = [np.zeros((*problem.points.shape, count))]
    problem, states, directions = _of_points_that_touch(problem, states, directions)
    reshaped = {k: _Reshaped.along(problem, d.points) for k, d in enumerate(directions) if d.points is not None}
    moving = [_BodyDirections.gather(i, c, directions) for i, c in enumerate(problem.contacts)]
    d_anchors = [m.at_rest(c) for m, c in zip(moving, problem.contacts, strict=True)]
    for state, (factorization, responses) in zip(states[1:], _linearised(solver, problem, states), strict=True):
        rhs = np.zeros((*problem.points.shape, count))
        for k, direction in enumerate(directions):
            if direction.materials is not None:
                rhs[:, :, k] = -_of_law(problem.assembler, direction.law).forces_of_parameter(state.displacement, direction.materials)
            if direction.points is not None:
                rhs[:, :, k] -= reshaped[k].forces(state.displacement)
        explicit = []
        for c, m, response, da in zip(problem.contacts, moving, responses, d_anchors, strict=True):
            change = m.explicit(c, response, da, state.load)
            explicit.append(change)
            for k in range(count):
                rhs[:, :, k] += c.scattered(change.force[:, :, k], len(rhs), response.orientation)
        rhs[problem.prescribed.constrained] = 0.0
        du = factorization.solve(rhs.reshape(-1, count)).reshape(rhs.shape)
        out.append(du)
        d_anchors = [
            change.anchors(c, response, np.einsum("pa,paik->pik", c.shape, du[c.nodes]))
            for c, response, change in zip(problem.contacts, responses, explicit, strict=True)
        ]
    return out


def _linearised(newton: Newton, problem: Problem, states: Sequence[LoadState]) -> Iterator[tuple[Factorization, list[ContactResponse]]]:
    """Yield the factorized tangent, which is valid until the next is asked for, and the contact responses at all states but the first.

    Where LU factors are exact and this thread may use others, those of the states ahead are computed meanwhile.
    """

    def at(solver: Newton, before: LoadState, state: LoadState) -> tuple[Factorization, list[ContactResponse]]:
        solver.problem = with_normal_stiffness(problem, state.normal_stiffness)
        return solver.linearised(state.displacement, before.anchors, state.load)[2:]

    first, *steps = pairwise(states)
    yield at(newton, *first)  # which chooses a linear solver
    count = min(usable_threads(), MOST_AHEAD, len(steps))
    if not isinstance(newton.solver, RecycledFactors) or count < 2:
        yield from (at(newton, *step) for step in steps)
        return
    solvers = [Newton(problem, replace(newton.settings, linear_solver="pardiso")) for _ in range(count)]
    with ThreadPoolExecutor(count, initializer=use_one_thread) as pool:
        jobs = [pool.submit(at, solver, *step) for solver, step in zip(solvers, steps, strict=False)]
        for k in range(len(steps)):
            yield jobs[k].result()
            if k + count < len(steps):  # the factors of state k are done with
                jobs.append(pool.submit(at, solvers[k % count], *steps[k + count]))


def _of_points_that_touch(
    problem: Problem, states: tuple[LoadState, ...], directions: list[Direction]
) -> tuple[Problem, tuple[LoadState, ...], list[Direction]]:
    """Return the same with those points only of every contact that touch in some state: of the others nothing depends."""
    some = []
    for c in problem.contacts:
        gaps = [local_positions(c, state.displacement, state.load)[1] for state in states[1:]]
        some.append(np.flatnonzero(np.min(gaps, axis=0, initial=np.inf) < 0.0) if not c.tied else np.arange(len(c.nodes)))
    contacts = tuple(at_points(c, points) for c, points in zip(problem.contacts, some, strict=True))
    on_path = tuple(
        replace(
            s,
            anchors=tuple(a[points] for a, points in zip(s.anchors, some, strict=True)),
            normal_stiffness=tuple(k[points] for k, points in zip(s.normal_stiffness, some, strict=False)),
        )
        for s in states
    )
    along = []
    for d in directions:
        if d.contact >= 0:
            points = some[d.contact]
            d = replace(d, friction=_at(d.friction, points), tangential_stiffness=_at(d.tangential_stiffness, points))
        along.append(d)
    return replace(problem, contacts=contacts, _positions=()), on_path, along


def _at(values: FloatArray | None, points: IntArray) -> FloatArray | None:
    return None if values is None else values[points]


def _of_law(assembler: Assembler, law: int | None) -> Assembler:
    """The assembler with one law in all cells; as it is where none is named."""
    return assembler if law is None else replace(assembler, law_codes=np.full_like(assembler.law_codes, law))


@dataclass(frozen=True, slots=True, eq=False)
class _Reshaped:
    """Elements with their reference nodes perturbed along a direction, forwards and backwards by `step`."""

    forward: Assembler
    backward: Assembler
    step: float

    @classmethod
    def along(cls, problem: Problem, change: FloatArray) -> _Reshaped:
        step = 1e-5 / max(float(np.abs(change).max()), 1e-12) * float(np.ptp(problem.points, axis=0).max())
        assembler = problem.assembler
        forward, backward = (assembler.with_elements(assembler.elements.moved(sign * step * change)) for sign in (1.0, -1.0))
        return cls(forward, backward, step)

    def forces(self, displacement: FloatArray) -> FloatArray:
        """Derivative (n, 3) of the internal forces at fixed displacement (central difference)."""
        return (self.forward.forces(displacement)[1] - self.backward.forces(displacement)[1]) / (2.0 * self.step)


@dataclass(frozen=True, slots=True, eq=False)
class _BodyDirections:
    """The parts of all directions that belong to one contact, stacked over the k directions."""

    friction: FloatArray
    stiffness: FloatArray
    start: FloatArray
    stop: FloatArray
    rotation: FloatArray
    tilt: FloatArray
    points: FloatArray

    @classmethod
    def gather(cls, index: int, contact: Contact, directions: list[Direction]) -> _BodyDirections:
        n, count = len(contact.area), len(directions)
        parts = cls(
            np.zeros((n, count)),
            np.zeros((n, count)),
            np.zeros((3, count)),
            np.zeros((3, count)),
            np.zeros((3, count)),
            np.zeros((3, count)),
            np.zeros((n, 3, count)),
        )
        for k, d in enumerate(directions):
            if d.points is not None:
                parts.points[:, :, k] = np.einsum("pa,pai->pi", contact.shape, d.points[contact.nodes])
            if d.contact != index:
                continue
            sources = (
                (parts.friction, d.friction),
                (parts.stiffness, d.tangential_stiffness),
                (parts.start, d.start),
                (parts.stop, d.stop),
                (parts.rotation, d.rotation),
                (parts.tilt, d.tilt),
            )
            for target, source in sources:
                if source is not None:
                    target[:, k] = source
        return parts

    def turning(self, contact: Contact, load: float) -> FloatArray:
        """Infinitesimal rotation vectors (3, k) of the body."""
        if contact.tilt is None:
            return self.rotation + load * self.tilt
        tilt = load * contact.tilt
        return np.asarray(rotation_matrix(tilt) @ self.rotation + load * left_jacobian(tilt) @ self.tilt)

    def moved(self, contact: Contact, world: FloatArray, load: float) -> FloatArray:
        """Change (p, 3, k) of local positions of points that stay at `world` (p, 3), relative to the body's reference point."""
        translation = self.start + load * (self.stop - self.start)
        turned = np.cross(self.turning(contact, load).T[None, :, :], world[:, None, :])
        change = self.points.transpose(0, 2, 1) - turned - translation.T[None, :, :]
        return np.asarray(np.einsum("pkj,ji->pik", change, contact.orientation(load)))

    def at_rest(self, contact: Contact) -> FloatArray:
        """Change (p, 3, k) of the anchors at the beginning of loading."""
        return self.moved(contact, contact.rest - contact.start, 0.0)

    def explicit(self, contact: Contact, response: ContactResponse, d_anchors: FloatArray, load: float) -> _Explicit:
        """Change of local positions, tractions and forces at fixed nodes."""
        local = self.moved(contact, response.local @ response.orientation.T, load)
        area = contact.area[:, None, None]
        slipping = (response.slip_direction != 0.0).any(axis=1)
        by_stiffness = np.where(slipping[:, None], 0.0, response.tangential / contact.tangential_stiffness[:, None])
        known = (
            np.einsum("pij,pjk->pik", response.anchor_stiffness, d_anchors)
            + response.slip_direction[:, :, None] * self.friction[:, None, :]
        )
        known -= area * by_stiffness[:, :, None] * self.stiffness[:, None, :]
        force = known - np.einsum("pij,pjk->pik", response.stiffness, local)
        turned = np.cross(self.turning(contact, load).T[None, :, :], (response.force @ response.orientation.T)[:, None, :])
        force += np.einsum("pkj,ji->pik", turned, response.orientation)
        return _Explicit(local, -known / area, force, self.stiffness)


@dataclass(frozen=True, slots=True, eq=False)
class _Explicit:
    """Changes (p, 3, k) at fixed nodes: local positions, friction traction but for its dependence on them, point forces."""

    local: FloatArray
    traction: FloatArray
    force: FloatArray
    stiffness: FloatArray

    def anchors(self, contact: Contact, response: ContactResponse, d_points: FloatArray) -> FloatArray:
        """Change (p, 3, k) of the next step's anchors, ``a = y - t / k_t``, when the points also move by `d_points` (p, 3, k)."""
        local = self.local + np.einsum("pjk,ji->pik", d_points, response.orientation)
        traction = self.traction + np.einsum("pij,pjk->pik", response.tangential_stiffness, local)
        k_t = contact.tangential_stiffness[:, None, None]
        return np.asarray(local - traction / k_t + response.tangential[:, :, None] * self.stiffness[:, None, :] / k_t**2)
