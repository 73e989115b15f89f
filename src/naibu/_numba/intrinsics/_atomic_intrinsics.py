"""Atomic operations on arrays in Numba kernels, a short sleep and a clock: import `naibu._numba.intrinsics.atomics` instead."""

from __future__ import annotations

import os
import platform
import time
from typing import Any

import numba
import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic

from naibu._numba.compilation import COUNTED, njit


def _address(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    return builder.gep(context.make_array(array_type)(context, builder, array).data, [index])


def _look(typingcontext, array, index):  # type: ignore[no-untyped-def]
    """Return array[index], and see what was written before it was."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.load_atomic(_address(context, builder, sig.args[0], args[0], args[1]), "acquire", 8)

    return types.int64(array, types.intp), codegen


def _post(typingcontext, array, index, value):  # type: ignore[no-untyped-def]
    """Set array[index] after all that was written before."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        builder.store_atomic(args[2], _address(context, builder, sig.args[0], args[0], args[1]), "release", 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.int64), codegen


def _add(typingcontext, array, index, value):  # type: ignore[no-untyped-def]
    """Add to array[index] and return what it was."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.atomic_rmw("add", _address(context, builder, sig.args[0], args[0], args[1]), args[2], "acq_rel")

    return types.int64(array, types.intp, types.int64), codegen


def _swap(typingcontext, array, index, old, new):  # type: ignore[no-untyped-def]
    """Set array[index] to `new` if it is `old`, and return whether it was."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        where = _address(context, builder, sig.args[0], args[0], args[1])
        found = builder.cmpxchg(where, args[2], args[3], "acq_rel", "acquire")
        return builder.zext(builder.extract_value(found, 1), ir.IntType(8))

    return types.uint8(array, types.intp, types.int64, types.int64), codegen


def _relax(typingcontext):  # type: ignore[no-untyped-def]
    """Tell the processor that this is a loop that waits, so that it leaves a shared core to the other thread."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        if platform.machine().lower() in ("x86_64", "amd64"):
            name = "llvm.x86.sse2.pause"
            pause = builder.module.globals.get(name) or ir.Function(builder.module, ir.FunctionType(ir.VoidType(), []), name)
            builder.call(pause, [])
        return context.get_dummy_value()

    return types.void(), codegen


look: Any = intrinsic(_look)
relax: Any = intrinsic(_relax)
post: Any = intrinsic(_post)
add: Any = intrinsic(_add)
swap: Any = intrinsic(_swap)

if os.name == "posix":
    _usleep: Any = types.ExternalFunction("usleep", types.int32(types.uint32))
    _clock_gettime: Any = types.ExternalFunction("clock_gettime", types.int32(types.int32, types.CPointer(types.int64)))  # type: ignore[no-untyped-call]
    _CLOCK = time.CLOCK_MONOTONIC

    @njit(cache=True)
    def nap(microseconds):  # type: ignore[no-untyped-def]  # pragma: no cover
        """Sleep."""
        _usleep(np.uint32(microseconds))

    @njit(cache=True, **COUNTED)
    def ticks():  # type: ignore[no-untyped-def]  # pragma: no cover
        """Return the time since some moment, ns."""
        found = np.zeros(2, np.int64)  # seconds and nanoseconds, as on all 64-bit systems
        _clock_gettime(np.int32(_CLOCK), found.ctypes)
        return 1_000_000_000 * found[0] + found[1]

else:

    @njit(cache=True)
    def nap(microseconds):  # type: ignore[no-untyped-def]  # pragma: no cover
        """Sleep where the system has a function for it; here the caller spins."""

    @njit(cache=True, **COUNTED)
    def ticks():  # type: ignore[no-untyped-def]  # pragma: no cover
        """Return the time where the system has a function for it; here always 0."""
        return 0


def trial() -> bool:
    """Tell whether a kernel with every operation compiles and is right."""

    def kernel(array: Any) -> Any:
        post(array, 0, 5)
        before = add(array, 0, 2)
        swapped, kept = swap(array, 0, 7, 9), swap(array, 0, 7, 11)
        nap(1)
        relax()
        return before == 5 and swapped and not kept and look(array, 0) == 9 and ticks() >= 0

    return bool(numba.njit(kernel)(np.zeros(1, dtype=np.int64)))
