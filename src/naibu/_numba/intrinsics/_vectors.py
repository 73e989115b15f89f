"""Vectors of eight numbers in Numba kernels, as LLVM vector types: see `naibu._numba.intrinsics.simd`, which is to be imported instead."""

from __future__ import annotations

import operator
from typing import Any

import numba
import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic, lower_builtin, models, register_model, type_callable

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


def _declared(builder: Any, name: str, result: Any, arguments: list[Any]) -> Any:
    """Return the LLVM function of this name."""
    return builder.module.globals.get(name) or ir.Function(builder.module, ir.FunctionType(result, arguments), name)


def _estimates_roots(context: Any) -> bool:
    """Tell whether kernels are compiled for a processor that estimates inverse roots in double precision."""
    return "+avx512f" in context.codegen().magic_tuple()[2].split(",")


def _estimated_inverse_root(builder: Any, value: Any, vector: ir.VectorType) -> Any:
    """Return 1 / sqrt(value) to a relative error of 2^-14."""
    lanes = ir.IntType(8)
    estimate = _declared(builder, "llvm.x86.avx512.rsqrt14.pd.512", vector, [vector, vector, lanes])
    return builder.call(estimate, [value, ir.Constant(vector, [0.0] * WIDTH), ir.Constant(lanes, 2**WIDTH - 1)])


def _inverse_root(typingcontext, value):  # type: ignore[no-untyped-def]
    """Return 1 / sqrt(value) of positive numbers; in double precision to rounding, from an estimate that is corrected.

    The argument must lie in the range of single precision; smaller ones than 1e-30 count as that. Where the processor estimates eight
    inverse roots at once, to 14 bits (AVX-512), a division and a root are saved.
    """
    single, double = ir.VectorType(_FLOAT, WIDTH), ir.VectorType(_DOUBLE, WIDTH)

    def constant(vector: ir.VectorType, number: float) -> Any:
        return ir.Constant(vector, [number] * WIDTH)

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        is_single = value.scalar.bitwidth == 32
        here = single if is_single else double
        least = constant(here, 1e-30 if not is_single else float.fromhex("0x1.4484bep-100"))
        bounded = builder.select(builder.fcmp_ordered(">", args[0], least), args[0], least)
        terms: tuple[float, ...] = (0.375, 0.5)
        if not is_single and _estimates_roots(context):
            y, terms = _estimated_inverse_root(builder, bounded, double), (0.3125, *terms)
        else:
            start = bounded if is_single else builder.fptrunc(bounded, single)
            root = builder.call(_declared(builder, f"llvm.sqrt.v{WIDTH}f32", single, [single]), [start])
            guess = builder.fdiv(constant(single, 1.0), root)
            if is_single:
                return guess
            y = builder.fpext(guess, double)
        gap = builder.fsub(constant(double, 1.0), builder.fmul(bounded, builder.fmul(y, y)))
        series = constant(double, terms[0])  # of (1 - gap)^(-1/2) - 1, over the gap
        for term in terms[1:]:
            series = builder.fadd(constant(double, term), builder.fmul(series, gap))
        return builder.fadd(y, builder.fmul(builder.fmul(y, gap), series))

    return value(value), codegen


# known to the type checker as anything: it takes the typing context for an argument
load: Any = intrinsic(_load)
store: Any = intrinsic(_store)
splat: Any = intrinsic(_splat)
total: Any = intrinsic(_total)
single: Any = intrinsic(_single)
double: Any = intrinsic(_double)
inverse_root: Any = intrinsic(_inverse_root)


def _operator(function: Any, name: str) -> None:
    def typing(context: Any) -> Any:
        def typed(left: Any, right: Any) -> Any:
            return left if isinstance(left, Vector) and left == right else None

        return typed

    type_callable(function)(typing)

    def lowered(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return getattr(builder, name)(*args)

    lower_builtin(function, Vector, Vector)(lowered)  # type: ignore[no-untyped-call]


for _function, _name in ((operator.add, "fadd"), (operator.sub, "fsub"), (operator.mul, "fmul")):
    _operator(_function, _name)


def trial() -> bool:
    """Tell whether a kernel with every operation compiles and is right."""

    def kernel(x: Any, y: Any) -> Any:
        value = load(x, 1)
        store(y, 0, inverse_root(value) * value + (value - splat(2.0)))
        return total(double(single(value)))

    x, y = np.arange(1.0, WIDTH + 2), np.zeros(WIDTH)
    found = numba.njit(kernel)(x, y)
    return bool(np.isclose(found, x[1:].sum()) and np.allclose(y, np.sqrt(x[1:]) + x[1:] - 2.0))
