"""Files of compiled kernels: one for each kernel, signature and kind of processor."""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numba.core import serialize
from numba.core.compiler import CompileResult

from naibu._numba.cache_folder import cache_folder, readable_folders
from naibu._numba.process_lock import ProcessLock

FORGOTTEN_S = 14 * 86400.0  # kernels that no process has used for so long are removed when the same kernel is compiled again
_MARKED_S = 86400.0  # how old the time of use of a kernel may become before it is set anew
LONGEST_WAIT_S = 120.0  # for another process that compiles the same kernel
SUFFIX = ".nbc"
_ADDRESS = re.compile(r"0x[0-9a-fA-F]{4,}")


@dataclass(frozen=True, slots=True)
class KernelFile:
    """Where the machine code of one kernel for one signature is kept.

    Attributes
    ----------
    label : str
        Module and qualified name of the kernel.
    key : str
        Hash of all that the machine code depends on.
    """

    label: str
    key: str

    @classmethod
    def of(cls, label: str, digest: str, signature: tuple[Any, ...], target: Any) -> KernelFile | None:
        """Return the file of a kernel with a digest; None for signatures that mean something else in each process."""
        text = repr(signature)
        if _ADDRESS.search(text):
            return None
        return cls(label, hashlib.sha256(repr((digest, text, target.codegen().magic_tuple())).encode()).hexdigest()[:20])

    @property
    def name(self) -> str:
        """Return the name of the file."""
        return f"{self.label.replace('<', '').replace('>', '')}-{self.key}{SUFFIX}"

    def lock(self) -> contextlib.AbstractContextManager[object]:
        """Return the lock of the process that compiles this kernel."""
        folder = cache_folder()
        return contextlib.nullcontext() if folder is None else ProcessLock(folder / f"{self.name}.lock", LONGEST_WAIT_S)

    def load(self, target: Any) -> Any:
        """Return the compiled kernel, or None where there is none or its file is damaged."""
        for folder in readable_folders():
            path = folder / self.name
            try:
                found = unpacked(target, path.read_bytes())
            except Exception:  # there is none, or it is damaged, which raises anything: it is compiled and written again
                continue
            _mark(path)
            return found
        return None

    def save(self, result: Any) -> None:
        """Keep a compiled kernel; a full or unwritable disk costs the cache, not the result."""
        if any(not lifted.can_cache for lifted in result.lifted) or result.library.has_dynamic_globals:
            return
        folder = cache_folder()
        if folder is None:
            return
        path = folder / self.name
        part = path.with_name(f"{self.name}.{os.getpid()}.part")
        with contextlib.suppress(OSError):
            try:
                part.write_bytes(packed(result))
                part.replace(path)
            finally:
                part.unlink(missing_ok=True)
            _forget(folder, path.name.rpartition("-")[0])


def packed(result: Any) -> bytes:
    """Return a compiled kernel as bytes."""
    # the types of all variables as text are for readers
    data: bytes = serialize.dumps(result._replace(type_annotation="")._reduce())  # type: ignore[no-untyped-call]
    return data


def unpacked(target: Any, data: bytes) -> Any:
    """Return a compiled kernel from its bytes."""
    target.refresh()
    return CompileResult._rebuild(target, *pickle.loads(data))  # type: ignore[no-untyped-call]


def _mark(path: Path) -> None:
    """Tell that a file was used."""
    with contextlib.suppress(OSError):  # in a folder of somebody else
        if time.time() - path.stat().st_mtime > _MARKED_S:
            os.utime(path)


def _forget(folder: Path, label: str) -> None:
    """Remove what was kept of a kernel and has not been used for long."""
    for other in folder.glob(f"{label}-*"):
        with contextlib.suppress(OSError):  # another process was faster
            if time.time() - other.stat().st_mtime > FORGOTTEN_S:
                other.unlink()
