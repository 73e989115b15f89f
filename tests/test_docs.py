"""What the documentation says of experiment folders is what the reader does."""

from __future__ import annotations

import importlib.util
import re
import shlex
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from cyclopts import CycloptsError

from naibu.cli import app
from naibu.io.experiment_folder import schema
from naibu.io.experiment_folder.reader import read_experiment
from naibu.io.experiment_folder.state_csv import OPTIONAL, REQUIRED, STATUSES
from naibu.mechanics.finite_elements.hyperelasticity import LAWS
from naibu.mechanics.linear_algebra.solver_selection import DIRECT_LIMIT, RECYCLING_FROM, SolverName

DOCS = Path(__file__).resolve().parent.parent / "docs"
PAGE = (DOCS / "experiment_folder.rst").read_text(encoding="utf-8")
TABLES = {name: getattr(schema, name) for name in dir(schema) if name.endswith("Table") and not name.startswith("_")}
# read from families of keys, for which the page gives examples
FAMILIES = {"rows_of_layers": "rows_layer_1", "values": "E_hardness_5_Pa"}


def block(language: str, number: int = 0) -> str:
    """Return a code block of the page."""
    found = re.findall(rf"^\.\. code-block:: {language}\n\n((?:   .*\n|\n)+)", PAGE, re.MULTILINE)
    return re.sub("^   ", "", found[number], flags=re.MULTILINE)


@pytest.mark.parametrize("name", [*TABLES, "Meta"])
def test_every_key_is_told_in_the_page(name: str) -> None:
    model = TABLES.get(name, schema.Meta)
    headings = {"coordinates", "object", "markers", "layer", "loading", "scanner", "gel", "state"} if name == "Meta" else set()
    for key, field in model.model_fields.items():
        told = FAMILIES.get(key, key)
        if key in headings:
            assert f"[{key}]" in PAGE, f"the table [{key}] is not told in experiment_folder.rst"
        elif field.is_required():
            assert f"**{told}**" in PAGE, f"{name}: the required key {told} is not told in bold in experiment_folder.rst"
        else:
            assert f"``{told}``" in PAGE, f"{name}: {told} is not told in experiment_folder.rst"


def test_every_column_and_status_is_told_in_the_page() -> None:
    for word in (*REQUIRED, *OPTIONAL, *STATUSES):
        assert f"``{word}``" in PAGE


def test_the_example_of_the_page_is_a_valid_experiment(tmp_path: Path) -> None:
    (tmp_path / "meta.toml").write_text(block("toml"), encoding="utf-8")
    for state in ("initial", "pressed"):
        (tmp_path / f"{state}.csv").write_text(block("text", 1), encoding="utf-8")
    experiment = read_experiment(tmp_path)
    assert experiment.materials == ("soft gel", "firm gel")
    assert experiment.loaded_states[0].stated_mm == 45.0
    assert experiment.initial.trusted.tolist() == [True, True, True, False, True, True]
    assert np.isnan(experiment.initial.points[4, 1])


def test_every_law_is_told() -> None:
    concepts = (DOCS / "concepts.rst").read_text(encoding="utf-8")
    for law in LAWS:
        assert f"``{law}``" in concepts


