"""Finite element model updating (FEMU) with markers: Gauss-Newton on whitened residuals with exact sensitivities.

Computed positions are fitted to measured ones (:cite:p:`kavanagh1971,avril2008`) by damped Gauss-Newton steps (:cite:p:`marquardt1963`)
with robust weights (:cite:p:`huber1964`). Unknowns are the parameters of the materials and of friction, common to all experiments; the
boundary conditions of every state; the position of the base below the markers; and the rigid pose of the object in every loaded scan. All
are estimated together, so that the covariance of the material parameters includes the uncertainty of the others.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.cores import usable_cores
from naibu.core.errors import ConvergenceError, InputError
from naibu.core.parameters import ParameterSet
from naibu.core.progress import Progress, report_progress
from naibu.core.rigid_transform import RigidTransform, registration
from naibu.core.status import Status
from naibu.identification.from_markers.bounded_step import bounded_step, next_reach, step_limits
from naibu.identification.from_markers.observations import LoadCaseFit, MarkerLoadCase, SolvedLoadCase
from naibu.identification.from_markers.specimen.parameter_names import pixel_scale
from naibu.identification.from_markers.specimen.resting_state import resting_derivatives, resting_state
from naibu.identification.from_markers.specimen.specimen_model import Specimen
from naibu.mechanics.finite_strain.newton import Newton
from naibu.mechanics.finite_strain.penalties import with_normal_stiffness
from naibu.mechanics.finite_strain.problem import SolverSettings
from naibu.mechanics.finite_strain.sensitivities import Direction, sensitivities
from naibu.mechanics.finite_strain.statics import Solution, WarmStart, solve
from naibu.mechanics.linear_algebra.direct import use_one_thread
from naibu.mechanics.linear_algebra.protocols import LinearSolver

Checkpoint = Callable[[Mapping[str, float]], None]
UNEVEN = 0.01  # points that slip over an edge make the objective uneven; a step that promises less than this and fails ends the search
ENOUGH = 2  # steps in succession that gain less than that, and less than half of what they promise, after which the search ends
ROUGH = 0.1  # a search is rough while a step may lower the objective by more than this fraction
PATH = SolverSettings(first_step=0.02, largest_step=0.15, tolerance=1e-6, path_tolerance=1e-4)
NEARBY = replace(PATH, smallest_step=0.02, pseudo_transient=False)  # for a path close to a known one
REFINED = replace(PATH, smallest_step=0.004, pseudo_transient=False)  # for one known on larger elements
TRIAL_EFFORT = 1.2  # times the iterations of the last solution, which a step of the search may cost before it is given up
LEAST_EFFORT = 100  # iterations that a solution at least is taken to have cost


@dataclass(frozen=True, slots=True)
class MatchingSettings:
    """Settings of the Gauss-Newton search.

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
    """Result of a Gauss-Newton search.

    Attributes
    ----------
    parameters : ParameterSet
        With the estimated values.
    covariance : ndarray, shape (p, p)
        Of the free parameters on the optimiser's scale, poses marginalised, scaled by the misfit where it exceeds the noise.
    fits : tuple of LoadCaseFit
        One for each load case.
    chi_squared, degrees_of_freedom : float
        Noise-normalised sum of squares of the data, and number of data minus effective number of parameters.
    information : ndarray, shape (p, p)
        Fisher information of the data alone (without priors) about the free parameters.
    status : Status
    history : tuple of float
        Objective after every iteration.
    """

    parameters: ParameterSet
    covariance: FloatArray
    fits: tuple[LoadCaseFit, ...]
    chi_squared: float
    degrees_of_freedom: float
    information: FloatArray
    status: Status
    history: tuple[float, ...]

    @property
    def noise_factor(self) -> float:
        """Root mean square residual in units of the stated noise."""
        return float(np.sqrt(self.chi_squared / max(self.degrees_of_freedom, 1.0)))


