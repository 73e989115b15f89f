# mypy: disallow-untyped-calls=False, warn-unused-ignores=False
"""Kernels that are compiled because another kernel calls them: code to link, without machine code and without wrappers.

Numba makes machine code and wrappers for callers in Python and in C of each kernel, though of a kernel that only other kernels call none is
ever run: its code is linked into that of its callers. Where many small kernels are called by few large ones, that is a third of the time of
compilation. If Python calls such a kernel later, it is compiled again, with all of that.
"""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Callable, Iterator
from typing import Any

import llvmlite.binding as llvm  # type: ignore[import-untyped]
from numba.core import sigutils
from numba.core.codegen import JITCodeLibrary, JITCPUCodegen
from numba.core.compiler_lock import global_compiler_lock

from naibu._numba import shortcuts
from naibu._numba.frame_stack import with_room

Compiler = Callable[[Any, Any], Any]


WRAPPER = "wrapper"  # name of the modules of wrappers for Python


class _NoPlaces:
    """What sets the environments of kernels in machine code, where there is none."""

    def set_env(self, name: str, environment: Any) -> None:
        """Do nothing: callers set the environments of what they link."""


class CalledLibrary(JITCodeLibrary):
    """Code of a called kernel: ready to be linked, never made into machine code."""

    codegen = _NoPlaces()  # type: ignore[assignment]
    linked_only = True  # see `naibu._numba.shortcuts.LINKED_ONLY`

    def add_ir_module(self, ir_module: Any) -> None:
        """Take in code, but for a wrapper for Python, which Numba makes of the body of each parallel loop."""
        if ir_module.name != WRAPPER:
            super().add_ir_module(ir_module)
        for function in ir_module.functions:  # its parts know one another: only a search for cycles would free them
            for block in function.blocks:
                block.instructions.clear()
            function.blocks.clear()

    def _optimize_final_module(self) -> None:
        """Leave the code to the optimisation of the kernel for Python: at each level of calls, all levels below were optimised again."""

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._verify_declare_only_symbols()
        self._finalized = True

    def _get_module_for_linking(self) -> Any:
        """Return the code, as that of Numba does, without making a copy of what is only linked."""
        self._ensure_finalized()
        if self._shared_module is None:
            self._shared_module = self._final_module
            for function in self._final_module.functions:
                if not function.is_declaration and function.linkage == llvm.Linkage.external:
                    function.linkage = "linkonce_odr"
        return self._shared_module

    def get_pointer_to_function(self, name: str) -> int:
        """Return 0, the address of no function."""
        self._ensure_finalized()
        return 0

    def serialize_using_object_code(self) -> tuple[str, str, bytes]:
        """Return what is kept in a file."""
        self._ensure_finalized()
        return self.name, "bitcode", self._get_module_for_linking().as_bitcode()

    @classmethod
    def _unserialize(cls, codegen: Any, state: tuple[str, str, bytes]) -> CalledLibrary:
        name, _, data = state
        library = cls(codegen, name)
        library._final_module = llvm.parse_bitcode(data)
        library._finalize_final_module()
        return library


class _LibrariesOf:
    """Libraries of one kernel for Python and of all that is compiled for it: only that of the kernel itself gets machine code."""

    def __init__(self, kernel: Any) -> None:
        self._name = kernel.py_func.__qualname__

    def __call__(self, codegen: Any, name: str) -> JITCodeLibrary:
        return (JITCodeLibrary if name == self._name else CalledLibrary)(codegen, name)


class _Nesting:
    """How many compilations are going on inside one another; changed under Numba's lock of the compiler."""

    depth = 0


def being_called() -> bool:
    """Tell whether the kernel that is wanted is called by one that is being compiled. Numba's lock of the compiler is held."""
    return _Nesting.depth > 0


def is_called_only(result: Any) -> bool:
    """Tell whether a compile result is without machine code."""
    return isinstance(result.library, CalledLibrary)


@contextlib.contextmanager
def libraries(kind: Any) -> Iterator[None]:
    """Within this context, Numba makes or loads libraries of this class."""
    before = JITCPUCodegen._library_class
    JITCPUCodegen._library_class = kind
    try:
        yield
    finally:
        JITCPUCodegen._library_class = before


def compiled_for(called: bool, kernel: Any, compile: Compiler, args: Any, return_type: Any) -> Any:
    """Compile a kernel, for callers among kernels or with machine code.

    Parameters
    ----------
    called : bool
        Whether only another kernel wants it.
    kernel : numba dispatcher
        Which one.
    compile : callable
        Numba's compiler of this kernel.
    args, return_type
        Types of the arguments and of the result (or None).
    """
    compiler = kernel._compiler
    compiler._customize_flags = _without_wrappers if called else _without_wrapper_for_c
    outermost = not being_called()
    faster = shortcuts.taken() if outermost else contextlib.nullcontext()
    _Nesting.depth += 1
    try:
        with libraries(CalledLibrary if called else _LibrariesOf(kernel)), _uncollected(), faster:
            result = with_room(lambda: compile(args, return_type)) if outermost else compile(args, return_type)
    finally:
        _Nesting.depth -= 1
        del compiler._customize_flags
    if not called:
        for environment in result._find_referenced_environments():  # of the kernels that are linked into it
            kernel.targetctx.codegen().set_env(environment.env_name, environment)
    return result


@contextlib.contextmanager
def _uncollected() -> Iterator[None]:
    """Keep Python from looking for cycles among the many objects of a compilation, nearly all of which live until its end."""
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collecting:
            gc.enable()


def _without_wrappers(flags: Any) -> Any:
    flags.no_cpython_wrapper = True
    flags.no_cfunc_wrapper = True
    return flags


def _without_wrapper_for_c(flags: Any) -> Any:
    flags.no_cfunc_wrapper = True
    return flags


def keep_from_python(kernel: Any) -> None:
    """Let a dispatcher hand to Python only kernels with machine code; one that was only called is compiled again for it."""
    kind = type(kernel)

    def compile(sig: Any) -> Any:
        with global_compiler_lock:
            args, _ = sigutils.normalize_signature(sig)
            found = kernel.overloads.get(tuple(args))
            if found is not None and is_called_only(found) and not being_called():
                del kernel.overloads[tuple(args)]
            return kind.compile(kernel, sig)

    def add_overload(result: Any) -> None:
        if is_called_only(result):
            kernel.overloads[tuple(result.signature.args)] = result
        else:
            kind.add_overload(kernel, result)

    kernel.compile, kernel.add_overload = compile, add_overload
