"""A model file is read as it was written, and every value that cannot be is refused by name."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from naibu.core.errors import InputError
from naibu.core.parameters import Parameter, ParameterSet
from naibu.identification.from_markers.known_materials import KnownMaterials
from naibu.identification.from_markers.observations import NoiseModel
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings
from naibu.identification.prediction.calibrated_model import CalibratedModel
from naibu.workflows.results.result_folder import read_model

COVARIANCE = np.array([[0.04, 0.01], [0.01, 0.09]])


def stored() -> dict[str, Any]:
    parameters = ParameterSet.of(
        [
            Parameter("soft: young_modulus", 100.0, "kPa", "log"),
            Parameter("soft: poisson_ratio", 0.48, "", "incompressibility", prior_sd=1.0),
            Parameter("firm: young_modulus", 200.0, "kPa", "log", fixed=True),
        ]
    )
    known = KnownMaterials({"firm": 200.0}, scale_is_absolute=True)
    model = CalibratedModel(ModelSettings(), parameters, COVARIANCE, NoiseModel(), 1.1, known, ("press/pressed",))
    return json.loads(json.dumps(model.to_dict()))


def test_a_model_comes_back() -> None:
    back = CalibratedModel.from_dict(stored())
    np.testing.assert_array_equal(back.covariance, COVARIANCE)
    assert back.to_dict() == stored()


def put(*path: Any) -> Callable[[dict[str, Any]], None]:
    """Return a change that sets the value at a path of keys."""

    def change(data: dict[str, Any]) -> None:
        inner: Any = data
        for key in path[:-2]:
            inner = inner[key]
        inner[path[-2]] = path[-1]

    return change


FAULTS = [
    (put("parameters", 0, "scale", "logarithmic"), "scale = 'logarithmic': must be one of linear, log, incompressibility"),
    (put("parameters", 0, "value", -3.0), "'soft: young_modulus' value = -3.0"),
    (put("parameters", 1, "value", -7.0), "'soft: poisson_ratio' value = -7.0: must be a finite number between -1 "),
    (put("parameters", 1, "value", 0.4999), "must be below 0.4995"),
    (put("parameters", 0, "value", "100"), "value = '100'"),
    (put("parameters", 0, "value", True), "value = True"),
    (put("parameters", 0, "value", float("nan")), "value = nan"),
    (put("parameters", 0, "value", 10**400), "value = 1000"),
    (put("parameters", 2, "fixed", 1), "fixed = 1: must be true or false"),
    (put("parameters", 1, "prior_sd", -1.0), "prior_sd = -1.0"),
    (put("parameters", 1, "name", "soft: young_modulus"), "defined more than once"),
    (put("parameters", 1, "weather", "fine"), "weather"),
    (put("parameters", "none"), "parameters = 'none': must be a list"),
    (put("covariance", [[0.04, 0.01]]), "shape (1, 2)': must have 2 rows and columns"),
    (put("covariance", 0, 0, -0.04), "covariance of 'soft: young_modulus' with itself = -0.04"),
    (put("covariance", 0, 1, 0.02), "must be symmetric"),
    (put("covariance", [[0.04, 0.07], [0.07, 0.09]]), "must be positive semidefinite"),
    (put("covariance", [[0.0, 0.5], [0.5, 0.09]]), "must be positive semidefinite"),
    (put("covariance", 0, 0, None), "must be finite; the data did not determine"),
    (put("covariance", "much"), "must be a table of numbers"),
    (put("noise", "placing_mm", -0.1), "noise placing_mm = -0.1"),
    (put("noise_factor", float("inf")), "noise_factor = inf"),
    (put("settings", "law", "hookean"), "settings law = 'hookean'"),
    (put("settings", "contact", "glue"), "settings contact = 'glue'"),
    (put("settings", "density", 1000.0), "settings density = 1000.0"),
    (put("settings", "element_size_mm", -1.0), "element_size_mm = -1.0"),
    (put("known", "young_moduli", "firm", 0.0), "young_moduli 'firm' = 0.0"),
    (put("known", "scale_is_absolute", "yes"), "scale_is_absolute = 'yes'"),
    (put("load_cases", [1]), "load_cases = [1]"),
    (put("units", "SI"), "units = 'SI'"),
    (put("settings", {}), "settings law = None: must be there"),
    (put("settings", {"law": "yeoh", "contact": "coulomb"}), "settings joined = None: must be there"),
    (put("reservation", 5), "reservation = 5: must be a text"),
]


@pytest.mark.parametrize(("change", "words"), FAULTS, ids=[words for _, words in FAULTS])
def test_values_that_cannot_be_are_refused(tmp_path: Path, change: Callable[[dict[str, Any]], None], words: str) -> None:
    data = copy.deepcopy(stored())
    change(data)
    (tmp_path / "model.json").write_text(json.dumps(data))
    with pytest.raises(InputError) as caught:
        read_model(tmp_path)
    assert words in str(caught.value)
    assert str(tmp_path / "model.json") in str(caught.value)


def test_correlated_and_undetermined_parameters_are_a_covariance() -> None:
    data = stored()
    data["covariance"] = [[0.04, 0.06], [0.06, 0.09]]  # wholly correlated: an eigenvalue of zero
    np.testing.assert_array_equal(CalibratedModel.from_dict(data).covariance, data["covariance"])
