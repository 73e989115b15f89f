"""Solution of a state to predict, on a coarser mesh first, with the platen position that the markers tell or that is stated."""

from __future__ import annotations

from dataclasses import dataclass, replace

from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError, InputError
from naibu.core.experiment import State
from naibu.core.parameters import ParameterSet
from naibu.identification.from_markers.coarse_search import WORTHWHILE, coarsened, on_finer_mesh
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
    coarse : SolvedLoadCase or None
        A solution with these parameters, or nearly so, on larger elements.
    """

    load_case: MarkerLoadCase
    parameters: ParameterSet
    fit: LoadCaseFit
    gauge: Gauge | None
    coarse: SolvedLoadCase | None

    def error_of_elements(self) -> FloatArray:
        """Return how far vanishing elements would move the markers (k, 3), mm."""
        return marker_error(self.load_case, self.fit, self.parameters.values(), self.coarse)


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
    coarse, start, rate = None, warm_start, None
    if warm_start is not None and markers is not None and (known := warm_start.parameters.values().get(platen)) is not None:
        narrow = narrow.with_values({platen: known})  # the markers tell it anyhow; from there the solution is near
    if warm_start is None and load_case.specimen.mesh.n_points >= WORTHWHILE:
        coarse, start, rate = _solved_on_larger_elements(load_case, narrow, platen, markers)
    if coarse is not None:
        narrow = coarse.parameters
    narrow, fit, gauge, _ = _solved(Matcher([load_case], narrow), platen, markers, start, rate)
    wide = parameters.with_values({platen: narrow.values()[platen]})
    fit = Matcher([load_case], wide).differentiated([fit], wide.values())[0]
    return SolvedState(load_case, wide, fit, gauge, coarse)


def _solved_on_larger_elements(
    load_case: MarkerLoadCase, parameters: ParameterSet, platen: str, markers: State | None
) -> tuple[SolvedLoadCase | None, SolvedLoadCase | None, float | None]:
    """Return the solution on larger elements, and the same on those of the load case; none where they cannot take the deformation.

    The last is how the distance of the outermost markers changes with the platen position there.
    """
    try:
        body = coarsened(load_case.specimen)
        matcher = Matcher([replace(load_case, specimen=body)], parameters)
        found, fit, _, rate = _solved(matcher, platen, markers, None)
        fit = matcher.differentiated([fit], found.values())[0]
    except (ConvergenceError, InputError):  # nothing is lost: the elements of the load case are solved from rest, or say why not
        return None, None, None
    coarse = SolvedLoadCase(fit, found)
    return coarse, on_finer_mesh(coarse, body, load_case.specimen), rate


def _solved(
    matcher: Matcher, platen: str, markers: State | None, start: SolvedLoadCase | None, rate: float | None = None
) -> tuple[ParameterSet, LoadCaseFit, Gauge | None, float | None]:
    load_case, parameters = matcher.load_cases[0], matcher.parameters
    fit = matcher.evaluate(parameters.values(), [start], derivatives=False)[0]
    if markers is None:
        return parameters, fit, None, None
    gauge = outermost_markers(load_case.specimen, markers, fit.sd)
    if rate is None and start is not None:
        rate = _known_rate(start, platen, gauge)
    found, fit, rate = fitted_platen_position(matcher, fit, platen, gauge, rate)
    return found, fit, gauge, rate


def _known_rate(start: SolvedLoadCase, platen: str, gauge: Gauge) -> float | None:
    """Return how the distance of the outermost markers changes with the platen position nearby; None where that is not known."""
    names = [p.name for p in start.parameters.free]
    if platen not in names or not start.fit.path:
        return None
    return float(gauge.derivatives(start.fit.predicted, start.fit.jacobian)[names.index(platen)])
