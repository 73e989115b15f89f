"""One draw of ``interval_coverage.py`` each: virtual specimens, scanned, identified and predicted; tasks of any process."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from naibu.core.experiment import Experiment, Loading
from naibu.core.progress import Progress
from naibu.identification.from_markers.calibration import calibrate
from naibu.identification.from_markers.known_materials import KnownMaterials
from naibu.identification.from_markers.observations import NoiseModel
from naibu.identification.from_markers.specimen.parameter_names import friction, poisson_ratio, shape_parameter, young_modulus
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings
from naibu.identification.prediction.calibrated_model import CalibratedModel
from naibu.identification.prediction.interval import per_axis
from naibu.identification.prediction.prediction import Prediction, predict_state, rms
from naibu.validation.specimens.marker_phantoms import box_experiment, virtual_specimen

NOISE_MM = 0.15
CELLS, TRUE_CELLS = 6.0, 9.0  # over the height, of predictions and of the gels that they predict
COMMON_MM, OWN_MM = 1.2, 0.7  # standard deviation of the error of stated platen positions: of all states of an experiment, of each


@dataclass(frozen=True)
class PredictedDraw:
    """Which measured coordinates of a gel lie within the bounds of the predicted ones, platen positions from markers or as stated."""

    inside: dict[bool, np.ndarray]
    told: str


@dataclass(frozen=True)
class IdentifiedDraw:
    """Values found, and which 95 % intervals hold the truth: those that are stated, and those that take the law for right."""

    values: dict[str, float]
    inside: list[bool]
    inside_of_law: list[bool]


def unseen(seed: int) -> tuple[str, Experiment]:
    """Draw a gel, its loading, and two compressions, and scan it."""
    rng = np.random.default_rng([seed, 77])
    kind, law = ("plate", "bar", "side_plates")[seed % 3], ("neo_hookean", "yeoh", "mooney_rivlin")[seed // 3 % 3]
    size = (50.0, 70.0, 40.0) if kind == "side_plates" else (60.0, 60.0, 60.0)
    full, little = size[1 if kind == "side_plates" else 2], rng.uniform(0.12, 0.25)
    positions = {"little": full * (1.0 - little), "more": full * (1.0 - min(little * rng.uniform(1.4, 2.0), 0.42))}
    loading = Loading(kind, bar_width_mm=15.0 if kind == "bar" else None)
    template = box_experiment(
        f"{kind}, {law}", size, [("gel", size[2])], loading, positions, margin_mm=5.0 if kind == "side_plates" else 10.0
    )
    truth = {young_modulus("gel"): 150.0 * np.exp(rng.normal(0.0, 0.4)), poisson_ratio("gel"): rng.uniform(0.47, 0.495)}
    truth |= {friction("gel", body): 0.25 * np.exp(rng.normal(0.0, 0.7)) for body in ("table", "acrylic")}
    if law == "yeoh":
        truth[shape_parameter("gel", "c20_ratio")] = abs(rng.normal(0.0, 0.3))
    if law == "mooney_rivlin":
        truth[shape_parameter("gel", "c01_fraction")] = np.clip(rng.normal(0.15, 0.2), 0.0, 0.6)
    virtual = virtual_specimen(template, truth, settings=ModelSettings(law=law, element_size_mm=size[2] / TRUE_CELLS))
    seen = virtual.scanned(seed=seed).experiment
    common = rng.normal(0.0, COMMON_MM)
    states = [replace(s, stated_mm=positions[s.name] + common + rng.normal(0.0, OWN_MM)) for s in seen.states[1:]]
    return kind, replace(seen, states=(seen.states[0], *states))


def predicted(seed: int, progress: Progress | None) -> PredictedDraw:
    """Calibrate a gel at one compression, and predict the other."""
    _, experiment = unseen(seed)
    settings = ModelSettings(element_size_mm=experiment.height_mm / CELLS)
    found = calibrate([experiment], states={experiment.name: ["little"]}, settings=settings, progress=progress)
    model, inside, line = CalibratedModel.of(found), {}, []
    for by_markers in (True, False):
        p = predict_state(model, experiment, "more", heights_from_markers=by_markers)
        inside[by_markers] = within(p)
        share, sd = 100 * within(p).mean(), np.median(per_axis(p.sd_mm))
        line.append(f"{'from markers' if by_markers else 'stated'}: RMS {rms(p.residual):.2f} mm, sd_mm {sd:.2f}, {share:.1f} % within")
    return PredictedDraw(inside, f"{experiment.name}: {'; '.join(line)}")


def within(p: Prediction) -> np.ndarray:
    """Whether measured coordinates lie within the bounds of the predicted ones."""
    return np.asarray(np.abs(p.residual) < 1.96 * per_axis(p.sd_mm)[:, None]).ravel()


def identified(experiment: Experiment, truth: dict[str, float], progress: Progress | None) -> IdentifiedDraw:
    """Identify two gels; `truth` is that of all parameters, of which the stiff gel's modulus is known."""
    found = calibrate(
        [experiment],
        known_materials=KnownMaterials({"stiff": truth[young_modulus("stiff")]}),
        noise=NoiseModel(NOISE_MM),
        start={young_modulus("soft"): 120.0},
        progress=progress,
    )
    model = CalibratedModel.of(found)
    held: list[list[bool]] = []
    for exact in (False, True):
        bounds = {n: model.interval(n, law_exact=exact) for n in truth if n != young_modulus("stiff")}
        held.append([bool(low <= truth[n] <= high) for n, (low, high) in bounds.items()])
    return IdentifiedDraw(model.parameters.values(), *held)
