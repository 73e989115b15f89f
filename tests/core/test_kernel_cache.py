"""Compiled kernels belong to the sources they were made from."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import naibu
from naibu.core.kernel_cache import VARIABLE, source_digest

INNER = "from numba import njit\n\n\n@njit(cache=True)\ndef inner(x):\n    return x + {}\n"
OUTER = "from numba import njit\n\nfrom naibu.inner import inner\n\n\n@njit(cache=True)\ndef outer(x):\n    return inner(x)\n"
ASK = "import os, sys; {}; import naibu; from naibu.outer import outer; print(outer(1), os.environ['NUMBA_CACHE_DIR'])"


def small_package(place: Path) -> Path:
    """A package with naibu's own cache and two kernels, one of which calls the other in another file."""
    source = Path(naibu.__file__).parent
    package = place / "naibu"
    (package / "core").mkdir(parents=True)
    (package / "core" / "__init__.py").touch()
    shutil.copy(source / "core" / "kernel_cache.py", package / "core")
    (package / "__init__.py").write_text("from naibu.core.kernel_cache import use_kernel_cache\n\nuse_kernel_cache()\n")
    (package / "inner.py").write_text(INNER.format(1))
    (package / "outer.py").write_text(OUTER)
    return package


def asked(place: Path, first: str = "pass", **variables: str) -> list[str]:
    environment = {k: v for k, v in os.environ.items() if k != VARIABLE} | {"PYTHONPATH": str(place)} | variables
    done = subprocess.run([sys.executable, "-c", ASK.format(first)], cwd=place, env=environment, capture_output=True, text=True, check=True)
    return done.stdout.split()


def test_a_changed_kernel_reaches_those_that_call_it(tmp_path: Path) -> None:
    package = small_package(tmp_path)
    value, folder = asked(tmp_path)
    assert value == "2"
    assert list(Path(folder).rglob("*.nbc"))
    assert asked(tmp_path, "import numba") == [value, folder]  # also where numba came first
    (package / "inner.py").write_text(INNER.format(5))
    changed, other = asked(tmp_path)
    assert (changed, other != folder) == ("6", True)
    assert not Path(folder).exists()


def test_a_folder_that_the_user_names_is_used(tmp_path: Path) -> None:
    small_package(tmp_path)
    assert asked(tmp_path, NUMBA_CACHE_DIR=str(tmp_path / "mine"))[1] == str(tmp_path / "mine")


def test_only_files_with_kernels_count(tmp_path: Path) -> None:
    package = small_package(tmp_path)
    before = source_digest(package)
    (package / "words.py").write_text("SAID = 1\n")
    assert source_digest(package) == before
    (package / "outer.py").write_text(OUTER + "\n")
    assert source_digest(package) != before
