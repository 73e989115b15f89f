"""Identification by matching measured marker positions: Gauss-Newton on whitened residuals with exact sensitivities.

Unknowns are the parameters of the materials and of friction, shared by all experiments; the boundary conditions of every state; where the
base lies below the markers; and the rigid pose of the object in every loaded scan. All are estimated together, so that the covariance
of the materials' parameters includes what the nuisances cost.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from naibu.core.errors import ConvergenceError, InputError
from naibu.core.parameters import Parameter, ParameterSet
from naibu.core.solution import Status
from naibu.identification.lattice import FILLED_SD_MM
from naibu.identification.names import base_offset, straight_base
from naibu.identification.pose import Pose, registration
from naibu.identification.specimen import Specimen
from naibu.mechanics.linear_solvers import LinearSolver, use_one_thread
from naibu.mechanics.sensitivities import sensitivities
from naibu.mechanics.statics import Newton, Solution, SolverSettings, solve

Array = NDArray[np.float64]
_PATH = SolverSettings(first_step=0.06, largest_step=0.15, tolerance=1e-6)


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Standard deviation of a measured coordinate, mm: placing of the marker's centre, and quantisation to pixels and slices."""

    placing_mm: float = 0.1

    def standard_deviation(self, xy_step_mm: float, z_step_mm: float) -> Array:
        """Return the standard deviation (3,) along x, y, z, mm."""
        steps = np.array([xy_step_mm, xy_step_mm, z_step_mm])
        return np.sqrt(self.placing_mm**2 + steps**2 / 12.0)


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """One measured state of a specimen.

    Attributes
    ----------
    specimen : Specimen
        The meshed experiment.
    state : str
        Name of the state.
    measured : ndarray, shape (k, 3)
        Positions in the scan's frame, true mm; NaN where missing.
    sd : ndarray, shape (3,)
        Standard deviation of a measured coordinate of the loaded state, mm.
    free_sd : ndarray, shape (k, 3)
        That of the free state; larger where a coordinate was completed from the lattice.
    """

    specimen: Specimen
    state: str
    measured: Array
    sd: Array
    free_sd: Array

    @property
    def label(self) -> str:
        """``experiment/state``."""
        return f"{self.specimen.experiment.name}/{self.state}"

    @classmethod
    def of(cls, specimen: Specimen, state: str, noise: NoiseModel) -> Trial:
        """Gather the measured positions (true mm in the scan's frame) of a state, in the order of the specimen's markers.

        Raises
        ------
        InputError
            The state has no positions, or fewer than four markers in common with the free state.
        """
        experiment = specimen.experiment
        markers = experiment.state(state).markers
        if markers is None:
            raise InputError(f"{experiment.name}/{state} has no measured positions; give its file or leave the state out")
        measured = markers.aligned(specimen.marker_ids) * specimen.placement.scale
        if np.isfinite(measured).any(axis=1).sum() < 4:
            raise InputError(f"{experiment.name}/{state} shares fewer than 4 trusted markers with the free state")
        sd = noise.standard_deviation(experiment.xy_step_mm, experiment.z_step_mm)
        return cls(specimen, state, measured, sd, np.where(specimen.marker_filled, FILLED_SD_MM, sd))


@dataclass(frozen=True, slots=True, eq=False)
class TrialFit:
    """A trial at one set of parameters.

    Attributes
    ----------
    predicted : ndarray, shape (k, 3)
        Predicted positions in the scan's frame, true mm.
    residual : ndarray, shape (k, 3)
        Measured minus predicted, mm; NaN where not measured.
    sd : ndarray, shape (k, 3)
        Standard deviation of the residual from noise in both states, mm.
    jacobian : ndarray, shape (k, 3, p)
        Derivatives of `predicted` with respect to the physical values of the free parameters.
    pose_jacobian : ndarray, shape (k, 3, 6)
        Derivatives with respect to the pose.
    """

    solution: Solution
    pose: Pose
    predicted: Array
    residual: Array
    sd: Array
    jacobian: Array
    pose_jacobian: Array
    path: tuple[Array, ...]


