"""Where compiled kernels go for users without a home, with an unknown number, and in installations that they cannot write to."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numba
import pytest

import naibu
from naibu._numba import cache_folder
from naibu._numba.cache_folder import VARIABLE

NOBODY = 61234  # a user without an entry in the system's list
KERNEL = "from naibu._numba.compilation import njit\n\n\n@njit(cache=True)\ndef twice(x):\n    return 2 * x\n"
ASK = """
from naibu._numba.cache_folder import cache_folder
from naibu._numba.reports import reported_compilation
from naibu.kernel import twice
compiled = []
with reported_compilation(lambda kernel, done: compiled.append(kernel)):
    assert twice(2) == 4
print(cache_folder(), bool(compiled))
"""


@pytest.fixture
def installed() -> Iterator[Path]:
    """A folder that every user can read, with a package of one kernel in it."""
    root = Path(tempfile.mkdtemp(prefix="naibu-test-"))
    root.chmod(0o755)
    package = root / "naibu"
    shutil.copytree(Path(naibu.__file__).parent / "_numba", package / "_numba", ignore=shutil.ignore_patterns("__pycache__"))
    (package / "__init__.py").touch()
    (package / "kernel.py").write_text(KERNEL)
    yield root
    shutil.rmtree(root)


def as_user(user: int | None) -> list[str]:
    return [] if user is None else ["setpriv", f"--reuid={user}", f"--regid={user}", "--clear-groups"]


def ask(installed: Path, user: int | None, **variables: str) -> tuple[str, bool]:
    """Return the folder of kernels in a process of a user, and whether it had to compile."""
    environment = {"PATH": os.environ["PATH"], "PYTHONPATH": str(installed), "PYTHONDONTWRITEBYTECODE": "1"} | variables
    command = [*as_user(user), sys.executable, "-c", ASK]
    done = subprocess.run(command, cwd=installed, env=environment, capture_output=True, text=True, check=True)
    folder, compiled = done.stdout.split()
    return folder, compiled == "True"


@pytest.fixture
def nobody(installed: Path) -> int:
    if not hasattr(os, "geteuid") or os.geteuid() != 0:
        pytest.skip("only root can become another user")
    if shutil.which("setpriv") is None:
        pytest.skip("setpriv is needed to become another user")
    # a virtual environment in a folder that others cannot enter lets them start the system's Python, with what is installed there
    which = "import sys, numba; print(sys.implementation.cache_tag, numba.__file__)"
    command = [*as_user(NOBODY), sys.executable, "-c", which]
    found = subprocess.run(command, cwd=installed, check=False, env={"PATH": os.environ["PATH"]}, capture_output=True, text=True)
    if found.returncode or found.stdout.strip() != f"{sys.implementation.cache_tag} {numba.__file__}":
        pytest.skip("other users cannot run this Python")
    return NOBODY


@pytest.fixture
def temporary() -> Iterator[Path]:
    """A folder for temporary files that everybody can write to."""
    folder = Path(tempfile.mkdtemp(prefix="naibu-test-"))
    folder.chmod(0o1777)
    yield folder
    shutil.rmtree(folder)


def test_without_a_home_kernels_stay_in_the_package(installed: Path) -> None:
    expected = str(installed / "naibu" / "__pycache__" / "kernels")
    assert ask(installed, None) == (expected, True)
    assert ask(installed, None) == (expected, False)


@pytest.mark.parametrize("home", [None, "/", "/nowhere"])
def test_an_unknown_user_keeps_kernels_in_a_private_folder(installed: Path, nobody: int, temporary: Path, home: str | None) -> None:
    """The package, which root installed, cannot be written to; nor can the home, if there is one."""
    variables = {"TMPDIR": str(temporary)} | ({} if home is None else {"HOME": home})
    expected = temporary / f"naibu-kernels-{nobody}"
    assert ask(installed, nobody, **variables) == (str(expected), True)
    assert ask(installed, nobody, **variables) == (str(expected), False)
    assert expected.stat().st_mode & 0o777 == 0o700 and expected.stat().st_uid == nobody


def test_a_user_with_a_home_keeps_kernels_there(installed: Path, nobody: int, temporary: Path) -> None:
    expected = temporary / "home" / ".cache" / "naibu" / "kernels"
    variables = {"TMPDIR": str(temporary), "HOME": str(temporary / "home")}
    assert ask(installed, nobody, **variables) == (str(expected), True)
    assert ask(installed, nobody, **variables) == (str(expected), False)


def test_kernels_that_an_administrator_compiled_serve_everybody(installed: Path, nobody: int, temporary: Path) -> None:
    assert ask(installed, None)[1]
    folder, compiled = ask(installed, nobody, TMPDIR=str(temporary))
    assert Path(folder).parent == temporary
    assert not compiled


def test_a_named_folder_that_cannot_be_written_to_is_passed_over(installed: Path, nobody: int, temporary: Path) -> None:
    variables = {"TMPDIR": str(temporary), VARIABLE: str(installed)}
    assert ask(installed, nobody, **variables) == (str(temporary / f"naibu-kernels-{nobody}"), True)


def test_where_nothing_can_be_written_every_process_compiles(installed: Path, nobody: int) -> None:
    nowhere = "import tempfile\ndef none(): raise FileNotFoundError('no usable temporary directory')\ntempfile.gettempdir = none\n"
    (installed / "naibu" / "__init__.py").write_text(nowhere)
    assert ask(installed, nobody) == ("None", True)
    assert ask(installed, nobody) == ("None", True)


def test_a_private_folder_that_others_can_write_to_is_not_used(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(cache_folder, "candidates", lambda: iter([tmp_path / "file" / "folder"]))
    (tmp_path / "file").touch()
    monkeypatch.setattr(cache_folder.tempfile, "gettempdir", lambda: str(tmp_path))
    folder = cache_folder.cache_folder.__wrapped__()
    assert folder.parent == tmp_path and folder.stat().st_mode & 0o777 == 0o700
    folder.chmod(0o777)  # anybody could put code there
    other = cache_folder.cache_folder.__wrapped__()
    assert other != folder and other.stat().st_mode & 0o077 == 0
