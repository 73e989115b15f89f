"""The way from a folder of measurements to a model, predictions and pages, and what happens when it is left early."""

from __future__ import annotations

import csv
import json
import os
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from html import escape
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
import worker_tasks
from virtual_press import COARSE, KNOWN, PLATEN_POSITIONS_MM, TRUTH, Press, stop_at

import naibu
from naibu.core.arrays import FloatArray
from naibu.core.errors import ConvergenceError, InputError, WorkerLostError
from naibu.core.experiment import Experiment
from naibu.core.status import Status
from naibu.identification.from_markers.calibration import Calibration
from naibu.identification.from_markers.known_materials import KnownMaterials
from naibu.identification.prediction import cross_validation as folds
from naibu.identification.verdict import Explanation
from naibu.io.experiment_folder.state_csv import parse_state_csv
from naibu.io.files import atomic
from naibu.viewer.result_page.page import report_html
from naibu.viewer.result_page.payload import report_json
from naibu.viewer.result_page.reading import report_from_json
from naibu.workflows import predict, report
from naibu.workflows.markers import cross_validation, identify
from naibu.workflows.markers.cross_validation import left_out_in_turn
from naibu.workflows.parallel.worker_count import Workers
from naibu.workflows.results.report_content import fitted_too, load_case_scene, prediction_report, prediction_scene
from naibu.workflows.results.result_folder import CHECKPOINT_FILE, MODEL_FILE, _identification_summary, read_model
from naibu.workflows.results.search_checkpoint import SearchCheckpoint

STATE = {"press": ["pressed"]}


def identified(folder: Path, out: Path, **options: object) -> identify.Identification:
    return identify.identify(folder, known=KNOWN, settings=COARSE, states=STATE, out=out, **options)  # type: ignore[arg-type]


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def names(folder: Path) -> set[str]:
    return set(os.listdir(folder))


def test_the_true_parameters_lie_near_the_identified_ones(press: Press) -> None:
    model = press.identification.model
    for name, value in TRUTH.items():
        p = next(q for q in model.parameters if q.name == name)
        if not p.fixed:  # the elements are coarse; four standard deviations allow for that
            assert abs(p.inner(value) - p.inner(p.value)) < 4.0 * model.standard_deviation(name)
    assert press.identification.calibration.match.status is Status.CONVERGED


def test_results_are_shown_in_a_notebook(press: Press) -> None:
    found = press.identification
    cards = re.compile(r"<dt>.*?</dd>")
    assert cards.findall(found.page_html()) == cards.findall((press.results / "report.html").read_text(encoding="utf-8")) != []
    assert escape(found.page_html(), quote=True) in found._repr_html_()
    written = json.loads((press.results / "identification.json").read_text(encoding="utf-8"))["parameters_95"]
    for row in found.to_records():
        assert row["estimate"] == pytest.approx(written[row["parameter"]]["estimate"], rel=1e-4)
    figure = found.plot()
    assert figure.axes[-1].get_xlabel() == "predicted from measured markers, RMS (mm)"
    plt.close(figure)


def test_results_are_complete(press: Press) -> None:
    expected = {"model.json", "identification.json", "residuals.csv", "report.html", "report.json", "press_pressed.vtkhdf"}
    assert names(press.results) == expected
    summary = json.loads((press.results / "identification.json").read_text(encoding="utf-8"))
    trial = summary["load_cases"]["press/pressed"]
    assert summary["status"] == "CONVERGED" and trial["markers"] == 125
    assert 0.8 < summary["noise_factor"] < 1.3
    assert trial["rms_3d_mm"] == pytest.approx(np.sqrt(sum(trial[f"rms_{a}_mm"] ** 2 for a in "xyz")))
    assert trial["rms_3d_mm"] < trial["baselines_rms_3d_mm"]["affine"] < trial["baselines_rms_3d_mm"]["rigid"]
    plate, table = (trial["reactions_mN"][name] for name in ("indenter of acrylic", "base of table"))
    np.testing.assert_allclose(plate, np.negative(table), atol=1e-4 * abs(table[2]))


