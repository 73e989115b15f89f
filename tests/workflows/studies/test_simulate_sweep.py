"""Sweeps of lattice studies: their points, their rows, interruption, and what is refused."""

import csv
import json
import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import worker_tasks
from lattice_studies import STUDY, study_file

from naibu.core.errors import InputError
from naibu.core.progress import ProgressReport
from naibu.io.study_schemas.sweep_schema import SweepFile, load_sweep
from naibu.workflows.studies.simulate import simulate
from naibu.workflows.studies.simulate_lattice import simulate_lattice
from naibu.workflows.studies.sweeps import simulate_sweep
from naibu.workflows.studies.sweeps.simulate_sweep import prepared_sweep, sweep_text
from naibu.workflows.studies.sweeps.sweep_design import design

SWEEP = """
[sweep]
study = "mine.toml"
method = "grid"
[[parameter]]
key = "parameters.K"
values = [20.0, 60.0]
[[parameter]]
key = "indenter.ball.radius_mm"
low = 6.0
high = 8.0
count = 2
"""


def sweep_file(folder: Path, text: str = SWEEP) -> Path:
    study_file(folder)
    path = folder / "varied.toml"
    path.write_text(text, encoding="utf-8")
    return path


def sampled(method: str, samples: int, seed: int = 0) -> SweepFile:
    text = (
        f'[sweep]\nstudy = "x"\nmethod = "{method}"\nsamples = {samples}\nseed = {seed}\n'
        '[[parameter]]\nkey = "a"\nlow = -1.0\nhigh = 3.0\n[[parameter]]\nkey = "b"\nlow = 1.0\nhigh = 100.0\nscale = "log"\n'
    )
    return load_sweep("sweep.toml", text.encode())


def test_a_grid_has_all_combinations() -> None:
    found = design(load_sweep("s.toml", SWEEP.encode()))
    assert found.tolist() == [[20.0, 6.0], [20.0, 8.0], [60.0, 6.0], [60.0, 8.0]]


def test_a_latin_hypercube_has_one_point_in_every_layer() -> None:
    found = design(sampled("latin_hypercube", 25))
    layers = np.stack([np.floor(25 * (found[:, 0] + 1.0) / 4.0), np.floor(25 * np.log10(found[:, 1]) / 2.0)])
    assert np.array_equal(np.sort(layers, axis=1), np.tile(np.arange(25.0), (2, 1)))


def test_sobol_points_fill_every_quarter_and_longer_sequences_begin_with_shorter_ones() -> None:
    found = design(sampled("sobol", 16))
    quarters = np.floor(4 * (found[:, 0] + 1.0) / 4.0) * 4 + np.floor(4 * np.log10(found[:, 1]) / 2.0)
    assert sorted(quarters) == list(range(16))  # a (0, 4, 2)-net: one point in every cell of 4 x 4
    assert np.array_equal(design(sampled("sobol", 6)), found[:6])
    assert not np.array_equal(design(sampled("sobol", 16, seed=1)), found)


def test_rows_are_those_of_single_runs_whatever_the_number_of_workers(tmp_path: Path) -> None:
    source = sweep_file(tmp_path)
    reports: list[ProgressReport] = []
    one = simulate(source, out=tmp_path / "one", progress=reports.append)
    simulate(source, out=tmp_path / "two", workers=2)
    assert one.finished and (one.frames, one.parts) == (4, "runs") and reports[-1].done == reports[-1].total == 4
    kept = json.loads((tmp_path / "one" / "varied.json").read_text(encoding="utf-8"))
    assert kept["rows"] == json.loads((tmp_path / "two" / "varied.json").read_text(encoding="utf-8"))["rows"]
    changed = STUDY.replace("K = 40.0", "K = 60.0").replace("radius_mm = 8.0", "radius_mm = 6.0")
    single = tmp_path / "single.toml"
    single.write_text(changed, encoding="utf-8")
    simulate_lattice(single, tmp_path / "single")
    told = json.loads((tmp_path / "single" / "single.json").read_text(encoding="utf-8"))
    row = kept["rows"][2]
    assert row["values"] == {"parameters.K": 60.0, "indenter.ball.radius_mm": 6.0} and row["problem"] == ""
    force = np.linalg.norm(told["forces_mN"]["ball"], axis=1)
    assert row["figures"]["largest force of ball, mN"] == pytest.approx(force.max(), rel=1e-9)
    assert row["figures"]["work of ball, mN mm"] == pytest.approx(told["work_mN_mm"]["ball"][-1], rel=1e-9)
    with (tmp_path / "one" / "varied.csv").open(newline="", encoding="utf-8") as stream:
        lines = list(csv.DictReader(stream))
    assert [float(line["parameters.K"]) for line in lines] == [20.0, 20.0, 60.0, 60.0]
    page = (tmp_path / "one" / "varied.html").read_text(encoding="utf-8")
    assert "4 runs." in page and "largest force of ball, mN" in page


def test_a_run_that_cannot_be_computed_is_a_row_that_says_why(tmp_path: Path) -> None:
    text = SWEEP.replace("low = 6.0\nhigh = 8.0", "low = 8.0\nhigh = 20.0")  # the larger ball would start inside the object
    simulate(sweep_file(tmp_path, text), out=tmp_path / "out")
    rows = json.loads((tmp_path / "out" / "varied.json").read_text(encoding="utf-8"))["rows"]
    assert [bool(row["problem"]) for row in rows] == [False, True, False, True]
    assert "centre_mm" in rows[1]["problem"] and rows[1]["figures"]["largest displacement, mm"] is None
    page = (tmp_path / "out" / "varied.html").read_text(encoding="utf-8")
    assert page.count("begins inside the object") == 1  # one reason, with the runs that have it
    assert re.search(r"Runs that could not be computed.*2, 4.*begins inside", page, re.DOTALL)
    assert "parameters.\u200bK, mN/mm" in page


