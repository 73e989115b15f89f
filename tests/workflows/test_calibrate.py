"""The verb calibrate: files in, a page, numbers and a study that simulate runs out."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import worker_tasks
from lattice_studies import study_file
from notebooks import check_shown

from naibu.core.errors import ConvergenceError, InputError
from naibu.core.progress import ProgressReport
from naibu.identification.lattice_calibration.captured.recorded_forces import RecordedForces
from naibu.identification.lattice_calibration.estimate import LatticeEstimate
from naibu.identification.lattice_calibration.studies.study_model import StudyModel
from naibu.identification.lattice_calibration.studies.study_problem import StudyProblem
from naibu.identification.lattice_calibration.studies.study_unknowns import StudyUnknowns
from naibu.workflows.parallel.task import Task
from naibu.workflows.studies.calibration import starts as calibration_starts
from naibu.workflows.studies.calibration.calibrate import calibrate_study
from naibu.workflows.studies.calibration.example import write_calibration_example
from naibu.workflows.studies.calibration.starts import StartedSearch, best_of, starting_values
from naibu.workflows.studies.lattice_study import prepared_study

STUDY = """
[object]
size_mm = [20, 20, 20]
mass_g = 10.0
[lattice]
spacing_mm = 10.0
[parameters]
K = 30.0
C1 = 8.0
C2 = inf
[simulation]
duration_s = 0.2
[floor]
[[indenter]]
name = "stamp"
shape = "box"
size_mm = [20, 20, 10]
centre_mm = [10.0, 10.0, 25.0]
contact = "tied"
path = [[0.0, 0, 0, 0], [0.1, 0, 0, -3]]
[output]
every_s = 0.02
"""
TRUTH = {"K": 45.0, "C1": 5.0}


@pytest.fixture
def inputs(tmp_path: Path) -> tuple[Path, Path, Path]:
    """A study, and points and forces of an object with other parameters."""
    path = study_file(tmp_path, STUDY)
    study = prepared_study(path).study
    unknowns, rng = StudyUnknowns.of(study, groups="all"), np.random.default_rng(0)
    made = StudyModel.of(study, [0.1], 100, 1, coarse=False).run(unknowns.parameters(unknowns.vector(TRUTH)))
    nodes = np.flatnonzero(study.lattice.points[:, 2] > 0.0)
    points = made.positions[0][nodes] + 0.05 * rng.standard_normal((len(nodes), 3))
    cloud, sensor = tmp_path / "points.csv", tmp_path / "force.csv"
    cloud.write_text("time_s,x_mm,y_mm,z_mm\n" + "".join(f"0.1,{x:.4f},{y:.4f},{z:.4f}\n" for x, y, z in points), encoding="utf-8")
    force = 1e-3 * (made.force[:, 1] + 5.0 * rng.standard_normal((100, 3)))
    rows = "".join(f"{2 * k + 1},{x:.6f},{y:.6f},{z:.6f}\n" for k, (x, y, z) in enumerate(force))
    sensor.write_text(f"Time (ms),Fx (N),Fy (N),Fz (N)\n{rows}", encoding="utf-8")
    return path, cloud, sensor


def test_a_study_is_calibrated_and_runs_with_what_was_found(inputs: tuple[Path, Path, Path], tmp_path: Path) -> None:
    study, cloud, sensor = inputs
    run = calibrate_study(study, shapes=[cloud], forces=[sensor], out=tmp_path / "out", groups="all", point_sd_mm=0.05)
    page, numbers, found = run.files
    told = json.loads(numbers.read_text(encoding="utf-8"))
    for row in told["parameters"]:
        assert row["value"] == pytest.approx(TRUTH[row["name"]], rel=0.1)
    assert [row["value"] for row in check_shown(run, page)] == run.estimate.values.tolist()
    assert told["misfit"]["forces"][0]["rms_mN"] < 0.1 * told["misfit"]["forces"][0]["start_rms_mN"]
    parameters = tomllib.loads(found.read_text(encoding="utf-8"))["parameters"]
    assert parameters["K"] == pytest.approx(told["parameters"][0]["value"], rel=1e-5)
    assert np.isinf(parameters["C2"])
    assert prepared_study(found).study.frames == prepared_study(study).study.frames
    assert "Measured against simulated forces" in page.read_text(encoding="utf-8")
    again = calibrate_study(study, shapes=[cloud], forces=[sensor], out=tmp_path / "again", groups="all", point_sd_mm=0.05)
    np.testing.assert_array_equal(again.estimate.values, run.estimate.values)


def test_an_interrupted_run_writes_the_best_so_far(inputs: tuple[Path, Path, Path], tmp_path: Path) -> None:
    study, cloud, sensor = inputs

    def stop(report: ProgressReport) -> None:
        if report.done and report.done >= 3:
            raise KeyboardInterrupt

    run = calibrate_study(study, shapes=[cloud], forces=[sensor], out=tmp_path / "out", groups="all", progress=stop)
    assert not run.estimate.finished
    assert "interrupted" in run.warnings[0]
    assert all(file.exists() for file in run.files)


def test_parameters_that_the_data_do_not_determine_are_given_no_value(inputs: tuple[Path, Path, Path], tmp_path: Path) -> None:
    """Points captured before anything moves tell nothing of K and C1, wherever the search ends."""
    study, _, _ = inputs
    points = prepared_study(study).study.lattice.points
    cloud = tmp_path / "rest.csv"
    cloud.write_text("time_s,x_mm,y_mm,z_mm\n" + "".join(f"0,{x:.4f},{y:.4f},{z:.4f}\n" for x, y, z in points), encoding="utf-8")
    run = calibrate_study(study, shapes=[cloud], out=tmp_path / "out", groups="all")
    assert not run.estimate.determined().any() and "determine no parameter" in " ".join(run.warnings)
    assert all("not determined" in said for said in run.estimate.sentences()[:2])
    assert "<td>not determined</td>" in run.files[0].read_text(encoding="utf-8").replace(' class="text"', "")
    assert not any(row["determined"] for row in json.loads(run.files[1].read_text(encoding="utf-8"))["parameters"])


def test_captures_in_other_coordinates_are_told(inputs: tuple[Path, Path, Path], tmp_path: Path) -> None:
    study, _, sensor = inputs
    shifted = tmp_path / "shifted.csv"
    shifted.write_text("t,x,y,z\n0,5,5,26\n0,15,5,26\n0,5,15,26\n", encoding="utf-8")
    run = calibrate_study(study, shapes=[shifted], forces=[sensor], out=tmp_path / "out", groups="all")
    assert any("other coordinates" in warning and "6 mm" in warning for warning in run.warnings)


def test_records_that_point_the_other_way_are_refused(inputs: tuple[Path, Path, Path], tmp_path: Path) -> None:
    study, cloud, sensor = inputs
    lines = sensor.read_text(encoding="utf-8").splitlines()
    rows = [[float(cell) for cell in line.split(",")] for line in lines[1:]]
    turned = "\n".join([lines[0], *(f"{t},{-x},{-y},{-z}" for t, x, y, z in rows)])
    sensor.write_text(turned, encoding="utf-8")
    with pytest.raises(InputError, match="'stamp' point the other way"):
        calibrate_study(study, shapes=[cloud], forces=[sensor], out=tmp_path / "out", groups="all")
    assert not list((tmp_path / "out").glob("*"))


def altered(sensor: Path, *, late_ms: float, offset_n: float, drift_n_per_s: float = 0.0) -> None:
    """Let a record be late, and its sensor not tared along z, or drift."""
    lines = sensor.read_text(encoding="utf-8").splitlines()
    rows = [[float(cell) for cell in line.split(",")] for line in lines[1:]]
    changed = [f"{t + late_ms},{x},{y},{z + offset_n + 1e-3 * t * drift_n_per_s}" for t, x, y, z in rows]
    sensor.write_text("\n".join([lines[0], *changed]), encoding="utf-8")


def test_a_late_clock_and_a_sensor_that_was_not_tared_are_estimated_and_told(inputs: tuple[Path, Path, Path], tmp_path: Path) -> None:
    study, _, sensor = inputs
    altered(sensor, late_ms=8.0, offset_n=-0.3)
    run = calibrate_study(study, forces=[sensor], out=tmp_path / "out", groups="all", sensor_errors="offset and delay")
    low, high = run.estimate.intervals().T
    assert (low < [45.0, 5.0]).all() and (high > [45.0, 5.0]).all()
    told = {error["quantity"]: error for error in json.loads(run.files[1].read_text(encoding="utf-8"))["sensor_errors"]}
    assert told["delay"]["value"] == pytest.approx(0.008, abs=0.001)
    assert told["offset along z"]["value"] == pytest.approx(-300.0, abs=4.0 * told["offset along z"]["sd"])
    assert any("stamp has a delay of" in warning and "ms" in warning for warning in run.warnings)
    assert any("an offset of -0.3" in warning and "N on z" in warning and "not tared" in warning for warning in run.warnings)
    assert "Errors of the force sensors" in run.files[0].read_text(encoding="utf-8")


def test_errors_of_a_sensor_that_are_said_not_to_be_there_are_named(inputs: tuple[Path, Path, Path], tmp_path: Path) -> None:
    study, _, sensor = inputs
    altered(sensor, late_ms=0.0, offset_n=0.3)
    run = calibrate_study(study, forces=[sensor], out=tmp_path / "out", groups="all", sensor_errors="none")
    assert any("an offset of 0.3" in warning and "perhaps not tared" in warning and "'offset'" in warning for warning in run.warnings)
    low, high = run.estimate.intervals().T
    assert (low < [45.0, 5.0]).all() and (high > [45.0, 5.0]).all()


def test_intervals_hold_whatever_a_sensor_drifts_where_it_may(inputs: tuple[Path, Path, Path], tmp_path: Path) -> None:
    study, _, sensor = inputs
    altered(sensor, late_ms=0.0, offset_n=0.0, drift_n_per_s=0.2)
    counted, excluded = (
        calibrate_study(study, forces=[sensor], out=tmp_path / f"out{k}", groups="all", **errors)
        for k, errors in enumerate(({"sensor_errors": "drift"}, {"force_drift_mn_per_s": 0.0}))
    )
    low, high = counted.estimate.intervals().T
    assert (low < [45.0, 5.0]).all() and (high > [45.0, 5.0]).all()
    told = {error["quantity"]: error for error in json.loads(counted.files[1].read_text(encoding="utf-8"))["sensor_errors"]}
    assert told["drift along z"]["value"] == pytest.approx(200.0, abs=4.0 * told["drift along z"]["sd"])
    assert any("drift" in warning and "stamp" in warning for warning in excluded.warnings)


@pytest.mark.parametrize(
    ("header", "order", "told"),
    [
        ("Time (ms),Fx,Fy,Fz", [0, 1, 2, 3], r"'stamp' are 0\.00\d+ times .* name the unit in the columns, as in fx_N"),
        ("t,Fx (N),Fy (N),Fz (N)", [0, 1, 2, 3], r"no window holds one; .* as in time_ms"),
        ("Time (ms),Fx (N),Fy (N),Fz (N)", [0, 1, 3, 2], r"other axes than simulated ones, which they resemble with .*fy along z"),
    ],
)
def test_records_in_another_unit_or_along_other_axes_are_refused(
    inputs: tuple[Path, Path, Path], tmp_path: Path, header: str, order: list[int], told: str
) -> None:
    study, cloud, sensor = inputs
    rows = [row.split(",") for row in sensor.read_text(encoding="utf-8").splitlines()[1:]]
    sensor.write_text("\n".join([header, *(",".join(row[k] for k in order) for row in rows)]), encoding="utf-8")
    with pytest.raises(InputError, match=told):
        calibrate_study(study, shapes=[cloud], forces=[sensor], out=tmp_path / "out", groups="all")


@pytest.mark.parametrize(
    ("factor", "unit", "told"), [(1e-3, "mm", "unit were 1000 times"), (1e3, "mm", "unit were 0.001 times"), (1e3, "m", "x_mm")]
)
def test_points_whose_columns_name_another_unit_are_told(
    inputs: tuple[Path, Path, Path], tmp_path: Path, factor: float, unit: str, told: str
) -> None:
    study, cloud, sensor = inputs
    rows = [row.split(",") for row in cloud.read_text(encoding="utf-8").splitlines()[1:]]
    lines = "".join(",".join([t, *(f"{factor * float(x):.9g}" for x in place)]) + "\n" for t, *place in rows)
    cloud.write_text(f"time_s,x_{unit},y_{unit},z_{unit}\n{lines}", encoding="utf-8")
    with pytest.raises(InputError, match=told):
        calibrate_study(study, shapes=[cloud], forces=[sensor], out=tmp_path / "out", groups="all")


def test_a_record_of_a_body_that_is_not_there_is_told(inputs: tuple[Path, Path, Path], tmp_path: Path) -> None:
    study, cloud, sensor = inputs
    with pytest.raises(InputError, match=r"of 'punch', which .* has not: its bodies are floor, stamp; correct"):
        calibrate_study(study, shapes=[cloud], forces=[f"punch={sensor}"], out=tmp_path / "out", groups="all")


@pytest.mark.parametrize("method", ["cma-es", "genetic"])
def test_searches_without_derivatives_go_by_their_seed(inputs: tuple[Path, Path, Path], tmp_path: Path, method: str) -> None:
    pytest.importorskip("cma" if method == "cma-es" else "pymoo")
    study, _, sensor = inputs
    runs = [
        calibrate_study(study, forces=[sensor], out=tmp_path / name, groups="all", method=method, seed=3, max_runs=150)  # type: ignore[arg-type]
        for name in ("a", "b")
    ]
    np.testing.assert_array_equal(runs[0].estimate.values, runs[1].estimate.values)
    assert runs[0].estimate.values == pytest.approx(list(TRUTH.values()), rel=0.25)


def test_the_example_is_complete(tmp_path: Path) -> None:
    study, shapes, forces = write_calibration_example(tmp_path)
    assert prepared_study(study).settings.parameters.K == 50.0
    assert shapes.read_text(encoding="utf-8").count("\n") == 1 + 5 * 2800
    assert forces.read_text(encoding="utf-8").count("\n") == 1 + 2 * 2000


def test_several_starts_agree_whoever_computes_them(inputs: tuple[Path, Path, Path], tmp_path: Path) -> None:
    study, cloud, sensor = inputs
    one = calibrate_study(study, shapes=[cloud], forces=[sensor], out=tmp_path / "one", groups="all", point_sd_mm=0.05)
    runs = [
        calibrate_study(
            study, shapes=[cloud], forces=[sensor], out=tmp_path / str(n), groups="all", point_sd_mm=0.05, starts=3, workers=n, seed=1
        )
        for n in (1, 2)
    ]
    np.testing.assert_allclose(runs[0].estimate.values, runs[1].estimate.values, rtol=1e-12)
    np.testing.assert_allclose(runs[0].estimate.values, one.estimate.values, rtol=0.01)  # one minimum: all starts lead there
    told = json.loads(runs[1].files[1].read_text(encoding="utf-8"))["starts"]
    assert len(told) == 3 and not any(row["fits_as_well_elsewhere"] or row["error"] for row in told)
    assert max(row["start"]["K"] for row in told) > 2.0 * min(row["start"]["K"] for row in told)
    assert "Where the searches ended" in runs[1].files[0].read_text(encoding="utf-8")


def test_a_worker_that_is_killed_costs_its_search_only(
    inputs: tuple[Path, Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study, cloud, sensor = inputs
    options: dict[str, Any] = {"shapes": [cloud], "forces": [sensor], "groups": "all", "point_sd_mm": 0.05, "starts": 3, "seed": 1}
    whole = calibrate_study(study, out=tmp_path / "whole", **options)
    searches = json.loads(whole.files[1].read_text(encoding="utf-8"))["starts"]
    victim = ("start", starting_values(whole.estimate.unknowns, 3, 1)[2])
    found = {}
    for times in (1, 99):
        begun = str(tmp_path / f"begun {times}")

        def task(name: str, function: Callable[..., Any], arguments: dict[str, Any], times: int = times, begun: str = begun) -> Task:
            return Task(name, partial(worker_tasks.killed_at, function, victim, times, begun), arguments)

        with monkeypatch.context() as patch:
            patch.setattr(calibration_starts, "Task", task)
            run = calibrate_study(study, out=tmp_path / f"killed {times}", workers=2, **options)
        assert Path(begun).read_text() == "xx"
        np.testing.assert_allclose(run.estimate.values, whole.estimate.values, rtol=0.01 if times > 1 else 1e-12)
        found[times] = json.loads(run.files[1].read_text(encoding="utf-8"))["starts"]
    assert found[1] == searches
    assert found[99][:2] == searches[:2] and "start 3: its worker died twice" in found[99][2]["error"]


def test_values_that_fit_as_well_widen_the_intervals(inputs: tuple[Path, Path, Path]) -> None:
    """A search that ends elsewhere with the same misfit is not told apart; one that fits worse is passed over."""
    study = prepared_study(inputs[0]).study
    unknowns = StudyUnknowns.of(study, groups="all")
    recorded = RecordedForces.of(study, [(1, 1e-3 * np.arange(1.0, 100.0, 2.0), np.ones((50, 3)))], sd_mn=1.0)
    problem = StudyProblem.of(unknowns, (), recorded, point_sd_mm=0.1)
    estimate = LatticeEstimate(unknowns, np.array([45.0, 5.0]), 1e-4 * np.eye(2), 1e4 * np.eye(2), (np.nan, 1.0), 1, 1, ())
    elsewhere, worse = replace(estimate, values=np.array([45.0, 10.0])), replace(estimate, values=np.array([90.0, 5.0]))
    ended = [(estimate, 100.0), (elsewhere, 102.0), (worse, 160.0)]
    searches = (*(StartedSearch(e.values, e, chi) for e, chi in ended), StartedSearch(np.ones(2), None, np.inf, "diverged"))
    found = best_of(problem, searches, complete=True)
    assert found.rivals == (1,)
    low, high = found.estimate.intervals().T
    assert low[1] < 5.0 < 10.0 < high[1]
    assert high[0] < 50.0
    with pytest.raises(ConvergenceError, match="diverged"):
        best_of(problem, searches[3:], complete=True)


def test_workers_without_several_starts_are_refused(inputs: tuple[Path, Path, Path], tmp_path: Path) -> None:
    study, _, sensor = inputs
    with pytest.raises(InputError, match="`starts` is 1"):
        calibrate_study(study, forces=[sensor], out=tmp_path / "out", groups="all", workers=2)
    with pytest.raises(InputError, match="starts is 0"):
        calibrate_study(study, forces=[sensor], out=tmp_path / "out", groups="all", starts=0)


def test_an_interruption_keeps_the_searches_that_ended(inputs: tuple[Path, Path, Path], tmp_path: Path) -> None:
    study, cloud, sensor = inputs

    def stop(report: ProgressReport) -> None:
        if report.stage == "calibrate" and report.total == 3 and report.done and report.done >= 1:
            raise KeyboardInterrupt

    run = calibrate_study(
        study, shapes=[cloud], forces=[sensor], out=tmp_path / "out", groups="all", point_sd_mm=0.05, starts=3, progress=stop
    )
    assert not run.estimate.finished
    assert len(json.loads(run.files[1].read_text(encoding="utf-8"))["starts"]) == 1
    assert run.estimate.values == pytest.approx(list(TRUTH.values()), rel=0.1)