def test_ratios_are_not_written_as_forces_and_kilopascals(press: Press) -> None:
    found = press.identification
    known = KnownMaterials(found.model.known_materials.young_moduli, scale_is_absolute=False)
    summary = _identification_summary(found.calibration, replace(found.model, known_materials=known), found.verdict, found.baselines, ())
    assert "reactions_mN" not in summary["load_cases"]["press/pressed"]
    (material, modulus), *_ = known.young_moduli.items()
    for name, told in summary["parameters_95"].items():
        if name.endswith("young_modulus"):
            p = next(p for p in found.model.parameters if p.name == name)
            assert told["unit"] == f"× {material}" and told["estimate"] == pytest.approx(p.value / modulus)


def test_files_and_page_tell_predicted_minus_measured(press: Press) -> None:
    calibration = press.identification.calibration
    fit, trial = calibration.match.fits[0], calibration.load_cases[0]
    table = rows(press.results / "residuals.csv")
    written = np.array([[float(r[f"residual_{a}_mm"]) for a in "xyz"] for r in table])
    np.testing.assert_allclose(written, fit.predicted - trial.measured, atol=1e-4)
    scene = load_case_scene(trial, fit, press.identification.model.parameters.values())
    # the scene stands in the object's frame; distances do not care
    np.testing.assert_allclose(np.linalg.norm(scene.residual_mm, axis=1), np.linalg.norm(fit.residual, axis=1), atol=1e-9)
    np.testing.assert_allclose(fit.pose.inverse().applied(fit.predicted), scene.steps[-1].markers, atol=1e-9)
    stored = report_from_json((press.results / "report.json").read_text(encoding="utf-8"))
    np.testing.assert_allclose(stored.scenes[0].residual_mm, scene.residual_mm, atol=1e-3)


def test_the_model_survives_its_file(press: Press) -> None:
    text = (press.results / MODEL_FILE).read_text(encoding="utf-8")
    model = read_model(press.results)
    assert model.to_dict() == json.loads(text) == press.identification.model.to_dict()
    np.testing.assert_array_equal(model.covariance, press.identification.model.covariance)


def test_two_runs_write_the_same_bytes(press: Press, tmp_path: Path) -> None:
    identified(press.folder, tmp_path)
    for name in ("model.json", "identification.json", "residuals.csv", "report.html"):
        assert (tmp_path / name).read_bytes() == (press.results / name).read_bytes(), name


def test_results_name_no_folder(press: Press) -> None:
    for path in press.results.iterdir():
        assert str(press.folder.parent).encode() not in path.read_bytes(), path.name


