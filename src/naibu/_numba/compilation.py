# mypy: disallow-untyped-calls=False, warn-unused-ignores=False
"""Compilation of kernels: `njit` as Numba's own, with a cache that knows what machine code depends on.

Kernels are kept in folders named by a digest of all sources they are made of (`naibu._numba.source_digest`), so that an edit compiles anew
what depends on it and nothing else, and installations with the same sources can share one folder. Where several processes need the same
kernel, one compiles and the others wait for it.
"""

from __future__ import annotations

import contextlib
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba.core import caching

from naibu._numba.cache_folder import cache_folder
from naibu._numba.process_lock import ProcessLock
from naibu._numba.source_digest import source_digest

PACKAGE = Path(__file__).resolve().parents[1]
FORGOTTEN_S = 30 * 86400.0  # kernels of other sources that nobody has touched for so long are removed
LONGEST_WAIT_S = 120.0  # for another process that compiles the same kernel

_listeners: list[Callable[[str, bool], None]] = []


@contextlib.contextmanager
def reported_compilation(listener: Callable[[str, bool], None]) -> Any:
    """Within this context, call ``listener(kernel, done)`` before and after each compilation of a kernel."""
    _listeners.append(listener)
    try:
        yield
    finally:
        _listeners.remove(listener)


def njit(function: Callable[..., Any] | None = None, *, cache: bool = False, **options: Any) -> Any:
    """Compile as `numba.njit` does; with `cache`, machine code is kept in `naibu._numba.cache_folder`.

    Parameters
    ----------
    function : callable, optional
        What to compile; without it, a decorator is returned.
    cache : bool
        Whether to keep machine code for later processes.
    **options
        As for `numba.njit`.
    """

    def decorated(function: Callable[..., Any]) -> Any:
        compiled = numba.njit(**options)(function)
        if cache and hasattr(compiled, "enable_caching"):  # not where NUMBA_DISABLE_JIT is set
            with contextlib.suppress(AttributeError, TypeError, OSError, RuntimeError):
                compiled._cache = KernelCache(function)  # on an untested Numba: compiled in every process
        return compiled

    return decorated if function is None else decorated(function)


class KernelLocator(caching._CacheLocator):
    """Tells Numba the folder of a kernel, by the digest of its sources."""

    def __init__(self, function: Callable[..., Any], file: str) -> None:
        path = Path(file).resolve()
        name = ".".join(path.relative_to(PACKAGE).with_suffix("").parts) if path.is_relative_to(PACKAGE) else path.stem
        package = PACKAGE if path.is_relative_to(PACKAGE) else path.parent
        self._digest = source_digest(path, package)
        self._line = function.__code__.co_firstlineno
        self._folder = cache_folder() / f"{name}-{self._digest}"

    def get_cache_path(self) -> str:
        """Return the folder."""
        if not self._folder.exists():
            _forget(self._folder)
            self._folder.mkdir(parents=True, exist_ok=True)
        return str(self._folder)

    def get_source_stamp(self) -> str:
        """Return what tells sources apart."""
        return self._digest

    def get_disambiguator(self) -> str:
        """Return what tells functions of one name apart."""
        return str(self._line)

    @classmethod
    def from_function(cls, function: Callable[..., Any], file: str) -> KernelLocator | None:
        """Return the locator of a function."""
        return cls(function, file) if Path(file).is_file() else None


class KernelCacheImpl(caching.CompileResultCacheImpl):
    """How compiled kernels become files: as Numba's own, elsewhere."""

    _locator_classes: list[type[object]] = [KernelLocator]  # noqa: RUF012  as Numba declares it


class KernelCache(caching.FunctionCache):
    """Numba's cache of one function; one process compiles, the others wait."""

    _impl_class = KernelCacheImpl

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._label = f"{function.__module__}.{function.__qualname__}"
        self._lock: ProcessLock | None = None

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the compiled function, or None where this process is to compile it."""
        found = super().load_overload(sig, target_context)
        if found is None:
            self._release()
            lock = ProcessLock(Path(self._cache_path) / f"{self._py_func.__name__}.lock", LONGEST_WAIT_S)
            if lock.acquire():  # another process may have compiled it while this one waited
                found = super().load_overload(sig, target_context)
            if found is not None:
                lock.release()
                return found
            self._lock = lock
            _tell(self._label, False)
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a compiled function."""
        try:
            with contextlib.suppress(OSError):  # a full disk costs the cache, not the result
                super().save_overload(sig, data)
        finally:
            self._release()
            _tell(self._label, True)

    def _release(self) -> None:
        if self._lock is not None:
            self._lock.release()
            self._lock = None


def _tell(kernel: str, done: bool) -> None:
    for listener in tuple(_listeners):
        listener(kernel, done)


def _forget(folder: Path) -> None:
    """Remove the kernels that the same module had with other sources and that were not used for long."""
    name = folder.name.rpartition("-")[0]
    within_package = PACKAGE in folder.parents
    for other in folder.parent.glob(f"{name}-*"):
        with contextlib.suppress(OSError):  # another process was faster
            if other.name.rpartition("-")[0] == name and (within_package or time.time() - other.stat().st_mtime > FORGOTTEN_S):
                shutil.rmtree(other, ignore_errors=True)
