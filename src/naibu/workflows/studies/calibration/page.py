"""Page and numbers of a calibrated lattice: estimates, what the data do not determine, and measured against simulated forces and shapes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from naibu.core.arrays import FloatArray
from naibu.identification.lattice_calibration.captured.shape_distance import closest_points
from naibu.identification.lattice_calibration.estimate import LatticeEstimate
from naibu.identification.lattice_calibration.intervals.sensor_diagnosis import SensorError
from naibu.identification.lattice_calibration.studies.study_problem import StudyProblem
from naibu.io.tables.force_records import ForceRecord
from naibu.viewer.chapters.chapter import Chapter, Figure, Section
from naibu.viewer.tables import Cell, Table
from naibu.workflows.studies.calibration.sensors import sensor_section
from naibu.workflows.studies.calibration.starts import CalibratedFromStarts

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

TOLD = "Points: measured; lines: simulated; dashed: with the values of the start."
LARGE_MM = 2.5  # distances that the report counts :cite:p:`hirai2008`


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """Measured against simulated shapes and forces.

    Attributes
    ----------
    times : tuple of float
        Of the captures, s.
    distance : tuple of ndarray, shape (k,)
        Of every captured point from the simulated surface, mm, positive outside.
    force_times : ndarray, shape (windows,)
        Middles of the windows, s.
    measured, force : ndarray, shape (windows, bodies, 3)
        Mean forces, mN; NaN where nothing was recorded: of the record, without the offset of its sensor, and simulated, as late as its
        clock.
    """

    times: tuple[float, ...]
    distance: tuple[FloatArray, ...]
    force_times: FloatArray
    measured: FloatArray
    force: FloatArray

    @classmethod
    def of(cls, problem: StudyProblem, values: FloatArray) -> Compared:
        """Simulate with values (p,), in fine steps."""
        load_case = problem.load_cases[0]
        model = load_case.fine
        found = model.run(problem.unknowns.parameters(values))
        times = tuple(step * model.study.step_s for step in model.captures)
        distance = tuple(closest_points(p, model.hull, x).signed for p, x in zip(load_case.points, found.positions, strict=True))
        middles = np.asarray(model.long_step * (np.arange(model.windows) + 0.5), dtype=np.float64)
        measured, force = load_case.forces.force.copy(), found.force.copy()
        for body, own in problem.of_bodies(load_case.forces, found).items():
            force[:, body] = own.means
            measured[own.counted, body] = own.measured
        return cls(times, distance, middles, measured, force)


def held_intervals(estimate: LatticeEstimate) -> FloatArray:
    """Return 95 % intervals (p, 2), within the range of each parameter."""
    bounds = np.asarray(estimate.unknowns.bounds)  # type: ignore[attr-defined]
    return np.clip(estimate.intervals(), bounds[:, :1], bounds[:, 1:])


def misfit_numbers(problem: StudyProblem, before: Compared, after: Compared) -> dict[str, Any]:
    """Return distances at every capture and differences of every force, RMS, with the start's values and with those found."""
    names = [body.name for body in problem.unknowns.study.bodies]
    far = f"points_beyond_{LARGE_MM:g}_mm"
    shapes = [
        {
            "time_s": t,
            "points": len(d),
            "start_rms_mm": _rms(b),
            "rms_mm": _rms(d),
            far: int((np.abs(d) >= LARGE_MM).sum()),
        }
        for t, b, d in zip(after.times, before.distance, after.distance, strict=True)
    ]
    forces = [
        {
            "indenter": names[k],
            "start_rms_mN": _rms(before.force[:, k] - seen),
            "rms_mN": _rms(after.force[:, k] - seen),
            "largest_mN": size,
        }
        for k in range(len(names))
        if np.isfinite(seen := after.measured[:, k]).any() and (size := float(np.nanmax(np.linalg.norm(seen, axis=1)))) >= 0.0
    ]
    return {"shapes": shapes, "forces": forces}


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.nanmean(values**2))) if np.isfinite(values).any() else float("nan")


def calibration_chapter(
    title: str,
    problem: StudyProblem,
    estimate: LatticeEstimate,
    before: Compared,
    after: Compared,
    records: Sequence[ForceRecord],
    warnings: Sequence[str],
    settings: Mapping[str, Cell],
    several: CalibratedFromStarts | None = None,
    sensors: Sequence[SensorError] = (),
) -> Chapter:
    """Return the page of a calibration; with `several`, of that from several starts, and with errors of sensors where these were sought."""
    sections = [_estimates(problem, estimate, warnings)]
    numbers = misfit_numbers(problem, before, after)
    if after.times:
        rows = tuple(tuple(row.values()) for row in numbers["shapes"])
        columns = ("time, s", "points", "RMS at the start, mm", "RMS, mm", f"points {LARGE_MM:g} mm or more away")
        text = f"Distances of captured points from the simulated surface; a point has a standard deviation of {problem.point_sd_mm:g} mm."
        figure = Figure("Distances", "Of the captured points, after the calibration.", lambda c: _draw_distances(c, after), (9.0, 3.0))
        sections.append(Section("Shapes", (text,), (Table("Distance of the captured points", columns, rows),), (figure,)))
    if numbers["forces"]:
        sections.append(_forces(problem, before, after, records, numbers))
    sections += sensor_section(sensors)
    if several:
        sections.append(_starts(several))
    return Chapter("calibration", f"Calibration: {title}", tuple(sections), dict(settings))