@dataclass(frozen=True, slots=True)
class MatchingSettings:
    """How to search.

    Attributes
    ----------
    max_iterations : int
        Gauss-Newton iterations.
    tolerance : float
        The search ends when a step would change the objective by less than this (in units of chi squared).
    huber : float
        Residuals beyond this many standard deviations count linearly.
    """

    max_iterations: int = 25
    tolerance: float = 3e-2
    huber: float = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """Result of a search.

    Attributes
    ----------
    parameters : ParameterSet
        With the estimated values.
    covariance : ndarray, shape (p, p)
        Of the free parameters on the optimiser's scale, poses marginalised, scaled by the misfit where it exceeds the noise.
    fits : tuple of TrialFit
        One for each trial.
    chi_squared, degrees_of_freedom : float
        Noise-normalised sum of squares of the data, and number of data minus effective number of parameters.
    information : ndarray, shape (p, p)
        What the data alone (without priors) say about the free parameters.
    status : Status
    history : tuple of float
        Objective after every iteration.
    """

    parameters: ParameterSet
    covariance: Array
    fits: tuple[TrialFit, ...]
    chi_squared: float
    degrees_of_freedom: float
    information: Array
    status: Status
    history: tuple[float, ...]

    @property
    def noise_factor(self) -> float:
        """Root mean square residual in units of the stated noise."""
        return float(np.sqrt(self.chi_squared / max(self.degrees_of_freedom, 1.0)))


