"""Models side by side on small virtual gels: the law that made the data wins, and what cannot be solved is a row."""

import numpy as np
import pytest

from naibu import datasets
from naibu.core.errors import ConvergenceError, InputError
from naibu.core.experiment import Experiment, Loading
from naibu.identification.from_markers import calibration
from naibu.identification.from_markers.calibration import calibrate
from naibu.identification.from_markers.gauss_newton import MatchingSettings
from naibu.identification.from_markers.known_materials import KnownMaterials
from naibu.identification.from_markers.observations import NoiseModel
from naibu.identification.from_markers.specimen.parameter_names import poisson_ratio, young_modulus
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings
from naibu.identification.prediction import cross_validation
from naibu.identification.prediction.cross_validation import LeftOut, compare_models, leave_one_out, pooled_rms
from naibu.validation.specimens.marker_phantoms import Scanner, box_experiment, virtual_specimen

COARSE = ModelSettings(contact="stick", element_size_mm=10.0)
TRUTH = {young_modulus("soft"): 100.0, poisson_ratio("soft"): 0.48, young_modulus("hard"): 200.0, poisson_ratio("hard"): 0.48}
KNOWN = KnownMaterials({"hard": 200.0})
QUICK = MatchingSettings(max_iterations=8)


def gel(name: str, layers: list[tuple[str, float]], height_mm: float) -> Experiment:
    e = box_experiment(name, (40.0, 40.0, 40.0), layers, Loading("plate"), {"pressed": height_mm}, spacing_mm=10.0, margin_mm=5.0)
    finer = ModelSettings(contact="stick", element_size_mm=40.0 / 6.0)
    return virtual_specimen(e, TRUTH, settings=finer).scanned(seed=3, scanner=Scanner(0.05, 0.0, 0.0)).experiment


@pytest.fixture(scope="module")
def gels() -> list[Experiment]:
    return [gel("first", [("soft", 20.0), ("hard", 20.0)], 34.0), gel("second", [("hard", 20.0), ("soft", 20.0)], 33.0)]


def test_each_gel_is_predicted_from_the_other(gels: list[Experiment]) -> None:
    steps: list[str] = []
    rows = leave_one_out(
        gels, known_materials=KNOWN, settings=COARSE, noise=NoiseModel(0.05), search=QUICK, progress=lambda r: steps.append(r.stage)
    )
    assert [(r.experiment, r.state, r.marker_count) for r in rows] == [("first", "pressed", 64), ("second", "pressed", 64)]
    assert set(steps) == {"without first", "without second"}
    for row in rows:
        assert row.rms_mm == pytest.approx(np.linalg.norm(row.rms_xyz))
        assert row.rms_mm < 0.4  # noise of two scans in three coordinates is 0.12 mm; the coarse mesh adds its own
    together = np.concatenate([r.prediction.residual for r in rows])
    assert pooled_rms(rows) == pytest.approx(np.sqrt((together**2).sum(axis=1).mean()))


def test_a_failed_candidate_is_a_row_that_says_so(gels: list[Experiment], monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(experiments: object, **options: object) -> None:
        raise ConvergenceError("no equilibrium")

    monkeypatch.setattr(cross_validation, "calibrate", fails)
    (row,) = compare_models(gels, [COARSE])
    assert row.problem == "no equilibrium"
    assert np.isnan([row.noise_factor, row.chi_squared, row.bic, row.left_out_mm]).all()


def test_an_interrupted_candidate_is_no_row(gels: list[Experiment]) -> None:
    def stopped(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        compare_models(gels[:1], [COARSE], known_materials=KNOWN, noise=NoiseModel(0.05), search=QUICK, progress=stopped)


def test_a_failure_with_an_experiment_left_out_keeps_the_rest_of_the_row(gels: list[Experiment], monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object, **__: object) -> list[LeftOut]:
        raise ConvergenceError("no equilibrium")

    monkeypatch.setattr(cross_validation, "leave_one_out", fails)
    (row,) = compare_models(gels, [COARSE], known_materials=KNOWN, noise=NoiseModel(0.05), search=QUICK)
    assert "left out: no equilibrium" in row.problem
    assert row.noise_factor > 0.0
    n = 2 * 3 * 64
    assert row.bic == pytest.approx(n * np.log(row.chi_squared / n) + row.parameter_count * np.log(n))


@pytest.mark.slow
def test_the_law_that_made_the_data_wins(gels: list[Experiment]) -> None:
    candidates = [COARSE, ModelSettings(law="linear_elastic", contact="stick", element_size_mm=10.0)]
    right, wrong = compare_models(gels, candidates, known_materials=KNOWN, noise=NoiseModel(0.05))
    assert right.bic < wrong.bic
    assert right.left_out_mm < wrong.left_out_mm


def test_one_experiment_has_nothing_to_be_predicted_from(gels: list[Experiment]) -> None:
    with pytest.raises(InputError, match="at least 2"):
        leave_one_out(gels[:1])


def test_calibration_starts_from_an_equilibrium_gap_that_can_be_believed(gels: list[Experiment], monkeypatch: pytest.MonkeyPatch) -> None:
    states = {"first": ["pressed"]}
    found = calibration._start_from_equilibrium_gap(gels[:1], KNOWN, states)
    assert 50.0 < found[young_modulus("soft")] < 220.0  # the interface between marker layers pulls it towards 200
    monkeypatch.setattr(calibration, "equilibrium_gap", lambda *_: {"soft": (2.0, 0.4)})
    assert calibration._start_from_equilibrium_gap(gels[:1], KNOWN, states) == {}
    assert calibration._start_from_equilibrium_gap([datasets.load("ct_half_ellipsoid")], KNOWN, {}) == {}


def test_the_users_own_start_comes_first(gels: list[Experiment], monkeypatch: pytest.MonkeyPatch) -> None:
    begun: dict[str, float] = {}

    def run(self: object, *, start: dict[str, float], **_: object) -> None:
        begun.update(start)

    monkeypatch.setattr(calibration.Matcher, "run", run)
    monkeypatch.setattr(calibration, "equilibrium_gap", lambda *_: {"soft": (90.0, 0.4)})
    calibrate(gels[:1], known_materials=KNOWN, settings=COARSE, with_mesh_error=False)
    assert begun[young_modulus("soft")] == 90.0
    calibrate(gels[:1], known_materials=KNOWN, settings=COARSE, with_mesh_error=False, start={young_modulus("soft"): 70.0})
    assert begun[young_modulus("soft")] == 70.0
