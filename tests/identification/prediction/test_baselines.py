"""Baselines on the bundled cubes: ordered as they must be, and as scipy and plain algebra say."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from naibu import datasets
from naibu.core.errors import InputError
from naibu.core.experiment import Loading
from naibu.identification.from_markers.calibration import calibrate
from naibu.identification.from_markers.known_materials import KnownMaterials
from naibu.identification.from_markers.observations import MarkerLoadCase, NoiseModel
from naibu.identification.from_markers.specimen.parameter_names import platen_position, poisson_ratio, young_modulus
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings, specimen
from naibu.identification.prediction.baselines import affine, baselines, equilibrium_gap_baseline, linear_parameters
from naibu.identification.prediction.prediction import rms
from naibu.validation.specimens.marker_phantoms import Scanner, box_experiment, phantom

COARSE = ModelSettings(element_size_mm=12.0)


def trial(name: str, state: str = "deformed") -> MarkerLoadCase:
    return MarkerLoadCase.of(specimen(datasets.load(name), COARSE), state, NoiseModel())


def values_of(t: MarkerLoadCase, platen_position_mm: float, nu: float = 0.45) -> dict[str, float]:
    """Identified parameters as far as the baselines use them."""
    e = t.specimen.experiment
    moduli = {name(m): value for m in e.materials for name, value in ((young_modulus, 200.0), (poisson_ratio, nu))}
    return moduli | {platen_position(e, t.state): platen_position_mm}


@pytest.fixture(scope="module")
def cube() -> MarkerLoadCase:
    return trial("ct_cube_plate", "height_45")


def test_the_rigid_baseline_is_the_best_rigid_motion(cube: MarkerLoadCase) -> None:
    points, measured = cube.specimen.marker_points, cube.measured

    def residual(p: np.ndarray) -> np.ndarray:
        return (Rotation.from_rotvec(p[:3]).apply(points) + p[3:] - measured).ravel()

    best = least_squares(residual, np.concatenate([np.zeros(3), measured.mean(axis=0)]))
    assert baselines(cube, values_of(cube, 46.0))["rigid"] == pytest.approx(np.sqrt(2.0 * best.cost / len(points)), rel=1e-6)


def test_an_affine_map_comes_back_from_points_with_gaps() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(30, 3))
    exact = points @ rng.normal(size=(3, 3)) + [1.0, 2.0, 3.0]
    seen = np.where(rng.uniform(size=exact.shape) < 0.3, np.nan, exact)
    np.testing.assert_allclose(affine(points, seen), exact, atol=1e-10)
    with pytest.raises(InputError, match="measured y"):
        affine(points, np.where([False, True, False], np.nan, exact))


@pytest.mark.parametrize(
    ("name", "state", "platen_position_mm"),
    [("ct_cube_plate", "height_45", 46.0), ("ct_two_material_2", "deformed", 43.5), ("ct_two_material_3", "deformed", 40.5)],
)
def test_every_description_explains_more_than_none(name: str, state: str, platen_position_mm: float) -> None:
    pressed = trial(name, state)
    found = baselines(pressed, values_of(pressed, platen_position_mm))
    assert 3.0 < found["rigid"] < 12.0
    assert 0.3 < found["affine"] < 0.6 * found["rigid"]
    assert 0.5 < found["linear"] < 0.8 * found["rigid"]


def test_the_report_s_parameters_are_those_of_its_tables() -> None:
    values = linear_parameters(datasets.load("ct_two_material_2"), {})
    assert values["hardness 5: young_modulus"] == 222.0
    assert values["hardness 0: poisson_ratio"] == 0.44


def test_other_materials_have_their_identified_or_stated_parameters(cube: MarkerLoadCase) -> None:
    (material,) = cube.specimen.experiment.materials
    found = values_of(cube, 46.0, nu=0.41)
    assert linear_parameters(cube.specimen.experiment, found) == {young_modulus(material): 200.0, poisson_ratio(material): 0.41}


def test_the_linear_baseline_explains_a_linear_foam_of_low_poisson_ratio() -> None:
    # the data come from finer elements, which do not refine those of the baseline
    template = box_experiment("foam", (60.0,) * 3, [("foam", 60.0)], Loading("plate"), {"pressed": 55.0})
    law = ModelSettings(law="linear_elastic", contact="stick", element_size_mm=8.0)
    truth = {young_modulus("foam"): 40.0, poisson_ratio("foam"): 0.1}
    exact = Scanner(placing_mm=0.0, xy_step_mm=0.0, z_step_mm=0.0, shift_mm=0.0, turn_deg=0.0, tilt_deg=0.0)
    seen = phantom(template, truth, seed=0, scanner=exact, settings=law)
    pressed = MarkerLoadCase.of(specimen(seen.experiment, COARSE), "pressed", NoiseModel())
    position = {platen_position(seen.experiment, "pressed"): 55.0}
    assert baselines(pressed, truth | position)["linear"] < 0.03
    assert baselines(pressed, truth | position | {poisson_ratio("foam"): 0.38})["linear"] > 0.1


def test_what_has_no_baseline_is_said(cube: MarkerLoadCase) -> None:
    with pytest.raises(InputError, match="platen position of 5 mm"):
        baselines(cube, values_of(cube, 5.0))


def test_the_equilibrium_gap_stands_between_no_model_and_the_match() -> None:
    coarse = ModelSettings(element_size_mm=15.0)
    found = calibrate([datasets.load("ct_two_material_2")], known_materials=KnownMaterials({"hardness 5": 222.0}), settings=coarse)
    ((_, distance),) = equilibrium_gap_baseline(found)
    rigid = baselines(found.load_cases[0], values_of(found.load_cases[0], 43.5))["rigid"]
    assert rms(found.match.fits[0].residual) < distance < 0.6 * rigid


def test_one_material_has_no_balance(cube: MarkerLoadCase) -> None:
    e = cube.specimen.experiment
    found = calibrate([e], states={e.name: ["height_45"]}, settings=ModelSettings(element_size_mm=20.0))
    assert list(equilibrium_gap_baseline(found)) == []
