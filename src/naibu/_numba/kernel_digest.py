"""A digest of everything that the machine code of a kernel depends on.

Machine code contains the kernels that it calls, inlined or linked, and the values of the global names that it reads. The digest covers the
bytecode of a kernel, its options, and the same of each kernel that it reaches through global names, directly or through others; the values
of constants; the source of modules of its package that define intrinsics or other objects; and the versions of Numba, llvmlite and Python.
Comments, docstrings, and whatever else stands in the files of these kernels do not count.
"""

from __future__ import annotations

import hashlib
import numbers
import sys
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, ModuleType
from typing import Any

import llvmlite  # type: ignore[import-untyped]
import numba
import numpy as np

# settings of Numba that change machine code
_SETTINGS = ("OPT", "BOUNDSCHECK", "DEBUGINFO_DEFAULT", "USING_SVML", "LOOP_VECTORIZE", "SLP_VECTORIZE", "ENABLE_AVX")


def kernel_digest(kernel: Any) -> str:
    """Return a short hash of a kernel and of all that its machine code depends on.

    Parameters
    ----------
    kernel : numba dispatcher
        What `numba.njit` returns.

    Raises
    ------
    OSError
        If the source of a module that counts cannot be read.
    """
    found: dict[int, str] = {}
    waiting = [kernel]
    while waiting:
        one = waiting.pop()
        if id(one) not in found:
            found[id(one)], reached = _described(one)
            waiting += reached
    digest = hashlib.sha256(_surroundings().encode())
    for text in (found[id(kernel)], *sorted(set(found.values()))):
        digest.update(text.encode())
    return digest.hexdigest()[:20]


def options_text(kernel: Any) -> str:
    """Return the options of a kernel in an order that does not depend on the process."""
    return _text(dict(kernel.targetoptions))


@cache
def _surroundings() -> str:
    settings = [getattr(numba.config, name, None) for name in _SETTINGS]
    return repr((numba.__version__, llvmlite.__version__, sys.implementation.cache_tag, settings))


def _described(value: Any) -> tuple[str, list[Any]]:
    """Return a hash of a kernel or function by itself, and the kernels and functions that it names."""
    function: FunctionType = getattr(value, "py_func", value)
    package = function.__module__.split(".")[0]
    options = options_text(value) if value is not function else ""
    parts = [f"{function.__module__}.{function.__qualname__}", options, _text(function.__defaults__), _text(function.__kwdefaults__)]
    parts += _code_parts(function.__code__, function.__doc__)
    reached: list[Any] = []
    for name, used in _used(function):
        if _is_function(used, package):
            inner = getattr(used, "py_func", used)
            parts.append(f"{name}: {inner.__module__}.{inner.__qualname__}")
            reached.append(used)
        else:
            parts.append(f"{name}: {_other(used, package)}")
    return hashlib.sha256("\0".join(parts).encode()).hexdigest(), reached


def _is_function(value: Any, package: str) -> bool:
    function = getattr(value, "py_func", value)
    return isinstance(function, FunctionType) and function.__module__.split(".")[0] == package


def _used(function: FunctionType) -> Iterator[tuple[str, Any]]:
    """Give the global names, those in modules of the package, and the closure's variables that a function may read."""
    package = function.__module__.split(".")[0]
    names = sorted(set(_names(function.__code__)))
    for name in names:
        if name in function.__globals__:
            value = function.__globals__[name]
            if isinstance(value, tuple | list) and any(callable(one) for one in value):
                yield from ((f"{name}[{index}]", one) for index, one in enumerate(value))
            else:
                yield name, value
            if isinstance(value, ModuleType) and value.__name__.split(".")[0] == package:
                yield from ((f"{name}.{inner}", getattr(value, inner)) for inner in names if hasattr(value, inner))
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        yield name, cell.cell_contents


def _names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _code_parts(code: CodeType, doc: str | None) -> Iterator[str]:
    constants = code.co_consts[1:] if doc is not None and code.co_consts and code.co_consts[0] == doc else code.co_consts
    yield code.co_code.hex()
    yield repr((code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags))
    yield repr((code.co_varnames, code.co_names, code.co_freevars, code.co_cellvars, getattr(code, "co_exceptiontable", b"")))
    for constant in constants:
        if isinstance(constant, CodeType):
            yield from _code_parts(constant, None)
        else:
            yield _text(constant)


def _text(value: Any) -> str:
    """Return a plain value as text that is the same in each process."""
    if isinstance(value, dict):
        return "{" + ", ".join(sorted(f"{_text(k)}: {_text(v)}" for k, v in value.items())) + "}"
    if isinstance(value, tuple | list):
        return f"{type(value).__name__}({', '.join(_text(v) for v in value)})"
    if isinstance(value, set | frozenset):
        return "{" + ", ".join(sorted(_text(v) for v in value)) + "}"
    if isinstance(value, np.ndarray):
        return f"{value.dtype.str}{value.shape}{hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()}"
    return f"{type(value).__name__} {value!r}"


def _other(value: Any, package: str) -> str:
    """Describe what a kernel names and is no kernel: by value, by name where it is of another package, else by its module's source."""
    if isinstance(value, ModuleType):
        return value.__name__
    if value is None or isinstance(value, numbers.Number | np.generic | str | bytes | tuple | list | set | frozenset | dict | np.ndarray):
        return _text(value)
    home = getattr(value, "__module__", None) or type(value).__module__
    name = getattr(value, "__qualname__", None) or getattr(value, "__name__", None) or type(value).__qualname__
    if home.split(".")[0] == package and not isinstance(value, BuiltinFunctionType):
        return f"{name} {_source(home)}"
    return f"{home}.{name}"


@cache
def _source(module: str) -> str:
    file = getattr(sys.modules.get(module), "__file__", None)
    if file is None:
        raise OSError(f"{module} has no source file")
    return hashlib.sha256(Path(file).read_bytes()).hexdigest()


def named_apart(function: Callable[..., Any], suffix: str) -> Callable[..., Any]:
    """Return a copy of a function under another qualified name, on which the names of its machine code depend."""
    if not isinstance(function, FunctionType):
        return function
    copy = FunctionType(function.__code__, function.__globals__, function.__name__, function.__defaults__, function.__closure__)
    copy.__kwdefaults__, copy.__doc__, copy.__module__ = function.__kwdefaults__, function.__doc__, function.__module__
    copy.__annotations__, copy.__qualname__ = dict(function.__annotations__), f"{function.__qualname__}{suffix}"
    return copy
