"""Public names: what the packages show, one path to each, a docstring, and a place in the API pages."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
from collections import Counter
from pathlib import Path

import pytest

import naibu

ROOT = Path(__file__).resolve().parent.parent
SOURCES, DOCS = ROOT / "src" / "naibu", ROOT / "docs"
PACKAGES = sorted(stub.parent.name for stub in SOURCES.glob("*/__init__.pyi"))
FIRST_LEVEL = {
    *("identify", "predict", "compare", "sense", "track", "simulate", "report"),
    *("read_volume", "Volume", "Mesh", "DisplacementField", "Markers", "Experiment"),
}


def names_of(package: str) -> list[str]:
    """Return the public names of ``naibu`` or of one of its packages, without the packages themselves."""
    return [name for name in dir(importlib.import_module(package)) if package != "naibu" or name not in PACKAGES]


def listed_in(page: Path) -> list[str]:
    """Return the names in the autosummary tables of a page."""
    blocks = re.findall(r"^\.\. autosummary::\n((?:   .*\n|\n)+)", page.read_text(encoding="utf-8"), re.MULTILINE)
    return [line.strip() for block in blocks for line in block.splitlines() if line.strip() and not line.strip().startswith(":")]


PUBLIC = [(package, name) for package in ("naibu", *(f"naibu.{p}" for p in PACKAGES)) for name in names_of(package)]


def test_the_first_level_shows_verbs_types_and_packages_and_nothing_else() -> None:
    assert set(dir(naibu)) == FIRST_LEVEL | set(PACKAGES)
    assert set(PACKAGES) >= {"core", "datasets", "identification", "imaging", "io", "mechanics", "meshing", "validation", "workflows"}
    with pytest.raises(AttributeError, match="identity"):
        _ = naibu.identity


@pytest.mark.parametrize("package", PACKAGES)
def test_a_package_shows_what_its_stub_exports(package: str) -> None:
    tree = ast.parse((SOURCES / package / "__init__.pyi").read_text(encoding="utf-8"))
    imported = {alias.name for node in tree.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    (exported,) = [ast.literal_eval(node.value) for node in tree.body if isinstance(node, ast.Assign)]
    assert set(exported) == imported == set(names_of(f"naibu.{package}"))


def test_each_public_name_has_one_path() -> None:
    names = Counter(name for _, name in PUBLIC)
    assert not [name for name, count in names.items() if count > 1], "a name belongs to one package"
    objects = Counter(id(getattr(importlib.import_module(package), name)) for package, name in PUBLIC)
    twice = [f"{package}.{name}" for package, name in PUBLIC if objects[id(getattr(importlib.import_module(package), name))] > 1]
    assert not twice, "the same object has two public names"


def test_each_public_name_is_a_documented_class_or_function() -> None:
    for package, name in PUBLIC:
        found = getattr(importlib.import_module(package), name)
        assert inspect.isclass(found) or callable(found), f"{package}.{name}"
        assert found.__module__.startswith("naibu."), f"{package}.{name}"
        assert (found.__doc__ or "").strip() and not found.__doc__.startswith(f"{name}("), f"{package}.{name} has no docstring"


@pytest.mark.parametrize("package", ["naibu", *(f"naibu.{p}" for p in PACKAGES)])
def test_each_public_name_stands_once_in_the_page_of_its_package(package: str) -> None:
    page = DOCS / "api.rst" if package == "naibu" else DOCS / "api" / f"{package.partition('.')[2]}.rst"
    assert f".. currentmodule:: {package}\n" in page.read_text(encoding="utf-8")
    assert sorted(listed_in(page)) == sorted(names_of(package))
    if package != "naibu":
        assert f"   api/{page.stem}\n" in (DOCS / "api.rst").read_text(encoding="utf-8")


def test_pages_and_examples_import_public_names_only() -> None:
    pages = [
        ROOT / "README.md",
        *DOCS.glob("*.rst"),
        *(DOCS / "applications").glob("*.rst"),
        *(DOCS / "api").glob("*.rst"),
        *(DOCS / "theory").glob("*.rst"),
        *(DOCS / "gallery_src").glob("*.py"),
        *(DOCS / "tutorials_src").glob("*.py"),
    ]
    statement = re.compile(r"^\s*from (naibu[\w.]*) import (\([^)]*\)|[^\n]+)", re.MULTILINE)
    private = []
    for page in pages:
        for package, names in statement.findall(page.read_text(encoding="utf-8")):
            if package.startswith("naibu.reproduction."):  # the report's specimens, of which a page makes use
                continue
            wanted = set(re.findall(r"\w+", re.sub(r" as \w+", "", names)))
            public = set(dir(importlib.import_module(package))) if package in ("naibu", *(f"naibu.{p}" for p in PACKAGES)) else set()
            private += [f"{page.name}: {package}.{name}" for name in sorted(wanted - public)]
    assert not private, "\n".join(private)
