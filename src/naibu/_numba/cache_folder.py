"""Where compiled kernels are kept."""

from __future__ import annotations

import atexit
import contextlib
import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path

VARIABLE = "NUMBA_CACHE_DIR"


@cache
def cache_folder() -> Path | None:
    """Return the folder of all compiled kernels, which exists and can be written to; None where there is no such folder at all.

    The first that can be written to of: the folder that the environment variable NUMBA_CACHE_DIR names, the package's own ``__pycache__``,
    the user's cache folder, and a private one among the temporary files.
    """
    for folder in candidates():
        if usable(folder):
            return folder
    return _private_folder()


@cache
def readable_folders() -> tuple[Path, ...]:
    """Return where compiled kernels are looked for: in `cache_folder`, and where this is not named by the user, in the package's own too.

    The latter may have been filled by an administrator, for users who cannot write there.
    """
    first, own = cache_folder(), _package_folder()
    folders = [] if first is None else [first]
    return tuple(folders if own in folders or os.environ.get(VARIABLE) else [*folders, own])


def _package_folder() -> Path:
    return Path(__file__).resolve().parents[1] / "__pycache__" / "kernels"


def candidates() -> Iterator[Path]:
    """Give the folders that may be used, the first choice first; without the temporary one."""
    given = os.environ.get(VARIABLE)
    if given:
        yield Path(given) / "naibu"
    yield _package_folder()
    user = _user_cache()
    if user is not None:
        yield user / "naibu" / "kernels"


def usable(folder: Path) -> bool:
    """Make a folder where it is missing, and tell whether files can be made in it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _user_cache() -> Path | None:
    """Return the user's cache folder; None where there is no home, as for an unknown user in a container."""
    try:
        if sys.platform == "win32":
            return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
        if sys.platform == "darwin":
            return Path.home() / "Library" / "Caches"
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError:
        return None


def _private_folder() -> Path | None:
    """Return a folder that only this user can write to: kernels are code, which nobody else may put there."""
    try:
        if sys.platform != "win32":
            folder = Path(tempfile.gettempdir()) / f"naibu-kernels-{os.getuid()}"
            with contextlib.suppress(OSError):
                folder.mkdir(mode=0o700, exist_ok=True)
                found = folder.lstat()
                if stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022 and usable(folder):
                    return folder
        folder = Path(tempfile.mkdtemp(prefix="naibu-kernels-"))
    except OSError:  # no temporary files either
        return None
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder
