"""``--quiet``, ``--json``, ``--log`` and ``--open``, which every verb takes; ``naibu new``; what ``naibu import`` shows first."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
import webbrowser
from collections.abc import Callable
from pathlib import Path

import pytest
from virtual_press import Press

import naibu as package
from naibu import cli, datasets
from naibu.cli.shell.run_record import RunRecord
from naibu.cli.shell.version import checked_out_commit, version_text
from naibu.io.experiment_folder.reader import read_experiment
from naibu.io.experiment_folder.schema import Meta

Run = Callable[..., tuple[int, str, str]]
TABLES = [datasets.path("ct_cube_plate") / f"{name}.csv" for name in ("initial", "height_45")]
SIZE = ("--size-mm", 60, 60, 60)


@pytest.fixture
def naibu(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Run:
    """Run a command in an empty folder; return exit code, output and messages."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["naibu", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            cli.main()
        said = capsys.readouterr()
        return int(end.value.code or 0), said.out, said.err

    return run


def test_json_is_all_that_standard_output_gets(naibu: Run) -> None:
    code, out, err = naibu("import", *TABLES, *SIZE, "--json", "-o", "mine")
    told = json.loads(out)
    assert code == 0 == told["exit_code"] and told["files"] == ["mine"] and told["error"] is None
    (table,) = told["tables"]
    assert [row["markers"] for row in table["rows"]] == [125, 125]
    assert table["rows"][0]["span x, mm"] == pytest.approx(40.6)  # of the bundled table: 67.57 - 26.97
    assert "Tables as they are read" in err and "Wrote mine" in err


def test_json_holds_the_error_and_its_code(naibu: Run) -> None:
    code, out, err = naibu("--json", "import", *TABLES, "--size-mm", 60, 60, 60, "--unit", "furlong")
    told = json.loads(out)
    assert code == told["exit_code"] == 2 and "furlong" in told["error"] and told["error"] in " ".join(err.split("\n"))
    assert "--unit" in told["error"]  # options before the verb do not hide which verb it is


def test_quiet_says_nothing_unless_something_is_wrong(naibu: Run) -> None:
    assert naibu("import", *TABLES, *SIZE, "-q", "-o", "mine") == (0, "", "")
    code, out, err = naibu("import", *TABLES, *SIZE, "-q", "-o", "mine")
    assert code == 2 and not out and "--overwrite" in err


def test_the_log_keeps_what_was_said_and_how_it_ended(naibu: Run) -> None:
    naibu("import", *TABLES, *SIZE, "--quiet", "--log", "run.log")
    naibu("import", *TABLES, *SIZE, "--log", "run.log")
    text = Path("run.log").read_text(encoding="utf-8")
    assert "Wrote naibu-experiment" in text and "exit code 0" in text and "error: " in text and text.rstrip().endswith("exit code 2")
    code, _, err = naibu("new", "--log", "nowhere/run.log")
    assert code == 2 and "nowhere/run.log" in err and not Path("my_experiment").exists()


