"""Calibrate the lattice of a study from captured shapes and recorded forces, and write a study that runs with what was found."""

from __future__ import annotations

import json
import os
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import permutations
from pathlib import Path
from typing import Any, get_args

import numpy as np

from naibu._version import __version__
from naibu.core.arrays import require_within
from naibu.core.errors import InputError
from naibu.core.progress import Progress
from naibu.identification.lattice_calibration.captured.recorded_forces import RecordedForces
from naibu.identification.lattice_calibration.captured.sensor_errors import NO_ERRORS, SensorErrorNames, SensorErrors
from naibu.identification.lattice_calibration.estimate import LatticeEstimate
from naibu.identification.lattice_calibration.studies.study_problem import StudyProblem
from naibu.identification.lattice_calibration.studies.study_unknowns import PULL_OFF, Friction, Groups, StudyUnknowns
from naibu.io.files.atomic import write_atomically
from naibu.io.files.provenance import sha256
from naibu.io.study_schemas.lattice_study_schema import StudyFile
from naibu.io.study_schemas.study_writing import study_document
from naibu.io.tables.captured_shapes import CapturedSurface, read_captured_shapes
from naibu.io.tables.force_records import ForceRecord, read_force_records
from naibu.viewer.chapters.chapter_page import chapter_html
from naibu.viewer.notebook import WrittenResult
from naibu.workflows.parallel.worker_count import Workers
from naibu.workflows.results.output_folder import no_empty_folders, output_folder
from naibu.workflows.studies.calibration.page import Compared, calibration_chapter, held_intervals, misfit_numbers, start_numbers
from naibu.workflows.studies.calibration.sensors import sensors_told
from naibu.workflows.studies.calibration.starts import CalibratedFromStarts, Method, calibrate_from_starts, searched
from naibu.workflows.studies.lattice_study import PreparedStudy, prepared_study

# a record and the forces at the start of the search: correlation with the axes exchanged, and as they are, that tell exchanged axes; and
# the factor between their sizes from which another unit is more likely than so wrong a start
OTHER_AXES, SAME_AXES, OTHER_UNIT = 0.9, 0.5, 200.0
POINT_SD_MM = 0.5  # of the report's stereo cameras :cite:p:`hirai2008`


@dataclass(frozen=True, slots=True, eq=False)
class LatticeCalibration(WrittenResult):
    """A calibrated study, and the files.

    Attributes
    ----------
    files : tuple of Path
        Page, numbers, and the study with the values that were found.
    estimate : LatticeEstimate
        Values, covariance, intervals, and what the data do not determine.
    warnings : tuple of str
        What a reader must know before trusting them.
    """

    files: tuple[Path, ...]
    estimate: LatticeEstimate
    warnings: tuple[str, ...]

    def to_records(self) -> tuple[Mapping[str, Any], ...]:
        """Return one row an unknown: its name, value, 95 % interval and unit."""
        found = self.estimate
        return tuple(
            {"unknown": name, "value": float(value), "lower": float(low), "upper": float(high), "unit": unit}
            for name, unit, value, (low, high) in zip(
                found.unknowns.names, found.unknowns.units, found.values, found.intervals(), strict=True
            )
        )


