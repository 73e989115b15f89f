"""The rules of the house: style, types, layers, lengths, docstrings, and what must not stand in any file."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SOURCES = ROOT / "src"
LONGEST_FILE, LONGEST_FUNCTION = 450, 60
TEXT = {".py", ".md", ".toml", ".rst", ".cff", ".js", ".mjs", ".css", ".sh", ".txt", ".cfg", ".yml", ".yaml", ""}
NOT_OURS = {"__pycache__", "node_modules", "assets", "build", "dist", "_build", "gallery", "generated", "LICENSE"}
# loaded by none but those who ask for what they do
ON_DEMAND = (
    "cyclopts",
    "dask",
    "distributed",
    "h5py",
    "matplotlib",
    "mkl",
    "openpyxl",
    "pydantic",
    "pyvista",
    "rich",
    "SimpleITK",
    "starlette",
    "vtk",
    "warp",
    "zarr",
)

Function = ast.FunctionDef | ast.AsyncFunctionDef


def passes(*command: str) -> None:
    """Run a tool in the repository's root and show what it said where it fails."""
    environment = os.environ | {"PYTHONPATH": str(SOURCES), "NO_COLOR": "1", "COLUMNS": "150"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.fail(f"{' '.join((Path(command[0]).name, *command[1:]))}\n{done.stdout}{done.stderr}", pytrace=False)


def none_of(found: list[str], rule: str) -> None:
    if found:
        pytest.fail(f"{rule}\n" + "\n".join(f"  {line}" for line in found), pytrace=False)


def python_files(*folders: str) -> list[Path]:
    return sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py"))


def functions(path: Path) -> Iterator[Function]:
    return (node for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, Function))


def place(path: Path, line: int) -> str:
    return f"{path.relative_to(ROOT).as_posix()}:{line}"


def test_style() -> None:
    passes(sys.executable, "-m", "ruff", "check", "--output-format=concise", ".")


def test_types() -> None:
    passes(sys.executable, "-m", "mypy", "--strict")


def test_layers() -> None:
    passes(str(Path(sysconfig.get_path("scripts")) / "lint-imports"), "--no-logo", "--no-cache")


def test_files_are_short() -> None:
    lengths = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in python_files("src", "benchmarks")}
    long = [f"{place(path, n)}: {n} lines" for path, n in lengths.items() if n > LONGEST_FILE]
    none_of(long, f"a file has at most {LONGEST_FILE} lines: split it where a second concept begins")


def test_functions_are_short() -> None:
    long = []
    for path in python_files("src", "benchmarks"):
        for function in functions(path):
            docstring = ast.get_docstring(function, clean=False)
            n = (function.end_lineno or 0) - function.lineno + 1 - (len(docstring.splitlines()) if docstring else 0)
            if n > LONGEST_FUNCTION:
                long.append(f"{place(path, function.lineno)} {function.name}: {n} lines")
    none_of(long, f"a function has at most {LONGEST_FUNCTION} lines without its docstring")


