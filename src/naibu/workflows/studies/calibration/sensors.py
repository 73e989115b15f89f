"""What a calibration tells of its force sensors: errors that were found, and errors that would explain what it lacks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from naibu.identification.lattice_calibration.captured.sensor_errors import MOST_DELAY_S, USUAL_DRIFT, SensorErrors
from naibu.identification.lattice_calibration.estimate import LatticeEstimate
from naibu.identification.lattice_calibration.intervals.sensor_diagnosis import (
    TOLD,
    SensorDiagnosis,
    SensorError,
    at_estimate,
    diagnosed,
    sensor_errors_found,
)
from naibu.identification.lattice_calibration.intervals.unnoticed_drift import UnnoticedDrift, counted_drift, unnoticed_drift
from naibu.identification.lattice_calibration.studies.study_problem import StudyProblem
from naibu.viewer.chapters.chapter import Section
from naibu.viewer.tables import Table

LARGE = 0.02  # of the largest force of the record: an offset or a drift that is a warning
LATE = 0.25  # of a window of time: a delay that is one
AT_THE_END = 0.95  # of the longest delay that is sought
WIDER = 1.5  # by which intervals are wider for a drift, from which on a reader is told


def sensors_told(problem: StudyProblem, estimate: LatticeEstimate) -> tuple[LatticeEstimate, tuple[SensorError, ...], tuple[str, ...]]:
    """Return an estimate whose intervals reach to where errors that were not sought would move it, errors that were found, and warnings."""
    found = at_estimate(problem, estimate) if problem.roughness == 0.0 else None  # in contact it takes long, and is rarely needed
    diagnosis = diagnosed(problem, estimate, found) if estimate.finished else None
    unnoticed = unnoticed_drift(problem, estimate, found) if estimate.finished and not diagnosis else None
    estimate = diagnosis.estimate if diagnosis else estimate
    sensors = sensor_errors_found(problem, estimate, found)
    told = _warnings(problem, diagnosis, sensors, unnoticed)
    unstated = problem.sensor_errors.drift_sd is None
    counted = counted_drift(problem, estimate, found) if estimate.finished and unstated else None
    if counted and counted.factor > WIDER:
        told += (
            f"Intervals count a drift of the force sensors by some {100.0 * USUAL_DRIFT:g} % of their largest force a second, as creep "
            f"looks alike: that of {counted.parameter} is {counted.factor:.2g} times as wide as without one. Where their data sheet says "
            "how much the sensors drift, state it (force_drift_mn_per_s; 0 if they do not).",
        )
    return estimate, sensors, told


def _warnings(
    problem: StudyProblem, diagnosis: SensorDiagnosis | None, sensors: Sequence[SensorError], unnoticed: UnnoticedDrift | None
) -> tuple[str, ...]:
    """Return in words what a reader must know of the sensors."""
    found, name = [], _name(problem, diagnosis.errors) if diagnosis else ""
    if diagnosis and diagnosis.told:
        named = ", ".join(f"{error} of {error.body}" for error in diagnosis.told)
        before, after = diagnosis.factors
        found.append(
            f"With {named} the forces would be met to {after:.3g} instead of {before:.3g} times their noise: "
            f"{_perhaps(problem, diagnosis.errors)}; or the law lacks something that looks alike. Intervals reach to where that would move "
            f"the estimates. To estimate it along, give {name!r} as sensor errors (--sensor-errors, sensor_errors)."
        )
    elif diagnosis:
        found.append(
            f"Forces are met better with errors of their sensors ({name}), too small to be told from noise: intervals "
            f"reach to where these would move the estimates. To estimate them along, give {name!r} as sensor errors (--sensor-errors, "
            "sensor_errors)."
        )
    if unnoticed:
        found.append(
            f"Intervals hold if the sensors {_drifts(problem.sensor_errors)}: a drift of {1e-3 * unnoticed.drift_mn_per_s:.2g} N/s on "
            f"{unnoticed.axis} of {unnoticed.body} would hardly show in these forces, as creep looks alike, and would make "
            f"{unnoticed.parameter} wrong by a factor of {unnoticed.factor:.3g}. Where a sensor may drift so, set sensor_errors to 'drift'."
        )
    for error in sensors:
        if abs(error.value) > TOLD * error.sd and _matters(problem, error):
            what = "the clock of the sensor is off" if error.quantity == "delay" else "the sensor was not tared, or drifts"
            found.append(f"The record of {error.body} has {error}: {what}. This was estimated along, and intervals count it.")
        if error.quantity == "delay" and abs(error.value) > AT_THE_END * MOST_DELAY_S:
            found.append(
                f"The delay of {error.body} is at the end of what is sought, {1e3 * MOST_DELAY_S:g} ms: shift the times of its record, and "
                "do not rely on these values."
            )
    return tuple(found)


def _drifts(errors: SensorErrors) -> str:
    return f"drift by less than {200.0 * USUAL_DRIFT:g} % of the largest force a second" if errors.drift else "do not drift"


def sensor_section(sensors: Sequence[SensorError]) -> tuple[Section, ...]:
    """Return a section of the page with the errors that were found; none if none were sought."""
    if not sensors:
        return ()
    rows = tuple((e.body, e.quantity, e.value, e.value - 1.96 * e.sd, e.value + 1.96 * e.sd, e.unit) for e in sensors)
    text = (
        "Errors of the force sensors were estimated along with the parameters, whose intervals count them. Where a sensor was tared, and "
        "its clock is that of the indenters, sensor_errors = none makes intervals shorter. A wrong gain of a sensor cannot "
        "be told from stiffness, nor a slow drift from creep."
    )
    table = Table("Errors of the force sensors", ("indenter", "error", "estimate", "95 % from", "to", "unit"), rows)
    return (Section("Sensors", (text,), (table,)),)


def _matters(problem: StudyProblem, error: SensorError) -> bool:
    forces, study = problem.load_cases[0].forces, problem.unknowns.study
    if error.quantity == "delay":
        return abs(error.value) > LATE * forces.window_steps * study.step_s
    body = [b.name for b in study.bodies].index(error.body)
    largest = float(np.nanmax(np.abs(forces.force[:, body])))
    lasts = len(forces.force) * forces.window_steps * study.step_s if error.quantity.startswith("drift") else 1.0
    return abs(error.value) * lasts > LARGE * largest


def _perhaps(problem: StudyProblem, errors: SensorErrors) -> str:
    drifts = errors.any_drift and not problem.sensor_errors.any_drift
    told = [("a sensor was perhaps not tared", errors.offset and not drifts), ("a sensor perhaps drifts", drifts)]
    told.append(("its clock is perhaps off", errors.delay))
    return ", and ".join(text for text, holds in told if holds)


def _name(problem: StudyProblem, errors: SensorErrors) -> str:
    """Return what errors go by; a drift that is counted in any case needs no name."""
    steady = "drift" if errors.any_drift and not problem.sensor_errors.any_drift else "offset" if errors.offset else ""
    return " and ".join(part for part in (steady, "delay" if errors.delay else "") if part)
