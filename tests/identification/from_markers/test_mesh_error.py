"""What the size of the elements does to parameters, on a virtual gel that was made on small ones."""

from __future__ import annotations

import numpy as np
import pytest
from pressed_gels import identified, scanned

from naibu.identification.from_markers.checks.verdict import coarse_elements, verdict_of
from naibu.identification.from_markers.specimen.parameter_names import young_modulus
from naibu.identification.prediction.calibrated_model import CalibratedModel
from naibu.identification.verdict import Explanation

NAME = young_modulus("soft")


@pytest.mark.parametrize("size", [15.0, 10.0])
def test_intervals_hold_the_truth_though_elements_are_coarse(size: float) -> None:
    """Without the error of the elements, the interval of the modulus misses the truth on the coarsest mesh."""
    found, truth = identified(size), scanned()[1][NAME]
    assert found.mesh is not None and found.mesh.element_size_mm == size
    model = CalibratedModel.of(found)
    low, high = model.interval(NAME)
    assert low < truth < high
    i = [p.name for p in found.match.parameters.free].index(NAME)
    estimate, sd = model.parameters.values()[NAME], np.sqrt(found.match.covariance[i, i])
    if size == 15.0:
        assert np.log(truth / estimate) > 1.96 * sd
        assert np.sign(found.mesh.step[i]) > 0.0


def test_coarse_elements_are_told_with_the_size_to_take() -> None:
    found = identified(15.0)
    judged = verdict_of(found)
    assert judged.explanation is Explanation.IN_PART
    assert "elements of 15 mm are too coarse" in judged.sentence and f"{NAME} would be about" in judged.sentence
    assert "element_size_mm of 10 or less" in judged.sentence
    assert coarse_elements(identified(10.0)) == ()


def test_estimates_stay_those_of_the_mesh_that_was_asked_for() -> None:
    """Predictions use the same elements, so that the parameters are not corrected."""
    with_error, without = identified(15.0), identified(15.0, with_mesh_error=False)
    assert without.mesh is None and without.match.parameters.values() == with_error.match.parameters.values()
    assert np.array_equal(without.covariance, without.match.covariance)
    step = with_error.mesh.step  # type: ignore[union-attr]
    assert np.allclose(with_error.covariance - without.covariance, np.outer(step, step))
