"""Kernels that only kernels call: the same results and errors, whether they are compiled or come from their files, and a way to Python."""

from __future__ import annotations

import gc
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from numba.core.errors import TypingError

import naibu
from naibu._numba.cache_folder import VARIABLE
from naibu._numba.compilation import called_apart, njit

ELF = b"\x7fELF"  # begin of machine code in a file
KERNELS = """
from numba import prange
from naibu._numba.compilation import njit


@njit(cache=True)
def root(x):
    if x < 0.0:
        raise ValueError("negative: " + str(int(x)))
    return x ** 0.5


@njit(cache=True)
def sum_of_roots(x):
    total = 0.0
    for i in range(len(x)):
        total += root(x[i])
    return total


@njit(cache=True, parallel=True)
def roots(x, out):
    for i in prange(len(x)):
        out[i] = root(x[i]) + sum_of_roots(x[:0])
"""
ASK = """
import gc

import numpy as np
from naibu._numba.reports import reported_compilation
from naibu.kernels import root, roots, sum_of_roots

compiled = []
with reported_compilation(lambda kernel, done: compiled.append(kernel.rpartition(".")[2]) if done else None):
    assert sum_of_roots(np.array([4.0, 9.0])) == 5.0
    out = np.zeros(2)
    roots(np.array([16.0, 25.0]), out)
    assert list(out) == [4.0, 5.0]
    assert gc.isenabled()
    try:
        sum_of_roots(np.array([4.0, -9.0]))
    except ValueError as error:
        assert str(error) == "negative: -9", error
    else:
        raise AssertionError("no error")
    {then}
print(*compiled)
"""
CALL_IT = """for _ in range(2):
        assert root(36.0) == 6.0
    try:
        root(-4.0)
    except ValueError as error:
        assert str(error) == "negative: -4", error
    else:
        raise AssertionError("no error")"""


def compiled_by(root: Path, then: str = "pass") -> list[str]:
    """Kernels that a new process compiled to ask all kernels for known values."""
    environment = {k: v for k, v in os.environ.items() if k != VARIABLE} | {"PYTHONPATH": str(root)}
    command = [sys.executable, "-c", ASK.format(then=then)]
    done = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return sorted(done.stdout.split())


@pytest.fixture
def package(tmp_path: Path) -> Path:
    package = tmp_path / "naibu"
    shutil.copytree(Path(naibu.__file__).parent / "_numba", package / "_numba", ignore=shutil.ignore_patterns("__pycache__"))
    (package / "__init__.py").touch()
    (package / "kernels.py").write_text(KERNELS)
    return tmp_path


def test_results_and_errors_are_the_same_from_files(package: Path) -> None:
    assert compiled_by(package) == ["root", "roots__parallel", "sum_of_roots"]
    assert compiled_by(package) == []


@pytest.mark.skipif(not called_apart(), reason="all kernels are compiled whole with this version of Numba")
def test_python_can_call_what_only_kernels_called_before(package: Path) -> None:
    assert compiled_by(package, CALL_IT).count("root") == 2  # once to be linked, once for Python
    assert compiled_by(package, CALL_IT) == []


@pytest.mark.skipif(not called_apart() or sys.platform != "linux", reason="tells machine code as Linux has it")
def test_a_called_kernel_is_kept_without_machine_code(package: Path) -> None:
    compiled_by(package)
    whole = {path.name.split("-")[0]: ELF in path.read_bytes() for path in package.rglob("*.nbc")}
    assert not whole["naibu.kernels.root"]
    assert whole["naibu.kernels.roots__parallel"]


@pytest.mark.skipif(not called_apart(), reason="all kernels are compiled whole with this version of Numba")
@pytest.mark.parametrize("collecting", [True, False])
def test_compilation_leaves_the_search_for_cycles_as_it_was(collecting: bool) -> None:
    @njit(cache=True)
    def fails(x):  # type: ignore[no-untyped-def]
        return x + "text"

    before = gc.isenabled()
    try:
        gc.enable() if collecting else gc.disable()
        with pytest.raises(TypingError):
            fails(1.0)
        assert gc.isenabled() == collecting
    finally:
        gc.enable() if before else gc.disable()


def test_a_kernel_is_compiled_once_for_all_constants_that_it_is_called_with() -> None:
    @njit
    def chosen(x, k):  # type: ignore[no-untyped-def]
        return x + k

    @njit
    def calls(x):  # type: ignore[no-untyped-def]
        return chosen(x, 0) + chosen(x, 1) + chosen(x, int(x)) + chosen(x, k=2)

    assert calls(2.0) == 13.0
    assert len(chosen.signatures) == 1


def test_a_kernel_that_takes_an_item_of_a_tuple_by_a_constant_gets_it() -> None:
    @njit
    def item(pair, k):  # type: ignore[no-untyped-def]
        return pair[k]

    @njit
    def calls(x):  # type: ignore[no-untyped-def]
        return item((x, "text"), 0) + len(item((x, "text"), 1))

    assert calls(2.5) == 6.5
