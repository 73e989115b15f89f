"""Coarse-to-fine search: the parameters are sought on larger elements first, from whose solutions the search on the finer mesh starts.

Most steps of a search are far from its end, where the error of larger elements does not matter, and are taken where they are cheap: on a
mesh that is coarser again and again until it is small. Where the search on the given mesh ends does not depend on it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from naibu.core.errors import ConvergenceError, InputError
from naibu.core.parameters import ParameterSet
from naibu.core.progress import Progress
from naibu.core.status import Status
from naibu.identification.from_markers.gauss_newton import Checkpoint, Match, Matcher, MatchingSettings
from naibu.identification.from_markers.observations import MarkerLoadCase, NoiseModel, SolvedLoadCase
from naibu.identification.from_markers.specimen.specimen_mesh import element_size
from naibu.identification.from_markers.specimen.specimen_model import Specimen, specimen
from naibu.meshing.point_location import interpolation_operator

COARSER = 1.5  # ratio of the element sizes
WORTHWHILE = 500  # nodes of a mesh from which a search on a coarser one saves time
COARSE_TOLERANCE = 100.0  # times that of the search on the finer mesh: until a step promises a few per cent of the objective


@dataclass(frozen=True, slots=True, eq=False)
class CoarseSearch:
    """Result of a search on larger elements.

    Attributes
    ----------
    load_cases : tuple of MarkerLoadCase
        What was fitted, on larger elements.
    match : Match
        The fit.
    warm_starts : mapping of str to SolvedLoadCase
        Its solutions on the finer mesh, by the labels of their load cases.
    solutions : mapping of str to SolvedLoadCase
        Its solutions, likewise.
    """

    load_cases: tuple[MarkerLoadCase, ...]
    match: Match
    warm_starts: Mapping[str, SolvedLoadCase]
    solutions: Mapping[str, SolvedLoadCase]


def coarse_search(
    load_cases: Sequence[MarkerLoadCase],
    parameters: ParameterSet,
    noise: NoiseModel,
    search: MatchingSettings,
    *,
    start: Mapping[str, float],
    progress: Progress | None = None,
    checkpoint: Checkpoint | None = None,
) -> CoarseSearch | None:
    """Search on larger elements; None where the meshes are small already, or a load case cannot be solved on a coarser one.

    Parameters
    ----------
    load_cases : sequence of MarkerLoadCase
        What is fitted.
    parameters : ParameterSet
        Parameters with their priors.
    noise : NoiseModel
        Of the measurement.
    search : MatchingSettings
        Of the search on the finer mesh.
    start : mapping
        Physical values to start from, by name.
    progress, checkpoint : callable, optional
        See `Matcher.run`.
    """
    if max(t.specimen.mesh.n_points for t in load_cases) < WORTHWHILE:
        return None
    bodies = {t.specimen.experiment.name: t.specimen for t in load_cases}
    rough, told = replace(search, tolerance=COARSE_TOLERANCE * search.tolerance), _on_larger_elements(progress)
    try:
        coarse = {name: coarsened(body) for name, body in bodies.items()}
        cases = tuple(MarkerLoadCase.of(coarse[t.specimen.experiment.name], t.state, noise) for t in load_cases)
        coarser = coarse_search(cases, parameters, noise, search, start=start, progress=progress, checkpoint=checkpoint)
        begin, warm_starts = (start, None) if coarser is None else (coarser.match.parameters.values(), coarser.warm_starts)
        if coarser is not None and coarser.match.status is Status.INTERRUPTED:
            return coarser
        match = Matcher(cases, parameters, rough).run(progress=told, checkpoint=checkpoint, start=begin, warm_starts=warm_starts)
    except (ConvergenceError, InputError):
        return None
    solutions = {t.name: SolvedLoadCase(fit, match.parameters) for t, fit in zip(cases, match.fits, strict=True)}
    finer = {t.name: on_finer_mesh(solutions[t.name], t.specimen, bodies[t.specimen.experiment.name]) for t in cases}
    return CoarseSearch(cases, match, finer, solutions)


def _on_larger_elements(progress: Progress | None) -> Progress | None:
    """Report the steps of a search as those of a stage of its own."""
    if progress is None:
        return None
    return lambda report: progress(replace(report, stage=f"{report.stage} on larger elements"))


def coarsened(body: Specimen) -> Specimen:
    """Return the specimen with elements that are larger by `COARSER`."""
    size = COARSER * element_size(body.experiment, body.settings.element_size_mm)
    return specimen(body.experiment, replace(body.settings, element_size_mm=size))


def on_finer_mesh(solved: SolvedLoadCase, coarse: Specimen, fine: Specimen) -> SolvedLoadCase:
    """Return a solution for a coarse specimen as one to start from on a finer mesh of the same object."""
    return replace(solved, between=interpolation_operator(coarse.mesh, fine.mesh.points, tolerance_mm=fine.experiment.height_mm))
