# mypy: disallow-untyped-calls=False, warn-unused-ignores=False
"""Compilation of kernels: `njit` as Numba's own, with a cache that knows everything that machine code depends on.

Files are named by a digest of a kernel and all that it depends on (`naibu._numba.kernel_digest`), so that an edit compiles anew what
depends on it and nothing else, and installations with the same sources can share one folder. Where several processes need the same kernel,
one compiles it and the others wait.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable
from functools import cache as cached
from pathlib import Path
from typing import Any

import numba

from naibu._numba.kernel_digest import kernel_digest, named_apart
from naibu._numba.reports import report
from naibu._numba.versions import passes, tested

try:
    from naibu._numba.kernel_files import KernelFile
except Exception:  # whatever a changed interface raises
    KernelFile = None  # type: ignore[assignment,misc]
try:
    from naibu._numba import called_kernels
except Exception:  # whatever a changed interface raises
    called_kernels = None  # type: ignore[assignment]

try:
    from naibu._numba import references
except Exception:  # whatever a changed interface raises
    references = None  # type: ignore[assignment]

# Options of kernels that neither make nor return arrays: references are not counted. Numba counts those of every array in a tuple, each
# time that a kernel takes the tuple apart, which takes longer than many a step of a small lattice.
# Kernels that they call take over that option; those that make arrays must not (`naibu._numba.references` checks it).
UNCOUNTED: dict[str, Any] = {"_nrt": False} if tested() else {}
COUNTED: dict[str, Any] = {"_nrt": True} if tested() else {}


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
        # one function may be compiled both ways: machine code of the same name would be taken for the same
        compiled = numba.njit(**options)(named_apart(function, "__parallel") if options.get("parallel") else function)
        compiler = getattr(compiled, "_compiler", None)  # None where NUMBA_DISABLE_JIT is set, or on an untested Numba
        if compiler is not None and hasattr(compiled, "get_call_template"):
            compiled.get_call_template = _Calls(compiled, compiled.get_call_template)
        if cache and compiler is not None and hasattr(compiler, "compile"):
            compiler.compile = CachedCompiler(compiled, compiler.compile)
            if called_apart():
                called_kernels.keep_from_python(compiled)
        return compiled

    return decorated if function is None else decorated(function)


class _Calls:
    """What tells the type of a call of a kernel by another one: that of its arguments, not of constants among them.

    Numba compiles a kernel once more for each constant that it is called with, an eighth of the time of compilation where it was measured;
    once the kernel is part of its caller, the optimiser knows the constant in any case. A kernel that takes an item of a tuple of several
    types by a constant needs it, and gets it.
    """

    def __init__(self, kernel: Any, template: Callable[[Any, Any], Any]) -> None:
        self._kernel, self._template = kernel, template

    def __call__(self, args: Any, named: Any) -> Any:
        found = self._found(args, named)
        result = self._kernel.overloads.get(tuple(found[2]))
        if result is not None and references is not None:
            references.require_counting_caller(_label(self._kernel), self._kernel.targetoptions, result.signature.return_type)
        return found

    def _found(self, args: Any, named: Any) -> Any:
        plain = tuple(map(numba.types.unliteral, args)), {name: numba.types.unliteral(value) for name, value in named.items()}
        try:
            return self._template(*plain)
        except numba.core.errors.TypingError:
            if plain == (tuple(args), dict(named)):
                raise
            return self._template(args, named)


class CachedCompiler:
    """What compiles a kernel: in place of that of a Numba dispatcher, which it calls where a kernel is not kept yet.

    Numba calls it under its lock of the compiler, so that one thread is in it at a time.

    Parameters
    ----------
    kernel : numba dispatcher
        Whose compiler it becomes.
    compile : callable
        Compiles the kernel for types of arguments and of the result (or None).
    """

    def __init__(self, kernel: Any, compile: Callable[[Any, Any], Any]) -> None:
        self._kernel, self._compile = kernel, compile
        self._label = _label(kernel)
        self._digest: str | None = None

    def __call__(self, args: Any, return_type: Any) -> Any:
        """Return the compile result, from its file where there is one."""
        result = self._result(args, return_type)
        if references is not None:
            references.require_no_arrays(self._label, self._kernel.targetoptions, result.signature.return_type)
        return result

    def _result(self, args: Any, return_type: Any) -> Any:
        called = called_apart() and called_kernels.being_called() and not self._kernel.targetoptions.get("parallel")
        file = self._file(args, return_type, called)
        if file is None:
            return self._reported(args, return_type, called)
        found = self._loaded(file, called)
        if found is None:
            with file.lock():
                found = self._loaded(file, called)  # another process may have compiled it meanwhile
                if found is None:
                    found = self._reported(args, return_type, called)
                    file.save(found)
        return found

    def _file(self, args: Any, return_type: Any, called: bool) -> Any:
        if not cache_works():
            return None
        try:
            self._digest = self._digest or kernel_digest(self._kernel)
        except OSError:  # no sources, as in a frozen application
            return None
        kind = ("called",) if called else ()
        return KernelFile.of(self._label, self._digest, (tuple(args), return_type, *kind), self._kernel.targetctx)

    def _loaded(self, file: Any, called: bool) -> Any:
        target = self._kernel.targetctx
        with called_kernels.libraries(called_kernels.CalledLibrary) if called else contextlib.nullcontext():
            found = file.load(target)
        if found is not None and not found.objectmode:
            target.insert_user_function(found.entry_point, found.fndesc, [found.library])
        return found

    def _reported(self, args: Any, return_type: Any, called: bool) -> Any:
        report(self._label, False)
        try:
            if called_apart():
                return called_kernels.compiled_for(called, self._kernel, self._compile, args, return_type)
            return self._compile(args, return_type)
        finally:
            report(self._label, True)


def _label(kernel: Any) -> str:
    return f"{kernel.py_func.__module__}.{kernel.py_func.__qualname__}"


def called_apart() -> bool:
    """Tell whether kernels that only kernels call are compiled without machine code: on tested versions of Numba."""
    return called_kernels is not None and tested()


@cached
def cache_works() -> bool:
    """Tell whether compiled kernels can be kept with this version of Numba: always on tested ones, else after a trial."""
    return KernelFile is not None and passes(_trial)


def _trial() -> bool:
    """Tell whether a compiled function can be written, read and called."""
    from naibu._numba import kernel_files

    def kernel(x: Any) -> Any:
        return 2.0 * x + 1.0

    first: Any = numba.njit(kernel)
    second: Any = numba.njit(kernel)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "kernel"
        path.write_bytes(kernel_files.packed(_compiled(first)))
        second.add_overload(kernel_files.unpacked(second.targetctx, path.read_bytes()))
    return bool(second(3.0) == 7.0 and hasattr(second, "targetoptions"))


def _compiled(kernel: Any) -> Any:
    return kernel._compiler.compile((numba.types.float64,), None)
