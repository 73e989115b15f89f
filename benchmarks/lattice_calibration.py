"""Calibration of lattices with friction: how long it takes, and whether its intervals hold: ``lattice_calibration.py [DRAWS]``.

A block of dough, CELLS^3 cubes of 10 mm, stands on a floor; a plate presses it, drags it aside until it slides, stays, and leaves. K, C1
and C2 of three classes of elements (nine values), static and kinetic friction are sought from five captures of points (0.5 mm) and the
plate's force (500 samples a second, 50 mN). ``--unknown all`` seeks K, C1 and C2 of all elements and friction, ``pull-off`` beside these
stiffness, damping and speed of the pull-off, ``surface-mass`` the ratio of masses. Every draw has a truth, noise and points of its own;
truths differ from the start by 35 % (standard deviation of logarithms), friction by 20 %. Nothing is tuned to a draw.

Prints, for each parameter, the root mean square error as a logarithm, the mean half width of its interval, and in how many draws the
interval held the truth; and time, processor time and simulations of a draw. ``--record`` writes ``results/lattice_calibration.json``.

``--differences`` prints instead half widths of intervals at the truth of the first draw, from differences of several lengths:
where they depend on the length, what the differences hold beside derivatives counts as information.

Run: ``OMP_NUM_THREADS=1 python benchmarks/lattice_calibration.py 1 --cells 8`` (9^3 masses, the time) and ``... 24 --cells 3 --workers 2``.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import NDArray
from records import ResultTable, write_record

from naibu.identification.lattice_calibration.captured.recorded_forces import RecordedForces
from naibu.identification.lattice_calibration.captured.sensor_errors import LITTLE_DRIFT, SensorErrorNames, SensorErrors
from naibu.identification.lattice_calibration.evaluation import residuals_at
from naibu.identification.lattice_calibration.gauss_newton import PRIOR_SD
from naibu.identification.lattice_calibration.studies.study_model import StudyModel
from naibu.identification.lattice_calibration.studies.study_problem import StudyProblem
from naibu.identification.lattice_calibration.studies.study_unknowns import FRICTION, SHIFT, StudyUnknowns
from naibu.mechanics.lattices.simulation.loading_history import LatticeStudy
from naibu.workflows.studies.calibration.starts import searched
from naibu.workflows.studies.lattice_study import prepared_study

Array = NDArray[np.float64]
POINT_SD_MM, FORCE_SD_MN, POINTS, SENSOR_HZ = 0.5, 50.0, 2800, 500.0
TRUTH_SD, FRICTION_SD = 0.35, 0.2
CAPTURE_S = (0.0, 1.0, 2.0, 3.4, 5.0)  # at the pace of 1, as the times of the path
STUDY = """
[object]
size_mm = [{side}, {side}, {side}]
mass_g = {mass}
[lattice]
spacing_mm = 10.0
[parameters]
K = {{ short = 60.0, normal = 40.0, long = 25.0 }}
C1 = {{ short = 30.0, normal = 18.0, long = 12.0 }}
C2 = {{ short = 900.0, normal = 700.0, long = 500.0 }}
[simulation]
duration_s = {end}
gravity_mm_per_s2 = 9810
[floor]
contact = "friction"
static_friction = 0.5
kinetic_friction = 0.4
{pull}
[[indenter]]
name = "plate"
shape = "box"
size_mm = [{wide}, {wide}, 10.0]
centre_mm = [{middle}, {middle}, {above}]
static_friction = 0.5
kinetic_friction = 0.4
{pull}
path = {path}
"""
PULL_OFF = "pull_stiffness_mN_per_mm = 60.0\npull_damping_mN_s_per_mm = 10.0\npull_speed_mm_per_s = 60.0"


@dataclass(frozen=True, slots=True)
class Draw:
    """One calibration: logarithms of estimates over truths, half widths of intervals, times, simulations, and what was left open."""

    names: tuple[str, ...]
    error: Array
    half: Array
    wall_s: float
    processor_s: float
    runs: int
    factors: tuple[float, float]
    settled: bool


def study_of(cells: int, unknown: str, pace: float, folder: Path) -> LatticeStudy:
    """Return the study with its rough values."""
    side = 10.0 * cells
    down, aside = -0.12 * side, 0.6 * side
    rows = [(0.0, 0.0, 0.0), (1.0, 0.0, down), (2.0, aside, down), (3.5, aside, down), (4.0, aside, side)]
    text = STUDY.format(
        side=side,
        mass=1.2e-3 * side**3,
        wide=3.0 * side,
        middle=0.5 * side,
        above=side + 5.0,
        end=5.0 / pace,
        path=[[t / pace, x, 0.0, z] for t, x, z in rows],
        pull=PULL_OFF if unknown == "pull-off" else "",
    )
    path = folder / "study.toml"
    path.write_text(text, encoding="utf-8")
    return prepared_study(path).study


def unknowns_of(study: LatticeStudy, unknown: str) -> StudyUnknowns:
    """Return what is sought."""
    if unknown == "classes":
        return StudyUnknowns.of(study, friction="common")
    return StudyUnknowns.of(study, groups="all", friction="common", pull_off=unknown == "pull-off", surface_mass=unknown == "surface-mass")


def truth_of(unknowns: StudyUnknowns, rng: np.random.Generator) -> Array:
    """Draw a truth."""
    rough = np.array([FRICTION_SD if "friction" in name else TRUTH_SD for name in unknowns.names])
    truth = np.asarray(unknowns.start * np.exp(rough * rng.standard_normal(len(rough))))
    static, kinetic = (unknowns.names.index(f"{name} friction") for name in ("static", "kinetic"))
    truth[[static, kinetic]] = np.clip(truth[[static, kinetic]], *FRICTION)
    truth[kinetic] = min(truth[kinetic], 0.95 * truth[static])
    return truth


def problem_of(
    unknowns: StudyUnknowns,
    truth: Array,
    pace: float,
    rng: np.random.Generator,
    divided: int = 1,
    errors: SensorErrors = LITTLE_DRIFT,
    drift: float = 0.0,
) -> StudyProblem:
    """Record the truth with steps of time that are shorter than those of the study by `divided`, and set up its identification."""
    study = replace(unknowns.study, step_s=unknowns.study.step_s / divided, sample_steps=unknowns.study.sample_steps * divided)
    steps = round(study.frames * study.frame_s / study.step_s)
    captures = [t / pace for t in CAPTURE_S]
    model = StudyModel.of(study, captures, steps, 1, coarse=False)
    made = model.run(unknowns.parameters(truth))
    faces = model.hull.triangles
    faces = faces[(study.lattice.points[faces][:, :, 2] > 0.0).any(axis=1)]
    noise = POINT_SD_MM * rng.standard_normal((len(captures), POINTS, 3))
    clouds = [(t, spread(x[faces], rng) + e) for t, x, e in zip(captures, made.positions, noise, strict=True)]
    times = np.arange(0.5 / SENSOR_HZ, steps * study.step_s, 1.0 / SENSOR_HZ)
    at = np.minimum((times / study.step_s).astype(int), steps - 1)
    force = made.force[at, 1] + FORCE_SD_MN * rng.standard_normal((len(times), 3))
    force[:, 2] += drift * times
    recorded = RecordedForces.of(unknowns.study, [(1, times, force)])
    return StudyProblem.of(unknowns, clouds, recorded, point_sd_mm=POINT_SD_MM, sensor_errors=errors)


def spread(triangles: Array, rng: np.random.Generator) -> Array:
    """Return points spread evenly over triangles (t, 3, 3)."""
    area = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
    weights = rng.dirichlet(np.ones(3), POINTS)
    return np.asarray((triangles[rng.choice(len(area), POINTS, p=area / area.sum())] * weights[:, :, None]).sum(axis=1))


def drawn(
    seed: int,
    *,
    cells: int,
    unknown: str,
    pace: float = 1.0,
    threads: int,
    divided: int = 1,
    errors: SensorErrors = LITTLE_DRIFT,
    drift: float = 0.0,
) -> Draw:
    """Calibrate one truth."""
    rng = np.random.default_rng([seed, 15])
    with tempfile.TemporaryDirectory() as folder:
        unknowns = unknowns_of(study_of(cells, unknown, pace, Path(folder)), unknown)
    truth = truth_of(unknowns, rng)
    problem = problem_of(unknowns, truth, pace, rng, divided, errors, drift)
    began, busy = time.perf_counter(), time.process_time()
    found = searched(problem, unknowns.start, method="gauss-newton", seed=0, max_runs=0, threads=threads, progress=None)
    wall, busy = time.perf_counter() - began, time.process_time() - busy
    half = 0.5 * np.diff(np.log(found.intervals()), axis=1)[:, 0]
    return Draw(unknowns.names, np.log(found.values / truth), half, wall, busy, found.runs, found.noise_factor, found.settled)


def differences(*, cells: int, unknown: str, pace: float, threads: int) -> None:
    """Print half widths of intervals at a truth by the length of the differences, long steps of time."""
    rng = np.random.default_rng([0, 15])
    with tempfile.TemporaryDirectory() as folder:
        unknowns = unknowns_of(study_of(cells, unknown, pace, Path(folder)), unknown)
    truth = truth_of(unknowns, rng)
    problem = problem_of(unknowns, truth, pace, rng)
    theta, lengths = np.log(truth), (0.5 * SHIFT, SHIFT, 2.0 * SHIFT, 4.0 * SHIFT)
    trials = [theta, *(np.log(unknowns.held(truth * np.exp(h * row))) for h in lengths for row in np.eye(len(theta)))]
    found = [np.concatenate(r) for r in residuals_at(problem, [(t, False) for t in trials], threads=threads)]
    widths = []
    for k, h in enumerate(lengths):
        slopes = (np.array(found[1 + k * len(theta) : 1 + (k + 1) * len(theta)]) - found[0]) / np.expm1(h)
        covariance = np.linalg.inv(slopes @ slopes.T + np.eye(len(theta)) / PRIOR_SD**2)
        widths.append(1.96 * np.sqrt(np.diag(covariance)))
    print("half widths with differences of " + ", ".join(f"{h:g}" for h in lengths))
    for name, row in zip(unknowns.names, np.array(widths).T, strict=True):
        print(f"{name:48s}" + "".join(f"{w:9.3f}" for w in row))


def main() -> None:
    """Draw, calibrate, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("draws", type=int, nargs="?", default=1)
    parser.add_argument("--cells", type=int, default=8, help="along an edge")
    parser.add_argument("--unknown", choices=("classes", "all", "pull-off", "surface-mass"), default="classes")
    parser.add_argument("--pace", type=float, default=1.0, help="how many times faster all is done than in 5 s")
    parser.add_argument("--first", type=int, default=0, help="seed of the first draw")
    parser.add_argument("--divided", type=int, default=1, help="by how much steps of time of the truth are shorter than those of the model")
    parser.add_argument("--sensor-errors", choices=get_args(SensorErrorNames), default="none", help="sought along; the sensor has none")
    parser.add_argument("--force-drift", type=float, help="standard deviation that is stated, mN/s; by default that of naibu calibrate")
    parser.add_argument("--drift", type=float, default=0.0, help="that the sensor has along z, mN/s")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--workers", type=int, default=1, help="processes, one draw each")
    parser.add_argument("--record", action="store_true")
    parser.add_argument("--differences", action="store_true", help="half widths by the length of differences")
    chosen = parser.parse_args()
    if chosen.differences:
        differences(cells=chosen.cells, unknown=chosen.unknown, pace=chosen.pace, threads=chosen.threads)
        return
    threads = chosen.threads if chosen.workers == 1 else 1
    one = partial(
        drawn,
        cells=chosen.cells,
        unknown=chosen.unknown,
        pace=chosen.pace,
        threads=threads,
        divided=chosen.divided,
        errors=SensorErrors.named(chosen.sensor_errors, chosen.force_drift),
        drift=chosen.drift,
    )
    seeds = range(chosen.first, chosen.first + chosen.draws)
    found: list[Draw] = []
    with ProcessPoolExecutor(chosen.workers) as pool:
        for draw in pool.map(one, seeds) if chosen.workers > 1 else map(one, seeds):
            found.append(draw)
            outside = [f"{n} {e:+.3f} ({h:.3f})" for n, e, h in zip(draw.names, draw.error, draw.half, strict=True) if abs(e) > h]
            state = "settled" if draw.settled else "NOT SETTLED"
            print(
                f"draw {seeds[len(found) - 1]}: {draw.wall_s:.1f} s, processor {draw.processor_s:.1f} s, {draw.runs} simulations, {state}, "
                f"noise factors {draw.factors[0]:.2f} {draw.factors[1]:.2f}; not held: {', '.join(outside) or 'none'}",
                flush=True,
            )
    print(f"settled: {sum(d.settled for d in found)} of {len(found)}")
    error, half = np.array([d.error for d in found]), np.array([d.half for d in found])
    held = np.abs(error) <= half
    rows = tuple(
        (name, float(np.sqrt((e**2).mean())), float(h.mean()), int(k.sum()), len(found))
        for name, e, h, k in zip(found[0].names, error.T, half.T, held.T, strict=True)
    )
    for name, rms, width, count, of in rows:
        print(f"{name:48s} error {rms:6.3f}   half width {width:6.3f}   held {count} of {of}")
    print(f"held: {100.0 * held.mean():.1f} % of {held.size} intervals")
    if chosen.record:
        times = tuple((float(np.median([getattr(d, k) for d in found]))) for k in ("wall_s", "processor_s", "runs"))
        tables = (
            ResultTable("intervals", ("parameter", "RMS error of the logarithm", "mean half width", "held", "of"), rows),
            ResultTable("time", ("draws", "median s", "median processor s", "median simulations"), ((len(found), *times),)),
        )
        write_record(f"lattice_calibration_{chosen.unknown}_{chosen.cells}", tables)


if __name__ == "__main__":
    main()