@dataclass(frozen=True, slots=True, eq=False)
class NormalEquations:
    """The objective and its linearisation over the free parameters and the poses.

    Attributes
    ----------
    hessian : ndarray, shape (s, s)
        Of half of the objective, by Gauss and Newton.
    gradient : ndarray, shape (s,)
        Direction of steepest descent of half of the objective.
    objective : float
        Robust sum of squares, priors included.
    data : ndarray, shape (s, s)
        The data's part of `hessian`.
    bend : ndarray, shape (s,)
        Contribution of the curvature of the optimiser's scales to the diagonal of the Hessian where it stabilises: without it a modulus
        or a Poisson's ratio close to the end of its scale oscillates.
    """

    hessian: FloatArray
    gradient: FloatArray
    objective: float
    data: FloatArray
    bend: FloatArray


@dataclass(slots=True, eq=False)
class Matcher:
    """Load cases and parameters, evaluated with warm starts along the search."""

    load_cases: Sequence[MarkerLoadCase]
    parameters: ParameterSet
    settings: MatchingSettings = field(default_factory=MatchingSettings)
    _solvers: dict[int, LinearSolver | None] = field(default_factory=dict)
    _penalties: dict[int, tuple[FloatArray, ...]] = field(default_factory=dict)
    _effort: dict[int, int] = field(default_factory=dict)
    _resting: dict[int, Solution | None] = field(default_factory=dict)

    def evaluate(
        self,
        values: Mapping[str, float],
        warm_starts: Sequence[SolvedLoadCase | None] = (),
        poses: Sequence[RigidTransform | None] = (),
        *,
        trial: bool = False,
        derivatives: bool = True,
    ) -> list[LoadCaseFit]:
        """Solve all load cases at `values`, from `warm_starts` where given; `poses` replace those that register the markers best.

        A `trial` is given up early where it costs much more than the solutions before: a shorter step of the search costs less. Its fits
        have no derivatives, nor have others without `derivatives`; `differentiated` adds them.

        Raises
        ------
        ConvergenceError
            A load case cannot be solved at these values.
        """

        def one(i: int) -> LoadCaseFit:
            near = warm_starts[i] if warm_starts else None
            estimates, pose = near.warm_start(values) if near else [], poses[i] if poses else None
            settings, wanted = self._trial_settings(i, near, bool(estimates)) if trial else PATH, derivatives and not trial
            if near and near.between is not None:
                try:
                    return self._evaluate_one(i, values, estimates, pose, REFINED, derivatives=wanted)
                except ConvergenceError:
                    estimates = []
            return self._evaluate_one(i, values, estimates, pose, settings, derivatives=wanted, stiffness=near.stiffness if near else None)

        return self._side_by_side(one)

    def _side_by_side(self, one: Callable[[int], LoadCaseFit]) -> list[LoadCaseFit]:
        """Call a function with the number of every load case, on all cores."""
        if len(self.load_cases) == 1:
            return [one(0)]
        with ThreadPoolExecutor(min(len(self.load_cases), usable_cores()), initializer=use_one_thread) as pool:
            return list(pool.map(one, range(len(self.load_cases))))

    def _evaluate_one(
        self,
        index: int, values: Mapping[str, float], warm_start: Sequence[WarmStart], pose: RigidTransform | None, settings: SolverSettings,
        *, derivatives: bool, stiffness: Mapping[float, tuple[FloatArray, ...]] | None = None,
    ) -> LoadCaseFit:  # fmt: skip
        load_case = self.load_cases[index]
        # as stiff as contact had to be before: the objective does not jump, and no evaluation finds it anew
        problem = load_case.specimen.problem(values, load_case.state)
        problem = problem if stiffness else with_normal_stiffness(problem, self._penalties.get(index, ()))
        try:
            solution = solve(problem, settings=settings, solver=self._solvers.get(index), warm_start=warm_start, stiffness=stiffness)
        except ConvergenceError as error:
            raise ConvergenceError(f"{load_case.name}: {error}") from error
        self._effort[index] = solution.iterations
        resting = self._resting[index] = resting_state(solution, self._resting.get(index))
        newton = Newton(solution.problem, PATH, self._solvers.get(index))
        path = self._path_derivatives(load_case, values, solution, newton) if derivatives else ()
        self._solvers[index], self._penalties[index] = newton.solver, solution.states[-1].normal_stiffness
        return self._observed(load_case, values, solution, resting, path, pose)

    def _trial_settings(self, index: int, near: SolvedLoadCase | None, warm: bool) -> SolverSettings:
        """Settings of a step of the search: what a solution that starts from another one has not needed, it does without."""
        rescued, most = near is not None and near.fit.solution.continued > 0, TRIAL_EFFORT * max(self._effort.get(index, 0), LEAST_EFFORT)
        return replace(NEARBY if warm and not rescued else PATH, pseudo_transient=rescued, max_total_iterations=int(most))

    def differentiated(self, fits: Sequence[LoadCaseFit], values: Mapping[str, float]) -> list[LoadCaseFit]:
        """Return fits at `values` with derivatives with respect to the free parameters of this matcher; nothing is solved anew."""

        def one(i: int) -> LoadCaseFit:
            load_case, fit = self.load_cases[i], fits[i]
            newton = Newton(fit.solution.problem, PATH, self._solvers.get(i))
            path = self._path_derivatives(load_case, values, fit.solution, newton)
            return self._observed(load_case, values, fit.solution, fit.resting, path, fit.pose)

        return self._side_by_side(one)

    def _path_derivatives(
        self, load_case: MarkerLoadCase, values: Mapping[str, float], solution: Solution, newton: Newton
    ) -> tuple[FloatArray, ...]:
        """Derivatives (n, 3, p) of every state on the path with respect to the physical values of the free parameters."""
        directions, gather = self._directions(load_case, values)
        raw = sensitivities(newton.problem, solution.states, directions, newton=newton)
        return tuple(d @ gather for d in raw)

    def _directions(self, load_case: MarkerLoadCase, values: Mapping[str, float]) -> tuple[list[Direction], FloatArray]:
        """Directions of the load case, and which of them (k, p) each free parameter takes."""
        free = self.parameters.free
        directions, owner = [], []
        for k, parameter in enumerate(free):
            found = load_case.specimen.direction(parameter.name, values, load_case.state)
            directions += found
            owner += [k] * len(found)
        gather = np.zeros((len(directions), len(free)))
        gather[np.arange(len(owner)), owner] = 1.0
        return directions, gather

    def _observed(
        self,
        load_case: MarkerLoadCase,
        values: Mapping[str, float],
        solution: Solution,
        resting: Solution | None,
        path: tuple[FloatArray, ...],
        pose: RigidTransform | None,
    ) -> LoadCaseFit:
        specimen = load_case.specimen.reshaped(values)
        u = specimen.at_markers(solution.displacement - (0.0 if resting is None else resting.displacement))
        gradient = specimen.deformation_gradient(solution.displacement)
        moved = specimen.marker_points + u
        enlargement = specimen.enlargement(values)
        if pose is None:
            lifted = specimen.marker_points.mean(axis=0) - (load_case.specimen.marker_points * enlargement).mean(axis=0)
            pose = _first_pose(specimen, moved, load_case.measured * enlargement, lifted)
        placed = pose.applied(moved)
        predicted = placed / enlargement  # residuals stay in the file's millimetres: a smaller scale must not make them smaller
        turned = np.einsum("ij,kjl->kil", pose.rotation, gradient)
        rotated = specimen.placement.pose.rotation.T  # noise of the reference scan, turned into the object's frame
        both = np.einsum("kij,jl->kil", turned, rotated)
        sd = np.sqrt(load_case.sd**2 + np.einsum("kil,kl->ki", both**2, load_case.free_sd**2))
        if not path:
            return LoadCaseFit(
                solution, pose, predicted, load_case.measured - predicted, sd, np.zeros((*u.shape, 0)), np.zeros((*u.shape, 6)), path,
                resting,
            )  # fmt: skip
        du = path[-1]
        if resting is not None:
            directions, gather = self._directions(load_case, values)
            du = du - resting_derivatives(resting, directions) @ gather
        n_free = du.shape[2]
        at_markers = specimen.at_markers(du) if n_free else np.zeros((len(u), 3, 0))
        for k, parameter in enumerate(self.parameters.free):
            if (motion := load_case.specimen.marker_motion(parameter.name, values)) is not None:
                at_markers[:, :, k] += np.einsum("kij,kj->ki", gradient, motion)
            if (shift := load_case.specimen.shift(parameter.name, values)) is not None:  # the nodes move past the markers, which stay
                at_markers[:, :, k] -= np.einsum("kij,kj->ki", gradient - np.eye(3), specimen.at_markers(shift))
        jacobian = np.einsum("ij,kjp->kip", pose.rotation, at_markers)
        for k, parameter in enumerate(self.parameters.free):
            if parameter.name == pixel_scale(specimen.experiment):
                jacobian[:, :2, k] -= placed[:, :2] / values[parameter.name]
        jacobian /= enlargement[:, None]
        arm = placed - pose.position
        pose_jacobian = np.zeros((len(u), 3, 6))
        pose_jacobian[:, :, :3] = np.eye(3)
        for axis in range(3):
            pose_jacobian[:, :, 3 + axis] = np.cross(np.eye(3)[axis], arm)
        pose_jacobian /= enlargement[:, None]
        return LoadCaseFit(solution, pose, predicted, load_case.measured - predicted, sd, jacobian, pose_jacobian, path, resting)

    def normal_equations(self, fits: Sequence[LoadCaseFit], inner: FloatArray) -> NormalEquations:
        """Linearise the objective at some fits of the load cases and the free parameters that gave them, on the optimiser's scale."""
        free = self.parameters.free
        p, size = len(free), len(free) + 6 * len(fits)
        slope = np.array([q.slope(q.physical(x)) for q, x in zip(free, inner, strict=True)])
        hessian, gradient = np.zeros((size, size)), np.zeros(size)
        for t, fit in enumerate(fits):
            seen = np.isfinite(fit.residual)
            r = (fit.residual / fit.sd)[seen]
            j = np.zeros((seen.sum(), size))
            j[:, :p] = (fit.jacobian * slope / fit.sd[:, :, None])[seen]
            j[:, p + 6 * t : p + 6 * t + 6] = (fit.pose_jacobian / fit.sd[:, :, None])[seen]
            c = self.settings.huber
            weight = np.minimum(1.0, c / np.maximum(np.abs(r), 1e-300))
            hessian += j.T @ (weight[:, None] * j)
            gradient += j.T @ (weight * r)
        data = hessian.copy()
        bend = np.zeros(size)
        bend[:p] = np.maximum(-gradient[:p] * [q.bend for q in free], 0.0)
        for k, q in enumerate(free):
            if np.isfinite(q.prior_sd):
                deviation = (inner[k] - q.inner(q.value)) / q.prior_sd
                hessian[k, k] += 1.0 / q.prior_sd**2
                gradient[k] -= deviation / q.prior_sd
        return NormalEquations(hessian, gradient, self.objective(fits, inner), data, bend)

    def run(
        self,
        *,
        progress: Progress | None = None,
        checkpoint: Checkpoint | None = None,
        start: Mapping[str, float] | None = None,
        warm_starts: Mapping[str, SolvedLoadCase] | None = None,
    ) -> Match:
        """Search for the parameters; after every accepted step `checkpoint` gets the values found so far.

        `progress` gets a report before every step is tried, and after every accepted one.

        The search starts from the parameters' own values, or from those in `start`; `warm_starts` are solutions near the start, by the
        labels of their load cases.

        Raises
        ------
        ConvergenceError
            A load case cannot be solved at the starting values.
        """
        free = self.parameters.free
        inner = np.array([p.inner((start or {}).get(p.name, p.value)) for p in free])
        fits = self._starting_fits(self.parameters.values(inner), [(warm_starts or {}).get(t.name) for t in self.load_cases])
        now = self.normal_equations(fits, inner)
        history, damping, rough, status = [now.objective], 1e-3, True, Status.ITERATION_LIMIT
        reach, disappointed = 1.0, 0
        try:
            for iteration in range(self.settings.max_iterations):
                hessian = now.hessian + np.diag(now.bend)
                step = bounded_step(hessian + damping * np.diag(np.diag(hessian) + 1e-12), now.gradient, reach * step_limits(free, rough))
                expected = float(2.0 * now.gradient @ step - step @ hessian @ step)
                if rough and expected < ROUGH * now.objective:
                    rough = False
                    continue
                if expected < self.settings.tolerance * max(1.0, 0.01 * now.objective):
                    status = Status.CONVERGED
                    break
                report_progress(progress, "calibration", done=iteration, objective=now.objective)  # steps may be rejected for minutes
                found = self._try(inner, step, fits, now.objective)
                if found is None:
                    if expected < UNEVEN * now.objective:
                        status = Status.CONVERGED
                        break
                    damping, reach = max(10.0 * damping, 0.05), next_reach(reach, 0.0)
                    if damping > 1e6:
                        break
                    continue
                gained = now.objective - found[2].objective
                reach = next_reach(reach, gained / expected)
                disappointed = disappointed + 1 if gained < min(0.5 * expected, UNEVEN * now.objective) else 0
                inner, fits, now = found
                damping = max(damping / 10.0, 1e-8)
                history.append(now.objective)
                if checkpoint is not None:
                    checkpoint(self.parameters.values(inner))
                report_progress(progress, "calibration", done=iteration + 1, objective=now.objective)
                if disappointed == ENOUGH or gained < 2.0 * self.settings.tolerance * max(1.0, 0.01 * now.objective):
                    status = Status.CONVERGED
                    break
        except KeyboardInterrupt:
            status = Status.INTERRUPTED
        return self._match(inner, fits, status, history)

    def _starting_fits(self, values: Mapping[str, float], warm_starts: Sequence[SolvedLoadCase | None]) -> list[LoadCaseFit]:
        """Fits at `values`: those of `warm_starts` where all were found there, else solved anew."""
        names, out = [q.name for q in self.parameters.free], []
        for i, (load_case, near) in enumerate(zip(self.load_cases, warm_starts, strict=True)):
            path = None if near is None else near.path_at(values, names, load_case.specimen.reshaped(values).mesh.points)
            if near is None or path is None:
                return self.evaluate(values, warm_starts)
            solution = near.fit.solution
            self._effort[i], self._penalties[i] = solution.iterations, solution.states[-1].normal_stiffness
            self._resting[i] = near.fit.resting
            out.append(self._observed(load_case, values, solution, near.fit.resting, path, near.fit.pose))
        return out

    def _try(
        self, inner: FloatArray, step: FloatArray, fits: list[LoadCaseFit], objective: float
    ) -> tuple[FloatArray, list[LoadCaseFit], NormalEquations] | None:
        """Evaluate a step; None where it does not lower the objective or a load case cannot be solved."""
        free = self.parameters.free
        moved = inner + step[: len(free)]
        old, new = self.parameters.values(inner), self.parameters.values(moved)
        here = self.parameters.with_values({q.name: old[q.name] for q in free})
        poses = [f.pose.moved(step[len(free) + 6 * t : len(free) + 6 * t + 6]) for t, f in enumerate(fits)]
        try:
            found = self.evaluate(new, [SolvedLoadCase(f, here) for f in fits], poses, trial=True)
        except (ConvergenceError, InputError):  # InputError: a step that moves markers out of the object
            return None
        if self.objective(found, moved) >= objective:
            return None
        found = self.differentiated(found, new)
        return moved, found, self.normal_equations(found, moved)

    def objective(self, fits: Sequence[LoadCaseFit], inner: FloatArray) -> float:
        """Return the robust sum of squares at some fits, priors at the free parameters on the optimiser's scale included."""
        c, total = self.settings.huber, 0.0
        for fit in fits:
            r = np.abs(fit.residual / fit.sd)[np.isfinite(fit.residual)]
            total += float(np.where(r <= c, r * r, 2.0 * c * r - c * c).sum())
        free = [(q, x) for q, x in zip(self.parameters.free, inner, strict=True) if np.isfinite(q.prior_sd)]
        return total + float(sum(((x - q.inner(q.value)) / q.prior_sd) ** 2 for q, x in free))

    def _match(self, inner: FloatArray, fits: list[LoadCaseFit], status: Status, history: list[float]) -> Match:
        free = self.parameters.free
        p = len(free)
        equations = self.normal_equations(fits, inner)
        hessian, data = equations.hessian, equations.data
        chi_squared = float(sum(np.nansum((f.residual / f.sd) ** 2) for f in fits))
        n_data = sum(load_case.n_data for load_case in self.load_cases)
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


def _first_pose(specimen: Specimen, points: FloatArray, measured: FloatArray, lifted: FloatArray) -> RigidTransform:
    """Pose that brings `points` to the `measured` ones; without data that of the reference scan, whose markers the model has `lifted`."""
    if np.isfinite(measured).all(axis=1).sum() >= 4:
        return registration(points, measured)
    pose, centre = specimen.placement.pose, points.mean(axis=0)
    return RigidTransform(pose.rotation, centre, pose.applied(centre - lifted))