def test_every_marker_is_predicted(press: Press, tmp_path: Path) -> None:
    prediction = predict.predict(press.results / MODEL_FILE, press.folder, state="pressed_more", heights_from_markers=True, out=tmp_path)
    pages = (prediction.page_html(), (tmp_path / "predicted.html").read_text(encoding="utf-8"))
    assert len({tuple(re.findall(r"<h1>.*?</h1>|<p class=lead>.*?</p>", page)) for page in pages}) == 1
    np.testing.assert_array_equal([[r["x_mm"], r["y_mm"], r["z_mm"]] for r in prediction.to_records()], prediction.points)
    plt.close(prediction.plot())
    assert names(tmp_path) == {"predicted.csv", "summary.json", "predicted.html", "predicted.json", "predicted.vtu", "predicted.vtkhdf"}
    table = rows(tmp_path / "predicted.csv")
    assert list(table[0]) == ["marker", "x_mm", "y_mm", "z_mm", "sd_model_mm", "sd_mm", "sd_x_mm", "sd_y_mm", "sd_z_mm"]
    assert [int(r["marker"]) for r in table] == rows_of(press.folder / "initial.csv")
    assert prediction.platen_position_mm == pytest.approx(PLATEN_POSITIONS_MM["pressed_more"], abs=0.5)
    summary = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert summary["registered_to_measured"] and not summary["used_to_identify"]
    assert not fitted_too(prediction.model, prediction) and "no test of the model" not in pages[0]
    known_state = replace(prediction.model, load_cases=("press/pressed_more",))
    assert "no test of the model" in report_html(prediction_report(known_state, prediction))
    measured = {int(r["marker"]): [float(r[f"{a}_mm"]) for a in "xyz"] for r in rows(press.folder / "pressed_more.csv")}
    error = np.array([[float(r[f"{a}_mm"]) for a in "xyz"] for r in table]) - np.array([measured[int(r["marker"])] for r in table])
    assert summary["rms_3d_mm"] == pytest.approx(np.sqrt((error**2).sum(axis=1).mean()), abs=2e-3)
    assert summary["rms_3d_mm"] < 0.6
    sd = {name: np.array([float(r[name]) for r in table]) for name in table[0] if name.startswith("sd_")}
    along = np.stack([sd[f"sd_{a}_mm"] for a in "xyz"], axis=1)
    assert ((along.min(axis=1) <= sd["sd_mm"]) & (sd["sd_mm"] <= along.max(axis=1))).all()
    assert (sd["sd_model_mm"] < sd["sd_mm"]).all()
    assert np.mean(np.abs(error) < 1.96 * sd["sd_mm"][:, None]) > 0.9
    assert summary["interval"] == prediction.interval and summary["strain_ratio_to_calibration"] == pytest.approx(prediction.strain_ratio)
    scene = prediction_scene(prediction)
    np.testing.assert_allclose(np.linalg.norm(scene.residual_mm, axis=1), np.linalg.norm(error, axis=1), atol=2e-3)


def rows_of(path: Path) -> list[int]:
    return [int(r["marker"]) for r in rows(path)]


def test_a_prediction_needs_no_measured_state(press: Press, experiment_folder: Path, tmp_path: Path) -> None:
    (experiment_folder / "pressed_more.csv").unlink()
    meta = experiment_folder / "meta.toml"
    meta.write_text(meta.read_text(encoding="utf-8").replace('file = "pressed_more.csv"', "held_out = true"), encoding="utf-8")
    out = tmp_path / "out"
    blind = predict.predict(press.results, experiment_folder, state="pressed_more", height_mm=46.0, out=out)
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert not summary["registered_to_measured"] and summary["rms_3d_mm"] is None and summary["markers"] == 0
    seen = predict.predict(press.results, press.folder, state="pressed_more", height_mm=46.0)
    # without a measured state positions stand in the free scan's frame: the same shape, elsewhere
    for points in (blind.points, seen.points):
        points -= points.mean(axis=0)
    np.testing.assert_allclose(np.linalg.svd(blind.points)[1], np.linalg.svd(seen.points)[1], rtol=1e-6)


def test_results_are_not_replaced_unasked(press: Press, tmp_path: Path) -> None:
    (tmp_path / "press_pressed.vtkhdf").write_text("mine")
    with pytest.raises(InputError, match=r"holds press_pressed\.vtkhdf, an earlier result or a file of your own.*`overwrite`"):
        identified(press.folder, tmp_path)
    with pytest.raises(InputError, match=r"holds model\.json, residuals\.csv, identification\.json and 3 more"):
        identified(press.folder, press.results)
    (tmp_path / "summary.json").write_text("mine")
    with pytest.raises(InputError, match=r"holds summary\.json"):
        predict.predict(press.results, press.folder, state="pressed_more", out=tmp_path)
    predict.predict(press.results, press.folder, state="pressed_more", out=tmp_path, overwrite=True)
    assert (tmp_path / "summary.json").read_text() != "mine" and (tmp_path / "press_pressed.vtkhdf").read_text() == "mine"


def test_a_prediction_may_share_the_folder_of_its_model(press: Press, tmp_path: Path) -> None:
    identified(press.folder, tmp_path)
    before = {name: (tmp_path / name).read_bytes() for name in names(tmp_path)}
    predict.predict(tmp_path, press.folder, state="pressed_more", out=tmp_path)
    assert {name: (tmp_path / name).read_bytes() for name in before} == before


