"""The version as ``naibu --version`` shows it: with the commit, where that is known."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import naibu
from naibu._version import __version__


def version_text() -> str:
    """Return the version with the commit it was built from, where that is known: ``0.2.0 (commit 1a2b3c4)``."""
    commit = _commit()
    return f"{__version__} (commit {commit})" if commit else __version__


def _commit() -> str:
    """Return the commit that a wheel recorded, or that the sources are checked out at; empty where neither is known."""
    recorded = files("naibu") / "_commit.txt"
    if recorded.is_file():
        return recorded.read_text(encoding="utf-8").strip()
    return checked_out_commit(source_root())


def source_root() -> Path:
    """Return the folder that holds ``src/naibu``, where the package runs from its sources."""
    return Path(naibu.__file__).resolve().parents[2]


def checked_out_commit(root: Path) -> str:
    """Return the first digits of the commit that a folder is checked out at, read from git's files; empty where it is no repository.

    Parameters
    ----------
    root : Path
        Folder that holds ``.git``.
    """
    place = root / ".git"
    try:
        if place.is_file():  # of a worktree
            place = (root / place.read_text(encoding="utf-8").removeprefix("gitdir:").strip()).resolve()
        head = (place / "HEAD").read_text(encoding="utf-8").strip()
        if not head.startswith("ref:"):
            return head[:7]
        name = head.removeprefix("ref:").strip()
        common = place / "commondir"
        shared = (place / common.read_text(encoding="utf-8").strip()).resolve() if common.is_file() else place
        if (shared / name).is_file():
            return (shared / name).read_text(encoding="utf-8").strip()[:7]
        packed = (shared / "packed-refs").read_text(encoding="utf-8").splitlines()
        return next((line[:7] for line in packed if line.endswith(f" {name}")), "")
    except (OSError, UnicodeDecodeError):
        return ""