def test_everything_public_has_a_docstring() -> None:
    bare = []
    for path in python_files("src"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        if ast.get_docstring(tree) is None:
            bare.append(f"{place(path, 1)} the module")
        bodies = [tree.body] + [node.body for node in tree.body if isinstance(node, ast.ClassDef) and not node.name.startswith("_")]
        for node in (node for body in bodies for node in body):
            if isinstance(node, Function | ast.ClassDef) and not node.name.startswith("_") and ast.get_docstring(node) is None:
                bare.append(f"{place(path, node.lineno)} {node.name}")
    none_of(bare, "modules, and public classes, functions and methods, say what they are")


def test_messages_of_the_library_name_no_options() -> None:
    option = re.compile(r"(?<![\w-])--[a-z][a-z-]+")
    found = []
    for path in (p for p in python_files("src") if "cli" not in p.relative_to(SOURCES / "naibu").parts):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        raised = (node for error in ast.walk(tree) if isinstance(error, ast.Raise) for node in ast.walk(error))
        words = (node for node in raised if isinstance(node, ast.Constant) and isinstance(node.value, str))
        found += [f"{place(path, node.lineno)} {node.value.strip()[:80]}" for node in words if option.search(node.value)]
    none_of(found, "errors name arguments of functions; the command line shows them as its options")


def test_no_file_holds_what_belongs_elsewhere() -> None:
    parents = [str(parent) for parent in ROOT.parents if parent != parent.parent]
    folders = "|".join(re.escape(folder.rstrip("/")) for folder in ["/home", "/root", "/Users", "/tmp", "/mnt", "/opt", "/srv", *parents])
    rules = {
        "path of one machine": re.compile(rf"(?<![\w./:~-])(?:{folders})/\w"),
        "package index": re.compile(r"index-url|https?://[\w.-]*(?:pypi|registry|artifact|nexus|mirror)[\w.-]*", re.IGNORECASE),
        "left open": re.compile(r"\b(?:TODO|FIXME|XXX)\b"),
        "left from a merge": re.compile(r"^(?:<{7} |>{7} )"),
    }
    found = []
    for path in text_files():
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            found += [f"{place(path, number)} {what}: {line.strip()[:100]}" for what, rule in rules.items() if rule.search(line)]
    none_of(found, "files name no machine's folders and no package index, and leave nothing open")


# words that earlier versions used for terms of the field, as regular expressions, and the terms
PRIVATE_WORDS = {
    r"[Pp]usher": "indenter",
    r"[Gg]r[ea]y[ -]values?\b|[Gg]r[ea]y[ _-]rms\b|[Gg]rey RMS": "intensity, intensity residual RMS",
    r"\b[Ss]lopes? of (?:the )?(?:grey|gray|both)": "image intensity gradient",
    r"(?:field|incremental|whitened|force)[ _]balance": "equilibrium gap, weighted equilibrium gap",
    r"\b[Ss]welling": "dilatation penalty",
    r"\b[Ll]ikeness": "normalised cross-correlation",
    r"\b[Ww]aver": "perturb",
    r"\b[Ss]tiff[ _]bod(?:y|ies)": "rigid inclusion",
    r"place_voxels|scatter of place": "sub-voxel jitter SD",
    r"\b[Ss]pec [A-Z]\d?\b": "a citation, or the chapter of the report",
    r"\b[Gg]lued\b": "tied",
    r"\b[Tt]eam\b": "thread pool",
    r"HeldNodes|\b[Hh]eld (?:nodes?|mass(?:es)?|faces)\b": "constrained",
    r"\bKnowledge\b": "known materials",
    r"\bNearby\b|\bHint\b": "warm start",
    r"\b[Ff]ree (?:state|shape|configuration)\b": "reference configuration, unloaded",
    r"\b[Dd]ampers?\b": "dashpot",
    r"\b[Dd]epartures?\b": "residual from the local affine fit",
}


def test_terms_are_those_of_the_field() -> None:
    own = ("src/", "docs/", "tests/", "benchmarks/", "viewer-src/", "README.md", "CONTRIBUTING.md")
    rules = {re.compile(word): term for word, term in PRIVATE_WORDS.items()}
    found = []
    for path in text_files():
        name = path.relative_to(ROOT).as_posix()
        if not name.startswith(own) or name == "docs/glossary.rst":  # which lists other names on purpose
            continue
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            found += [f"{place(path, number)} {m[0]!r}: write {term}" for rule, term in rules.items() if (m := rule.search(line))]
    none_of(found, "terms are those of the field (docs/glossary.rst)")


def text_files() -> list[Path]:
    kept = []
    for folder, folders, files in os.walk(ROOT):
        folders[:] = [name for name in folders if name not in NOT_OURS and (not name.startswith(".") or name == ".ci")]
        kept += [Path(folder, name) for name in files if Path(name).suffix in TEXT and name not in NOT_OURS and not name.startswith(".")]
    return sorted(path for path in kept if path != Path(__file__).resolve())


def loaded_modules(statement: str) -> set[str]:
    command = [sys.executable, "-c", f"import sys; {statement}; print(*sys.modules)"]
    return set(subprocess.run(command, capture_output=True, text=True, check=True).stdout.split())


def loaded_by(statement: str) -> set[str]:
    return {name.partition(".")[0] for name in loaded_modules(statement)} & set(ON_DEMAND)


def test_importing_naibu_is_light() -> None:
    assert loaded_by("import naibu; dir(naibu)") == set()
    # the packages of public names load nothing until a name is used
    for package in ("applications", "core", "identification", "imaging", "io", "mechanics", "meshing", "validation", "workflows"):
        assert loaded_by(f"import naibu; dir(naibu.{package})") == set()


def test_importing_naibu_is_fast() -> None:
    # processor time: other work on the machine does not count
    timed = "from time import process_time; began = process_time(); import naibu; print(process_time() - began)"
    best = min(float(subprocess.run([sys.executable, "-c", timed], capture_output=True, text=True, check=True).stdout) for _ in range(5))
    assert best < 0.2


def test_verbs_start_without_what_they_seldom_need() -> None:
    """Statistics took a third of the start of each worker of a calibration."""
    workflows = ("fields.identify_fields", "markers.identify", "measurement.sense", "studies.calibration.calibrate", "studies.simulate")
    names = loaded_modules("import " + ", ".join(f"naibu.workflows.{name}" for name in workflows))
    assert not {"scipy.stats", "scipy.signal"} & names


def test_the_mechanics_load_no_plotting_and_no_command_line() -> None:
    assert (
        loaded_by("import naibu.mechanics.finite_strain.statics, naibu.meshing.primitives, naibu.identification.from_markers.gauss_newton")
        == set()
    )