@no_empty_folders()
def calibrate_study(
    study: str | os.PathLike[str],
    *,
    shapes: Sequence[str | os.PathLike[str]] = (),
    forces: Sequence[str | os.PathLike[str]] = (),
    out: str | os.PathLike[str],
    groups: Groups = "class",
    friction: Friction = "given",
    pull_off: bool = False,
    method: Method = "gauss-newton",
    point_sd_mm: float = POINT_SD_MM,
    force_sd_mn: float | None = None,
    sensor_errors: SensorErrorNames = "none",
    force_drift_mn_per_s: float | None = None,
    max_runs: int = 2000,
    seed: int = 0,
    threads: int = 2,
    starts: int = 1,
    workers: int = 1,
    cluster: str | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> LatticeCalibration:
    """Identify the parameters of a lattice from what cameras and force sensors recorded of it.

    Ctrl-C (KeyboardInterrupt, also from `progress`) keeps the best values so far; of several starts on workers, of the searches that ended.

    Parameters
    ----------
    study : str or path-like
        What was done, as for `naibu.simulate`: object, indenters, and their paths. Its parameters are where the search starts.
    shapes : sequence of path-like
        Captured points, in the coordinates of the study; see `naibu.io.read_captured_shapes`.
    forces : sequence of path-like
        Records of force sensors; see `naibu.io.read_force_records`. One without a name is that of the only indenter.
    out : path-like
        Folder for ``calibration.html``, ``calibration.json`` and ``STUDY-calibrated.toml``.
    groups, friction, pull_off
        What is unknown; see `naibu.identification.StudyUnknowns`.
    method : str
        ``"gauss-newton"``, or a search without derivatives: ``"cma-es"`` or ``"genetic"``, with intervals by derivatives at its end.
    point_sd_mm : float
        Standard deviation of a coordinate of the captured points.
    force_sd_mn : float
        Standard deviation of a component of a force in one sample; by default estimated from the records.
    sensor_errors : str
        Errors of the force sensors that are estimated along, of each by itself: an ``"offset"`` of every component (a sensor that was not
        tared), a ``"delay"`` of its clock, a ``"drift"`` (an offset and what grows evenly with time), two of them, or ``"none"``.
    force_drift_mn_per_s : float
        Standard deviation of the drift of a component of a force sensor, mN/s, as from its data sheet; 0 if it has none. Values and
        intervals count it, whatever `sensor_errors` are; by default 0.5 % of the largest force of the record, per second, and with
        ``"drift"`` any.
    max_runs : int
        Simulations of a search without derivatives, at most.
    seed : int
        Of the random numbers of such a search.
    threads : int
        Computing derivatives.
    starts : int
        Number of independent searches: from the values of the study, and from a Latin hypercube within a factor of 10 around them. The
        best is taken; intervals reach to other values that fit as well.
    workers, cluster
        Where these searches run, as for `naibu.workflows.Workers`.
    overwrite : bool
        Whether results that the folder holds are replaced.
    progress : callable, optional
        Called with a `ProgressReport` after every evaluation.

    Raises
    ------
    InputError
        Files or settings that cannot be used, records that belong to no indenter, forces that point the other way, or a folder that
        cannot be written to or holds results.
    ConvergenceError
        The iterations did not settle.
    """
    _check_arguments(shapes, forces, method, point_sd_mm, force_sd_mn, max_runs, threads, seed, starts)
    errors = SensorErrors.named(sensor_errors, force_drift_mn_per_s)
    where = _checked_workers(workers, cluster, starts)
    prepared = prepared_study(study)
    if prepared.settings.material is not None and groups != "given":
        raise InputError(
            f"groups is {groups!r}, but the elements of {prepared.source} come from [material]; choose 'given', or write [parameters]"
        )
    captured, records = read_captured_shapes(shapes) if shapes else (), read_force_records(forces) if forces else ()
    unknowns = StudyUnknowns.of(prepared.study, groups=groups, friction=friction, pull_off=pull_off)
    problem = _problem(prepared, unknowns, captured, records, point_sd_mm, force_sd_mn, errors)
    name = f"{prepared.name}-calibrated.toml"
    folder = output_folder(out, ("calibration.html", "calibration.json", name), overwrite=overwrite)
    before = Compared.of(replace(problem, sensor_errors=NO_ERRORS), unknowns.start)
    _check_directions(prepared, before, tared=not problem.sensor_errors.offset)
    estimate, several = _searched(problem, starts, where, progress, method=method, seed=seed, max_runs=max_runs, threads=threads)
    estimate, sensors, told = sensors_told(problem, estimate)
    after = Compared.of(problem, estimate.values)
    settings = calibrated_settings(prepared.settings, estimate)
    options: dict[str, str | float | int | None] = {
        "study": prepared.source, "method": method, "groups": groups, "friction": friction, "point_sd_mm": point_sd_mm, "seed": seed,
        "starts": starts, "sensor_errors": sensor_errors, "force_drift_mn_per_s": force_drift_mn_per_s,
        **{f"SHA-256 of {file}": digest for file, digest in {**prepared.inputs, **_hashes((*shapes, *forces))}.items()},
    }  # fmt: skip
    warnings = (*_warnings_of_starts(several), *told, *_warnings(problem, estimate, before))
    chapter = calibration_chapter(prepared.title, problem, estimate, before, after, records, warnings, options, several, sensors)
    comment = f"{prepared.title}, calibrated by naibu {__version__} from {', '.join(map(_file_name, (*shapes, *forces)))}"
    target = write_atomically(folder / name, study_document(_with_volumes(prepared, settings, folder), comment))
    page = write_atomically(folder / "calibration.html", chapter_html(chapter))
    numbers = {
        **_numbers(estimate), "misfit": misfit_numbers(problem, before, after), "warnings": list(warnings), "settings": options,
        "sensor_errors": [asdict(error) for error in sensors], **({"starts": start_numbers(several)} if several else {}),
    }  # fmt: skip
    written = write_atomically(folder / "calibration.json", json.dumps(numbers, indent=1, ensure_ascii=False) + "\n")
    return LatticeCalibration((page, written, target), estimate, warnings)


def _check_arguments(
    shapes: Sequence[str | os.PathLike[str]],
    forces: Sequence[str | os.PathLike[str]],
    method: str,
    point_sd_mm: float,
    force_sd_mn: float | None,
    max_runs: int,
    threads: int,
    seed: int,
    starts: int,
) -> None:
    if method not in get_args(Method):
        raise InputError(f"method is {method!r}; choose one of {', '.join(get_args(Method))}")
    require_within("point_sd_mm", point_sd_mm, 1e-6, 1e3, "mm")
    if force_sd_mn is not None:
        require_within("force_sd_mn", force_sd_mn, 1e-6, 1e6, "mN")
    for name, count in (("max_runs", max_runs), ("threads", threads), ("starts", starts)):
        if count < 1:
            raise InputError(f"{name} is {count}: must be at least 1")
    if seed < 0:
        raise InputError(f"seed is {seed}: must be 0 or more")
    if force_sd_mn is not None and not forces:
        raise InputError(f"force_sd_mn is {force_sd_mn:g}, but there are no records of forces; leave it out")
    if twice := [shape for shape, count in Counter(map(str, shapes)).items() if count > 1]:
        raise InputError(f"`shapes` names {twice[0]} twice, which would count as two measurements; name it once")
    if not shapes and not forces:
        raise InputError("`shapes` and `forces` are both missing; give captured points, records of force sensors, or both")


def _problem(
    prepared: PreparedStudy,
    unknowns: StudyUnknowns,
    captured: Sequence[CapturedSurface],
    records: Sequence[ForceRecord],
    point_sd_mm: float,
    force_sd_mn: float | None,
    errors: SensorErrors,
) -> StudyProblem:
    study = prepared.study
    names = [body.name for body in study.bodies]
    movable = [k for k, name in enumerate(names) if name != "floor"]
    placed = []
    for record in records:
        if not record.indenter and len(movable) != 1:
            raise InputError(
                f"forces: a record names no indenter, and the study has {len(movable)}: {', '.join(names[k] for k in movable)}; write "
                "NAME=FILE, or add a column 'indenter'"
            )
        if record.indenter and record.indenter not in names:
            raise InputError(
                f"forces: a record is of {record.indenter!r}, which {prepared.source} has not: its bodies are {', '.join(names)}; correct "
                "the column 'indenter', or NAME in NAME=FILE"
            )
        placed.append((names.index(record.indenter) if record.indenter else movable[0], record.times_s, record.force))
    recorded = RecordedForces.of(study, placed, sd_mn=force_sd_mn)
    return StudyProblem.of(unknowns, [(c.time_s, c.points) for c in captured], recorded, point_sd_mm=point_sd_mm, sensor_errors=errors)


def _check_directions(prepared: PreparedStudy, before: Compared, *, tared: bool) -> None:
    """Refuse records that hold what the object exerts on the sensor, along other axes, or in another unit than the one that is named.

    Of sensors that are not `tared` changes are compared.
    """
    for body, name in enumerate(b.name for b in prepared.study.bodies):
        counted = np.isfinite(before.measured[:, body])
        seen, ours = before.measured[:, body][counted[:, 0]], before.force[:, body][counted[:, 0]]
        if not tared and len(seen):
            seen, ours = seen - seen.mean(axis=0), ours - ours.mean(axis=0)
        sizes = float(np.sqrt((seen**2).sum() * (ours**2).sum()))
        if not sizes > 0.0:
            continue
        products = seen.T @ ours / sizes  # (axis of the record, axis of the study)
        alike = float(np.trace(products))
        if alike < -0.5:
            raise InputError(
                f"forces of {name!r} point the other way than simulated ones; a record holds what the indenter exerts on the object: "
                "reverse the signs, or check the axes of the sensor"
            )
        turned = max(permutations(range(3)), key=lambda order: np.abs(products[list(order), range(3)]).sum())
        if np.abs(products[list(turned), range(3)]).sum() > OTHER_AXES and alike < SAME_AXES:
            columns = ", ".join(
                f"{'-' if products[column, axis] < 0.0 else ''}f{'xyz'[column]} along {'xyz'[axis]}" for axis, column in enumerate(turned)
            )
            raise InputError(
                f"forces of {name!r} act along other axes than simulated ones, which they resemble with {columns}: exchange the columns, "
                "or turn the paths of the study"
            )
        times = float(np.sqrt((ours**2).sum() / (seen**2).sum()))
        if not 1.0 / OTHER_UNIT < times < OTHER_UNIT:
            raise InputError(
                f"forces of {name!r} are {1.0 / times:.3g} times those that the parameters of the study give: name the unit in the "
                "columns, as in fx_N or fx_mN; if it is right, begin with parameters less than a factor of 200 away"
            )


def _checked_workers(workers: int, cluster: str | None, starts: int) -> Workers:
    where = Workers(workers, cluster)
    if starts == 1 and where.elsewhere:
        raise InputError("`workers` and `cluster` share out the searches of several starts, and `starts` is 1; raise it, or leave them out")
    return where


def _searched(
    problem: StudyProblem, starts: int, where: Workers, progress: Progress | None, **options: Any
) -> tuple[LatticeEstimate, CalibratedFromStarts | None]:
    if starts == 1:
        return searched(problem, problem.unknowns.start, progress=progress, **options), None
    several = calibrate_from_starts(problem, starts, workers=where, progress=progress, **options)
    return several.estimate, several


def _warnings_of_starts(several: CalibratedFromStarts | None) -> tuple[str, ...]:
    if several is None:
        return ()
    found = []
    if several.rivals:
        found.append(
            f"{len(several.rivals)} of the other searches ended at values that fit as well: the data do not tell them apart. "
            "Intervals reach to all of them; read the table of starts."
        )
    if failed := [s for s in several.searches if s.estimate is None]:
        found.append(f"{len(failed)} of {len(several.searches)} searches came to no end, the first of them: {failed[0].error}.")
    return tuple(found)


def _warnings(problem: StudyProblem, estimate: LatticeEstimate, before: Compared) -> tuple[str, ...]:
    found = [] if estimate.finished else ["The search was interrupted: these are the best values so far, not the end of the search."]
    if not problem.unknowns.study.tied:
        found.append(
            "In contact the intervals are not confirmed: jumps, as points begin to slip, count in them as errors of the model, but in "
            "trials with known truth one of 121 was still too narrow (benchmarks/lattice_calibration.py). Take them as the least "
            "uncertainty."
        )
    found += estimate.remarks
    if not estimate.settled and estimate.finished:
        found.append(
            "The search did not come to rest: long and short steps of time differ by more than the noise, or contacts jump between "
            "sticking and sliding. Intervals hold what the weak prior holds, as if "
            "nothing were known; begin nearer (the calibrated study), identify fewer parameters, or give the study a finer lattice."
        )
    for what, factor in zip(("points", "forces"), estimate.noise_factor, strict=True):
        if factor > 1.3:
            found.append(
                f"The calibrated lattice reproduces the {what} to {factor:.2g} times their noise only: the law, the paths of the "
                "indenters or the stated noise do not hold. Intervals are wider by that factor, and may still be too narrow."
            )
        if factor < 0.7:
            found.append(f"The {what} are met to {factor:.2g} times their noise: it is stated too large, and intervals are too wide.")
    at_rest = [d for time, d in zip(before.times, before.distance, strict=True) if time == 0.0]
    offset = float(np.sqrt((at_rest[0] ** 2).mean())) if at_rest else 0.0
    if offset > 3.0 * problem.point_sd_mm:
        found.append(
            f"At rest, before anything moves, the captured points lie {offset:.3g} mm (RMS) from the object of the study: the captures are "
            "in other coordinates, or size_mm is not that of the object. Estimates absorb this."
        )
    unknowns = problem.unknowns
    if not (known := estimate.determined()).any():
        found.append("The data determine no parameter: those of the calibrated study come from its start, and were not measured.")
    elif left := [name for name, one in zip(unknowns.names, known, strict=True) if not one]:
        found.append(f"Not determined within a factor of 4: {', '.join(left)}. The calibrated study states one value of many that fit.")
    for name, value, (low, high) in zip(unknowns.names, estimate.values, unknowns.bounds, strict=True):
        if not low < value < high:
            found.append(f"{name} has reached the end of its range, {low:g} to {high:g}.")
    return tuple(found)


def calibrated_settings(settings: StudyFile, estimate: LatticeEstimate) -> StudyFile:
    """Return the settings of a study with the values of an estimate."""
    unknowns = estimate.unknowns
    assert isinstance(unknowns, StudyUnknowns)
    given = settings.model_dump(mode="python", exclude_unset=True)
    held = np.clip(estimate.values, *unknowns.bounds.T)
    tables: dict[str, Any] = {}
    for name, value in zip(unknowns.names[: len(unknowns.kind)], held, strict=False):
        kind, *places = name.split()
        node = tables
        for inner in (kind, *places)[:-1]:
            node = node.setdefault(inner, {})
        node[(kind, *places)[-1]] = _rounded(value)
    if tables:
        given["parameters"] |= tables
    indenters = unknowns.parameters(estimate.values).indenters
    bodies = ([given["floor"]] if settings.floor is not None else []) + given.get("indenter", [])
    for quantity, members in unknowns.surfaces:
        unit = PULL_OFF.get(quantity, "")
        key = f"{quantity}_{unit.replace('/', '_per_').replace(' ', '_')}" if unit else quantity
        for k in members:
            bodies[k][key] = _rounded(getattr(indenters[k], quantity))
    return StudyFile.model_validate(given)


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")


def _with_volumes(prepared: PreparedStudy, settings: StudyFile, folder: Path) -> StudyFile:
    """Copy the volumes that a study names beside the study that is written, where they must be."""
    labels, material = settings.object.labels, settings.material
    if labels is not None:
        copied = _copied(prepared, labels, folder)
        settings = settings.model_copy(update={"object": settings.object.model_copy(update={"labels": copied})})
    if material is not None and isinstance(material.young_modulus_kPa, str):
        copied = _copied(prepared, material.young_modulus_kPa, folder)
        settings = settings.model_copy(update={"material": material.model_copy(update={"young_modulus_kPa": copied})})
    return settings


def _copied(prepared: PreparedStudy, name: str, folder: Path) -> str:
    source = Path(prepared.source).parent / name
    target = folder / source.name
    if not (target.exists() and target.samefile(source)):
        shutil.copyfile(source, target)
    return source.name


def _file_name(source: str | os.PathLike[str]) -> str:
    text = os.fspath(source)
    return Path(text if Path(text).exists() else text.partition("=")[2]).name


def _hashes(sources: Sequence[str | os.PathLike[str]]) -> dict[str, str]:
    texts = [os.fspath(source) for source in sources]
    files = [Path(text if Path(text).exists() else text.partition("=")[2]) for text in texts]
    return {file.name: sha256(file) for file in files}


def _numbers(estimate: LatticeEstimate) -> dict[str, Any]:
    unknowns, low_high = estimate.unknowns, held_intervals(estimate)
    rows = zip(unknowns.names, unknowns.units, estimate.values.tolist(), low_high.tolist(), estimate.determined().tolist(), strict=True)
    return {
        "naibu": __version__,
        "finished": estimate.finished,
        "settled": estimate.settled,
        "parameters": [{"name": n, "unit": u, "value": v, "interval_95": i, "determined": d} for n, u, v, i, d in rows],
        "covariance_of_logarithms": estimate.covariance.tolist(),
        "noise_factor": dict(zip(("points", "forces"), [None if np.isnan(f) else f for f in estimate.noise_factor], strict=True)),
        "undetermined": list(estimate.undetermined),
        "iterations": estimate.iterations,
        "simulations": estimate.runs,
    }
