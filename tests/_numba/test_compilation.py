"""Compiled kernels belong to the sources that they were made from, and are made once."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import naibu
from naibu._numba import cache_folder
from naibu._numba.cache_folder import VARIABLE
from naibu._numba.source_digest import source_digest

INNER = "from naibu._numba.compilation import njit\n\n\n@njit(cache=True)\ndef inner(x):\n    return x + {}\n"
OUTER = (
    "from naibu._numba.compilation import njit\nfrom naibu.inner import inner\n\n\n@njit(cache=True)\ndef outer(x):\n    return inner(x)\n"
)
APART = "from naibu._numba.compilation import njit\n\n\n@njit(cache=True)\ndef apart(x):\n    return 2 * x\n"
ASK = """
{}
from naibu._numba.compilation import reported_compilation
from naibu._numba.cache_folder import cache_folder
from naibu.outer import outer
from naibu.apart import apart
compiled = []
with reported_compilation(lambda kernel, done: compiled.append(kernel) if done else None):
    value = outer(1) + 0 * apart(1)
print(value, cache_folder(), *sorted(compiled))
"""


def small_package(root: Path) -> Path:
    """A package with naibu's own cache and three kernels, one of which calls another in another file."""
    package = root / "naibu"
    shutil.copytree(Path(naibu.__file__).parent / "_numba", package / "_numba", ignore=shutil.ignore_patterns("__pycache__"))
    (package / "__init__.py").touch()
    (package / "inner.py").write_text(INNER.format(1))
    (package / "outer.py").write_text(OUTER)
    (package / "apart.py").write_text(APART)
    return package


def started(root: Path, first: str = "", **variables: str) -> subprocess.Popen[str]:
    environment = {k: v for k, v in os.environ.items() if k != VARIABLE} | {"PYTHONPATH": str(root)} | variables
    return subprocess.Popen([sys.executable, "-c", ASK.format(first)], cwd=root, env=environment, stdout=subprocess.PIPE, text=True)


def finished(process: subprocess.Popen[str]) -> tuple[int, Path, list[str]]:
    out, _ = process.communicate(timeout=120)
    assert process.returncode == 0
    value, folder, *compiled = out.split()
    return int(value), Path(folder), compiled


def test_an_edit_compiles_what_depends_on_it_and_nothing_else(tmp_path: Path) -> None:
    package = small_package(tmp_path)
    value, folder, compiled = finished(started(tmp_path))
    assert (value, compiled) == (2, ["naibu.apart.apart", "naibu.inner.inner", "naibu.outer.outer"])
    assert list(folder.rglob("*.nbc"))
    assert finished(started(tmp_path, "import numba")) == (2, folder, [])
    (package / "inner.py").write_text(INNER.format(5))
    assert finished(started(tmp_path)) == (6, folder, ["naibu.inner.inner", "naibu.outer.outer"])
    assert len(list(folder.glob("inner-*"))) == 1  # those of the old source are gone


def test_two_processes_compile_a_kernel_once(tmp_path: Path) -> None:
    small_package(tmp_path)
    both = [started(tmp_path), started(tmp_path)]
    compiled = [name for process in both for name in finished(process)[2]]
    assert sorted(compiled) == ["naibu.apart.apart", "naibu.inner.inner", "naibu.outer.outer"]


def test_a_folder_that_the_user_names_is_used(tmp_path: Path) -> None:
    small_package(tmp_path)
    assert finished(started(tmp_path, NUMBA_CACHE_DIR=str(tmp_path / "mine")))[1] == tmp_path / "mine" / "naibu"


def test_installations_with_the_same_sources_share_kernels(tmp_path: Path) -> None:
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        small_package(tmp_path / name)
    shared = {"NUMBA_CACHE_DIR": str(tmp_path / "shared")}
    assert len(finished(started(tmp_path / "one", **shared))[2]) == 3
    assert finished(started(tmp_path / "two", **shared))[2] == []


def test_only_what_kernels_depend_on_counts(tmp_path: Path) -> None:
    package = small_package(tmp_path)
    before = source_digest(package / "outer.py", package)
    (package / "words.py").write_text("SAID = 1\n")
    assert _fresh_digest(package) == before
    (package / "inner.py").write_text(INNER.format(3))
    assert _fresh_digest(package) != before


def test_constants_of_other_modules_count(tmp_path: Path) -> None:
    package = small_package(tmp_path)
    (package / "numbers.py").write_text("OFFSET = 1\n")
    (package / "outer.py").write_text("from naibu.numbers import OFFSET\n" + OUTER)
    before = _fresh_digest(package)
    (package / "numbers.py").write_text("OFFSET = 2\n")
    assert _fresh_digest(package) != before


def test_without_a_home_and_a_writable_package_kernels_go_to_a_private_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(cache_folder, "candidates", lambda: iter([tmp_path / "file" / "folder"]))
    (tmp_path / "file").touch()
    monkeypatch.setattr(cache_folder.tempfile, "gettempdir", lambda: str(tmp_path))
    folder = cache_folder.cache_folder.__wrapped__()
    assert folder.parent == tmp_path and folder.stat().st_mode & 0o777 == 0o700
    folder.chmod(0o777)  # anybody could put code there
    other = cache_folder.cache_folder.__wrapped__()
    assert other != folder and other.stat().st_mode & 0o077 == 0


def _fresh_digest(package: Path) -> str:
    """The digest as a new process computes it: within one, sources are read once."""
    command = (
        "import sys; from pathlib import Path; from naibu._numba.source_digest import source_digest\n"
        "package = Path(sys.argv[1]); print(source_digest(package / 'outer.py', package))"
    )
    done = subprocess.run([sys.executable, "-c", command, str(package)], capture_output=True, text=True, check=True)
    return done.stdout.strip()
