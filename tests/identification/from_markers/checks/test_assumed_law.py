"""Gels that stiffen more than a neo-Hookean one, identified as neo-Hookean: the truth is held, and the verdict says what it hangs on."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from naibu.core.experiment import Loading
from naibu.core.markers import Markers
from naibu.identification.from_markers.calibration import Calibration, calibrate
from naibu.identification.from_markers.checks.verdict import verdict_of
from naibu.identification.from_markers.known_materials import KnownMaterials
from naibu.identification.from_markers.law_uncertainty import law_uncertainty
from naibu.identification.from_markers.observations import NoiseModel
from naibu.identification.from_markers.specimen.parameter_names import poisson_ratio, shape_parameter, young_modulus
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings
from naibu.identification.prediction.calibrated_model import CalibratedModel
from naibu.identification.verdict import Explanation
from naibu.validation.specimens.marker_phantoms import Scanner, box_experiment, virtual_specimen

COARSE = ModelSettings(contact="stick", element_size_mm=5.0)
HARD = young_modulus("hard")


@cache
def found(compression: float, noise_mm: float, stiffening: float, seed: int = 1) -> Calibration:
    """Make two gels in a cube of 40 mm on elements of their own, with the same ``c20_ratio``, and identify them as neo-Hookean."""
    at = {"pressed": 40.0 * (1.0 - compression)}
    template = box_experiment("gels", (40.0,) * 3, [("soft", 20.0), ("hard", 20.0)], Loading("plate"), at, spacing_mm=6.0, margin_mm=4.0)
    truth = {young_modulus("soft"): 100.0, HARD: 300.0}
    for gel in ("soft", "hard"):
        truth |= {poisson_ratio(gel): 0.48, shape_parameter(gel, "c20_ratio"): stiffening}
    made = virtual_specimen(template, truth, settings=ModelSettings(law="yeoh", contact="stick", element_size_mm=40.0 / 11.0))
    seen = made.scanned(seed=seed, scanner=Scanner(noise_mm, 0.0, 0.0)).experiment
    return calibrate([seen], known_materials=KnownMaterials({"soft": 100.0}), settings=COARSE, noise=NoiseModel(noise_mm))


def held(c: Calibration, truth: float = 300.0) -> tuple[bool, bool]:
    """Whether the interval of the harder gel holds the truth with any law, and with the one assumed."""
    model = CalibratedModel.of(c)
    both = (model.interval(HARD), model.interval(HARD, law_exact=True))
    return both[0][0] < truth < both[0][1], both[1][0] < truth < both[1][1]


def test_markers_that_ask_for_another_law_are_heard() -> None:
    """Markers computed by another program, on quadratic hexahedra with Yeoh's law: 100 and 350.5 kPa, c20 1.13 and c30 0.77 times c10."""
    table = np.loadtxt(Path(__file__).with_name("yeoh_gels.csv"), delimiter=",", skiprows=1)
    rng, names = np.random.default_rng(8), ("initial", "pressed")
    template = box_experiment("gels", (60.0,) * 3, [("hard", 30.0), ("soft", 30.0)], Loading("plate"), {"pressed": 46.0})
    seen = [Markers.from_arrays(np.arange(len(table)), p + rng.normal(0.0, 0.1, p.shape)) for p in (table[:, :3], table[:, 3:])]
    states = tuple(replace(template.state(name), markers=m) for name, m in zip(names, seen, strict=True))
    gels = replace(template, states=states, base_z_mm=0.0, nominal_spacing_mm=None, nominal_margin_mm=None, nominal_heights_mm=())
    c = calibrate([gels], known_materials=KnownMaterials({"soft": 100.0}), noise=NoiseModel(0.1))
    judged = verdict_of(c)
    assert judged.explanation is Explanation.IN_PART
    assert "the law does not fit" in judged.sentence and "yeoh law" in judged.sentence
    yeoh = next(other for other in law_uncertainty(c).others if other.name == "yeoh")
    assert yeoh.probability < 1e-6
    assert yeoh.shift[[p.name for p in c.match.parameters.free].index(HARD)] > 0.1  # towards the truth
    assert held(c, 350.5) == (True, False)


def test_where_markers_cannot_tell_the_interval_holds_any_law() -> None:
    c = found(0.2, 0.3, 1.0)
    judged = verdict_of(c)
    assert judged.explanation is Explanation.EXPLAINED
    assert judged.sentence.startswith("Explained, but moduli hang on the assumed law: ") or "Poisson's ratios hang" in judged.sentence
    assert held(c)[0]


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_neo_hookean_gel_is_not_doubted(seed: int) -> None:
    c = found(0.25, 0.1, 0.0, seed)
    assert not any("law does not fit" in reason for reason in verdict_of(c).reasons)
    assert held(c)[0]


def test_little_deformation_leaves_nothing_to_the_law() -> None:
    c = found(0.03, 0.02, 1.0)
    assert verdict_of(c).limits == ""
    model = CalibratedModel.of(c)
    for p in c.match.parameters.free:
        assert model.standard_deviation(p.name) < 1.1 * model.standard_deviation(p.name, law_exact=True)


def test_the_part_of_the_law_is_stored_with_the_model() -> None:
    model = CalibratedModel.of(found(0.2, 0.3, 1.0))
    again = CalibratedModel.from_dict(json.loads(json.dumps(model.to_dict())))
    assert model.law_covariance is not None and again.law_covariance is not None
    np.testing.assert_array_equal(again.law_covariance, model.law_covariance)
    assert np.linalg.eigvalsh(model.law_covariance).min() > -1e-9 * np.abs(model.law_covariance).max()
