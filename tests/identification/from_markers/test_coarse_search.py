"""Search on larger elements first: what it starts the search on smaller ones from."""

from __future__ import annotations

import numpy as np

from naibu import datasets
from naibu.identification.from_markers.calibration import initial_parameters
from naibu.identification.from_markers.coarse_search import WORTHWHILE, coarse_search, coarsened
from naibu.identification.from_markers.gauss_newton import Matcher, MatchingSettings
from naibu.identification.from_markers.known_materials import KnownMaterials
from naibu.identification.from_markers.observations import MarkerLoadCase, NoiseModel
from naibu.identification.from_markers.specimen.parameter_names import young_modulus
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings, specimen
from naibu.validation.specimens.marker_phantoms import Scanner, two_gels, virtual_specimen


def test_a_search_on_larger_elements_gives_values_and_a_path_to_start_from() -> None:
    template, truth = two_gels(50.0)
    virtual = virtual_specimen(template, truth, settings=ModelSettings(element_size_mm=10.0), seed=1)
    data = virtual.scanned(seed=2, scanner=Scanner(placing_mm=0.1, xy_step_mm=0.0, z_step_mm=0.0)).experiment
    noise, settings = NoiseModel(0.1), ModelSettings(element_size_mm=8.0)
    body = specimen(data, settings)
    state = data.loaded_states[0].name
    load_case = MarkerLoadCase.of(body, state, noise)
    parameters = initial_parameters([body], {data.name: [state]}, KnownMaterials({"stiff": 222.0}))
    found = coarse_search([load_case], parameters, noise, MatchingSettings(), start={young_modulus("soft"): 150.0})
    assert found is not None and found.load_cases[0].specimen.mesh.n_points < body.mesh.n_points
    values = found.match.parameters.values()
    assert abs(np.log(values[young_modulus("soft")] / truth[young_modulus("soft")])) < 0.3  # from 150 kPa, of 90
    warm = found.warm_starts[load_case.name].warm_start(values)
    coarse = found.match.fits[0].solution
    assert warm[-1][0] == 1.0 and warm[-1][1].shape == body.mesh.points.shape
    top = [np.isclose(mesh.points[:, 2], data.height_mm) for mesh in (found.load_cases[0].specimen.mesh, body.mesh)]
    means = [u[at, 2].mean() for u, at in zip((coarse.displacement, warm[-1][1]), top, strict=True)]
    assert abs(means[0] - means[1]) < 0.02 * abs(means[0])  # both tops lie on the plate
    solved = Matcher([load_case], parameters).evaluate(values, [found.warm_starts[load_case.name]])[0].solution
    distance = np.linalg.norm(solved.displacement - warm[-1][1])  # coarse elements are a fifth of the body and blur where it slips
    assert solved.status.ok and distance < 0.1 * np.linalg.norm(solved.displacement)


def test_small_meshes_are_searched_at_once() -> None:
    measured = datasets.load("ct_cube_plate")
    body = specimen(measured, ModelSettings(element_size_mm=10.0))
    assert coarsened(body).mesh.n_points < body.mesh.n_points < WORTHWHILE
    load_case = MarkerLoadCase.of(body, "height_45", NoiseModel())
    parameters = initial_parameters([body], {measured.name: ["height_45"]}, KnownMaterials({}))
    assert coarse_search([load_case], parameters, NoiseModel(), MatchingSettings(), start={}) is None
