"""Are the stated intervals right? Virtual specimens with known truth, solved on another mesh: ``interval_coverage.py [DRAWS] [...]``.

Parameters: two gels between sticking and slipping plates, 0.15 mm noise a coordinate; prints the errors of the modulus ratio and of
Poisson's ratio, and the share of 95 % intervals that hold the truth. The gels obey the law that is assumed, which the intervals do not take
for granted; the share of those that do is printed beside.

Predictions (``--predict``): gels under a plate, under a bar and between side plates in turn, of three laws in turn, with friction,
Poisson's ratio, stiffness and errors of the stated platen positions of their own; calibrated at one compression, with a neo-Hookean law,
and predicted at 1.4 to 2 times that. Prints the share of measured coordinates within 1.96 ``sd_mm``, with the platen position from the
markers and as stated. ``--record`` writes ``results/interval_coverage.json``, or ``results/prediction_coverage.json``.

``--workers N`` shares the draws out to processes (0: as many as cores and memory allow), ``--cluster tcp://HOST:PORT`` to a Dask cluster
whose workers have this folder in their PYTHONPATH; the results are the same.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from interval_draws import NOISE_MM, identified, predicted
from records import ResultTable, write_record

from naibu.identification.from_markers.specimen.parameter_names import poisson_ratio, young_modulus
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings
from naibu.validation.specimens.marker_phantoms import Scanner, two_gels, virtual_specimen
from naibu.workflows.parallel.run_tasks import run_tasks
from naibu.workflows.parallel.task import Outcome, Task
from naibu.workflows.parallel.worker_count import HERE, Workers


def computed(function: Callable[..., Any], draws: Mapping[int, Mapping[str, Any]], told: Callable[[Any], str], where: Workers) -> list[Any]:
    """Compute draws with their arguments, by seed, print a line of each when it is done, and return them in order."""
    start, seeds = time.perf_counter(), list(draws)

    def finished(index: int, outcome: Outcome) -> None:
        print(f"draw {seeds[index]}, {told(outcome.value())}, {time.perf_counter() - start:.0f} s", flush=True)

    tasks = [Task(f"draw {seed}", function, arguments) for seed, arguments in draws.items()]
    return [outcome.value() for outcome in run_tasks(tasks, workers=where, stage="draws", finished=finished)]


def predictions(draws: int, first: int, where: Workers = HERE) -> tuple[ResultTable, ...]:
    """Calibrate and predict every draw and print the summary."""
    done = computed(predicted, {seed: {"seed": seed} for seed in range(first, first + draws)}, lambda draw: str(draw.told), where)
    inside = {by_markers: [draw.inside[by_markers] for draw in done] for by_markers in (True, False)}
    rows = []
    for by_markers, name in ((True, "from markers"), (False, "as stated")):
        every = np.concatenate(inside[by_markers])
        least = 100 * min(w.mean() for w in inside[by_markers])
        share = f"{100 * every.mean():.1f} % of {len(every)} coordinates within their 95 % bounds"
        print(f"platen position {name}: {share}, {least:.1f} % in the worst draw")
        rows.append((name, round(100 * float(every.mean()), 1), round(float(least), 1), len(every)))
    columns = ("platen position", "within 95 % bounds, %", "in the worst draw, %", "coordinates")
    return (ResultTable("predictions", columns, tuple(rows)),)


def parameters(draws: int, where: Workers = HERE) -> tuple[ResultTable, ...]:
    """Identify every draw and print the summary."""
    template, truth = two_gels(44.0)
    virtual = virtual_specimen(template, truth, settings=ModelSettings(element_size_mm=6.0))
    names = [n for n in truth if n != young_modulus("stiff")]

    def of_ratio(values: dict[str, float]) -> float:
        return values[young_modulus("soft")] / truth[young_modulus("soft")] - 1.0

    def of_nu(values: dict[str, float]) -> list[float]:
        return [values[poisson_ratio(m)] - truth[poisson_ratio(m)] for m in ("soft", "stiff")]

    def told(draw: Any) -> str:
        soft, stiff = of_nu(draw.values)
        errors = f"ratio {100 * of_ratio(draw.values):+.2f} %, nu {soft:+.4f} {stiff:+.4f}"
        return f"{errors}, intervals hold {sum(draw.inside)}/{len(names)}"

    scanner = Scanner(placing_mm=NOISE_MM, xy_step_mm=0.0, z_step_mm=0.0)
    scans = {seed: {"experiment": virtual.scanned(seed=seed, scanner=scanner).experiment, "truth": truth} for seed in range(draws)}
    done = computed(identified, scans, told, where)
    inside, inside_of_law = [draw.inside for draw in done], [draw.inside_of_law for draw in done]
    ratio, nu = [of_ratio(draw.values) for draw in done], [of_nu(draw.values) for draw in done]
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
    parser.add_argument("--workers", type=int, default=1, help="processes; 0: what cores and memory allow")
    parser.add_argument("--cluster", help="scheduler of a Dask cluster instead, tcp://HOST:PORT")
    parser.add_argument("--record", action="store_true", help="write the record of this run")
    options = parser.parse_args()
    where = Workers(options.workers, options.cluster)
    tables = predictions(options.draws, options.first, where) if options.predict else parameters(options.draws, where)
    if options.record:
        write_record("prediction_coverage" if options.predict else "interval_coverage", tables)


if __name__ == "__main__":
    main()