def _estimates(problem: StudyProblem, estimate: LatticeEstimate, warnings: Sequence[str]) -> Section:
    unknowns, low_high = problem.unknowns, held_intervals(estimate)
    rows = tuple(
        (name, unit, float(value) if known else "not determined", float(low), float(high), float(start))
        for name, unit, value, known, (low, high), start in zip(
            unknowns.names, unknowns.units, estimate.values, estimate.determined(), low_high, unknowns.start, strict=True
        )
    )
    parts = [
        f"{what} are reproduced to {factor:.3g} times their noise."
        for what, factor in zip(("Points", "Forces"), estimate.noise_factor, strict=True)
        if np.isfinite(factor)
    ]
    text = (
        *warnings,
        f"{' '.join(parts)} Intervals hold 95 %, if residuals are independent, which errors of the model are not. "
        f"{estimate.runs} simulations.",
    )
    table = Table("Parameters", ("parameter", "unit", "estimate", "95 % from", "to", "start"), rows)
    left = Table("What the data do not determine", ("combination",), tuple((sentence,) for sentence in estimate.undetermined))
    return Section("Parameters", text, (table, left))


def start_numbers(several: CalibratedFromStarts) -> list[dict[str, Any]]:
    """Return where every search began and ended, and how well it fits."""
    names = several.estimate.unknowns.names
    return [
        {
            "start": dict(zip(names, search.start.tolist(), strict=True)),
            "values": dict(zip(names, search.estimate.values.tolist(), strict=True)) if search.estimate else None,
            "chi_squared": search.misfit if search.estimate else None,
            "settled": bool(search.estimate and search.estimate.settled),
            "fits_as_well_elsewhere": k in several.rivals,
            "error": search.error,
        }
        for k, search in enumerate(several.searches)
    ]


def _starts(several: CalibratedFromStarts) -> Section:
    rows: list[tuple[Cell, ...]] = []
    for k, search in enumerate(several.searches):
        found = search.estimate
        remark = search.error
        if found is not None:
            remark = "fits as well" if k in several.rivals else "" if found.settled else "did not come to rest"
        ended = [None] * len(search.start) if found is None else [float(value) for value in found.values]
        rows.append((k + 1, None if found is None else search.misfit, *ended, remark))
    text = (
        "Independent searches, from the values of the study and from a Latin hypercube around them; chi-squared of fine steps in units of "
        "the stated noise, with the weak prior. The least one is taken."
    )
    columns = ("search", "chi-squared", *several.estimate.unknowns.names, "remark")
    return Section("Starts", (text,), (Table("Where the searches ended", columns, tuple(rows)),))


def _forces(
    problem: StudyProblem, before: Compared, after: Compared, records: Sequence[ForceRecord], numbers: Mapping[str, Any]
) -> Section:
    forces = problem.load_cases[0].forces
    window = 1e3 * forces.window_steps * problem.unknowns.study.step_s
    text = [
        f"Recorded samples are averaged over windows of {window:g} ms, {np.median(forces.samples[forces.samples > 0]):.3g} in each; "
        f"simulated forces are means over the same windows. No sample is interpolated. Standard deviation of a sample: "
        f"{', '.join(f'{sd:.3g}' for sd in forces.sd_mn[np.isfinite(forces.sd_mn)])} mN."
    ]
    if any(record.moment is not None for record in records):
        text.append("Moments of the sensors were read, and are not used.")
    columns = ("indenter", "RMS difference at the start, mN", "RMS difference, mN", "largest measured, mN")
    table = Table("Measured against simulated forces", columns, tuple(tuple(row.values()) for row in numbers["forces"]))
    names = [body.name for body in problem.unknowns.study.bodies]
    figures = tuple(
        Figure(
            f"Force of {names[k]}",
            TOLD,
            _drawn(before, after, k),
            (11.0, 3.2),
        )
        for k in range(len(names))
        if np.isfinite(after.measured[:, k]).any()
    )
    return Section("Forces", tuple(text), (table,), figures)


def _drawn(before: Compared, after: Compared, body: int) -> Any:
    def draw(canvas: Canvas) -> None:
        for k, axes in enumerate(canvas.subplots(1, 3)):
            axes.plot(after.force_times, 1e-3 * after.measured[:, body, k], ".", markersize=3, color="0.4")
            axes.plot(before.force_times, 1e-3 * before.force[:, body, k], "--", linewidth=0.8, color="tab:orange")
            axes.plot(after.force_times, 1e-3 * after.force[:, body, k], linewidth=1.0, color="tab:blue")
            axes.set(xlabel="time (s)", ylabel=f"force along {'xyz'[k]} (N)")

    return draw


def _draw_distances(canvas: Canvas, after: Compared) -> None:
    axes = canvas.subplots()
    axes.boxplot([np.asarray(d) for d in after.distance], whis=(2.5, 97.5), showfliers=False, positions=range(len(after.times)))
    axes.set_xticklabels([f"{t:g}" for t in after.times])
    axes.axhline(0.0, color="0.7", linewidth=0.8)
    axes.set(xlabel="time (s)", ylabel="distance (mm), 95 % within the whiskers")
