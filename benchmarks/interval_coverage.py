"""Are the stated intervals right? Virtual specimens with known truth, solved on another mesh: ``interval_coverage.py [DRAWS] [--predict]``.

Parameters: two gels between sticking and slipping plates, 0.15 mm noise a coordinate; prints the errors of the modulus ratio and of
Poisson's ratio, and the share of 95 % intervals that hold the truth. The gels obey the law that is assumed, which the intervals do not take
for granted; the share of those that do is printed beside.

Predictions (``--predict``): gels under a plate, under a bar and between side plates in turn, of three laws in turn, with friction,
Poisson's ratio, stiffness and errors of the stated platen positions of their own; calibrated at one compression, with a neo-Hookean law,
and predicted at 1.4 to 2 times that. Prints the share of measured coordinates within 1.96 ``sd_mm``, with the platen position from the
markers and as stated. ``--record`` writes ``results/interval_coverage.json``, or ``results/prediction_coverage.json``.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np
from records import ResultTable, write_record

from naibu.core.experiment import Experiment, Loading
from naibu.identification.from_markers.calibration import calibrate
from naibu.identification.from_markers.known_materials import KnownMaterials
from naibu.identification.from_markers.observations import NoiseModel
from naibu.identification.from_markers.specimen.parameter_names import friction, poisson_ratio, shape_parameter, young_modulus
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings
from naibu.identification.prediction.calibrated_model import CalibratedModel
from naibu.identification.prediction.interval import per_axis
from naibu.identification.prediction.prediction import Prediction, predict_state, rms
from naibu.validation.specimens.marker_phantoms import Scanner, box_experiment, two_gels, virtual_specimen

NOISE_MM = 0.15
CELLS, TRUE_CELLS = 6.0, 9.0  # over the height, of predictions and of the gels that they predict
COMMON_MM, OWN_MM = 1.2, 0.7  # standard deviation of the error of stated platen positions: of all states of an experiment, of each


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


def predictions(draws: int, first: int) -> tuple[ResultTable, ...]:
    """Calibrate and predict every draw and print the summary."""
    start = time.perf_counter()
    inside: dict[bool, list[np.ndarray]] = {True: [], False: []}
    for seed in range(first, first + draws):
        _, experiment = unseen(seed)
        settings = ModelSettings(element_size_mm=experiment.height_mm / CELLS)
        model = CalibratedModel.of(calibrate([experiment], states={experiment.name: ["little"]}, settings=settings))
        line = []
        for by_markers in (True, False):
            p = predict_state(model, experiment, "more", heights_from_markers=by_markers)
            inside[by_markers].append(within(p))
            share, sd = 100 * within(p).mean(), np.median(per_axis(p.sd_mm))
            line.append(f"{'from markers' if by_markers else 'stated'}: RMS {rms(p.residual):.2f} mm, sd_mm {sd:.2f}, {share:.1f} % within")
        print(f"draw {seed}, {experiment.name}: {'; '.join(line)}, {time.perf_counter() - start:.0f} s", flush=True)
    rows = []
    for by_markers, name in ((True, "from markers"), (False, "as stated")):
        every = np.concatenate(inside[by_markers])
        least = 100 * min(w.mean() for w in inside[by_markers])
        share = f"{100 * every.mean():.1f} % of {len(every)} coordinates within their 95 % bounds"
        print(f"platen position {name}: {share}, {least:.1f} % in the worst draw")
        rows.append((name, round(100 * float(every.mean()), 1), round(float(least), 1), len(every)))
    columns = ("platen position", "within 95 % bounds, %", "in the worst draw, %", "coordinates")
    return (ResultTable("predictions", columns, tuple(rows)),)


def within(p: Prediction) -> np.ndarray:
    """Whether measured coordinates lie within the bounds of the predicted ones."""
    return np.asarray(np.abs(p.residual) < 1.96 * per_axis(p.sd_mm)[:, None]).ravel()


def parameters(draws: int) -> tuple[ResultTable, ...]:
    """Identify every draw and print the summary."""
    template, truth = two_gels(44.0)
    virtual = virtual_specimen(template, truth, settings=ModelSettings(element_size_mm=6.0))
    inside, inside_of_law, ratio, nu, start = [], [], [], [], time.perf_counter()
    for seed in range(draws):
        data = virtual.scanned(seed=seed, scanner=Scanner(placing_mm=NOISE_MM, xy_step_mm=0.0, z_step_mm=0.0))
        found = calibrate(
            [data.experiment],
            known_materials=KnownMaterials({"stiff": 222.0}),
            noise=NoiseModel(NOISE_MM),
            start={young_modulus("soft"): 120.0},
        )
        model = CalibratedModel.of(found)
        values = model.parameters.values()
        names = [n for n in truth if n != young_modulus("stiff")]
        for held, exact in ((inside, False), (inside_of_law, True)):
            bounds = [model.interval(n, law_exact=exact) for n in names]
            held.append([low <= truth[n] <= high for n, (low, high) in zip(names, bounds, strict=True)])
        ratio.append(values[young_modulus("soft")] / truth[young_modulus("soft")] - 1.0)
        nu.append([values[poisson_ratio(m)] - truth[poisson_ratio(m)] for m in ("soft", "stiff")])
        errors = f"ratio {100 * ratio[-1]:+.2f} %, nu {nu[-1][0]:+.4f} {nu[-1][1]:+.4f}"
        print(f"draw {seed}: {errors}, intervals hold {sum(inside[-1])}/{len(names)}, {time.perf_counter() - start:.0f} s", flush=True)
    print(f"modulus ratio: mean error {100 * np.mean(ratio):+.2f} %, RMS {100 * np.sqrt(np.mean(np.square(ratio))):.2f} %")
    print(f"Poisson's ratio: RMS error {np.sqrt(np.mean(np.square(nu))):.4f}")
    share, each = 100 * np.mean(inside), np.mean(inside, axis=0)
    of_law = 100 * float(np.mean(inside_of_law))
    print(f"95 % intervals hold the truth in {share:.1f} % of {np.size(inside)} cases; by parameter {each.round(2)}")
    print(f"those that take the law for right: {of_law:.1f} %")
    rows = (
        ("mean error of the ratio of moduli, %", round(100 * float(np.mean(ratio)), 1)),
        ("RMS error of the ratio of moduli, %", round(100 * float(np.sqrt(np.mean(np.square(ratio)))), 1)),
        ("RMS error of Poisson's ratio", round(float(np.sqrt(np.mean(np.square(nu)))), 4)),
        (f"of {np.size(inside)} intervals of 95 % held the truth, %", round(float(share), 1)),
        ("the same with the law taken for right, %", round(of_law, 1)),
        (f"least covered, {names[int(np.argmin(each))]}, %", round(100 * float(each.min()), 1)),
    )
    return (ResultTable("parameters", (f"{draws} virtual specimens", "value"), rows),)


def main() -> None:
    """Run what is asked for, and record it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("draws", nargs="?", type=int, default=20, help="noisy scans to identify")
    parser.add_argument("--predict", action="store_true", help="predictions rather than parameters")
    parser.add_argument("--first", type=int, default=0, help="the first draw of predictions")
    parser.add_argument("--record", action="store_true", help="write the record of this run")
    options = parser.parse_args()
    tables = predictions(options.draws, options.first) if options.predict else parameters(options.draws)
    if options.record:
        write_record("prediction_coverage" if options.predict else "interval_coverage", tables)


if __name__ == "__main__":
    main()
