"""What is packaged: a pure wheel with everything it needs, a source archive without junk, and an image that runs without rights."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

import naibu

ROOT = Path(__file__).resolve().parent.parent
SOURCES = ROOT / "src" / "naibu"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
POSIX_ONLY = {"fcntl", "grp", "pty", "pwd", "resource", "syslog", "termios", "tty"}
POSIX_CALLS = {"fork", "geteuid", "getgid", "getuid", "killpg", "nice", "setsid", "statvfs", "sched_getaffinity", "uname", "mkfifo"}
POSIX_SIGNALS = {
    "SIGALRM",
    "SIGHUP",
    "SIGKILL",
    "SIGUSR1",
    "SIGUSR2",
    "SIGPIPE",
    "SIGCHLD",
    "SIGSTOP",
    "SIGCONT",
    "alarm",
    "setitimer",
    "pause",
}
POSIX_SOCKETS = {"AF_UNIX", "SO_REUSEPORT", "MSG_DONTWAIT"}
ATTRIBUTES = {"os": POSIX_CALLS, "signal": POSIX_SIGNALS, "socket": POSIX_SOCKETS}
POSIX_PATHS = tuple(f"/{name}/" for name in ("tmp", "dev", "proc", "var", "etc", "usr"))


def conditional(path: list[ast.AST]) -> bool:
    """Tell whether a node stands in a branch on the platform, or in one that an error of a missing module or attribute leaves."""
    tests = [ast.unparse(node.test) for node in path if isinstance(node, ast.If | ast.IfExp)]
    caught = any(isinstance(n, ast.Try) or (isinstance(n, ast.With) and "suppress(" in ast.unparse(n.items[0])) for n in path)
    return caught or any("platform" in test or "os.name" in test or "hasattr" in test for test in tests)


@pytest.fixture
def open_folder() -> Iterator[Path]:
    """A folder that others may enter and write to, which those of pytest are not."""
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o777)
        yield Path(name)


def posix_only(tree: ast.AST) -> list[int]:
    """Return lines that work on POSIX alone, outside of branches for it."""
    lines: list[int] = []

    def visit(node: ast.AST, path: list[ast.AST]) -> None:
        modules = (
            [a.name for a in node.names] if isinstance(node, ast.Import) else [node.module] if isinstance(node, ast.ImportFrom) else []
        )
        owner = node.value.id if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) else ""
        call = isinstance(node, ast.Attribute) and node.attr in ATTRIBUTES.get(owner, ())
        place = isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.startswith(POSIX_PATHS)
        if (POSIX_ONLY & set(modules) or call or place) and not conditional(path):
            lines.append(node.lineno)
        for child in ast.iter_child_nodes(node):
            visit(child, [*path, node])

    visit(tree, [])
    return lines


def test_the_check_sees_what_works_on_posix_alone() -> None:
    assert posix_only(ast.parse("import os, fcntl\nos.fork()\nif os.name == 'posix':\n    os.getuid()\n")) == [1, 2]
    assert posix_only(ast.parse("signal.alarm(3)\nsignal.SIGTERM\nopen('/dev/x')\nif sys.platform != 'win32':\n    signal.SIGHUP\n")) == [
        1,
        3,
    ]


def test_nothing_works_on_posix_alone() -> None:
    found = {}
    for file in SOURCES.rglob("*.py"):
        text = file.read_text(encoding="utf-8")
        early = re.search(r'^ *if sys\.platform == "win32":$', text, re.MULTILINE)  # of modules in two versions
        if not early and (lines := posix_only(ast.parse(text))):
            found[file.name] = lines
    assert not found


def test_text_files_are_written_and_read_as_utf_8() -> None:
    # the default encoding of Windows is another
    pattern = re.compile(r"\.(?:read_text|write_text)\((?![^)\n]*encoding)[^\n]*$", re.MULTILINE)
    bad = [
        f"{file.name}: {line}"
        for file in SOURCES.rglob("*.py")
        for line in pattern.findall(file.read_text(encoding="utf-8"))
        if "encoding" not in line
    ]
    assert not bad


def test_versions_agree() -> None:
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {naibu.__version__}\n" in citation
    released = re.findall(r"^## \[(\d[\d.]*)\] - (\S+)", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert released[0][0] == naibu.__version__
    assert f"date-released: {released[0][1]}\n" in citation
    classified = {c.rpartition(" ")[2] for c in PROJECT["classifiers"] if c.startswith("Programming Language :: Python :: 3.")}
    assert classified == {"3.11", "3.12", "3.13", "3.14"}


def test_the_constraints_are_the_lowest_versions_allowed() -> None:
    lowest = dict(re.findall(r"^([\w-]+)>=([\d.]+)", "\n".join(PROJECT["dependencies"]), re.MULTILINE))
    text = (ROOT / "constraints-lowest.txt").read_text(encoding="utf-8")
    fixed = dict(re.findall(r"^([\w-]+)==([\d.]+)$", text, re.MULTILINE))
    assert set(lowest) == set(fixed) - {"llvmlite"}
    assert [name for name in lowest if not f"{fixed[name]}.".startswith(f"{lowest[name]}.")] == []


def test_the_image_runs_without_rights() -> None:
    image = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    last = image.rpartition("FROM ")[2]
    assert last.startswith("python:3") and "-slim\n" in last
    assert re.search(r"^USER 65534:65534$", last, re.MULTILINE) and last.index("USER ") < last.index("ENTRYPOINT")
    copied = {word for line in re.findall(r"^COPY (?!--from)(.*) \S+$", image, re.MULTILINE) for word in line.split()}
    kept = set(re.findall(r"^!(.*)$", (ROOT / ".dockerignore").read_text(encoding="utf-8"), re.MULTILINE))
    assert copied == kept and all((ROOT / name).exists() for name in copied)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root may become somebody without rights")
def test_verbs_run_without_rights_and_without_a_home_folder(open_folder: Path) -> None:
    place = open_folder
    environment = {
        "PATH": os.environ["PATH"],
        "PYTHONPATH": str(SOURCES.parent),
        "NUMBA_CACHE_DIR": str(place / "kernels"),
        "MPLCONFIGDIR": "/tmp",
    }

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "naibu", *arguments]
        return subprocess.run(command, env=environment, cwd=place, capture_output=True, text=True, user=65534, group=65534, check=False)

    try:
        made = run("new", "-o", "my_gel")
    except PermissionError:
        pytest.skip("this interpreter may not be run by others")
    if "Permission denied" in made.stderr:
        pytest.skip("the sources may not be read by others")
    assert made.returncode == 0, made.stderr
    assert run("new", "lattice", "-o", "study.toml").returncode == 0
    shown = run("import", "my_gel/initial.csv", "my_gel/pressed.csv", "--size-mm", "60", "60", "60", "-o", "gel")
    assert shown.returncode == 0, shown.stderr
    assert (place / "gel" / "meta.toml").stat().st_uid == 65534


@pytest.mark.slow
def test_wheel_and_source_archive_hold_what_they_should(tmp_path: Path) -> None:
    pytest.importorskip("hatchling")
    for target in ("wheel", "sdist"):
        subprocess.run(
            [sys.executable, "-m", "hatchling", "build", "-t", target, "-d", str(tmp_path)], cwd=ROOT, check=True, capture_output=True
        )
    (wheel,) = tmp_path.glob("*.whl")
    assert wheel.name == f"naibu-{naibu.__version__}-py3-none-any.whl"
    shutil.unpack_archive(wheel, tmp_path / "wheel", "zip")
    packed = {p.relative_to(tmp_path / "wheel" / "naibu").as_posix() for p in (tmp_path / "wheel" / "naibu").rglob("*") if p.is_file()}
    listed = subprocess.run(["git", "ls-files", "src/naibu"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    assert packed - {"_commit.txt"} == {name.removeprefix("src/naibu/") for name in listed}
    (archive,) = tmp_path.glob("*.tar.gz")
    shutil.unpack_archive(archive, tmp_path / "sdist")
    names = {p.relative_to(tmp_path / "sdist").as_posix().partition("/")[2] for p in (tmp_path / "sdist").rglob("*") if p.is_file()}
    tracked = set(subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split())
    assert names - tracked <= {"PKG-INFO"}
