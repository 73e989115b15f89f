"""Solution of a state to predict, with the platen position that the markers tell or that is stated.

It is found on larger elements first, where most of the way to the platen position costs little.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError, InputError
from naibu.core.experiment import State
from naibu.core.parameters import ParameterSet
from naibu.identification.from_markers.coarse_search import WORTHWHILE, coarsened, on_finer_mesh
from naibu.identification.from_markers.gauss_newton import Matcher
from naibu.identification.from_markers.mesh_error import marker_error
from naibu.identification.from_markers.observations import LoadCaseFit, MarkerLoadCase, SamePath, SolvedLoadCase
from naibu.identification.prediction.platen_position import Gauge, fitted_platen_position, outermost_markers, same_path


@dataclass(frozen=True, slots=True, eq=False)
class SolvedState:
    """A state to predict, solved.

    Attributes
    ----------
    load_case : MarkerLoadCase
        The state without its markers.
    parameters : ParameterSet
        With the platen position that was used.
    fit : LoadCaseFit
        The solution, with derivatives with respect to all free parameters.
    gauge : Gauge or None
        The markers that told the platen position.
    coarse : SolvedLoadCase, optional
        The same state on larger elements, at nearly the same platen position.
    """

    load_case: MarkerLoadCase
    parameters: ParameterSet
    fit: LoadCaseFit
    gauge: Gauge | None
    coarse: SolvedLoadCase | None = None

    def error_of_elements(self) -> FloatArray:
        """Return how far vanishing elements would move the markers (k, 3), mm."""
        values = self.parameters.values()
        return marker_error(self.load_case, self.fit, values, None if self.coarse is None else self.coarse.warm_start(values))


def solve_state(
    load_case: MarkerLoadCase,
    parameters: ParameterSet,
    platen: str,
    *,
    markers: State | None = None,
    warm_start: SolvedLoadCase | None = None,
) -> SolvedState:
    """Solve a state that is to be predicted.

    Parameters
    ----------
    load_case : MarkerLoadCase
        The state without its markers.
    parameters : ParameterSet
        Of the state, those with derivatives free.
    platen : str
        Name of the platen position.
    markers : State, optional
        The state with its markers, whose outermost ones tell the platen position; that of the parameters is used by default.
    warm_start : SolvedLoadCase, optional
        Solution of the state with similar parameters.

    Raises
    ------
    InputError
        There are no markers that tell the platen position.
    ConvergenceError
        The state cannot be solved.
    """
    narrow = parameters.changed({p.name: replace(p, fixed=True) for p in parameters.free if p.name != platen})
    if warm_start is not None and markers is not None and (known := warm_start.parameters.values().get(platen)) is not None:
        narrow = narrow.with_values({platen: known})  # the markers tell it anyhow; from there the solution is near
    coarse = _on_larger_elements(load_case, narrow, platen, markers) if warm_start is None else None
    if coarse is not None:
        narrow = coarse.parameters
        warm_start = on_finer_mesh(SamePath(coarse.fit, narrow), coarse.load_case.specimen, load_case.specimen)
    found = _solved(load_case, narrow, platen, markers, warm_start)
    position = found.parameters.values()[platen]
    wide = parameters.with_values({platen: position})
    fit = Matcher([load_case], wide).differentiated([found.fit], wide.values())[0]
    near = None if coarse is None else same_path(coarse.fit, coarse.parameters, load_case.specimen.experiment, platen, position)
    return replace(found, parameters=wide, fit=fit, coarse=near)


def _on_larger_elements(load_case: MarkerLoadCase, parameters: ParameterSet, platen: str, markers: State | None) -> SolvedState | None:
    """Solve the state on larger elements; None where the mesh is small already, or where they do not bear it."""
    if load_case.specimen.mesh.n_points < WORTHWHILE:
        return None
    try:
        return _solved(replace(load_case, specimen=coarsened(load_case.specimen)), parameters, platen, markers, None)
    except (ConvergenceError, InputError):
        return None


def _solved(
    load_case: MarkerLoadCase, parameters: ParameterSet, platen: str, markers: State | None, warm_start: SolvedLoadCase | None
) -> SolvedState:
    """Solve a state without derivatives, with the platen position of the parameters or that which `markers` tell."""
    matcher = Matcher([load_case], parameters)
    fit, gauge = matcher.evaluate(parameters.values(), [warm_start], derivatives=False)[0], None
    if markers is not None:
        gauge = outermost_markers(load_case.specimen, markers, fit.sd)
        parameters, fit = fitted_platen_position(matcher, fit, platen, gauge)
    return SolvedState(load_case, parameters, fit, gauge)
