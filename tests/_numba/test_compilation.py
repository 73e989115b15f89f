"""Compiled kernels belong to the sources that they were made from, and are made once."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

import naibu
from naibu._numba.cache_folder import VARIABLE

INNER = "from naibu._numba.compilation import njit\n\n\n@njit(cache=True)\ndef inner(x):\n    return x + {}\n"
OUTER = (
    "from naibu._numba.compilation import njit\nfrom naibu.inner import inner\n\n\n@njit(cache=True)\ndef outer(x):\n    return inner(x)\n"
)
APART = "from naibu._numba.compilation import njit\n\n\n@njit(cache=True)\ndef apart(x):\n    return 2 * x\n"
ASK = """
{}
from naibu._numba.reports import reported_compilation
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


def test_what_no_process_uses_is_removed_after_a_while(tmp_path: Path) -> None:
    package = small_package(tmp_path)
    folder = finished(started(tmp_path))[1]
    kept = {path.name.rpartition("-")[0] for path in folder.glob("*.nbc")}
    long_ago = time.time() - 15 * 86400
    for path in folder.iterdir():
        os.utime(path, (long_ago, long_ago))
    (package / "inner.py").write_text(INNER.format(5))
    finished(started(tmp_path))
    for path in folder.iterdir():
        assert time.time() - path.stat().st_mtime < 86400  # used, or new
    assert {path.name.rpartition("-")[0] for path in folder.iterdir()} == kept
    assert len(list(folder.iterdir())) == 3


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
    finished(started(tmp_path))
    (package / "outer.py").write_text('"""Words."""\n\n' + OUTER.replace("return inner(x)", "# why\n    return inner(x)"))
    (package / "words.py").write_text("SAID = 1\n")
    assert finished(started(tmp_path))[2] == []


@pytest.mark.parametrize(
    "change",
    [
        lambda outer: outer.replace("cache=True", "cache=True, error_model='numpy'"),
        lambda outer: outer.replace("def outer(x)", "def outer(x, more=1)"),
        lambda outer: "from naibu.numbers import offset\n" + outer.replace("inner(x)", "inner(x) + offset - 1"),
        lambda outer: "import naibu.numbers as n\n" + outer.replace("inner(x)", "inner(x) + n.offset - 1"),
        lambda outer: "from naibu.door import inner as indirect\n" + outer.replace("inner(x)", "indirect(x)"),
    ],
    ids=["options", "defaults", "constant", "constant of a module", "name at another door"],
)
def test_what_changes_machine_code_counts(change: Callable[[str], str], tmp_path: Path) -> None:
    package = small_package(tmp_path)
    (package / "numbers.py").write_text("offset = 1\n")
    (package / "door.py").write_text("from naibu.inner import inner\n")
    finished(started(tmp_path))
    (package / "outer.py").write_text(change(OUTER))
    assert finished(started(tmp_path))[2] == ["naibu.outer.outer"]


def test_a_constant_elsewhere_compiles_anew(tmp_path: Path) -> None:
    package = small_package(tmp_path)
    (package / "numbers.py").write_text("offset = 1\n")
    (package / "outer.py").write_text("from naibu.numbers import offset\n" + OUTER.replace("inner(x)", "inner(x) + offset"))
    assert finished(started(tmp_path))[0] == 3
    (package / "numbers.py").write_text("offset = 2\n")
    value, _, compiled = finished(started(tmp_path))
    assert (value, compiled) == (4, ["naibu.outer.outer"])


def test_one_function_compiled_both_ways_has_two_kernels(tmp_path: Path) -> None:
    """Neither is taken for the other, by this process or by the next one."""
    package = small_package(tmp_path)
    both = "\nfrom numba import prange\n\n\ndef total(x):\n    s = 0\n    for i in prange(x):\n        s += i\n    return s\n\n\n"
    both += "alone = njit(cache=True)(total)\ntogether = njit(cache=True, parallel=True)(total)\n"
    (package / "apart.py").write_text(APART + both)
    ask = "from naibu.apart import alone, together; assert alone(5) == together(5) == 10"
    finished(started(tmp_path, ask))
    folder = package / "__pycache__" / "kernels"
    assert {"naibu.apart.total", "naibu.apart.total__parallel"} <= {path.name.rpartition("-")[0] for path in folder.glob("*.nbc")}
    assert finished(started(tmp_path, ask))[2] == []


def test_a_damaged_file_is_compiled_again(tmp_path: Path) -> None:
    small_package(tmp_path)
    folder = finished(started(tmp_path))[1]
    whole = {path: path.read_bytes() for path in folder.glob("*.nbc")}
    for path, content in whole.items():
        path.write_bytes(content[: len(content) // 2])
    assert len(finished(started(tmp_path))[2]) == 3
    assert finished(started(tmp_path))[2] == []


def test_a_full_disk_costs_the_cache_and_not_the_result(tmp_path: Path) -> None:
    small_package(tmp_path)
    limit = "import resource, numba; resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))"
    value, folder, compiled = finished(started(tmp_path, limit))
    assert (value, len(compiled)) == (2, 3)
    assert list(folder.iterdir()) == []
    assert len(finished(started(tmp_path))[2]) == 3


def test_a_kernel_that_does_not_compile_keeps_nobody_waiting(tmp_path: Path) -> None:
    """The lock is released, in the same process and for others."""
    package = small_package(tmp_path)
    (package / "apart.py").write_text(APART.replace("2 * x", "2 * x if x != x + 0 else x.missing"))
    fails = """
import numba
from naibu._numba.cache_folder import cache_folder
from naibu.apart import apart
for _ in range(2):
    try:
        apart(1)
    except numba.TypingError:
        continue
    raise SystemExit(1)
raise SystemExit(len(list(cache_folder().glob('*.lock'))))
"""
    start = time.monotonic()
    assert started(tmp_path, fails).wait(timeout=100) == 0
    assert started(tmp_path, fails).wait(timeout=100) == 0
    assert time.monotonic() - start < 100


def test_threads_compile_a_kernel_once(tmp_path: Path) -> None:
    small_package(tmp_path)
    threads = (
        "from threading import Thread\nfrom naibu.outer import outer\nfrom naibu._numba.reports import reported_compilation\n"
        "seen, found = [], []\n"
        "with reported_compilation(lambda kernel, done: seen.append((kernel, done))):\n"
        "    threads = [Thread(target=lambda: found.append(outer(1))) for _ in range(4)]\n"
        "    [t.start() for t in threads]; [t.join() for t in threads]\n"
        "assert found == [2] * 4 and len(seen) == 4, seen\n"
        "assert seen[0] == ('naibu.outer.outer', False) and seen[-1] == ('naibu.outer.outer', True), seen\n"
    )
    assert finished(started(tmp_path, threads))[2] == ["naibu.apart.apart"]
