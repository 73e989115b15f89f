"""The command line: what it prints, what it writes, and one clear message for every mistake."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from virtual_press import KNOWN, Press, stop_at

from naibu import cli
from naibu.identification.from_markers.checks.marker_checks import Doubt
from naibu.identification.from_markers.specimen.specimen_model import ModelSettings
from naibu.io.experiment_folder.reader import read_experiment
from naibu.mechanics.finite_strain.newton import Newton
from naibu.workflows.markers import compare as comparison
from naibu.workflows.markers import identify as workflow

Run = Callable[..., tuple[int, str, str]]
COARSE = ("--element-size-mm", "20", "--known", KNOWN[0])


@pytest.fixture
def naibu(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Run:
    """Run a command in an empty folder; return exit code, output and messages."""
    place = tmp_path / "place"
    place.mkdir()
    monkeypatch.chdir(place)

    def run(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["naibu", *map(str, arguments)])
        try:
            cli.main()
            code = 0
        except SystemExit as end:
            code = int(end.code or 0)
        said = capsys.readouterr()
        return code, said.out, said.err

    return run


def refused(ended: tuple[int, str, str], *words: str) -> None:
    """A message that holds the words, and nothing written."""
    code, _, message = ended
    assert code == cli.BAD_INPUT, message
    assert message.startswith("error: ") and message.count("\n") <= 2 and "Traceback" not in message, message
    for word in words:
        assert word in message, message
    assert not [p for p in Path().rglob("*") if p.is_file()]


def test_identify_predict_report(naibu: Run, press: Press) -> None:
    code, out, _ = naibu("identify", press.folder, "--state", "press/pressed", *COARSE, "--out", "here")
    assert code == 0 and "press/pressed" in out and "firm on acrylic: friction" in out and "given" in out
    assert Path("here/model.json").read_bytes() == (press.results / "model.json").read_bytes()
    code, out, _ = naibu("predict", "here/model.json", press.folder, "--state", "pressed_more", "--heights-from-markers", "--out", "here")
    assert code == 0 and "125 markers: RMS x" in out and "follows from the mean z" in out
    summary = json.loads(Path("here/summary.json").read_text(encoding="utf-8"))
    assert f"3-D {summary['rms_3d_mm']:.3f} mm" in out
    for page in ("report", "predicted"):
        Path(f"here/{page}.html").unlink()
    code, out, _ = naibu("report", "here")
    assert code == 0 and Path("here/report.html").is_file() and Path("here/predicted.html").is_file()


def test_the_verdict_comes_first_and_decides_the_exit_code(naibu: Run, press: Press, monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = ("identify", press.folder, "--state", "press/pressed", *COARSE)
    code, out, _ = naibu(*arguments, "--out", "good")
    assert code == 0 and out.startswith("Explained, but moduli and Poisson's ratios hang on the assumed law: residuals of 0.3")
    doubt = Doubt("z seems to point towards the base", grave=True)
    monkeypatch.setattr(workflow, "check_markers", lambda *_: (doubt,))
    code, out, _ = naibu(*arguments, "--out", "bad")
    assert code == 3 and out.startswith(f"Not explained, do not use: {doubt.text}.")
    assert "do not" in out.splitlines()[0] and "not to be used" in out.splitlines()[-1] and "Converged." not in out
    assert {"model.json", "identification.json", "report.html"} <= set(os.listdir("bad"))
    code, out, _ = naibu("predict", "bad", press.folder, "--state", "pressed_more", "--height-mm", 46, "--out", "bad")
    assert code == 0 and "The model is doubtful: Not explained" in out


def test_compare_keeps_what_it_has_found(naibu: Run, press: Press, monkeypatch: pytest.MonkeyPatch) -> None:
    models = ("--law", "neo_hookean", "--law", "mooney_rivlin", "--contact", "coulomb", "--out", "compared")
    compare = comparison.compare_models
    done: list[str] = []

    def once(loaded: object, candidates: list[ModelSettings], **options: object) -> object:
        if done:
            raise KeyboardInterrupt
        done.append(candidates[0].law)
        return compare(loaded, candidates, **options)

    monkeypatch.setattr(comparison, "compare_models", once)
    assert naibu("compare", press.folder, *COARSE, *models)[0] == cli.INTERRUPTED
    (first,) = json.loads(Path("compared/comparison.json").read_text(encoding="utf-8"))
    assert first["result"]["noise_factor"] < 3.0 and first["result"]["left_out_mm"] is None
    monkeypatch.setattr(comparison, "compare_models", compare)
    code, out, _ = naibu("compare", press.folder, *COARSE, *models)
    assert code == 0 and "neo_hookean" in out and "mooney_rivlin" in out and "BIC above best" in out
    entries = json.loads(Path("compared/comparison.json").read_text(encoding="utf-8"))
    assert entries[0] == first and len(entries) == 2
    monkeypatch.setattr(comparison, "compare_models", None)  # nothing is left to be solved
    assert naibu("compare", press.folder, *COARSE, *models)[1] == out


@pytest.mark.parametrize("content", ["{", '{"a": 1}', "[1]"])
def test_a_damaged_comparison_is_kept(naibu: Run, press: Press, content: str) -> None:
    Path("compared").mkdir()
    file = Path("compared/comparison.json")
    file.write_text(content, encoding="utf-8")
    code, _, message = naibu("compare", press.folder, *COARSE, "--out", "compared")
    assert code == cli.BAD_INPUT and "comparison.json" in message and "delete it" in message
    assert file.read_text(encoding="utf-8") == content


def test_help_and_version_answer(naibu: Run) -> None:
    for verb in ("demo", "identify", "predict", "report", "import", "doctor"):
        code, out, _ = naibu(verb, "--help")
        assert code == 0 and verb in out
    assert naibu("--version")[0] == 0


def test_tables_become_an_experiment(naibu: Run, press: Press) -> None:
    tables = [press.folder / f"{name}.csv" for name in ("initial", "pressed")]
    code, out, _ = naibu("import", *tables, "--out", "mine", "--size-mm", 60, 60, 60, "--spacing-mm", 10)
    assert code == 0 and "naibu identify mine" in out
    assert sorted(os.listdir("mine")) == ["initial.csv", "meta.toml", "pressed.csv"]
    shutil.rmtree("mine")
    refused(naibu("import", *tables, tables[1], "--out", "mine", "--size-mm", 60, 60, 60), "'pressed'", "rename")


def test_tables_whose_labels_do_not_correspond_are_refused(naibu: Run, press: Press, tmp_path_factory: pytest.TempPathFactory) -> None:
    initial, pressed = (press.folder / f"{name}.csv" for name in ("initial", "pressed"))
    head, *rows = pressed.read_text().splitlines()
    cells = [row.split(",", 1) for row in rows]
    order = np.random.default_rng(0).permutation(len(rows))
    for name, shown in (
        ("shuffled", [f"{cells[i][0]},{cells[j][1]}" for i, j in enumerate(order)]),
        ("other", [f"{n},{cells[j][1]}" for n, j in enumerate(np.argsort([float(c[1].split(",")[0]) for c in cells]), start=1)]),
    ):
        table = tmp_path_factory.mktemp("tables") / f"{name}.csv"
        table.write_text("\n".join([head, *shown]) + "\n")
        done = naibu("import", initial, table, "--out", "mine", "--size-mm", 60, 60, 60)
        refused(done, name, "do not correspond", "row numbers")
    assert not Path("mine").exists()
    exchanged = [*rows]
    exchanged[3], exchanged[40] = f"{cells[3][0]},{cells[40][1]}", f"{cells[40][0]},{cells[3][1]}"
    Path("exchanged.csv").write_text("\n".join([head, *exchanged]) + "\n")
    code, out, _ = naibu("import", initial, "exchanged.csv", "--out", "mine", "--size-mm", 60, 60, 60)
    assert code == 0 and f"marker {cells[3][0]}, {cells[40][0]} moved unlike its neighbours" in out


def test_layers_and_heights_are_told_with_the_tables(naibu: Run, press: Press) -> None:
    tables = [press.folder / f"{name}.csv" for name in ("initial", "pressed")]
    shape = ("--out", "mine", "--size-mm", 60, 60, 60)
    layers = ("--layer", "soft=0..30", "--layer", "firm=30..60")
    assert naibu("import", *tables, *shape, *layers, "--stated-mm", "pressed=45")[0] == 0
    experiment = read_experiment(Path("mine"))
    assert [(la.material, la.from_base_mm, la.to_base_mm) for la in experiment.layers] == [("soft", 0.0, 30.0), ("firm", 30.0, 60.0)]
    assert experiment.loaded_states[0].stated_mm == 45.0
    shutil.rmtree("mine")
    refused(naibu("import", *tables, *shape, "--layer", "soft 0-30"), "soft 0-30", "NAME=FROM..TO")
    refused(naibu("import", *tables, *shape, "--stated-mm", "45"), "'45'", "STATE=HEIGHT")


def replaced(old: str, new: str, file: str = "meta.toml") -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        text = (folder / file).read_text(encoding="utf-8")
        assert old in text
        (folder / file).write_text(text.replace(old, new), encoding="utf-8")

    return change


def renumbered(folder: Path) -> None:
    lines = (folder / "pressed.csv").read_text(encoding="utf-8").splitlines()
    others = [lines[0]] + [",".join([str(1000 + int(line.split(",")[0])), *line.split(",")[1:]]) for line in lines[1:]]
    (folder / "pressed.csv").write_text("\n".join(others), encoding="utf-8")


def doubled(folder: Path) -> None:
    text = (folder / "pressed.csv").read_text(encoding="utf-8")
    (folder / "pressed.csv").write_text(text + text.splitlines()[1] + "\n", encoding="utf-8")


def rewritten(row: Callable[[list[str]], list[str]], file: str = "initial.csv", only: str = "") -> Callable[[Path], None]:
    """Change the cells of all rows of a table, or of the one marker named."""

    def change(folder: Path) -> None:
        head, *lines = (folder / file).read_text(encoding="utf-8").splitlines()
        cells = [line.split(",") for line in lines]
        kept = [",".join(row(c) if not only or c[0] == only else c) for c in cells]
        (folder / file).write_text("\n".join([head, *kept]), encoding="utf-8")

    return change


MISTAKES: dict[str, tuple[Callable[[Path], None], tuple[str, ...]]] = {
    "unknown key": (replaced("title =", "tilte ="), ("meta.toml", "tilte", "title")),
    "wrong units": (replaced('units = "mm"', 'units = "cm"'), ("meta.toml", "units", "cm", "millimetres")),
    "not TOML": (replaced("[object]", "[object"), ("meta.toml", "line")),
    "size not a number": (replaced("[60.0, 60.0, 60.0]", "[60.0, nan, 60.0]"), ("meta.toml", "size_mm", "nan")),
    "duplicate label": (doubled, ("pressed.csv", "marker 1")),
    "only NaN": (rewritten(lambda c: [c[0], "NaN", "NaN", "NaN", "missing", ""]), ("initial.csv", "no marker has all its coordinates")),
    "infinite": (rewritten(lambda c: [c[0], "inf", *c[2:]], only="7"), ("initial.csv", "inf")),
    "no number": (rewritten(lambda c: [c[0], "1,5".replace(",", ";"), *c[2:]], only="7"), ("initial.csv", "1;5")),
    "no common markers": (renumbered, ("pressed.csv", "initial.csv", "0 markers")),
    "layers leave a gap": (replaced("[30.0, 60.0]", "[31.0, 60.0]"), ("meta.toml", "layer", "gap", "30")),
    "layers do not cover": (replaced("[30.0, 60.0]", "[30.0, 50.0]"), ("meta.toml", "layer", "50 mm", "60 mm")),
    "marker outside": (rewritten(lambda c: [c[0], "500", *c[2:]], only="7"), ("initial.csv", "marker 7", "500")),
    "in centimetres": (
        rewritten(lambda c: [c[0], *(f"{float(v) / 10:.3f}" for v in c[1:4]), *c[4:]]),
        ("initial.csv", "unit", "nominal_spacing_mm"),
    ),
    "table lost": (lambda folder: (folder / "pressed.csv").unlink(), ("pressed.csv", "no such file")),
    "meta lost": (lambda folder: (folder / "meta.toml").unlink(), ("meta.toml", "no such file")),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_folder_that_cannot_be_used_is_refused(naibu: Run, experiment_folder: Path, mistake: str) -> None:
    change, words = MISTAKES[mistake]
    change(experiment_folder)
    refused(naibu("identify", experiment_folder, *COARSE, "--out", "here"), *words)


IDENTIFY_MISTAKES = {
    "unknown dataset": (("ct_cube_plat",), ("ct_cube_plat", "Did you mean 'ct_cube_plate'")),
    "no experiment": ((), ("naibu identify needs EXPERIMENTS", "naibu identify --help")),
    "twice": (("PRESS", "PRESS"), ("'press'", "once")),
    "unknown material": (("PRESS", "--known", "hard=200"), ("'hard'", "firm", "soft")),
    "no modulus": (("PRESS", "--known", "firm=2oo kPa"), ("firm=2oo kPa", "kPa")),
    "unknown unit": (("PRESS", "--known", "firm=200 psi"), ("psi", "MPa")),
    "negative modulus": (("PRESS", "--known", "firm=-200"), ("positive", "-200")),
    "mixed": (("PRESS", "--known", "firm=200", "--known", "soft"), ("soft", "each")),
    "two scales": (("PRESS", "--known", "firm", "--known", "soft"), ("only one material",)),
    "unknown state": (("PRESS", "--state", "press/squeezed"), ("'squeezed'", "pressed_more")),
    "state of another": (("PRESS", "--state", "cube/pressed"), ("'cube'", "press")),
    "unloaded state": (("PRESS", "--state", "press/initial"), ("press/initial", "not loaded", "pressed")),
    "no element size": (("PRESS", "--element-size-mm", "-3"), ("--element-size-mm", "-3", "positive")),
    "too many elements": (("PRESS", "--element-size-mm", "0.1"), ("0.1 mm", "elements")),
    "unknown law": (("PRESS", "--law", "rubber"), ("rubber", "neo_hookean")),
    "unknown option": (("PRESS", "--knwon", "firm"), ("--knwon",)),
    "two dimensions": (("us_agar",), ("us_agar", "two-dimensional")),
    "a file": (("META",), ("meta.toml",)),
}


@pytest.mark.parametrize("mistake", IDENTIFY_MISTAKES)
def test_identify_refuses(naibu: Run, press: Press, mistake: str) -> None:
    arguments, words = IDENTIFY_MISTAKES[mistake]
    places = {"PRESS": press.folder, "META": press.folder / "meta.toml"}
    refused(naibu("identify", *(places.get(a, a) for a in arguments), "--out", "here"), *words)


PREDICT_MISTAKES = {
    "no state chosen": (("MODEL", "PRESS"), ("2 loaded states", "pressed_more", "--state")),
    "unknown state": (("MODEL", "PRESS", "--state", "squeezed"), ("'squeezed'", "pressed_more")),
    "unloaded state": (("MODEL", "PRESS", "--state", "initial"), ("press/initial", "not loaded")),
    "too low": (("MODEL", "PRESS", "--state", "pressed", "--height-mm", "17"), ("17 mm", "30 %", "60 mm")),
    "too high": (("MODEL", "PRESS", "--state", "pressed", "--height-mm", "61"), ("61 mm", "60 mm")),
    "not a number": (("MODEL", "PRESS", "--state", "pressed", "--height-mm", "nan"), ("nan mm",)),
    "no number": (("MODEL", "PRESS", "--state", "pressed", "--height-mm", "low"), ("low", "--height-mm")),
    "two heights": (("MODEL", "PRESS", "--state", "pressed", "--height-mm", "50", "--heights-from-markers"), ("exclude each other",)),
    "model lost": (("nowhere/model.json", "PRESS", "--state", "pressed"), ("nowhere", "naibu identify")),
    "unknown dataset": (("MODEL", "prss"), ("'prss'", "ct_cube_plate")),
    "unknown material": (("MODEL", "ct_two_material_1"), ("hardness", "firm", "Identify")),
}


@pytest.mark.parametrize("mistake", PREDICT_MISTAKES)
def test_predict_refuses(naibu: Run, press: Press, mistake: str) -> None:
    arguments, words = PREDICT_MISTAKES[mistake]
    places = {"PRESS": press.folder, "MODEL": press.results / "model.json"}
    refused(naibu("predict", *(places.get(a, a) for a in arguments), "--out", "here"), *words)


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ("{", "", "JSON"),
        ('"naibu model 1"', '"naibu model 0"', "naibu model 0"),
        ('"covariance"', '"variance"', "covariance"),
        ('"law"', '"Law"', "settings law = None: must be there"),
        ('"unit"', '"units"', "unit"),
        ('"prior_sd": 2.0', '"prior_sd": -2.0', "prior"),
    ],
)
def test_a_damaged_model_is_refused(naibu: Run, press: Press, tmp_path: Path, old: str, new: str, word: str) -> None:
    text = (press.results / "model.json").read_text(encoding="utf-8")
    assert old in text
    (tmp_path / "model.json").write_text(text.replace(old, new, 1), encoding="utf-8")
    refused(naibu("predict", tmp_path, press.folder, "--state", "pressed", "--out", "here"), "model.json", word)


def test_heights_need_measured_markers(naibu: Run, press: Press, experiment_folder: Path) -> None:
    (experiment_folder / "pressed.csv").unlink()
    replaced('file = "pressed.csv"', "held_out = true")(experiment_folder)
    arguments = ("predict", press.results, experiment_folder, "--state", "pressed", "--heights-from-markers", "--out", "here")
    refused(naibu(*arguments), "press/pressed", "no measured markers", "--height-mm")


@pytest.mark.parametrize("verb", ["identify", "predict"])
def test_a_place_that_cannot_be_written_is_refused_first(naibu: Run, press: Press, tmp_path: Path, verb: str) -> None:
    (tmp_path / "file").write_text("mine", encoding="utf-8")
    inputs = (press.folder, *COARSE) if verb == "identify" else (press.results, press.folder, "--state", "pressed")
    for place in (tmp_path / "file", tmp_path / "file" / "below"):
        began = time.perf_counter()
        refused(naibu(verb, *inputs, "--out", place), "file", "--out")
        assert time.perf_counter() - began < 2.0
    assert (tmp_path / "file").read_text(encoding="utf-8") == "mine"


def test_report_needs_results(naibu: Run, press: Press) -> None:
    refused(naibu("report", press.folder), "holds no results")
    refused(naibu("report", "nowhere"), "nowhere", "holds no results")


@pytest.mark.parametrize("verb", ["identify", "predict"])
def test_a_solve_that_diverges_says_so(naibu: Run, press: Press, monkeypatch: pytest.MonkeyPatch, verb: str) -> None:
    # Newton's method finds no equilibrium beyond a tenth of the load
    for way in ("solve", "pseudo_transient"):
        found = getattr(Newton, way)
        monkeypatch.setattr(Newton, way, lambda self, u, anchors, load, way=found: None if load > 0.1 else way(self, u, anchors, load))
    inputs = (press.folder, *COARSE) if verb == "identify" else (press.results, press.folder, "--state", "pressed")
    code, _, message = naibu(verb, *inputs, "--out", "here")
    assert code == cli.FAILED and "Traceback" not in message
    assert "of the load" in message and "Refine the mesh" in message and "press/pressed" in message
    assert not [p for p in Path().rglob("*") if p.is_file()]


def test_the_reader_may_stop_it(naibu: Run, press: Press, monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = ("identify", press.folder, "--state", "press/pressed", *COARSE, "--out", "here")
    with monkeypatch.context() as patch:
        stop_at(patch, 3)
        code, out, _ = naibu(*arguments)
    assert code == cli.INTERRUPTED and "The same command continues from here" in out
    assert Path("here/model.json").is_file() and Path("here/checkpoint.json").is_file()
    assert naibu(*arguments)[0] == 0
    assert not Path("here/checkpoint.json").exists()


def test_control_c_in_a_real_process(press: Press, tmp_path: Path) -> None:
    out = tmp_path / "here"
    options = ["--known", KNOWN[0], "--element-size-mm", "15", "--out", str(out)]
    command = [sys.executable, "-m", "naibu", "identify", str(press.folder), *options]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        waited = time.monotonic() + 120.0
        while not (out / "checkpoint.json").is_file() and process.poll() is None and time.monotonic() < waited:
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        said, message = process.communicate(timeout=120)
    finally:
        process.kill()
    assert process.returncode == cli.INTERRUPTED and "Traceback" not in message, message
    assert "nterrupted" in said + message and "same command" in said + message
    assert (out / "checkpoint.json").is_file() and not [name for name in os.listdir(out) if name.endswith(".part")]
