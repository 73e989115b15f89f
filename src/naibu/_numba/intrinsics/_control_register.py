"""Subnormal numbers as zeros in Numba kernels: see `naibu._numba.intrinsics.subnormals`, which is to be imported instead."""

from __future__ import annotations

import platform
from typing import Any

import numba
import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic

SUPPORTED = platform.machine().lower() in ("x86_64", "amd64")
_FLUSHED = 1 << 15 | 1 << 6  # results (FTZ) and operands (DAZ) of the control register of vectors, MXCSR
_WORD = ir.IntType(32)


def _instruction(builder: Any, name: str) -> Any:
    kind = ir.FunctionType(ir.VoidType(), [ir.IntType(8).as_pointer()])
    return builder.module.globals.get(name) or ir.Function(builder.module, kind, name)


def _flush_subnormals(typingcontext):  # type: ignore[no-untyped-def]
    """Have this thread take subnormal numbers for zeros, and return what its control register held."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        word = builder.alloca(_WORD)
        place = builder.bitcast(word, ir.IntType(8).as_pointer())
        builder.call(_instruction(builder, "llvm.x86.sse.stmxcsr"), [place])
        before = builder.load(word)
        builder.store(builder.or_(before, ir.Constant(_WORD, _FLUSHED)), word)
        builder.call(_instruction(builder, "llvm.x86.sse.ldmxcsr"), [place])
        return before

    return types.int32(), codegen


def _restore(typingcontext, before):  # type: ignore[no-untyped-def]
    """Set the control register of this thread to what it held."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        word = builder.alloca(_WORD)
        builder.store(args[0], word)
        builder.call(_instruction(builder, "llvm.x86.sse.ldmxcsr"), [builder.bitcast(word, ir.IntType(8).as_pointer())])
        return context.get_dummy_value()

    return types.void(types.int32), codegen


flush_subnormals: Any = intrinsic(_flush_subnormals)
restore: Any = intrinsic(_restore)


def trial() -> bool:
    """Tell whether a kernel with both operations compiles and is right."""

    def kernel(numbers: Any) -> Any:
        before = flush_subnormals()
        for i in range(len(numbers)):
            numbers[i] *= np.float32(0.1)
        restore(before)

    numbers = np.full(9, 2e-38, dtype=np.float32)
    numba.njit(kernel)(numbers)
    return not numbers.any() and bool(np.float32(2e-38) * np.float32(0.1) > 0)
