"""Where compiled kernels are kept: in a folder of their own for each state of the sources.

Numba looks whether the file of a kernel has changed, not whether those of the kernels that it calls have. After an update, or an edit, it
would join old machine code with new.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
import time
from pathlib import Path

VARIABLE = "NUMBA_CACHE_DIR"
KEPT_S = 30 * 86400.0  # kernels of other sources, where several installations may share a folder


def use_kernel_cache() -> None:
    """Let Numba keep compiled kernels in the folder of the present sources, unless NUMBA_CACHE_DIR names another.

    Where neither the package nor the user's cache can be written to, Numba decides.
    """
    numba = sys.modules.get("numba")
    if os.environ.get(VARIABLE) or (numba is not None and numba.config.CACHE_DIR):
        return
    package = Path(__file__).resolve().parents[1]
    name = f"kernels-{source_digest(package)}"
    for home, kept_s in ((package / "__pycache__", 0.0), (_user_cache(), KEPT_S)):
        folder = home / name
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            _forget(home, name, kept_s)
            os.environ[VARIABLE] = str(folder)
            if numba is not None:  # it has read the environment already
                numba.config.CACHE_DIR = str(folder)
            return


def source_digest(package: Path) -> str:
    """Return a short hash of all files of a package that hold kernels, by name and content."""
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        content = path.read_bytes()
        if b"njit" in content or b"intrinsic" in content:
            digest.update(path.relative_to(package).as_posix().encode() + b"\0" + content)
    return digest.hexdigest()[:12]


def _user_cache() -> Path:
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local")) / "naibu"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "naibu"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "naibu"


def _forget(home: Path, name: str, kept_s: float) -> None:
    """Remove the kernels of other sources that were not begun within the last `kept_s` seconds."""
    for other in home.glob("kernels-*"):
        try:
            if other.name != name and time.time() - other.stat().st_mtime > kept_s:
                shutil.rmtree(other, ignore_errors=True)
        except OSError:  # another process was faster
            continue