def test_every_linear_solver_is_told() -> None:
    concepts = (DOCS / "concepts.rst").read_text(encoding="utf-8")
    for name in get_args(SolverName):
        assert name == "automatic" or f"``{name}``" in concepts
    for limit in (DIRECT_LIMIT, DIRECT_LIMIT // 10, RECYCLING_FROM):
        assert f"{limit:,} unknowns".replace(",", " ") in concepts


@pytest.mark.parametrize(
    "page",
    [
        "motion",
        "viscoelasticity",
        "fields",
        "sensing",
        "lattices",
        "adaptive",
        "applications/sensing_chip",
        "applications/fingertip",
        "applications/mammography",
    ],
)
def test_the_example_of_a_page_runs(page: str, capsys: pytest.CaptureFixture[str]) -> None:
    text = (DOCS / f"{page}.rst").read_text(encoding="utf-8")
    found = re.findall(r"^\.\. code-block:: python\n\n((?:   .*\n|\n)+)", text, re.MULTILINE)
    assert found
    if importlib.util.find_spec("warp") is None:  # an extra of 400 MB, for a device that few have
        found = [code for code in found if "lattice_gpu" not in code]
    exec("\n".join(re.sub("^   ", "", code, flags=re.MULTILINE) for code in found), {})
    assert capsys.readouterr().out


def test_every_verb_is_told() -> None:
    page = (DOCS / "cli.rst").read_text(encoding="utf-8")
    verbs = [name for name in app if not name.startswith("-")]
    assert len(verbs) > 10
    assert [verb for verb in verbs if f".. naibu-help:: {verb}\n" not in page] == []


def test_commands_in_the_pages_can_be_parsed() -> None:
    pages = [*DOCS.rglob("*.rst"), *(DOCS / "tutorials_src").glob("*.py"), DOCS.parent / "README.md"]
    commands = []
    for page in pages:
        if {"gallery", "tutorials", "generated", "_build"} & set(page.relative_to(DOCS.parent).parts):
            continue
        text = page.read_text(encoding="utf-8").replace("\\\n", " ")
        commands += [(page.name, line) for line in re.findall(r"^ {0,8}(?:exec )?naibu ([a-z][^\n]*)$", text, re.MULTILINE)]
    assert len(commands) > 25
    for page_name, line in commands:
        words = shlex.split(re.sub(r"\s#.*| [|>] .*|\|\|.*|&& .*", "", line))
        if words[0] not in app or "…" in line:
            assert words[0] not in ("identify", "sense", "track"), (page_name, line)
            continue
        app.meta.parse_args(words, exit_on_error=False, print_error=False)
        own = [word for word in words if word not in ("--open", "--json", "--quiet")]
        if "--log" in own:
            del own[own.index("--log") : own.index("--log") + 2]
        try:
            app.parse_args(own, exit_on_error=False, print_error=False)
        except CycloptsError as error:
            raise AssertionError(f"{page_name}: naibu {line}: {error}") from error


def test_entries_of_the_bibliography_are_whole() -> None:
    text = (DOCS / "references.bib").read_text(encoding="utf-8")
    broken = [entry.partition(",")[0] for entry in re.split(r"\n(?=@)", text) if entry.count("{") != entry.count("}")]
    assert not broken, f"braces do not match in {broken}"


def test_citations_and_bibliography_agree() -> None:
    entries = re.findall(r"^@\w+\{(\w+),", (DOCS / "references.bib").read_text(encoding="utf-8"), re.MULTILINE)
    assert len(entries) == len(set(entries)), sorted(key for key in set(entries) if entries.count(key) > 1)
    pages = [*DOCS.glob("*.rst"), *(DOCS / "applications").glob("*.rst"), *(DOCS / "theory").glob("*.rst")]
    files = [*(DOCS.parent / "src").rglob("*.py"), *pages, *(DOCS / "gallery_src").glob("*"), *(DOCS / "tutorials_src").glob("*")]
    cited = {
        key.strip()
        for file in files
        for keys in re.findall(r":cite:\w+:`([^`]+)`", file.read_text(encoding="utf-8"))
        for key in keys.split(",")
    }
    assert cited <= set(entries), f"cited, but not in docs/references.bib: {sorted(cited - set(entries))}"
    assert set(entries) <= cited, f"in docs/references.bib, but cited nowhere: {sorted(set(entries) - cited)}"


CONTRIBUTING = (DOCS.parent / "CONTRIBUTING.md").read_text(encoding="utf-8")


def test_contributing_names_files_that_exist() -> None:
    named = set(re.findall(r"`([\w./-]+(?:\.(?:py|pyi|rst|md|toml|bib)|/))`", CONTRIBUTING))
    roots = (DOCS.parent, DOCS.parent / "src" / "naibu", DOCS.parent / "src" / "naibu" / "io", DOCS.parent / "src/naibu/mechanics/contact")
    formats = {f"src/naibu/io/{folder}/FORMAT.py" for folder in ("image_formats", "mesh_formats", "field_formats")}
    examples = {*formats, "workflows/VERB.py"}
    lost = sorted(name for name in named - examples if not any((root / name).exists() for root in roots))
    assert len(named) > 30 and not lost, lost


def test_contributing_shows_every_folder() -> None:
    (tree,) = re.findall(r"^src/naibu/\n((?:  .*\n)+)", CONTRIBUTING, re.MULTILINE)
    shown: set[str] = set()
    parent = ""
    for indent, name in re.findall(r"^( +)(\w+)/(?:\s|$)", tree, re.MULTILINE):
        parent = name if len(indent) == 2 else parent
        shown.add(name if len(indent) == 2 else f"{parent}/{name}")
    package = DOCS.parent / "src" / "naibu"
    folders = {path.parent.relative_to(package).as_posix() for path in package.rglob("__init__.py")} - {"."}
    told_within = ("mechanics/lattices/", "validation/", "viewer/", "reproduction/")  # their folders stand in the line of the parent
    assert {f for f in folders if f.count("/") < 2 and not f.startswith(told_within)} <= shown <= folders
