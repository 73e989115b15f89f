"""A digest of a kernel's source together with all sources that its machine code depends on.

Machine code contains the kernels that it calls, inlined or linked, and the module constants that it reads. Numba notices that the file of a
kernel has changed, but not that those of its callees have. Here the digest of a module covers its own text, that of every module of the
package with kernels that it imports, directly or through others, and that of modules from which it takes constants (names in capitals).
"""

from __future__ import annotations

import hashlib
import re
from functools import cache
from pathlib import Path

_IMPORT = re.compile(r"^from (\w+(?:\.\w+)*) import (\([^)]*\)|[^\n(]+)", re.MULTILINE)
_NAME = re.compile(r"\b(\w+)(?: as \w+)?")
_CONSTANT = re.compile(r"\b_?[A-Z][A-Z0-9_]+\b")


def source_digest(path: Path, package: Path) -> str:
    """Return a short hash of a module of `package` and of what its kernels depend on.

    Parameters
    ----------
    path : Path
        File of the module.
    package : Path
        Folder of the top package; what is imported from elsewhere does not count.
    """
    digest = hashlib.sha256()
    for each in sorted(_closure(path.resolve(), package.resolve())):
        digest.update(each.relative_to(package.resolve()).as_posix().encode() + b"\0" + _text(each).encode() + b"\0")
    return digest.hexdigest()[:16]


def _closure(path: Path, package: Path) -> set[Path]:
    found, waiting = {path}, [path]
    while waiting:
        for other in _needed(waiting.pop(), package):
            if other not in found:
                found.add(other)
                if _has_kernels(other):
                    waiting.append(other)
    return found


@cache
def _needed(path: Path, package: Path) -> tuple[Path, ...]:
    """Modules of the package that a module imports and that hold kernels, or constants that it takes."""
    needed = []
    for module, names in _IMPORT.findall(_text(path)):
        if module.split(".")[0] != package.name:
            continue
        target = package.joinpath(*module.split(".")[1:])
        file = target.with_suffix(".py") if target.with_suffix(".py").is_file() else target / "__init__.py"
        submodules = [target / f"{name}.py" for name in _NAME.findall(names)]
        needed += [each for each in submodules if each.is_file() and _has_kernels(each)]
        if file.is_file() and (_has_kernels(file) or _CONSTANT.search(names)):
            needed.append(file)
    return tuple(needed)


def _has_kernels(path: Path) -> bool:
    return re.search(r"\b(njit|intrinsic)\b", _text(path)) is not None


@cache
def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8")
