"""Discretisation error of parameters identified from markers: the same load cases on a second mesh, and one Gauss-Newton step.

The solution at the identified parameters on another mesh, finer where that is cheap and coarser else, places the markers elsewhere. By
Richardson's extrapolation (:cite:p:`roache1994`) the difference tells how far they are from where vanishing elements would place them. The
parameters that would fit best there differ by a Gauss-Newton step: that is what the elements have done to them. Contact with friction,
edges and interfaces make solutions singular, so that the order of convergence is not reliable; the step is taken as the standard deviation
of an error that all parameters share, rather than as a correction.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError, InputError
from naibu.core.parameters import ParameterSet
from naibu.core.progress import Progress, report_progress
from naibu.identification.from_markers.coarse_search import COARSER
from naibu.identification.from_markers.gauss_newton import PATH, Match, Matcher
from naibu.identification.from_markers.observations import LoadCaseFit, MarkerLoadCase, SolvedLoadCase
from naibu.identification.from_markers.specimen.resting_state import since_scan
from naibu.identification.from_markers.specimen.specimen_mesh import element_size
from naibu.identification.from_markers.specimen.specimen_model import specimen
from naibu.mechanics.finite_strain.statics import WarmStart, solve
from naibu.meshing.point_location import interpolation_operator

RATIO = COARSER  # of the element sizes of the two meshes
ORDER = 1.5  # of convergence: 1 beside singular edges, 2 for smooth solutions
MOST_NODES = 1200  # of a finer mesh; its cost grows with the square of their number
TRUSTED = 0.25  # change of the logarithm of a stiffness on a finer mesh from which on extrapolation is not trusted
STIFFNESSES = (": young_modulus", ": stiffness")


@dataclass(frozen=True, slots=True, eq=False)
class MeshError:
    """What the element size did to an identification.

    Attributes
    ----------
    element_size_mm : float
        Edge of the elements on which the parameters were identified; the largest where experiments differ.
    markers_mm : float
        Root mean square error of a coordinate of a marker from the elements.
    step : ndarray, shape (p,)
        Change of the free parameters that would fit best with vanishing elements, on the optimiser's scale.
    moved : tuple of ndarray, shapes (k, 3)
        By how much vanishing elements would place the markers of every load case elsewhere at the same parameters, mm.
    """

    element_size_mm: float
    markers_mm: float
    step: FloatArray
    moved: tuple[FloatArray, ...]

    @property
    def covariance(self) -> FloatArray:
        """Second moment (p, p) of the error of the free parameters from the elements."""
        return np.outer(self.step, self.step)


def mesh_error(
    load_cases: Sequence[MarkerLoadCase],
    match: Match,
    priors: ParameterSet,
    coarse: Mapping[str, SolvedLoadCase] | None = None,
    progress: Progress | None = None,
) -> MeshError | None:
    """Return the discretisation error of a finished search; None where a load case cannot be solved on the second mesh.

    Parameters
    ----------
    load_cases : sequence of MarkerLoadCase
        What was fitted.
    match : Match
        The fit.
    priors : ParameterSet
        Parameters with their priors, as the search began.
    coarse : mapping of str to SolvedLoadCase, optional
        Solutions on larger elements with similar parameters, by the labels of their load cases; they save time.
    progress : callable, optional
        Gets a report before every load case.
    """
    values, free = match.parameters.values(), match.parameters.free
    finer = RATIO**3 * max(t.specimen.mesh.n_points for t in load_cases) <= MOST_NODES
    sizes = [element_size(t.specimen.experiment, t.specimen.settings.element_size_mm) for t in load_cases]
    changes = []
    try:
        for done, (load_case, fit, size) in enumerate(zip(load_cases, match.fits, sizes, strict=True)):
            report_progress(progress, "error of the elements", done=done, total=len(load_cases))
            known = coarse[load_case.name].warm_start(values) if coarse and not finer else None
            changes.append(change_on_mesh(load_case, fit, values, size / RATIO if finer else size * RATIO, known))
    except (ConvergenceError, InputError):
        return None
    matcher = Matcher(load_cases, priors)
    inner = np.array([p.inner(values[p.name]) for p in free])
    moved = [replace(f, residual=f.residual - change) for f, change in zip(match.fits, changes, strict=True)]
    equations, before = matcher.normal_equations(moved, inner), matcher.normal_equations(match.fits, inner)
    step = np.linalg.solve(equations.hessian, equations.gradient - before.gradient)[: len(free)]
    stiffnesses = [abs(s) for p, s in zip(free, step, strict=True) if p.name.endswith(STIFFNESSES)]
    factor = -1.0 / (RATIO**ORDER - 1.0)
    if finer:
        factor = 1.0 if max(stiffnesses, default=0.0) > TRUSTED else 1.0 / (1.0 - RATIO**-ORDER)
    squares = np.concatenate([change[np.isfinite(f.residual)] ** 2 for f, change in zip(match.fits, changes, strict=True)])
    markers_mm = abs(factor) * float(np.sqrt(squares.mean()))
    return MeshError(max(sizes), markers_mm, factor * step, tuple(factor * change for change in changes))


def marker_error(load_case: MarkerLoadCase, fit: LoadCaseFit, values: Mapping[str, float]) -> FloatArray:
    """Return how far vanishing elements would move the markers (k, 3) of a solved load case, mm, by a coarser mesh; 0 where it has none."""
    size = element_size(load_case.specimen.experiment, load_case.specimen.settings.element_size_mm)
    try:
        return np.asarray(-change_on_mesh(load_case, fit, values, size * RATIO) / (RATIO**ORDER - 1.0))
    except (ConvergenceError, InputError):
        return np.zeros_like(fit.predicted)


def change_on_mesh(
    load_case: MarkerLoadCase,
    fit: LoadCaseFit,
    values: Mapping[str, float],
    element_size_mm: float,
    known: Sequence[WarmStart] | None = None,
) -> FloatArray:
    """Return by how much the markers (k, 3) of a load case lie elsewhere, mm, on elements of another size at the same parameters.

    The states there start from those `known`, or else from those of the fit.
    """
    coarse = load_case.specimen
    body = specimen(coarse.experiment, replace(coarse.settings, element_size_mm=element_size_mm))
    problem = body.problem(values, load_case.state)
    if not known:
        between = interpolation_operator(coarse.reshaped(values).mesh, problem.points, tolerance_mm=coarse.experiment.height_mm)
        known = [(s.load, np.asarray(between @ s.displacement)) for s in fit.solution.states[1:]]
    solution = solve(problem, settings=PATH, warm_start=known)
    moved = body.reshaped(values)
    points = moved.marker_points + moved.at_markers(since_scan(solution))
    return np.asarray(fit.pose.applied(points) / body.enlargement(values) - fit.predicted)
