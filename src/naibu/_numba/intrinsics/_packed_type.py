# mypy: disallow-untyped-calls=False, disallow-untyped-decorators=False, warn-unused-ignores=False
"""The Numba type of tuples that kernels read from memory: see `naibu._numba.intrinsics.packed_tuples`, which is to be imported instead."""

from __future__ import annotations

import array
import hashlib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core.typing.templates import AttributeTemplate
from numba.extending import NativeValue, infer_getattr, lower_builtin, lower_getattr_generic, models, register_model, typeof_impl, unbox
from numba.np import numpy_support
from numba.np.arrayobj import populate_array

_PLACE = ir.IntType(64)
_SOURCE = Path(__file__).read_bytes() if Path(__file__).exists() else b""  # machine code depends on it, as on what kernels name


class PackedTuple(types.BaseTuple):
    """A tuple of arrays, numbers and such tuples, of which a kernel gets the address.

    It is taken apart as other tuples are. An array takes a place of eight bytes for its address and one for each length, a number one.

    Parameters
    ----------
    items : tuple of numba type
        Of contiguous arrays, numbers and packed tuples.
    fields : tuple of str
        Names of the items, where they have names.
    """

    def __init__(self, items: tuple[Any, ...], fields: tuple[str, ...] = ()) -> None:
        self.types, self.count, self.fields = items, len(items), fields
        self.starts = [0]
        for one in items:
            self.starts.append(self.starts[-1] + _places(one))
        super().__init__(name=f"packed_{hashlib.sha256(_SOURCE + repr((fields, items)).encode()).hexdigest()[:16]}")

    @property
    def key(self) -> tuple[Any, ...]:
        """Packed tuples are equal where the types and names of their items are."""
        return self.types, self.fields

    def __getitem__(self, index: Any) -> Any:
        """Return the type of an item."""
        return self.types[index]

    def __len__(self) -> int:
        """Return how many items there are."""
        return self.count

    def __iter__(self) -> Iterator[Any]:
        """Give the types of the items."""
        return iter(self.types)


class Packed(array.array):  # type: ignore[type-arg]
    """Arguments of a kernel that lie in this array; the arrays are kept alive, and what they hold may change, numbers may not.

    Numba knows the type of a buffer by its class, of which there is one for each type, and looks no further: a call takes microseconds
    less than with an object whose type it has to ask for.
    """

    kind: PackedTuple
    kept: tuple[Any, ...]
    address: int


@cache  # Numba remembers classes by their addresses
def _class_of(kind: PackedTuple) -> type[Packed]:
    return type("Packed", (Packed,), {"kind": kind})


def packed(items: tuple[Any, ...]) -> Packed:
    """Return arguments in memory; see `naibu._numba.intrinsics.packed_tuples`."""
    kind = _type_of(items)
    memory = np.zeros(max(kind.starts[-1], 1), dtype=np.int64)
    _fill(memory, kind, items)
    made = _class_of(kind)("q", memory.tobytes())
    made.kept, made.address = items, made.buffer_info()[0]
    return made


def _places(kind: Any) -> int:
    if isinstance(kind, types.Array):
        return 1 + int(kind.ndim)
    return kind.starts[-1] if isinstance(kind, PackedTuple) else 1


def _type_of(items: tuple[Any, ...]) -> PackedTuple:
    found = []
    for one in items:
        kind: Any = _type_of(one) if isinstance(one, tuple) else numba.typeof(one)
        if isinstance(kind, types.Array) and kind.layout != "C":
            raise ValueError(f"arrays in packed tuples must be contiguous; one has the shape {one.shape} and the strides {one.strides}")
        found.append(kind)
    return PackedTuple(tuple(found), getattr(items, "_fields", ()))


def _fill(memory: Any, kind: PackedTuple, items: tuple[Any, ...]) -> None:
    for start, one, item in zip(kind.starts, kind.types, items, strict=False):
        if isinstance(one, PackedTuple):
            _fill(memory[start:], one, item)
        elif isinstance(one, types.Array):
            memory[start] = item.__array_interface__["data"][0]
            memory[start + 1 : start + 1 + item.ndim] = item.shape
        else:
            number = np.array([item], dtype=numpy_support.as_dtype(one))
            memory[start : start + 1].view(np.uint8)[: number.nbytes] = number.view(np.uint8)