@dataclass(slots=True, eq=False)
class Matcher:
    """Trials and parameters, evaluated with warm starts along the search."""

    trials: Sequence[Trial]
    parameters: ParameterSet
    settings: MatchingSettings = field(default_factory=MatchingSettings)
    _solvers: dict[int, LinearSolver | None] = field(default_factory=dict)

    def evaluate(
        self, values: Mapping[str, float], previous: Sequence[TrialFit] | None = None, change: Array | None = None
    ) -> list[TrialFit]:
        """Solve all trials at `values`; `previous` fits and the `change` of the free physical values since then give the first guess.

        Raises
        ------
        ConvergenceError
            A trial cannot be solved at these values.
        """

        def one(i: int) -> TrialFit:
            return self._evaluate_one(i, values, previous[i] if previous else None, change)

        if len(self.trials) == 1:
            return [one(0)]
        with ThreadPoolExecutor(min(len(self.trials), os.cpu_count() or 1), initializer=use_one_thread) as pool:
            return list(pool.map(one, range(len(self.trials))))

    def _evaluate_one(self, index: int, values: Mapping[str, float], previous: TrialFit | None, change: Array | None) -> TrialFit:
        trial = self.trials[index]
        specimen = trial.specimen
        problem = specimen.problem(values, trial.state)
        hints: list[tuple[float, Array]] = []
        if previous is not None and change is not None:
            states = previous.solution.states[1:]
            hints = [(s.load, s.displacement + d @ change) for s, d in zip(states, previous.path[1:], strict=True)]
        try:
            solution = solve(problem, settings=_PATH, solver=self._solvers.get(index), hints=hints)
        except ConvergenceError as error:
            raise ConvergenceError(f"{trial.label}: {error}") from error
        newton = Newton(problem, _PATH, self._solvers.get(index))
        path = self._path_derivatives(trial, values, solution, newton)
        self._solvers[index] = newton.solver
        return self._observed(trial, values, solution, path, previous.pose if previous else None)

    def _path_derivatives(self, trial: Trial, values: Mapping[str, float], solution: Solution, newton: Newton) -> tuple[Array, ...]:
        """Derivatives (n, 3, p) of every state on the path with respect to the physical values of the free parameters."""
        free = self.parameters.free
        directions, owner = [], []
        for k, parameter in enumerate(free):
            found = trial.specimen.direction(parameter.name, values, trial.state)
            directions += found
            owner += [k] * len(found)
        gather = np.zeros((len(directions), len(free)))
        gather[np.arange(len(owner)), owner] = 1.0
        raw = sensitivities(newton.problem, solution.states, directions, newton=newton)
        return tuple(d @ gather for d in raw)

    def _observed(
        self, trial: Trial, values: Mapping[str, float], solution: Solution, path: tuple[Array, ...], pose: Pose | None
    ) -> TrialFit:
        specimen = trial.specimen.reshaped(values)
        u = specimen.observation @ solution.displacement
        gradient = specimen.deformation_gradient(solution.displacement)
        moved = specimen.marker_points + u
        if pose is None:
            pose = _first_pose(specimen, moved, trial.measured)
        predicted = pose.applied(moved)
        turned = np.einsum("ij,kjl->kil", pose.rotation, gradient)
        rotated = specimen.placement.rotation.T  # noise of the free scan, turned into the object's frame
        both = np.einsum("kij,jl->kil", turned, rotated)
        sd = np.sqrt(trial.sd**2 + np.einsum("kil,kl->ki", both**2, trial.free_sd**2))
        du = path[-1]
        n_free = du.shape[2]
        at_markers = np.stack([specimen.observation @ du[:, i, :] for i in range(3)], axis=1) if n_free else np.zeros((len(u), 3, 0))
        for k, parameter in enumerate(self.parameters.free):
            if parameter.name in (base_offset(specimen.experiment), straight_base(specimen.experiment)):
                at_markers[:, :, k] += gradient[:, :, 2]
            if (shift := trial.specimen.shift(parameter.name, values)) is not None:  # the nodes move past the markers, which stay
                at_markers[:, :, k] -= np.einsum("kij,kj->ki", gradient - np.eye(3), specimen.observation @ shift)
        jacobian = np.einsum("ij,kjp->kip", pose.rotation, at_markers)
        arm = predicted - pose.position
        pose_jacobian = np.zeros((len(u), 3, 6))
        pose_jacobian[:, :, :3] = np.eye(3)
        for axis in range(3):
            pose_jacobian[:, :, 3 + axis] = np.cross(np.eye(3)[axis], arm)
        return TrialFit(solution, pose, predicted, trial.measured - predicted, sd, jacobian, pose_jacobian, path)

    def normal_equations(self, fits: Sequence[TrialFit], inner: Array, *, robust: bool = True) -> tuple[Array, Array, float, Array]:
        """Return Hessian and gradient over (free parameters, poses), the objective, and the data's part of the Hessian."""
        free = self.parameters.free
        p, size = len(free), len(free) + 6 * len(fits)
        slope = np.array([q.slope(q.physical(x)) for q, x in zip(free, inner, strict=True)])
        hessian, gradient, objective = np.zeros((size, size)), np.zeros(size), 0.0
        for t, fit in enumerate(fits):
            seen = np.isfinite(fit.residual)
            r = (fit.residual / fit.sd)[seen]
            j = np.zeros((seen.sum(), size))
            j[:, :p] = (fit.jacobian * slope / fit.sd[:, :, None])[seen]
            j[:, p + 6 * t : p + 6 * t + 6] = (fit.pose_jacobian / fit.sd[:, :, None])[seen]
            c = self.settings.huber if robust else np.inf
            weight = np.minimum(1.0, c / np.maximum(np.abs(r), 1e-300))
            hessian += j.T @ (weight[:, None] * j)
            gradient += j.T @ (weight * r)
            objective += float(np.where(np.abs(r) <= c, r * r, 2.0 * c * np.abs(r) - c * c if np.isfinite(c) else 0.0).sum())
        data = hessian.copy()
        for k, q in enumerate(free):
            if np.isfinite(q.prior_sd):
                deviation = (inner[k] - q.inner(q.value)) / q.prior_sd
                hessian[k, k] += 1.0 / q.prior_sd**2
                gradient[k] -= deviation / q.prior_sd
                objective += deviation**2
        return hessian, gradient, objective, data

    def run(
        self, callback: Callable[[int, float, Mapping[str, float]], None] | None = None, *, start: Mapping[str, float] | None = None
    ) -> Match:
        """Search for the parameters; `callback(iteration, objective, values)` is called after every accepted step.

        The search starts from the parameters' own values, or from those in `start`.

        Raises
        ------
        ConvergenceError
            A trial cannot be solved at the starting values.
        """
        free = self.parameters.free
        inner = np.array([p.inner((start or {}).get(p.name, p.value)) for p in free])
        fits = self.evaluate(self.parameters.values(inner))
        hessian, gradient, objective, _ = self.normal_equations(fits, inner)
        history, damping, status = [objective], 1e-3, Status.ITERATION_LIMIT
        try:
            for iteration in range(self.settings.max_iterations):
                step = np.linalg.solve(hessian + damping * np.diag(np.diag(hessian) + 1e-12), gradient)
                step *= min(1.0, float(np.min(_limits(free) / np.maximum(np.abs(step[: len(free)]), 1e-300), initial=1.0)))
                expected = float(2.0 * gradient @ step - step @ hessian @ step)
                if expected < self.settings.tolerance * max(1.0, 0.01 * objective):
                    status = Status.CONVERGED
                    break
                found = self._try(inner, np.asarray(step, dtype=np.float64), fits, objective)
                if found is None:
                    damping = max(10.0 * damping, 0.05)
                    if damping > 1e6:
                        break
                    continue
                gained = objective - found[4]
                inner, fits, hessian, gradient, objective = found
                damping = max(damping / 10.0, 1e-8)
                history.append(objective)
                if callback is not None:
                    callback(iteration, objective, self.parameters.values(inner))
                if gained < 2.0 * self.settings.tolerance * max(1.0, 0.01 * objective):
                    status = Status.CONVERGED
                    break
        except KeyboardInterrupt:
            status = Status.INTERRUPTED
        return self._match(inner, fits, status, history)

    def _try(
        self, inner: Array, step: Array, fits: list[TrialFit], objective: float
    ) -> tuple[Array, list[TrialFit], Array, Array, float] | None:
        """Evaluate a step; None where it does not lower the objective or a trial cannot be solved."""
        free = self.parameters.free
        moved = inner + step[: len(free)]
        old, new = self.parameters.values(inner), self.parameters.values(moved)
        change = np.array([new[q.name] - old[q.name] for q in free])
        shifted = [
            TrialFit(
                f.solution,
                f.pose.moved(step[len(free) + 6 * t : len(free) + 6 * t + 6]),
                *[getattr(f, n) for n in ("predicted", "residual", "sd", "jacobian", "pose_jacobian", "path")],
            )
            for t, f in enumerate(fits)
        ]
        try:
            found = self.evaluate(new, shifted, change)
        except (ConvergenceError, InputError):  # InputError: a step that moves markers out of the object
            return None
        hessian, gradient, value, _ = self.normal_equations(found, moved)
        return (moved, found, hessian, gradient, value) if value < objective else None

    def _match(self, inner: Array, fits: list[TrialFit], status: Status, history: list[float]) -> Match:
        free = self.parameters.free
        p = len(free)
        hessian, _, _, data = self.normal_equations(fits, inner)
        chi_squared = float(sum(np.nansum((f.residual / f.sd) ** 2) for f in fits))
        n_data = int(sum(np.isfinite(f.residual).sum() for f in fits))
        effective = float(np.trace(np.linalg.solve(hessian, data)))
        dof = n_data - effective
        factor = max(1.0, chi_squared / max(dof, 1.0))
        covariance = np.asarray(np.linalg.inv(hessian)[:p, :p] * factor, dtype=np.float64)
        information = data[:p, :p] - data[:p, p:] @ np.linalg.solve(data[p:, p:], data[p:, :p])
        values = self.parameters.values(inner)
        return Match(
            self.parameters.with_values({q.name: values[q.name] for q in free}),
            covariance,
            tuple(fits),
            chi_squared,
            dof,
            information,
            status,
            tuple(history),
        )


def _limits(free: Sequence[Parameter]) -> Array:
    """Largest change of each free parameter in one step, on the optimiser's scale."""
    linear = [max(3.0, 0.5 * q.prior_sd) if np.isfinite(q.prior_sd) else np.inf for q in free]
    return np.array([{"log": 1.0, "incompressibility": 1.5}.get(q.scale, widest) for q, widest in zip(free, linear, strict=True)])


def _first_pose(specimen: Specimen, points: Array, measured: Array) -> Pose:
    """Pose that brings `points` to the `measured` ones; without data that of the free scan."""
    if np.isfinite(measured).all(axis=1).sum() >= 4:
        return registration(points, measured)
    place = specimen.placement
    centre = points.mean(axis=0)
    return Pose(place.rotation, centre, place.rotation @ centre + place.origin)
