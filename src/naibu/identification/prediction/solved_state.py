"""Solution of a state to predict, with the platen position that the markers tell or that is stated."""

from __future__ import annotations

from dataclasses import dataclass, replace

from naibu.core.arrays import FloatArray
from naibu.core.experiment import State
from naibu.core.parameters import ParameterSet
from naibu.identification.from_markers.gauss_newton import Matcher
from naibu.identification.from_markers.mesh_error import marker_error
from naibu.identification.from_markers.observations import LoadCaseFit, MarkerLoadCase, SolvedLoadCase
from naibu.identification.prediction.platen_position import Gauge, fitted_platen_position, outermost_markers


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
    """

    load_case: MarkerLoadCase
    parameters: ParameterSet
    fit: LoadCaseFit
    gauge: Gauge | None

    def error_of_elements(self) -> FloatArray:
        """Return how far vanishing elements would move the markers (k, 3), mm."""
        return marker_error(self.load_case, self.fit, self.parameters.values())


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
    matcher = Matcher([load_case], narrow)
    fit, gauge = matcher.evaluate(narrow.values(), [warm_start], derivatives=False)[0], None
    if markers is not None:
        gauge = outermost_markers(load_case.specimen, markers, fit.sd)
        narrow, fit = fitted_platen_position(matcher, fit, platen, gauge)
    wide = parameters.with_values({platen: narrow.values()[platen]})
    fit = Matcher([load_case], wide).differentiated([fit], wide.values())[0]
    return SolvedState(load_case, wide, fit, gauge)
