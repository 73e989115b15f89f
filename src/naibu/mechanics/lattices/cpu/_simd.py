"""Eight numbers at a time in Numba kernels: vectors of the compiler, since it finds none in loops whose arrays may overlap.

Works on every processor; the compiler splits the vectors where registers are shorter. Use inside `numba.njit` functions only::

    distance = load(x, j) - load(x, i)     # x[j : j + 8] - x[i : i + 8]
    store(x, i, load(x, i) + distance)

The operators ``+``, ``-`` and ``*`` join two vectors of one precision; `splat` makes one of a number.
"""

from __future__ import annotations

import operator
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils
from numba.core.datamodel import models
from numba.core.extending import intrinsic, lower_builtin, register_model
from numba.core.typing.templates import AbstractTemplate, infer_global, signature

WIDTH = 8
_FLOAT, _DOUBLE = ir.FloatType(), ir.DoubleType()


class Vector(types.Type):
    """The Numba type of eight numbers of one precision."""

    def __init__(self, scalar: types.Float) -> None:
        self.scalar = scalar
        super().__init__(name=f"vector{WIDTH}({scalar})")

    @property
    def key(self) -> types.Float:
        """Vectors are equal where their precision is."""
        return self.scalar


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Vector) -> None:
        super().__init__(dmm, fe_type, _ir_type(fe_type.scalar))  # type: ignore[no-untyped-call]


def _ir_type(scalar: types.Float) -> ir.VectorType:
    return ir.VectorType(_FLOAT if scalar.bitwidth == 32 else _DOUBLE, WIDTH)


def _pointer(context: Any, builder: Any, array_type: Any, array: Any, index: Any, vector: ir.VectorType) -> Any:
    """Return the address of array[index : index + WIDTH] of a contiguous array, without any check of bounds."""
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), vector.as_pointer())


def _load(typingcontext, array, index):  # type: ignore[no-untyped-def]
    """Return array[index : index + 8] of a contiguous array of one dimension."""
    vector = Vector(array.dtype)

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        where = _pointer(context, builder, sig.args[0], args[0], args[1], _ir_type(array.dtype))
        return builder.load(where, align=array.dtype.bitwidth // 8)

    return vector(array, types.intp), codegen


def _store(typingcontext, array, index, value):  # type: ignore[no-untyped-def]
    """Set array[index : index + 8] of a contiguous array of one dimension."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        where = _pointer(context, builder, sig.args[0], args[0], args[1], _ir_type(array.dtype))
        builder.store(args[2], where, align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, value), codegen


def _repeated(builder: Any, value: Any, vector: ir.VectorType) -> Any:
    one = builder.insert_element(ir.Constant(vector, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [0] * WIDTH)
    return builder.shuffle_vector(one, ir.Constant(vector, ir.Undefined), zeros)


def _splat(typingcontext, value):  # type: ignore[no-untyped-def]
    """Return eight copies of a number."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return _repeated(builder, args[0], _ir_type(value))

    return Vector(value)(value), codegen


def _total(typingcontext, value):  # type: ignore[no-untyped-def]
    """Return the sum of the eight numbers, added pairwise."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        parts = [builder.extract_element(args[0], ir.Constant(ir.IntType(32), k)) for k in range(WIDTH)]
        while len(parts) > 1:
            parts = [builder.fadd(parts[k], parts[k + 1]) for k in range(0, len(parts), 2)]
        return parts[0]

    return value.scalar(value), codegen


def _single(typingcontext, value):  # type: ignore[no-untyped-def]
    """Return the numbers rounded to single precision."""
    narrow = Vector(types.float32)

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return args[0] if value == narrow else builder.fptrunc(args[0], _ir_type(types.float32))

    return narrow(value), codegen


def _double(typingcontext, value):  # type: ignore[no-untyped-def]
    """Return the numbers in double precision."""
    wide = Vector(types.float64)

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return args[0] if value == wide else builder.fpext(args[0], _ir_type(types.float64))

    return wide(value), codegen


def _inverse_root(typingcontext, value):  # type: ignore[no-untyped-def]
    """Return 1 / sqrt(value) of positive numbers; in double precision by a step of third order from the single one.

    The argument must lie in the range of single precision; smaller ones than 1e-30 count as that.
    """
    single, double = ir.VectorType(_FLOAT, WIDTH), ir.VectorType(_DOUBLE, WIDTH)

    def constant(vector: ir.VectorType, number: float) -> Any:
        return ir.Constant(vector, [number] * WIDTH)

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        is_single = value.scalar.bitwidth == 32
        here = single if is_single else double
        least = constant(here, 1e-30 if not is_single else float.fromhex("0x1.4484bep-100"))
        bounded = builder.select(builder.fcmp_ordered(">", args[0], least), args[0], least)
        start = bounded if is_single else builder.fptrunc(bounded, single)
        name, kind = f"llvm.sqrt.v{WIDTH}f32", ir.FunctionType(single, [single])
        root = builder.call(cgutils.get_or_insert_function(builder.module, kind, name), [start])  # type: ignore[no-untyped-call]
        guess = builder.fdiv(constant(single, 1.0), root)
        if is_single:
            return guess
        y = builder.fpext(guess, double)
        gap = builder.fsub(constant(double, 1.0), builder.fmul(bounded, builder.fmul(y, y)))
        series = builder.fadd(constant(double, 0.5), builder.fmul(constant(double, 0.375), gap))
        return builder.fadd(y, builder.fmul(builder.fmul(y, gap), series))

    return value(value), codegen


def aligned(shape: tuple[int, ...], kind: Any) -> Any:
    """Return zeros that begin where a line of the cache does."""
    size = int(np.prod(shape)) * np.dtype(kind).itemsize
    raw = np.zeros(size + 64, dtype=np.uint8)
    start = -raw.ctypes.data % 64
    return raw[start : start + size].view(kind).reshape(shape)


# known to the type checker as anything: it takes the typing context for an argument
load: Any = intrinsic(_load)
store: Any = intrinsic(_store)
splat: Any = intrinsic(_splat)
total: Any = intrinsic(_total)
single: Any = intrinsic(_single)
double: Any = intrinsic(_double)
inverse_root: Any = intrinsic(_inverse_root)


def _operator(function: Any, name: str) -> None:
    class Typing(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            if len(args) == 2 and isinstance(args[0], Vector) and args[0] == args[1]:
                return signature(args[0], *args)  # type: ignore[no-untyped-call]
            return None

    infer_global(function)(Typing)  # type: ignore[no-untyped-call]

    def lowered(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return getattr(builder, name)(*args)

    lower_builtin(function, Vector, Vector)(lowered)  # type: ignore[no-untyped-call]


for _function, _name in ((operator.add, "fadd"), (operator.sub, "fsub"), (operator.mul, "fmul")):
    _operator(_function, _name)
