"""Whether 95 % intervals of `naibu calibrate` hold, with tied boxes: draws of the virtual dough of ``naibu calibrate --example``.

Run: python benchmarks/tied_calibration.py [--draws 9] [--first 0] [--sensor-errors "offset and delay"] [--force-drift 0] [--drift 200]

Every draw is a seed of the example: five captures of 2800 points and two force sensors, nine parameters. Printed are simulations and
processor time of every draw, which truths its intervals miss and by how many standard deviations, and how many are held in all.

``--linearised`` tells instead, of many draws, whether they deviate as chance lets them: by the step of Gauss and Newton from the truth, in
units of the standard deviations that derivatives there give. One simulation serves all draws.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import get_args

import numpy as np

from naibu.identification.lattice_calibration.captured.recorded_forces import RecordedForces
from naibu.identification.lattice_calibration.captured.sensor_errors import SensorErrorNames, SensorErrors
from naibu.identification.lattice_calibration.intervals.sensor_diagnosis import fitted
from naibu.identification.lattice_calibration.studies.study_problem import StudyProblem
from naibu.identification.lattice_calibration.studies.study_unknowns import StudyUnknowns
from naibu.io.tables.captured_shapes import read_captured_shapes
from naibu.io.tables.force_records import read_force_records
from naibu.workflows.studies.calibration.calibrate import calibrate_study
from naibu.workflows.studies.calibration.example import POINT_SD_MM, SOURCE, write_calibration_example
from naibu.workflows.studies.lattice_study import prepared_study


def main() -> None:
    """Calibrate the draws, and print what their intervals hold."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=9)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--sensor-errors", choices=get_args(SensorErrorNames), default="none", help="sought along; the sensors have none")
    parser.add_argument(
        "--force-drift", type=float, help="standard deviation that is stated, mN/s; by default .5 %% of the largest force a second"
    )
    parser.add_argument("--drift", type=float, default=0.0, help="that the sensors have along z, mN/s")
    parser.add_argument("--linearised", action="store_true", help="deviations by derivatives at the truth")
    options = parser.parse_args()
    if options.linearised:
        linearised(range(options.first, options.first + options.draws), SensorErrors.named(options.sensor_errors, options.force_drift))
        return
    truth = StudyUnknowns.of(prepared_study(SOURCE).study).start
    held, widths = [], []
    for seed in range(options.first, options.first + options.draws):
        began = time.process_time()
        with TemporaryDirectory() as folder:
            study, shapes, forces = write_calibration_example(Path(folder) / "dough", seed=seed)
            drifted(forces, options.drift)
            found = calibrate_study(
                study, shapes=[shapes], forces=[forces], out=Path(folder) / "found", sensor_errors=options.sensor_errors,
                force_drift_mn_per_s=options.force_drift,
            ).estimate  # fmt: skip
        low, high = found.intervals().T
        within = (low <= truth) & (truth <= high)
        off = np.log(found.values / truth) / np.sqrt(np.diag(found.covariance))
        missed = ", ".join(f"{name} ({z:+.1f} SD)" for name, z, one in zip(found.unknowns.names, off, within, strict=True) if not one)
        print(f"seed {seed}: {time.process_time() - began:.0f} s, {found.runs} simulations; not held: {missed or 'none'}", flush=True)
        held.append(within)
        widths.append(0.5 * np.log(high / low))
    print(f"held: {np.sum(held)} of {np.size(held)}")
    for name, *width in zip(found.unknowns.names, np.min(widths, axis=0), np.max(widths, axis=0), strict=True):
        print(f"half width of the logarithm of {name}: {width[0]:.2f} to {width[1]:.2f}")


def linearised(seeds: range, errors: SensorErrors) -> None:
    """Print how draws deviate, by derivatives at the truth."""
    unknowns, at_truth, deviations = StudyUnknowns.of(prepared_study(SOURCE).study), None, []
    for seed in seeds:
        with TemporaryDirectory() as folder:
            _, shapes, forces = write_calibration_example(Path(folder) / "dough", seed=seed)
            captured, records = read_captured_shapes([shapes]), read_force_records([forces])
        bodies = [body.name for body in unknowns.study.bodies]
        recorded = RecordedForces.of(unknowns.study, [(bodies.index(r.indenter), r.times_s, r.force) for r in records])
        clouds = [(c.time_s, c.points) for c in captured]
        problem = StudyProblem.of(unknowns, clouds, recorded, point_sd_mm=POINT_SD_MM, sensor_errors=errors)
        fine = problem.load_cases[0].fine
        at_truth = at_truth or fine.run(unknowns.parameters(unknowns.start), unknowns.changes(unknowns.start))
        fit = fitted(problem, at_truth)
        deviations.append(fit.step / np.sqrt(np.diag(fit.covariance)))
    z = np.array(deviations)
    for name, column in zip(unknowns.names, z.T, strict=True):
        print(f"{name}: mean {column.mean():+.2f}, RMS {np.sqrt((column**2).mean()):.2f}, largest {np.abs(column).max():.1f} SD")
    print(f"within 1.96 SD: {(np.abs(z) < 1.96).sum()} of {z.size}")


def drifted(forces: Path, drift_mn_per_s: float) -> None:
    """Add a drift to the vertical forces of a table, N."""
    header, *lines = forces.read_text(encoding="utf-8").splitlines()
    rows = [line.split(",") for line in lines]
    for row in rows:
        row[4] = f"{float(row[4]) + 1e-3 * drift_mn_per_s * float(row[0]):.4f}"
    forces.write_text("\n".join([header, *map(",".join, rows)]) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