def test_open_shows_the_page(naibu: Run, press: Press, monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[str] = []
    monkeypatch.setattr(webbrowser, "open", shown.append)
    shutil.copytree(press.results, "results")
    code, _, _ = naibu("report", "results", "--open")
    assert code == 0 and len(shown) == 1 and shown[0].startswith("file://") and shown[0].endswith("results/report.html")
    naibu("new", "--open")
    assert len(shown) == 1


def test_numbers_that_json_lacks_become_null() -> None:
    run = RunRecord()
    run.add_table("t", ("a", "b"), [(float("nan"), float("inf")), (1.5, None)])
    assert json.loads(run.summary(0))["tables"][0]["rows"] == [{"a": None, "b": None}, {"a": 1.5, "b": None}]


def test_help_groups_verbs_by_task_and_its_examples_can_be_parsed(naibu: Run) -> None:
    code, out, _ = naibu("--help")
    assert code == 0
    heads = ["Start", "Markers", "Scans", "Simulate", "Touch", "Reproduce", "Output of every verb"]
    assert [out.index(f"─ {head}") for head in heads] == sorted(out.index(f"─ {head}") for head in heads)
    verbs = [name for name in cli.app if not name.startswith("-")]
    for verb in verbs:
        epilogue = cli.app[verb].help_epilogue
        examples = [line.strip() for line in epilogue.splitlines() if line.startswith("  naibu ")]
        assert examples, f"naibu {verb} --help shows no example"
        for example in examples:
            for command in example.partition(" > ")[0].split(" && "):
                tokens = shlex.split(command)[1:]
                cli.app.meta.parse_args(tokens, exit_on_error=False, print_error=False)
                cli.app.parse_args([t for t in tokens if t not in ("--open", "--json")], exit_on_error=False, print_error=False)


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_knows_verbs_and_their_options(shell: str) -> None:
    script = cli.app.meta.generate_completion(shell=shell)
    for word in ("identify", "compare-methods", "diameter-mm", "quiet"):
        assert word in script


def test_a_new_experiment_is_valid_and_tells_its_keys(naibu: Run) -> None:
    code, out, _ = naibu("new", "-o", "my_gel")
    assert code == 0 and "naibu identify my_gel" in out
    experiment = read_experiment(Path("my_gel"))
    assert len(experiment.initial.ids) == 125 and [s.stated_mm for s in experiment.loaded_states] == [45.0]
    text = Path("my_gel/meta.toml").read_text(encoding="utf-8")
    proposed = [re.sub("^# (?=\\w+ = )", "", line) for line in text.splitlines()]
    keys = Meta.model_validate(tomllib.loads("\n".join(proposed)))  # also those that stand there as comments
    assert keys.source and keys.coordinates.xy_sd_mm == 0.13
    code, _, err = naibu("new", "-o", "my_gel")
    assert code == 2 and "meta.toml" in err and "--overwrite" in err


@pytest.mark.parametrize("kind", ["lattice", "indentation", "chip", "fingertip", "ischemia"])
def test_a_new_study_is_the_example_of_its_kind(naibu: Run, kind: str) -> None:
    code, out, _ = naibu("new", kind, "-o", "here/study.toml")
    assert code == 0 and "naibu simulate here/study.toml" in out
    assert "#" in Path("here/study.toml").read_text(encoding="utf-8")
    tomllib.loads(Path("here/study.toml").read_text(encoding="utf-8"))


def test_preview_writes_nothing_and_centimetres_are_not_taken_for_millimetres(naibu: Run) -> None:
    assert naibu("import", *TABLES, *SIZE, "--preview")[0] == 0
    assert not list(Path().iterdir())
    for n, table in enumerate(TABLES):
        head, *rows = table.read_text(encoding="utf-8").splitlines()
        cells = [row.split(",") for row in rows]
        text = "\n".join([head.replace("_mm", ""), *(",".join([c[0], *(f"{float(v) / 10:.4f}" for v in c[1:4]), *c[4:]]) for c in cells)])
        Path(f"{n}.csv").write_text(text, encoding="utf-8")
    code, _, err = naibu("import", "0.csv", "1.csv", *SIZE)
    assert code == 2 and "in cm they would fill it" in err and "--unit" in err
    assert naibu("import", "0.csv", "1.csv", *SIZE, "--unit", "cm")[0] == 0
    assert read_experiment(Path("naibu-experiment")).initial.points[0] == pytest.approx([26.97, 64.67, 12.0], abs=1e-3)


def test_the_commit_is_that_of_git(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def git(*arguments: str) -> str:
        options = ("-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false")
        return subprocess.run(["git", *options, *arguments], cwd=tmp_path, check=True, capture_output=True, text=True).stdout.strip()

    assert checked_out_commit(tmp_path) == ""
    git("init", "-q")
    git("commit", "-q", "--allow-empty", "-m", "first")
    commit = git("rev-parse", "HEAD")
    assert checked_out_commit(tmp_path) == commit[:7]
    monkeypatch.setattr(package, "__file__", str(tmp_path / "src" / "naibu" / "__init__.py"))
    monkeypatch.setattr("naibu.cli.shell.version.files", lambda name: tmp_path / name)  # no wheel, which records its commit
    assert version_text() == f"{package.__version__} (commit {commit[:7]})"
    git("pack-refs", "--all")
    assert checked_out_commit(tmp_path) == commit[:7]
    git("worktree", "add", "-q", "other")
    assert checked_out_commit(tmp_path / "other") == commit[:7]
    git("checkout", "-q", "--detach")
    assert checked_out_commit(tmp_path) == commit[:7]