def test_pages_are_written_again_without_experiments(press: Press, tmp_path: Path) -> None:
    stored = (press.results / "report.json").read_text(encoding="utf-8")
    (tmp_path / "report.json").write_text(stored, encoding="utf-8")
    assert report.report(tmp_path) == [tmp_path / "report.html"]
    assert (tmp_path / "report.html").read_bytes() == (press.results / "report.html").read_bytes()
    assert report_json(report_from_json(stored)) == stored
    (tmp_path / "report.json").write_text(stored[: len(stored) // 2], encoding="utf-8")
    with pytest.raises(InputError, match=r"report\.json.*not JSON"):
        report.report(tmp_path)
    (tmp_path / "report.json").write_text(stored.replace('"role"', '"rule"'), encoding="utf-8")
    with pytest.raises(InputError, match=r"scenes\[0\]"):
        report.report(tmp_path)


def sister_of(folder: Path, place: Path) -> Path:
    """Rename a press to another one whose loaded scans are shifted: the same material, and no copy of a measurement."""
    other = folder.rename(place / "sister")
    for state in ("pressed", "pressed_more"):
        table = rows(other / f"{state}.csv")
        with (other / f"{state}.csv").open("w", newline="", encoding="utf-8") as stream:
            writer = csv.DictWriter(stream, list(table[0]))
            writer.writeheader()
            writer.writerows(row | {"x_mm": f"{float(row['x_mm']) + 0.25:.6g}"} for row in table)
    return other


def test_experiments_are_predicted_from_each_other(press: Press, experiment_folder: Path, tmp_path: Path) -> None:
    other = sister_of(experiment_folder, tmp_path)
    found = identify.identify([press.folder, other], known=KNOWN, settings=COARSE, states=STATE, cross_validate=True)
    assert {(r.experiment, r.state) for r in found.left_out} == {("press", "pressed"), ("sister", "pressed"), ("sister", "pressed_more")}
    assert all(r.rms_mm < 0.6 for r in found.left_out)
    used = {t.specimen.experiment.name: t.specimen.experiment for t in found.calibration.load_cases}
    used["press"] = replace(used["press"], states=tuple(s for s in used["press"].states if s.name != "pressed_more"))
    kept = SearchCheckpoint({}, folder=tmp_path)
    there, trouble = left_out_in_turn(list(used.values()), found.calibration, Workers(2), None, kept)
    assert trouble is None
    assert set(SearchCheckpoint.read(tmp_path, {}).models) == {"press", "sister"}
    here = {(r.experiment, r.state): r for r in found.left_out}
    assert [(r.experiment, r.state) for r in there] == list(here)
    for row in there:
        np.testing.assert_allclose(row.prediction.residual, here[row.experiment, row.state].prediction.residual, atol=1e-9)
    with pytest.raises(InputError, match="cross_validate"):
        identify.identify(press.folder, workers=2)


def test_a_worker_that_is_killed_costs_its_fold_only(press: Press, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calibration, fold = press.identification.calibration, cross_validation.predicted_from_others
    mine = calibration.load_cases[0].specimen.experiment
    mine = replace(mine, states=mine.states[:2])
    both, found = [mine, replace(mine, name="sister")], {}
    for times in (1, 99):  # the worker that takes the fold over computes it, or is killed as well
        folder, begun = tmp_path / f"kept {times}", tmp_path / f"begun {times}"
        folder.mkdir()
        task = partial(worker_tasks.killed_at, fold, ("left_out", "press"), times, str(begun))
        monkeypatch.setattr(cross_validation, "predicted_from_others", task)
        found[times], trouble = left_out_in_turn(both, calibration, Workers(2), None, SearchCheckpoint({}, folder=folder))
        assert begun.read_text() == "xx"
        assert isinstance(trouble, WorkerLostError) if times > 1 else trouble is None
        # what was lost is computed when the identification goes on
        assert set(SearchCheckpoint.read(folder, {}).models) == ({"sister"} if times > 1 else {"press", "sister"})
    (rescued, undisturbed), (left,) = found[1], found[99]
    assert [r.experiment for r in (rescued, undisturbed, left)] == ["press", "sister", "sister"]
    np.testing.assert_array_equal(left.prediction.residual, undisturbed.prediction.residual)
    # the two experiments hold the same markers, so that each predicts the other as the other does it, but for where the search starts
    np.testing.assert_allclose(rescued.prediction.residual, undisturbed.prediction.residual, atol=0.01)


def test_an_experiment_that_was_predicted_before_an_interruption_is_not_calibrated_again(
    press: Press, experiment_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other, out = sister_of(experiment_folder, tmp_path), tmp_path / "out"
    calibrated: list[list[str]] = []
    calibrate = folds.calibrate

    def kept() -> SearchCheckpoint:
        return SearchCheckpoint.read(out, json.loads((out / CHECKPOINT_FILE).read_text(encoding="utf-8"))["provenance"])

    def noted(experiments: Sequence[Experiment], **options: object) -> object:
        calibrated.append([e.name for e in experiments])
        return calibrate(experiments, **options)  # type: ignore[arg-type]

    def interrupted(experiments: Sequence[Experiment], **options: object) -> object:
        if experiments[0].name == "press":
            return calibrate(experiments, **options)  # type: ignore[arg-type]
        while "sister" not in kept().models:
            time.sleep(0.05)
        raise KeyboardInterrupt

    arguments: dict[str, Any] = {"known": KNOWN, "settings": COARSE, "states": STATE, "cross_validate": True, "out": out}
    monkeypatch.setattr(folds, "calibrate", interrupted)
    assert identify.identify([other, press.folder], **arguments).interrupted
    assert set(kept().models) == {"sister"}
    monkeypatch.setattr(folds, "calibrate", noted)
    found = identify.identify([other, press.folder], **arguments)
    assert calibrated == [["sister"]]  # what was interrupted: the model that has not seen the press
    assert not found.interrupted and {r.experiment for r in found.left_out} == {"press", "sister"}
    assert all(r.rms_mm < 0.6 for r in found.left_out) and CHECKPOINT_FILE not in names(out)


def test_an_interrupted_search_keeps_the_best_and_goes_on(press: Press, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        stop_at(patch, 3)
        found = identified(press.folder, tmp_path)
    assert found.interrupted and found.calibration.match.status is Status.INTERRUPTED
    assert "Interrupted" in (tmp_path / "report.html").read_text(encoding="utf-8")
    # the half-way model predicts
    predict.predict(tmp_path, press.folder, state="pressed_more")
    again = identified(press.folder, tmp_path)
    # the poses are registered anew, which may only help
    assert again.calibration.match.history[0] <= found.calibration.match.history[-1] * 1.001
    assert_same_result(again, press, tmp_path)


def assert_same_result(found: identify.Identification, press: Press, out: Path) -> None:
    assert not found.interrupted and CHECKPOINT_FILE not in names(out)
    reference, values = press.identification.model, found.model.parameters.values()
    for p in reference.parameters.free:
        # a search ends where the next step would lower chi squared by 0.12 at most, that is, within 0.35 standard deviations
        assert abs(p.inner(values[p.name]) - p.inner(p.value)) < 0.4 * reference.standard_deviation(p.name)


def test_an_interruption_before_there_is_a_result_goes_on_too(press: Press, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        stop_at(patch, 1)
        with pytest.raises(KeyboardInterrupt):
            identified(press.folder, tmp_path)
    assert names(tmp_path) <= {CHECKPOINT_FILE}
    assert_same_result(identified(press.folder, tmp_path), press, tmp_path)


@pytest.mark.parametrize("changed", ["settings", "damaged", "refused"])
def test_a_checkpoint_of_something_else_is_not_used(press: Press, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changed: str) -> None:
    with monkeypatch.context() as patch:
        stop_at(patch, 3)
        identified(press.folder, tmp_path)
    file = tmp_path / CHECKPOINT_FILE
    if changed == "settings":
        file.write_text(file.read_text(encoding="utf-8").replace('"tied"', '"sliding"'), encoding="utf-8")
    elif changed == "damaged":
        file.write_text("{", encoding="utf-8")
    before = {name: (tmp_path / name).read_bytes() for name in names(tmp_path)}
    with pytest.raises(InputError, match=r"holds model\.json.*a search with other inputs or settings that can be resumed.*`overwrite`"):
        identified(press.folder, tmp_path, resume=changed != "refused")
    assert {name: (tmp_path / name).read_bytes() for name in names(tmp_path)} == before
    again = identified(press.folder, tmp_path, resume=changed != "refused", overwrite=True)
    assert again.calibration.match.history == press.identification.calibration.match.history


@pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="needs signals of threads")
def test_an_interruption_while_comparing_loses_nothing(press: Press, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given = 0

    def interrupted(calibration: Calibration) -> Iterator[tuple[str, str, float]]:
        nonlocal given
        for given in range(1, 3000):  # a minute
            if given == 10:  # by when the main thread waits; in the callback of a weak reference, an interruption would be lost
                signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
            yield calibration.load_cases[0].name, "rigid", float(given)
            time.sleep(0.02)

    monkeypatch.setattr(identify, "baselines_of", interrupted)
    found = identified(press.folder, tmp_path)
    assert found.interrupted and CHECKPOINT_FILE in names(tmp_path)
    assert found.baselines[found.calibration.load_cases[0].name] == {"rigid": given} and given < 2999
    assert (tmp_path / MODEL_FILE).read_bytes() == (press.results / MODEL_FILE).read_bytes()


def test_an_experiment_left_out_that_cannot_be_predicted_loses_nothing(
    press: Press, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(*arguments: object, **options: object) -> None:
        raise ConvergenceError("no way")

    monkeypatch.setattr(cross_validation, "leave_one_out", failing)
    with pytest.raises(ConvergenceError, match="no way"):
        identified(press.folder, tmp_path, cross_validate=True)
    assert (tmp_path / MODEL_FILE).read_bytes() == (press.results / MODEL_FILE).read_bytes()


@pytest.mark.parametrize("failure", [KeyboardInterrupt(), OSError(28, "No space left on device")])
def test_an_interrupted_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failure: BaseException) -> None:
    file = tmp_path / "model.json"
    file.write_text("old", encoding="utf-8")

    def failing(_: int) -> None:
        raise failure

    monkeypatch.setattr(atomic.os, "fsync", failing)
    with pytest.raises((KeyboardInterrupt, InputError)):
        atomic.write_atomically(file, "new")
    assert names(tmp_path) == {"model.json"} and file.read_text(encoding="utf-8") == "old"


def test_the_verbs_are_functions_of_the_package() -> None:
    assert naibu.identify is identify.identify and naibu.predict is predict.predict and naibu.report is report.report
    assert naibu.datasets.load("ct_cube_plate").name == "ct_cube_plate" and "ct_cube_plate" in naibu.datasets.names()


def rewritten(file: Path, change: Callable[[FloatArray], FloatArray]) -> None:
    """Change the positions of a marker table."""
    read = parse_state_csv(file, file.read_bytes(), 3)
    lines = ["marker,x_mm,y_mm,z_mm", *(f"{i},{x},{y},{z}" for i, (x, y, z) in zip(read.ids, change(read.points).tolist(), strict=True))]
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")


def test_good_data_are_explained(press: Press) -> None:
    verdict = press.identification.verdict
    assert verdict.explanation is Explanation.EXPLAINED and verdict.reasons == () and verdict.outliers == ()
    summary = json.loads((press.results / "identification.json").read_text(encoding="utf-8"))
    assert next(iter(summary)) == "verdict"
    assert summary["verdict"]["explanation"] == "explained" and summary["verdict"]["sentence"] == verdict.sentence
    page = (press.results / "report.html").read_text(encoding="utf-8")
    assert page.index(escape(verdict.sentence)) < page.index("One set of parameters fits the markers of one loaded state")
    assert press.identification.model.reservation == ""


def test_a_misplaced_marker_is_named_in_every_result(press: Press, experiment_folder: Path, tmp_path: Path) -> None:
    def changed(points: FloatArray) -> FloatArray:
        points[59, 0] += 4.0  # too little to be seen before the model is there
        return points

    rewritten(experiment_folder / "pressed.csv", changed)
    out = tmp_path / "out"
    found = identified(experiment_folder, out)
    (sentence,) = found.verdict.outliers
    assert found.verdict.explanation is Explanation.EXPLAINED
    assert sentence.startswith("Marker 60 of press/pressed is 4") and "off along x: left out; 0.3" in sentence
    summary = json.loads((out / "identification.json").read_text(encoding="utf-8"))
    assert summary["verdict"]["left_out_markers"] == [sentence] and summary["load_cases"]["press/pressed"]["markers"] == 124
    assert sentence in (out / "report.html").read_text(encoding="utf-8")
    assert_same_result(found, press, out)


def test_two_tables_upside_down_are_not_explained(experiment_folder: Path, tmp_path: Path) -> None:
    """The fit is as good as with the true direction, and takes the soft gel for the firm one: 403 kPa for 99."""
    for name in ("initial", "pressed", "pressed_more"):
        rewritten(experiment_folder / f"{name}.csv", lambda points: points * [1.0, 1.0, -1.0])
    out = tmp_path / "out"
    found = identified(experiment_folder, out)
    assert found.model.noise_factor < 1.1
    assert found.verdict.explanation is Explanation.NOT_EXPLAINED and "z seems to point towards the base" in found.verdict.sentence
    assert read_model(out).reservation == found.verdict.sentence
    page = (out / "report.html").read_text(encoding="utf-8")
    assert '<div id="verdict" class="limits">' in page and "One set of parameters" not in page
    prediction = predict.predict(out, experiment_folder, state="pressed", height_mm=50.0)
    assert "The model is doubtful: Not explained, do not use" in prediction.notes[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [
        lambda p: p + np.random.default_rng(1).normal(size=p.shape) * 4.0,
        lambda p: np.roll(p, 1, axis=0),
        lambda p: p + np.column_stack([0.3 * p[:, 2], 0.0 * p[:, :2]]),
    ],
)
def test_motions_of_no_pressed_body_are_not_explained(
    experiment_folder: Path, tmp_path: Path, change: Callable[[FloatArray], FloatArray]
) -> None:
    rewritten(experiment_folder / "pressed.csv", change)
    found = identified(experiment_folder, tmp_path / "out")
    assert found.verdict.explanation is Explanation.NOT_EXPLAINED and "of its deformation" in found.verdict.sentence


@pytest.mark.slow
def test_overstated_noise_is_said_and_the_intervals_hold_the_truth(experiment_folder: Path, tmp_path: Path) -> None:
    meta = experiment_folder / "meta.toml"
    coarse = meta.read_text(encoding="utf-8").replace("xy_step_mm = 0.29", "xy_step_mm = 4.0").replace("z_step_mm = 0.5", "z_step_mm = 4.0")
    meta.write_text(coarse, encoding="utf-8")
    found = identified(experiment_folder, tmp_path / "out")
    assert found.model.noise_factor < 0.25 and "overstated about" in found.verdict.notes[0]
    for p in found.model.parameters.free:
        if p.name in TRUTH:
            low, high = found.model.interval(p.name)
            assert low <= TRUTH[p.name] <= high, p.name


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"pressed": lambda p: p[np.random.default_rng(1).permutation(len(p))]}, "labels of the two states do not"),
        ({"pressed": lambda p: p * [-1.0, 1.0, 1.0]}, "mirror image"),
        ({"initial": lambda p: p[:, [2, 1, 0]], "pressed": lambda p: p[:, [2, 1, 0]]}, "axes exchanged"),
    ],
)
def test_tables_that_cannot_belong_together_are_refused_before_anything_is_written(
    experiment_folder: Path, tmp_path: Path, changes: dict[str, Callable[[FloatArray], FloatArray]], words: str
) -> None:
    for name, change in changes.items():
        rewritten(experiment_folder / f"{name}.csv", change)
    with pytest.raises(InputError, match=words):
        identified(experiment_folder, tmp_path / "out")
    assert not (tmp_path / "out").exists()