@typeof_impl.register(Packed)
def _typeof(value: Packed, context: Any) -> PackedTuple:
    return value.kind


@register_model(PackedTuple)
class _PackedModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: PackedTuple) -> None:
        super().__init__(dmm, fe_type, _PLACE.as_pointer())


@unbox(PackedTuple)
def _unboxed(kind, value, c):  # type: ignore[no-untyped-def]
    number = c.pyapi.object_getattr_string(value, "address")
    address = c.pyapi.long_as_longlong(number)
    c.pyapi.decref(number)
    return NativeValue(c.builder.inttoptr(address, _PLACE.as_pointer()))


def _loaded(builder: Any, memory: Any, place: int, kind: Any) -> Any:
    """Return what lies at a place, which does not change while a kernel runs."""
    where = builder.bitcast(builder.gep(memory, [ir.Constant(_PLACE, place)]), kind.as_pointer())
    value = builder.load(where)
    value.set_metadata("invariant.load", builder.module.add_metadata([]))
    return value


def _item(context: Any, builder: Any, kind: PackedTuple, memory: Any, index: int) -> Any:
    start, one = kind.starts[index], kind.types[index]
    if isinstance(one, PackedTuple):
        return builder.gep(memory, [ir.Constant(_PLACE, start)])
    if not isinstance(one, types.Array):
        model = context.data_model_manager[one]
        return model.from_data(builder, _loaded(builder, memory, start, model.get_data_type()))
    array = context.make_array(one)(context, builder)
    size = context.get_abi_sizeof(context.get_data_type(one.dtype))
    shape = [_loaded(builder, memory, start + 1 + axis, _PLACE) for axis in range(one.ndim)]
    strides = [ir.Constant(_PLACE, size)]
    for length in shape[:0:-1]:
        strides.insert(0, builder.mul(strides[0], length, flags=["nsw"]))
    data = _loaded(builder, memory, start, array.data.type)
    populate_array(array, data, shape, strides if one.ndim else [], size, None)
    return array._getvalue()


@infer_getattr
class _NamedItem(AttributeTemplate):
    """What tells the type of an item that is read by its name."""

    key = PackedTuple

    def generic_resolve(self, kind: PackedTuple, name: str) -> Any:  # type: ignore[override]
        """Return the type of an item; None where none has this name."""
        return kind.types[kind.fields.index(name)] if name in kind.fields else None


@lower_getattr_generic(PackedTuple)
def _named_item(context, builder, kind, memory, name):  # type: ignore[no-untyped-def]
    return _item(context, builder, kind, memory, kind.fields.index(name))


@lower_builtin("static_getitem", PackedTuple, types.IntegerLiteral)
def _static_item(context, builder, sig, args):  # type: ignore[no-untyped-def]
    kind, (memory, index) = sig.args[0], args
    return _item(context, builder, kind, memory, index % len(kind))


@lower_builtin("static_getitem", PackedTuple, types.SliceLiteral)
def _static_slice(context, builder, sig, args):  # type: ignore[no-untyped-def]
    kind, (memory, chosen) = sig.args[0], args
    items = [_item(context, builder, kind, memory, index) for index in range(len(kind))[chosen]]
    return context.make_tuple(builder, sig.return_type, items)


class _Trial(NamedTuple):
    scale: float
    matrix: Any


def trial() -> bool:
    """Tell whether a kernel that takes a packed tuple apart compiles and is right."""

    def kernel(data: Any) -> Any:
        x, (scale, matrix), known = data
        x[0] += scale * data[1].matrix[1, 2] * len(data[1]) * matrix.ndim / 2 if known else 0.0
        return x[0] + len(x)

    x, matrix = np.zeros(3), np.arange(6, dtype=np.float32).reshape(2, 3)
    return bool(numba.njit(kernel)(packed((x, _Trial(0.5, matrix), True))) == 8.0 and x[0] == 5.0)