@pytest.mark.parametrize("times", [1, 99])
def test_a_worker_that_is_killed_costs_its_run_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, times: int) -> None:
    source, run = sweep_file(tmp_path), simulate_sweep.run_of_sweep
    victim = ("document", prepared_sweep(source).documents[1])
    simulate(source, out=tmp_path / "whole")
    monkeypatch.setattr(simulate_sweep, "run_of_sweep", partial(worker_tasks.killed_at, run, victim, times, str(tmp_path / "begun")))
    assert simulate(source, out=tmp_path / "killed", workers=2).finished
    assert (tmp_path / "begun").read_text() == "xx"
    whole, killed = (json.loads((tmp_path / name / "varied.json").read_text(encoding="utf-8"))["rows"] for name in ("whole", "killed"))
    lost = times > 1
    assert [row for k, row in enumerate(killed) if k != 1 or not lost] == [row for k, row in enumerate(whole) if k != 1 or not lost]
    assert ("run 2: its worker died twice (killed by SIGKILL)" in killed[1]["problem"]) == lost


def test_an_interrupted_sweep_keeps_its_runs_and_goes_on(tmp_path: Path) -> None:
    source, out = sweep_file(tmp_path), tmp_path / "out"

    def stop(report: ProgressReport) -> None:
        if report.done is not None and report.done >= 2:
            raise KeyboardInterrupt

    run = simulate(source, out=out, progress=stop)
    assert (run.frames, run.of) == (2, 4) and not run.finished
    assert len(json.loads((out / "varied.json").read_text(encoding="utf-8"))["rows"]) == 2
    with pytest.raises(InputError, match="`resume`"):
        simulate(source, out=out)
    kept = out / "varied.runs.jsonl"
    kept.write_text(kept.read_text(encoding="utf-8") + '{"run": 2, "figu', encoding="utf-8")  # killed while it wrote
    assert simulate(source, out=out, resume=True).finished and not kept.exists()
    simulate(source, out=tmp_path / "whole")
    assert (out / "varied.csv").read_bytes() == (tmp_path / "whole" / "varied.csv").read_bytes()
    with pytest.raises(InputError, match="nothing to resume"):
        simulate(source, out=out, resume=True)


def test_a_sweep_that_never_began_leaves_nothing_behind(tmp_path: Path) -> None:
    source, out = sweep_file(tmp_path), tmp_path / "out"

    def stop(report: ProgressReport) -> None:
        if "sweep" in report.stage:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(source, out=out, progress=stop)
    assert not out.exists()
    pytest.importorskip("distributed")
    with pytest.raises(InputError, match="no Dask scheduler"):
        simulate(source, out=out, cluster="wrong://127.0.0.1:9")
    assert not out.exists()


def test_kept_runs_of_another_sweep_are_refused(tmp_path: Path) -> None:
    source, out = sweep_file(tmp_path), tmp_path / "out"

    def stop(report: ProgressReport) -> None:
        if report.done is not None and report.done >= 1:
            raise KeyboardInterrupt

    simulate(source, out=out, progress=stop)
    sweep_file(tmp_path, SWEEP.replace("60.0", "70.0"))
    with pytest.raises(InputError, match="other settings"):
        simulate(source, out=out, resume=True)


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("parameters.K", "parameters.KK", "KK"),
        ("parameters.K", "nowhere.K", "'nowhere'"),
        ("parameters.K", "lattice", "no number"),
        ("parameters.K", "floor.contact", "no number"),
        ("parameters.K", "object.size_mm.w", "use one of"),
        ("parameters.K", "parameters.K.short.x", "no table"),
        ("indenter.ball", "indenter.stick", "use one of ball"),
        ("values = [20.0, 60.0]", "values = [20.0, -60.0]", r"run 3, parameters.K = -60.*\[parameters\] K"),
        ("values = [20.0, 60.0]", "values = [20.0, 20.0]", "twice"),
        ("values = [20.0, 60.0]", "values = []", "values"),
        ("count = 2", "count = 60000", "more than 100000"),
        ("count = 2", "", "needs count"),
        ("low = 6.0", "low = 9.0", "less than high"),
        ("low = 6.0", 'low = -6.0\nscale = "log"', "positive"),
        ('method = "grid"', 'method = "sobol"', "needs samples"),
        ('method = "grid"', 'method = "sobol"\nsamples = 4', "belong to method"),
        ('method = "grid"', 'method = "gird"', "method"),
        ('"mine.toml"', '"absent.toml"', "absent.toml"),
        ('"mine.toml"', '"varied.toml"', "is not a known key"),
        ('key = "indenter.ball.radius_mm"', 'key = "parameters.K"', "given twice"),
    ],
)
def test_sweeps_that_cannot_be_are_refused_before_anything_is_written(tmp_path: Path, old: str, new: str, told: str) -> None:
    assert old in SWEEP
    source = sweep_file(tmp_path, SWEEP.replace(old, new, 1))
    with pytest.raises(InputError, match=told):
        simulate(source, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_workers_and_devices_that_do_not_fit(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="one run"):
        simulate(study_file(tmp_path), out=tmp_path / "out", workers=2)
    with pytest.raises(InputError, match="device"):
        simulate(sweep_file(tmp_path), out=tmp_path / "out", device="cuda")


def test_the_template_is_a_sweep_of_a_study_that_comes_with_naibu() -> None:
    found = load_sweep("sweep.toml", sweep_text().encode())
    assert design(found).shape == (16, 3) and found.sweep.study == "dough-pressed-by-sphere"
