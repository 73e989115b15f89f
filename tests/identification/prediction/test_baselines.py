"""Baselines on the bundled cubes: ordered as they must be, and as scipy and plain algebra say."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from naibu import datasets
from naibu.core.errors import InputError
from naibu.core.experiment import Layer
from naibu.identification.from_markers.calibration import calibrate
from naibu.identification.from_markers.known_materials import KnownMaterials
from naibu.identification.from_markers.observations import NoiseModel, Trial
from naibu.identification.from_markers.specimen_model import ModelSettings, specimen
from naibu.identification.prediction.baselines import affine, balanced, baselines, report_parameters
from naibu.identification.prediction.prediction import rms

COARSE = ModelSettings(element_size_mm=12.0)


def trial(name: str, state: str = "deformed") -> Trial:
    return Trial.of(specimen(datasets.load(name), COARSE), state, NoiseModel())


@pytest.fixture(scope="module")
def cube() -> Trial:
    return trial("ct_cube_plate", "height_45")


def test_the_rigid_baseline_is_the_best_rigid_motion(cube: Trial) -> None:
    points, measured = cube.specimen.marker_points, cube.measured

    def residual(p: np.ndarray) -> np.ndarray:
        return (Rotation.from_rotvec(p[:3]).apply(points) + p[3:] - measured).ravel()

    best = least_squares(residual, np.concatenate([np.zeros(3), measured.mean(axis=0)]))
    assert baselines(cube, 46.0)["rigid"] == pytest.approx(np.sqrt(2.0 * best.cost / len(points)), rel=1e-6)


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
    found = baselines(trial(name, state), platen_position_mm)
    assert 3.0 < found["rigid"] < 12.0
    assert 0.3 < found["affine"] < 0.6 * found["rigid"]
    assert 0.5 < found["linear"] < 0.8 * found["rigid"]


def test_the_report_s_parameters_are_those_of_its_tables() -> None:
    values = report_parameters(datasets.load("ct_two_material_2"))
    assert values["hardness 5: young_modulus"] == 222.0
    assert values["hardness 0: poisson_ratio"] == 0.44
    alone = report_parameters(datasets.load("ct_cube_plate"))
    assert [v for n, v in alone.items() if n.endswith("poisson_ratio")] == [0.38]


def test_what_has_no_baseline_is_said(cube: Trial) -> None:
    with pytest.raises(InputError, match="an opening of 5 mm"):
        baselines(cube, 5.0)
    experiment = datasets.load("ct_two_material_2")
    other = replace(experiment, layers=(Layer("jelly", 0.0, 30.0), experiment.layers[1]))
    with pytest.raises(InputError, match="jelly"):
        report_parameters(other)


def test_force_balance_stands_between_no_model_and_the_match() -> None:
    coarse = ModelSettings(element_size_mm=15.0)
    found = calibrate([datasets.load("ct_two_material_2")], known_materials=KnownMaterials({"hardness 5": 222.0}), settings=coarse)
    (distance,) = balanced(found).values()
    rigid = baselines(found.trials[0], 43.5)["rigid"]
    assert rms(found.match.fits[0].residual) < distance < 0.6 * rigid


def test_one_material_has_no_balance(cube: Trial) -> None:
    e = cube.specimen.experiment
    found = calibrate([e], states={e.name: ["height_45"]}, settings=ModelSettings(element_size_mm=20.0))
    assert balanced(found) == {}
